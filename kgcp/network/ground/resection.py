"""Resection: the exterior orientation of one frame from points of known position in it.

Names may be wrong. Hypotheses come from triples of points (P3P, up to four solutions each) and
the one on which most points agree is adjusted with the covariances of images and positions; what
does not agree is left out. Of points in one plane the mirrored solution is followed to the end as
well. No solution has a point behind the camera: on the flat part of a field such a one may fit
within hundredths of a pixel.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import chdtri

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import cross_matrix, rotation_onto
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about

MIN_POINTS = 4
"""Points that must agree by default: three have up to four poses, a fourth tells them apart."""

MIN_MARGIN = 13.8
"""Δχ² of the next best pose from which on a pose counts: odds of 1000 to 1."""

_MOST_TRIPLES = 200
_REJECTED_CHI2 = 25.0  # of three numbers: by chance once in 65 000
_REFINED = 4  # best hypotheses that are adjusted
_MOST_STEPS, _ROUND_STEPS = 40, 3  # of an adjustment, and between two reweightings
_CONVERGED = 1e-5  # decrease of χ² that means nothing
_ROUNDS = 10
_SAME_RAD, _SAME_SHARE = 2e-3, 2e-3  # of two poses that are one: turn, and shift over distance
_START_PX, _START_SHARE = 2.0, 0.01  # what a hypothesis of three points with noise is off by
# Four points without distances leave two numbers to check a name by. In one of 1800 frames a wrong
# one passed the limit of single points; this one is for all together.
_FEW_CHECKS, _FEW_CHECKS_CHANCE = 2, 0.01
_MOST_TURN_SD = 0.02  # [rad]: beyond it covariances of first order do not hold
_NO_DISTANCE = 1e6  # deviation of the logarithm of a distance that is not measured


@dataclass(frozen=True, slots=True, eq=False)
class PointImages:
    """n points of known position in one frame."""

    positions_m: FloatArray  # (n, 3): in a Cartesian frame, called the world
    position_cov: FloatArray  # (n, 3, 3): zeros: exact
    pixels: FloatArray  # (n, 2): images of the points, raw pixels
    pixel_cov: FloatArray  # (n, 2, 2)
    distances_m: FloatArray  # (n,): camera to point, as the image's size says; NaN: not known
    sd_distances_m: FloatArray  # (n,)

    def __len__(self) -> int:
        return len(self.pixels)

    def chosen(self, which: BoolArray) -> PointImages:
        """Return some of the points."""
        return PointImages(
            self.positions_m[which],
            self.position_cov[which],
            self.pixels[which],
            self.pixel_cov[which],
            self.distances_m[which],
            self.sd_distances_m[which],
        )

    @property
    def has_distance(self) -> BoolArray:
        """Whether the distance of each point is known (n,)."""
        return np.asarray(np.isfinite(self.distances_m))


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """Exterior orientation of one frame."""

    centre_m: FloatArray  # (3,): projection centre in the world
    world_from_camera: FloatArray  # (3, 3): camera axes in the world, as columns
    focal_scale: float = 1.0  # of the camera's principal distances

    def moved(self, step: FloatArray) -> CameraPose:
        """Return the pose after a step: shift [m], left rotation [rad], relative focal length."""
        turn = rotation_about(np.ascontiguousarray(step[3:6]))
        scale = self.focal_scale * math.exp(step[6]) if len(step) > 6 else self.focal_scale
        return CameraPose(self.centre_m + step[:3], turn @ self.world_from_camera, scale)

    def in_camera(self, points_m: FloatArray) -> FloatArray:
        """Bring points (n, 3) of the world into the camera frame."""
        return (points_m - self.centre_m) @ self.world_from_camera


@dataclass(frozen=True, slots=True, eq=False)
class Resection:
    """An oriented frame.

    Attributes
    ----------
    pose : CameraPose
    cov : (6, 6) or (7, 7) array
        Position [m], left rotation vector [rad], both along the world's axes; with an unknown
        focal length, its relative change.
    residuals : (n, 3) array
        Observed minus computed place [px] and logarithm of the distance (NaN where it is unknown).
    chi2 : (n,) array
        Squared residuals of each point over their covariance.
    is_used : (n,) array
        Whether a point agrees with the pose.
    margin : float
        Δχ² by which the next best pose fits worse; every point counts up to a limit.
    other : CameraPose or None
        That pose; None: no other explains any three points.
    """

    pose: CameraPose
    cov: FloatArray
    residuals: FloatArray
    chi2: FloatArray
    is_used: BoolArray
    margin: float
    other: CameraPose | None

    @property
    def observations(self) -> int:
        """Numbers that took part."""
        return int(np.count_nonzero(np.isfinite(self.residuals[self.is_used])))

    @property
    def variance_factor(self) -> float | None:
        """Squares of the residuals per degree of freedom; None: there is none."""
        freedom = self.observations - len(self.cov)
        return None if freedom <= 0 else float(np.sum(self.chi2[self.is_used])) / freedom


class NoPoseError(Exception):
    """The points give no pose, or more than one."""


def orient(
    camera: Camera,
    images: PointImages,
    *,
    min_points: int = MIN_POINTS,
    focals: Sequence[float] = (1.0,),
    sd_focal: float = 0.0,
    seed: int = 0,
) -> Resection:
    """Return the pose of a frame from points in it, some of which may have wrong names.

    Parameters
    ----------
    camera : Camera
    images : PointImages
        At least three points.
    min_points : int
        How many points must agree; points with a distance check a pose by themselves, so that
        three are enough then.
    focals : sequence of float
        Multiples of the camera's focal length that are tried as starts.
    sd_focal : float
        Relative standard deviation of the focal length before; 0: it is known.
    seed : int
        Of the triples that are drawn, where there are very many.

    Raises
    ------
    NoPoseError
        If too few points agree, the next best pose fits nearly as well, or all points lie in a
        line.
    """
    if len(images) < 3:
        raise NoPoseError(f"{len(images)} known points; a pose needs three")
    hypotheses = list(_hypotheses(camera, images, focals, seed))
    if not hypotheses:
        raise NoPoseError("no triple of points has a pose in front of the camera")
    costs = _hypothesis_costs(camera, images, hypotheses)
    fits: list[tuple[float, CameraPose, BoolArray]] = []
    tried: list[CameraPose] = []
    for row in np.argsort(costs, kind="stable"):
        if len(tried) == _REFINED:
            break
        start = hypotheses[row]
        if any(_is_same(start, other, 10.0) for other in tried):
            continue
        tried.append(start)
        fits += _followed(camera, images, start, sd_focal)
    if not fits:
        raise NoPoseError("no pose explains three of the points")
    fits.sort(key=lambda fit: fit[0])
    cost, pose, used = fits[0]
    others = [fit for fit in fits[1:] if not _is_same(pose, fit[1], 1.0)]
    margin, other = (others[0][0] - cost, others[0][1]) if others else (math.inf, None)
    _require_agreement(images, used, min_points)
    if margin < MIN_MARGIN:
        raise NoPoseError(f"two poses fit alike (Δχ² {margin:.1f})")
    result = _result(camera, images, pose, used, sd_focal)
    if result is None:
        raise NoPoseError("the points do not determine the pose: they lie in a line")
    cov, residuals, chi2 = result
    turn_sd = math.sqrt(float(np.linalg.eigvalsh(cov[3:6, 3:6])[-1]))
    if turn_sd > _MOST_TURN_SD:
        raise NoPoseError(f"the points hardly determine the pose (± {math.degrees(turn_sd):.1f}°)")
    oriented = Resection(pose, cov, residuals, chi2, used, margin, other)
    _require_fit(oriented)
    return oriented


def _require_fit(oriented: Resection) -> None:
    """Refuse a pose that hardly anything checks, if that does not fit well."""
    freedom = oriented.observations - len(oriented.cov)
    total = float(np.sum(oriented.chi2[oriented.is_used]))
    if 0 < freedom <= _FEW_CHECKS and total > chdtri(freedom, _FEW_CHECKS_CHANCE):
        raise NoPoseError(f"so few points must agree better (χ² {total:.0f} of {freedom})")


def _require_agreement(images: PointImages, used: BoolArray, min_points: int) -> None:
    count = int(np.count_nonzero(used))
    needed = min(3, min_points) if images.has_distance[used].all() else min_points
    if count < needed:
        raise NoPoseError(f"{count} of {len(images)} points agree; {needed} are needed")
    if 2 * count < len(images):
        raise NoPoseError(f"only {count} of {len(images)} points agree with each other")


def _hypotheses(
    camera: Camera, images: PointImages, focals: Sequence[float], seed: int
) -> Iterator[CameraPose]:
    """Yield all poses of triples of points, none of them behind the camera."""
    triples = _triples(len(images), seed)
    for focal in focals:
        rays = _normalised(camera, images.pixels, focal)
        for triple in triples:
            for pose in three_point_poses(images.positions_m[triple], rays[triple]):
                yield CameraPose(pose.centre_m, pose.world_from_camera, focal)
            if images.has_distance[triple].all():
                distances = focal * images.distances_m[triple]
                aligned = _aligned_pose(images.positions_m[triple], rays[triple], distances)
                if aligned is not None:
                    yield CameraPose(aligned.centre_m, aligned.world_from_camera, focal)


def _aligned_pose(
    positions_m: FloatArray, rays: FloatArray, distances_m: FloatArray
) -> CameraPose | None:
    """Return the pose in which points (3, 3) best lie at distances along rays; None: in a line.

    Where noise leaves no exact pose of three points, near their critical cylinder, this is one.
    """
    directions = np.column_stack((rays, np.ones(len(rays))))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    in_camera = directions * distances_m[:, None]
    if _are_in_line(positions_m) or _are_in_line(in_camera):
        return None
    rotation = rotation_onto(in_camera, positions_m)
    return CameraPose(positions_m.mean(axis=0) - rotation @ in_camera.mean(axis=0), rotation)


def _are_in_line(points: FloatArray) -> bool:
    """Tell whether three points (3, 3) lie in a line, but for rounding."""
    first, second = points[1] - points[0], points[2] - points[0]
    limit = 1e-9 * float(first @ first + second @ second)
    return not float(np.linalg.norm(np.cross(first, second))) > limit


def _triples(count: int, seed: int) -> list[list[int]]:
    """Return triples of points: all, or some that are drawn."""
    if math.comb(count, 3) <= _MOST_TRIPLES:
        return [list(triple) for triple in itertools.combinations(range(count), 3)]
    rng = np.random.default_rng([seed, count])
    return [sorted(rng.choice(count, 3, replace=False).tolist()) for _ in range(_MOST_TRIPLES)]


def three_point_poses(positions_m: FloatArray, rays: FloatArray) -> Iterator[CameraPose]:
    """Yield the poses, at most four, in which three points (3, 3) lie on rays (3, 2).

    Rays are normalised coordinates. Points behind the camera are no pose.
    """
    middle = positions_m.mean(axis=0)
    try:
        _, turns, shifts = cv2.solveP3P(
            np.ascontiguousarray(positions_m - middle).reshape(3, 1, 3),
            np.ascontiguousarray(rays).reshape(3, 1, 2),
            np.eye(3),
            None,
            flags=cv2.SOLVEPNP_AP3P,
        )
    except cv2.error:  # three points in a line
        return
    for turn, shift in zip(turns or (), shifts or (), strict=True):
        if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
            continue
        rotation = rotation_about(np.ascontiguousarray(turn.ravel()))
        depths = (positions_m - middle) @ rotation[2] + float(shift[2, 0])
        if np.all(depths > 0.0):
            yield CameraPose(middle - rotation.T @ shift.ravel(), rotation.T)


def _normalised(camera: Camera, pixels: FloatArray, focal: float) -> FloatArray:
    """Return normalised coordinates (n, 2) for a focal length that is a multiple of the camera's.

    The distortion stays where it is in the image.
    """
    return np.asarray(camera.undistort(pixels) / focal)


def _projected(
    camera: Camera, pose: CameraPose, points_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return pixels (n, 2), NaN behind the camera, and points in the camera frame (n, 3)."""
    points = pose.in_camera(points_m)
    depth = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
    return camera.distort(pose.focal_scale * points[:, :2] / depth[:, None]), points


