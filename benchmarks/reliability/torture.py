"""Kill `kgcp detect` and its workers at random moments, and repeat it until it is complete.

The table must be, byte for byte, that of an undisturbed run. Linux only, because it finds the
workers in /proc.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import click

from kgcp.io.files.time_text import format_time
from kgcp.io.formats.frame_times import read_times
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.presets import preset

_BREAK_S = 1000.0
_EARLY_S = 2.0  # time in which a run starts
_PAUSE_S = 0.3  # longest time between a frame and a kill
_EARLY, _WORKER = 0.2, 0.5  # share of runs killed while they start; share that lose a worker
_ORPHAN_S = 20.0  # time after which no worker of a killed parent may be left


@dataclass(slots=True)
class Toll:
    """Number of kills, and of runs until the end."""

    parents: int = 0
    workers: int = 0
    runs: int = 0  # runs that ended by themselves

    @property
    def kills(self) -> int:
        """Number of all kills."""
        return self.parents + self.workers


def make_flight(
    folder: Path, frames: int, jobs: int, *, absent_share: float = 0.1, rendered: int = 100
) -> None:
    """Write a flight of small frames, some of which need the second pass.

    Frames after the first `rendered` ones are links to these; their times are later by a multiple
    of `_BREAK_S`.
    """
    far = preset("far")
    settings = replace(
        far,
        camera=replace(far.camera, width=400, height=300, cx=203.2, cy=147.1),
        frames=min(frames, rendered),
        distance_m=(60.0, 215.0),
        absent_share=absent_share,
        decoy_share=0.1,
    )
    write_simulated_flight(plan_flight(settings, 3), folder, jobs=jobs, on_frame=lambda: None)
    (folder / "reference.csv").unlink()  # it names only the rendered frames
    names = sorted(path.name for path in (folder / "frames").iterdir())
    times = read_times(folder / "frames.csv", names).time_s
    lines = ["frame,time"]
    for number in range(frames):
        name, turn = names[number % len(names)], number // len(names)
        path = folder / "frames" / f"pass_{turn:03d}" / name
        path.parent.mkdir(exist_ok=True)
        path.hardlink_to(folder / "frames" / name)
        lines.append(f"{path.parent.name}/{name},{format_time(times[name] + _BREAK_S * turn)}")
    for name in names:
        (folder / "frames" / name).unlink()
    (folder / "frames.csv").write_text("\n".join(lines), encoding="utf-8")


def detecting(flight: Path, out: Path, jobs: int) -> list[str]:
    """Return the arguments of kgcp to make a flight's table."""
    return ["detect", str(flight), "--out", str(out), "--jobs", str(jobs)]


