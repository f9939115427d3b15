"""Run `kgcp detect` for a long time, and measure whether memory grows or speed falls.

Linux only, because it reads memory and CPU time of the processes in /proc.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from benchmarks.reliability.torture import Life, detecting, make_flight

_ABSENT = 0.8  # share of frames without a target, which take little time
_TURN_S = 1.0
_WARM_UP = 0.05  # share of the frames after which memory should no longer grow
_TENTH = 0.1
_MOST_GROWTH_MB = 20.0
_LEAST_SPEED = 0.95
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_MB_PER_PAGE = os.sysconf("SC_PAGE_SIZE") / 2**20
_CPU_FIELDS = slice(11, 13)  # fields of /proc/PID/stat after the name: user and system time


@dataclass(frozen=True, slots=True)
class Sample:
    """Progress of a run, and the time and memory that it has used.

    Attributes
    ----------
    done : int
        Number of frames examined, counting those of the second pass again.
    is_looking : bool
        Whether frames remain to be examined; afterwards, the table is written.
    time_s, cpu_s : float
        Wall time, and CPU time of parent and workers together.
    parent_mb, workers_mb : float
        Resident memory of the parent and of the largest worker.
    """

    done: int
    is_looking: bool
    time_s: float
    cpu_s: float
    parent_mb: float
    workers_mb: float


def samples(life: Life) -> Iterator[Sample]:
    """Yield one sample per second until the run has ended."""
    while not life.is_over:
        try:
            pids = [life.process.pid, *life.workers()]
            resident_mb = [_resident_mb(pid) for pid in pids]
            cpu_s = sum(map(_cpu_s, pids))
        except OSError:  # it has just ended
            break
        if life.done:
            workers_mb = max(resident_mb[1:], default=0.0)
            is_looking = life.done < life.total
            now_s = time.monotonic()
            yield Sample(life.done, is_looking, now_s, cpu_s, resident_mb[0], workers_mb)
        time.sleep(_TURN_S)


def _resident_mb(pid: int) -> float:
    pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * _MB_PER_PAGE


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return sum(map(int, fields[_CPU_FIELDS])) / _TICKS_PER_S


@dataclass(frozen=True, slots=True)
class Speed:
    """Frames per second of wall time and of CPU time."""

    per_s: float
    per_cpu_s: float


def speed_between(taken: Sequence[Sample], first: float, last: float) -> Speed:
    """Return the speed between two numbers of examined frames, from the nearest samples.

    Only samples before the end of the examination count: later, workers have ended, and their CPU
    time can no longer be read.
    """
    looking = [sample for sample in taken if sample.is_looking]
    begin, end = (
        min(looking, key=lambda sample: abs(sample.done - done)) for done in (first, last)
    )
    done = end.done - begin.done
    return Speed(done / (end.time_s - begin.time_s), done / (end.cpu_s - begin.cpu_s))


@click.command()
@click.option("--frames", type=click.IntRange(100), default=20_000, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=1, show_default=True)
def main(frames: int, jobs: int) -> None:
    """Print memory and speed, and exit with 1 if memory grows or the run becomes slower.

    Speed is judged by CPU time, which does not depend on other programs of the machine.
    """
    with tempfile.TemporaryDirectory() as folder:
        flight = Path(folder) / "flight"
        make_flight(flight, frames, jobs, absent_share=_ABSENT)
        life = Life(detecting(flight, Path(folder) / "out", jobs))
        taken = list(samples(life))
        if life.end() != 0:
            raise RuntimeError("".join(life.lines[-20:]))
    warm = [sample for sample in taken if sample.done >= _WARM_UP * frames]
    growth_mb, table_mb = (
        max(
            (
                sample.parent_mb - warm[0].parent_mb
                for sample in warm
                if sample.is_looking is looking
            ),
            default=0.0,
        )
        for looking in (True, False)
    )
    start, tenth = _WARM_UP * frames, _TENTH * (1.0 - _WARM_UP) * frames
    first = speed_between(taken, start, start + tenth)
    last = speed_between(taken, frames - tenth, frames)
    ratio = last.per_cpu_s / first.per_cpu_s
    print(
        f"{frames} frames on {jobs} processes in {taken[-1].time_s - taken[0].time_s:.0f} s;"
        f" parent {warm[0].parent_mb:.0f} MB after {_WARM_UP:.0%}, then at most"
        f" {growth_mb:+.1f} MB (limit: {_MOST_GROWTH_MB:.0f}), {table_mb:+.1f} MB with the table;"
        f" workers at most {max(sample.workers_mb for sample in taken):.0f} MB"
    )
    print(
        f"first tenth {first.per_cpu_s:.2f} frames per CPU second ({first.per_s:.2f} per second),"
        f" last tenth {last.per_cpu_s:.2f} ({last.per_s:.2f}): {ratio:.1%} of the first"
        f" (limit: {_LEAST_SPEED:.0%})"
    )
    sys.exit(growth_mb > _MOST_GROWTH_MB or ratio < _LEAST_SPEED)


if __name__ == "__main__":
    main()
