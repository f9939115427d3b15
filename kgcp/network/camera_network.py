"""One camera's network: what is observed, what is known beforehand, and its adjustment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import (
    Circles3D,
    Eccentricity,
    circle_images,
    eccentricity,
    plane_axes,
)
from kgcp.geometry.pose import Pose
from kgcp.network.adjust import ROBUST, adjust_network
from kgcp.network.calibration_records import (
    CalibrationSettings,
    NamedView,
    PointModel,
    operator_sd_px,
)
from kgcp.network.covariance import fitting_covariances, precision
from kgcp.network.frame_camera import FrameCameraModel
from kgcp.network.records import (
    BendPrior,
    CalibrationPrior,
    Estimate,
    Network,
    Observations,
    PointPrior,
    ScaleBar,
    Solution,
)
from kgcp.network.sheet_bends import bend_displacements, bend_shapes, first_bends, next_bends
from kgcp.targets.fields.points import AnyField

_CENTRE_SD = 0.1  # of the frame's longer side: how far a principal point may be from the middle
CENTRE_DETERMINED = 0.1
"""Largest standard deviation of a principal point that counts as determined, of the prior's: 1 % of
the frame."""
# How far from the middle a principal point may be found, of the frame's size. At 1 `Camera` ends,
# and adjustments stick shortly before.
_FARTHEST_CENTRE = 0.9
_FOCAL_SD = 3.0  # of the focal length to start with
_RADIAL_SD = 0.3  # of the distance from the middle, at the corner: what a term may displace
_TANGENTIAL_SD = 0.05
_SCALINGS = 10  # of the covariances, and new eccentricities, at most
_HOLDINGS = 6  # of a principal point at the border of the frame, and releases
_HELD_SD = 1e-3  # px
_SETTLED_PX = 0.002  # change of the eccentricities between two adjustments
_SETTLED_VARIANCE = 1.25  # ratio of the discs' variances between two adjustments
_POWER = {"k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6}


@dataclass(frozen=True, slots=True)
class NetworkUnknowns:
    """What is estimated in an adjustment."""

    points: PointModel
    terms: tuple[str, ...]  # of the distortion
    is_same_aspect: bool

    @property
    def is_rational(self) -> bool:
        """Whether the distortion is a quotient of two polynomials."""
        return "k4" in self.terms


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedNetwork:
    """An adjusted network, and what was estimated in it."""

    camera: Camera
    estimate: Estimate
    unknowns: NetworkUnknowns
    network: Network
    solution: Solution

    @property
    def model(self) -> FrameCameraModel:
        """The camera with these unknowns."""
        terms, is_same_aspect = self.unknowns.terms, self.unknowns.is_same_aspect
        return FrameCameraModel(_without(self.camera, terms), terms, is_same_aspect)

    @property
    def poses(self) -> list[Pose]:
        """The poses of all photographs."""
        estimate = self.estimate
        return [
            Pose(rotation, translation)
            for rotation, translation in zip(estimate.rotations, estimate.translations, strict=True)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationProblem:
    """What all adjustments of one calibration share."""

    views: tuple[NamedView, ...]
    field: AnyField
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

    def with_unknowns(self, state: AdjustedNetwork, unknowns: NetworkUnknowns) -> AdjustedNetwork:
        """Return the adjustment of other unknowns; bends are those of the state, estimated anew."""
        cov, bends = state.network.observations.cov, state.network.bends
        # as in `adjusted`: by the discs' own covariances, terms of rational models would run away
        keeps_cov = bends is not None or unknowns.is_rational
        if not keeps_cov or state.unknowns.points is not unknowns.points:
            return self.adjusted(state.camera, state.estimate, unknowns)
        return self._settled(state.camera, state.estimate, unknowns, cov, bends)

    def with_estimate(self, state: AdjustedNetwork, estimate: Estimate) -> AdjustedNetwork:
        """Return the adjustment from another start."""
        return self.adjusted(state.camera, estimate, state.unknowns)

    def adjusted(
        self, camera: Camera, estimate: Estimate, unknowns: NetworkUnknowns
    ) -> AdjustedNetwork:
        """Return the adjustment once the eccentricities have settled.

        The covariances of the discs are made to fit their residuals, so that priors, which are
        absolute, get the weight that they deserve.
        """
        start, cov = estimate.unbent(0), self.observations().cov
        # Errors of a field that stays as stated would outweigh priors from the beginning, and terms
        # that can hardly be told apart grow to poles of the rational model between the discs. Those
        # of a field that may move are no noise: it would hardly leave its place.
        if unknowns.is_rational and unknowns.points is PointModel.FIXED:
            cov = self._fitting_at(camera, start)
        return self._settled(camera, start, unknowns, cov, None)

    def _fitting_at(self, camera: Camera, estimate: Estimate) -> FloatArray:
        """Return covariances (n, 2, 2) of the discs that agree with an estimate to start from."""
        observed = self.observations()
        circles = observed_circles(self.field, estimate, observed)
        squares = np.sum((observed.places - camera.project(circles.centres_m)) ** 2, axis=1)
        return np.asarray(observed.cov + 0.5 * np.median(squares) * np.eye(2))

    def bent(self, state: AdjustedNetwork) -> AdjustedNetwork:
        """Return the adjustment of a free field that bends, or `state` if it hardly does.

        Bends that displace discs by less than these are measured to may be errors of the operator.
        With them, the focal length of DICe's rendered boards, which cannot bend, went from -0.8 to
        -1.4 px off.

        Parameters
        ----------
        state : AdjustedNetwork
            Without bends.
        """
        if state.unknowns.points is not PointModel.FREE or not self.field.starts_from_homographies:
            return state
        network, solution = state.network, state.solution
        cov = fitting_covariances(network, solution, self.observations().cov)
        fitting = replace(network, observations=replace(network.observations, cov=cov))
        bends = first_bends(fitting, solution, bend_shapes(self.field.points_m()))
        if bends is None:
            return state
        start = state.estimate.unbent(bends.shapes.shape[1])
        bent = self._settled(state.camera, start, state.unknowns, cov, bends)
        squares = np.sum(bend_displacements(bent.network, bent.estimate) ** 2, axis=1)
        is_seen = np.sqrt(squares[bent.solution.is_used].mean()) > operator_sd_px(self.views)
        return bent if is_seen else state

    def _settled(
        self,
        camera: Camera,
        estimate: Estimate,
        unknowns: NetworkUnknowns,
        cov: FloatArray,
        bends: BendPrior | None,
    ) -> AdjustedNetwork:
        """Return the adjustment that starts with some covariances (n, 2, 2) and bends."""
        observed = self.observations()
        if unknowns.is_same_aspect:
            camera = replace(camera, fy=camera.fx)
        terms = unknowns.terms
        model = FrameCameraModel(_without(camera, terms), terms, unknowns.is_same_aspect)
        before = np.full_like(observed.places, np.inf)
        for _ in range(_SCALINGS):
            offsets = self.eccentricity(camera, estimate, observed).total_px
            offsets = np.where(np.isfinite(offsets), offsets, 0.0)
            network = Network(
                model,
                np.zeros(len(self.views), dtype=np.intp),
                replace(observed, places=observed.places - offsets, cov=cov),
                self.point_prior(unknowns.points),
                self.camera_prior(model, camera),
                bends,
            )
            start = replace(estimate, cameras=model.values_of(camera)[None])
            solution = self._with_kept_centre(network, start)
            estimate = solution.estimate
            camera = model.camera(estimate.cameras[0])
            next_cov = fitting_covariances(network, solution, observed.cov)
            change = float(np.trace(next_cov.sum(axis=0)) / np.trace(cov.sum(axis=0)))
            is_scaled = 1.0 / _SETTLED_VARIANCE < change < _SETTLED_VARIANCE
            if bends is not None:
                next_sd = next_bends(network, solution, bends)
                change = (next_sd.sd / bends.sd) ** 2
                is_scaled &= 1.0 / _SETTLED_VARIANCE < change < _SETTLED_VARIANCE
            is_settled = is_scaled and np.abs(offsets - before).max() < _SETTLED_PX
            cov, before = next_cov, offsets
            if is_settled:
                break
            bends = next_sd if bends is not None else None
        return AdjustedNetwork(camera, estimate, unknowns, network, solution)

    def _with_kept_centre(self, network: Network, start: Estimate) -> Solution:
        """Return the adjustment, with a principal point that is lost held at the frame's border.

        That of cropped photographs may well be outside. But if it is hardly determined, a field
        that is not as described can draw it out to where no camera exists. Then it is held, as
        long as the photographs draw it outwards.
        """
        names = network.model.names
        index, last_px = _centre_of(names), np.array(self.size) - 1.0
        is_held, held_px = np.zeros(2, dtype=np.bool_), np.zeros(2)
        for _ in range(_HOLDINGS):
            solution = adjust_network(
                _held_at(network, index[is_held], held_px[is_held]), start, ROBUST
            )
            start = solution.estimate
            centre_px = start.cameras[0, index]
            nearest_px = np.clip(centre_px, 0.0, last_px)
            # a coordinate that is held has given way a little to where the photographs draw it
            is_outward = (centre_px - held_px) * (held_px - 0.5 * last_px) > 0.0
            is_lost = centre_px != nearest_px
            if np.any(is_lost & ~is_held):
                is_lost &= self._is_lost(network, solution, index)
            held_px = np.where(is_held, held_px, nearest_px)
            was_held, is_held = is_held, np.where(is_held, is_outward, is_lost)
            if np.array_equal(was_held, is_held):
                break
        cameras = start.cameras.copy()
        cameras[0, index[was_held]] = held_px[was_held]
        return replace(solution, estimate=replace(start, cameras=cameras))

    def _is_lost(self, network: Network, solution: Solution, index: IndexArray) -> BoolArray:
        """Return which coordinates of the principal point are hardly determined.

        So are those at the end of what a `Camera` may have: the minimum is beyond.
        """
        sd = np.sqrt(precision(network, solution).camera_cov.diagonal()[index])
        from_middle = np.abs(solution.estimate.cameras[0, index] / self.size - 0.5)
        is_loose = sd > CENTRE_DETERMINED * network.cameras.sd[0, index]
        return np.asarray(is_loose | (from_middle > _FARTHEST_CENTRE))

    def is_at_border(self, names: Sequence[str], estimate: Estimate) -> BoolArray:
        """Return which unknowns (p,) are a principal point's that is held at the border."""
        is_held = np.zeros(len(names), dtype=np.bool_)
        index, border = _centre_of(names), np.array(self.size) - 1.0
        centre = estimate.cameras[0, index]
        is_held[index] = (centre == 0.0) | (centre == border)
        return is_held

    def eccentricity(
        self, camera: Camera, estimate: Estimate, observed: Observations
    ) -> Eccentricity:
        """Return how far the centroids of all discs are from the images of their centres."""
        return eccentricity(camera, observed_circles(self.field, estimate, observed))

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
        sds = self.field.point_sds_m()
        if points is PointModel.FREE:
            # a tenth of the pitch limits what the photographs hardly determine
            sds = np.full_like(sds, 0.1 * self.field.pitch_m)
        return PointPrior(nominal, np.eye(3) * sds[:, None] ** -2.0, bars)

    def camera_prior(self, model: FrameCameraModel, camera: Camera) -> CalibrationPrior:
        """Return what is known of any camera: a principal point in the middle, small distortion."""
        width, height = self.size
        corner = 0.5 * math.hypot(width, height) / camera.mean_focal_px
        usual = {"cx": 0.5 * (width - 1), "cy": 0.5 * (height - 1)}
        values, sd = [], []
        for name in model.names:
            values.append(usual.get(name, getattr(camera, name) if name[0] == "f" else 0.0))
            sd.append(self._sd(name, camera, corner))
        return CalibrationPrior(np.array([values]), np.array([sd]))

    def _sd(self, name: str, camera: Camera, corner: float) -> float:
        if name in ("fx", "fy"):
            return _FOCAL_SD * camera.mean_focal_px
        if name in ("cx", "cy"):
            return _CENTRE_SD * max(self.size)
        if name in ("p1", "p2"):
            return _TANGENTIAL_SD / corner
        return _RADIAL_SD / corner ** _POWER[name]

    def radius_scale(self, state: AdjustedNetwork) -> float:
        """Return the median of measured over expected radii, the latter through the lens."""
        return float(np.nanmedian(self._radius_ratios(state)))

    def radius_scales(self, state: AdjustedNetwork) -> FloatArray:
        """Return the same of every photograph (v,); NaN if none of its discs is used."""
        ratios, view = self._radius_ratios(state), state.network.observations.view
        used = np.isfinite(ratios)
        return np.array(
            [
                np.median(ratios[used & (view == k)]) if np.any(used & (view == k)) else np.nan
                for k in range(len(self.views))
            ]
        )

    def _radius_ratios(self, state: AdjustedNetwork) -> FloatArray:
        """Return measured over expected radii (n,); NaN of discs that are not used."""
        observed = self.observations()
        expected = circle_images(
            state.camera, observed_circles(self.field, state.estimate, observed)
        ).moments
        measured = np.concatenate([view.vectors for view in self.views])
        usable = np.all(np.isfinite(expected), axis=1) & state.solution.is_used
        ratios = np.full(len(measured), np.nan)
        ratios[usable] = (_determinant(measured[usable]) / _determinant(expected[usable])) ** 0.25
        return ratios


