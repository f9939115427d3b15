"""`kgcp init`: a folder of frames in, a commented flight.toml out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.options import LocalPath, NumberRange, flight_argument, json_option

if TYPE_CHECKING:
    from kgcp.pipeline.init import FlightDraft

_WIDTH = 100


@click.command()
@flight_argument
@click.option(
    "--target",
    "targets_file",
    metavar="FILE",
    type=LocalPath(),
    help="Take the targets from this targets.toml of 'kgcp target', or from another flight.toml."
    "  [default: a targets.toml in FLIGHT]",
)
@click.option(
    "--diameter",
    "diameter_m",
    metavar="M",
    type=NumberRange(0.0, 100.0, min_open=True),
    help="Outer diameter of the targets that --code describes [m].",
)
@click.option(
    "--code",
    "codes",
    metavar="DEG,DEG,…",
    multiple=True,
    help="Describe a target by the directions of its dots; may be repeated.",
)
@click.option(
    "--lever-arm",
    "lever_arm_m",
    metavar="F R D",
    type=NumberRange(-1000.0, 1000.0),
    nargs=3,
    help="From the trajectory's point to the target's centre: forward, right, down [m].",
)
@click.option("--crs", metavar="CRS", help="CRS of the flight, for example EPSG:25832.")
@json_option
def command(
    flight: Path,
    targets_file: Path | None,
    diameter_m: float | None,
    codes: tuple[str, ...],
    lever_arm_m: tuple[float, float, float] | None,
    crs: str | None,
    *,
    as_json: bool,
) -> None:
    """Write a flight.toml from the files in the folder FLIGHT.

    Takes the camera from a calibration file, from DJI's DewarpData or, marked as a guess, from the
    focal length in EXIF; times from Timestamp.MRK, frames.csv, the frames' names or EXIF; the
    vehicle from the rover's file; targets from the targets.toml of 'kgcp target'; positions of
    static targets from a table of surveyed points. Prints what it found and where, and what is
    missing and what to do about it.

    Never replaces a flight.toml.

    \b
    Examples:
      kgcp init my_photos --lever-arm -0.8 0.15 -1.95
      kgcp init my_photos --diameter 0.9 --code 0,43,78,180 --crs EPSG:25832
    """  # noqa: D301 - \b is click's mark for lines that stay
    if targets_file is not None and (codes or diameter_m is not None):
        raise click.UsageError("--target excludes --diameter and --code; give one of them")
    if bool(codes) != (diameter_m is not None):
        raise click.UsageError("--diameter and --code describe a target together; give both")
    from kgcp.pipeline.init import draft_flight, write_draft
    from kgcp.pipeline.init_records import InitOptions

    options = InitOptions(targets_file, codes, diameter_m, lever_arm_m, crs)
    draft = draft_flight(flight, options)
    written = write_draft(draft, flight)
    if as_json:
        _print_json(draft, written)
    _print_page(draft, written)
    needs_edit = any(not gap.is_assumed for gap in draft.gaps)
    first = "fill in what is MISSING there, then " if needs_edit else ""
    click.echo(f"next: {first}kgcp check {quoted(flight)}", err=True)


def quoted(flight: Path) -> str:
    """Return a folder as it is typed, also where shells take & and brackets for their own."""
    text = str(flight)
    return text if re.fullmatch(r"[\w.:/\\~+-]+", text) else f'"{text}"'


def _print_json(draft: FlightDraft, written: list[Path]) -> None:
    import json
    from dataclasses import asdict

    page = {
        "found": [asdict(finding) for finding in draft.findings],
        "missing": [asdict(gap) for gap in draft.gaps],
        "files": [str(path) for path in written],
    }
    click.echo(json.dumps(page))


def _print_page(draft: FlightDraft, written: list[Path]) -> None:
    for finding in draft.findings:
        click.echo(_filled(finding.heading, finding.text), err=True)
    for gap in draft.gaps:
        word = "assumed" if gap.is_assumed else "missing"
        click.echo(_filled(f"{word}: {gap.heading}", gap.text), err=True)
        click.echo(_filled("", f"→ {gap.remedy}"), err=True)
    for path in written:
        click.echo(f"wrote {path}", err=True)


def _filled(heading: str, text: str) -> str:
    import textwrap

    from kgcp.errors import one_line

    return textwrap.fill(
        one_line(text), _WIDTH, initial_indent=f"{heading:22s}", subsequent_indent=" " * 22
    )
