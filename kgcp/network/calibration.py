"""A camera from photographs of a field: start, lens model, shape of the field, covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, Eccentricity, circle_images, eccentricity
from kgcp.geometry.pose import Pose
from kgcp.network.adjust import ROBUST, adjust
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    LensModel,
    NamedView,
    PointModel,
    rms_px,
)
from kgcp.network.covariance import observation_factor, precision, tangled
from kgcp.network.frame_camera import FrameCameraModel
from kgcp.network.records import (
    CameraPrior,
    Estimate,
    Network,
    Observations,
    PointPrior,
    ScaleBar,
    Solution,
)
from kgcp.network.start import (
    better_poses,
    homography_misfits,
    refined_poses,
    start_camera_and_poses,
)
from kgcp.targets.fields.layout import Field

LEAST_VIEWS = 3
_CENTRE_SD = 0.1  # of the frame's longer side: how far a principal point may be from the middle
_FOCAL_SD = 3.0  # of the focal length to start with
_RADIAL_SD = 0.3  # of the distance from the middle, at the corner: what a term may displace
_TANGENTIAL_SD = 0.05
_DETERMINED = 0.3  # of its prior deviation: what is known no better is not determined
_SIGNIFICANT = 0.001
_INFLATION = 100.0  # of a variance by other parameters: a deviation ten times larger
_FOLDS = 5
_LEAST_SHARE = 0.6  # of a photograph's discs that must fit
_SCALINGS = 10  # of the covariances, and new eccentricities, at most
_MARGIN_PX = 2.0  # within the frame, where a disc is to be found
_MOST_MISFIT = 0.1  # of a photograph's homography, over the spread of its discs
_SETTLED_PX = 0.002  # change of the eccentricities between two adjustments
_CLEAR_TURN = 1.5  # times the sum of squares: the field's own shape tells its ends apart

_TERMS: dict[LensModel, tuple[str, ...]] = {
    LensModel.RADIAL: ("k1", "k2"),
    LensModel.BROWN: ("k1", "k2", "p1", "p2", "k3"),
    LensModel.RATIONAL: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_ADDITIONS: tuple[tuple[str, ...], ...] = (("k2",), ("p1", "p2"), ("k3",))
_POWER = {"k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6}


def missing_discs(calibration: CameraCalibration) -> dict[str, tuple[IndexArray, FloatArray]]:
    """Return the discs that a photograph must show and that were not measured.

    Returns
    -------
    dict
        By photograph: indices of the field's discs (k,), and the centroids and moments (k, 5) of
        their images.
    """
    field, camera = calibration.field, calibration.camera
    estimate = calibration.solution.estimate
    missing = {}
    for index, view in enumerate(calibration.views):
        point = np.setdiff1d(np.arange(len(estimate.points)), view.point)
        rotation, translation = estimate.rotations[index], estimate.translations[index]
        centres = estimate.points[point] @ rotation.T + translation
        axes = np.broadcast_to(rotation[:, :2], (len(point), 3, 2))
        images = circle_images(camera, Circles3D(centres, axes, field.radii_m()[point]))
        low, high = images.outlines_px.min(axis=1), images.outlines_px.max(axis=1)
        size = np.array([camera.width, camera.height])
        is_inside = np.all((low > _MARGIN_PX) & (high < size - 1 - _MARGIN_PX), axis=1)
        missing[view.photo] = (point[is_inside], images.moments[is_inside])
    return missing


def calibrate_camera(
    views: Sequence[NamedView],
    field: Field,
    size: tuple[int, int],
    settings: CalibrationSettings,
    start: CameraCalibration | None = None,
) -> CameraCalibration:
    """Return the camera that took the photographs.

    The field is taken as it is meant to be, then as stiff or free as asked for. The poses of planar
    fields are followed in both their forms. Centroids are reduced by their eccentricity, exactly
    and through the lens, until it does not change.

    Parameters
    ----------
    size : tuple of int
        Width and height of the photographs [px].
    start : CameraCalibration, optional
        A former calibration by the same photographs.

    Raises
    ------
    KgcpError
        If fewer than three photographs show the field.
    """
    _require_views(views)
    work = _Work(tuple(views), field, size, settings)
    if start is not None:
        work = replace(work, field=start.field)
    points = field.points_m()
    # what a former calibration has dropped is all that is dropped now
    disordered = () if start is not None else work.disordered()
    work = replace(work, views=tuple(view for view in views if view.photo not in disordered))
    _require_views(work.views)
    observations = work.observations()
    unknowns = _Unknowns(PointModel.FIXED, ("k1", "k2"), settings.is_same_aspect)
    if start is None:
        camera, estimate = start_camera_and_poses(observations, points, size)
        state = work.adjusted(camera, estimate, replace(unknowns, terms=()))
        for terms in (("k1",), ("k1", "k2")):
            state = work.with_terms(state, terms)
    else:
        work = replace(work, views=tuple(v for v in work.views if v.photo not in start.dropped))
        estimate = replace(start.solution.estimate, points=points)  # as they are meant to be
        state = work.adjusted(start.camera, estimate, unknowns)
    state = work.with_better_twins(state)
    if not field.is_diameter_stated and start is None:
        work = replace(work, field=field.with_diameters(work.radius_scale(state)))
        state = work.with_estimate(state, state.estimate)
    work, state, misfits = work.without_misfits(state)
    dropped = (*disordered, *(() if start is None else start.dropped), *misfits)
    dropped = tuple(dict.fromkeys(dropped))
    _require_views(work.views)
    fixed = work.with_terms(state, _chosen_terms(work, state))
    points_used, is_turn_unclear = settings.points, False
    state = fixed
    if settings.points is not PointModel.FIXED:
        own_shape = replace(fixed.unknowns, points=settings.points)
        state = work.adjusted(fixed.camera, fixed.estimate, own_shape)
        if any(view.is_symmetric for view in work.views):
            work, state, is_turn_unclear = work.with_turns(state)
        if is_turn_unclear:
            state, points_used = fixed, PointModel.FIXED
        else:
            state = work.with_terms(state, _chosen_terms(work, state))
    return work.result(state, fixed, dropped, points_used, is_turn_unclear=is_turn_unclear)


def _require_views(views: Sequence[NamedView]) -> None:
    if len(views) < LEAST_VIEWS:
        raise KgcpError(
            f"{len(views)} of the photographs show the field, and {LEAST_VIEWS} are needed; take"
            " more, or correct what describes the field"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """Another way in which a symmetric field may lie in a photograph."""

    cost_ratio: float  # its sum of squares over that of the present one
    permutation: IndexArray  # (m,): which disc takes the place of which
    pose: Pose


@dataclass(frozen=True, slots=True)
class _Unknowns:
    """What is estimated in an adjustment."""

    points: PointModel
    terms: tuple[str, ...]  # of the distortion
    is_same_aspect: bool


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """An adjusted network, and what was estimated in it."""

    camera: Camera
    estimate: Estimate
    unknowns: _Unknowns
    network: Network
    solution: Solution

    @property
    def model(self) -> FrameCameraModel:
        """The camera with these unknowns."""
        terms, is_same_aspect = self.unknowns.terms, self.unknowns.is_same_aspect
        return FrameCameraModel(_without(self.camera, terms), terms, is_same_aspect)


@dataclass(frozen=True, slots=True, eq=False)
class _Work:
    """What all adjustments of one calibration share."""

    views: tuple[NamedView, ...]
    field: Field
    size: tuple[int, int]
    settings: CalibrationSettings

    def observations(self) -> Observations:
        """Return the centroids of all discs."""
        counts = [len(view.point) for view in self.views]
        return Observations(
            np.repeat(np.arange(len(self.views)), counts),
            np.concatenate([view.point for view in self.views]),
            np.concatenate([view.vectors[:, :2] for view in self.views]),
            np.concatenate([view.covs[:, :2, :2] for view in self.views]),
        )

    def disordered(self) -> tuple[str, ...]:
        """Return the photographs whose discs do not lie like those of a plane, with these names."""
        misfits = homography_misfits(self.observations(), self.field.points_m())
        return tuple(
            view.photo
            for view, misfit in zip(self.views, misfits, strict=True)
            if misfit > _MOST_MISFIT
        )

    def with_terms(self, state: _State, terms: tuple[str, ...]) -> _State:
        """Return the adjustment with other terms of distortion."""
        unknowns = replace(state.unknowns, terms=terms)
        return self.adjusted(state.camera, state.estimate, unknowns)

    def with_estimate(self, state: _State, estimate: Estimate) -> _State:
        """Return the adjustment from another start."""
        return self.adjusted(state.camera, estimate, state.unknowns)

    def adjusted(self, camera: Camera, estimate: Estimate, unknowns: _Unknowns) -> _State:
        """Return the adjustment once the eccentricities have settled.

        The covariances of the discs are scaled to their residuals, so that priors, which are
        absolute, get the weight that they deserve.
        """
        observed = self.observations()
        terms = unknowns.terms
        model = FrameCameraModel(_without(camera, terms), terms, unknowns.is_same_aspect)
        scale, before = 1.0, np.full_like(observed.places, np.inf)
        for _ in range(_SCALINGS):
            offsets = self.eccentricity(camera, estimate, observed).total_px
            offsets = np.where(np.isfinite(offsets), offsets, 0.0)
            network = Network(
                model,
                np.zeros(len(self.views), dtype=np.intp),
                replace(observed, places=observed.places - offsets, cov=scale * observed.cov),
                self.point_prior(unknowns.points),
                self.camera_prior(model, camera),
            )
            start = replace(estimate, cameras=model.values_of(camera)[None])
            solution = adjust(network, start, ROBUST)
            estimate = solution.estimate
            camera = model.camera(estimate.cameras[0])
            factor = observation_factor(network, solution)
            scale *= factor
            is_settled = np.abs(offsets - before).max() < _SETTLED_PX and 0.8 < factor < 1.25
            before = offsets
            if is_settled:
                break
        return _State(camera, estimate, unknowns, network, solution)

    def eccentricity(
        self, camera: Camera, estimate: Estimate, observed: Observations
    ) -> Eccentricity:
        """Return how far the centroids of all discs are from the images of their centres."""
        return eccentricity(camera, self._circles(estimate, observed))

    def _circles(self, estimate: Estimate, observed: Observations) -> Circles3D:
        rotations = estimate.rotations[observed.view]
        centres = np.einsum("nij,nj->ni", rotations, estimate.points[observed.point])
        centres += estimate.translations[observed.view]
        radii = self.field.radii_m()[observed.point]
        return Circles3D(centres, rotations[:, :, :2], radii)

    def point_prior(self, points: PointModel) -> PointPrior:
        """Return what the adjustment knows of the field; unseen points stay where they are."""
        nominal = self.field.points_m()
        if points is PointModel.FIXED:
            return PointPrior(nominal, None)
        names = self.field.names()
        bars = tuple(
            ScaleBar(names.index(bar.first), names.index(bar.second), bar.length_m, bar.sd_m)
            for bar in self.field.bars
        )
        information = np.diag(np.array(self.field.flat_sd_m) ** -2.0)
        if points is PointModel.FREE:
            # a deviation of a tenth of the pitch holds what the photographs hardly see
            information = np.eye(3) * (0.1 * self.field.pitch_m) ** -2.0
        return PointPrior(nominal, np.tile(information, (len(nominal), 1, 1)), bars)

    def camera_prior(self, model: FrameCameraModel, camera: Camera) -> CameraPrior:
        """Return what is known of any camera: a principal point in the middle, small distortion."""
        width, height = self.size
        corner = 0.5 * math.hypot(width, height) / camera.mean_focal_px
        usual = {"cx": 0.5 * (width - 1), "cy": 0.5 * (height - 1)}
        values, sd = [], []
        for name in model.names:
            values.append(usual.get(name, getattr(camera, name) if name[0] == "f" else 0.0))
            sd.append(self._sd(name, camera, corner))
        return CameraPrior(np.array([values]), np.array([sd]))

    def _sd(self, name: str, camera: Camera, corner: float) -> float:
        if name in ("fx", "fy"):
            return _FOCAL_SD * camera.mean_focal_px
        if name in ("cx", "cy"):
            return _CENTRE_SD * max(self.size)
        if name in ("p1", "p2"):
            return _TANGENTIAL_SD / corner
        return _RADIAL_SD / corner ** _POWER[name]

    def with_better_twins(self, state: _State) -> _State:
        """Try the other pose of every photograph with the camera as it is now."""
        kept = state.network.observations.chosen(state.solution.is_used)
        points = state.estimate.points
        poses, _ = better_poses(state.camera, kept, points, _poses(state.estimate))
        flipped = np.abs(poses.rotations - state.estimate.rotations).max(axis=(1, 2)) > 0.02
        if not flipped.any():
            return state
        estimate = replace(
            state.estimate, rotations=poses.rotations, translations=poses.translations
        )
        return self.with_estimate(state, estimate)

    def without_misfits(self, state: _State) -> tuple[_Work, _State, tuple[str, ...]]:
        """Leave out photographs most of whose discs do not lie like the field's."""
        dropped: tuple[str, ...] = ()
        work = self
        while True:
            count = len(work.views)
            view = state.network.observations.view
            share = np.bincount(view, state.solution.is_used, count) / np.bincount(view)
            if share.min() >= _LEAST_SHARE or count <= LEAST_VIEWS:
                return work, state, dropped
            worst = int(share.argmin())
            dropped = (*dropped, work.views[worst].photo)
            stays = np.arange(count) != worst
            work = replace(work, views=tuple(np.array(work.views, dtype=object)[stays]))
            estimate = replace(
                state.estimate,
                rotations=state.estimate.rotations[stays],
                translations=state.estimate.translations[stays],
            )
            state = work.with_estimate(state, estimate)

    def with_turns(self, state: _State) -> tuple[_Work, _State, bool]:
        """Turn a symmetric field in photographs where its own shape fits better turned.

        Returns
        -------
        work, state
            With the discs named accordingly.
        is_unclear : bool
            Whether some photograph fits nearly as well either way.
        """
        work = self
        for _ in range(len(self.views)):
            turns = [work._best_turn(state, view) for view in range(len(work.views))]
            worst = min(range(len(turns)), key=lambda view: turns[view].cost_ratio)
            if turns[worst].cost_ratio >= 1.0:
                return work, state, turns[worst].cost_ratio < _CLEAR_TURN
            views = list(work.views)
            point = turns[worst].permutation[views[worst].point]
            views[worst] = replace(views[worst], point=point)
            work = replace(work, views=tuple(views))
            rotations, translations = (
                state.estimate.rotations.copy(),
                state.estimate.translations.copy(),
            )
            rotations[worst] = turns[worst].pose.rotation
            translations[worst] = turns[worst].pose.translation_m
            estimate = replace(state.estimate, rotations=rotations, translations=translations)
            state = work.with_estimate(state, estimate)
        return work, state, True

    def _best_turn(self, state: _State, view: int) -> _Turn:
        """Return how else a symmetric field could lie in a photograph."""
        observed = state.network.observations
        own = observed.chosen((observed.view == view) & state.solution.is_used)
        own = replace(own, view=np.zeros(len(own.view), dtype=np.intp))
        points, pose = state.estimate.points, _poses(state.estimate)[view]
        _, cost = refined_poses(state.camera, own, points, [pose])
        turns = []
        for permutation in self.field.symmetries():
            turned = replace(own, point=permutation[own.point])
            guess = _turned_pose(pose, self.field.points_m(), permutation)
            refined, other = refined_poses(state.camera, turned, points, [guess])
            turns.append(_Turn(float(other[0] / cost[0]), permutation, _poses(refined)[0]))
        return min(turns, key=lambda turn: turn.cost_ratio)

    def result(
        self,
        state: _State,
        fixed: _State,
        dropped: tuple[str, ...],
        points_used: PointModel,
        *,
        is_turn_unclear: bool,
    ) -> CameraCalibration:
        """Return the camera with its covariance and what it does not determine."""
        model = state.model
        known = precision(state.network, state.solution)
        cov = known.camera_cov
        by_unknown = model.to_calibration()
        sd = np.sqrt(cov.diagonal())
        weak = sd > _DETERMINED * state.network.cameras.sd[0]
        names = np.array(model.names)
        observed = self.observations()
        return CameraCalibration(
            state.camera,
            CalibrationCovariance(by_unknown @ cov @ by_unknown.T),
            self.field,
            self.settings,
            self.views,
            dropped,
            state.network,
            state.solution,
            known,
            self.eccentricity(state.camera, state.estimate, observed),
            points_used,
            rms_px(fixed.solution),
            self.radius_scale(state),
            tuple(names[weak].tolist()),
            tangled(model.names, cov, _INFLATION),
            is_turn_unclear,
        )

    def radius_scale(self, state: _State) -> float:
        """Return the median of measured over expected radii, the latter through the lens."""
        observed = self.observations()
        expected = circle_images(state.camera, self._circles(state.estimate, observed)).moments
        measured = np.concatenate([view.vectors for view in self.views])
        usable = np.all(np.isfinite(expected), axis=1) & state.solution.is_used
        ratio = (_determinant(measured[usable]) / _determinant(expected[usable])) ** 0.25
        return float(np.median(ratio))


