"""Covariance of a fitted pose, from residuals that may be correlated along edges.

The inverse normal matrix N⁻¹ is the covariance only if residuals are independent from pixel to
pixel. Jagged print, JPEG, sharpening and unmodelled effects correlate them along the contours. So
the scores (derivatives of the log-likelihood) are summed over short arcs of every circle, and the
scatter of these sums gives the covariance of the gradient: a cluster-robust ("sandwich") estimate
(Liang & Zeger, Biometrika 73, 1986; White, Econometrica 48, 1980).

The fit itself makes that scatter smaller, the more so the fewer arcs there are. The scatter is
therefore compared with the one that this fit would leave of independent residuals (Bell &
McCaffrey, Survey Methodology 28, 2002).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.appearance import places_across_edges_px
from kgcp.measurement.adjustment.normal_equations import normal_matrix
from kgcp.measurement.adjustment.solver import TargetFit, noise_of
from kgcp.measurement.adjustment.spread_shape import (
    SHAPE_PRECISIONS,
    ShapeEquations,
    equations_by_shape,
)
from kgcp.measurement.image_model.noise import median_at_edges
from kgcp.measurement.image_model.photometry import (
    SKEW_PARAMS,
    Light,
    Param,
    Tone,
    plateau_levels,
)
from kgcp.measurement.image_model.residual_agreement import sums_over_arcs
from kgcp.measurement.image_model.rolling_shutter import RollingShutter
from kgcp.measurement.image_model.rotation_displacement import mean_square_displacement
from kgcp.measurement.records import Uncertainty

_ARC_PX = 6.0
# Where levels vary, arcs are longer: stains leave residuals that are correlated over the spacing of
# the levels' knots.
_UNEVEN_ARC_PX = 12.0
# The ratio of the scatter to that of independent residuals is found in six directions of the pose,
# from some twenty arcs on a small ring.
_ARCS_OF_MEAN_RATIO = 60.0  # weight of the mean over all directions against each single ratio
_ARCS_OF_UNIT_RATIO = 20.0  # weight of 1 against a mean that is below 1
_LEAST_SCATTER_LEFT = 0.25  # share of the scatter that a fit leaves at least
_SIMD_WIDTH = 4  # numbers that the processor takes at once
# Least standard deviation of a displacement that a circle's whole edge has in common: no print and
# no pixel is known better. In bins it is larger, since a tone curve displaces edges within a bin;
# that value is in pixels of the frame.
_EDGE_FLOOR_PX, _EDGE_FLOOR_OF_BINS_PX = 0.0005, 0.004
# Levels that vary may imitate the halos of sharpening. Simulated sets of 23 to 40 rings of R ≥ 26
# px, sharpened with strengths of 0.5 to 0.8, were too large or too small by up to 0.0015 px in the
# mean (docs/method/covariance.md, "Halos of sharpening"). So this times the strength counts as such
# a displacement.
_PER_SHARPENING_PX = 0.003
# Factors of the variances on small rings, whose residuals do not show enough of uneven light: where
# levels vary, and at most where they do not. Without them, z was 1.4 in shade and 1.5 with dirt
# (`benchmarks.accuracy.ring_sizes`).
_SMALL_RING_FACTOR, _MOST_EVEN_SMALL_RING_FACTOR = 1.8, 1.4
# A skew point spread displaces edges by κ / 6σ² with its third cumulant κ, and by an unknown amount
# with its higher moments. This share of κ / 6σ² counts as the standard deviation of that amount. Of
# 139 simulated plates behind four comatic lenses, centres are off by 0.09 to 0.20 of it per axis
# (RMS), behind another program's lens by 0.19. Levels that vary take up part of a skew: the share
# is larger there.
_SKEW_SHARE, _SKEW_SHARE_IN_UNEVEN_LIGHT = 0.18, 0.3
# A bilateral filter hides a skew from the fit, but not its displacement. Residuals then agree along
# edges and inflate the variances: on rings of R ≥ 26 px behind comatic lenses 1.0 times without
# such a filter, 2.3 times with a weak and 3.9 times with a strong one, in another program's mixture
# 2.6 to 4.7 times. So the share above grows with the inflation: by nothing at 1.25, by 1.1 at 2.75.
_HIDDEN_SKEW_SHARE, _INFLATION_BY_HIDDEN_SKEW = 1.1, (1.25, 2.75)
# The share of what a kurtosis displaces that counts as a standard deviation, likewise. Without it,
# distances of rings of R < 13 px have z of 1.0 to 2.0 out of focus by 2 and 3 px. With 0.2 instead,
# larger rings have z of 0.5 to 0.8.
_KURTOSIS_SHARE = 0.12
# Rings whose radius is less than this many times the blur may have a skew or a kurtosis that is not
# free, since their residuals do not show it enough: under an unknown curve, the limit for that is
# high. When this counted below R 13 px only, distances of burnt rings of R 13 to 14 px, out of
# focus by 2 px, were off by 3.6 to 4.8 deviations; now by 1.9 to 3.5.
_FEW_BLURS = 15.0
# The share of the scatter of edges beyond the noise of the plateaus that a whole edge may have in
# common. It counts as far as neighbouring residuals agree: in full where arcs scatter 1 + 0.5 times
# as much as independent pixels, not at all where they scatter no more. From the radius on that
# comes third, rings whose levels vary have long arcs enough to show all of it. Counted again there,
# it made deviations of another program's phone and mixture 1.2 and 1.3 times as large. Smaller
# rings have too few arcs for that.
_COMMON_SHARE, _EXCESS_FOR_FULL_SHARE, _LARGE_UNEVEN_RING_PX = 0.25, 0.5, 32.0
# Where the middle of an edge is clipped, its place is extrapolated from the part that is not: this
# share of the distance to it counts as a standard deviation.
_EXTRAPOLATED_SHARE = 0.025


@dataclass(frozen=True, slots=True, eq=False)
class PoseCovariance:
    """Covariance of a pose."""

    # (6, 6): translation [m] and rotation vector [rad], left perturbation in the camera frame
    pose_cov: FloatArray
    inflation: float  # mean ratio of these variances to those of independent residuals


def pose_covariance(fit: TargetFit) -> PoseCovariance:
    """Return the covariance of the pose of a fit.

    It is found from the scatter of the scores over arcs. Added is what the scatter does not show: a
    displacement that a circle's whole edge has in common, point spreads whose shape is not known
    well, and an unknown rotation during the readout.

    Raises
    ------
    Rejection
        `POOR_FIT` if the pixels do not determine the pose.
    """
    misfit = fit.misfit
    if fit.level_equations is None:
        scaled = fit.scaled_jacobian
        normal = normal_matrix(scaled, misfit, fit.unknowns)
    else:
        scaled = fit.level_equations.rows()
        normal = fit.level_equations.normal
    try:
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
        root = np.linalg.cholesky(inverse[:6, :6])
    except np.linalg.LinAlgError as error:
        raise Rejection(Reason.POOR_FIT, "the pixels do not determine the pose") from error
    circle, arc = nearest_edges(fit)
    to_pose = np.linalg.solve(root, inverse[:6])  # in units of N⁻¹
    by_pixel = np.zeros((scaled.shape[1], -(-len(scaled) // _SIMD_WIDTH) * _SIMD_WIDTH))
    by_pixel[:, : len(scaled)] = scaled.T
    of_pose = by_pixel[:, : len(scaled)] @ to_pose.T
    sums, products, arcs = sums_over_arcs(of_pose, by_pixel, misfit.score, misfit.weight, arc)
    products = products[:, :, : len(scaled)]
    # of the scatter of independent residuals on an arc, its normal matrix A, a fit leaves
    # A − A N⁻¹ A
    scatter_left = np.sum(products.sum(axis=0) * to_pose) - np.sum((products @ inverse) * products)
    if fit.level_equations is not None:
        scatter_left -= fit.level_equations.scatter_explained(of_pose, misfit.weight, arc)
    ratios, directions = np.linalg.eigh(
        sums.T @ sums / max(scatter_left / 6.0, _LEAST_SCATTER_LEFT)
    )
    mean_ratio = float(ratios.mean())
    if mean_ratio < 1.0:  # the scatter of few arcs may be small by chance
        mean_ratio = (arcs * mean_ratio + _ARCS_OF_UNIT_RATIO) / (arcs + _ARCS_OF_UNIT_RATIO)
    ratios = (arcs * ratios + _ARCS_OF_MEAN_RATIO * mean_ratio) / (arcs + _ARCS_OF_MEAN_RATIO)
    half = root @ (directions * np.sqrt(ratios))
    in_common_px = common_displacement_px(
        fit, min(max(mean_ratio - 1.0, 0.0) / _EXCESS_FOR_FULL_SHARE, 1.0)
    )
    shifts = inverse[:6] @ _gradient_by_growth(fit, scaled, circle) * in_common_px
    pose_cov = half @ half.T + shifts @ shifts.T
    pose_cov *= unevenness_factor(fit, mean_ratio)
    if fit.parameters.has_skew:
        depth_m = fit.parameters.matrix[2, 3]
        across_px = _skew_displacement_px(fit, mean_ratio * np.diag(inverse), mean_ratio)
        across_m = across_px * depth_m / fit.sample.problem.focal_px
        pose_cov[[0, 1], [0, 1]] += across_m * across_m
    if fit.parameters.has_kurtosis:
        shift = _kurtosis_displacement(fit, inverse, mean_ratio)
        pose_cov += np.outer(shift, shift)
    is_even = fit.level_equations is None
    if is_even and not fit.unknowns.has_shape and _hides_shape(fit):
        pose_cov += _omitted_shape_cov(
            equations_by_shape(fit, scaled, normal), max(1.0, mean_ratio)
        )
    shutter = fit.sample.problem.shutter
    if shutter is not None:
        pose_cov += _unknown_rotation_cov(fit, shutter)
    return PoseCovariance(pose_cov, max(1.0, mean_ratio))


def unevenness_factor(fit: TargetFit, inflation: float) -> float:
    """Return the factor by which variances are larger in uneven light than residuals show.

    It is 1 unless the ring is small. On a small ring whose levels do not vary, an `inflation` above
    1 says that the light may be uneven, and the factor grows with it.
    """
    if not fit.sample.problem.is_ring_small:
        return 1.0
    if fit.parameters.field is not None:
        return _SMALL_RING_FACTOR
    return float(_MOST_EVEN_SMALL_RING_FACTOR ** min(max(inflation - 1.0, 0.0), 1.0))


def _unknown_rotation_cov(fit: TargetFit, shutter: RollingShutter) -> FloatArray:
    """Return what the scene's rotation during the readout adds to the covariance (6, 6)."""
    problem = fit.sample.problem
    return mean_square_displacement(
        fit.parameters.pose,
        problem.circles.part(slice(0, problem.measured_count)),
        shutter.delay_s_px * problem.focal_px,
        shutter.rotation.sd_rad_s,
    )


