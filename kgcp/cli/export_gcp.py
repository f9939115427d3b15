"""`kgcp export-gcp`: detections and trajectory in, KGCPs out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.options import detections_option, flight_argument, json_option, out_option
from kgcp.io.exporters import FORMATS, export

if TYPE_CHECKING:
    from kgcp.carrier import Carrier
    from kgcp.kgcps import Kgcp, Skip


@click.command()
@flight_argument
@out_option
@click.option(
    "--format",
    "formats",
    type=click.Choice(list(FORMATS)),
    multiple=True,
    default=list(FORMATS),
    help="What to write besides kgcps.parquet; may be repeated.  [default: all]",
)
@detections_option
@json_option
def command(
    flight: Path,
    out: Path | None,
    formats: tuple[str, ...],
    detections: Path | None,
    *,
    as_json: bool,
) -> None:
    """Make kinematic ground control points of the detections of FLIGHT.

    Interpolates the vehicle's trajectory at every frame's time, adds the lever arm, and writes
    FLIGHT/kgcp/kgcps.parquet, kgcps.csv and OpenDroneMap's gcp_list.txt. Needs 'kgcp detect'
    before it, and in flight.toml a crs and a [vehicle], or targets with position_m.

    Example: kgcp export-gcp sample_flight --format odm
    """
    from kgcp.errors import KgcpError
    from kgcp.io.columns import KGCP_COLUMNS
    from kgcp.io.exporters.points import MapPoints
    from kgcp.io.flight import read_flight
    from kgcp.io.kgcp_table import kgcp_row
    from kgcp.io.provenance import provenance
    from kgcp.io.sightings import read_attempts
    from kgcp.io.tables import write_table
    from kgcp.io.whereabouts import read_whereabouts
    from kgcp.kgcps import build_kgcps

    the_flight = read_flight(flight)
    folder = out or the_flight.folder / "kgcp"
    source = detections or folder / "detections.parquet"
    attempts = read_attempts(source, the_flight.targets)
    sightings = [attempt.sighting for attempt in attempts if attempt.sighting is not None]
    if not sightings:
        raise KgcpError(
            f"{source}: no target was measured in any frame;"
            " see the reasons that 'kgcp detect' gives"
        )
    whereabouts = read_whereabouts(the_flight)
    kgcps, skipped = build_kgcps(sightings, whereabouts, the_flight.camera)
    table = folder / "kgcps.parquet"
    write_table(table, KGCP_COLUMNS, map(kgcp_row, kgcps), provenance(the_flight))
    points = MapPoints(whereabouts.frame.crs, kgcps)
    written = [table]
    for name in dict.fromkeys(formats):
        written += export(points, name, folder)
    _report(kgcps, skipped, whereabouts.carrier, written, as_json=as_json)


def _report(
    kgcps: tuple[Kgcp, ...],
    skipped: tuple[Skip, ...],
    carrier: Carrier | None,
    written: list[Path],
    *,
    as_json: bool,
) -> None:
    from collections import Counter

    reasons = Counter(skip.reason.value for skip in skipped)
    if as_json:
        import json

        summary = {"kgcps": len(kgcps), "skipped": dict(reasons), "files": [*map(str, written)]}
        click.echo(json.dumps(summary))
    click.echo(f"{len(kgcps)} KGCPs, {len(skipped)} sightings left out", err=True)
    for reason, count in reasons.most_common():
        click.echo(f"  {count:6d} {reason}", err=True)
    if carrier is not None and carrier.motion.sd_position_m is None:
        click.echo("the trajectory has no sd_x, sd_y, sd_z: KGCPs have no deviations", err=True)
    elif carrier is not None and carrier.motion.sd_attitude_deg is None:
        click.echo(
            "the trajectory has no sd_roll_deg, sd_pitch_deg, sd_heading_deg:"
            " attitude counts as free of error",
            err=True,
        )
    for path in written:
        click.echo(f"wrote {path}", err=True)
