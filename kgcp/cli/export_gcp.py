"""`kgcp export-gcp`: detections and trajectory in, KGCPs out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kgcp.cli.doubts import doubt_json, print_doubts
from kgcp.cli.options import (
    detections_option,
    flight_place_argument,
    json_option,
    out_place_option,
    selection_options,
)
from kgcp.io.exporters.formats import DEFAULT_FORMATS, FORMATS

if TYPE_CHECKING:
    from kgcp.georef.target_positions import Vehicle
    from kgcp.io.images.remote import StoredFolder
    from kgcp.pipeline.export import GcpSet
    from kgcp.quality.consistency import Consistency

ALL = "all"
MANY = 12
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
@flight_place_argument
@out_place_option
@click.option(
    "--format",
    "formats",
    type=click.Choice([*FORMATS, ALL]),
    multiple=True,
    default=DEFAULT_FORMATS,
    help="Format to write besides kgcps.parquet; may be repeated; 'all' skips formats that cannot"
    " hold these points.  [default: csv, odm]",
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
    default=None,
    help="CRS of the points, for example EPSG:25832.  [default: the flight's]",
)
@click.option(
    "--mark-floor-px",
    metavar="PX",
    type=click.FloatRange(0.0, 100.0),
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
@selection_options
@detections_option
@json_option
def command(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    formats: tuple[str, ...],
    crs: str | None,
    mark_floor_px: float,
    image_names: str,
    detections: Path | None,
    *,
    as_json: bool,
    **selection: Any,  # noqa: ANN401 - the fields of a Selection
) -> None:
    """Compute ground control points from the measurements.

    Interpolates the vehicle's trajectory at every frame's time, adds the lever arm, and writes
    the kinematic ground control points to FLIGHT/kgcp: kgcps.parquet, kgcps.csv and OpenDroneMap's
    odm/gcp_list.txt. Run 'kgcp detect' first. flight.toml needs a crs and either a [vehicle] or
    targets with position_m. With reference poses, the summary reports how well they agree with the
    vehicle and what to correct.

    Example: kgcp export-gcp sample_flight --format odm
    """
    from kgcp.georef.selection import Selection
    from kgcp.io.exporters.write import not_renewed
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.export import make_gcps, write_gcps
    from kgcp.pipeline.workspace import DETECTIONS, open_workspace

    with open_workspace(flight, out, (DETECTIONS,)) as workspace:
        the_flight = read_flight(workspace.flight)
        source = detections or workspace.out / DETECTIONS
        made = make_gcps(the_flight, source, selection=Selection(**selection), crs=crs)
        written = write_gcps(made, workspace.out)
        more, left_out = _export(
            made,
            formats,
            workspace.out,
            mark_floor_px=mark_floor_px,
            image_extensions=image_names == WITH_EXTENSION,
        )
        written += more
        older = not_renewed(workspace.out, written)
    _report(made, written, left_out, older, workspace.named, as_json=as_json)


def _export(
    made: GcpSet,
    formats: tuple[str, ...],
    folder: Path,
    *,
    mark_floor_px: float,
    image_extensions: bool,
) -> tuple[list[Path], dict[str, str]]:
    """Write the named formats; with `all`, every format that can hold the points.

    Returns the paths, and by format why it was left out.
    """
    from kgcp.errors import KgcpError
    from kgcp.pipeline.export import export_gcps

    written, left_out = [], {}
    for name in FORMATS if ALL in formats else dict.fromkeys(formats):
        try:
            written += export_gcps(
                made,
                (name,),
                folder,
                mark_floor_px=mark_floor_px,
                image_extensions=image_extensions,
            )
        except KgcpError as error:
            if name in formats:
                raise
            left_out[name] = str(error)
    return written, left_out


def _report(
    made: GcpSet,
    written: list[Path],
    left_out: dict[str, str],
    older: tuple[str, ...],
    named: Callable[[object], str],
    *,
    as_json: bool,
) -> None:
    from collections import Counter

    reasons = Counter(skipped.reason.value for skipped in made.skipped)
    checks = sum(point.is_checkpoint for point in made.gcps)
    if as_json:
        import json

        summary = {
            "kgcps": len(made.gcps),
            "checkpoints": checks,
            "skipped": dict(reasons),
            "advice": _advice(made.consistency),
            "doubts": [*map(doubt_json, made.doubts)],
            "files": [*map(named, written)],
            "left_out": left_out,
            "not_renewed": older,
        }
        click.echo(json.dumps(summary))
    of_these = f" ({checks} check points)" if checks else ""
    click.echo(
        f"{len(made.gcps)} KGCPs{of_these}, {len(made.skipped)} sightings left out", err=True
    )
    for reason, times in reasons.most_common():
        click.echo(f"  {times:6d} {reason}", err=True)
    _report_deviations(made.vehicle)
    if made.consistency is not None:
        _report_consistency(made.consistency)
    print_doubts(made.doubts)
    for path in _named(written):
        click.echo(f"wrote {named(path)}", err=True)
    for name, reason in left_out.items():
        click.echo(f"left out {name}: {reason.removeprefix(f'{name}: ')}", err=True)
    if older:
        click.echo(f"left as an earlier export wrote them: {', '.join(older)}", err=True)


def _named(written: list[Path]) -> list[str]:
    """Name files; where a folder has many of them, the folder."""
    from collections import Counter

    counts = Counter(path.parent for path in written)
    names = (
        f"{counts[path.parent]} files in {path.parent}" if counts[path.parent] > MANY else str(path)
        for path in written
    )
    return [*dict.fromkeys(names)]


def _report_deviations(vehicle: Vehicle | None) -> None:
    if vehicle is not None and vehicle.motion.sd_position_m is None:
        click.echo(
            "the trajectory has no sd_x, sd_y, sd_z: KGCPs have no standard deviations", err=True
        )
    elif vehicle is not None and vehicle.motion.sd_attitude_deg is None:
        click.echo(
            "the trajectory has no sd_roll_deg, sd_pitch_deg, sd_heading_deg:"
            " attitude is taken as free of error",
            err=True,
        )


def _report_consistency(found: Consistency) -> None:
    from kgcp.quality.advice import rms_m

    along, across, up = rms_m(found)
    outliers = sum(one.is_outlier for one in found.discrepancies)
    click.echo(
        f"frames with a reference pose: {len(found.discrepancies)}; vehicle and camera differ by"
        f" {along:.3f} m along, {across:.3f} m across, {up:.3f} m up (RMS), {outliers} outliers",
        err=True,
    )


def _advice(found: Consistency | None) -> tuple[str, ...]:
    from kgcp.quality.advice import advice

    return () if found is None else advice(found)