def _skew_displacement_px(fit: TargetFit, variances: FloatArray, inflation: float) -> float:
    """Return the standard deviation of the centre that a skew point spread adds [px].

    A third cumulant κ displaces all edges across it by κ / 6σ². Higher moments of the point spread
    displace them, too, but are not known: that leaves about a fifth of κ / 6σ² uncertain, or a
    third in uneven light. Where the `inflation` says that edges were processed, the fitted κ may be
    only a part of the lens's.

    The covariance of the fit already covers the part of κ that may be noise. It is taken off, by
    the `variances` of the free parameters.
    """
    blur = fit.parameters.blur
    skew = np.array(blur.skew)
    skew_variances = variances[np.searchsorted(fit.unknowns.free, SKEW_PARAMS)]
    largest = math.sqrt(max(0.0, float(np.max(skew * skew - skew_variances))))
    hidden = float(np.interp(inflation, _INFLATION_BY_HIDDEN_SKEW, (0.0, _HIDDEN_SKEW_SHARE)))
    share = _SKEW_SHARE if fit.level_equations is None else _SKEW_SHARE_IN_UNEVEN_LIGHT
    return (share + hidden) * largest / (6.0 * blur.mean_sd_px**2)


def _kurtosis_displacement(fit: TargetFit, inverse: FloatArray, inflation: float) -> FloatArray:
    """Return the displacement of the pose (6,) that a point spread's kurtosis leaves uncertain.

    It is a share of the one that a fit without kurtosis would have. The covariance of the fit
    already covers the part of the kurtosis that may be noise. It is taken off, by the `inverse`
    normal matrix.
    """
    k = int(np.searchsorted(fit.unknowns.free, Param.KURTOSIS))
    beyond_noise = fit.parameters.blur.kurtosis**2 - inflation * inverse[k, k]
    size = _KURTOSIS_SHARE * math.sqrt(max(0.0, beyond_noise))
    return np.asarray(size * inverse[:6, k] / inverse[k, k])


