"""A circle in space from its images in oriented frames: centre, normal and radius.

The method follows Otepka & Fraser (2004), section 2.2, with two changes. The observations are
centroid and second moments of the circle's image (`kgcp.geometry.circle_image`), which are regular
everywhere, even for a circle seen frontally. The normal has two unknowns, instead of three elements
and a constraint.

Two circles of a given radius have the same image (Kager 1981). Frames from two different directions
distinguish them. Both are adjusted here, and the result includes how much worse the other one fits.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, special
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import (
    circle_derivatives,
    circle_images,
    moments_jacobian_by_calibration,
)
from kgcp.network.ground.circle_start import circle_starts
from kgcp.network.ground.moved_circle import Split
from kgcp.network.ground.space_circle import (
    CircleViews,
    ExtraNoise,
    NoCircleError,
    SpaceCircle,
    angle_deg,
    mean_radius,
    outline_noise,
)

LEAST_FRAMES = 2
"""Least number of frames that place a circle: a single ray has no intersection."""

_MAX_STEPS = 60
_ROUND_STEPS = 3  # steps per round of reweighting: the next weights move the minimum anyway
_CONVERGED = 1e-5  # decrease of χ² at which the iteration ends
_MAX_ROBUST_ROUNDS = 12
_SETTLED_COST = 1e-3  # change of χ² between two rounds at which the poses count as settled
_CAUCHY_CHI2 = 12.0  # χ² of a frame that has weight 1/2
_MEDIAN_CHI2 = 4.351  # of five numbers
_SAME_NORMAL_DEG = 0.5
_MIN_KEPT = 0.5  # share of the frames that must agree; otherwise the circle is refused
REJECTED_CHI2 = 37.0
"""Limit of the χ² of a frame's five numbers. Chance exceeds it once in 1.7 million, like 5 σ of a
single number."""

MAX_EXTRA_PX = 100.0
"""Largest additional standard deviation that is estimated [px]; if it is reached, nothing fits."""

# Stated variances are scaled down only with at least this many degrees of freedom, and by no
# smaller factor than this.
_MIN_FREEDOM, _MIN_FACTOR = 200, 0.25


@dataclass(frozen=True, slots=True, eq=False)
class CircleFit:
    """A circle adjusted to its images."""

    circle: SpaceCircle
    cov: FloatArray  # (6, 6): in the order of `SpaceCircle.moved`
    residuals: FloatArray  # (n, 5): observed minus computed moments
    chi2: FloatArray  # (n,): squared residuals of each frame over their covariance
    is_used: BoolArray  # (n,): whether a frame took part
    cost: float  # robust sum of χ² over all frames, to compare two fits

    @property
    def variance_factor(self) -> float:
        """χ² per degree of freedom, of the frames that are used."""
        freedom = 5 * int(np.count_nonzero(self.is_used)) - 6
        return float(np.sum(self.chi2[self.is_used])) / freedom


@dataclass(frozen=True, slots=True, eq=False)
class PlacedCircle:
    """A circle placed from many frames.

    Attributes
    ----------
    fit : CircleFit
        The fit with the better of the two normals.
    other : CircleFit or None
        The fit with the mirrored normal; None: it leads to the same circle.
    ambiguity : float
        Δχ² by which the mirrored normal fits worse.
    noise : ExtraNoise
        Noise added to the stated covariances.
    has_own_noise : bool
        Whether this noise is estimated for this circle alone, because its images contradict each
        other much more than those of the others.
    move : Split or None
        A move of the circle while it was photographed; the fit is to the frames of one place. None:
        there are no signs of a move.
    step : Split or None
        An apparent move that steps of the poses may explain; the fit is to the frames of both
        places. None: there are no signs of one.
    """

    fit: CircleFit
    other: CircleFit | None
    ambiguity: float
    noise: ExtraNoise
    has_own_noise: bool = False
    move: Split | None = None
    step: Split | None = None


def place_circle(
    camera: Camera,
    views: CircleViews,
    noise: ExtraNoise = ExtraNoise(),  # noqa: B008 - frozen
) -> PlacedCircle:
    """Adjust a circle to its images without approximate values, leaving out frames that do not fit.

    Parameters
    ----------
    camera : Camera
        Its distortion is applied to every point of the outline.
    views : CircleViews
        At least `LEAST_FRAMES` frames from different places.

    Returns
    -------
    PlacedCircle
        Its covariance lacks the errors that all frames share: see `common_covariance`.

    Raises
    ------
    NoCircleError
        If the rays do not meet in front of the cameras, no plane explains the shapes, or fewer than
        half of the frames agree.
    """
    starts = circle_starts(camera, views)
    fits = [fit for start in starts if (fit := _fit(camera, views, start, noise)) is not None]
    if not fits:
        raise NoCircleError("no circle has images like these")
    best = min(fits, key=lambda fit: fit.cost)
    mirrored = best.circle.mirrored(views.camera_m[best.is_used])
    other = _fit(camera, views, mirrored, noise)
    if other is not None and other.cost < best.cost:
        best, other = other, best
    if np.count_nonzero(best.is_used) < max(LEAST_FRAMES, _MIN_KEPT * len(views)):
        used = int(np.count_nonzero(best.is_used))
        raise NoCircleError(f"only {used} of {len(views)} frames agree with each other")
    if other is None or _is_same(best.circle, other.circle):
        return without_other(camera, views, best, noise)
    return PlacedCircle(best, other, other.cost - best.cost, noise)


def circle_through(camera: Camera, views: CircleViews, noise: ExtraNoise) -> SpaceCircle | None:
    """Return the least-squares circle of a few views, using all of them; None if there is none.

    Raises
    ------
    NoCircleError
        As `circle_starts`.
    """
    weights, best, least = np.ones(len(views)), None, math.inf
    for start in circle_starts(camera, views):
        covs = total_covariances(camera, views, start, noise)
        circle = _minimised(camera, views, start, covs, weights, _ROUND_STEPS)
        if circle is not None:
            cost = _weighted_cost(camera, views, circle, covs, weights)
            if cost < least:
                best, least = circle, cost
    return best


def without_other(
    camera: Camera, views: CircleViews, best: CircleFit, noise: ExtraNoise
) -> PlacedCircle:
    """Return a placed circle for which the mirrored normal leads to the same fit."""
    mirrored = best.circle.mirrored(views.camera_m[best.is_used])
    worse = _robust_cost(_chi2_of(camera, views, mirrored, noise))
    return PlacedCircle(best, None, max(0.0, worse - best.cost), noise)


def seen_in(camera: Camera, views: CircleViews, placed: PlacedCircle, part: BoolArray) -> CircleFit:
    """Return the fit to some of the frames (n,), completed by the residuals of all frames."""
    fit = placed.fit
    residuals = views.moments - circle_images(camera, fit.circle.in_cameras(views)).moments
    is_used = part.copy()
    is_used[part] = fit.is_used
    chi2 = _chi2_of(camera, views, fit.circle, placed.noise)
    return replace(fit, residuals=residuals, chi2=chi2, is_used=is_used)


def extra_noise(camera: Camera, placed: Sequence[tuple[CircleViews, CircleFit]]) -> ExtraNoise:
    """Return the noise of the images beyond the stated one, estimated from the residuals.

    It is estimated separately for places and shapes, so that χ² of all circles equals the degrees
    of freedom. If χ² is smaller with the stated covariances alone, and there are enough images,
    these are scaled down instead.
    """
    sds_px, factors, chances = [], [], []
    for part, unknowns in ((slice(0, 2), 3), (slice(2, 5), 3)):
        residuals, stated, unit, freedom = [], [], [], 0
        for views, fit in placed:
            kept = views.chosen(fit.is_used)
            covs = _stated(camera, kept, fit.circle)
            residuals.append(fit.residuals[fit.is_used][:, part])
            stated.append(covs[:, part, part])
            unit.append(outline_noise(kept.moments)[:, part, part])
            freedom += residuals[-1].size - unknowns
        sd, factor, ratio = _excess(
            np.concatenate(residuals), np.concatenate(stated), np.concatenate(unit), freedom
        )
        # small residuals do not prove exact poses: they hide pose errors that all frames share
        is_of_poses = part.start == 0 and any(views.exterior_cov is not None for views, _ in placed)
        independent = freedom * _independent_share(camera, placed, part)
        sds_px.append(sd)
        factors.append(1.0 if is_of_poses else factor)
        chances.append(float(special.chdtrc(independent, ratio * independent)))
    return ExtraNoise(*sds_px, *factors, *chances)


def _independent_share(
    camera: Camera, placed: Sequence[tuple[CircleViews, CircleFit]], part: slice
) -> float:
    """Return how many independent numbers have a χ² that scatters alike, as a share of all numbers.

    Circles in the same frame share the error of its orientation. If C are the covariances of single
    images, and F is the true one of all of them, χ² has the variance 2 tr(C⁻¹ F C⁻¹ F).

    Parameters
    ----------
    part : slice
        The moments that count.
    """
    numbers, squares = 0, 0.0
    of_frames: dict[Hashable, FloatArray] = {}
    for views, fit in placed:
        kept = views.chosen(fit.is_used)
        numbers += kept.moments[:, part].size
        if kept.exterior_cov is None:
            continue
        by_exterior = _moments_by_exterior(camera, kept, fit.circle)[:, part]
        weighted = np.linalg.solve(_stated(camera, kept, fit.circle)[:, part, part], by_exterior)
        shares = np.swapaxes(by_exterior, 1, 2) @ weighted @ np.nan_to_num(kept.exterior_cov)
        squares -= float(np.einsum("npq,nqp->", shares, shares))
        for frame, share in zip(kept.frame_keys, shares, strict=True):
            of_frames[frame] = of_frames.get(frame, np.zeros((6, 6))) + share
    squares += sum(float(np.sum(share * share.T)) for share in of_frames.values())
    return numbers / (numbers + squares) if numbers else 1.0


def common_covariance(
    camera: Camera,
    views: CircleViews,
    fit: CircleFit,
    noise: ExtraNoise,
    calibration_cov: FloatArray | None,
    edge_sd_px: float,
) -> FloatArray:
    """Return the covariance (6, 6) from errors that all frames share, which averaging keeps.

    There are four of them:

    - errors of the calibration;
    - a displacement of edges by the same number of pixels in all images;
    - the orientations, see `_common_by_orientations`;
    - the common errors of `views`.

    Parameters
    ----------
    calibration_cov : (12, 12) array or None
        Covariance of `CALIBRATION_PARAMETERS`; None: unknown.
    edge_sd_px : float
        Standard deviation of the common displacement of edges [px].
    """
    kept = views.chosen(fit.is_used)
    circles = fit.circle.in_cameras(kept)
    slopes = circle_derivatives(camera, circles)
    weights = np.linalg.inv(total_covariances(camera, kept, fit.circle, noise))
    design = _design(kept, fit.circle, slopes.by_centre, slopes.by_rotation, slopes.by_radius)
    gain = fit.cov @ np.einsum("nmp,nmk->npk", design, weights).transpose(1, 0, 2).reshape(6, -1)
    common = np.zeros((6, 6))
    if calibration_cov is not None:
        by_calibration = moments_jacobian_by_calibration(camera, circles).reshape(
            -1, len(calibration_cov)
        )
        by_calibration = -gain @ by_calibration
        common += by_calibration @ calibration_cov @ by_calibration.T
    # a displacement δ along the whole outline changes the mean moment a²/4 by a δ / 2
    radius = mean_radius(kept.moments)
    wider = np.zeros((len(kept), 5))
    wider[:, 2] = wider[:, 4] = 0.5 * radius
    by_edge = gain @ wider.ravel() * edge_sd_px
    common += np.outer(by_edge, by_edge)
    by_exterior = _moments_by_exterior(camera, kept, fit.circle)
    if kept.exterior_cov is not None:
        gain_of_frame = gain.reshape(6, -1, 5).transpose(1, 0, 2)
        common += _common_by_orientations(kept.exterior_cov, by_exterior, gain_of_frame)
    if kept.common_effects is not None:
        by_errors = gain @ (by_exterior @ kept.common_effects).reshape(-1, 6)
        common += by_errors @ by_errors.T
    return common


def _common_by_orientations(
    exterior_cov: FloatArray, by_exterior: FloatArray, gain: FloatArray
) -> FloatArray:
    """Return the covariance (6, 6) from errors that n orientations share.

    How much of their errors is common is unknown, and a block with few control points shifts as a
    whole. If nothing is known of correlations, the projection centres shift with their mean
    covariance. Otherwise the orientations follow from points on the ground, whose errors are common
    to all of them. The covariance of a sum of n effects, however they are correlated, is at most n
    times the sum of their covariances.

    Parameters
    ----------
    exterior_cov : (n, 6, 6) array
    by_exterior : (n, 5, 6) array
        Derivatives of the moments by the orientations.
    gain : (n, 6, 5) array
        Derivatives of the circle's unknowns by the moments.
    """
    if not exterior_cov[:, :3, 3:].any():
        common = np.zeros((6, 6))
        common[:3, :3] = exterior_cov[:, :3, :3].mean(axis=0)
        return common
    effects = gain @ by_exterior
    each = effects @ exterior_cov @ np.swapaxes(effects, 1, 2)
    return np.asarray(len(each) * each.sum(axis=0))


def _fit(
    camera: Camera, views: CircleViews, start: SpaceCircle, noise: ExtraNoise
) -> CircleFit | None:
    """Return the robust fit from a start; None if it does not converge to a circle."""
    circle, weights = start, np.ones(len(views))
    for _ in range(_MAX_ROBUST_ROUNDS):
        covs = total_covariances(camera, views, circle, noise)
        moved = _minimised(camera, views, circle, covs, weights, _ROUND_STEPS)
        if moved is None:
            return None
        circle = moved
        chi2 = _chi2(camera, views, circle, covs)
        scale = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)
        next_weights = 1.0 / (1.0 + chi2 / (_CAUCHY_CHI2 * scale))
        is_settled = np.allclose(next_weights, weights, atol=1e-3)
        weights = next_weights
        if is_settled:
            break
    return fit_to_agreeing(camera, views, circle, noise)


def fit_to_agreeing(
    camera: Camera, views: CircleViews, circle: SpaceCircle, noise: ExtraNoise
) -> CircleFit | None:
    """Return the fit to the frames that agree; the others are rejected."""
    used, at = np.zeros(len(views), dtype=np.bool_), views
    covs = total_covariances(camera, at, circle, noise)
    chi2 = _chi2(camera, at, circle, covs)
    cost = math.inf
    for _ in range(_MAX_ROBUST_ROUNDS):
        scale = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)
        kept = chi2 <= REJECTED_CHI2 * scale
        is_settled = at is views or abs(cost - _robust_cost(chi2)) <= _SETTLED_COST
        if (np.array_equal(kept, used) and is_settled) or np.count_nonzero(kept) < LEAST_FRAMES:
            break
        used, cost = kept, _robust_cost(chi2)
        moved = _minimised(camera, at, circle, covs, used.astype(np.float64))
        if moved is None:
            return None
        circle = moved
        at = _at_likely_poses(camera, views, at, circle, noise)
        covs = total_covariances(camera, at, circle, noise)
        chi2 = _chi2(camera, at, circle, covs)
    if not used.any():
        return None
    normal = _normal_equations(camera, at.chosen(used), circle, covs[used])[0]
    if not np.linalg.cond(_unit_diagonal(normal)) < 1e13:
        return None
    residuals = views.moments - circle_images(camera, circle.in_cameras(views)).moments
    cov = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return CircleFit(circle, cov, residuals, chi2, used, _robust_cost(chi2))


def _at_likely_poses(
    camera: Camera, views: CircleViews, at: CircleViews, circle: SpaceCircle, noise: ExtraNoise
) -> CircleViews:
    """Return the views with the poses and, for these, the moments that a circle makes likely.

    The equations of a circle are linear at `at`. Evaluated at the stated poses, they would have the
    errors of these in their coefficients, and the circle would seem to be farther away and larger.
    The moments are changed by the effect of the change of the poses, so that the residuals are
    those with the stated poses, to first order (the Gauss-Helmert model).

    Parameters
    ----------
    views, at : CircleViews
        With the stated poses, and with those of the round before.
    """
    if views.exterior_cov is None:
        return views
    by_exterior = _moments_by_exterior(camera, at, circle)
    residuals = at.moments - circle_images(camera, circle.in_cameras(at)).moments
    covs = total_covariances(camera, at, circle, noise)
    back = np.einsum("nmp,nm->np", by_exterior, np.linalg.solve(covs, residuals[..., None])[..., 0])
    change = np.einsum("npq,nq->np", views.exterior_cov, back)
    if not np.isfinite(change).all():
        return at
    moved = replace(
        views,
        camera_m=views.camera_m + change[:, :3],
        world_from_camera=np.asarray(
            Rotation.from_rotvec(change[:, 3:]).as_matrix() @ views.world_from_camera
        ),
    )
    effect = np.einsum("nmp,np->nm", _moments_by_exterior(camera, moved, circle), change)
    return replace(moved, moments=views.moments + effect)


def _minimised(
    camera: Camera,
    views: CircleViews,
    circle: SpaceCircle,
    covs: FloatArray,
    weights: FloatArray,
    max_steps: int = _MAX_STEPS,
) -> SpaceCircle | None:
    """Return the circle with the least weighted squares, by Levenberg's damped steps."""
    damping, cost = 1e-4, _weighted_cost(camera, views, circle, covs, weights)
    if not math.isfinite(cost):
        return None
    weighted = covs / np.maximum(weights, 1e-12)[:, None, None]
    for _ in range(max_steps):
        normal, right = _normal_equations(camera, views, circle, weighted)
        scale = 1.0 / np.sqrt(np.diag(normal))
        while True:
            damped = _unit_diagonal(normal) + damping * np.eye(6)
            step = scale * np.linalg.solve(damped, scale * right)
            trial = circle.moved(step) if circle.radius_m + step[5] > 0.0 else circle
            trial_cost = _weighted_cost(camera, views, trial, covs, weights)
            if trial_cost < cost or damping > 1e8:
                break
            damping *= 10.0
        if not trial_cost < cost:
            return circle
        is_done = cost - trial_cost <= _CONVERGED
        circle, cost, damping = trial, trial_cost, max(0.1 * damping, 1e-12)
        if is_done:
            break
    return circle


