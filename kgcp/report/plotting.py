"""Import of matplotlib without the settings of the current folder."""

from __future__ import annotations

from contextlib import chdir
from importlib import import_module


def load_matplotlib() -> None:
    """Import matplotlib before anything else does, without the settings of the current folder.

    It would read a file matplotlibrc there. Commands are mostly run in the folder of a flight,
    which may come from anybody.
    """
    with chdir("/"):
        import_module("matplotlib")