def _hides_shape(fit: TargetFit) -> bool:
    """Tell whether a ring is too small, or too blurred, to show its point spread's shape."""
    problem = fit.sample.problem
    is_blurred = problem.outer_radius_px < _FEW_BLURS * fit.parameters.blur.mean_sd_px
    return problem.is_ring_small or is_blurred


def _omitted_shape_cov(by_shape: ShapeEquations, inflation: float) -> FloatArray:
    """Return what skew and kurtosis of the point spread, left at 0, add to the covariance (6, 6).

    Residuals of small rings, and of blurred ones, mostly show too little of the two to make them
    free. One step of Newton's method tells how large they seem, and how far that would displace the
    pose. The displacement counts as a deviation as far as their χ² exceeds that of noise alone.

    In simulations of 40 rings of R 7 to 13 px each, behind several comatic lenses, z of the centre
    was 1.9 to 2.2 without this and is 0.9 to 1.1. Out of focus by 1.5 px, z of the distance was 1.3
    and is 1.0. Behind Gaussian point spreads both stay as they are.
    """
    cov = np.linalg.inv(by_shape.normal + np.diag(SHAPE_PRECISIONS))
    seen = cov @ by_shape.score
    added = np.zeros((6, 6))
    for part in (slice(0, len(SKEW_PARAMS)), slice(len(SKEW_PARAMS), None)):
        chi2 = float(seen[part] @ np.linalg.solve(inflation * cov[part, part], seen[part]))
        share = max(0.0, 1.0 - len(seen[part]) / chi2) if chi2 > 0.0 else 0.0
        shift = by_shape.displacement[:6, part] @ seen[part]
        added += share * np.outer(shift, shift)
    return added


