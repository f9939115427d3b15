"""`kgcp orient`: detections of static targets in, poses of the camera out."""

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
    unit_option,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from kgcp.io.images.remote import StoredFolder
    from kgcp.pipeline.ground.orient import FlightPoses
    from kgcp.pipeline.ground.own_frame import OrientedFrame, PoseT

_MIN_POINTS = 4
_MAX_NAMED = 3  # frames in a message


@click.command()
@flight_place_argument
@out_place_option
@click.option(
    "--frames",
    "patterns",
    metavar="PATTERN",
    multiple=True,
    help='Orient these frames, for example "west/*"; may be repeated.  [default: all]',
)
@click.option(
    "--min-points",
    metavar="N",
    type=click.IntRange(3),
    help="Targets that must agree in a frame; three whose distances are measured are enough."
    f"  [default: {_MIN_POINTS}]",
)
@click.option(
    "--free-focal",
    is_flag=True,
    help="Estimate the focal length, too; that in flight.toml may be wrong by a factor of two.",
)
@click.option(
    "--device",
    "device_file",
    metavar="FILE",
    type=LocalPath(),
    help="Orient frames by an EO device that they show, relative to it; FILE, device.toml, has its"
    " points.",
)
@click.option(
    "--field",
    "field_text",
    metavar="FIELD",
    help="Orient frames by a field of discs that they show, relative to it: a field.toml, another"
    " program's board file, or a shorthand, as for 'kgcp calibrate'.",
)
@unit_option
@detections_option
@json_option
def command(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    detections: Path | None,
    *,
    patterns: tuple[str, ...],
    min_points: int | None,
    free_focal: bool,
    device_file: Path | None,
    field_text: str | None,
    unit: str | None,
    as_json: bool,
) -> None:
    """Orient frames by the static targets in them, without an adjustment.

    Computes the camera's pose in every frame with three or more targets that have a position_m, and
    rejects targets that do not agree. A frame with only one ring is oriented if other frames
    determine how that ring lies. Writes poses.parquet, pose_residuals.parquet and poses.csv to
    FLIGHT/kgcp.
    poses.csv can be given as [reference] poses. Run 'kgcp detect' first.

    With --device, frames are oriented by plain discs within a closed boundary, which are identified
    by their arrangement. With --field, they are oriented by the discs of a field, which are found
    as by 'kgcp calibrate'. 'kgcp detect' is not needed. Writes device_poses.csv or field_poses.csv.

    \b
    Examples:
      kgcp orient FLIGHT
      kgcp orient FLIGHT --device device.toml --free-focal
      kgcp orient FLIGHT --field field.toml
    """  # noqa: D301 - \b is click's mark for lines that stay
    if unit is not None and field_text is None:
        raise click.UsageError("--unit applies to --field only; leave it out")
    if device_file is None and field_text is None:
        least = _MIN_POINTS if min_points is None else min_points
        _orient_by_targets(
            flight, out, patterns, detections, least, free_focal=free_focal, as_json=as_json
        )
        return
    _refuse_together(
        {
            "--device": device_file is not None,
            "--field": field_text is not None,
            "--detections": detections is not None,
            "--min-points": min_points is not None,
        }
    )
    folder, results = _own_frame_folders(flight, out)
    if device_file is not None:
        _orient_by_device(
            folder, results, patterns, device_file, free_focal=free_focal, as_json=as_json
        )
    elif field_text is not None:
        _orient_by_field(
            folder, results, patterns, (field_text, unit), free_focal=free_focal, as_json=as_json
        )


def _orient_by_targets(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    patterns: tuple[str, ...],
    detections: Path | None,
    min_points: int,
    *,
    free_focal: bool,
    as_json: bool,
) -> None:
    from kgcp.io.files.locks import sole_writer
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.ground.orient import OrientOptions, orient_flight, write_poses
    from kgcp.pipeline.workspace import DETECTIONS, open_workspace

    options = OrientOptions(patterns, min_points, has_free_focal=free_focal)
    with open_workspace(flight, out, (DETECTIONS,)) as workspace:
        the_flight = read_flight(workspace.flight)
        poses = orient_flight(the_flight, workspace.detections(detections), options)
        with sole_writer(workspace.out, "orient"):
            written = write_poses(poses, workspace.out)
    if as_json:
        import json

        files = [*map(workspace.named, written)]
        click.echo(json.dumps({**poses.summary(), "files": files}))
    _report(poses)
    for path in written:
        click.echo(f"wrote {workspace.named(path)}", err=True)