def observed_circles(field: AnyField, estimate: Estimate, observed: Observations) -> Circles3D:
    """Return the outlines of observed discs (n,) in the frames of their photographs' cameras."""
    rotations = estimate.rotations[observed.view]
    centres = np.einsum("nij,nj->ni", rotations, estimate.points[observed.point])
    centres += estimate.translations[observed.view]
    axes = np.einsum("nij,njk->nik", rotations, plane_axes(field.normals())[observed.point])
    return Circles3D(centres, axes, field.radii_m()[observed.point])


def _centre_of(names: Sequence[str]) -> IndexArray:
    return np.array([names.index("cx"), names.index("cy")])


def _held_at(network: Network, index: IndexArray, values: FloatArray) -> Network:
    """Return the network with some of the camera's parameters (k,) held at values."""
    known, sd = network.cameras.values.copy(), network.cameras.sd.copy()
    known[0, index], sd[0, index] = values, _HELD_SD
    return replace(network, cameras=CalibrationPrior(known, sd))


def _determinant(moments: FloatArray) -> FloatArray:
    return moments[:, 2] * moments[:, 4] - moments[:, 3] ** 2


def _without(camera: Camera, terms: Sequence[str]) -> Camera:
    """Return a camera whose other terms of distortion are zero."""
    absent = [name for name in (*_POWER, "p1", "p2") if name not in terms]
    zeros: dict[str, Any] = dict.fromkeys(absent, 0.0)
    return replace(camera, **zeros)
