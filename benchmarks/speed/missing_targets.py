"""CPU time of frames in which a predicted target is missing, relative to decoding.

Usage: python -m benchmarks.speed.missing_targets [--flights DIR] [--frames 20]

In every second frame the plate is painted over, with a disc or with a copy of the ground beside it.
The other frames predict where it must be.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.pipeline.execution.threads import use_one_thread_each

if TYPE_CHECKING:
    from benchmarks.speed.sources import Source
    from kgcp.geometry.arrays import GreyArray
    from kgcp.measurement.records import Measurement

_REPEATS = 3  # the smallest counts, since other work of the machine only adds time
_REACH = 1.6  # radius that is painted over, in radii of the main ring
_HEADER = "set                     painted      frames   Mpx  decode ms  first pass both passes"


@dataclass(frozen=True, slots=True)
class MissCost:
    """CPU times of one frame [s]: decoding, first pass with decoding, and second pass."""

    decode_s: float
    first_pass_s: float
    second_pass_s: float


def _timed(function: Callable[[], object], before: Callable[[], object] = lambda: None) -> float:
    """Return the CPU time of a function; `before` is called before each run and not timed."""
    best_s = float("inf")
    for _ in range(_REPEATS):
        before()
        begin_s = time.process_time()
        function()
        best_s = min(best_s, time.process_time() - begin_s)
    return best_s


def _painted(image: GreyArray, measured: Measurement, paint: str) -> GreyArray:
    """Hide a plate below a grey disc, or below a copy of the ground beside it."""
    import numpy as np

    (x, y), reach = measured.centre_px, _REACH * measured.appearance.radius_px
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    is_plate = np.hypot(columns - x, rows - y) < reach
    if paint == "disc":
        image[is_plate] = np.median(image)
    else:
        image[is_plate] = np.roll(image, round(2.2 * reach), axis=1)[is_plate]
    return image


def costs_of(source: Source, work: Path, paint: str) -> Iterator[MissCost]:
    """Paint over the targets of every second frame, and time both passes on these frames."""
    import cv2
    import numpy as np

    from kgcp.io.flight.data import FlightData
    from kgcp.io.images.frames import read_grey
    from kgcp.measurement.records import Measurement
    from kgcp.pipeline.execution.kept_frames import KeptFrames, remove_kept_frames
    from kgcp.pipeline.frame_task import (
        DetectionJob,
        FrameInput,
        GuidedInput,
        examine_frame,
        examine_frame_again,
    )
    from kgcp.pipeline.guidance import FrameTracks, predict_missing
    from kgcp.settings import DetectSettings

    folder = work / f"{source.name}_{paint}"
    shutil.copytree(source.flight.frames_folder, folder)
    flight = replace(source.flight, frames_folder=folder)
    data = FlightData(flight, source.frames)
    kept = KeptFrames(work / f"{source.name}_{paint}_kept", 1 << 31)
    kept.folder.mkdir()

    def forget_frames() -> None:
        """Remove kept frames, because replacing a file takes longer than creating one."""
        remove_kept_frames(kept.folder)
        kept.folder.mkdir()

    settings = DetectSettings()
    job = DetectionJob(folder, flight.camera, None, flight.targets, settings, kept_frames=kept)
    times = data.frame_times.time_s
    inputs = [FrameInput(frame, times.get(frame), {}) for frame in source.frames]
    tracks = FrameTracks(flight.targets, source.frames)
    firsts = [examine_frame(job, frame_input) for frame_input in inputs]
    hidden = []
    for row, result in enumerate(firsts):
        (first, *_) = result.outcomes
        if row % 2 and isinstance(first, Measurement):
            path = folder / source.frames[row]
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
            cv2.imwrite(str(path), _painted(np.asarray(image), first, paint))
            firsts[row] = examine_frame(job, inputs[row])
            hidden.append(row)
        tracks.add(row, firsts[row])
    predictions, _ = predict_missing(flight, data, tracks)
    for row in hidden:
        visible = {
            name: each
            for name, each in predictions.get(row, {}).items()
            if each.is_visible(flight.camera)
        }
        if visible:
            guided = GuidedInput(inputs[row], firsts[row], visible)
            path = folder / source.frames[row]
            decode_s = _timed(partial(read_grey, path, flight.camera))
            first_pass_s = _timed(partial(examine_frame, job, inputs[row]), before=forget_frames)
            second_pass_s = _timed(partial(examine_frame_again, job, guided))
            yield MissCost(decode_s, first_pass_s, second_pass_s)


@click.command()
@click.option("--flights", type=click.Path(path_type=Path), default=None, help="Folder of flights.")
@click.option(
    "--frames", type=click.IntRange(4), default=20, show_default=True, help="Frames per line."
)
def main(flights: Path | None, frames: int) -> None:
    """Print mean CPU times of the frames of every set, divided by that of decoding."""
    use_one_thread_each()  # before any library of numbers is loaded
    from benchmarks.speed.costs import use_one_opencv_thread
    from benchmarks.speed.sources import flights_of

    use_one_opencv_thread()
    with tempfile.TemporaryDirectory(prefix="kgcp_missing_") as folder:
        work = Path(folder)
        print("CPU time on one thread, divided by that of decoding; means", flush=True)
        print(_HEADER, flush=True)
        for source in flights_of(flights, work, frames):
            for paint in ("disc", "ground"):
                costs = list(costs_of(source, work, paint))
                if not costs:
                    continue
                decode_s = statistics.mean(cost.decode_s for cost in costs)
                first_pass_s = statistics.mean(cost.first_pass_s for cost in costs)
                both_passes_s = first_pass_s + statistics.mean(cost.second_pass_s for cost in costs)
                megapixels = 1e-6 * source.flight.camera.width * source.flight.camera.height
                print(
                    f"{source.name:24s}{paint:10s}{len(costs):9d}{megapixels:6.1f}"
                    f"{1e3 * decode_s:11.1f}{first_pass_s / decode_s:12.2f}"
                    f"{both_passes_s / decode_s:12.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
