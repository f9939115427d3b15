"""Import of matplotlib without the settings of the current folder."""

from __future__ import annotations

from contextlib import chdir
from importlib import import_module


def load_matplotlib() -> None:
    """Import it without the settings of the current folder, before anything else imports it.

    It reads a file matplotlibrc there, and commands are mostly run in a flight's folder, which may
    come from anybody.
    """
    with chdir("/"):
        import_module("matplotlib")
