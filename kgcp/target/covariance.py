"""Covariances that hold up: from the residuals as they are, correlation included.

The inverse normal matrix is the covariance only if residuals are independent from pixel to pixel.
Jagged print, JPEG, sharpening and the tails of unmodelled effects run along the contours. So the
scores (derivatives of the log-likelihood) are summed over short arcs of every circle, and the
scatter of these sums gives the covariance of the gradient: a cluster-robust ("sandwich") estimate
(Liang & Zeger, Biometrika 73, 1986; White, Econometrica 48, 1980).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.target.adjust import Fit, noise_of
from kgcp.target.imager import share_at
from kgcp.target.light import plateau_levels
from kgcp.target.observation import Uncertainty

_ARC_PX = 6.0
# Of a circle's edge as a whole: no print and no pixel is known better, …
_EDGE_FLOOR_PX = 0.0005
_TONED_EDGE_FLOOR_PX = 0.004  # of the frame, where a tone curve displaces edges within bins
_COMMON_SHARE = 0.25  # … and where edges scatter more than noise makes them, so much of it, …
_EXTRAPOLATED_SHARE = 0.025  # … and so much of how far they are beyond what is not clipped


@dataclass(frozen=True, slots=True, eq=False)
class PoseCovariance:
    """Covariance of a pose.

    Attributes
    ----------
    pose_cov : (6, 6) array
        Translation [m] and rotation vector [rad], left perturbation in the camera frame.
    inflation : float
        Mean ratio of these variances to those of independent residuals.
    """

    pose_cov: FloatArray
    inflation: float


def pose_covariance(fit: Fit) -> PoseCovariance:
    """Return the covariance of the pose of a fit.

    From the scatter of its scores over arcs, nowhere below that of independent pixels, plus what a
    small common displacement of each circle's edge would do.
    """
    inverse = np.linalg.inv(fit.normal)
    scaled = fit.jacobian[fit.unknowns.free] / fit.sd
    circle, arc = _nearest_edges(fit)
    count = int(arc.max()) + 1
    sums = np.zeros((len(scaled), count))
    _add_by_arc(scaled, fit.misfit.score, arc, sums)
    used = int(np.count_nonzero(np.bincount(arc, minlength=count)))
    correction = used / max(used - len(scaled), 0.25 * used)
    robust = (correction * inverse @ (sums @ sums.T) @ inverse)[:6, :6]
    plain = inverse[:6, :6]
    inflation = max(1.0, float(np.trace(np.linalg.solve(plain, robust))) / 6.0)
    shifts = (inverse @ _edge_pull(fit, scaled, circle))[:6] * _common_displacement_px(fit)
    return PoseCovariance(_at_least(robust, plain) + shifts @ shifts.T, inflation)


def _common_displacement_px(fit: Fit) -> float:
    """Return the standard deviation of the displacement that all of a circle's edge shares [px].

    From the residuals: what edges scatter beyond the noise of the plateaus (coarse sampling of a
    print, compression, tails of what is not modelled) averages out along a circle only in part. And
    of an edge whose middle is clipped only a tail is seen, whose shape is not known exactly.
    """
    imaging = fit.sample.imaging
    is_plain = imaging.window.binning == 1 or imaging.response is Response.LINEAR
    floor_px = _EDGE_FLOOR_PX if is_plain else _TONED_EDGE_FLOOR_PX / imaging.window.binning
    floor_px = math.hypot(floor_px, _EXTRAPOLATED_SHARE * _clipped_reach_px(fit))
    noise = noise_of(fit.sample, fit.prediction)
    share = fit.prediction.share
    edge = (share > 0.3) & (share < 0.7)
    if not edge.any():
        return floor_px
    black, white = plateau_levels(fit.parameters.light, fit.sample.imaging.response)
    slope_per_px = (white - black) / (np.sqrt(2.0 * np.pi) * fit.parameters.blur.mean_sd_px)
    excess = np.sqrt(np.median(noise.sd[edge] ** 2 - noise.plateau_sd[edge] ** 2))
    return max(floor_px, float(_COMMON_SHARE * excess / slope_per_px))


def _clipped_reach_px(fit: Fit) -> float:
    """Return how far the middle of a straight edge is within what is clipped [px]."""
    light, imaging = fit.parameters.light, fit.sample.imaging
    burnt = share_at(imaging.censoring.high, light, imaging.response)
    sunk = share_at(imaging.censoring.low, light, imaging.response)
    hidden = max(0.5 - burnt, sunk - 0.5, 0.0)
    return float(fit.parameters.blur.mean_sd_px * ndtri(min(0.5 + hidden, 1.0 - 1e-3)))


def _edge_pull(fit: Fit, scaled: FloatArray, circle: IndexArray) -> FloatArray:
    """Return the gradient (p, 2) by one pixel's growth of the outer and of the inner circle.

    Coming nearer by the share 1/r grows a circle of r pixels by one pixel.
    """
    imaging = fit.sample.imaging
    translation_m = fit.parameters.pose.translation_m
    by_approach = -(translation_m @ fit.jacobian[:3]) * fit.misfit.weight / fit.sd
    px_per_m = imaging.outer_radius_px / imaging.outer_radius_m
    pulls = [
        scaled[:, circle == index] @ by_approach[circle == index] / (radius * px_per_m)
        for index, radius in enumerate(imaging.circles.radii_m[:2])
    ]
    return np.stack(pulls, axis=1)


def _at_least(robust: npt.NDArray[Any], plain: npt.NDArray[Any]) -> FloatArray:
    """Return the robust covariance, nowhere below the plain one.

    Few arcs can by chance agree too well in some direction; the noise of the pixels is there all
    the same.
    """
    root = np.linalg.cholesky(plain)
    whitened = np.linalg.solve(root, np.linalg.solve(root, robust).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    raised = (vectors * np.maximum(values, 1.0)) @ vectors.T
    covariance: FloatArray = root @ raised @ root.T
    return covariance


def _nearest_edges(fit: Fit) -> tuple[IndexArray, IndexArray]:
    """Return, for every pixel, the circle of its nearest edge and the number of the arc there."""
    imaging = fit.sample.imaging
    circles, points = imaging.circles, fit.prediction.points_m
    px_per_m = imaging.outer_radius_px / imaging.outer_radius_m
    counts = np.maximum(1, np.rint(2.0 * np.pi * circles.radii_m * px_per_m / _ARC_PX))
    firsts = np.concatenate(([0], np.cumsum(counts)[:-1]))
    circle, arc = (np.zeros(points.shape[1], dtype=np.intp) for _ in range(2))
    _number_arcs(points, circles.centres_m, circles.radii_m, firsts, counts, circle, arc)
    return circle, arc


@compiled
def _number_arcs(
    points_m: FloatArray,
    centres_m: FloatArray,
    radii_m: FloatArray,
    firsts: FloatArray,
    counts: FloatArray,
    circle: IndexArray,
    arc: IndexArray,
) -> None:
    for i in range(points_m.shape[1]):
        nearest = np.inf
        for c in range(len(radii_m)):
            x, y = points_m[0, i] - centres_m[0, c], points_m[1, i] - centres_m[1, c]
            square, far = x * x + y * y, radii_m[c] + nearest
            if square < far * far:
                off_edge = abs(math.sqrt(square) - radii_m[c])
                if off_edge < nearest:
                    nearest, circle[i] = off_edge, c
        c = circle[i]
        x, y = points_m[0, i] - centres_m[0, c], points_m[1, i] - centres_m[1, c]
        turn = math.atan2(y, x) / (2.0 * math.pi)
        turn -= math.floor(turn)
        arc[i] = int(firsts[c] + min(math.floor(turn * counts[c]), counts[c] - 1.0))


@compiled
def _add_by_arc(scaled: FloatArray, score: FloatArray, arc: IndexArray, sums: FloatArray) -> None:
    for k in range(scaled.shape[0]):
        for i in range(scaled.shape[1]):
            sums[k, arc[i]] += scaled[k, i] * score[i]


def propagate(camera: Camera, pose: Pose, pose_cov: FloatArray) -> Uncertainty:
    """Carry the covariance of a pose to everything that is reported of it.

    Parameters
    ----------
    camera : Camera
    pose : Pose
    pose_cov : (6, 6) array
        As in `Uncertainty`.
    """
    ray = pose.translation_m / pose.distance_m
    centre = _centre_jacobian(camera, pose)
    angles = _angle_jacobian(camera, pose)
    sd_angles = np.sqrt(np.einsum("ij,jk,ik->i", angles, pose_cov, angles))
    return Uncertainty(
        pose_cov=pose_cov,
        centre_cov_px2=centre @ pose_cov[:3, :3] @ centre.T,
        sd_distance_m=float(np.sqrt(ray @ pose_cov[:3, :3] @ ray)),
        sd_roll_deg=float(sd_angles[0]),
        sd_pitch_deg=float(sd_angles[1]),
        sd_heading_deg=float(sd_angles[2]),
    )


def _centre_jacobian(camera: Camera, pose: Pose) -> FloatArray:
    x, y, z = pose.translation_m
    normalised = np.array([[x / z, y / z]])
    by_translation = np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]])
    jacobian: FloatArray = camera.distort_jacobian(normalised)[0] @ by_translation
    return jacobian


def _angle_jacobian(camera: Camera, pose: Pose) -> FloatArray:
    """Return the derivatives (3, 6) of roll, pitch and heading [deg].

    A turn ω moves a direction d by ω × d, so that its component k changes by (d × e_k) · ω.
    """
    jacobian = np.zeros((3, 6))
    normal, axis = pose.rotation[:, 2], pose.rotation[:, 0]
    turned_normal, turned_axis = np.cross(normal, np.eye(3)), np.cross(axis, np.eye(3))
    for row, k in ((0, 1), (1, 0)):  # atan2(−n_k, n_z)
        by_k, by_z = -normal[2] * turned_normal[k], normal[k] * turned_normal[2]
        jacobian[row, 3:] = (by_k + by_z) / (normal[2] ** 2 + normal[k] ** 2)
    x, y, z = pose.translation_m
    lens = camera.distort_jacobian(np.array([x / z, y / z]))
    # the image of the axis is lens @ (d_xy − (x, y)/z · d_z)/z; how the lens changes is negligible
    direction = lens @ (axis[:2] - np.array([x, y]) / z * axis[2])
    across = np.array([-direction[1], direction[0]]) / (direction @ direction) @ lens
    by_axis = np.array([across[0], across[1], -(across @ np.array([x, y])) / z])
    jacobian[2, 3:] = by_axis @ turned_axis
    by_offset = -axis[2] / z * across
    jacobian[2, :3] = (*by_offset, -(by_offset @ np.array([x, y])) / z)
    return np.degrees(jacobian)
