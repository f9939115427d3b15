"""What shells on Windows leave to programs: file patterns, `~`, and slips in quoting."""

from __future__ import annotations

import os
from collections.abc import Iterable
from glob import glob
from pathlib import Path

import click

SHELL_EXPANDS = os.name != "nt"
"""Whether the shell has replaced patterns and `~` already."""


def as_meant(arguments: Iterable[str]) -> list[str]:
    r"""Return the arguments as they were meant to be.

    Programs on Windows take \" for a quotation mark, so that the folder "D:\my photos\" arrives
    as `D:\my photos"`, and with it the options behind it, up to the next mark.

    Raises
    ------
    click.UsageError
        If an argument has swallowed options.
    """
    if SHELL_EXPANDS:
        return [*arguments]
    meant = [os.path.expanduser(argument.removesuffix('"')) for argument in arguments]  # noqa: PTH111 - a pattern is no path
    for argument in meant:
        if '" -' in argument:
            raise click.UsageError(
                f"{argument}: was read as one argument; leave out the backslash before the"
                " quotation mark"
            )
    return meant


def paths_of(text: str) -> list[Path]:
    """Return the paths that an argument names, sorted: several if it is a pattern with * or ?.

    A pattern that matches nothing stays as it is; the reader then reports that it does not exist.
    """
    if SHELL_EXPANDS or not {"*", "?"} & set(text):
        return [Path(text)]
    matches = sorted(glob(text.replace("[", "[[]")))  # noqa: PTH207 - passes over hidden files
    return [Path(match) for match in matches] or [Path(text)]
