"""`kgcp export-gcp`: detections and trajectory in, KGCPs out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kgcp.cli.doubts import print_doubts
from kgcp.cli.options import (
    NumberRange,
    detections_option,
    exclude_option,
    flight_places_argument,
    json_option,
    out_place_option,
    quiet_option,
    selection_options,
)
from kgcp.io.exporters.formats import DEFAULT_FORMATS, FORMATS

if TYPE_CHECKING:
    from kgcp.georef.gcp import Gcp
    from kgcp.georef.selection import Selection
    from kgcp.io.flight.flight import Flight
    from kgcp.io.formats.exclusions import Exclusion
    from kgcp.io.images.remote import StoredFolder
    from kgcp.pipeline.export import GcpSet
    from kgcp.pipeline.merge import MergedGcps
    from kgcp.quality.consistency import Consistency

ALL = "all"
MAX_LISTED_FILES = 12  # in one folder; more are counted
WITH_EXTENSION, WITHOUT_EXTENSION = "with-extension", "without-extension"


def _list_formats(context: click.Context, _: click.Parameter, asked: bool) -> None:  # noqa: FBT001 - click's signature
    if not asked or context.resilient_parsing:
        return
    for name, form in FORMATS.items():
        click.echo(f"{name:14s} {form.description}")
        for file in form.files:
            click.echo(f"{'':16s} {file}")
    context.exit()


@click.command()
@flight_places_argument
@out_place_option
@click.option(
    "--format",
    "formats",
    type=click.Choice([*FORMATS, ALL]),
    multiple=True,
    help="Format to write besides kgcps.parquet; may be repeated; 'all' skips formats that cannot"
    f" hold these points.  [default: {', '.join(DEFAULT_FORMATS)}]",
)
@click.option(
    "--list-formats",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_formats,
    help="Print the formats and their files.",
)
@click.option(
    "--crs",
    metavar="CRS",
    help="CRS of the points, for example EPSG:25832.  [default: the flight's]",
)
@click.option(
    "--mark-floor-px",
    metavar="PX",
    type=NumberRange(0.0, 100.0),
    default=0.1,
    show_default=True,
    help="Least standard deviation of an image point in the files of other programs [px].",
)
@click.option(
    "--image-names",
    type=click.Choice([WITH_EXTENSION, WITHOUT_EXTENSION]),
    default=WITH_EXTENSION,
    show_default=True,
    help="Names of images for metashape and realityscan, whose projects may lack the extension.",
)
@exclude_option
@click.option(
    "--flight-ids",
    is_flag=True,
    help="Begin the points' ids with the flight's name, so that a project can take several exports;"
    " always done if several flights are exported at once.",
)
@selection_options
@detections_option
@quiet_option
@json_option
def command(
    flights: tuple[Path | StoredFolder, ...],
    out: Path | StoredFolder | None,
    detections: Path | None,
    *,
    crs: str | None,
    exclude_files: tuple[Path, ...],
    flight_ids: bool,
    is_quiet: bool,
    as_json: bool,
    **options: Any,  # noqa: ANN401 - of the files, and the fields of a Selection
) -> None:
    """Compute ground control points from the measurements.

    Interpolates the vehicle's trajectory at every frame's time, adds the lever arm, and writes
    the kinematic ground control points to FLIGHT/kgcp: kgcps.parquet, kgcps.csv and OpenDroneMap's
    odm/gcp_list.txt. Run 'kgcp detect' first. flight.toml needs a crs and either a [vehicle] or
    targets with position_m. With reference poses, the summary reports how well they agree with the
    vehicle and what to correct.

    Several flights become one set of points, whose ids begin with the flights' names, in the folder
    of --out.

    \b
    Examples:
      kgcp export-gcp sample_flight --format odm
      kgcp export-gcp north south --out block --format metashape
    """  # noqa: D301 - \b is click's mark for lines that stay
    from kgcp.georef.selection import Selection
    from kgcp.io.formats.exclusions import read_exclusions

    files = FileOptions(
        formats=options.pop("formats"),
        mark_floor_px=options.pop("mark_floor_px"),
        image_names=options.pop("image_names"),
    )
    exclusions = tuple(line for file in exclude_files for line in read_exclusions(file))
    choice = PointChoice(Selection(**options), exclusions, crs)
    if len(flights) > 1:
        if out is None:
            raise click.UsageError("several flights need a folder for their points: give --out")
        if detections is not None:
            raise click.UsageError("--detections applies to one flight only; leave it out")
        _export_several(flights, out, choice, files, is_quiet=is_quiet, as_json=as_json)
    else:
        _export_one(
            flights[0],
            out,
            detections,
            choice,
            files,
            flight_ids=flight_ids,
            is_quiet=is_quiet,
            as_json=as_json,
        )


@dataclass(frozen=True, slots=True)
class PointChoice:
    """Which points are wanted."""

    selection: Selection  # without `excluded`
    exclusions: tuple[Exclusion, ...]
    crs: str | None


@dataclass(frozen=True, slots=True)
class FileOptions:
    """Which files are wanted, and their options."""

    formats: tuple[str, ...]
    mark_floor_px: float
    image_names: str

    @property
    def details(self) -> dict[str, Any]:
        """Arguments of the functions that write files."""
        return {
            "mark_floor_px": self.mark_floor_px,
            "image_extensions": self.image_names == WITH_EXTENSION,
        }


def _export_one(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    detections: Path | None,
    choice: PointChoice,
    files: FileOptions,
    *,
    flight_ids: bool,
    is_quiet: bool,
    as_json: bool,
) -> None:
    from dataclasses import replace

    from kgcp.georef.gcp import with_flight_name
    from kgcp.io.exporters.write import not_renewed
    from kgcp.io.files.locks import sole_writer
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.export import export_gcps, write_gcps
    from kgcp.pipeline.workspace import DETECTIONS, open_workspace

    with open_workspace(flight, out, (DETECTIONS,)) as workspace:
        the_flight = read_flight(workspace.flight)
        (made,) = _made([(the_flight, workspace.detections(detections))], choice)
        if flight_ids:
            made = replace(made, gcps=with_flight_name(made.gcps, the_flight.name))
        with sole_writer(workspace.out, "export-gcp"):
            written = write_gcps(made, workspace.out)
            more, left_out = _export(
                files.formats,
                lambda name: export_gcps(made, (name,), workspace.out, **files.details),
            )
            written += more
            older = not_renewed(workspace.out, written)
    about_files = (written, left_out, older)
    if as_json:
        _print_json([made], made, about_files, workspace.named)
    _report([made], made, about_files, workspace.named, is_quiet=is_quiet)


def _export_several(
    flights: tuple[Path | StoredFolder, ...],
    out: Path | StoredFolder,
    choice: PointChoice,
    files: FileOptions,
    *,
    is_quiet: bool,
    as_json: bool,
) -> None:
    from kgcp.errors import KgcpError
    from kgcp.io.exporters.write import not_renewed
    from kgcp.io.files.locks import sole_writer
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.merge import export_merged, merge_gcps, write_merged
    from kgcp.pipeline.workspace import DETECTIONS, results_folder

    if not isinstance(out, Path):
        raise KgcpError(f"{out}: only for one flight; write the points of several to a local disk")
    read = []
    for flight in flights:
        if not isinstance(flight, Path):
            raise KgcpError(
                f"{flight}: several flights can be merged on a local disk only; copy them there"
            )
        read.append((read_flight(flight), results_folder(flight) / DETECTIONS))
    merged = merge_gcps(_made(read, choice))
    with sole_writer(out, "export-gcp"):
        written = write_merged(merged, out)
        more, left_out = _export(
            files.formats, lambda name: export_merged(merged, (name,), folder=out, **files.details)
        )
        written += more
        older = not_renewed(out, written)
    about_files = (written, left_out, older)
    if as_json:
        _print_json(merged.parts, merged, about_files, str)
    _report(merged.parts, merged, about_files, str, is_quiet=is_quiet)


def _made(flights: Sequence[tuple[Flight, Path]], choice: PointChoice) -> list[GcpSet]:
    """Make the points of flights, each with the table of its detections."""
    from dataclasses import replace

    from kgcp.pipeline.exclude import excluded_rows, rows_of
    from kgcp.pipeline.export import make_gcps

    rows = {flight.name: rows_of(table) for flight, table in flights} if choice.exclusions else {}
    excluded = excluded_rows(choice.exclusions, rows)
    return [
        make_gcps(
            flight,
            table,
            selection=replace(choice.selection, excluded=excluded.get(flight.name, ())),
            crs=choice.crs,
        )
        for flight, table in flights
    ]


def _export(
    formats: tuple[str, ...], write: Callable[[str], list[Path]]
) -> tuple[list[Path], dict[str, str]]:
    """Write the named formats; of the default ones or with `all`, those that can hold the points.

    Returns the paths, and by format why it was left out.
    """
    from kgcp.errors import KgcpError

    written, left_out = [], {}
    for name in FORMATS if ALL in formats else dict.fromkeys(formats or DEFAULT_FORMATS):
        try:
            written += write(name)
        except KgcpError as error:
            is_file_error = isinstance(error.__cause__, OSError)  # such as a full disk
            if name in formats or is_file_error:
                raise
            left_out[name] = str(error)
    return written, left_out


def _report(
    parts: Sequence[GcpSet],
    whole: GcpSet | MergedGcps,
    files: tuple[list[Path], dict[str, str], tuple[str, ...]],
    named: Callable[[object], str],
    *,
    is_quiet: bool,
) -> None:
    """Report points, flights and files: those written, why some were not, and older ones.

    Parameters
    ----------
    is_quiet : bool
        Report grave doubts only.
    """
    written, left_out, older = files
    if is_quiet:
        for part in parts:
            print_doubts(part.doubts, is_quiet=True)
        return
    for part in parts:
        click.echo(f"{_heading(part, parts)}{_counted(part)}", err=True)
        _report_part(part)
    if len(parts) > 1:
        click.echo(f"all {len(parts)} flights: {_counted(whole)}", err=True)
    for path in _named(written):
        click.echo(f"wrote {named(path)}", err=True)
    for name, reason in left_out.items():
        click.echo(f"left out {name}: {reason.removeprefix(f'{name}: ')}", err=True)
    if older:
        click.echo(f"not updated, from an earlier export: {', '.join(older)}", err=True)


def _print_json(
    parts: Sequence[GcpSet],
    whole: GcpSet | MergedGcps,
    files: tuple[list[Path], dict[str, str], tuple[str, ...]],
    named: Callable[[object], str],
) -> None:
    import json

    from kgcp.quality.advice import advice

    written, left_out, older = files
    summary = {
        "kgcps": len(whole.gcps),
        "checkpoints": sum(point.is_checkpoint for point in whole.gcps),
        "skipped": dict(_reasons(whole)),
        "advice": [
            f"{_heading(part, parts)}{line}"
            for part in parts
            if part.consistency is not None
            for line in advice(part.consistency, part.doubts)
        ],
        "doubts": [
            {**doubt.summary(), "flight": part.flight.name}
            for part in parts
            for doubt in part.doubts
        ],
        "files": [*map(named, written)],
        "left_out": left_out,
        "not_renewed": older,
    }
    click.echo(json.dumps(summary))


def _heading(part: GcpSet, parts: Sequence[GcpSet]) -> str:
    """Return the flight's name before what is said about one of several flights."""
    return f"{part.flight.name}: " if len(parts) > 1 else ""