def _residuals(camera: Camera, images: PointImages, pose: CameraPose) -> FloatArray:
    """Return observed minus computed places [px] and logarithms of distances (n, 3)."""
    pixels, points = _projected(camera, pose, images.positions_m)
    logs = np.log(images.distances_m * pose.focal_scale / np.linalg.norm(points, axis=1))
    return np.column_stack((images.pixels - pixels, logs))


def _design(camera: Camera, images: PointImages, pose: CameraPose) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (n, 3, 7) by the pose's step and (n, 3, 3) by the points' positions.

    A distance by an image's size grows with the focal length; it belongs to the camera's own.
    """
    points = pose.in_camera(images.positions_m)
    normalised = pose.focal_scale * points[:, :2] / points[:, 2:]
    lens = camera.distort_jacobian(normalised)
    to_plane = np.zeros((len(images), 2, 3))
    to_plane[:, 0, 0] = to_plane[:, 1, 1] = pose.focal_scale
    to_plane[:, :, 2] = -normalised
    by_camera_point = np.empty((len(images), 3, 3))
    by_camera_point[:, :2] = lens @ (to_plane / points[:, 2, None, None])
    by_camera_point[:, 2] = points / np.sum(points**2, axis=1)[:, None]
    by_point = by_camera_point @ pose.world_from_camera.T
    by_focal = np.zeros((len(images), 3, 1))
    by_focal[:, :2, 0] = np.einsum("nij,nj->ni", lens, normalised)
    by_focal[:, 2, 0] = -1.0
    # with R' = exp(ω) R a point moves by (X − C) × ω in the world's axes
    by_turn = by_point @ cross_matrix(images.positions_m - pose.centre_m)
    return np.concatenate((-by_point, by_turn, by_focal), axis=2), by_point


def _covariances(images: PointImages, by_point: FloatArray) -> FloatArray:
    """Return the covariances (n, 3, 3) of the observations, those of the positions included."""
    cov = by_point @ images.position_cov @ np.swapaxes(by_point, 1, 2)
    cov[:, :2, :2] += images.pixel_cov
    known = images.has_distance
    cov[~known, 2, :] = cov[~known, :, 2] = 0.0
    cov[known, 2, 2] += (images.sd_distances_m[known] / images.distances_m[known]) ** 2
    cov[~known, 2, 2] = _NO_DISTANCE**2
    return np.asarray(cov)


def _chi2(residuals: FloatArray, cov: FloatArray) -> FloatArray:
    """Return squared residuals (n,) over covariances; infinite behind the camera."""
    behind = ~np.isfinite(residuals[:, 0])
    known = np.nan_to_num(residuals)
    squares = np.einsum("nm,nm->n", known, np.linalg.solve(cov, known[..., None])[..., 0])
    return np.asarray(np.where(behind, np.inf, squares))


def _hypothesis_costs(
    camera: Camera, images: PointImages, poses: Sequence[CameraPose]
) -> FloatArray:
    """Return how many points each of m poses from three of them does not explain, roughly (m,).

    Such a pose has the noise of its three points, so that some pixels do not count.
    """
    centres = np.array([pose.centre_m for pose in poses])
    rotations = np.array([pose.world_from_camera for pose in poses])
    focals = np.array([pose.focal_scale for pose in poses])
    points = np.einsum("pni,pij->pnj", images.positions_m - centres[:, None], rotations)
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    pixels = camera.distort(focals[:, None, None] * points[..., :2] / depth[..., None])
    off2 = np.sum((images.pixels - pixels) ** 2, axis=-1)
    distance = np.linalg.norm(points, axis=-1)
    mean_cov = np.trace(images.position_cov, axis1=1, axis2=2) / 3.0
    variance = (
        _START_PX**2
        + 0.5 * np.trace(images.pixel_cov, axis1=1, axis2=2)
        + mean_cov * (camera.mean_focal_px / distance) ** 2
    )
    chi2 = off2 / variance
    share = np.log(images.distances_m * focals[:, None] / distance)
    sd2 = _START_SHARE**2 + (images.sd_distances_m / images.distances_m) ** 2
    chi2 += np.nan_to_num(share**2 / sd2)
    return np.asarray(np.sum(np.minimum(np.nan_to_num(chi2, nan=np.inf), _REJECTED_CHI2), axis=1))


def _followed(
    camera: Camera, images: PointImages, start: CameraPose, sd_focal: float
) -> Iterator[tuple[float, CameraPose, BoolArray]]:
    """Yield the adjusted pose of a hypothesis, and of its mirror image in the points' plane."""
    fit = _robust_fit(camera, images, start, sd_focal)
    if fit is None:
        return
    yield fit
    used = fit[2]
    mirrored = _mirrored(images.chosen(used), fit[1])
    if mirrored is not None:
        other = _robust_fit(camera, images, mirrored, sd_focal)
        if other is not None:
            yield other


