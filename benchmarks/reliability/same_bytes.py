"""Process one small flight under many circumstances, and compare the results byte by byte.

The first table is for one machine with one set of packages. It varies the numbers of threads and of
jobs, the order in which code is compiled, and whether it comes from the cache. All results must be
the same bytes. The second table makes the libraries choose kernels as on other processors; it
states the largest difference of a measurement in units of its reported standard deviation.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
import pandas as pd

from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.presets import preset

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_CORE_TYPES = {"Haswell": "avx2", "Zen": "avx2", "SkylakeX": "avx512f", "Nehalem": "sse4_2"}
_LIBRARY_CALL = """\
import sys
import numpy
from pathlib import Path
square = numpy.ones((600, 600))
square @ square  # the library has its threads before kgcp is there
from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.detect import RunOptions, detect_flight
if __name__ == "__main__":
    flight, out, jobs = sys.argv[1:]
    detect_flight(read_flight(Path(flight)), out=Path(out), options=RunOptions(jobs=int(jobs)))
"""
_COMPILE_FIRST = """\
import sys
from kgcp.settings import DetectSettings, Method
from kgcp.io.flight.flight import read_flight
from kgcp.io.images.frames import read_grey
from kgcp.measurement.frame import examine
from pathlib import Path
flight = read_flight(Path(sys.argv[1]))
paths = sorted(flight.frames_folder.rglob("*.*"), reverse=True)
for method in (Method.PAPER, Method.MODEL):
    for path in paths:
        examine(read_grey(path, flight.camera), flight.camera, flight.targets,
                DetectSettings(method=method))
"""


def make_flight(folder: Path, frames: int) -> None:
    """Write a flight of small consumer frames, some of which need the second pass."""
    consumer = preset("consumer")
    settings = replace(
        consumer,
        camera=replace(consumer.camera, width=800, height=600, cx=403.2, cy=297.1),
        frames=frames,
        distance_m=(15.0, 150.0),
    )
    write_simulated_flight(plan_flight(settings, 3), folder, jobs=1, on_frame=lambda: None)


@dataclass(frozen=True, slots=True)
class Circumstances:
    """Circumstances under which a flight is processed.

    Attributes
    ----------
    environment : mapping of str
        Variables in addition to those of this process.
    has_cluster : bool
        Whether a Dask cluster of two workers on this machine is used instead of jobs.
    is_library_call : bool
        Whether the detections are made by a program that has used numpy before.
    compiles_in_other_order : bool
        Whether, starting with an empty cache, the frames are first measured in the opposite order
        and with the other method first.
    """

    name: str
    jobs: int
    environment: Mapping[str, str]
    has_cluster: bool = False
    is_library_call: bool = False
    compiles_in_other_order: bool = False


def one_machine(cache: Path) -> Iterator[Circumstances]:
    """Yield circumstances that must not change any byte; the first is the reference."""
    for threads in ("1", "4"):
        environment = dict.fromkeys(_THREADS, threads)
        for jobs in (0, 1, 2):
            yield Circumstances(f"{threads} threads, {jobs} jobs", jobs, environment)
            yield Circumstances(
                f"{threads} threads, {jobs} jobs, library", jobs, environment, is_library_call=True
            )
        yield Circumstances(f"{threads} threads, Dask", 2, environment, has_cluster=True)
    for jobs in (0, 2):
        cold = {"NUMBA_CACHE_DIR": str(cache / f"cold{jobs}")}
        yield Circumstances(f"compiled anew, {jobs} jobs", jobs, cold)
        yield Circumstances(f"from that cache, {2 - jobs} jobs", 2 - jobs, cold)
    other = {"NUMBA_CACHE_DIR": str(cache / "other")}
    yield Circumstances("compiled in another order", 0, other, compiles_in_other_order=True)


def other_processors(cache: Path) -> Iterator[Circumstances]:
    """Yield circumstances as on other processors; the first is that of this processor."""
    for core, flag in _CORE_TYPES.items():
        if flag in processor_flags():
            yield Circumstances(f"OPENBLAS_CORETYPE={core}", 0, {"OPENBLAS_CORETYPE": core})
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(cache / "generic")}
    for jobs in (0, 2):
        yield Circumstances(f"NUMBA_CPU_NAME=generic, {jobs} jobs", jobs, generic)
    both = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3", **generic}
    yield Circumstances("generic, Nehalem, numpy without AVX2", 0, both)


def processor_flags() -> set[str]:
    """Return the processor's flags as the kernel lists them; empty if this is not Linux."""
    if not Path("/proc/cpuinfo").exists():
        return set()
    for line in Path("/proc/cpuinfo").read_text(encoding="ascii").splitlines():
        if line.startswith("flags"):
            return set(line.partition(":")[2].split())
    return set()


