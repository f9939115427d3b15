"""Frames oriented by an EO device in them, in the device's own frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kgcp.errors import Rejection
from kgcp.io.flight.device_file import EoDevice
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frame_patterns import matching_frames
from kgcp.io.images.frames import list_frames, read_grey
from kgcp.measurement.enclosed_discs import centres_and_covariances, enclosed_discs
from kgcp.network.ground.device import DevicePose, orient_by_device
from kgcp.network.ground.resection import NoPoseError
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.ground.own_frame import OrientedFrame, require_a_pose, write_own_frame_poses

_SD_FOCAL = 0.2  # relative standard deviation of a focal length that is only roughly known


@single_threaded()
def orient_frames_by_device(
    flight: Flight,
    device: EoDevice,
    patterns: Sequence[str] = (),
    *,
    has_free_focal: bool = False,
) -> list[OrientedFrame[DevicePose]]:
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
    chosen = matching_frames(list_frames(flight.frames_folder), patterns)
    sd_focal = _SD_FOCAL if has_free_focal else 0.0
    made = [_oriented(flight, device, frame, sd_focal) for frame in chosen]
    require_a_pose(made, flight, f"device {device.name!r}")
    return made


def _oriented(
    flight: Flight, device: EoDevice, frame: str, sd_focal: float
) -> OrientedFrame[DevicePose]:
    camera, count = flight.camera, len(device.points_m)
    try:
        grey = read_grey(flight.frames_folder / frame, camera)
    except Rejection as rejection:
        return OrientedFrame(frame, None, rejection.detail)
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
        return OrientedFrame(frame, None, found)
    return OrientedFrame(frame, min(poses, key=lambda pose: pose.rms_px), "")


def write_device_poses(frames: Sequence[OrientedFrame[DevicePose]], folder: Path) -> Path:
    """Write `device_poses.csv`, and return its path.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    return write_own_frame_poses(
        frames,
        folder / "device_poses.csv",
        {
            "rms_px": lambda pose: f"{pose.rms_px:.4f}",
            "margin": lambda pose: f"{pose.margin:.1f}",
        },
    )