class Life:
    """One process of kgcp, from its start to its end, by itself or by a kill."""

    def __init__(self, command: Sequence[str]) -> None:
        command = [sys.executable, "-m", "kgcp", *command, "--log-json"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.done = self.total = 0  # of all stages so far
        self._totals: dict[str, int] = {}
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def is_over(self) -> bool:
        """Whether the process has ended."""
        return self.process.poll() is not None

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            if line.startswith('{"event": "progress"'):
                event = json.loads(line)
                self._totals[event["stage"]] = event["total"]
                self.total = sum(self._totals.values())
                self.done = self.total - event["total"] + event["done"]

    def workers(self) -> list[int]:
        """Return the ids of its worker processes: children of its server, or its own."""
        children = children_of(self.process.pid)
        servers = [child for child in children if is_started_by(child, b"forkserver")]
        forked = [worker for server in servers for worker in children_of(server)]
        return forked + [child for child in children if is_started_by(child, b"spawn_main")]

    def wait_for(self, done: float, seconds: float) -> None:
        """Wait until a number of frames is done, then some seconds more, but not beyond the end."""
        while not self.is_over and self.done < done:
            time.sleep(0.05)
        until = time.monotonic() + seconds
        while not self.is_over and time.monotonic() < until:
            time.sleep(0.02)

    def end(self) -> int:
        """Wait for the end and return the exit code."""
        code = self.process.wait()
        self._reader.join(timeout=_ORPHAN_S)  # its workers hold the other end of the pipe
        assert not self._reader.is_alive(), "workers have outlived their parent"
        assert self.process.stderr is not None
        self.process.stderr.close()
        return code


def children_of(pid: int) -> list[int]:
    """Return the children of a process; /proc lists them by the thread that started them."""
    children: list[str] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the thread has just ended
            children += path.read_text(encoding="ascii").split()
    return [int(child) for child in children]


def is_started_by(pid: int, function: bytes) -> bool:
    """Tell whether a process runs this function of multiprocessing."""
    try:
        return function in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def live_and_die(life: Life, kills_left: int, rng: random.Random, toll: Toll) -> None:
    """Let a run work for some time, kill one of its workers perhaps, and then the run."""
    if rng.random() < _EARLY:
        life.wait_for(0, rng.uniform(0.0, _EARLY_S))
    else:
        life.wait_for(1, 0.0)
        share = rng.uniform(0.0, 2.0) / max(kills_left, 1)
        life.wait_for(life.done + share * (life.total - life.done), rng.uniform(0.0, _PAUSE_S))
        workers = life.workers()
        if workers and rng.random() < _WORKER:
            kill(rng.choice(workers))
            toll.workers += 1
            life.wait_for(0, rng.uniform(0.0, 2.0 * _EARLY_S))
    if not life.is_over:
        kill(life.process.pid)
        toll.parents += 1


def kill(pid: int) -> None:
    """Kill a process as the kernel does when memory is short."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def torture(command: Sequence[str], out: Path, kills: int, rng: random.Random) -> Toll:
    """Run, kill and resume until all kills are done and the last run has ended.

    Raises
    ------
    RuntimeError
        If a run fails without being killed.
    """
    toll = Toll()
    while True:
        life = Life(command)
        if toll.kills < kills:
            live_and_die(life, kills - toll.kills, rng, toll)
        code = life.end()
        if code == 0:
            toll.runs += 1
            if toll.kills >= kills:
                return toll
            shutil.rmtree(out)
        elif code != -signal.SIGKILL:
            raise RuntimeError(f"exit code {code}:\n{''.join(life.lines[-20:])}")


@click.command()
@click.option("--frames", type=click.IntRange(1), default=2000, show_default=True)
@click.option("--kills", type=click.IntRange(0), default=50, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
@click.option("--seed", type=int, default=1, show_default=True)
def main(frames: int, kills: int, jobs: int | None, seed: int) -> None:
    """Print the toll, and exit with 1 if the tables differ."""
    jobs = jobs or usable_cores()
    with tempfile.TemporaryDirectory() as folder:
        flight, out, tortured = (Path(folder) / name for name in ("flight", "out", "tortured"))
        make_flight(flight, frames, jobs)
        start_s = time.perf_counter()
        life = Life(detecting(flight, out, jobs))
        if life.end() != 0:
            raise RuntimeError("".join(life.lines[-20:]))
        undisturbed_s = time.perf_counter() - start_s
        record = json.loads((out / "run.json").read_text(encoding="utf-8"))
        start_s = time.perf_counter()
        rng = random.Random(seed)  # noqa: S311 - no secret
        toll = torture(detecting(flight, tortured, jobs), tortured, kills, rng)
        tortured_s = time.perf_counter() - start_s
        tables = [(each / "detections.parquet").read_bytes() for each in (out, tortured)]
    journal_s = record["stages_s"]["journal, within these"]
    print(
        f"{frames} frames on {jobs} processes: {undisturbed_s:.0f} s, of which the journal took"
        f" {journal_s:.1f} s ({100.0 * journal_s / undisturbed_s:.2f} %)"
    )
    print(
        f"killed the run {toll.parents} times and a worker {toll.workers} times: done after"
        f" {tortured_s:.0f} s (complete runs: {toll.runs})"
    )
    print("tables: byte-identical" if tables[0] == tables[1] else "tables: DIFFER")
    sys.exit(tables[0] != tables[1])


if __name__ == "__main__":
    main()
