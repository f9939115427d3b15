"""Render frames that are hard to search, measure them, and print what is found, missed and wrong.

Usage: python -m benchmarks.search.hard_frames [--frames 300] [--only SET …] [--jobs 2] [--list 10]
       python -m benchmarks.search.hard_frames --only SET --frame 17 [--save frame.png]

See benchmarks/README.md for the sets.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import click
import cv2

from benchmarks.pool import ordered_map
from benchmarks.search.plates import TARGETS
from benchmarks.search.scene import render, stream
from benchmarks.search.sets import SETS, SETS_BY_NAME, FrameSet
from benchmarks.search.verdict import (
    HEADER,
    FrameVerdict,
    describe,
    failure_lines,
    judge_frame,
    table_line,
)
from kgcp.errors import Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.measurement.records import Miss, Outcome
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.simulation.scene import PlatePose

_FRAMES, _QUICK_FRAMES = 300, 40


def measured(grey: GreyArray, frame_set: FrameSet, seed: int, index: int) -> tuple[Outcome, ...]:
    """Search a frame for all targets, most of which it does not show."""
    camera = frame_set.shot(seed, index).camera
    try:
        return tuple(measure_frame(grey, camera, TARGETS, DetectSettings()))
    except Rejection as rejection:
        return tuple(Miss(t.name, rejection.reason, rejection.detail) for t in TARGETS)


def picture(frame_set: FrameSet, seed: int, index: int) -> GreyArray:
    """Render one frame of a set."""
    noise = stream(seed, frame_set.name, index, "pixels")
    return render(frame_set.shot(seed, index), seed, noise)


def verdict_of(task: tuple[str, int, int]) -> FrameVerdict:
    """Render, measure and judge one frame; the task is set, seed and index."""
    name, seed, index = task
    frame_set = SETS_BY_NAME[name]
    grey = picture(frame_set, seed, index)
    return judge_frame(index, frame_set.shot(seed, index), measured(grey, frame_set, seed, index))


def run_set(frame_set: FrameSet, frames: int, seed: int, jobs: int) -> Iterator[FrameVerdict]:
    """Yield the verdicts of a set's frames, in their order."""
    tasks = [(frame_set.name, seed, index) for index in range(frames)]
    yield from ordered_map(
        verdict_of,
        tasks,
        jobs=jobs,
        start=cv2.setNumThreads,
        start_arguments=(0,),
        items_per_task=4,
    )


def show_frame(frame_set: FrameSet, seed: int, index: int, save: Path | None) -> None:
    """Print everything about one frame, and write it to the file `save` if that is given."""
    shot, grey = frame_set.shot(seed, index), picture(frame_set, seed, index)
    if save is not None:
        cv2.imwrite(str(save), grey)
    plates: list[tuple[str, PlatePose]] = [("wanted", placed) for placed in shot.wanted]
    for kind, seen in (*plates, *shot.decoys):
        print(f"{kind}: {describe(shot, seen)}")
    outcomes = measured(grey, frame_set, seed, index)
    for outcome in outcomes:
        if isinstance(outcome, Miss):
            print(f"{outcome.target} {outcome.reason.value}: {outcome.detail}")
        else:
            print(f"{outcome.target} measured by ring {outcome.ring} at {outcome.centre_px}")
    verdict = judge_frame(index, shot, outcomes)
    print("\n".join(failure_lines(frame_set, [verdict], most=sys.maxsize)))


@click.command()
@click.option("--only", "names", multiple=True, type=click.Choice(list(SETS_BY_NAME)))
@click.option("--frames", type=click.IntRange(1), default=None, help="Frames per set.")
@click.option("--quick", is_flag=True, help=f"{_QUICK_FRAMES} frames per set.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
@click.option("--list", "most", type=click.IntRange(min=0), default=5, show_default=True,
              help="Number of missed plates to describe, per set and reason.")  # fmt: skip
@click.option(
    "--frame", type=click.IntRange(min=0), default=None, help="Show only this frame of a set."
)
@click.option(
    "--save", type=click.Path(path_type=Path), default=None, help="File to save the frame to."
)
def main(
    names: tuple[str, ...],
    frames: int | None,
    seed: int,
    jobs: int | None,
    most: int,
    frame: int | None,
    save: Path | None,
    *,
    quick: bool,
) -> None:
    """Print the table, and the frames with failures."""
    sets = [SETS_BY_NAME[name] for name in names] or list(SETS)
    if frame is not None:
        if len(sets) != 1:
            raise click.UsageError("--frame needs one --only SET")
        show_frame(sets[0], seed, frame, save)
        return
    count = frames or (_QUICK_FRAMES if quick else _FRAMES)
    print(HEADER, flush=True)
    failures: list[str] = []
    begin_s = time.perf_counter()
    for frame_set in sets:
        verdicts = list(run_set(frame_set, count, seed, jobs or usable_cores()))
        print(table_line(frame_set, verdicts), flush=True)
        failures += failure_lines(frame_set, verdicts, most)
    print(f"{time.perf_counter() - begin_s:.0f} s")
    print(
        "\n".join(["set and frame of failures; show one with --only SET --frame FRAME:", *failures])
    )


if __name__ == "__main__":
    main()