def process(
    flight: Path, out: Path, circumstances: Circumstances, *, only_detects: bool = False
) -> dict[str, str]:
    """Detect, export and report; return the hashes of all files that were written."""
    environment = {**os.environ, **circumstances.environment}

    def call(*command: str) -> None:
        done = subprocess.run(
            [sys.executable, *command], env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"{circumstances.name}: {done.stderr}")

    place, jobs = str(flight), str(circumstances.jobs)
    if circumstances.compiles_in_other_order:
        call("-c", _COMPILE_FIRST, place)
    if circumstances.is_library_call:
        script = out.with_suffix(".py")
        script.write_text(_LIBRARY_CALL, encoding="utf-8")
        call(str(script), place, str(out), jobs)
    else:
        workers = ("--scheduler", "local:2") if circumstances.has_cluster else ("--jobs", jobs)
        call("-m", "kgcp", "detect", place, "--out", str(out), *workers, "--quiet")
    for command in () if only_detects else (("export-gcp", "--format", "all"), ("bias-report",)):
        call("-m", "kgcp", *command, place, "--out", str(out))
    return file_hashes(out)


def file_hashes(out: Path) -> dict[str, str]:
    """Return the hashes of all files of a run, but of run.json, which says how long it took."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "run.json"
    }


def largest_difference(one: Path, other: Path) -> float:
    """Return the largest difference of a distance, centre or angle over its standard deviation."""
    tables = [
        pd.read_parquet(out / "detections.parquet").set_index(["frame", "target", "instance"])
        for out in (one, other)
    ]
    if not tables[0]["status"].equals(tables[1]["status"]):
        return np.inf
    largest = 0.0
    for value, sd in (
        ("distance_m", "sd_distance_m"),
        ("x_px", "sd_x_px"),
        ("y_px", "sd_y_px"),
        ("roll_deg", "sd_roll_deg"),
        ("pitch_deg", "sd_pitch_deg"),
        ("heading_deg", "sd_heading_deg"),
    ):
        ratio = (tables[0][value] - tables[1][value]).abs() / tables[0][sd]
        largest = max(largest, float(ratio.max()))
    return largest


def compare(flight: Path, place: Path, sets: Iterator[Circumstances]) -> int:
    """Print a line for each circumstance; return how many of them wrote other bytes."""
    reference: dict[str, str] = {}
    first, others = place, 0
    for number, circumstances in enumerate(sets):
        out = place / f"{number:02d}"
        hashes = process(flight, out, circumstances)
        if not reference:
            reference, first = hashes, out
        if reference == hashes:
            verdict = f"{len(hashes)} files, the same bytes"
        else:
            others += 1
            names = reference.keys() | hashes.keys()
            changed = sum(reference.get(name) != hashes.get(name) for name in names)
            sigmas = largest_difference(first, out)
            verdict = f"{changed} of {len(names)} files differ, measurements by {sigmas:.1e} sigma"
        click.echo(f"{circumstances.name:38s} {verdict}")
    return others


@click.command()
@click.option("--frames", default=12, show_default=True, type=click.IntRange(6))
@click.option("--processors/--no-processors", "has_processors", default=True, show_default=True)
def main(frames: int, *, has_processors: bool) -> None:
    """Process a simulated flight repeatedly; exit with 1 if bytes differ on one machine."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        flight = place / "flight"
        make_flight(flight, frames)
        differing = compare(flight, place / "machine", one_machine(place / "cache"))
        if has_processors:
            click.echo()
            compare(flight, place / "processors", other_processors(place / "cache"))
    if differing:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