def _determinant(moments: FloatArray) -> FloatArray:
    return moments[:, 2] * moments[:, 4] - moments[:, 3] ** 2


def _without(camera: Camera, terms: Sequence[str]) -> Camera:
    """Return a camera whose other terms of distortion are zero."""
    absent = [name for name in (*_POWER, "p1", "p2") if name not in terms]
    zeros: dict[str, Any] = dict.fromkeys(absent, 0.0)
    return replace(camera, **zeros)


def _poses(estimate: Estimate) -> list[Pose]:
    return [
        Pose(rotation, translation)
        for rotation, translation in zip(estimate.rotations, estimate.translations, strict=True)
    ]


def _turned_pose(pose: Pose, points: FloatArray, turn: IndexArray) -> Pose:
    """Return the pose under which point i has the image that point turn[i] is to have."""
    middle = points.mean(axis=0)
    # turn[i] is where the turn S takes point i, so that R X_i + t = R Sᵀ X_turn[i] + t'
    across, image = (points - middle)[:, :2], (points[turn] - middle)[:, :2]
    u, _, vt = np.linalg.svd(image.T @ across)
    back = np.eye(3)
    back[:2, :2] = (u @ vt).T
    rotation = pose.rotation @ back
    return Pose(rotation, pose.rotation @ middle + pose.translation_m - rotation @ middle)


