"""Covariance of a disc's centroid and moments, from residuals that may be correlated.

As for coded targets (`adjustment.covariance`), scores are summed over arcs of the edge, and their
scatter is compared with the one that this fit would leave of independent residuals. If a disc is
adjusted to JPEG's intervals, scores are summed over the blocks of 8 × 8 pixels. A disc has few arcs
or blocks, so that only all discs of a photograph together can show variances below those of
independent residuals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.discs.affine_model import Geometry, mean_radius_px
from kgcp.measurement.discs.compressed_fit import CompressedFit
from kgcp.measurement.discs.disc_levels import GEOMETRY_COUNT
from kgcp.measurement.discs.fit_disc import DiscFit, DiscSample
from kgcp.measurement.discs.pixel_choice import outward_px
from kgcp.measurement.image_model.noise import median_at_edges
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.residual_agreement import sums_over_arcs

_ARC_PX = 6.0
_FEWEST_ARCS = 8
_ARCS_OF_PHOTOGRAPH = 40.0  # weight, in arcs, of the ratio of all discs against that of one disc
_LEAST_EXPECTED = 1.0  # least scatter of a single disc with which its own is compared
# Ratios of single discs are cut at this many times the median, or at as many times as chance makes
# of 1 with these standard deviations. Of small discs in JPEGs, with three blocks each, three times
# the median would cut every tenth, and the mean would be 8 to 15 % too small.
_OUTLYING_RATIO, _OUTLYING_SDS = 3.0, 5.0
_LEAST_FACTOR = 0.25  # of variances, as for coded targets
# Variances by chance of a ratio of 1: from one arc or block, and from one pixel of an edge
_ARC_VARIANCE, _PIXEL_VARIANCE = 2.0, 2.5
# Least standard deviation of centre and edge, whatever the noise. With 0.0005 px, deviations of
# simulated discs of R 60 px were up to 15 % too large.
_FLOOR_PX = 0.0002
# Share of the scatter of edges beyond the noise that a whole edge may have in common, and share of
# the distance over which the place of a clipped edge is extrapolated
_COMMON_SHARE = 0.25
_EXTRAPOLATED_SHARE = 0.025
# The following are standard deviations of a displacement of all edges alike by the camera, as
# shares of the blur. They are from the named cases of `benchmarks.calibrate.operator`.
#
# An unknown curve has more than three parameters can describe. It displaces edges by 0.05 to 0.13
# px where the blur is 0.67 px (`unknown_film`), and by 0.2 px where white is burnt
# (`unknown_clipped_film`). That also counts if the discs are too few to show whether the curve is
# bent.
_BY_UNKNOWN_CURVE, _BY_UNKNOWN_CURVE_OF_BURNT = 0.15, 0.3
# Compression of quality 92 and 85 displaces edges by 0.02 to 0.06 px, and where white is burnt by
# 0.05 and 0.18 px (`srgb_jpeg`, `clipped_jpeg`). Burnt and with an unknown curve, it is 0.5 px
# (`unknown_clipped_jpeg`, quality 92). If the curve could bend in each disc instead, it would take
# that up, but displace centres where the light falls off: by 0.005 px at R 150 px, 1.9 deviations.
_BY_COMPRESSION, _BY_COMPRESSION_OF_BURNT, _BY_COMPRESSION_OF_BURNT_UNKNOWN = 0.08, 0.3, 0.7
# A single disc may be too small to show smeared pixels (`find_smear`), and its surroundings too
# even to show JPEG's blocks. Compression counts as found if more pixels than this share of the
# clipped ones are within six grey values below them. That holds for all of 448 single discs of R
# 2.5 to 8 px in JPEGs (`clipped_jpeg`), and for 2 % of as many without compression.
_BELOW_CLIPPED, _BELOW_COUNTS = 0.15, 6.0
# Burnt discs whose radius is less than this many times the blur do not tell size from brightness:
# at R 3 px, out of focus by 2 px, edges are displaced by 0.35 px (`defocused_clipped`).
_FEW_BLURS, _BY_BLUR_OF_BURNT = 3.0, 0.3
# A ring that is measured as a whole tells a displacement of all its edges, and this share of the
# above is left: 0.007 px of the 0.1 px of an unknown curve. (In simulations, film's curve leaves
# 0.012 px and sRGB's 0.001 px.) Edges that are nearer to each other than this, in pixels or in
# blurs, tell it wrongly: with film's curve, distances were off by 3 % at R 2.5 px and by 1.1 % at 3
# px. Between the two, more is left the nearer edges are: with film's curve, sharpening and JPEG,
# 0.017 px at a gap of 4 px and 0.030 px at 2.5 px.
_SHARE_LEFT_OF_RING, _LEAST_GAP_PX, _LEAST_GAP = 1.0 / 15.0, 1.9, 3.0
_WIDE_GAP_PX = 4.0
# Where the light falls off, a bent curve displaces opposite edges differently, and with them the
# centre. Its standard deviation is this share of the blur, times the relative change of the light
# over one radius. In ten draws of photographs, the displacement that discs had in common was half
# of this (R 8 and 15 px), and twice this in one case of twelve.
_BY_CURVE_PER_FALL = 0.05
KURTOSIS_SD = 0.3
"""A-priori standard deviation of the excess kurtosis of a camera's point spread.

