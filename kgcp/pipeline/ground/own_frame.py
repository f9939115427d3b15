"""Frames oriented in the coordinate frame of an EO device or a field of discs in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from kgcp.errors import KgcpError
from kgcp.io.files.atomic import write_bytes
from kgcp.io.flight.flight import Flight
from kgcp.io.tables.poses import OwnFramePose, own_frame_poses_csv
from kgcp.network.ground.device import DevicePose
from kgcp.network.ground.field_pose import FieldPose

PoseT = TypeVar("PoseT", DevicePose, FieldPose)


@dataclass(frozen=True, slots=True, eq=False)
class OrientedFrame(Generic[PoseT]):
    """The pose of one frame, or the reason why there is none."""

    frame: str
    pose: PoseT | None
    reason: str


def require_a_pose(frames: Sequence[OrientedFrame[PoseT]], flight: Flight, shown: str) -> None:
    """Refuse a flight of which no frame could be oriented.

    Raises
    ------
    KgcpError
        With the most common reason.
    """
    if not any(each.pose is not None for each in frames):
        reason, count = Counter(each.reason for each in frames).most_common(1)[0]
        which = ""
        if count < len(frames):
            which = f"; of {len(frames)} frames {count} have this reason"
        raise KgcpError(
            f"{flight.frames_folder}: no frame can be oriented by the {shown}{which}: {reason}"
        )


def write_own_frame_poses(
    frames: Sequence[OrientedFrame[PoseT]],
    path: Path,
    columns: Mapping[str, Callable[[PoseT], str]],
) -> Path:
    """Write the poses as CSV with additional columns; return the path.

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
            tuple(text_of(each.pose) for text_of in columns.values()),
        )
        for each in frames
        if each.pose is not None
    )
    write_bytes(path, own_frame_poses_csv(rows, (*columns,)).encode())
    return path
