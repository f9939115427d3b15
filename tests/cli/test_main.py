from __future__ import annotations

import errno
import re
import subprocess
import sys
import time
import warnings
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from kgcp import __version__
from kgcp.cli import COMMANDS, Program, main
from kgcp.errors import KgcpError, KgcpWarning
from tests.cli.conftest import SAMPLE, SampleFlight

HEAVY = {"cv2", "jinja2", "matplotlib", "numpy", "pandas", "PIL", "pyarrow", "pyproj", "scipy"}


def run_raising(error: BaseException) -> tuple[int, str, str]:
    """Run a program of one command that raises, and return exit code, stdout and stderr."""

    class OneCommand(Program):
        def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:  # noqa: ARG002 - click's signature
            @click.command(cmd_name)
            def fail() -> None:
                raise error

            return fail

    result = CliRunner().invoke(OneCommand("kgcp"), ["detect"], catch_exceptions=False)
    return result.exit_code, result.stdout, result.stderr


def test_a_known_error_is_printed_in_one_line_with_exit_code_1() -> None:
    error = KgcpError("flight.toml: [camera] fx: is missing; give it\nas a number")
    assert run_raising(error) == (
        1,
        "",
        "kgcp: error: flight.toml: [camera] fx: is missing; give it as a number\n",
    )


def test_an_error_names_the_option_that_helps() -> None:
    error = KgcpError("out: is full; choose another results folder", option="out")
    assert str(error).endswith("choose another results folder")
    assert run_raising(error)[2].endswith("; choose another results folder (--out)\n")


def test_a_known_warning_is_printed_in_one_line_and_does_not_stop_the_command() -> None:
    class OneCommand(Program):
        def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:  # noqa: ARG002 - click's signature
            @click.command(cmd_name)
            def warn() -> None:
                warnings.warn("leap seconds are known until 2027", KgcpWarning, stacklevel=1)
                click.echo("done")

            return warn

    result = CliRunner().invoke(OneCommand("kgcp"), ["detect"], catch_exceptions=False)
    assert (result.exit_code, result.stdout) == (0, "done\n")
    assert result.stderr == "kgcp: warning: leap seconds are known until 2027\n"


def test_an_interrupt_is_printed_in_one_line_with_exit_code_130() -> None:
    code, out, err = run_raising(KeyboardInterrupt())
    assert (code, out, err.count("\n")) == (130, "", 1)
    assert err.startswith("kgcp: interrupted")


def test_an_unexpected_error_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        run_raising(ZeroDivisionError())


def test_wrong_usage_ends_with_click_s_exit_code_2() -> None:
    assert CliRunner().invoke(main, ["detekt"]).exit_code == 2
    assert CliRunner().invoke(main, ["detect", "--no-such-option"]).exit_code == 2


