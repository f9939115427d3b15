"""Resection: the exterior orientation of one frame from images of points with known positions.

Some points may have wrong names. Therefore triples of points yield hypotheses (P3P, up to four
solutions each). The hypotheses with which most points agree are adjusted with the covariances of
images and positions; points that do not agree are left out. For each, the mirrored solution is
adjusted as well, because points in a plane hardly distinguish the two. Solutions with a point
behind the camera do not count: on the flat part of a field, one may fit to hundredths of a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.point_images import CameraPose, PointImages
from kgcp.network.ground.pose_adjustment import (
    common_errors,
    covariance_and_residuals,
    minimised,
    scale_at,
    second_order_cov,
    squared_residuals,
)
from kgcp.network.ground.pose_hypotheses import hypotheses

MIN_POINTS = 4
"""Points that must agree by default: three have up to four poses, the fourth decides."""

MIN_MARGIN = 13.8
"""Least Δχ² between the best pose and the next: odds of 1000 to 1."""

_REJECTED_CHI2 = 25.0  # limit of a point's χ²; three numbers exceed it by chance once in 65 000
_MAX_REFINED = 4  # hypotheses that are adjusted, the best ones first
_ROUND_STEPS = 3  # steps of the adjustment between two reweightings
_MAX_ROUNDS = 10
# Two poses count as the same up to this rotation and this shift relative to the distance.
_SAME_RAD, _SAME_SHIFT = 2e-3, 2e-3
# Errors of a hypothesis from three noisy points: in the image, and relative in distances.
_START_PX, _START_DISTANCE = 2.0, 0.01
# If the redundancy is at most 2, as of four points without distances, the sum of the χ² of all
# points must not exceed the value that chance exceeds with this probability. With the limit of
# single points alone, a wrong name among four points went unnoticed in 1 of 1800 frames.
_LOW_REDUNDANCY, _LOW_REDUNDANCY_CHANCE = 2, 0.01
# Standard deviations of the rotation about its weakest axis [rad]. Above the first one, likely
# poses lie on a noticeably curved line, and second-order terms are added to the covariance. Above
# the second one, these terms are not enough, and the pose is refused.
_CURVED_ROTATION_SD, _MAX_ROTATION_SD = 0.005, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Resection:
    """An oriented frame.

    Attributes
    ----------
    pose : CameraPose
    cov : (6, 6) or (7, 7) array
        Position [m] and left rotation vector [rad], both along the world's axes; with an unknown
        focal length also its relative change.
    residuals : (n, 3) array
        Observed minus computed place [px] and logarithm of the distance (NaN: not measured).
    chi2 : (n,) array
        Squared residuals of each point over their covariance.
    is_used : (n,) array
        Whether a point agrees with the pose.
    margin : float
        Δχ² by which the next best pose fits worse; the χ² of every point is limited.
    other : CameraPose or None
        The next best pose; None: no other explains three points.
    distance_scale : float
        Logarithm of the common factor by which all distances are too long; 0 if none is estimated.
    """

    pose: CameraPose
    cov: FloatArray
    residuals: FloatArray
    chi2: FloatArray
    is_used: BoolArray
    margin: float
    other: CameraPose | None
    distance_scale: float

    @property
    def observations(self) -> int:
        """Number of observations that took part."""
        return int(np.count_nonzero(np.isfinite(self.residuals[self.is_used])))

    @property
    def variance_factor(self) -> float | None:
        """χ² per degree of freedom; None: no redundancy."""
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
        Number of points that must agree. Three are enough if all have a distance, which checks the
        pose.
    focals : sequence of float
        Start values of the focal length, as multiples of the camera's.
    sd_focal : float
        A-priori standard deviation of the focal length, relative; 0: it is known.
    seed : int
        For drawing triples if there are very many.

    Raises
    ------
    NoPoseError
        If too few points agree, the next best pose fits nearly as well, the points hardly
        determine the pose, or they lie in a line.
    """
    if len(images) < 3:
        raise NoPoseError(f"{len(images)} known points; a pose needs three")
    starts = list(hypotheses(camera, images, focals, seed))
    if not starts:
        raise NoPoseError("no triple of points has a pose in front of the camera")
    costs = _hypothesis_costs(camera, images, starts)
    fits: list[tuple[float, CameraPose, BoolArray]] = []
    tried: list[CameraPose] = []
    for row in np.argsort(costs, kind="stable"):
        if len(tried) == _MAX_REFINED:
            break
        start = starts[row]
        if any(_is_same(start, other, 10.0) for other in tried):
            continue
        tried.append(start)
        fits += _followed(camera, images, start, sd_focal)
    if not fits:
        raise NoPoseError(
            "no pose explains three of the points; look at their names, at position_m and at the"
            " camera"
        )
    fits.sort(key=lambda fit: fit[0])
    cost, pose, used = fits[0]
    others = [fit for fit in fits[1:] if not _is_same(pose, fit[1], 1.0)]
    margin, other = (others[0][0] - cost, others[0][1]) if others else (math.inf, None)
    _require_agreement(images, used, min_points)
    if margin < MIN_MARGIN:
        raise NoPoseError(
            f"two poses fit alike (Δχ² {margin:.1f}): there are too few points, they are nearly in"
            " a line, or the position of one is wrong"
        )
    cov, residuals, chi2 = _determined(camera, images, pose, used, sd_focal)
    scale = scale_at(camera, images.chosen(used), pose)
    oriented = Resection(pose, cov, residuals, chi2, used, margin, other, scale)
    _require_fit(oriented)
    return oriented


