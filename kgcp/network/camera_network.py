"""The network of one camera: observations, priors and adjustment."""

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

# A-priori standard deviations: of the principal point about the middle, relative to the frame's
# longer side; of the focal length, relative to its start value; of the displacement by one
# distortion term at the frame's corner, relative to the corner's distance from the middle.
_CENTRE_SD = 0.1
_FOCAL_SD = 3.0
_RADIAL_SD = 0.3
_TANGENTIAL_SD = 0.05
# The same for terms that are not significant, from what lenses usually have.
_USUAL_SD = {"k2": 0.02, "p1": 0.0005, "p2": 0.0005, "k3": 0.01}
CENTRE_DETERMINED = 0.1
"""Largest standard deviation of a principal point that counts as determined, relative to the
a-priori one. It is 1 % of the frame's longer side."""
# Largest distance of a principal point from the middle, relative to the frame's size. `Camera`
# allows less than 1, and adjustments get stuck shortly before that.
_MAX_CENTRE_OFFSET = 0.9
_MAX_ADJUSTMENTS = 10  # with updated covariances and eccentricities
_MAX_HOLDINGS = 6  # rounds in which a principal point is held at the frame's border or released
_HELD_SD_PX = 1e-3
_SETTLED_PX = 0.002  # change of the eccentricities between two adjustments
_SETTLED_VARIANCE = 1.25  # ratio of the discs' variances between two adjustments
# Power of the radius that a term's displacement, relative to the radius, grows with
_RADIUS_POWER = {"k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6, "p1": 1, "p2": 1}


@dataclass(frozen=True, slots=True)
class NetworkUnknowns:
    """Unknowns of an adjustment."""

    points: PointModel
    terms: tuple[str, ...]  # distortion terms
    is_same_aspect: bool
    # further terms, which are not significant; priors keep them as small as in usual lenses
    insignificant: tuple[str, ...] = ()

    @property
    def is_rational(self) -> bool:
        """Whether the distortion is a quotient of two polynomials."""
        return "k4" in self.terms

    def model(self, camera: Camera) -> FrameCameraModel:
        """Return the camera model with these unknowns; other terms of the camera become zero."""
        terms = (*self.terms, *self.insignificant)
        return FrameCameraModel(_without(camera, terms), terms, self.is_same_aspect)


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedNetwork:
    """An adjusted network with its unknowns."""

    camera: Camera
    estimate: Estimate
    unknowns: NetworkUnknowns
    network: Network
    solution: Solution

    @property
    def model(self) -> FrameCameraModel:
        """The camera model with these unknowns."""
        return self.unknowns.model(self.camera)

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
        """Return the adjustment of other unknowns, starting from a state.

        If the field bends in the state, it bends in the result as well; the bends are estimated
        anew.
        """
        cov, bends = state.network.observations.cov, state.network.bends
        # stated covariances let the terms of rational models diverge: see `adjusted`
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
        """Return the adjustment without bends, iterated until the eccentricities have settled.

        The covariances of the discs are fitted to their residuals. Priors are absolute, and only
        realistic covariances of the discs give them their proper weight.
        """
        start, cov = estimate.with_zero_bends(0), self.observations().cov
        # If the field is fixed, its errors inflate the residuals. With the stated covariances the
        # discs would outweigh the priors in the first adjustment. Rational terms, which are hard
        # to separate, would then grow until the model has poles between the discs. Therefore the
        # covariances are fitted before. If the field may move, its errors are no noise: with such
        # covariances it would hardly leave its stated place.
        if unknowns.is_rational and unknowns.points is PointModel.FIXED:
            cov = self._fitting_at(camera, start)
        return self._settled(camera, start, unknowns, cov, None)

    def _fitting_at(self, camera: Camera, estimate: Estimate) -> FloatArray:
        """Return covariances (n, 2, 2) of the discs that agree with the residuals of a start."""
        observed = self.observations()
        circles = observed_circles(self.field, estimate, observed)
        squares = np.sum((observed.places - camera.project(circles.centres_m)) ** 2, axis=1)
        return np.asarray(observed.cov + 0.5 * np.median(squares) * np.eye(2))

    def bent(self, state: AdjustedNetwork) -> AdjustedNetwork:
        """Return the adjustment of a free field that bends, or `state` if it hardly does.

        Bends count only if they displace the discs by more than the standard deviation of their
        measurement. Smaller ones may be errors of the disc operator. DICe's rendered boards cannot
        bend; when bends were estimated for them, the error of the focal length grew from -0.8 to
        -1.4 px.

        Parameters
        ----------
        state : AdjustedNetwork
            The adjustment without bends.
        """
        if state.unknowns.points is not PointModel.FREE or not self.field.starts_from_homographies:
            return state
        network, solution = state.network, state.solution
        cov = fitting_covariances(network, solution, self.observations().cov)
        fitting = replace(network, observations=replace(network.observations, cov=cov))
        bends = first_bends(fitting, solution, bend_shapes(self.field.points_m()))
        if bends is None:
            return state
        start = state.estimate.with_zero_bends(bends.shapes.shape[1])
        bent = self._settled(state.camera, start, state.unknowns, cov, bends)
        squares = np.sum(bend_displacements(bent.network, bent.estimate) ** 2, axis=1)
        is_noticeable = np.sqrt(squares[bent.solution.is_used].mean()) > operator_sd_px(self.views)
        return bent if is_noticeable else state

    def _settled(
        self,
        camera: Camera,
        estimate: Estimate,
        unknowns: NetworkUnknowns,
        cov: FloatArray,
        bends: BendPrior | None,
    ) -> AdjustedNetwork:
        """Repeat the adjustment until eccentricities, covariances and bends have settled.

        Parameters
        ----------
        cov : (n, 2, 2) array
            Covariances of the discs to start with.
        bends : BendPrior or None
            Bends to start with; None: the field does not bend.
        """
        observed = self.observations()
        if unknowns.is_same_aspect:
            camera = replace(camera, fy=camera.fx)
        model = unknowns.model(camera)
        before = np.full_like(observed.places, np.inf)
        for _ in range(_MAX_ADJUSTMENTS):
            offsets = self.eccentricity(camera, estimate, observed).total_px
            offsets = np.where(np.isfinite(offsets), offsets, 0.0)
            network = Network(
                model,
                np.zeros(len(self.views), dtype=np.intp),
                replace(observed, places=observed.places - offsets, cov=cov),
                self.point_prior(unknowns.points),
                self.camera_prior(unknowns, camera),
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
        """Return the adjustment; a principal point that runs away is held at the frame's border.

        In cropped photographs the principal point may well lie outside the frame. But if it is
        hardly determined, a wrong description of the field can move it so far that no valid camera
        exists. Then it is held at the border as long as the photographs pull it outwards.
        """
        names = network.model.names
        index, last_px = _centre_of(names), np.array(self.size) - 1.0
        is_held, held_px = np.zeros(2, dtype=np.bool_), np.zeros(2)
        for _ in range(_MAX_HOLDINGS):
            solution = adjust_network(
                _held_at(network, index[is_held], held_px[is_held]), start, ROBUST
            )
            start = solution.estimate
            centre_px = start.cameras[0, index]
            nearest_px = np.clip(centre_px, 0.0, last_px)
            # a held coordinate gives way a little: this tells where the photographs pull it
            is_outward = (centre_px - held_px) * (held_px - 0.5 * last_px) > 0.0
            is_runaway = centre_px != nearest_px
            if np.any(is_runaway & ~is_held):
                is_runaway &= self._is_undetermined(network, solution, index)
            held_px = np.where(is_held, held_px, nearest_px)
            was_held, is_held = is_held, np.where(is_held, is_outward, is_runaway)
            if np.array_equal(was_held, is_held):
                break
        cameras = start.cameras.copy()
        cameras[0, index[was_held]] = held_px[was_held]
        return replace(solution, estimate=replace(start, cameras=cameras))

    def _is_undetermined(
        self, network: Network, solution: Solution, index: IndexArray
    ) -> BoolArray:
        """Return which coordinates of the principal point are hardly determined.

        They include those at the limit of what `Camera` allows: their minimum lies beyond it.
        """
        sd = np.sqrt(precision(network, solution).camera_cov.diagonal()[index])
        offset = np.abs(solution.estimate.cameras[0, index] / self.size - 0.5)
        is_weak = sd > CENTRE_DETERMINED * network.cameras.sd[0, index]
        return np.asarray(is_weak | (offset > _MAX_CENTRE_OFFSET))

    def is_at_border(self, names: Sequence[str], estimate: Estimate) -> BoolArray:
        """Return which unknowns (p,) are coordinates of a principal point held at the border."""
        is_held = np.zeros(len(names), dtype=np.bool_)
        index, border = _centre_of(names), np.array(self.size) - 1.0
        centre = estimate.cameras[0, index]
        is_held[index] = (centre == 0.0) | (centre == border)
        return is_held

    def eccentricity(
        self, camera: Camera, estimate: Estimate, observed: Observations
    ) -> Eccentricity:
        """Return the offsets of all discs' centroids from the images of their centres."""
        return eccentricity(camera, observed_circles(self.field, estimate, observed))

    def point_prior(self, points: PointModel) -> PointPrior:
        """Return the prior of the field's points; unobserved points stay at their stated places."""
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
            # a weak prior of a tenth of the pitch: for what the photographs hardly determine
            sds = np.full_like(sds, 0.1 * self.field.pitch_m)
        return PointPrior(nominal, np.eye(3) * sds[:, None] ** -2.0, bars)

    def camera_prior(self, unknowns: NetworkUnknowns, camera: Camera) -> CalibrationPrior:
        """Return the prior of any camera: a central principal point and small distortion."""
        width, height = self.size
        corner = 0.5 * math.hypot(width, height) / camera.mean_focal_px
        middle = {"cx": 0.5 * (width - 1), "cy": 0.5 * (height - 1)}
        values, sd = [], []
        for name in unknowns.model(camera).names:
            values.append(middle.get(name, getattr(camera, name) if name[0] == "f" else 0.0))
            is_significant = name not in unknowns.insignificant
            sd.append(self._sd(name, camera, corner, is_significant=is_significant))
        return CalibrationPrior(np.array([values]), np.array([sd]))

    def _sd(self, name: str, camera: Camera, corner: float, *, is_significant: bool) -> float:
        """Return an a-priori standard deviation; `corner` is the corner's normalised radius."""
        if name in ("fx", "fy"):
            return _FOCAL_SD * camera.mean_focal_px
        if name in ("cx", "cy"):
            return _CENTRE_SD * max(self.size)
        of_any_lens = _TANGENTIAL_SD if name in ("p1", "p2") else _RADIAL_SD
        share = of_any_lens if is_significant else _USUAL_SD[name]
        return float(share / corner ** _RADIUS_POWER[name])

    def radius_scale(self, state: AdjustedNetwork) -> float:
        """Return the median ratio of measured to expected radii; those include distortion."""
        return float(np.nanmedian(self._radius_ratios(state)))

    def radius_scales(self, state: AdjustedNetwork) -> FloatArray:
        """Return `radius_scale` of each photograph (v,); NaN if none of its discs is used."""
        ratios, view = self._radius_ratios(state), state.network.observations.view
        used = np.isfinite(ratios)
        return np.array(
            [
                np.median(ratios[used & (view == k)]) if np.any(used & (view == k)) else np.nan
                for k in range(len(self.views))
            ]
        )

    def _radius_ratios(self, state: AdjustedNetwork) -> FloatArray:
        """Return the ratios (n,) of measured to expected radii; NaN for discs that are not used."""
        observed = self.observations()
        expected = circle_images(
            state.camera, observed_circles(self.field, state.estimate, observed)
        ).moments
        measured = np.concatenate([view.vectors for view in self.views])
        # the distortion of a hopeless adjustment may fold an outline, which then has no such radius
        usable = (_determinant(expected) > 0.0) & state.solution.is_used
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
    prior, sd = network.cameras.values.copy(), network.cameras.sd.copy()
    prior[0, index], sd[0, index] = values, _HELD_SD_PX
    return replace(network, cameras=CalibrationPrior(prior, sd))


def _determinant(moments: FloatArray) -> FloatArray:
    return moments[:, 2] * moments[:, 4] - moments[:, 3] ** 2


def _without(camera: Camera, terms: Sequence[str]) -> Camera:
    """Return a camera with all distortion terms but these set to zero."""
    absent = [name for name in _RADIUS_POWER if name not in terms]
    zeros: dict[str, Any] = dict.fromkeys(absent, 0.0)
    return replace(camera, **zeros)
