"""Comparison of the target's positions by the vehicle with those by the camera's poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Sighting, unmistakable
from kgcp.georef.target_positions import TargetPosition, TargetPositions
from kgcp.quality.consistency_equations import ComparedFrame, ConsistencyEquations
from kgcp.quality.corrections import (
    MAX_VARIANCE_FACTOR,
    READOUT,
    UNKNOWN_LIMITS,
    CorrectionEstimate,
    estimate_corrections,
)
from kgcp.quality.robust_gls import (
    ErrorModel,
    find_outliers,
    whitened_products,
    with_shared_errors,
)
from kgcp.settings import VehicleSettings

MIN_FRAMES = 10
_CORRELATION_TIMES_S = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
# Readouts that are tried: sizes of images depend on them too unevenly for one step from the stated
# one [s].
_READOUTS_S = tuple((0.0075 * np.arange(-8, 9)).tolist())
_READOUT_STEPS = 2
_MAX_SEARCHED = 60  # frames in which they are: the search was tried on flights of 20 and 60
# Least gain in −2 log likelihood by the sizes of the images; chance gains as much in one of 1000
# flights.
_MIN_GAIN = 10.8
_REGULARISATION_M2 = 1e-12  # keeps a covariance that is zero along an axis invertible


@dataclass(frozen=True, slots=True, eq=False)
class Discrepancy:
    """Difference between the two positions of a target in one frame."""

    # as in the sighting
    frame: str
    target: str
    time_s: float  # when the target's row was exposed, by the trajectory's clock, Unix UTC [s]
    # (3,): position by the vehicle minus position by the camera, along the track, across it to the
    # right, and up [m]
    offset_m: FloatArray
    # (3, 3): by all stated standard deviations except those of errors that all frames share [m²]
    cov_m2: FloatArray
    residual_m: FloatArray  # (3,): offset after the corrections [m]
    is_outlier: bool  # whether it was left out of the adjustment


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """Agreement of vehicle and camera."""

    discrepancies: tuple[Discrepancy, ...]  # ascending in time
    estimate: CorrectionEstimate  # corrections that explain them
    # correlation time of the trajectory's errors, the likeliest of `_CORRELATION_TIMES_S` [s]
    correlation_s: float
    # standard deviations by flight.toml, by the names of the unknowns and in their units
    stated_sd: Mapping[str, float]


def study_consistency(
    sightings: Sequence[Sighting],
    target_positions: TargetPositions,
    poses: ReferencePoses,
    camera: Camera,
    motions: CameraMotions | None = None,
) -> Consistency | None:
    """Compare the target's positions by the vehicle with those by the camera.

    The first follow from trajectory and lever arm. The others follow from the reference pose of the
    camera and the measured pose of the target, P = C + R(ENU ← camera) t. With a rolling shutter, C
    and R include the camera's motion until the target's row is exposed.

    Parameters
    ----------
    sightings : sequence of Sighting
        Those of static targets, and those without a pose or a reference pose, are not used.
    motions : CameraMotions, optional
        For a rolling shutter: motion of the camera at each reference pose.

    Returns
    -------
    Consistency or None
        None if fewer than ten frames can be compared, or if fewer than ten are no outliers.

    Raises
    ------
    KgcpError
        As `TargetPositions.positions`.
    """
    frames = _compared_frames(sightings, target_positions, poses, camera)
    if len(frames) < MIN_FRAMES or target_positions.vehicle is None:
        return None
    orientations = ExteriorOrientations.of(poses, target_positions.local_frame)
    equations = ConsistencyEquations.of(
        frames, orientations, camera, target_positions.vehicle.settings.sd_time_s, motions
    )
    adjusted = _robustly_adjusted(frames, equations)
    if adjusted is None:
        return None
    if _may_have_other_readout(adjusted.estimate):
        adjusted = _with_other_readout(frames, adjusted, camera) or adjusted
    settings = target_positions.vehicle.settings
    return Consistency(
        _discrepancies(frames, equations, adjusted, settings.time_offset_s),
        adjusted.estimate,
        adjusted.correlation_s,
        _stated_sd(settings, [frame.sighting for frame in frames]),
    )


def _stated_sd(settings: VehicleSettings, sightings: Sequence[Sighting]) -> Mapping[str, float]:
    share = median((one.sd_common_distance_m or 0.0) / one.distance_m for one in sightings)
    names = (f"lever_arm_{axis}_m" for axis in ("forward", "right", "down"))
    of_arm = dict(zip(names, settings.sd_lever_arm_m, strict=True))
    of_scale = dict.fromkeys(("diameter_percent", "focal_length_percent"), 100.0 * share)
    return {"time_offset_s": settings.sd_time_s, **of_arm, **of_scale}


@dataclass(frozen=True, slots=True, eq=False)
class _Adjusted:
    """Equations, and the corrections that fit them."""

    equations: ConsistencyEquations
    outlier: BoolArray  # (n,): frames that were left out
    estimate: CorrectionEstimate
    correlation_s: float  # the likeliest
    misfit: float  # −2 log likelihood, but for a constant

    @property
    def residual_m(self) -> FloatArray:
        """Offsets (n, 3) after the corrections, in ENU axes [m]."""
        return np.asarray(self.equations.offset + self.equations.design @ self.estimate.values)


def _robustly_adjusted(
    frames: Sequence[ComparedFrame], equations: ConsistencyEquations, readout_s: float = 0.0
) -> _Adjusted | None:
    """Adjust without outliers; None: too few frames are left."""
    outlier = find_outliers(
        -equations.design,
        equations.offset,
        equations.correlated + equations.independent,
        limits=UNKNOWN_LIMITS,
        min_scale=1.0,
    )
    if np.count_nonzero(~outlier) < MIN_FRAMES:
        return None
    return _adjusted(frames, equations, outlier, readout_s)


def _adjusted(
    frames: Sequence[ComparedFrame],
    equations: ConsistencyEquations,
    outlier: BoolArray,
    readout_s: float = 0.0,
) -> _Adjusted:
    """Adjust with the likeliest correlation time of the trajectory's errors.

    The time is estimated, not assumed. A wrong one would weight neighbouring frames as if their
    trajectory were far better, or far worse, than it is.

    Parameters
    ----------
    readout_s : float
        Correction of the readout that the equations already include.
    """
    columns = np.concatenate(
        (
            equations.design,
            equations.offset[:, :, None],
            equations.common[:, :, None],
            equations.shared,
        ),
        axis=2,
    )[~outlier]
    correlated = equations.correlated + _REGULARISATION_M2 * np.eye(3)
    time_s = np.array([frame.time_s for frame in frames])
    errors = ErrorModel(equations.independent, correlated, time_s).kept(~outlier)
    trials = []
    for correlation_s in _CORRELATION_TIMES_S:
        products, log_det = with_shared_errors(
            *whitened_products(columns, errors, correlation_s), equations.shared.shape[2]
        )
        fitted = estimate_corrections(
            products, 3 * len(columns), has_sds=equations.has_sds, readout_s=readout_s
        )
        misfit = fitted.chi2_after
        if not equations.has_sds:  # likelihood with the likeliest scale of all variances
            misfit = 3 * len(columns) * math.log(misfit)
        trials.append((misfit + log_det, correlation_s, fitted))
    misfit, correlation_s, fitted = min(trials, key=lambda trial: trial[0])
    return _Adjusted(equations, outlier, fitted, correlation_s, misfit)


def _may_have_other_readout(estimate: CorrectionEstimate) -> bool:
    """Tell whether a readout is worth a search: something is wrong, and it may be the readout."""
    is_wrong = any(correction.is_significant for correction in estimate.corrections)
    is_wrong = is_wrong or estimate.variance_factor > MAX_VARIANCE_FACTOR
    return is_wrong and estimate.corrections[READOUT].value is not None


def _with_other_readout(
    frames: Sequence[ComparedFrame], first: _Adjusted, camera: Camera
) -> _Adjusted | None:
    """Return the corrections with another readout that explains also the sizes of the images.

    None: it explains no more than corrections which leave the sizes as they were measured.
    """
    kept = np.flatnonzero(~first.outlier)
    few = kept[:: max(1, len(kept) // _MAX_SEARCHED)]
    others = np.ones(len(frames), dtype=np.bool_)
    others[few] = False

    def at(excess_s: Sequence[float]) -> list[_Adjusted]:
        moved = first.equations.at_readouts(frames, camera, np.array(excess_s), few)
        return [
            _adjusted(frames, each, others, by_s)
            for each, by_s in zip(moved, excess_s, strict=True)
        ]

    best = min(at([each - camera.readout_s for each in _READOUTS_S]), key=lambda each: each.misfit)
    for _ in range(_READOUT_STEPS):
        value = best.estimate.corrections[READOUT].value
        if value is None or abs(value) > UNKNOWN_LIMITS[READOUT]:
            return None
        best = min(best, *at([value]), key=lambda each: each.misfit)
    value = best.estimate.corrections[READOUT].value
    gain = _adjusted(frames, first.equations, others).misfit - best.misfit
    scale = best.estimate.variance_factor if first.equations.has_sds else 1.0
    if value is None or gain < _MIN_GAIN * max(1.0, scale):
        return None
    everywhere = np.arange(len(frames))
    (moved,) = first.equations.at_readouts(frames, camera, np.array([value]), everywhere)
    found = _robustly_adjusted(frames, moved, value)
    if (
        found is None
        or not found.estimate.corrections[READOUT].is_significant
        or found.estimate.variance_factor > MAX_VARIANCE_FACTOR
    ):
        return None
    before = first.estimate.chi2_before
    return replace(found, estimate=replace(found.estimate, chi2_before=before))


def _compared_frames(
    sightings: Sequence[Sighting],
    target_positions: TargetPositions,
    poses: ReferencePoses,
    camera: Camera,
) -> list[ComparedFrame]:
    """Return the frames with reference poses in which a moving target was measured, by time."""
    rows = {frame: row for row, frame in enumerate(poses.frames)}
    moving = [
        sighting
        for sighting in unmistakable(sightings)
        if sighting.target not in target_positions.static and sighting.frame in rows
    ]
    if not moving:
        return []
    times = [sighting.row_time_s(camera) for sighting in moving]
    positions = target_positions.positions([sighting.target for sighting in moving], times)
    frames = [
        ComparedFrame(
            sighting, sighting.pose, time_s, position, position.vehicle_state, rows[sighting.frame]
        )
        for sighting, time_s, position in zip(moving, times, positions, strict=True)
        if isinstance(position, TargetPosition)
        and position.vehicle_state
        and sighting.pose
        and time_s is not None
    ]
    return sorted(frames, key=lambda frame: (frame.time_s, frame.sighting.frame))


def _discrepancies(
    frames: Sequence[ComparedFrame],
    equations: ConsistencyEquations,
    adjusted: _Adjusted,
    time_offset_s: float,
) -> tuple[Discrepancy, ...]:
    """Return the discrepancies before and after the corrections."""
    track = equations.track
    cov = track @ (equations.correlated + equations.independent) @ np.swapaxes(track, 1, 2)
    offset_m = np.einsum("nij,nj->ni", track, equations.offset)
    residual_m = np.einsum("nij,nj->ni", track, adjusted.residual_m)
    return tuple(
        Discrepancy(
            frame.sighting.frame,
            frame.sighting.target,
            frame.time_s + time_offset_s,
            offset_m[index],
            cov[index],
            residual_m[index],
            bool(adjusted.outlier[index]),
        )
        for index, frame in enumerate(frames)
    )
