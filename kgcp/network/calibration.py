"""A camera from photographs of a field: start, lens model, shape of the field, covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.circle_image import Circles3D, circle_images, plane_axes
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    NamedView,
    PointModel,
    rms_px,
)
from kgcp.network.camera_network import (
    CENTRE_DETERMINED,
    AdjustedNetwork,
    CalibrationProblem,
    NetworkUnknowns,
)
from kgcp.network.covariance import precision, tangled
from kgcp.network.field_turns import with_turns
from kgcp.network.parameter_choice import (
    DETERMINED,
    with_all_terms,
    with_chosen_parameters,
)
from kgcp.network.photographs_apart import photographs_apart, without
from kgcp.network.space_start import start_in_space
from kgcp.network.start import better_poses, homography_misfits, start_camera_and_poses
from kgcp.targets.fields.points import AnyField

LEAST_VIEWS = 3
# Parameters are tangled if correlation inflates the variance of one of them by more than this
# factor, that is its standard deviation tenfold.
_MAX_INFLATION = 100.0
_MIN_SHARE = 0.6  # share of a photograph's discs that must fit
_MARGIN_PX = 2.0  # between the frame's edge and a missing disc that is worth searching for
_MAX_MISFIT = 0.1  # RMS of a photograph's homography, relative to the spread of its discs


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """The adjustment with the parameters that are worth estimating."""

    problem: CalibrationProblem  # discs are renamed where a symmetric field lies turned
    state: AdjustedNetwork
    fixed: AdjustedNetwork  # the same with the field as stated
    points: PointModel
    # If it is not clear how a symmetric field lies in some photographs: the adjustment of its shape
    # with the discs renamed. The above are then for the field as stated.
    unclear: tuple[CalibrationProblem, AdjustedNetwork] | None = None


def missing_discs(calibration: CameraCalibration) -> dict[str, tuple[IndexArray, FloatArray]]:
    """Return the discs that must be visible in a photograph but were not measured.

    Returns
    -------
    dict
        For every photograph: indices of the field's discs (k,), and expected centroids and moments
        (k, 5) of their images.
    """
    field, camera = calibration.field, calibration.camera
    estimate = calibration.solution.estimate
    missing = {}
    for index, view in enumerate(calibration.views):
        point = np.setdiff1d(np.arange(len(estimate.points)), view.point)
        rotation, translation = estimate.rotations[index], estimate.translations[index]
        centres = estimate.points[point] @ rotation.T + translation
        axes = rotation @ plane_axes(field.normals()[point])
        images = circle_images(camera, Circles3D(centres, axes, field.radii_m()[point]))
        low, high = images.outlines_px.min(axis=1), images.outlines_px.max(axis=1)
        size = np.array([camera.width, camera.height])
        is_inside = np.all((low > _MARGIN_PX) & (high < size - 1 - _MARGIN_PX), axis=1)
        missing[view.photo] = (point[is_inside], images.moments[is_inside])
    return missing


def calibrate_camera(
    views: Sequence[NamedView],
    field: AnyField,
    size: tuple[int, int],
    settings: CalibrationSettings,
    start: CameraCalibration | None = None,
) -> CameraCalibration:
    """Return the camera that took the photographs.

    The field is first held at its stated coordinates, then made stiff or free as the settings ask.
    Both possible poses of a planar field are tried. Centroids are corrected for eccentricity,
    rigorously including distortion, until the correction settles.

    Parameters
    ----------
    size : tuple of int
        Width and height of the photographs [px].
    start : CameraCalibration, optional
        An earlier calibration from the same photographs.

    Raises
    ------
    KgcpError
        If fewer than three photographs show the field, or they do not determine the camera.
    """
    _require_views(views)
    try:
        return _calibrated(CalibrationProblem(tuple(views), field, size, settings), start)
    except np.linalg.LinAlgError as error:
        raise KgcpError(
            "the photographs do not determine a camera, however its parameters are limited; tilt"
            " the field by 25° to 40° about both axes, or correct its description"
        ) from error


def _calibrated(problem: CalibrationProblem, start: CameraCalibration | None) -> CameraCalibration:
    """Calibrate without approximate values, or from an earlier calibration."""
    field = problem.field
    if start is not None:
        problem = replace(problem, field=start.field)
    points = field.points_m()
    # an earlier calibration has already dropped disordered photographs
    disordered = () if start is not None else _disordered(problem)
    problem = replace(problem, views=tuple(v for v in problem.views if v.photo not in disordered))
    _require_views(problem.views, disordered)
    observations = problem.observations()
    unknowns = NetworkUnknowns(PointModel.FIXED, ("k1", "k2"), is_same_aspect=True)
    if start is None:
        start_from = start_camera_and_poses if field.starts_from_homographies else start_in_space
        camera, estimate = start_from(observations, points, problem.size)
        state = problem.adjusted(camera, estimate, replace(unknowns, terms=()))
        for terms in (("k1",), ("k1", "k2")):
            state = problem.with_unknowns(state, replace(unknowns, terms=terms))
    else:
        problem = replace(
            problem, views=tuple(v for v in problem.views if v.photo not in start.dropped)
        )
        estimate = replace(start.solution.estimate, points=points)  # at their stated coordinates
        state = problem.adjusted(start.camera, estimate, unknowns)
    state = _with_better_twins(problem, state)
    if not field.is_diameter_stated and start is None:
        problem = replace(problem, field=field.with_diameters(problem.radius_scale(state)))
        state = problem.with_estimate(state, state.estimate)
    problem, state, misfits = _without_misfits(problem, state)
    dropped = (*disordered, *(() if start is None else start.dropped), *misfits)
    _require_views(problem.views)
    chosen = _chosen(problem, state)
    # errors of the field as stated would hide that a photograph stands apart
    apart = photographs_apart(*(chosen.unclear or (chosen.problem, chosen.state)))
    if apart:
        is_apart = np.array([view.photo in apart for view in problem.views])
        others = _chosen(*without(problem, state, is_apart))
        if chosen.unclear and others.unclear:
            apart = ()
        else:
            chosen = others
    chosen = _with_bends(chosen)
    chosen = replace(chosen, state=with_all_terms(chosen.problem, chosen.state))
    return _result(chosen, tuple(dict.fromkeys((*dropped, *apart))))


def _chosen(problem: CalibrationProblem, state: AdjustedNetwork) -> _Chosen:
    """Choose the parameters, starting from an adjustment with the field as stated."""
    fixed = with_chosen_parameters(problem, state)
    points = problem.settings.points
    if points is PointModel.FIXED:
        return _Chosen(problem, fixed, fixed, points)
    # k1 and k2 alone until the field has its true shape: more terms would absorb its errors
    state = problem.adjusted(state.camera, state.estimate, replace(state.unknowns, points=points))
    if any(view.is_symmetric for view in problem.views):
        turned, state, is_unclear = with_turns(problem, state)
        if is_unclear:
            return _Chosen(problem, fixed, fixed, PointModel.FIXED, (turned, state))
        problem = turned
    return _Chosen(problem, with_chosen_parameters(problem, state), fixed, points)


def _with_bends(chosen: _Chosen) -> _Chosen:
    """Let the field bend differently in every photograph, if the residuals show that it does.

    This comes last, because a photograph with a much larger bend must be left out before.
    """
    problem = chosen.problem
    bent = problem.bent(chosen.state)
    if bent.network.bends is None:
        return chosen
    return replace(chosen, state=with_chosen_parameters(problem, bent))


def _require_views(views: Sequence[NamedView], disordered: Sequence[str] = ()) -> None:
    if len(views) >= LEAST_VIEWS:
        return
    problem = f"{len(views)} of the photographs show the field, and {LEAST_VIEWS} are needed"
    if disordered:
        raise KgcpError(
            f"{problem}: discs do not lie like those of a plane with their names in"
            f" {', '.join(disordered)}; correct the places and names in the field's description, or"
            " take others if the field was bent or moved"
        )
    raise KgcpError(f"{problem}; take more, or correct the description of the field")


def _disordered(problem: CalibrationProblem) -> tuple[str, ...]:
    """Return the photographs whose named discs do not match a plane."""
    if not problem.field.starts_from_homographies:
        return ()
    misfits = homography_misfits(problem.observations(), problem.field.points_m())
    return tuple(
        view.photo
        for view, misfit in zip(problem.views, misfits, strict=True)
        if misfit > _MAX_MISFIT
    )


def _with_better_twins(problem: CalibrationProblem, state: AdjustedNetwork) -> AdjustedNetwork:
    """Try the mirrored pose of every photograph, now that the camera is better known."""
    kept = state.network.observations.chosen(state.solution.is_used)
    points = state.estimate.points
    poses, _ = better_poses(state.camera, kept, points, state.poses)
    is_flipped = np.abs(poses.rotations - state.estimate.rotations).max(axis=(1, 2)) > 0.02
    if not is_flipped.any():
        return state
    estimate = replace(state.estimate, rotations=poses.rotations, translations=poses.translations)
    return problem.with_estimate(state, estimate)


def _without_misfits(
    problem: CalibrationProblem, state: AdjustedNetwork
) -> tuple[CalibrationProblem, AdjustedNetwork, tuple[str, ...]]:
    """Drop photographs in which fewer than `_MIN_SHARE` of the discs fit, the worst one first."""
    dropped: tuple[str, ...] = ()
    while True:
        count = len(problem.views)
        view = state.network.observations.view
        share = np.bincount(view, state.solution.is_used, count) / np.bincount(view)
        if share.min() >= _MIN_SHARE or count <= LEAST_VIEWS:
            return problem, state, dropped
        worst = int(share.argmin())
        dropped = (*dropped, problem.views[worst].photo)
        problem, state = without(problem, state, np.arange(count) == worst)


def _result(chosen: _Chosen, dropped: tuple[str, ...]) -> CameraCalibration:
    """Return the camera with its covariance and its undetermined parameters."""
    problem, state = chosen.problem, chosen.state
    model = state.model
    estimated = precision(state.network, state.solution)
    cov = estimated.camera_cov
    by_unknown = model.to_calibration()
    share = np.array([CENTRE_DETERMINED if n in ("cx", "cy") else DETERMINED for n in model.names])
    weak = np.sqrt(cov.diagonal()) > share * state.network.cameras.sd[0]
    weak |= problem.is_at_border(model.names, state.estimate)
    names = np.array(model.names)
    is_significant = ~np.isin(names, state.unknowns.insignificant)
    observed = problem.observations()
    return CameraCalibration(
        state.camera,
        CalibrationCovariance(by_unknown @ cov @ by_unknown.T),
        problem.field,
        problem.settings,
        problem.views,
        dropped,
        state.network,
        state.solution,
        estimated,
        problem.eccentricity(state.camera, state.estimate, observed),
        chosen.points,
        rms_px(chosen.fixed.solution),
        problem.radius_scale(state),
        problem.radius_scales(state),
        state.unknowns.insignificant,
        tuple(names[weak & is_significant].tolist()),
        tangled(
            names[is_significant].tolist(),
            _with_focal_difference(model.names, cov)[np.ix_(is_significant, is_significant)],
            _MAX_INFLATION,
        ),
        chosen.unclear is not None,
    )


def _with_focal_difference(names: Sequence[str], cov: FloatArray) -> FloatArray:
    """Return the covariance of the parameters with fy replaced by fy - fx, if fy is estimated.

    fx and fy are strongly correlated because most errors change both alike. That must not count as
    tangled: their difference is well determined.
    """
    difference = np.eye(len(names))
    if "fy" in names:
        difference[names.index("fy"), names.index("fx")] = -1.0
    return np.asarray(difference @ cov @ difference.T)
