"""Prediction of plain targets in a frame from the frames before and after it."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.plain_prediction import Predictions
from kgcp.georef.prediction import NEIGHBOURS, InterpolatedState, Track, interpolate
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.measurement.records import FrameResult, Measurement
from kgcp.targets.plain import PlainTarget

# Longest gap over which image places are interpolated, in usual intervals between frames that show
# the target. In a longer one, the camera may turn round.
_MAX_GAP_INTERVALS = 4.0
_EXTRA_SD_PX, _EXTRA_SD_DEG = 1.0, 2.0  # added to what interpolation states of centre and normal


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """The part of a measurement from which other frames are predicted."""

    state: FloatArray  # (3,): centre x, y [px] and logarithm of the distance [m]
    normal: FloatArray  # (3,): in the camera frame
    sd_normal_deg: float

    @classmethod
    def of(cls, measurement: Measurement) -> Self:
        """Extract it from a measurement."""
        state = np.append(measurement.centre_px, math.log(measurement.distance_m))
        # a copy, because a view would keep its whole array in memory
        normal = measurement.pose.normal.copy()
        return cls(state, normal, _sd_normal_deg(measurement))


class PlainTracks:
    """The plain targets of a flight through its n frames.

    Parameters
    ----------
    time_s : (n,) array
        Mid-exposures [s]; NaN: not known.
    """

    def __init__(self, targets: Sequence[PlainTarget], time_s: FloatArray) -> None:
        self._targets = targets
        self._found: dict[str, dict[int, _Place]] = {target.name: {} for target in targets}
        # if no frame has a time, their numbers serve as times
        in_order = np.arange(len(time_s), dtype=np.float64)
        self._time_s = time_s if np.isfinite(time_s).any() else in_order

    def add(self, row: int, result: FrameResult) -> None:
        """Add what was measured in a frame, given its row in `time_s`."""
        for outcome in result.outcomes:
            if isinstance(outcome, Measurement) and outcome.target in self._found:
                self._found[outcome.target][row] = _Place.of(outcome)

    def predictions(
        self, camera: Camera, wanted: Mapping[int, Collection[str]]
    ) -> Mapping[int, Predictions]:
        """Return predictions by row, for the targets wanted there that neighbours can predict."""
        predictions: dict[int, dict[str, PlainPrediction]] = {}
        for target in self._targets:
            found = self._found[target.name]
            if not found:
                continue
            rows = sorted(found.keys() | {row for row in wanted if target.name in wanted[row]})
            state = np.full((len(rows), 3), math.nan)
            for index, row in enumerate(rows):
                if row in found:
                    state[index] = found[row].state
            track = Track(self._time_s[rows], state)
            for row, place in zip(rows, interpolate(track, _MAX_GAP_INTERVALS), strict=True):
                if place is not None:
                    prediction = self._prediction(target, row, place, camera)
                    predictions.setdefault(row, {})[target.name] = prediction
        return predictions

    def _prediction(
        self, target: PlainTarget, row: int, place: InterpolatedState, camera: Camera
    ) -> PlainPrediction:
        """Return the prediction for an interpolated place, whose size is a distance."""
        distance_m = place.size
        sight = np.append(camera.undistort(place.centre_px[None])[0], 1.0)
        position_m = distance_m / float(np.linalg.norm(sight)) * sight
        return PlainPrediction(
            centre_px=place.centre_px,
            cov_px2=(place.sd_px**2 + _EXTRA_SD_PX**2) * np.eye(2),
            position_m=position_m,
            sd_log_distance=place.sd_log_size,
            normal=self._normal(target, row),
            radius_px=target.radii_m[0] * camera.mean_focal_px / distance_m,
            source=NEIGHBOURS,
        )

    def _normal(self, target: PlainTarget, row: int) -> NormalPrior | None:
        """Return the mean of the normals before and after; their angle adds to its uncertainty.

        None if the target's normal is unknown: either of the two may be the mirrored one.
        """
        if target.normal_enu is None:
            return None
        now, found = self._time_s[row], self._found[target.name]
        before = max((row for row in found if self._time_s[row] < now), key=self._frame_time_s)
        after = min((row for row in found if self._time_s[row] > now), key=self._frame_time_s)
        neighbours = found[before], found[after]
        first, second = (place.normal for place in neighbours)
        mean = (first + second) / np.linalg.norm(first + second)
        angle_deg = math.degrees(math.acos(min(1.0, float(first @ second))))
        sd_deg = max(place.sd_normal_deg for place in neighbours)
        return NormalPrior(mean, math.hypot(sd_deg, angle_deg, _EXTRA_SD_DEG))

    def _frame_time_s(self, row: int) -> float:
        return float(self._time_s[row])


def _sd_normal_deg(measurement: Measurement) -> float:
    """Return the standard deviation of a normal about its least certain axis [deg]."""
    if measurement.uncertainty is None:
        return 0.0
    axes: FloatArray = measurement.pose.rotation[:, :2]
    cov = axes.T @ measurement.uncertainty.pose_cov[3:, 3:] @ axes
    return math.degrees(math.sqrt(max(float(np.linalg.eigvalsh(cov)[-1]), 0.0)))