def _mirrored(images: PointImages, pose: CameraPose) -> CameraPose | None:
    """Return the pose with the points' mean plane mirrored about the ray of their middle."""
    middle = images.positions_m.mean(axis=0)
    spread = images.positions_m - middle
    normal = np.linalg.svd(spread)[2][-1]
    ray = middle - pose.centre_m
    distance = float(np.linalg.norm(ray))
    ray = ray / distance
    axis = np.cross(normal, ray)
    sine, cosine = float(np.linalg.norm(axis)), float(normal @ ray)
    if sine < 1e-6:
        return None
    # the points turn in the camera's frame: the camera about their middle, the other way round
    turn = rotation_about(np.ascontiguousarray(-axis / sine * 2.0 * math.atan2(sine, cosine)))
    return CameraPose(
        middle - turn @ (middle - pose.centre_m), turn @ pose.world_from_camera, pose.focal_scale
    )


def _robust_fit(
    camera: Camera, images: PointImages, start: CameraPose, sd_focal: float
) -> tuple[float, CameraPose, BoolArray] | None:
    """Return cost, pose and points that agree; None: fewer than three do."""
    pose = start
    weights = _cauchy(_total_chi2(camera, images, pose, _START_PX))
    for _ in range(_ROUNDS):
        moved = _minimised(camera, images, pose, weights, sd_focal, _ROUND_STEPS)
        if moved is None:
            return None
        pose = moved
        renewed = _cauchy(_total_chi2(camera, images, pose, 0.0))
        is_settled = np.allclose(renewed, weights, atol=1e-2)
        weights = renewed
        if is_settled:
            break
    used = np.zeros(len(images), dtype=np.bool_)
    for _ in range(_ROUNDS):
        agree = _total_chi2(camera, images, pose, 0.0) <= _REJECTED_CHI2
        if np.count_nonzero(agree) < 3:
            return None
        if np.array_equal(agree, used):
            break
        used = agree
        moved = _minimised(camera, images, pose, used.astype(np.float64), sd_focal)
        if moved is None:
            return None
        pose = moved
    chi2 = _total_chi2(camera, images, pose, 0.0)
    prior = (math.log(pose.focal_scale) / sd_focal) ** 2 if sd_focal else 0.0
    return float(np.sum(np.minimum(chi2, _REJECTED_CHI2))) + prior, pose, used


