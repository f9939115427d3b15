"""Which of a plate's two possible normals agrees with the frames before and after.

For a camera that looks down at a plate on a roof, the normal changes little from frame to frame.
How little is estimated from the frames in which the image alone decides between the two normals.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.measurement.records import FrameResult, Measurement

_CLEAR_AMBIGUITY = 10.0  # least Δχ² by the image of frames that may decide for others
_MIN_PAIRS = 4  # of neighbours from which the difference of normals is estimated
_MAX_INTERVALS = 3.0  # largest interval between neighbours, in medians
_MEDIAN_OF_2D = 1.1774  # median distance from the centre of a 2-D normal distribution, in σ
_MIN_SD_DEG = 1.0  # of a normal against its neighbours

Place = tuple[str, str, int]
"""Frame, target and instance."""


@dataclass(frozen=True, slots=True, eq=False)
class _TimedMeasurement:
    place: Place
    time_s: float  # of the frame
    measurement: Measurement

    @property
    def ambiguity(self) -> float:
        """Δχ² by which the other normal is worse; infinite if there is none."""
        other = self.measurement.alternative
        return math.inf if other is None else other.ambiguity


def preferences_of_neighbours(results: Iterable[FrameResult]) -> Mapping[Place, float]:
    """Return Δχ² by which neighbouring frames make the other normal worse, for ambiguous normals.

    There is no entry where the image alone decides, or where neighbours are missing or too few.

    Parameters
    ----------
    results : iterable of FrameResult
        Of all frames, in any order.
    """
    tracks: dict[tuple[str, int], list[_TimedMeasurement]] = defaultdict(list)
    for result in results:
        for outcome in result.outcomes:
            if isinstance(outcome, Measurement) and result.time_s is not None:
                place = (result.frame, outcome.target, outcome.instance)
                tracks[place[1:]].append(_TimedMeasurement(place, result.time_s, outcome))
    preferences: dict[Place, float] = {}
    for track in tracks.values():
        preferences |= _preferences(sorted(track, key=lambda timed: (timed.time_s, timed.place)))
    return preferences


def _preferences(track: list[_TimedMeasurement]) -> dict[Place, float]:
    """Return the preferences for one target; its measurements are in the order of time."""
    clear = [timed for timed in track if timed.ambiguity >= _CLEAR_AMBIGUITY]
    if len(clear) <= _MIN_PAIRS:
        return {}
    times_s = np.array([timed.time_s for timed in clear])
    normals = np.array([timed.measurement.pose.normal for timed in clear])
    longest_s = _MAX_INTERVALS * float(np.median(np.diff(times_s)))
    is_near = np.diff(times_s) <= longest_s
    angles_deg = np.degrees(np.arccos(np.clip(np.sum(normals[1:] * normals[:-1], axis=1), -1, 1)))
    if is_near.sum() < _MIN_PAIRS:
        return {}
    sd_deg = max(float(np.median(angles_deg[is_near])) / _MEDIAN_OF_2D, _MIN_SD_DEG)
    preferences = {}
    for timed in track:
        measurement, other = timed.measurement, timed.measurement.alternative
        if other is None or other.ambiguity >= _CLEAR_AMBIGUITY or measurement.uncertainty is None:
            continue
        normal = _neighbours_normal(times_s, normals, timed.time_s, longest_s)
        if normal is not None:
            rotation_cov = measurement.uncertainty.pose_cov[3:, 3:]
            prior = NormalPrior(normal, sd_deg)
            preferences[timed.place] = prior.preference(measurement.pose, other.pose, rotation_cov)
    return preferences


def _neighbours_normal(
    times_s: FloatArray, normals: FloatArray, time_s: float, longest_s: float
) -> FloatArray | None:
    """Return the mean normal of the frames just before and after a time; None if both are far."""
    after = int(np.searchsorted(times_s, time_s))
    near = [
        index
        for index in (after - 1, after)
        if 0 <= index < len(times_s) and abs(times_s[index] - time_s) <= longest_s
    ]
    if not near:
        return None
    mean = normals[near].mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))