def common_displacement_px(fit: TargetFit, share_along_arcs: float) -> float:
    """Return the standard deviation of the displacement that all of a circle's edge shares [px].

    Edges may scatter more than the noise of the plateaus. Where that scatter is correlated along
    arcs (coarse sampling of a print, effects that are not modelled), it averages out along a circle
    only in part; where it is not (compression), it averages out wholly. `share_along_arcs` says how
    far it is, 0…1.

    Of an edge whose middle is clipped only a tail is seen, whose shape is not known exactly: that
    counts, too.
    """
    problem, light = fit.sample.problem, fit.parameters.light
    is_even = fit.level_equations is None
    if problem.tone is Tone.BINNED:
        floor_px = _EDGE_FLOOR_OF_BINS_PX / problem.window.binning
    else:
        floor_px = _EDGE_FLOOR_PX if is_even else _halo_displacement_px(light)
    floor_px = math.hypot(floor_px, _EXTRAPOLATED_SHARE * _clipped_reach_px(fit))
    if not is_even and problem.outer_radius_px >= _LARGE_UNEVEN_RING_PX:
        return floor_px
    noise = noise_of(fit.sample, fit.prediction, is_even=is_even)
    excess = np.maximum(noise.sd**2 - noise.plateau_sd**2, 0.0)
    at_edges = median_at_edges(excess, fit.prediction.share, 0.3, 0.7, 0.0)
    black, white = plateau_levels(light, problem.tone)
    slope_per_px = (white - black) / (math.sqrt(2.0 * math.pi) * fit.parameters.blur.mean_sd_px)
    scatter_px = math.sqrt(share_along_arcs * at_edges) / slope_per_px
    return max(floor_px, _COMMON_SHARE * scatter_px)


def _halo_displacement_px(light: Light) -> float:
    """Return the standard deviation of edges where levels may imitate sharpening's halos [px]."""
    strength = light.sharpening + light.linear_sharpening
    return math.hypot(_EDGE_FLOOR_PX, _PER_SHARPENING_PX * strength)


def _clipped_reach_px(fit: TargetFit) -> float:
    """Return how far the middle of a straight edge lies in the clipped part, in the mean [px]."""
    limits = fit.sample.problem.censoring
    high_px = places_across_edges_px(fit, limits.high)
    low_px = places_across_edges_px(fit, limits.low)
    return float(np.mean(np.maximum(0.0, np.maximum(-high_px, low_px))))


def _gradient_by_growth(fit: TargetFit, scaled: FloatArray, circle: IndexArray) -> FloatArray:
    """Return the gradients (p, 2) if the outer, or the inner, circle grew by one pixel.

    A circle of r pixels grows by one pixel if it comes nearer by 1/r of its distance.
    """
    problem = fit.sample.problem
    per_pixel = -fit.misfit.weight / (fit.sd * problem.outer_radius_px / problem.outer_radius_m)
    by_approach = per_pixel * (fit.parameters.pose.translation_m @ fit.jacobian[:3])
    by_growth = np.zeros((2, len(by_approach)))
    for index, radius_m in enumerate(problem.circles.radii_m[:2]):
        np.divide(by_approach, radius_m, out=by_growth[index], where=circle == index)
    return np.asarray(scaled @ by_growth.T)