Coded targets have a weaker prior: see `adjustment.spread_shape`.
"""
_SMALL_SHARE = 1e-3  # of the white share's change, for a numerical derivative


@dataclass(frozen=True, slots=True, eq=False)
class DiscScatter:
    """What the residuals of one disc say of its covariance."""

    independent: FloatArray  # (5, 5): of centroid [px] and moments [px²], for independent residuals
    common: FloatArray  # (5, 5): added for displacements of the whole edge, and the floor
    # Scatter of the scores over arcs, in units of the independent part, and the one that the fit
    # leaves of independent residuals
    scatter: float
    expected: float
    arcs: float  # number of arcs, or of blocks of equal weight, that these were found from
    is_noise_alone: bool  # whether nothing is clipped, and the light is linear

    @property
    def ratio(self) -> float:
        """Ratio of the scatter to the expected one; small if a fit leaves hardly any."""
        return self.scatter / max(self.expected, _LEAST_EXPECTED)

    def cov(self, inflation: float) -> FloatArray:
        """Return the covariance (5, 5) for an inflation of the independent part."""
        return inflation * self.independent + self.common


def scatter_of(adjusted: DiscFit | CompressedFit) -> DiscScatter:
    """Return the parts of the covariance of centroid and second moments.

    The fit must be one that `check_disc_fit` accepts, with enough redundancy.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equations are singular.
    """
    fit = adjusted.fit if isinstance(adjusted, CompressedFit) else adjusted
    misfit, scaled = adjusted.misfit, adjusted.scaled
    inverse = np.linalg.inv(adjusted.normal).astype(np.float64)
    own = inverse[:GEOMETRY_COUNT]
    root = np.linalg.cholesky(own[:, :GEOMETRY_COUNT])
    to_own = np.linalg.solve(root, own)  # in units of N⁻¹
    of_own, of_all = np.ascontiguousarray((to_own @ scaled).T), np.ascontiguousarray(scaled.T)
    group = adjusted.block if isinstance(adjusted, CompressedFit) else _arcs(fit)
    sums, products, count = sums_over_arcs(of_own, of_all, misfit.score, misfit.weight, group)
    scatter, expected = scatter_over_arcs(sums, products, to_own, inverse)
    if isinstance(adjusted, CompressedFit):
        # blocks differ in weight, and the noise is known from all discs of the photograph
        shares = np.einsum("bkp,kp->b", products, to_own)
        arcs, t_variance = float(shares.sum() ** 2 / np.sum(shares * shares)), 1.0
    else:
        # with an estimated noise, errors over deviations are distributed as Student's t
        freedom = fit.noise_freedom
        arcs, t_variance = float(count), freedom / (freedom - 2.0)
    if _edges_tell_displacement(fit):  # `RingUnknowns` allows for the displacement itself
        share = _SHARE_LEFT_OF_RING * max(_WIDE_GAP_PX / _gap_px(fit), 1.0)
        common_px = max(_FLOOR_PX, share * _camera_displacement_px(fit))
        by_point_spread = np.zeros(GEOMETRY_COUNT)
    else:
        common_px = common_displacement_px(fit)
        by_point_spread = _displacement_by_point_spread(fit)
    # an edge that is displaced everywhere alike changes M by a multiple of the identity
    grown = np.array((0.0, 0.0, 1.0, 0.0, 1.0)) * common_px
    common = np.outer(grown, grown) + np.diag([_FLOOR_PX**2] * GEOMETRY_COUNT)
    common += np.outer(by_point_spread, by_point_spread)
    if fit.free.tone.is_shaped:
        by_curve_px = _BY_CURVE_PER_FALL * fit.state.blur.mean_sd_px * fit.state.slope
        common[:2, :2] += np.outer(by_curve_px, by_curve_px)
    by_curved_light_px = _curved_light_displacement_px(fit)
    common[:2, :2] += by_curved_light_px @ by_curved_light_px
    # edges across the second order are displaced outwards or inwards by as much as the centre
    stretched = by_curved_light_px[[0, 0, 1], [0, 1, 1]]
    common[2:, 2:] += np.outer(stretched, stretched)
    to_moments = moments_by_stretch(fit.state.geometry)
    return DiscScatter(
        t_variance * (to_moments @ own[:, :GEOMETRY_COUNT] @ to_moments.T),
        to_moments @ common @ to_moments.T,
        scatter,
        expected,
        arcs,
        not (fit.sample.is_burnt or fit.free.is_light_curved),
    )


def scatter_over_arcs(
    sums: FloatArray, products: FloatArray, to_own: FloatArray, inverse: FloatArray
) -> tuple[float, float]:
    """Return the scatter of the arcs' scores, and the expected one of independent residuals.

    Of the latter, a fit leaves A − A N⁻¹ A on an arc whose normal matrix is A.

    Parameters
    ----------
    sums : (arcs, 5) array
        Gradient of every arc, propagated to the ellipse: `to_own` times it.
    products : (arcs, 5, p) array
        `to_own` times the normal matrix A of every arc.
    to_own : (5, p) array
        Rows of the ellipse in N⁻¹, in units of the root of its own part.
    inverse : (p, p) array
        N⁻¹, of all arcs and the priors.
    """
    expected = np.sum(products.sum(axis=0) * to_own) - np.sum((products @ inverse) * products)
    return float(np.sum(sums * sums)), float(expected)


def inflations(scatters: Sequence[DiscScatter]) -> FloatArray:
    """Return the factors (n,) of the covariances of the discs of one photograph.

    The ratio of one disc is uncertain. That of a photograph is not, and compression and jagged
    print are the same for all its discs. So each disc's own ratio counts with the number of its
    arcs, and the photograph's like forty arcs. What exceeds 1 by chance is taken off: a single disc
    has only eight arcs or a few more.

    A factor is below 1 if the whole photograph shows that, beyond chance: a camera's denoising
    leaves residuals that cancel each other over neighbouring pixels. This does not hold for burnt
    discs, whose levels are known beforehand rather than from residuals, nor at edges of shadows,
    where residuals are not only noise.
    """
    if not scatters:
        return np.empty(0)
    is_noise_alone = np.array([each.is_noise_alone for each in scatters])
    ratios = np.array([each.ratio for each in scatters])
    arcs = np.array([each.arcs for each in scatters], dtype=np.float64)
    of_photograph = _ratio_of_photograph(scatters)
    chance = np.array(_ARC_VARIANCE / arcs.sum())
    shown = max(1.0 - float(beyond_chance(np.array(1.0 - of_photograph), chance)), _LEAST_FACTOR)
    least = np.where(is_noise_alone, shown, 1.0)
    weight = arcs + _ARCS_OF_PHOTOGRAPH
    pooled = (arcs * ratios + _ARCS_OF_PHOTOGRAPH * of_photograph) / weight
    shared = _ARCS_OF_PHOTOGRAPH * (2.0 * arcs + _ARCS_OF_PHOTOGRAPH) / arcs.sum()
    return least + beyond_chance(pooled - least, _ARC_VARIANCE * (arcs + shared) / weight**2)


def _ratio_of_photograph(scatters: Sequence[DiscScatter]) -> float:
    """Return the scatter of all discs relative to the expected one.

    Of small discs in JPEGs, which fill two blocks each, a fit leaves hardly any scatter; together
    they tell it nevertheless. Ratios of single discs that are far above the others are cut.
    """
    ratios = np.array([each.ratio for each in scatters])
    by_chance = np.sqrt(_ARC_VARIANCE / np.array([each.arcs for each in scatters]))
    most = np.maximum(1.0 + _OUTLYING_SDS * by_chance, _OUTLYING_RATIO)
    usual = np.minimum(ratios, most * np.median(ratios))
    expected = np.array([each.expected for each in scatters])
    scatter = float(np.sum(usual * np.maximum(expected, _LEAST_EXPECTED)))
    return scatter / max(float(expected.sum()), _LEAST_EXPECTED)


def beyond_chance(excess: FloatArray, variance: FloatArray) -> FloatArray:
    """Return excesses (n,), reduced by what chance alone makes of an excess of 0; at least 0.

    As with the estimator of James and Stein, large excesses stay as they are. Of chance alone, 0.13
    standard deviations are left in the mean. If negative excesses were merely set to 0, it would be
    0.4, and variances of a single disc would be 16 % too large.
    """
    return np.maximum(excess - variance / np.maximum(excess, 1e-12), 0.0)


def moments_by_stretch(geometry: Geometry) -> FloatArray:
    """Return the derivatives (5, 5) of the moments x, y and M M / 4 by x, y and M."""
    _, _, xx, xy, yy = geometry.tolist()
    slopes = np.eye(GEOMETRY_COUNT)
    slopes[2:, 2:] = [
        [0.5 * xx, 0.5 * xy, 0.0],
        [0.25 * xy, 0.25 * (xx + yy), 0.25 * xy],
        [0.0, 0.5 * xy, 0.5 * yy],
    ]
    return slopes


def common_displacement_px(fit: DiscFit) -> float:
    """Return the standard deviation of the displacement that the whole edge has in common [px].

    As for coded targets, it follows from how much edges scatter beyond the noise of the plateaus
    (here less what so few pixels do by chance), and from how deep the middle of the edge lies in
    the clipped part. The camera's displacement counts, too.
    """
    noise, blur_px = fit.noise, fit.state.blur.mean_sd_px
    limits = fit.sample.censoring
    is_edge = (fit.share > 0.2) & (fit.share < 0.8) & ~limits.is_clipped
    chance = np.array(_PIXEL_VARIANCE / max(int(np.count_nonzero(is_edge)), 1))
    excess = beyond_chance((noise.sd / noise.plateau_sd) ** 2 - 1.0, chance) * noise.plateau_sd**2
    at_edges = median_at_edges(excess, fit.share, 0.3, 0.7, 0.0)
    black, white = fit.state.plateaus(fit.free.tone)
    slope_per_px = (white - black) / (math.sqrt(2.0 * math.pi) * blur_px)
    reach_px = blur_px * float(ndtri(min(0.5 + _hidden_share(fit), 1.0 - 1e-3)))
    by_scatter_px = _COMMON_SHARE * math.sqrt(max(at_edges, 0.0)) / slope_per_px
    return max(
        _FLOOR_PX, _EXTRAPOLATED_SHARE * reach_px, by_scatter_px, _camera_displacement_px(fit)
    )


def _hidden_share(fit: DiscFit) -> float:
    """Return how much of the contrast is clipped beyond the middle of the edge; 0: it is seen."""
    state, tone, limits = fit.state, fit.free.tone, fit.sample.censoring
    at_high, at_low = state.share_at(limits.high, tone), state.share_at(limits.low, tone)
    return max(0.5 - at_high, at_low - 0.5, 0.0)


def _camera_displacement_px(fit: DiscFit) -> float:
    """Return the standard deviation of a displacement of all edges by the camera [px].

    Compression changes both sides of an edge alike, and does not displace it, unless a curve or
    burnt white makes the sides differ. On burnt ground, smeared clipped values show compression.
    """
    free = fit.free
    by_curve = _BY_UNKNOWN_CURVE if free.is_curve_unknown else 0.0
    by_compression = by_blur = 0.0
    blur_px = fit.state.blur.mean_sd_px
    if fit.sample.is_burnt:
        by_curve = _BY_UNKNOWN_CURVE_OF_BURNT if free.is_curve_unknown else 0.0
        if free.is_compressed or _looks_smeared(fit.sample):
            by_compression = (
                _BY_COMPRESSION_OF_BURNT_UNKNOWN if by_curve else _BY_COMPRESSION_OF_BURNT
            )
        if mean_radius_px(fit.state.geometry) < _FEW_BLURS * blur_px:
            by_blur = _BY_BLUR_OF_BURNT
    elif free.tone is not Tone.LINEAR:
        by_compression = _BY_COMPRESSION * free.is_compressed
    return math.hypot(math.hypot(by_curve, by_compression, by_blur) * blur_px, free.curve_spread_px)


def _displacement_by_point_spread(fit: DiscFit) -> FloatArray:
    """Return one standard deviation of the ellipse (5,) by the shape of the point spread [px].

    An edge that is seen as a whole hardly depends on it, unless the disc is hardly larger than the
    blur. Of a burnt edge only the foot is seen, and the point spread tells where its middle is.
    """
    is_small = mean_radius_px(fit.state.geometry) < _FEW_BLURS * fit.state.blur.mean_sd_px
    if not fit.sample.is_burnt and not is_small:
        return np.zeros(GEOMETRY_COUNT)
    by_kurtosis = levels_by_kurtosis(fit) / fit.sd
    terms = fit.scaled @ (fit.misfit.weight * by_kurtosis)
    moved = np.linalg.solve(fit.normal, terms)[:GEOMETRY_COUNT]
    sd = fit.free.kurtosis_sd
    if _hidden_share(fit):
        # what is seen is no more than the foot, by which a kurtosis is found too small by half
        sd = max(sd, KURTOSIS_SD + abs(fit.free.kurtosis))
    return np.asarray(moved * sd)


def levels_by_kurtosis(fit: DiscFit) -> FloatArray:
    """Return the derivative (n,) of the grey values by the excess kurtosis of the point spread."""
    by_kurtosis = fit.sample.pixels.by_kurtosis(fit.state.geometry, fit.state.blur)
    changed = levels_changed(fit, _SMALL_SHARE * by_kurtosis[None])[0]
    return np.asarray(changed / _SMALL_SHARE)


def levels_changed(fit: DiscFit, changes: FloatArray) -> FloatArray:
    """Return the changes (k, n) of the grey values for some changes (k, n) of the white share."""
    pixels, state = fit.sample.pixels, fit.state
    share = pixels.white_share(state.geometry, state.blur)
    changed = [replace(share, value=share.value + change) for change in changes]
    levels = [fit.sample.level_model.linearised(each, state.vector)[0] for each in changed]
    return np.array(levels) - fit.levels


def _looks_smeared(sample: DiscSample) -> bool:
    """Tell whether compression may have smeared clipped pixels, even if they are few."""
    limits, step = sample.censoring, sample.window.levels_per_count
    if math.isfinite(limits.ceiling) or math.isfinite(limits.floor):
        return True
    below = (sample.levels < limits.high) & (sample.levels > limits.high - _BELOW_COUNTS * step)
    return bool(np.count_nonzero(below) > _BELOW_CLIPPED * np.count_nonzero(limits.at_high) > 0)


def _edges_tell_displacement(fit: DiscFit) -> bool:
    """Tell whether a ring's edges are far enough apart to show how far all are displaced."""
    if not len(fit.sample.pixels.inner):
        return False
    return _gap_px(fit) > max(_LEAST_GAP_PX, _LEAST_GAP * fit.state.blur.mean_sd_px)


