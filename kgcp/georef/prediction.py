"""Prediction of a target's place in frames in which it was not found.

There are two sources: the frames before and after, and reference poses with the target's place.
Either is trusted as far as it agrees with the frames in which the target was found.
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

_MIN_FOUND = 4  # least number of frames with which the reference is compared
_MEDIAN_OF_2D = 1.1774  # of the distance from the centre of a normal distribution, in σ
_MEDIAN_OF_1D = 0.6745  # of the absolute value
_FLOOR_PX, _FLOOR_LOG = 0.5, 0.02  # least standard deviations of a prediction
_TRIPLES = 8  # of neighbours, nearest in time, from which the motion is estimated
_MIN_TRIPLES = 3
NEIGHBOURS = "its neighbours"
"""What a prediction by interpolation was made from."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One target through the frames of a flight, n of them in their order."""

    time_s: FloatArray  # (n,): mid-exposures [s]; NaN: not known
    # (n, 3): centre x, y [px] and logarithm of the radius [px], or of the distance [m] where only
    # `interpolate` sees it; NaN: not found
    state: FloatArray

    @property
    def is_found(self) -> BoolArray:
        """Whether the target was found in each frame (n,)."""
        return np.asarray(np.isfinite(self.state[:, 0]))


def state_of(observation: Measurement) -> FloatArray:
    """Return centre [px] and logarithm of the radius [px] of an observation (3,)."""
    return np.append(observation.centre_px, np.log(observation.appearance.radius_px))


def predict_position(track: Track, by_reference: FloatArray | None) -> list[Prediction | None]:
    """Return where a target must be in the n frames in which it was not found.

    The sources are the neighbouring frames and `by_reference` (n, 3), from `reference_states`; the
    more precise one counts. None where neither gives a prediction, and where the target was found.
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

    Their standard deviations are medians over the frames in which the target was found, so that a
    wrong frame does no harm; a bias counts as deviation. There is no prediction if fewer than four
    frames can be compared, or if most are off by more than a radius.
    """
    error = (track.state - predicted)[np.isfinite(track.state + predicted).all(axis=1)]
    if len(error) < _MIN_FOUND:
        return [None] * len(predicted)
    off_px = np.hypot(error[:, 0], error[:, 1])
    if np.median(off_px / np.exp(np.nanmedian(track.state[:, 2]))) > 1.0:
        return [None] * len(predicted)
    sd_px = max(float(np.median(off_px)) / _MEDIAN_OF_2D, _FLOOR_PX)
    sd_log = max(float(np.median(np.abs(error[:, 2]))) / _MEDIAN_OF_1D, _FLOOR_LOG)
    return [
        Prediction(state[:2], sd_px, float(np.exp(state[2])), sd_log, "the reference")
        if np.isfinite(state).all()
        else None
        for state in predicted
    ]


@dataclass(frozen=True, slots=True, eq=False)
class Interpolation:
    """A state between two frames, with standard deviations."""

    centre_px: FloatArray  # (2,): [px]
    sd_px: float  # of either coordinate [px]
    size: float  # radius or distance, whose logarithm the track has
    sd_log_size: float


def predict_between(track: Track) -> list[Prediction | None]:
    """Return the states of `interpolate` as predictions of a target's image."""
    return [
        None
        if between is None
        else Prediction(
            between.centre_px, between.sd_px, between.size, between.sd_log_size, NEIGHBOURS
        )
        for between in interpolate(track)
    ]


def interpolate(track: Track, longest_gap: float = np.inf) -> list[Interpolation | None]:
    """Interpolate between the frames before and after in which the target was found.

    Gaps of more than `longest_gap` times the usual interval between such frames nearby are left
    open.

    The target is taken to move on a straight line. An unknown acceleration α displaces it from that
    line by ½ α (τ − a)(b − τ) at a time τ between a and b. The mean square of α comes from the
    nearest triples of found frames: the outer two of each predict the middle one.
    """
    states: list[Interpolation | None] = [None] * len(track.time_s)
    found = np.flatnonzero(track.is_found & np.isfinite(track.time_s))
    found = found[np.unique(track.time_s[found], return_index=True)[1]]
    time, state = track.time_s[found], track.state[found]
    if len(time) < _MIN_TRIPLES + 2:
        return states
    middle, lever = _between(time[1:-1], time[:-2], time[2:], state[:-2], state[2:])
    acceleration2 = ((state[1:-1] - middle) / lever[:, None]) ** 2
    for index in np.flatnonzero(~track.is_found & np.isfinite(track.time_s)):
        now = track.time_s[index]
        after = int(np.searchsorted(time, now))
        if not 0 < after < len(time) or now == time[after]:
            continue
        before, later = slice(after - 1, after), slice(after, after + 1)
        state_now, arm = _between(
            track.time_s[index, None], time[before], time[later], state[before], state[later]
        )
        near = np.argsort(np.abs(time[1:-1] - now), kind="stable")[:_TRIPLES]
        usual_s = 0.5 * float(np.median(time[near + 2] - time[near]))
        if time[after] - time[after - 1] > longest_gap * usual_s:
            continue
        sd = arm[0] * np.sqrt(acceleration2[near].mean(axis=0))
        states[index] = Interpolation(
            state_now[0, :2],
            float(np.hypot(np.sqrt(0.5 * (sd[0] ** 2 + sd[1] ** 2)), _FLOOR_PX)),
            float(np.exp(state_now[0, 2])),
            float(np.hypot(sd[2], _FLOOR_LOG)),
        )
    return states


def _between(
    now: FloatArray, before: FloatArray, after: FloatArray, start: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return states (m, 3) on the line between two, and the factor (m,) of an acceleration."""
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
    """Return the states (n, 3) of a target by reference poses; NaN where they are not known.

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
