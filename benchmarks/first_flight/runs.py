"""Four first flights, from bare files to exports: commands, their output, and edited lines.

    python -m benchmarks.first_flight.runs

This prints the transcripts of docs/first_flight_runs.md; `--write` writes that page anew. A run may
have at most five commands and ten edited lines.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from click.testing import CliRunner

from benchmarks.first_flight.bare_folders import (
    STATIC_MAP,
    Render,
    plan,
    rendered,
    rendered_static,
    write_dji_folder,
    write_sbet_folder,
    write_static_folder,
)
from kgcp.cli import main as kgcp

MOST_COMMANDS, MOST_LINES = 5, 10
PAGE = Path(__file__).resolve().parents[2] / "docs" / "first_flight_runs.md"
FRAMES = 4
_TARGET = "--diameter 0.9 --code 0,43,78,180"
_LEVER_ARM = "--lever-arm -0.8 0.15 -1.95"
_SPEED = re.compile(r"in [\d.]+ s \([\d.]+/s\)")
_HEAD = """# Recorded first flights

Four simulated first flights, from the bare files of card and rover to points, as
`python -m benchmarks.first_flight.runs --write` records them: every command with its output, and
every line that was edited. [The first flight](first_flight.md) explains the steps. Frames are
rendered; the files beside them have the formats of DJI, RTKLIB, POSPac and OpenCV.
"""


@dataclass(frozen=True, slots=True)
class Edit:
    """Lines of a flight.toml that the user fills in; the draft has their keys in comments."""

    file: str
    lines: Mapping[str, str]  # key → value as TOML


@dataclass(frozen=True, slots=True)
class FirstFlight:
    """One first flight, as a recipe."""

    title: str
    about: str
    make: Callable[[Path], None]  # writes the bare files into the current folder
    steps: tuple[str | Edit, ...]
    results: tuple[str, ...]  # files that must exist at the end
    points: Mapping[str, int]  # table → expected number of points


@dataclass(frozen=True, slots=True)
class Transcript:
    """Transcript of a run: commands, edits and output."""

    text: str
    commands: int
    edited: int


def first_flights(
    moving: Render = rendered, static: Render = rendered_static
) -> Iterator[FirstFlight]:
    """Yield the four flights; the functions render frames with moving and static targets."""
    yield FirstFlight(
        "DJI drone with Timestamp.MRK, rover with RTKLIB",
        "The card's folder with `rover.pos` copied into it. The frames have DewarpData.",
        lambda folder: write_dji_folder(folder / "flight", plan(FRAMES, 1), render=moving),
        (
            f"kgcp init flight {_TARGET} {_LEVER_ARM}",
            Edit("flight/flight.toml", {"sd_lever_arm_m": "[0.005, 0.005, 0.005]"}),
            "kgcp check flight",
            "kgcp detect flight",
            "kgcp export-gcp flight --format metashape --format odm",
        ),
        ("flight/kgcp/odm/gcp_list.txt", "flight/kgcp/metashape/markers.csv"),
        {"flight/kgcp/kgcps.parquet": FRAMES},
    )
    yield FirstFlight(
        "Machine-vision camera with SBET",
        "Frames named by Unix time, OpenCV's calibration, POSPac's SBET and smrmsg.",
        lambda folder: write_sbet_folder(folder / "flight", plan(FRAMES, 2), moving),
        (
            f"kgcp init flight {_TARGET} {_LEVER_ARM} --crs EPSG:25832",
            Edit("flight/flight.toml", {"response": '"linear"', "sd_time_s": "0.001"}),
            "kgcp check flight",
            "kgcp detect flight",
            "kgcp export-gcp flight --format pix4d --format csv",
        ),
        ("flight/kgcp/pix4d/marks.csv", "flight/kgcp/kgcps.csv"),
        {"flight/kgcp/kgcps.parquet": FRAMES},
    )
    yield FirstFlight(
        "Static target, consumer drone, EXIF only",
        "Photos and no more: no times, no calibration, no trajectory.",
        lambda folder: write_static_folder(folder / "flight", plan(FRAMES, 3), static),
        (
            f"kgcp init flight {_TARGET}",
            Edit(
                "flight/flight.toml",
                {
                    "crs": '"EPSG:25832"',
                    "position_m": str(STATIC_MAP.tolist()),
                    "sd_position_m": "[0.01, 0.01, 0.015]",
                },
            ),
            "kgcp check flight",
            "kgcp detect flight",
            "kgcp export-gcp flight --format odm",
        ),
        ("flight/kgcp/odm/gcp_list.txt",),
        {"flight/kgcp/kgcps.parquet": FRAMES},
    )
    yield FirstFlight(
        "Two flights, one block",
        "Two folders of a DJI drone, each with its own `rover.pos`.",
        lambda folder: _write_two(folder, moving),
        (
            f"kgcp init north {_TARGET} {_LEVER_ARM}",
            f"kgcp init south {_TARGET} {_LEVER_ARM}",
            "kgcp detect north",
            "kgcp detect south",
            "kgcp export-gcp north south --out block --format metashape --format odm",
        ),
        ("block/metashape/markers.csv", "block/odm/gcp_list.txt"),
        {"block/kgcps.parquet": FRAMES},
    )


def _write_two(folder: Path, render: Render) -> None:
    half = FRAMES // 2
    write_dji_folder(folder / "north", plan(half, 4), render=render)
    write_dji_folder(folder / "south", plan(half, 5), first_number=half + 1, render=render)


def run(flight: FirstFlight, folder: Path) -> Transcript:
    """Run a first flight in an empty folder, and return its transcript.

    Raises
    ------
    AssertionError
        If a command fails, a result is missing, or there are too many commands or edited lines.
    """
    flight.make(folder)
    parts, commands, edited = [], 0, 0
    for step in flight.steps:
        if isinstance(step, Edit):
            edited += len(step.lines)
            parts.append(_edit(folder, step))
        else:
            commands += 1
            parts.append(_typed(folder, step))
    for name in flight.results:
        assert (folder / name).stat().st_size > 0, name
    for table, count in flight.points.items():
        assert len(pd.read_parquet(folder / table)) == count, table
    assert commands <= MOST_COMMANDS
    assert edited <= MOST_LINES
    return Transcript("\n".join(parts), commands, edited)


def _edit(folder: Path, edit: Edit) -> str:
    path = folder / edit.file
    lines = path.read_text(encoding="utf-8").splitlines()
    for key, value in edit.lines.items():
        (row,) = [row for row, line in enumerate(lines) if line.startswith(f"# {key} = ")]
        lines[row] = f"{key} = {value}"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    shown = "\n".join(f"    {key} = {value}" for key, value in edit.lines.items())
    return f"Edited in `{edit.file}`:\n\n{shown}\n"


def _typed(folder: Path, command: str) -> str:
    """Run a command as if in the folder, in this process."""
    name, *arguments = shlex.split(command)[1:]
    words = [str(folder / word) if _is_place(word, folder) else word for word in arguments]
    jobs = ["--jobs", "0", "--log-json"] if name == "detect" else []
    result = CliRunner().invoke(kgcp, [name, *words, *jobs], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    output = result.stdout + (_counts(result.stderr) if jobs else result.stderr)
    shown = _SPEED.sub("in … s", output.replace(f"{folder}{os.sep}", ""))
    return f"    $ {command}\n" + "".join(f"    {line}\n" for line in shown.splitlines())


def _is_place(word: str, folder: Path) -> bool:
    return word in {"flight", "north", "south", "block"} or (folder / word).is_dir()


def _counts(log: str) -> str:
    """Return the summary of a run without progress, as people see it."""
    events = [json.loads(line) for line in log.splitlines()]
    (summary,) = [event for event in events if event["event"] == "summary"]
    doubts = [
        f"kgcp: doubt: {e['sentence']}; {e['remedy']}\n" for e in events if e["event"] == "doubt"
    ]
    counts = ", ".join(
        f"{count} {word.replace('_', ' ')}" for word, count in summary["status"].items()
    )
    return "".join(doubts) + f"{summary['frames']} frames: {counts}\nwrote {summary['table']}\n"


def page_of(transcripts: Mapping[str, tuple[str, Transcript]]) -> str:
    """Return the page of all runs."""
    parts = [_HEAD]
    for title, (about, each) in transcripts.items():
        took = f"{each.commands} commands, edited lines: {each.edited}."
        parts.append(f"## {title}\n\n{about} {took}\n\n{each.text}")
    return "\n".join(parts)


def main() -> None:
    """Run all flights and print their transcripts, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write docs/first_flight_runs.md anew")
    arguments = parser.parse_args()
    transcripts = {}
    for flight in first_flights():
        with tempfile.TemporaryDirectory() as folder:
            transcripts[flight.title] = (flight.about, run(flight, Path(folder)))
    page = page_of(transcripts)
    if arguments.write:
        PAGE.write_text(page, encoding="utf-8")
    else:
        sys.stdout.write(page)


if __name__ == "__main__":
    main()
