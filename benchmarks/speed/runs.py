"""Measurements in separate processes: two jobs against one, memory, size, `--help`."""

from __future__ import annotations

import multiprocessing
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2

from benchmarks.speed.costs import Costs, FrameCost, cost_and_memory, use_one_opencv_thread
from benchmarks.speed.sources import Source, flight_over
from kgcp.io.flight.flight import Flight
from kgcp.pipeline.detect import RunOptions, detect_flight
from kgcp.settings import DetectSettings

_JOBS_FRAMES = 120
_WARM = 0.2  # share of the frames before the clock starts
_MEGAPIXELS = (2, 4, 8, 12, 16, 24, 36, 50)
_BASE_MB, _FRAMES_HELD = 250, 4  # limit of a worker's memory: base [MB], and bytes per pixel
_QUALITY = 92
_HELP_RUNS = 5
_MB = 1e6


class _Clock:
    """Measures the time from the end of the warm-up to the last frame."""

    def __init__(self) -> None:
        self.times_s: list[float] = []

    def note(self, text: str) -> None:
        """Ignore a message."""

    def progress(self, stage: str, done: int, total: int, found: int) -> None:
        """Record the time at which a frame was done."""
        del stage, done, total, found
        self.times_s.append(time.perf_counter())

    @property
    def frames_per_s(self) -> float:
        """Frames per second after the warm-up."""
        first = int(_WARM * len(self.times_s))
        return (len(self.times_s) - 1 - first) / (self.times_s[-1] - self.times_s[first])


def jobs_line(source: Source, work: Path) -> str:
    """Examine the same frames with one job and with two; return both rates in words."""
    folder = work / "repeated"
    folder.mkdir()
    for number in range(_JOBS_FRAMES):
        frame = source.flight.frames_folder / source.frames[number % len(source.frames)]
        shutil.copy(frame, folder / f"{number:04d}{frame.suffix}")
    flight = replace(source.flight, frames_folder=folder, times_file=None)
    one, two = (_rate(flight, work / f"out_{jobs}", jobs) for jobs in (1, 2))
    return f"two jobs: {two:.1f} frames/s, {two / one:.2f} times the {one:.1f} of one"


def _rate(flight: Flight, out: Path, jobs: int) -> float:
    clock = _Clock()
    out.mkdir()
    settings = replace(DetectSettings(), is_guided=False)
    detect_flight(flight, settings, out=out, options=RunOptions(jobs=jobs), listener=clock)
    return clock.frames_per_s


def help_line() -> str:
    """Time `kgcp --help`."""
    best_s = float("inf")
    for _ in range(_HELP_RUNS):
        begin_s = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "kgcp", "--help"], check=True, stdout=subprocess.DEVNULL
        )
        best_s = min(best_s, time.perf_counter() - begin_s)
    return f"kgcp --help: {best_s:.2f} s"


def size_lines(picture: tuple[Path, Source], work: Path) -> Iterator[str]:
    """Rescale a picture; yield CPU time and memory for each size, from separate processes."""
    path, source = picture
    yield f"{path.name}, rescaled"
    yield "   Mpx  decode ms   search   whole   ns/pixel  worker MB   limit MB"
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise FileNotFoundError(path)
    for megapixels in _MEGAPIXELS:
        scale = (1e6 * megapixels / (image.shape[0] * image.shape[1])) ** 0.5
        method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
        resized = cv2.resize(image, None, fx=scale, fy=scale, interpolation=method)
        height, width = resized.shape[:2]
        folder = work / f"size_{megapixels}"
        folder.mkdir()
        cv2.imwrite(str(folder / "frame.jpg"), resized, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        flight = flight_over(source, folder, width, height)
        yield _in_own_process(folder / "frame.jpg", flight)


def _in_own_process(path: Path, flight: Flight) -> str:
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=use_one_opencv_thread) as pool:
        return _size_line(
            *pool.submit(cost_and_memory, path, flight.camera, flight.targets).result()
        )


def _size_line(cost: FrameCost, memory_bytes: int) -> str:
    costs = Costs("", "", (cost,))
    memory_mb = memory_bytes / _MB
    limit_mb = _BASE_MB + _FRAMES_HELD * cost.pixels / _MB
    return (
        f"{1e-6 * cost.pixels:6.1f}{1e3 * cost.decode_s:11.1f}{costs.search:9.2f}{costs.whole:8.2f}"
        f"{1e9 * cost.measure_s / cost.pixels:11.1f}{memory_mb:11.0f}{limit_mb:11.0f}"
    )