def _unit_diagonal(normal: FloatArray) -> FloatArray:
    size = np.sqrt(np.diag(normal))
    return np.asarray(normal / np.outer(size, size))


def _weighted_cost(
    camera: Camera,
    views: CircleViews,
    circle: SpaceCircle,
    covs: FloatArray,
    weights: FloatArray,
) -> float:
    is_used = weights > 0.0
    squares = _chi2(camera, views, circle, covs)[is_used]
    return float(np.sum(weights[is_used] * squares)) if np.isfinite(squares).all() else math.inf


def _chi2(camera: Camera, views: CircleViews, circle: SpaceCircle, covs: FloatArray) -> FloatArray:
    """Return the χ² (n,) of all frames; infinite if the circle is not in front of the camera."""
    residuals = views.moments - circle_images(camera, circle.in_cameras(views)).moments
    squares = np.einsum("nm,nm->n", residuals, np.linalg.solve(covs, residuals[..., None])[..., 0])
    return np.asarray(np.where(np.isfinite(squares), squares, np.inf))


def _chi2_of(
    camera: Camera, views: CircleViews, circle: SpaceCircle, noise: ExtraNoise
) -> FloatArray:
    return _chi2(camera, views, circle, total_covariances(camera, views, circle, noise))


def _robust_cost(chi2: FloatArray) -> float:
    return float(np.sum(np.minimum(chi2, REJECTED_CHI2)))


