"""Settings of all tests."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from kgcp.pipeline.execution.threads import use_one_thread_each

use_one_thread_each()  # before numpy is loaded: threads of several workers wait for each other

_LIMIT_S = 60.0  # of a call that does nothing, after all is compiled

# A busy machine is no failure, and the same tests try the same examples on every machine.
settings.register_profile("kgcp", deadline=None, derandomize=True)
settings.load_profile("kgcp")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what most tests use before several processes run them: each would compile it."""
    jobs = getattr(session.config.option, "numprocesses", None)
    if jobs:
        from kgcp.pipeline.execution.compiled_code import compilation
        from kgcp.pipeline.execution.local_processes import SupervisedProcessPool

        with SupervisedProcessPool(jobs, _LIMIT_S, compilation()) as pool:
            list(pool.map(abs, range(jobs)))


@pytest.fixture(scope="module")
def fewest_sub_pixels() -> Iterator[None]:
    """Render all plates and discs by 4 × 4 sub-pixels per pixel, as large ones, not up to 10 × 10.

    Each is covered exactly, but for the bend of an edge within it. On a plate, no pixel's light
    changes by more than 0.0024 of white, RMS 0.00003; on discs of R 3 to 18 px by 0.0011, RMS
    0.00004, and their area by 6 · 10⁻⁶. Noise is 0.01. Rendering took longer than measuring.
    """
    from kgcp.simulation import disc_field, plate

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plate, "_SUB_PIXELS_ACROSS", 1)
        patch.setattr(disc_field, "_SUB_PIXELS_ACROSS", 1)
        yield


@pytest.fixture
def no_place_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave figures to the tests of the page: to draw them takes longer than to place targets."""
    monkeypatch.setattr(
        "kgcp.pipeline.ground.place.draw_places",
        lambda _: dict.fromkeys(("diameters", "frames", "positions"), b""),
    )


@pytest.fixture
def no_bias_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave figures to the tests of the page: to draw them takes longer than all else."""
    import numpy as np

    from kgcp.report.style import Picture

    blank = Picture(b"", np.zeros(0, np.intp), np.zeros((0, 2), np.intp))
    drawn = dict.fromkeys(("error", "time", "image", "map"), blank)
    monkeypatch.setattr("kgcp.pipeline.bias_report.draw_figures", lambda *_: drawn)


@pytest.fixture
def sigint_raises() -> Iterator[None]:
    """Let SIGINT raise `KeyboardInterrupt` here, and by default end processes started here.

    A shell starts what it runs in the background with SIGINT ignored, and children inherit that.
    """
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


@pytest.fixture
def hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that another user may not enter; it hides even which files it has."""
    folder, ask = tmp_path / "hidden", os.stat

    def refuse(
        path: str | Path | int, *, dir_fd: int | None = None, follow_symlinks: bool = True
    ) -> os.stat_result:
        if str(path).startswith(str(folder)):
            raise PermissionError(13, "Permission denied", str(path))
        return ask(path, dir_fd=dir_fd, follow_symlinks=follow_symlinks)

    monkeypatch.setattr("os.stat", refuse)
    monkeypatch.setattr("pyarrow.parquet.read_table", refuse)
    monkeypatch.setattr("pyarrow.parquet.read_schema", refuse)
    return folder