def adjusted_pose(
    camera: Camera, images: PointImages, start: CameraPose, sd_focal: float
) -> tuple[CameraPose, FloatArray, FloatArray] | None:
    """Return pose, covariance and residuals (n, 3) of an adjustment to all points.

    Parameters
    ----------
    start : CameraPose
        Near enough that all points lie in front of the camera.
    sd_focal : float
        As for `orient`.

    Returns
    -------
    tuple or None
        None: a point falls behind the camera, or the pose is not determined.
    """
    used = np.ones(len(images), dtype=np.bool_)
    pose = _minimised(camera, images, start, used.astype(np.float64), sd_focal)
    result = None if pose is None else _result(camera, images, pose, used, sd_focal)
    if pose is None or result is None:
        return None
    return pose, result[0], result[1]


def _cauchy(chi2: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + chi2 / 9.0))


def _total_chi2(
    camera: Camera, images: PointImages, pose: CameraPose, slack_px: float
) -> FloatArray:
    residuals = _residuals(camera, images, pose)
    ahead = np.isfinite(residuals[:, 0])
    chi2 = np.full(len(images), np.inf)
    if ahead.any():
        kept = images.chosen(ahead)
        _, by_point = _design(camera, kept, pose)
        cov = _covariances(kept, by_point)
        cov[:, :2, :2] += slack_px**2 * np.eye(2)
        chi2[ahead] = _chi2(residuals[ahead], cov)
    return chi2


