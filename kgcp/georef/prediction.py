"""Prediction of a target's image in frames in which it was not found.

There are two sources: the frames before and after, and reference poses with the target's position.
The standard deviations of both are estimated from the frames in which the target was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations, visible_pixel
from kgcp.georef.target_positions import TargetPosition, TargetPositions
from kgcp.measurement.guided import Prediction
from kgcp.measurement.records import Measurement
from kgcp.targets.plain import AnyTarget

_MIN_COMPARED = 4  # least number of frames with which the reference is compared
_MEDIAN_OF_2D = 1.1774  # median distance from the centre of a 2-D normal distribution, in σ
_MEDIAN_OF_1D = 0.6745  # median absolute value of a normal distribution, in σ
_MIN_SD_PX, _MIN_SD_LOG = 0.5, 0.02  # of a prediction: centre, logarithm of radius or distance
_MAX_TRIPLES = 8  # of frames, nearest in time, from which the acceleration is estimated
_MIN_TRIPLES = 3
NEIGHBOURS = "its neighbours"
"""Source of predictions by interpolation."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One target in n frames of a flight, in the order of the frames."""

    time_s: FloatArray  # (n,): mid-exposures [s]; NaN: not known
    # (n, 3): centre x, y [px] and logarithm of the radius [px]; for `interpolate` it may be the
    # logarithm of the distance [m] instead. NaN: not found
    state: FloatArray

    @property
    def is_found(self) -> BoolArray:
        """Whether the target was found in each frame (n,)."""
        return np.asarray(np.isfinite(self.state[:, 0]))


def state_of(observation: Measurement) -> FloatArray:
    """Return centre [px] and logarithm of the radius [px] of an observation (3,)."""
    return np.append(observation.centre_px, np.log(observation.appearance.radius_px))


def predict_position(track: Track, by_reference: FloatArray | None) -> list[Prediction | None]:
    """Predict a target in those of n frames in which it was not found.

    The sources are the neighbouring frames and `by_reference` (n, 3), from `reference_states`; the
    more precise prediction is used. None where the target was found, and where neither source
    gives a prediction.
    """
    sources = [predict_between(track)]
    if by_reference is not None:
        sources.append(predict_by_reference(track, by_reference))
    return [
        min(
            (option for option in options if option is not None and not found),
            key=lambda option: option.sd_px,
            default=None,
        )
        for found, options in zip(track.is_found, zip(*sources, strict=True), strict=True)
    ]


def predict_by_reference(track: Track, predicted: FloatArray) -> list[Prediction | None]:
    """Turn states (n, 3) by the reference into predictions.

    Their standard deviations come from the median differences in the frames in which the target was
    found, so that a wrong frame does no harm. A bias is included. There are no predictions if fewer
    than four frames can be compared, or if the median difference is more than a radius.
    """
    error = (track.state - predicted)[np.isfinite(track.state + predicted).all(axis=1)]
    if len(error) < _MIN_COMPARED:
        return [None] * len(predicted)
    off_px = np.hypot(error[:, 0], error[:, 1])
    if np.median(off_px / np.exp(np.nanmedian(track.state[:, 2]))) > 1.0:
        return [None] * len(predicted)
    sd_px = max(float(np.median(off_px)) / _MEDIAN_OF_2D, _MIN_SD_PX)
    sd_log = max(float(np.median(np.abs(error[:, 2]))) / _MEDIAN_OF_1D, _MIN_SD_LOG)
    return [
        Prediction(state[:2], sd_px, float(np.exp(state[2])), sd_log, "the reference")
        if np.isfinite(state).all()
        else None
        for state in predicted
    ]


@dataclass(frozen=True, slots=True, eq=False)
class InterpolatedState:
    """A target's state between two frames, with standard deviations."""

    centre_px: FloatArray  # (2,): [px]
    sd_px: float  # of either coordinate [px]
    size: float  # radius [px] or distance [m], whichever the track has
    sd_log_size: float


