"""`kgcp place`: detections and poses of the camera in, places of static targets out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.options import (
    LocalPath,
    detections_option,
    flight_place_argument,
    json_option,
    out_place_option,
)
from kgcp.io.exporters.formats import FORMATS, OF_CAMERAS

if TYPE_CHECKING:
    from kgcp.io.images.remote import StoredFolder


def _names(
    context: click.Context,
    parameter: click.Parameter,
    value: str | None,
) -> tuple[str, ...]:
    names = tuple(name.strip() for name in (value or "").split(",") if name.strip())
    if value is not None and not names:
        raise click.BadParameter("names no target", context, parameter)
    return names


@click.command()
@flight_place_argument
@out_place_option
@click.option(
    "--targets",
    metavar="NAMES",
    callback=_names,
    help="Targets to place, separated by commas.  [default: all with position_m]",
)
@click.option(
    "--poses",
    metavar="FILE",
    type=LocalPath(),
    help="Poses of the camera, in any format of [reference].  [default: that of flight.toml]",
)
@click.option(
    "--eo",
    type=click.Choice(["sd", "fixed"]),
    default="sd",
    show_default=True,
    help="Use the standard deviations of the poses, or take the poses as exact.",
)
@click.option(
    "--min-frames",
    metavar="N",
    type=click.IntRange(2),
    default=3,
    show_default=True,
    help="Place targets that at least N frames show.",
)
@click.option(
    "--format",
    "formats",
    type=click.Choice([name for name in FORMATS if name not in OF_CAMERAS]),
    multiple=True,
    help="Also write the placed targets for another program, to the folder places; may be"
    " repeated. The formats are those of 'kgcp export-gcp' that hold points.",
)
@detections_option
@json_option
def command(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    detections: Path | None,
    *,
    targets: tuple[str, ...],
    poses: Path | None,
    eo: str,
    min_frames: int,
    formats: tuple[str, ...],
    as_json: bool,
) -> None:
    """Place static targets from all frames that show them, and measure their diameters.

    Computes centre, normal and diameter of every target with position_m from the frames with a
    reference pose, and compares them with flight.toml: a check of the positions and of the print.
    Writes places.parquet, place_residuals.parquet, places.csv, places.json and places.html to
    FLIGHT/kgcp. Run 'kgcp detect' first.

    \b
    Examples:
      kgcp place FLIGHT
      kgcp place FLIGHT --poses FLIGHT/kgcp/poses.csv --format metashape
    """  # noqa: D301 - \b is click's mark for lines that stay
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.workspace import DETECTIONS, open_workspace
    from kgcp.report.plotting import load_matplotlib

    load_matplotlib()  # before the report does
    from kgcp.io.exporters.write import not_renewed
    from kgcp.io.files.locks import sole_writer
    from kgcp.pipeline.ground.place import EXPORTS, PlaceOptions, place_flight, write_places

    options = PlaceOptions(targets, poses, min_frames, has_exact_poses=eo == "fixed")
    with open_workspace(flight, out, (DETECTIONS,)) as workspace:
        the_flight = read_flight(workspace.flight)
        places = place_flight(the_flight, workspace.detections(detections), options)
        with sole_writer(workspace.out, "place"):
            written = write_places(places, workspace.out, formats)
            older = not_renewed(workspace.out / EXPORTS, written)
    if as_json:
        import json

        files = [*map(workspace.named, written)]
        click.echo(json.dumps({**places.summary(), "files": files, "not_renewed": older}))
    doubts = places.doubts
    for sentence in places.sentences:
        if sentence not in doubts:
            click.echo(sentence, err=True)
    for name, reason in places.placement.skipped.items():
        click.echo(f"not placed: {name}: {reason}", err=True)
    for doubt in doubts:
        click.echo(f"kgcp: doubt: {doubt}", err=True)
    for path in written:
        click.echo(f"wrote {workspace.named(path)}", err=True)
    if older:
        click.echo(f"not updated, from an earlier run: {', '.join(older)}", err=True)
