"""Where plain targets must be in a frame, as the frames before and after it show them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.plain_prediction import Predictions
from kgcp.georef.prediction import NEIGHBOURS, Interpolation, Track, interpolate
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.measurement.records import FrameResult, Measurement
from kgcp.targets.plain import PlainTarget

# Image places are interpolated only over gaps not much longer than those from which the motion is
# known: the camera may turn round meanwhile.
_LONGEST_GAP = 4.0
_FLOOR_PX, _FLOOR_DEG = 1.0, 2.0  # least standard deviations, whatever neighbours agree on


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Where a target is in a frame, and how it lies: what other frames need of a measurement."""

    state: FloatArray  # (3,): centre x, y [px] and logarithm of the distance [m]
    normal: FloatArray  # (3,): in the camera frame
    sd_normal_deg: float

    @classmethod
    def of(cls, measurement: Measurement) -> Self:
        """Take it from a measurement."""
        state = np.append(measurement.centre_px, math.log(measurement.distance_m))
        # copies: views would keep what they are views of
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
        # without any times, the order of the frames replaces them
        in_order = np.arange(len(time_s), dtype=np.float64)
        self._time_s = time_s if np.isfinite(time_s).any() else in_order

    def add(self, row: int, result: FrameResult) -> None:
        """Take what was measured in a frame."""
        for outcome in result.outcomes:
            if isinstance(outcome, Measurement) and outcome.target in self._found:
                self._found[outcome.target][row] = _Place.of(outcome)

    def predictions(
        self, camera: Camera, wanted: Mapping[int, Collection[str]]
    ) -> Mapping[int, Predictions]:
        """Return by row where the targets wanted in it must be, as far as neighbours show it."""
        made: dict[int, dict[str, PlainPrediction]] = {}
        for target in self._targets:
            found = self._found[target.name]
            if not found:
                continue
            rows = sorted(found.keys() | {row for row in wanted if target.name in wanted[row]})
            state = np.full((len(rows), 3), math.nan)
            for at, row in enumerate(rows):
                if row in found:
                    state[at] = found[row].state
            track = Track(self._time_s[rows], state)
            for row, between in zip(rows, interpolate(track, _LONGEST_GAP), strict=True):
                if between is not None:
                    prediction = self._prediction(target, row, between, camera)
                    made.setdefault(row, {})[target.name] = prediction
        return made

    def _prediction(
        self, target: PlainTarget, row: int, between: Interpolation, camera: Camera
    ) -> PlainPrediction:
        """Return the prediction for an interpolated place; its size is the distance."""
        distance_m = between.size
        sight = np.append(camera.undistort(between.centre_px[None])[0], 1.0)
        position_m = distance_m / float(np.linalg.norm(sight)) * sight
        return PlainPrediction(
            centre_px=between.centre_px,
            cov_px2=(between.sd_px**2 + _FLOOR_PX**2) * np.eye(2),
            position_m=position_m,
            sd_log_distance=between.sd_log_size,
            normal=self._normal(target, row),
            radius_px=target.radii_m[0] * camera.mean_focal_px / distance_m,
            source=NEIGHBOURS,
        )

    def _normal(self, target: PlainTarget, row: int) -> NormalPrior | None:
        """Return the mean of the normals before and after, uncertain by their difference as well.

        None if the target's normal is free: each of the two may be the mirrored one.
        """
        if target.normal_enu is None:
            return None
        now, found = self._time_s[row], self._found[target.name]
        before = max((each for each in found if self._time_s[each] < now), key=self._frame_time_s)
        after = min((each for each in found if self._time_s[each] > now), key=self._frame_time_s)
        both = found[before], found[after]
        first, second = (place.normal for place in both)
        mean = (first + second) / np.linalg.norm(first + second)
        apart_deg = math.degrees(math.acos(min(1.0, float(first @ second))))
        sd_deg = max(place.sd_normal_deg for place in both)
        return NormalPrior(mean, math.hypot(sd_deg, apart_deg, _FLOOR_DEG))

    def _frame_time_s(self, row: int) -> float:
        return float(self._time_s[row])


def _sd_normal_deg(measurement: Measurement) -> float:
    """Return the standard deviation of a normal about the axis about which it is worst."""
    if measurement.uncertainty is None:
        return 0.0
    axes: FloatArray = measurement.pose.rotation[:, :2]
    cov = axes.T @ measurement.uncertainty.pose_cov[3:, 3:] @ axes
    return math.degrees(math.sqrt(max(float(np.linalg.eigvalsh(cov)[-1]), 0.0)))