def _report(poses: FlightPoses) -> None:
    from collections import Counter

    oriented = poses.oriented
    by_ring = sum(each.is_by_one_ring for each in oriented)
    of_these = f" ({by_ring} by one ring)" if by_ring else ""
    click.echo(f"{len(oriented)} of {len(poses.poses)} frames oriented{of_these}", err=True)
    reasons = Counter(each.reason for each in poses.poses if each.pose is None)
    for reason, count in reasons.most_common():
        click.echo(f"  {count:6d} {reason}", err=True)
    _report_left_out(poses)
    for doubt in poses.doubts:
        click.echo(f"kgcp: doubt: {doubt}", err=True)
    if poses.focal_px is not None:
        focal, sd = poses.focal_px
        click.echo(f"focal length {focal:.2f} ± {sd:.2f} px", err=True)


def _report_left_out(poses: FlightPoses) -> None:
    left_out: dict[str, list[str]] = {}
    for each in poses.oriented:
        if not each.is_by_one_ring:
            for name in each.targets:
                if name not in each.used:
                    left_out.setdefault(name, []).append(each.frame)
    for name, frames in left_out.items():
        where = ", ".join(frames)
        if len(frames) > _MAX_NAMED:
            measured = sum(name in each.targets for each in poses.oriented)
            where = f"{len(frames)} of {measured} frames, first in {frames[0]}"
            if 2 * len(frames) > measured:
                where += f"; {what_to_check(name, poses.suspects)}"
        click.echo(f"kgcp: doubt: {name} left out in {where}", err=True)


def what_to_check(left_out: str, suspects: Sequence[str]) -> str:
    """Return what to check if most frames leave a target out."""
    others = [name for name in suspects if name != left_out]
    if left_out in suspects and others:
        # three wrong targets leave out a right one as well as three right ones a wrong one
        return f"its position is wrong, or that of {' or '.join(others)}"
    return "check its position_m and diameter"


def _refuse_together(given: Mapping[str, bool]) -> None:
    """Refuse a device and a field at once, and options that cannot be combined with either."""
    first, *others = (name for name, is_given in given.items() if is_given)
    if others:
        raise click.UsageError(f"{first} takes no {' or '.join(others)}; leave one out")


def _own_frame_folders(
    flight: Path | StoredFolder, out: Path | StoredFolder | None
) -> tuple[Path, Path | None]:
    from kgcp.errors import KgcpError

    if isinstance(flight, Path) and (out is None or isinstance(out, Path)):
        return flight, out
    raise KgcpError(f"{flight}: frames are read from a disk here; copy them there")


def _orient_by_device(
    flight: Path,
    out: Path | None,
    patterns: tuple[str, ...],
    device_file: Path,
    *,
    free_focal: bool,
    as_json: bool,
) -> None:
    from kgcp.errors import KgcpError
    from kgcp.io.files.safe_read import is_no_file
    from kgcp.io.flight.device_file import read_device
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.ground.device import orient_frames_by_device, write_device_poses
    from kgcp.pipeline.workspace import results_folder

    if is_no_file(device_file):
        raise KgcpError(f"{device_file}: does not exist; name a device's file", option="device")
    device, the_flight = read_device(device_file), read_flight(flight)
    made = orient_frames_by_device(the_flight, device, patterns, has_free_focal=free_focal)
    path = write_device_poses(made, out or results_folder(flight))
    _report_frames({"device": device.name}, (), made, path, as_json=as_json)


def _orient_by_field(
    flight: Path,
    out: Path | None,
    patterns: tuple[str, ...],
    field_and_unit: tuple[str, str | None],
    *,
    free_focal: bool,
    as_json: bool,
) -> None:
    from kgcp.io.flight.field_file import read_field
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.ground.field import (
        field_doubts,
        orient_frames_by_field,
        write_field_poses,
    )
    from kgcp.pipeline.workspace import results_folder

    field, the_flight = read_field(*field_and_unit), read_flight(flight)
    made = orient_frames_by_field(the_flight, field, patterns, has_free_focal=free_focal)
    path = write_field_poses(made, out or results_folder(flight))
    doubts = field_doubts(made, field)
    _report_frames({"field": field.name}, doubts, made, path, as_json=as_json)


def _report_frames(
    about: Mapping[str, str],
    doubts: Sequence[str],
    frames: Sequence[OrientedFrame[PoseT]],
    path: Path,
    *,
    as_json: bool,
) -> None:
    if as_json:
        import json

        oriented = sum(each.pose is not None for each in frames)
        reasons = {each.frame: each.reason for each in frames if each.pose is None}
        counts = {"frames": len(frames), "oriented": oriented, "not_oriented": reasons}
        files = {"doubts": doubts, "files": [str(path)]}
        click.echo(json.dumps({**about, **counts, **files}))
    for each in frames:
        outcome = f"not oriented: {each.reason}" if each.pose is None else each.pose.in_words
        click.echo(f"{each.frame}: {outcome}", err=True)
    for doubt in doubts:
        click.echo(f"kgcp: doubt: {doubt}", err=True)
    click.echo(f"wrote {path}", err=True)