def test_a_folder_without_a_flight_is_a_known_error(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("empty")
    result = CliRunner().invoke(main, ["detect", str(folder)])
    assert result.exit_code == 1
    assert result.stderr.startswith(f"kgcp: error: {folder / 'flight.toml'}: does not exist;")
    assert result.stderr.count("\n") == 1


def test_every_command_is_listed() -> None:
    text = CliRunner().invoke(main, ["--help"]).stdout
    for name in COMMANDS:
        assert f"\n  {name} " in text


@pytest.mark.parametrize("width", [50, 80, 200])
def test_the_list_of_commands_has_whole_sentences(width: int) -> None:
    result = CliRunner().invoke(main, ["--help"], terminal_width=width)
    listed = " ".join(result.stdout.partition("\nCommands:")[2].split())
    assert "..." not in listed
    for name in COMMANDS:
        command = main.get_command(click.Context(main), name)
        assert command is not None
        sentence = re.split(r"(?<=\.)\s", " ".join((command.help or "").split()))[0]
        assert f"{name} {sentence}" in listed


def test_an_error_of_an_option_begins_with_its_dashes(tmp_path: Path) -> None:
    arguments = ["target", "--new", "1", "--diameter", "0.9", "--sheet", "A4"]
    result = CliRunner().invoke(main, [*arguments, "--out", str(tmp_path)])
    assert result.stderr.startswith("kgcp: error: --sheet: 'T1' needs 1145 × ")
    assert result.exit_code == 1


@pytest.mark.parametrize(
    ("command", "option", "others"),
    [
        ("export-gcp", "--max-sd", ()),
        ("export-gcp", "--mark-floor-px", ()),
        ("init", "--lever-arm", ("0", "0")),
    ],
)
def test_nan_as_the_value_of_an_option_is_wrong_usage(
    tmp_path: Path, command: str, option: str, others: tuple[str, ...]
) -> None:
    result = CliRunner().invoke(main, [command, str(tmp_path), option, "nan", *others])
    assert result.stderr.endswith(f"Error: Invalid value for '{option}': nan is not a number.\n")
    assert result.exit_code == 2


@pytest.mark.parametrize(
    "arguments",
    [["detect", str(SAMPLE), "--overlay", "s3://b/sheet"], ["simulate", "s3://b/flight"]],
)
def test_a_url_is_no_path_of_this_machine(arguments: list[str]) -> None:
    """It would become local folders `s3:/b`."""
    result = CliRunner().invoke(main, [*arguments, "--frames", "1"])
    assert result.exit_code == 2
    assert f"{arguments[-1]} is a URL; name a file or folder of this machine" in result.stderr


@pytest.mark.parametrize("option", ["--overlay", "--out", "--places"])
def test_an_option_is_no_path_of_the_option_before_it(tmp_path: Path, option: str) -> None:
    """A contact sheet would be written into a folder named -q."""
    result = CliRunner().invoke(main, ["detect", str(tmp_path), option, "-q"])
    assert result.exit_code == 2
    assert f"Invalid value for '{option}': -q looks like an option" in result.stderr


def test_an_error_names_an_option_with_hyphens_between_its_words(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["detect", str(tmp_path), "--jobs", "0", "--min-score", "2"])
    assert result.stderr.startswith("kgcp: error: --min-score: 2 is out of range; ")
    assert result.exit_code == 1


@pytest.mark.parametrize("path", [None, "results/run.json"])
def test_a_full_disk_is_reported_in_one_line(path: str | None) -> None:
    code, _, stderr = run_raising(OSError(errno.ENOSPC, "No space left on device", path))
    where = "" if path is None else f"{path}: "
    assert stderr == f"kgcp: error: {where}no space left; make room, then repeat the command\n"
    assert code == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no such device")
@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("detect", "--help")])
def test_help_onto_a_full_disk_ends_in_one_line(arguments: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "kgcp", *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.stderr == "kgcp: error: no space left; make room, then repeat the command\n"
    assert done.returncode == 1


@pytest.mark.skipif(sys.platform == "win32", reason="Popen closes no streams there")
@pytest.mark.parametrize("closed", [(2,), (0, 1, 2)])
def test_detection_runs_where_standard_streams_are_closed(
    unmeasured: SampleFlight, closed: tuple[int, ...]
) -> None:
    for frame in sorted((unmeasured.path / "frames").iterdir())[2:]:
        frame.unlink()
    call = ["-m", "kgcp", "detect", str(unmeasured.path), "--jobs", "1"]
    program = (
        "import os, sys\n"
        f"for number in {closed}: os.close(number)\n"
        f"os.execv(sys.executable, [sys.executable, *{call}])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], check=False)
    assert done.returncode == 0
    assert (unmeasured.out / "detections.parquet").is_file()


def test_the_module_can_be_run_and_prints_its_version() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "kgcp", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"kgcp, version {__version__}\n"


def test_help_loads_no_heavy_library_and_is_quick() -> None:
    program = (
        "import sys\n"
        "from click.testing import CliRunner\n"
        "from kgcp.cli import main\n"
        "assert CliRunner().invoke(main, ['--help']).exit_code == 0\n"
        "print(*{name.partition('.')[0] for name in sys.modules})\n"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    seconds = time.perf_counter() - start
    assert not HEAVY & set(done.stdout.split())
    assert seconds < 2.0  # 0.2 s on an idle machine; loose, as tests share theirs


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("orient", str(SAMPLE), "--device", "{}/d.toml"), "d.toml: is protected, or open in"),
        (("simulate", "{}/flight", "--frames", "1"), "flight: cannot be written"),
    ],
)
def test_a_protected_folder_is_one_line(
    hidden: Path, arguments: tuple[str, ...], problem: str
) -> None:
    result = CliRunner().invoke(main, [argument.format(hidden) for argument in arguments])
    assert result.exit_code == 1
    assert problem in result.stderr.splitlines()[-1]