def _reasons(points: GcpSet | MergedGcps) -> Counter[str]:
    return Counter(skipped.reason.value for skipped in points.skipped)


def _counted(points: GcpSet | MergedGcps) -> str:
    from kgcp.quality.number_text import counted

    checks = sum(point.is_checkpoint for point in points.gcps)
    of_these = f" ({counted(checks, 'check point')})" if checks else ""
    skipped = counted(len(points.skipped), "sighting")
    return f"{counted(len(points.gcps), 'KGCP')}{of_these}, {skipped} left out"


def _report_part(part: GcpSet) -> None:
    for reason, times in _reasons(part).most_common():
        click.echo(f"  {times:6d} {reason}", err=True)
    _report_accuracy(part.gcps)
    if part.consistency is not None:
        _report_consistency(part.consistency)
    print_doubts(part.doubts)


def _named(written: list[Path]) -> list[str]:
    """Return the names of files; many files in one folder are counted instead."""
    from collections import Counter

    counts = Counter(path.parent for path in written)
    names = (
        f"{counts[path.parent]} files in {path.parent}"
        if counts[path.parent] > MAX_LISTED_FILES
        else str(path)
        for path in written
    )
    return [*dict.fromkeys(names)]


def _report_accuracy(gcps: Sequence[Gcp]) -> None:
    from kgcp.pipeline.export import accuracy_text

    text = accuracy_text(gcps)
    if text:
        click.echo(text, err=True)


def _report_consistency(found: Consistency) -> None:
    from kgcp.quality.advice import rms_m

    along, across, up = rms_m(found)
    outliers = sum(each.is_outlier for each in found.discrepancies)
    click.echo(
        f"frames with a reference pose: {len(found.discrepancies)}; vehicle and camera differ by"
        f" {along:.3f} m along, {across:.3f} m across, {up:.3f} m up (RMS), {outliers} outliers",
        err=True,
    )