def nearest_edges(fit: TargetFit) -> tuple[IndexArray, IndexArray]:
    """Return, for every pixel, the circle of its nearest edge and the number of the arc there."""
    problem = fit.sample.problem
    circles = problem.circles.part(slice(0, problem.measured_count))
    px_per_m = problem.outer_radius_px / problem.outer_radius_m
    arc_px = _ARC_PX if fit.level_equations is None else _UNEVEN_ARC_PX
    counts = np.maximum(1, np.rint(2.0 * np.pi * circles.radii_m * px_per_m / arc_px))
    return _number_arcs(fit.prediction.points_m, circles.centres_m, circles.radii_m, counts)


@compiled
def _number_arcs(
    points_m: FloatArray, centres_m: FloatArray, radii_m: FloatArray, counts: FloatArray
) -> tuple[IndexArray, IndexArray]:
    """Return the circle of every pixel's nearest edge, and the number of the arc there."""
    nearest = np.full(points_m.shape[1], np.inf)
    circle, arc = np.zeros((2, len(nearest)), np.intp)
    for c in range(len(radii_m)):
        for i in range(len(nearest)):
            x, y = points_m[0, i] - centres_m[0, c], points_m[1, i] - centres_m[1, c]
            off_edge = abs(math.sqrt(x * x + y * y) - radii_m[c])
            circle[i] = c if off_edge < nearest[i] else circle[i]
            nearest[i] = min(nearest[i], off_edge)
    firsts = np.cumsum(counts) - counts
    for i in range(len(nearest)):
        c = circle[i]
        x, y = points_m[0, i] - centres_m[0, c], points_m[1, i] - centres_m[1, c]
        turn = math.atan2(y, x) / (2.0 * math.pi)
        turn -= math.floor(turn)
        arc[i] = int(firsts[c] + min(math.floor(turn * counts[c]), counts[c] - 1.0))
    return circle, arc


def ambiguity_cov(pose: Pose, other: Pose, ambiguity: float) -> FloatArray:
    """Return what the other pose adds to the covariance of the translation (3, 3) [m²].

    The other pose is the right one with the probability that belongs to the ambiguity. Its
    difference from the reported one counts squared, with that probability.
    """
    apart_m = other.translation_m - pose.translation_m
    return np.asarray(expit(-0.5 * ambiguity) * np.outer(apart_m, apart_m))


def propagate(camera: Camera, pose: Pose, pose_cov: FloatArray) -> Uncertainty:
    """Propagate the covariance of a pose to everything that is reported of it.

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
    normal, axis = pose.rotation[:, 2].tolist(), pose.rotation[:, 0].tolist()
    turned_normal, turned_axis = _across_axes(*normal), _across_axes(*axis)
    for row, k in ((0, 1), (1, 0)):  # atan2(−n_k, n_z)
        by_k, by_z = -normal[2] * turned_normal[k], normal[k] * turned_normal[2]
        jacobian[row, 3:] = (by_k + by_z) / (normal[2] ** 2 + normal[k] ** 2)
    x, y, z = pose.translation_m.tolist()
    x, y = x / z, y / z
    (xx, xy), (yx, yy) = camera.distort_jacobian(np.array([x, y])).tolist()
    # the image of the axis is lens @ (d_xy − (x, y) · d_z)/z; how the lens changes is negligible
    along_x, along_y = axis[0] - x * axis[2], axis[1] - y * axis[2]
    right, down = xx * along_x + xy * along_y, yx * along_x + yy * along_y
    square = right * right + down * down
    across_x, across_y = (right * yx - down * xx) / square, (right * yy - down * xy) / square
    by_axis = np.array([across_x, across_y, -(across_x * x + across_y * y)])
    jacobian[2, 3:], jacobian[2, :3] = by_axis @ turned_axis, -axis[2] / z * by_axis
    return np.degrees(jacobian)


def _across_axes(x: float, y: float, z: float) -> FloatArray:
    """Return the cross products (3, 3) of a vector with the three axes, as rows."""
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
