"""Wall and CPU time of `kgcp detect` on a short flight, by stages, and of a first run.

Usage: python -m benchmarks.speed.start_up [--repeats 5] [--cold] [--keep DIR]

Two flights of 20 frames of 4 Mpx are simulated: `clean` (linear PNG) and `consumer` (JPEG with an
unknown tone curve). The shortest of several runs counts, since other work of the machine only adds
time. CPU time is that of all processes. In these runs, Python writes and reads compiled modules as
it does where kgcp is installed, even if the environment of the benchmark forbids it. Linux only.
"""

from __future__ import annotations

import ctypes
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import click

_FRAMES, _MEGAPIXELS = 20, 4.0
_PRESETS = ("clean", "consumer")
_SUBREAPER = 36  # option of prctl: orphaned processes become children of this process
_STAGE = re.compile(r"^ *([0-9.]+) s  (.+)$", re.MULTILINE)
_PARTS = {  # what is timed → program
    "Python alone": "pass",
    "what a worker imports": "import kgcp.pipeline.frame_task",
    "the same, with its compiled code": (
        "import kgcp.pipeline.frame_task, kgcp.pipeline.execution.ready_worker"
    ),
    "what the program imports": "import kgcp.pipeline.check, kgcp.pipeline.detect",
}


@dataclass(frozen=True, slots=True)
class Run:
    """Wall time and CPU time of a program with all its processes [s], and its stderr."""

    wall_s: float
    cpu_s: float
    text: str


def run(program: list[str], environment: Mapping[str, str] | None = None) -> Run:
    """Run a program until it and all its processes have ended."""
    begin_s, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    names = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    # to a file: a pipe stays open until the last process ends, some 0.1 s after the program
    with tempfile.TemporaryFile("w+") as messages:
        subprocess.run(program, env={**names, **(environment or {})}, stderr=messages, check=True)
        wall_s = time.perf_counter() - begin_s
        messages.seek(0)
        text = messages.read()
    while True:
        try:
            os.wait()
        except ChildProcessError:
            break
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Run(wall_s, cpu_s, text)


def detecting(flight: Path, *options: str) -> list[str]:
    """Return the command that detects in all frames of a flight, without resuming."""
    out = str(flight.parent / f"results_{flight.name}")
    program = [sys.executable, "-m", "kgcp", "detect", str(flight), "--out", out]
    return [*program, "--restart", "--quiet", *options]


def make_flight(folder: Path, name: str) -> None:
    """Simulate a flight of a preset, with more pixels."""
    from kgcp.pipeline.simulate import write_simulated_flight
    from kgcp.simulation.flight import plan_flight
    from kgcp.simulation.presets import preset

    settings = preset(name)
    camera = settings.camera
    scale = (1e6 * _MEGAPIXELS / (camera.width * camera.height)) ** 0.5
    larger = replace(
        camera,
        width=round(scale * camera.width),
        height=round(scale * camera.height),
        **{key: scale * getattr(camera, key) for key in ("fx", "fy", "cx", "cy")},
    )
    plan = plan_flight(replace(settings, camera=larger, frames=_FRAMES), 1)
    # jobs 0: a server of worker processes would never end, and `run` would wait for it
    write_simulated_flight(plan, folder, jobs=0, on_frame=lambda: None)


def print_runs(flight: Path, repeats: int) -> None:
    """Print the shortest run on a flight, and the stages of the shortest run with --profile."""
    run(detecting(flight))  # compiles
    best = min((run(detecting(flight)) for _ in range(repeats)), key=lambda each: each.wall_s)
    alone = min(
        (run(detecting(flight, "--jobs", "1")) for _ in range(repeats)),
        key=lambda each: each.wall_s,
    )
    print(
        f"{flight.name}, {_FRAMES} frames of {_MEGAPIXELS:g} Mpx: {best.wall_s:.2f} s,"
        f" {best.cpu_s:.2f} s of CPU; with one job {alone.wall_s:.2f} s,"
        f" {alone.cpu_s:.2f} s of CPU",
        flush=True,
    )
    profiled = min(
        (run(detecting(flight, "--profile")) for _ in range(repeats)), key=lambda each: each.wall_s
    )
    stages = [(float(seconds), name) for seconds, name in _STAGE.findall(profiled.text)]
    own = [each for each in stages if not each[1].startswith("workers: ")]
    whole_s = sum(s for s, name in own if name not in {"in all", "journal, within these"})
    print(
        f"  with --profile {profiled.wall_s:.2f} s, {whole_s / profiled.wall_s:.0%} in its stages:"
    )
    for seconds, name in stages:
        if seconds >= 0.01 * profiled.wall_s:
            print(f"  {seconds:8.2f} s  {name}")


def print_parts(repeats: int) -> None:
    """Print wall and CPU time of starting the processes of a run."""
    for name, program in _PARTS.items():
        parts = [run([sys.executable, "-c", program]) for _ in range(repeats)]
        wall_s, cpu_s = (min(getattr(part, key) for part in parts) for key in ("wall_s", "cpu_s"))
        print(f"{name}: {wall_s:.2f} s, {cpu_s:.2f} s of CPU", flush=True)


def print_cold_start(flight: Path, folder: Path) -> None:
    """Print wall and CPU time of a first run, which compiles, with one job and with two."""
    for jobs in ("1", "2"):
        cache = {"NUMBA_CACHE_DIR": str(folder / f"cache_{jobs}")}
        first = run(detecting(flight, "--jobs", jobs), cache)
        print(
            f"first run, {jobs} jobs, all code to be compiled: {first.wall_s:.0f} s,"
            f" {first.cpu_s:.0f} s of CPU",
            flush=True,
        )


@click.command()
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True)
@click.option(
    "--cold", "is_cold", is_flag=True, help="Also time a first run, which compiles: takes minutes."
)
@click.option(
    "--keep", type=click.Path(path_type=Path), help="Folder in which to keep the flights."
)
def main(repeats: int, *, is_cold: bool, keep: Path | None) -> None:
    """Print the tables."""
    ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)
    with tempfile.TemporaryDirectory(prefix="kgcp_start_") as folder:
        work = keep or Path(folder)
        for name in _PRESETS:
            if not (work / name / "flight.toml").exists():
                make_flight(work / name, name)
        print_parts(repeats)
        for name in _PRESETS:
            print_runs(work / name, repeats)
        if is_cold:
            print_cold_start(work / _PRESETS[-1], Path(folder))


if __name__ == "__main__":
    main()
