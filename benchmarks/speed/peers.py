"""CPU time of kgcp and of other detectors of coded targets, on the same frames in the same run.

Usage: python -m benchmarks.speed.peers [--flights DIR] [--photos DIR] [--frames 10]
(DIR as for benchmarks.speed.relative_costs)

Each detector has one thread, and its time includes decoding the frame, which takes place right
before: in a tight loop, decoding is up to twice as fast as in a run. AprilTag 3 (pupil-apriltags,
`pip install pupil-apriltags`) searches for tag36h11 with decimation 2, and OpenCV's ArUco for
6x6_250, both with default settings. The frames show none of their markers, so that only their
search is timed. kgcp also measures its targets if the frames show any. If the tone curve is
unknown, it starts from the base curve that a run would have chosen, if the frames determine it.
"""

from __future__ import annotations

import importlib
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.pipeline.execution.threads import use_one_thread_each

if TYPE_CHECKING:
    from benchmarks.speed.sources import Source
    from kgcp.geometry.arrays import GreyArray

_REPEATS = 3  # the smallest counts, since other work of the machine only adds time
_HEADER = "set                       frames   Mpx  decode ms     kgcp  AprilTag   ArUco"


@cache
def _april_tags() -> Callable[[GreyArray], object] | None:
    try:
        detector = importlib.import_module("pupil_apriltags").Detector
    except ModuleNotFoundError:
        return None
    # one detector for all sets: when a second one ends, it frees memory that it does not own
    made = detector(families="tag36h11", nthreads=1, quad_decimate=2.0)
    return made.detect  # type: ignore[no-any-return]  # it has no types


def _aruco() -> Callable[[GreyArray], object]:
    import cv2

    cv2.setNumThreads(0)
    made = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250))
    return made.detectMarkers


def ratios_of(source: Source) -> Iterator[tuple[float, list[float]]]:
    """Yield, per frame, the time of decoding [s] and each detector's time, divided by it."""
    from kgcp.io.images.frames import read_grey
    from kgcp.measurement.frame import examine
    from kgcp.measurement.search.pyramid import eight_bit
    from kgcp.settings import DetectSettings

    flight, settings = source.flight, DetectSettings()

    def kgcp(grey: GreyArray) -> object:
        return examine(grey, flight.camera, flight.targets, settings, source.priors)

    detectors = [kgcp, _april_tags(), _aruco()]
    for frame in source.frames:
        path = flight.frames_folder / frame
        decoding: list[float] = []
        least = [float("nan") if detect is None else float("inf") for detect in detectors]
        for _ in range(_REPEATS):
            for number, detect in enumerate(detectors):
                if detect is None:
                    continue
                begin_s = time.process_time()
                grey = eight_bit(read_grey(path, flight.camera))
                decoded_s = time.process_time()
                detect(grey)
                least[number] = min(least[number], time.process_time() - decoded_s)
                decoding.append(decoded_s - begin_s)
        decode_s = statistics.median(decoding)
        yield decode_s, [1.0 + each / decode_s for each in least]


@click.command()
@click.option("--flights", type=click.Path(path_type=Path), default=None, help="Folder of flights.")
@click.option(
    "--photos",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder of photographs without targets.",
)
@click.option(
    "--frames", type=click.IntRange(2), default=10, show_default=True, help="Frames per line."
)
def main(flights: Path | None, photos: Path | None, frames: int) -> None:
    """Print median CPU times of the frames of every set, divided by that of decoding."""
    use_one_thread_each()  # before any library of numbers is loaded
    from benchmarks.speed.sources import flights_of, photographs_of

    with tempfile.TemporaryDirectory(prefix="kgcp_peers_") as folder:
        sources = flights_of(flights, Path(folder), frames)
        print(
            "CPU time with decoding, on one thread, divided by that of decoding; medians",
            flush=True,
        )
        print(_HEADER, flush=True)
        for source in (*sources, *photographs_of(photos, sources[0])):
            chosen = source.spread(frames)
            next(ratios_of(chosen))  # compiles
            rows = list(ratios_of(chosen))
            decode_ms = 1e3 * statistics.median(decode_s for decode_s, _ in rows)
            medians = [
                statistics.median(column) for column in zip(*(r for _, r in rows), strict=True)
            ]
            megapixels = 1e-6 * source.flight.camera.width * source.flight.camera.height
            print(
                f"{source.name:26s}{len(rows):6d}{megapixels:6.1f}{decode_ms:11.1f}"
                f"{medians[0]:9.2f}{medians[1]:10.2f}{medians[2]:8.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