def _determined(
    camera: Camera, images: PointImages, pose: CameraPose, used: BoolArray, sd_focal: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return covariance, residuals and χ² of a pose; refuse one that is hardly determined."""
    result = covariance_and_residuals(camera, images, pose, used, sd_focal)
    if result is None:
        raise NoPoseError("the points do not determine the pose: they lie in a line")
    cov, residuals, chi2 = result
    sd_rad = math.sqrt(float(np.linalg.eigvalsh(cov[3:6, 3:6])[-1]))
    if sd_rad > _MAX_ROTATION_SD:
        raise NoPoseError(f"the points hardly determine the pose (± {math.degrees(sd_rad):.1f}°)")
    if sd_rad > _CURVED_ROTATION_SD:
        second_order = second_order_cov(camera, images.chosen(used), pose, cov, sd_focal)
        if second_order is None:
            raise NoPoseError("the points hardly determine the pose")
        cov = cov + second_order
    return cov, residuals, chi2


def _require_fit(oriented: Resection) -> None:
    """Refuse a pose of low redundancy that does not fit well."""
    freedom = oriented.observations - len(oriented.cov)
    total = float(np.sum(oriented.chi2[oriented.is_used]))
    if 0 < freedom <= _LOW_REDUNDANCY and total > chdtri(freedom, _LOW_REDUNDANCY_CHANCE):
        raise NoPoseError(f"so few points must agree better (χ² {total:.0f} of {freedom})")


def _require_agreement(images: PointImages, used: BoolArray, min_points: int) -> None:
    count = int(np.count_nonzero(used))
    needed = min(3, min_points) if images.has_distance[used].all() else min_points
    if count < needed:
        raise NoPoseError(f"{count} of {len(images)} points agree; {needed} are needed")
    if 2 * count < len(images):
        raise NoPoseError(f"only {count} of {len(images)} points agree with each other")


def _hypothesis_costs(
    camera: Camera, images: PointImages, poses: Sequence[CameraPose]
) -> FloatArray:
    """Return the robust sums of χ² (m,) of m hypotheses; points they do not explain dominate.

    The variances include the errors that a hypothesis has from the noise of its three points.
    """
    centres = np.array([pose.centre_m for pose in poses])
    rotations = np.array([pose.world_from_camera for pose in poses])
    focals = np.array([pose.focal_scale for pose in poses])
    points = np.einsum("pni,pij->pnj", images.positions_m - centres[:, None], rotations)
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    pixels = camera.distort(focals[:, None, None] * points[..., :2] / depth[..., None])
    squares_px2 = np.sum((images.pixels - pixels) ** 2, axis=-1)
    distance = np.linalg.norm(points, axis=-1)
    mean_cov = np.trace(images.position_cov, axis1=1, axis2=2) / 3.0
    variance = (
        _START_PX**2
        + images.motion_sd_rad(distance) ** 2 * camera.mean_focal_px**2
        + 0.5 * np.trace(images.pixel_cov, axis1=1, axis2=2)
        + mean_cov * (camera.mean_focal_px / distance) ** 2
    )
    chi2 = squares_px2 / variance
    logs = np.log(images.distances_m * focals[:, None] / distance)
    sd2 = (
        _START_DISTANCE**2 + images.sd_scale**2 + (images.sd_distances_m / images.distances_m) ** 2
    )
    chi2 += np.nan_to_num(logs**2 / sd2)
    return np.asarray(np.sum(np.minimum(np.nan_to_num(chi2, nan=np.inf), _REJECTED_CHI2), axis=1))


def _followed(
    camera: Camera, images: PointImages, start: CameraPose, sd_focal: float
) -> Iterator[tuple[float, CameraPose, BoolArray]]:
    """Yield the adjusted pose of a hypothesis, and that of its mirror image."""
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
    """Return the pose in which the points' mean plane is mirrored about the ray to its middle."""
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
    # rotating the points in the camera's frame rotates the camera about their middle, inversely
    rotation = rotation_about(np.ascontiguousarray(-axis / sine * 2.0 * math.atan2(sine, cosine)))
    return CameraPose(
        middle - rotation @ (middle - pose.centre_m),
        rotation @ pose.world_from_camera,
        pose.focal_scale,
    )


def _robust_fit(
    camera: Camera, images: PointImages, start: CameraPose, sd_focal: float
) -> tuple[float, CameraPose, BoolArray] | None:
    """Return cost, pose and which points agree (n,); None if fewer than three do."""
    pose = start
    weights = _cauchy(squared_residuals(camera, images, pose, _START_PX))
    for _ in range(_MAX_ROUNDS):
        moved = minimised(camera, images, pose, weights, sd_focal, _ROUND_STEPS)
        if moved is None:
            return None
        pose = moved
        next_weights = _cauchy(squared_residuals(camera, images, pose, 0.0))
        is_settled = np.allclose(next_weights, weights, atol=1e-2)
        weights = next_weights
        if is_settled:
            break
    used = np.zeros(len(images), dtype=np.bool_)
    for _ in range(_MAX_ROUNDS):
        agree = squared_residuals(camera, images, pose, 0.0) <= _REJECTED_CHI2
        if np.count_nonzero(agree) < 3:
            return None
        if np.array_equal(agree, used):
            break
        used = agree
        moved = minimised(camera, images, pose, used.astype(np.float64), sd_focal)
        if moved is None:
            return None
        pose = moved
    chi2 = squared_residuals(camera, images, pose, 0.0)
    prior = (math.log(pose.focal_scale) / sd_focal) ** 2 if sd_focal else 0.0
    prior += common_errors(camera, images.chosen(used), pose)[1]
    return float(np.sum(np.minimum(chi2, _REJECTED_CHI2))) + prior, pose, used


def _cauchy(chi2: FloatArray) -> FloatArray:
    """Return Cauchy's weights (n,), which are 1/2 at 3 σ."""
    return np.asarray(1.0 / (1.0 + chi2 / 9.0))


def _is_same(first: CameraPose, second: CameraPose, factor: float) -> bool:
    """Tell whether two poses are the same, within `factor` times the usual tolerance."""
    rotation = first.world_from_camera.T @ second.world_from_camera
    sine = float(np.linalg.norm(rotation - rotation.T)) / math.sqrt(8.0)
    if float(np.trace(rotation)) < 1.0 or sine > factor * _SAME_RAD:
        return False
    shift = float(np.linalg.norm(first.centre_m - second.centre_m))
    return shift <= factor * _SAME_SHIFT * max(1.0, float(np.linalg.norm(first.centre_m)))