def _chosen_terms(work: _Work, state: _State) -> tuple[str, ...]:
    """Return the terms of distortion: those asked for, or as many as are worth it.

    Every lens has k1. A further term is worth it if it is significant over the photographs, known
    better than beforehand, and photographs that took no part in its estimation fit better with it.
    """
    if work.settings.lens is not LensModel.AUTO:
        return _TERMS[work.settings.lens]
    kept = work.with_terms(state, ("k1",))
    misfit = _misfit_of_others(work, kept)
    for addition in _ADDITIONS:
        trial = work.with_terms(kept, (*kept.unknowns.terms, *addition))
        trial_misfit = _misfit_of_others(work, trial)
        if trial_misfit < misfit and _is_worth_it(trial, addition, len(work.views)):
            kept, misfit = trial, trial_misfit
    return kept.unknowns.terms


def _is_worth_it(state: _State, addition: Sequence[str], views: int) -> bool:
    limit = stats.t.ppf(1.0 - 0.5 * _SIGNIFICANT / len(addition), views - 1)
    sd = np.sqrt(precision(state.network, state.solution).camera_cov.diagonal())
    names = state.network.model.names
    columns = [names.index(name) for name in addition]
    is_known = sd[columns] < _DETERMINED * state.network.cameras.sd[0, columns]
    is_large = np.abs(state.estimate.cameras[0, columns]) > limit * sd[columns]
    return bool(is_known.all() and is_large.any())