def _normal_equations(
    camera: Camera, views: CircleViews, circle: SpaceCircle, covs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return normal matrix (6, 6) and right-hand side (6,)."""
    circles = circle.in_cameras(views)
    slopes = circle_derivatives(camera, circles)
    design = _design(views, circle, slopes.by_centre, slopes.by_rotation, slopes.by_radius)
    residuals = views.moments - slopes.moments
    weighted = np.linalg.solve(covs, design)
    normal = np.einsum("nmp,nmq->pq", weighted, design)
    return 0.5 * (normal + normal.T), np.einsum("nmp,nm->p", weighted, residuals)


def _design(
    views: CircleViews,
    circle: SpaceCircle,
    by_centre: FloatArray,
    by_rotation: FloatArray,
    by_radius: FloatArray,
) -> FloatArray:
    """Return the derivatives (n, 5, 6) of the moments by the circle's unknowns."""
    camera_from_world = np.swapaxes(views.world_from_camera, 1, 2)
    turned = by_rotation @ camera_from_world @ circle.axes
    return np.concatenate((by_centre @ camera_from_world, turned, by_radius[..., None]), axis=2)


def total_covariances(
    camera: Camera, views: CircleViews, circle: SpaceCircle, noise: ExtraNoise
) -> FloatArray:
    """Return the covariances (n, 5, 5) of moments by all errors that differ between frames."""
    unit = outline_noise(views.moments)
    extra = np.zeros_like(unit)
    extra[:, :2, :2] = noise.centre_px**2 * unit[:, :2, :2]
    extra[:, 2:, 2:] = noise.outline_px**2 * unit[:, 2:, 2:]
    scale = np.sqrt([noise.centre_factor] * 2 + [noise.outline_factor] * 3)
    return np.asarray(_stated(camera, views, circle) * np.outer(scale, scale) + extra)


def _stated(camera: Camera, views: CircleViews, circle: SpaceCircle) -> FloatArray:
    """Return the stated covariances (n, 5, 5) of the moments: by images and orientations."""
    if views.exterior_cov is None:
        return views.cov
    by_exterior = _moments_by_exterior(camera, views, circle)
    share = by_exterior @ views.exterior_cov @ np.swapaxes(by_exterior, 1, 2)
    return np.asarray(views.cov + np.nan_to_num(share))


def _moments_by_exterior(camera: Camera, views: CircleViews, circle: SpaceCircle) -> FloatArray:
    """Return the derivatives (n, 5, 6) of the moments by the exterior orientations.

    With R' = exp(ω) R and C' = C + δ, the circle moves in the camera's frame by
    Rᵀ((X − C) × ω − δ), and turns by −Rᵀ ω.
    """
    slopes = circle_derivatives(camera, circle.in_cameras(views))
    camera_from_world = np.swapaxes(views.world_from_camera, 1, 2)
    by_place = slopes.by_centre @ camera_from_world
    by_turn = by_place @ cross_matrix(circle.centre_m - views.camera_m)
    by_turn = by_turn - slopes.by_rotation @ camera_from_world
    return np.concatenate((-by_place, by_turn), axis=2)


def _excess(
    residuals: FloatArray, stated: FloatArray, unit: FloatArray, freedom: int
) -> tuple[float, float, float]:
    """Return σ ≥ 0 and a factor ≤ 1 with which χ² equals `freedom`, and χ² / `freedom` without.

    Covariances are `stated` + σ² `unit`, or the factor times `stated`.
    """

    def squares(sd: float) -> float:
        solved = np.linalg.solve(stated + sd**2 * unit, residuals[..., None])[..., 0]
        return float(np.sum(residuals * solved))

    if freedom <= 0:
        return 0.0, 1.0, 1.0
    ratio = squares(0.0) / freedom
    if ratio <= 1.0:
        return 0.0, max(ratio, _MIN_FACTOR) if freedom >= _MIN_FREEDOM else 1.0, ratio
    if squares(MAX_EXTRA_PX) > freedom:
        return MAX_EXTRA_PX, 1.0, ratio
    sd = optimize.brentq(lambda sd: squares(sd) - freedom, 0.0, MAX_EXTRA_PX, xtol=1e-12)
    return float(sd), 1.0, ratio


def _is_same(first: SpaceCircle, second: SpaceCircle) -> bool:
    return angle_deg(first.normal, second.normal) < _SAME_NORMAL_DEG
