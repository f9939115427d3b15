"""Check of the direction in which the plate is mounted, from images and reference poses."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.camera_priors import body_from_plate
from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.quality.checks.encounters import Encounters
from kgcp.quality.number_text import minus

_MAX_OFF_DEG = 8.0  # from mount_deg
_MAX_SPREAD_DEG = 8.0  # of a steady rotation, by the median
_RIGHT_ANGLE_DEG = 5.0  # within this of a multiple of 90°, that multiple is proposed


def check_mount(encounters: Encounters) -> Iterator[Doubt]:
    """Compare the plate's direction with that of the vehicle and `mount_deg`."""
    mount_deg = encounters.vehicle.settings.mount_deg
    off = _plate_turns_deg(encounters, mount_deg)
    off = off[np.isfinite(off)]
    if not len(off):
        return
    turns = np.exp(1j * np.radians(off))
    middle = math.degrees(float(np.angle(turns.mean())))
    spread = float(np.median(np.abs((off - middle + 180.0) % 360.0 - 180.0)))
    if abs(middle) < _MAX_OFF_DEG or spread > _MAX_SPREAD_DEG:
        return
    measured_deg = (mount_deg + middle + 180.0) % 360.0 - 180.0
    nearest = 90.0 * round(measured_deg / 90.0)
    proposed = nearest if abs(measured_deg - nearest) < _RIGHT_ANGLE_DEG else round(measured_deg, 1)
    yield mild(
        Cause.MOUNT,
        "according to images and reference poses, the plate is rotated by"
        f" {minus(f'{measured_deg:.1f}')}° ± {spread:.1f}° on the vehicle, but mount_deg is"
        f" {mount_deg:g}",
        f"set [vehicle] mount_deg = {proposed:g}, unless headings are wrong",
        {"mount_deg": measured_deg, "spread_deg": spread},
    )


def _plate_turns_deg(encounters: Encounters, mount_deg: float) -> FloatArray:
    """Return the rotation of the plate about its normal from its stated mount (n,) [deg]."""
    by_image = encounters.enu_from_camera @ encounters.camera_from_plate
    by_vehicle = encounters.frame_from_body @ body_from_plate(mount_deg)
    turn = np.swapaxes(by_vehicle, 1, 2) @ by_image
    angle = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    angle[~np.isfinite(encounters.position_m).all(axis=1)] = np.nan
    return np.asarray(np.degrees(angle))