def _minimised(
    camera: Camera,
    images: PointImages,
    start: CameraPose,
    weights: FloatArray,
    sd_focal: float,
    most_steps: int = _MOST_STEPS,
) -> CameraPose | None:
    """Return the pose with the least weighted squares; None if a point falls behind the camera."""
    counted = weights > 1e-9
    kept, weight = images.chosen(counted), weights[counted]
    if np.count_nonzero(counted) < 3:
        return None
    pose, damping = start, 1e-6
    normal, right, cost = _normal_equations(camera, kept, pose, weight, sd_focal)
    if not math.isfinite(cost):
        return None
    for _ in range(most_steps):
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        unit = normal * np.outer(scale, scale)
        while True:
            step = scale * np.linalg.solve(unit + damping * np.eye(len(unit)), scale * right)
            trial = pose.moved(step)
            trial_normal, trial_right, trial_cost = _normal_equations(
                camera, kept, trial, weight, sd_focal
            )
            if trial_cost < cost or damping > 1e6:
                break
            damping = max(10.0 * damping, 1e-6)
        if not trial_cost < cost:
            return pose
        is_done = cost - trial_cost <= _CONVERGED
        pose, normal, right, cost = trial, trial_normal, trial_right, trial_cost
        damping *= 0.1
        if is_done:
            break
    return pose