def _misfit_of_others(work: _Work, state: _State) -> float:
    """Return the median residual of photographs that took no part, in turns (cross-validation)."""
    network, estimate = state.network, state.estimate
    # the field as it is estimated by all: only the camera is on trial
    points = PointPrior(estimate.points, None)
    used = network.observations.chosen(state.solution.is_used)
    views = np.arange(len(work.views))
    model = state.model
    misfits = []
    for fold in range(min(_FOLDS, len(views))):
        is_left_out = views % _FOLDS == fold
        trained = _part(replace(network, points=points, observations=used), ~is_left_out)
        start = _part_of_estimate(estimate, ~is_left_out)
        values = adjust(trained, start, ROBUST).estimate.cameras[0]
        camera = model.camera(values)
        left = _part(replace(network, points=points, observations=used), is_left_out)
        poses = _poses(_part_of_estimate(estimate, is_left_out))
        _, costs = refined_poses(camera, left.observations, estimate.points, poses)
        misfits.append(costs / np.bincount(left.observations.view))
    return float(np.mean(np.concatenate(misfits)))


def _part(network: Network, which: BoolArray) -> Network:
    """Return the network of some of its photographs."""
    index = np.cumsum(which) - 1
    observed = network.observations.chosen(which[network.observations.view])
    return replace(
        network,
        view_camera=network.view_camera[which],
        observations=replace(observed, view=index[observed.view]),
    )


def _part_of_estimate(estimate: Estimate, which: BoolArray) -> Estimate:
    return replace(
        estimate,
        rotations=estimate.rotations[which],
        translations=estimate.translations[which],
    )