def predict_between(track: Track) -> list[Prediction | None]:
    """Return the states of `interpolate` as predictions of a target's image."""
    return [
        None
        if state is None
        else Prediction(state.centre_px, state.sd_px, state.size, state.sd_log_size, NEIGHBOURS)
        for state in interpolate(track)
    ]


def interpolate(track: Track, max_gap_intervals: float = np.inf) -> list[InterpolatedState | None]:
    """Interpolate between the frames before and after in which the target was found.

    There is no state in gaps of more than `max_gap_intervals` times the usual interval between such
    frames nearby.

    The target is assumed to move on a straight line. An unknown acceleration α displaces it from
    that line by ½ α (τ − a)(b − τ) at a time τ between a and b. The mean square of α is estimated
    from the nearest triples of frames with the target: the outer two of each predict the middle
    one.
    """
    states: list[InterpolatedState | None] = [None] * len(track.time_s)
    found = np.flatnonzero(track.is_found & np.isfinite(track.time_s))
    found = found[np.unique(track.time_s[found], return_index=True)[1]]
    time, state = track.time_s[found], track.state[found]
    if len(time) < _MIN_TRIPLES + 2:
        return states
    middle, factor = _between(time[1:-1], time[:-2], time[2:], state[:-2], state[2:])
    acceleration2 = ((state[1:-1] - middle) / factor[:, None]) ** 2
    for index in np.flatnonzero(~track.is_found & np.isfinite(track.time_s)):
        now = track.time_s[index]
        after = int(np.searchsorted(time, now))
        if not 0 < after < len(time) or now == time[after]:
            continue
        before, later = slice(after - 1, after), slice(after, after + 1)
        state_now, factor_now = _between(
            track.time_s[index, None], time[before], time[later], state[before], state[later]
        )
        near = np.argsort(np.abs(time[1:-1] - now), kind="stable")[:_MAX_TRIPLES]
        usual_s = 0.5 * float(np.median(time[near + 2] - time[near]))
        if time[after] - time[after - 1] > max_gap_intervals * usual_s:
            continue
        sd = factor_now[0] * np.sqrt(acceleration2[near].mean(axis=0))
        states[index] = InterpolatedState(
            state_now[0, :2],
            float(np.hypot(np.sqrt(0.5 * (sd[0] ** 2 + sd[1] ** 2)), _MIN_SD_PX)),
            float(np.exp(state_now[0, 2])),
            float(np.hypot(sd[2], _MIN_SD_LOG)),
        )
    return states


def _between(
    now: FloatArray, before: FloatArray, after: FloatArray, start: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return states (m, 3) on the line between two, and the factors (m,) of the acceleration."""
    share = (now - before) / (after - before)
    return start + share[:, None] * (end - start), 0.5 * (now - before) * (after - now)


def reference_states(
    frames: Sequence[str],
    time_s: Sequence[float | None],
    target: AnyTarget,
    poses: ReferencePoses,
    target_positions: TargetPositions,
    camera: Camera,
) -> FloatArray:
    """Return the states (n, 3) of a target by reference poses, as in `Track`; NaN: not known.

    Raises
    ------
    KgcpError
        As `TargetPositions.positions`.
    """
    rows: Mapping[str, int] = {frame: row for row, frame in enumerate(poses.frames)}
    orientations = ExteriorOrientations.of(poses, target_positions.local_frame)
    states = np.full((len(frames), 3), np.nan)
    posed = [index for index, frame in enumerate(frames) if frame in rows]
    positions = target_positions.positions(
        [target.name] * len(posed), [time_s[index] for index in posed]
    )
    for index, position in zip(posed, positions, strict=True):
        if isinstance(position, TargetPosition):
            row = rows[frames[index]]
            sight = position.position_m - orientations.centre_m[row]
            radius_px = 0.5 * target.outer_diameter_m * camera.mean_focal_px
            states[index, :2] = visible_pixel(camera, sight @ orientations.enu_from_camera[row])
            states[index, 2] = np.log(radius_px / np.linalg.norm(sight))
    return states
