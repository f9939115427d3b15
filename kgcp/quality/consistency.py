"""The target's places by its vehicle against those by the camera's reference poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition, TargetPositions
from kgcp.quality.consistency_equations import Meeting, System
from kgcp.quality.corrections import UNKNOWN_LIMITS, CorrectionEstimate, estimate_corrections
from kgcp.quality.robust_gls import ErrorModel, find_outliers, whitened_products
from kgcp.settings import VehicleSettings

LEAST_MEETINGS = 10
_CORRELATIONS_S = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
_FLOOR_M2 = 1e-12  # keeps a covariance that is zero along an axis invertible


@dataclass(frozen=True, slots=True, eq=False)
class Discrepancy:
    """Between the two places of a target in one frame."""

    # as in the sighting
    frame: str
    target: str
    time_s: float  # when the target's row was exposed, by the trajectory's clock, Unix UTC [s]
    # (3,): by the vehicle minus by the camera: along the track, across it to the right, up [m]
    offset_m: FloatArray
    # (3, 3): by all stated standard deviations but those that all frames share [m²]
    cov_m2: FloatArray
    residual_m: FloatArray  # (3,): what the corrections leave of the offset [m]
    is_outlier: bool  # whether it fits no correction and was left out


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """How well vehicle and camera agree."""

    discrepancies: tuple[Discrepancy, ...]  # ascending in time
    estimate: CorrectionEstimate  # corrections that explain them
    # over which the trajectory's errors seem to fade: the likeliest of a few times [s]
    correlation_s: float
    # how well flight.toml says that unknowns are known, by their names and in their units
    stated_sd: Mapping[str, float]


def study_consistency(
    sightings: Sequence[Sighting],
    target_positions: TargetPositions,
    poses: ReferencePoses,
    camera: Camera,
) -> Consistency | None:
    """Compare the places of the target on the vehicle with those that the camera gives it.

    By the vehicle: trajectory and lever arm. By the camera: reference pose and measured pose of
    the target, P = C + R(ENU ← camera) t, where a rolling shutter's camera has moved on, too.

    Parameters
    ----------
    sightings : sequence of Sighting
        Without a pose or a reference pose they are passed over, and so are static targets.

    Returns
    -------
    Consistency or None
        None with fewer than ten frames to compare, or that fit any correction.

    Raises
    ------
    KgcpError
        As `TargetPositions.positions`.
    """
    meetings = _meet(sightings, target_positions, poses, camera)
    if len(meetings) < LEAST_MEETINGS or target_positions.vehicle is None:
        return None
    orientations = ExteriorOrientations.of(poses, target_positions.local_frame)
    equations = System.of(
        meetings, orientations, poses, camera, target_positions.vehicle.settings.sd_time_s
    )
    outlier = find_outliers(
        -equations.design,
        equations.offset,
        equations.fading + equations.white,
        limits=UNKNOWN_LIMITS,
        least_scale=1.0,
    )
    if np.count_nonzero(~outlier) < LEAST_MEETINGS:
        return None
    fitted, correlation_s = _adjust(
        np.array([meeting.time_s for meeting in meetings]), equations, ~outlier
    )
    settings = target_positions.vehicle.settings
    return Consistency(
        _discrepancies(meetings, equations, outlier, fitted, settings.time_offset_s),
        fitted,
        correlation_s,
        _stated_sd(settings),
    )


def _stated_sd(settings: VehicleSettings) -> Mapping[str, float]:
    names = (f"lever_arm_{axis}_m" for axis in ("forward", "right", "down"))
    of_arm = dict(zip(names, settings.sd_lever_arm_m, strict=True))
    return {"time_offset_s": settings.sd_time_s, **of_arm}


def _adjust(
    time_s: FloatArray, equations: System, kept: BoolArray
) -> tuple[CorrectionEstimate, float]:
    """Return the corrections by the points that are kept, and the likeliest correlation time.

    A time that is believed but wrong would weigh neighbouring frames against each other as if
    their trajectory were far better, or worse, than it is.
    """
    columns = np.concatenate(
        (equations.design, equations.offset[:, :, None], equations.common[:, :, None]), axis=2
    )[kept]
    fading = equations.fading + _FLOOR_M2 * np.eye(3)
    errors = ErrorModel(equations.white, fading, time_s).kept(kept)
    trials = []
    for correlation_s in _CORRELATIONS_S:
        products, log_det = whitened_products(columns, errors, correlation_s)
        fitted = estimate_corrections(products, 3 * len(columns), has_sds=equations.has_sds)
        misfit = fitted.chi2_after
        if not equations.has_sds:  # the likeliest scale is part of the likelihood
            misfit = 3 * len(columns) * math.log(misfit)
        trials.append((misfit + log_det, correlation_s, fitted))
    _, correlation_s, fitted = min(trials, key=lambda trial: trial[0])
    return fitted, correlation_s


def _meet(
    sightings: Sequence[Sighting],
    target_positions: TargetPositions,
    poses: ReferencePoses,
    camera: Camera,
) -> list[Meeting]:
    """Return where moving targets were measured in frames with reference poses, by time."""
    rows = {frame: row for row, frame in enumerate(poses.frames)}
    moving = [
        sighting
        for sighting in sightings
        if not sighting.instance
        and sighting.target not in target_positions.static
        and sighting.frame in rows
    ]
    if not moving:
        return []
    times = [sighting.row_time_s(camera) for sighting in moving]
    positions = target_positions.positions([sighting.target for sighting in moving], times)
    meetings = [
        Meeting(
            sighting, sighting.pose, time_s, position, position.vehicle_state, rows[sighting.frame]
        )
        for sighting, time_s, position in zip(moving, times, positions, strict=True)
        if isinstance(position, TargetPosition)
        and position.vehicle_state
        and sighting.pose
        and time_s is not None
    ]
    return sorted(meetings, key=lambda meeting: (meeting.time_s, meeting.sighting.frame))


def _discrepancies(
    meetings: Sequence[Meeting],
    equations: System,
    outlier: BoolArray,
    fitted: CorrectionEstimate,
    time_offset_s: float,
) -> tuple[Discrepancy, ...]:
    """Return what images and poses are apart by, before and after the corrections."""
    residual = equations.offset + equations.design @ fitted.values
    track = equations.track
    cov = track @ (equations.fading + equations.white) @ np.swapaxes(track, 1, 2)
    offset_m = np.einsum("nij,nj->ni", track, equations.offset)
    residual_m = np.einsum("nij,nj->ni", track, residual)
    return tuple(
        Discrepancy(
            meeting.sighting.frame,
            meeting.sighting.target,
            meeting.time_s + time_offset_s,
            offset_m[index],
            cov[index],
            residual_m[index],
            bool(outlier[index]),
        )
        for index, meeting in enumerate(meetings)
    )