def _gap_px(fit: DiscFit) -> float:
    """Return the least distance of a ring's edges [px]."""
    radii = fit.sample.pixels.circles[:, 2]
    return -float(np.diff(radii).max()) * mean_radius_px(fit.state.geometry)


def _curved_light_displacement_px(fit: DiscFit) -> FloatArray:
    """Return how far light beyond second order may displace centre and edges (2, 2) [px].

    The step of a shadow has all orders. The higher orders together count like the second: by as
    much as it changes the light over the margin that is used, relatively, edges may be displaced in
    units of the blur.
    """
    blur = fit.state.blur
    return blur.mean_sd_px * outward_px(blur) ** 2 * fit.light_curvature


def _arcs(fit: DiscFit) -> IndexArray:
    """Return the number (n,) of the arc that every pixel belongs to."""
    geometry, places = fit.state.geometry, fit.sample.pixels.places_px
    stretch = geometry[[2, 3, 3, 4]].reshape(2, 2)
    u, v = np.linalg.solve(stretch, places - geometry[:2, None])
    length_px = 2.0 * math.pi * math.sqrt(abs(float(np.linalg.det(stretch))))
    count = max(round(length_px / _ARC_PX), _FEWEST_ARCS)
    turn = np.arctan2(v, u) / (2.0 * np.pi) % 1.0
    return np.asarray(np.minimum((turn * count).astype(np.intp), count - 1))
