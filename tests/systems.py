"""What Windows lacks, and what tests do without it."""

from __future__ import annotations

import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

import pytest


def not_on_windows(reason: str) -> pytest.MarkDecorator:
    """Skip a test there."""
    return pytest.mark.skipif(os.name == "nt", reason=reason)


@cache
def has_links() -> bool:
    """Whether files can be read through links: Windows asks for a privilege to make them."""
    if os.name != "nt":
        return True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a").mkdir()
        (folder / "a" / "file").touch()
        try:
            (folder / "b").symlink_to("a")
        except OSError:
            return False
        return (folder / "b" / "file").is_file()


needs_links = pytest.mark.skipif(not has_links(), reason="no links can be made here")


def share(source: Path, place: Path) -> None:
    """Have a file or folder at another place, too: a link, or a copy where there are none."""
    if has_links():
        place.symlink_to(source)
    elif source.is_dir():
        shutil.copytree(source, place)
    else:
        shutil.copy(source, place)


def kill(process: int) -> None:
    """End a process at once, by its number."""
    os.kill(process, 9)  # SIGKILL, whose name Windows lacks
