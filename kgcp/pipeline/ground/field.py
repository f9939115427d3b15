"""Frames oriented by a field of discs in them, in the field's own frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.io.files.atomic import write_bytes
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frames import list_frames, matching_frames, read_grey
from kgcp.io.tables.poses import OwnFramePose, own_frame_poses_csv
from kgcp.measurement.discs.photograph import (
    PhotoMiss,
    PhotoTask,
    learn_from_fields,
    measure_field,
)
from kgcp.measurement.discs.records import Operator
from kgcp.network.ground.field_pose import FieldPose, orient_by_field
from kgcp.network.ground.resection import NoPoseError
from kgcp.pipeline.calibration.run import LEARNED_FROM, REASONS
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.targets.fields.points import AnyField


@dataclass(frozen=True, slots=True, eq=False)
class FieldFrame:
    """What became of one frame: a pose, or why there is none."""

    frame: str
    pose: FieldPose | None
    reason: str


@single_threaded()
def orient_frames_by_field(
    flight: Flight,
    field: AnyField,
    patterns: Sequence[str] = (),
    *,
    has_free_focal: bool = False,
) -> list[FieldFrame]:
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
    frames = list_frames(flight.frames_folder)
    chosen = matching_frames(frames, patterns) if patterns else frames
    task = PhotoTask(field, flight.camera.response, Operator.MODEL)
    some = chosen[:: max(len(chosen) // LEARNED_FROM, 1)][:LEARNED_FROM]
    task = PhotoTask(
        field, task.response, task.operator, learn_from_fields(_readable(flight, some), task)
    )
    with np.errstate(all="ignore"):  # poses are tried anywhere: what is not finite is no result
        made = [_oriented(flight, task, frame, has_free_focal=has_free_focal) for frame in chosen]
    if not any(each.pose is not None for each in made):
        reason = made[0].reason if made else "there is no frame"
        raise KgcpError(
            f"{flight.frames_folder}: no frame can be oriented by the field {field.name!r}:"
            f" {reason}"
        )
    return made


def _readable(flight: Flight, frames: Sequence[str]) -> Iterator[GreyArray]:
    for frame in frames:
        with suppress(Rejection):
            yield read_grey(flight.frames_folder / frame, flight.camera)


def _oriented(flight: Flight, task: PhotoTask, frame: str, *, has_free_focal: bool) -> FieldFrame:
    try:
        grey = read_grey(flight.frames_folder / frame, flight.camera)
    except Rejection as rejection:
        return FieldFrame(frame, None, rejection.detail)
    measured = measure_field(grey, task, frame, "")
    if isinstance(measured, PhotoMiss):
        return FieldFrame(frame, None, f"{REASONS[measured.reason]} ({measured.detail})")
    if measured.is_symmetric:
        reason = "the field looks the same turned, and nothing tells how it lies; give it a mark"
        return FieldFrame(frame, None, reason)
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
        return FieldFrame(frame, None, str(error))
    return FieldFrame(frame, pose, "")


def write_field_poses(frames: Sequence[FieldFrame], folder: Path) -> Path:
    """Write `field_poses.csv`, and return its path.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    rows = (
        OwnFramePose(
            each.frame,
            each.pose.pose,
            each.pose.cov,
            (f"{each.pose.rms_px:.4f}", str(each.pose.discs), str(each.pose.discs_used)),
        )
        for each in frames
        if each.pose is not None
    )
    path = folder / "field_poses.csv"
    write_bytes(path, own_frame_poses_csv(rows, ("rms_px", "discs", "discs_used")).encode())
    return path