def _normal_equations(
    camera: Camera,
    images: PointImages,
    pose: CameraPose,
    weights: FloatArray,
    sd_focal: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Return normal matrix, right-hand side and weighted squares; the focal length if unknown."""
    residuals = _residuals(camera, images, pose)
    unknowns = 7 if sd_focal else 6
    if not np.isfinite(residuals[:, 0]).all():
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    design, by_point = _design(camera, images, pose)
    design, known = design[:, :, :unknowns], np.nan_to_num(residuals)
    cov = _covariances(images, by_point)
    try:
        solved = np.linalg.solve(cov, np.concatenate((design, known[..., None]), axis=2))
    except np.linalg.LinAlgError:  # a step to where a point is in the camera
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    weighted = weights[:, None, None] * solved
    normal = np.einsum("nmp,nmq->pq", design, weighted[..., :-1])
    right = np.einsum("nmp,nm->p", design, weighted[..., -1])
    cost = float(np.einsum("nm,nm->", known, weighted[..., -1]))
    if sd_focal:
        off = math.log(pose.focal_scale)
        normal[6, 6] += 1.0 / sd_focal**2
        right[6] -= off / sd_focal**2
        cost += (off / sd_focal) ** 2
    return normal, right, cost


def _result(
    camera: Camera, images: PointImages, pose: CameraPose, used: BoolArray, sd_focal: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return covariance, residuals and their squares; None: the pose is not determined."""
    kept = images.chosen(used)
    normal, _, _ = _normal_equations(camera, kept, pose, np.ones(len(kept)), sd_focal)
    scale = 1.0 / np.sqrt(np.diag(normal))
    unit = normal * np.outer(scale, scale)
    if not np.linalg.cond(unit) < 1e13:
        return None
    cov = np.linalg.inv(unit) * np.outer(scale, scale)
    chi2 = _total_chi2(camera, images, pose, 0.0)
    return 0.5 * (cov + cov.T), _residuals(camera, images, pose), chi2


def _is_same(first: CameraPose, second: CameraPose, factor: float) -> bool:
    """Tell whether two poses are one but for rounding, or for `factor` times that."""
    turn = first.world_from_camera.T @ second.world_from_camera
    sine = float(np.linalg.norm(turn - turn.T)) / math.sqrt(8.0)
    if float(np.trace(turn)) < 1.0 or sine > factor * _SAME_RAD:
        return False
    shift = float(np.linalg.norm(first.centre_m - second.centre_m))
    return shift <= factor * _SAME_SHARE * max(1.0, float(np.linalg.norm(first.centre_m)))
