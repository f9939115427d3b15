"""Frames measured again with other grey values: the experiment of Figure 10 of Cucci (2016)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.measurement.guided import Prediction, measure_guided
from kgcp.measurement.plate_prior import PlatePrior
from kgcp.measurement.records import Measurement
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Target

GAINS = (0.6, 1.6)
_SD_PX, _SD_LOG_RADIUS = 0.5, 0.02  # of the prediction: the target has not moved
_REACH = 4.0  # from the centre, in ring radii, within which grey values are changed
_MIN_REACH_PX = 60.0


@dataclass(frozen=True, slots=True)
class Reexposed:
    """One target measured again."""

    row: int  # of the measurement, in the order of time
    gain: float  # factor of the grey values
    radius_px: float  # of the ring
    change_percent: float | None  # of the distance; None: the target was not measured again
    sd_percent: float | None  # standard deviation of the new distance
    saturated: float | None  # share of clipped pixels in the changed frame


def reexposed(grey: GreyArray, gain: float) -> GreyArray:
    """Return a frame with its grey values times `gain`, clipped and rounded."""
    limit = np.iinfo(grey.dtype).max
    return np.rint(np.minimum(grey * gain, limit)).astype(grey.dtype)


def measure_again(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    settings: DetectSettings,
    centre_px: FloatArray,
    radius_px: float,
    row: int,
) -> list[Reexposed]:
    """Measure one target with its grey values unchanged and times each of `GAINS`.

    The target is searched for only at its known position, whatever the size of the frame.
    The list is empty if it is not measured there with unchanged grey values.
    """
    prediction = Prediction(centre_px, _SD_PX, radius_px, _SD_LOG_RADIUS, "the unchanged frame")

    def measured(gain: float) -> Measurement | None:
        changed = _reexposed_around(grey, gain, centre_px, radius_px)
        return measure_guided(changed, camera, target, prediction, settings, PlatePrior(), ())[0]

    before = measured(1.0)
    if before is None:
        return []
    return [_compare(before, measured(gain), gain, radius_px, row) for gain in GAINS]


def _compare(
    before: Measurement, after: Measurement | None, gain: float, radius_px: float, row: int
) -> Reexposed:
    if after is None:
        return Reexposed(row, gain, radius_px, None, None, None)
    distance = after.pose.distance_m
    spread = after.uncertainty
    return Reexposed(
        row,
        gain,
        radius_px,
        100.0 * (distance / before.pose.distance_m - 1.0),
        None if spread is None else 100.0 * spread.sd_distance_m / distance,
        after.appearance.saturated,
    )


def _reexposed_around(
    grey: GreyArray, gain: float, centre_px: FloatArray, radius_px: float
) -> GreyArray:
    """Return a frame whose grey values are changed around the ring, where they are used."""
    reach = max(_MIN_REACH_PX, _REACH * radius_px)
    left, top = np.maximum(np.floor(centre_px - reach), 0).astype(int)
    right, bottom = np.ceil(centre_px + reach).astype(int)
    changed = grey.copy()
    changed[top:bottom, left:right] = reexposed(grey[top:bottom, left:right], gain)
    return changed
