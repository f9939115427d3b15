"""Frames oriented by an EO device in them, in the device's own frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kgcp.errors import KgcpError, Rejection
from kgcp.io.files.atomic import write_bytes
from kgcp.io.flight.device_file import EoDevice
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frames import list_frames, matching_frames, read_grey
from kgcp.io.tables.poses import OwnFramePose, own_frame_poses_csv
from kgcp.measurement.enclosed_discs import centres_and_covariances, enclosed_discs
from kgcp.network.ground.device import DevicePose, orient_by_device
from kgcp.network.ground.resection import NoPoseError
from kgcp.pipeline.execution.threads import single_threaded

_SD_FOCAL = 0.2  # relative, of a focal length that is only roughly known


@dataclass(frozen=True, slots=True, eq=False)
class DeviceFrame:
    """What became of one frame: a pose, or why there is none."""

    frame: str
    pose: DevicePose | None
    reason: str


@single_threaded()
def orient_frames_by_device(
    flight: Flight,
    device: EoDevice,
    patterns: Sequence[str] = (),
    *,
    has_free_focal: bool = False,
) -> list[DeviceFrame]:
    """Orient frames in the frame of a device.

    Parameters
    ----------
    patterns : sequence of str
        Which frames; empty: all.
    has_free_focal : bool
        Whether the focal length is known to 20 % only.

    Raises
    ------
    KgcpError
        If no frame matches, or none can be oriented.
    """
    frames = list_frames(flight.frames_folder)
    chosen = matching_frames(frames, patterns) if patterns else frames
    sd_focal = _SD_FOCAL if has_free_focal else 0.0
    made = [_oriented(flight, device, frame, sd_focal) for frame in chosen]
    if not any(each.pose is not None for each in made):
        reason = made[0].reason if made else "there is no frame"
        raise KgcpError(
            f"{flight.frames_folder}: no frame can be oriented by the device {device.name!r}:"
            f" {reason}"
        )
    return made


def _oriented(flight: Flight, device: EoDevice, frame: str, sd_focal: float) -> DeviceFrame:
    camera, count = flight.camera, len(device.points_m)
    try:
        grey = read_grey(flight.frames_folder / frame, camera)
    except Rejection as rejection:
        return DeviceFrame(frame, None, rejection.detail)
    groups = enclosed_discs(grey, count, camera.response)
    poses, reasons = [], []
    for group in groups:
        centres, covs = centres_and_covariances(group)
        try:
            poses.append(
                orient_by_device(camera, device.points_m, centres, covs, sd_focal=sd_focal)
            )
        except NoPoseError as error:
            reasons.append(str(error))
    if not poses:
        found = f"no closed region with {count} discs" if not groups else reasons[0]
        return DeviceFrame(frame, None, found)
    return DeviceFrame(frame, min(poses, key=lambda pose: pose.rms_px), "")


def write_device_poses(frames: Sequence[DeviceFrame], folder: Path) -> Path:
    """Write `device_poses.csv`, and return its path.

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
            (f"{each.pose.rms_px:.4f}", f"{each.pose.margin:.1f}"),
        )
        for each in frames
        if each.pose is not None
    )
    path = folder / "device_poses.csv"
    write_bytes(path, own_frame_poses_csv(rows, ("rms_px", "margin")).encode())
    return path
