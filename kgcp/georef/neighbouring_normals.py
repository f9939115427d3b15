"""Which of a plate's two normals the frames before and after make the likelier one.

For a camera that looks down at a plate on a roof, the normal changes little from frame to frame.
The frames whose image alone decides between the two show how little.
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

_SURE = 10.0  # Δχ² of the image above which one frame may decide for another
_FEWEST = 4  # pairs of neighbours from which the difference of normals is estimated
_FARTHEST = 3.0  # times the usual interval between neighbours
_MEDIAN_OF_2D = 1.1774  # of the distance from the centre of a normal distribution, in σ
_LEAST_SD_DEG = 1.0

Place = tuple[str, str, int]
"""Frame, target and instance."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    place: Place
    time_s: float
    measurement: Measurement

    @property
    def ambiguity(self) -> float:
        """Δχ² by which the other normal is worse; infinite without another."""
        other = self.measurement.alternative
        return math.inf if other is None else other.ambiguity


def preferences_of_neighbours(results: Iterable[FrameResult]) -> Mapping[Place, float]:
    """Return by how much more χ² the other normal has, for normals of which the image is not sure.

    Where no neighbours tell, or not enough, there is no entry.

    Parameters
    ----------
    results : iterable of FrameResult
        Of all frames. Their order does not matter.
    """
    tracks: dict[tuple[str, int], list[_Seen]] = defaultdict(list)
    for result in results:
        for outcome in result.outcomes:
            if isinstance(outcome, Measurement) and result.time_s is not None:
                place = (result.frame, outcome.target, outcome.instance)
                tracks[place[1:]].append(_Seen(place, result.time_s, outcome))
    preferences: dict[Place, float] = {}
    for track in tracks.values():
        preferences |= _preferences(sorted(track, key=lambda seen: (seen.time_s, seen.place)))
    return preferences


def _preferences(track: list[_Seen]) -> dict[Place, float]:
    """Return the preferences in the frames of one target, in the order of time."""
    sure = [seen for seen in track if seen.ambiguity >= _SURE]
    if len(sure) <= _FEWEST:
        return {}
    times_s = np.array([seen.time_s for seen in sure])
    normals = np.array([seen.measurement.pose.normal for seen in sure])
    longest_s = _FARTHEST * float(np.median(np.diff(times_s)))
    is_near = np.diff(times_s) <= longest_s
    angles_deg = np.degrees(np.arccos(np.clip(np.sum(normals[1:] * normals[:-1], axis=1), -1, 1)))
    if is_near.sum() < _FEWEST:
        return {}
    sd_deg = max(float(np.median(angles_deg[is_near])) / _MEDIAN_OF_2D, _LEAST_SD_DEG)
    preferences = {}
    for seen in track:
        measurement, other = seen.measurement, seen.measurement.alternative
        if other is None or other.ambiguity >= _SURE or measurement.uncertainty is None:
            continue
        direction = _direction(times_s, normals, seen.time_s, longest_s)
        if direction is not None:
            rotation_cov = measurement.uncertainty.pose_cov[3:, 3:]
            prior = NormalPrior(direction, sd_deg)
            preferences[seen.place] = prior.preference(measurement.pose, other.pose, rotation_cov)
    return preferences


def _direction(
    times_s: FloatArray, normals: FloatArray, time_s: float, longest_s: float
) -> FloatArray | None:
    """Return the mean normal of the frames just before and after a moment; None if all are far."""
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
