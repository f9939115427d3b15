"""Frames oriented by a field of discs in them, in the field's own frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frame_patterns import matching_frames
from kgcp.io.images.frames import list_frames, read_grey
from kgcp.measurement.discs.records import Operator
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.measurement.field_photograph import (
    PhotoMiss,
    PhotoTask,
    learn_from_fields,
    measure_field,
)
from kgcp.network.ground.field_pose import FieldPose, orient_by_field
from kgcp.network.ground.resection import NoPoseError
from kgcp.pipeline.calibration.run import LEARNED_FROM, REASONS
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.ground.own_frame import OrientedFrame, require_a_pose, write_own_frame_poses
from kgcp.targets.fields.points import AnyField

# Largest relative difference between measured and expected radii. Prints and edges are better.
_MAX_RADIUS_DIFFERENCE = 0.03


@single_threaded()
def orient_frames_by_field(
    flight: Flight,
    field: AnyField,
    patterns: Sequence[str] = (),
    *,
    has_free_focal: bool = False,
) -> list[OrientedFrame[FieldPose]]:
    """Orient frames in the frame of a field.

    Parameters
    ----------
    patterns : sequence of str
        Which frames; empty: all.
    has_free_focal : bool
        Whether the focal length is unknown, to a factor of two.

    Raises
    ------
    KgcpError
        If no frame matches, or none can be oriented.
    """
    chosen = matching_frames(list_frames(flight.frames_folder), patterns)
    task = PhotoTask(field, flight.camera.response, Operator.MODEL)
    some = chosen[:: max(len(chosen) // LEARNED_FROM, 1)][:LEARNED_FROM]
    task = replace(task, camera=learn_from_fields(_readable(flight, some), task))
    with np.errstate(all="ignore"):  # trial poses may be absurd; results that are not finite fail
        made = [_oriented(flight, task, frame, has_free_focal=has_free_focal) for frame in chosen]
    require_a_pose(made, flight, f"field {field.name!r}")
    return made


def _readable(flight: Flight, frames: Sequence[str]) -> Iterator[GreyArray]:
    for frame in frames:
        with suppress(Rejection):
            yield read_grey(flight.frames_folder / frame, flight.camera)


def _oriented(
    flight: Flight, task: PhotoTask, frame: str, *, has_free_focal: bool
) -> OrientedFrame[FieldPose]:
    try:
        grey = read_grey(flight.frames_folder / frame, flight.camera)
    except Rejection as rejection:
        return OrientedFrame(frame, None, rejection.detail)
    measured = measure_field(grey, task, frame, ExifCamera())
    if isinstance(measured, PhotoMiss):
        return OrientedFrame(frame, None, f"{REASONS[measured.reason]} ({measured.detail})")
    if measured.is_symmetric:
        reason = "the field looks the same turned, and nothing tells how it lies; give it a mark"
        return OrientedFrame(frame, None, reason)
    try:
        pose = orient_by_field(
            flight.camera,
            task.field,
            measured.point.astype(np.intp),
            measured.vectors,
            measured.covs,
            has_free_focal=has_free_focal,
        )
    except NoPoseError as error:
        return OrientedFrame(frame, None, str(error))
    return OrientedFrame(frame, pose, "")


def field_doubts(frames: Sequence[OrientedFrame[FieldPose]], field: AnyField) -> tuple[str, ...]:
    """Return what to look at before the poses are used: they are as far away as the field is large.

    The sizes of the discs tell if the field's distances, or its diameters, have another unit.
    """
    scales = [each.pose.radius_scale for each in frames if each.pose is not None]
    scale = float(np.median(scales))
    if not field.is_diameter_stated or abs(scale - 1.0) <= _MAX_RADIUS_DIFFERENCE:
        return ()
    times = f"{scale:.0f}" if scale > 100.0 else f"{scale:.3g}"
    doubt = (
        f"the discs are {times} times as large as the field says; look at its distances, which"
        " the poses' places follow, and its diameters"
    )
    return (doubt,)


def write_field_poses(frames: Sequence[OrientedFrame[FieldPose]], folder: Path) -> Path:
    """Write `field_poses.csv`, and return its path.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    return write_own_frame_poses(
        frames,
        folder / "field_poses.csv",
        {
            "rms_px": lambda pose: f"{pose.rms_px:.4f}",
            "discs": lambda pose: str(pose.discs),
            "discs_used": lambda pose: str(pose.discs_used),
        },
    )
