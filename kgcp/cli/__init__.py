"""The command line: thin commands, and the one place that prints known errors as one line."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TextIO

import click

from kgcp import __version__
from kgcp.cli.encodings import print_anything
from kgcp.cli.shells import as_meant
from kgcp.errors import KgcpError, KgcpWarning, SettingError
from kgcp.pipeline.execution.threads import use_one_thread_each

_OBJECTS = 50_000  # between two searches for garbage; loading libraries leaves none

STARTED_S = time.perf_counter()
"""When the program began to run: after some 20 ms of Python's own."""

# Name → module, in the order of use; a module is imported when its command is called.
COMMANDS = {
    "init": "kgcp.cli.init",
    "check": "kgcp.cli.check",
    "detect": "kgcp.cli.detect",
    "export-gcp": "kgcp.cli.export_gcp",
    "bias-report": "kgcp.cli.bias_report",
    "orient": "kgcp.cli.orient",
    "place": "kgcp.cli.place",
    "plan": "kgcp.cli.plan",
    "target": "kgcp.cli.target",
    "calibrate": "kgcp.cli.calibrate",
    "simulate": "kgcp.cli.simulate",
}

_WHOLE = 200  # letters: more than a first sentence has
_EXIT_KNOWN_ERROR = 1  # 2 is click's own, for wrong usage
_EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells count


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Print each `KgcpWarning` once, as one line; leave other warnings to Python."""
    with warnings.catch_warnings():
        show, printed = warnings.showwarning, set[str]()

        def show_in_one_line(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            """Write one of kgcp's warnings as a line; leave others as they are."""
            if issubclass(category, KgcpWarning):
                text = f"kgcp: warning: {message}"
                if text not in printed:
                    click.echo(text, err=True)
                printed.add(text)
            else:
                show(message, category, filename, lineno, file, line)

        warnings.simplefilter("always", KgcpWarning)
        warnings.showwarning = show_in_one_line
        yield


def _open_all_streams() -> None:
    """Let streams that are closed swallow what is printed, as services and `2>&-` leave them.

    Otherwise the next file that is opened takes the stream's number, and with it what libraries
    print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # noqa: FBT003 - gets the number
        if getattr(sys, name) is None:
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115 - to the end


def _drop_unwritten_output() -> None:
    """Discard what stdout cannot take; Python 3.13 would try again at its end, and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Program(click.Group):
    """The `kgcp` command: imports a command when it is called, prints known errors as one line."""

    def main(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - click's signature
        """Run the program; even its help has characters that not every stream can print."""
        _open_all_streams()
        print_anything(sys.stdout, sys.stderr)
        gc.set_threshold(_OBJECTS)
        atexit.register(gc.freeze)  # 0.2 s of searching what ends with the process anyway
        try:
            # Else click replaces every pattern on Windows, also that of --frames, however quoted.
            return super().main(*args, windows_expand_args=False, **kwargs)
        except OSError as error:  # here and not in `invoke`, which help does not reach
            if error.errno != errno.ENOSPC:
                raise
            where = "" if error.filename is None else f"{error.filename}: "
            text = f"kgcp: error: {where}no space left; make room, then repeat the command"
            click.echo(text, err=True)
            _drop_unwritten_output()
            sys.exit(_EXIT_KNOWN_ERROR)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments as they were meant in the shell."""
        return super().parse_args(ctx, as_meant(args))

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the commands in the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """Import a command."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = import_module(COMMANDS[cmd_name]).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands with the whole first sentence of each, however narrow the terminal."""
        commands = ((name, self.get_command(ctx, name)) for name in self.list_commands(ctx))
        with formatter.section("Commands"):
            formatter.write_dl(
                [
                    (name, command.get_short_help_str(_WHOLE))
                    for name, command in commands
                    if command is not None
                ]
            )

    def _in_options(self, ctx: click.Context, error: KgcpError) -> str:
        """Return the text of an error; a setting has the name of the option that it came from."""
        text = error.on_command_line()
        command = self.get_command(ctx, ctx.invoked_subcommand or "")
        if command is None or not isinstance(error, SettingError):
            return text
        option = f"--{error.key.replace('_', '-')}"
        for parameter in command.params:
            if option in parameter.opts or parameter.name == error.key:
                return text.replace(error.key, parameter.opts[0], 1)
        return text

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; unexpected exceptions keep their traceback."""
        use_one_thread_each()  # before a command imports numpy
        try:
            with _one_line_warnings():
                return super().invoke(ctx)
        except KgcpError as error:
            click.echo(f"kgcp: error: {self._in_options(ctx, error)}", err=True)
            ctx.exit(_EXIT_KNOWN_ERROR)
        except KeyboardInterrupt:
            click.echo("kgcp: interrupted; files written so far are complete", err=True)
            ctx.exit(_EXIT_INTERRUPTED)


@click.group(cls=Program, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="kgcp")
def main() -> None:
    """Measure coded circular targets in aerial frames and compute ground control points.

    The usual sequence for a flight folder:

    \b
      kgcp init FLIGHT           write flight.toml from the files in the folder
      kgcp check FLIGHT          report what is in a flight folder, and what does not fit
      kgcp detect FLIGHT         find and measure the target in every frame
      kgcp export-gcp FLIGHT     compute and export kinematic ground control points
      kgcp bias-report FLIGHT    compare measured distances with reference poses
    """  # noqa: D301 - \b is click's mark for lines that stay
