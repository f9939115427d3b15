"""Covariance of a disc's centroid and moments, from the residuals as they are.

As for coded targets (`adjustment.covariance`): scores are summed over arcs of the edge, and their
scatter is held against what independent residuals of this very fit would leave. A disc has few
arcs: only a whole photograph shows that variances are below those of independent pixels. That is
where JPEG compressed it, block by block of 8 × 8 pixels: so scores are summed over these, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.discs.affine_model import Geometry, mean_radius_px
from kgcp.measurement.discs.disc_levels import GEOMETRY_COUNT
from kgcp.measurement.discs.fit_disc import DiscFit
from kgcp.measurement.discs.pixel_choice import outward_px
from kgcp.measurement.image_model.noise import median_at_edges
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.residual_agreement import sums_over_arcs

_ARC_PX = 6.0
_FEWEST_ARCS = 8
_BLOCK_PX, _FEWEST_BLOCKS = 8, 40.0  # of JPEG; in all discs of a photograph
_ARCS_IN_COMMON = 40.0  # what all discs of a photograph scatter counts like so many arcs
_LEAST_LEFT, _NEARLY_NONE = 1.0, 1e-6  # of the scatter, after the fit
_OUTLYING_RATIO = 3.0  # of the median; larger ratios are those of single discs
_LEAST_FACTOR = 0.25  # of variances, as for coded targets
# Variances of ratios that independent residuals show, by one arc, by one block and by one pixel of
# an edge
_ARC_VARIANCE, _BLOCK_VARIANCE, _PIXEL_VARIANCE = 2.0, 1.5, 2.5
# Of centre and edge, whatever the noise; 0.0005 px made deviations of simulated discs of R 60 px
# up to 15 % too large.
_FLOOR_PX = 0.0002
_COMMON_SHARE = 0.25  # where edges scatter more than noise makes them, so much of it, …
_EXTRAPOLATED_SHARE = 0.025  # … and so much of how far they are beyond what is not clipped
# By how much of the blur the camera may displace all edges alike, as standard deviations, from the
# cases named of `benchmarks.calibrate.operator`. An unknown curve that three parameters do not hold
# does it by 0.05 to 0.13 px where σ is 0.67 px (`unknown_film`). If discs are too few to show that
# a curve is bent, it is known no better.
_OF_UNKNOWN_CURVE = 0.15
# Compression of quality 92 and 85 does it by 0.02 to 0.06 px, and where white is burnt by 0.05 and
# 0.18 px (`srgb_jpeg`, `clipped_jpeg`). A curve that could bend in each disc would take it up
# instead, and displace centres where the light falls off: by 0.005 px at R 150 px, 1.9 deviations.
_OF_COMPRESSION, _OF_COMPRESSION_OF_BURNT = 0.08, 0.3
# Out of focus, the point spread has more to it than a kurtosis. The half of an edge that is not
# burnt shows it as a displacement of 0.035 to 0.08 px where σ is 1.2 px (`defocused_clipped`).
_OUT_OF_FOCUS_AND_BURNT = 0.04
# Of what compression or an unknown tone curve may displace all edges by, so much is left of a ring
# that is measured as a whole, whose edges tell it: of the 0.1 px of a bent curve 0.007 px, where a
# film's leaves 0.012 px and sRGB's 0.001 px. Edges nearer to each other than so many px, or
# standard deviations of the blur, tell it wrongly: by a film's curve distances were off by 3 % at R
# 2.5 px and by 1.1 % at 3 px.
_LEFT_OF_RING, _LEAST_GAP_PX, _LEAST_GAP = 1.0 / 15.0, 1.9, 3.0
# Where the light falls off, a bent curve displaces opposite edges differently: of the blur, for
# light that falls off by all of itself over one radius. What discs had in common in ten draws of
# photographs was half of this (R 8 and 15 px), and twice this for one case of twelve.
_TONED_FALL = 0.05


@dataclass(frozen=True, slots=True)
class BlockScatter:
    """The scatter of one disc's scores over JPEG's blocks."""

    ratio: float  # mean ratio to that of independent residuals
    expected: float  # the latter scatter, after the fit: little, if there are few blocks
    count: float  # how many blocks of equal weight would tell as much


@dataclass(frozen=True, slots=True, eq=False)
class DiscScatter:
    """What the residuals of one disc say of its covariance."""

    independent: FloatArray  # (5, 5): of centroid [px] and moments [px²], for independent residuals
    common: FloatArray  # (5, 5): what an edge displaced as a whole adds, and the floor
    ratio: float  # mean ratio of the scatter of scores to that of independent residuals
    arcs: int  # that it was found from
    over_blocks: BlockScatter
    is_noise_alone: bool  # nothing is clipped, and light is linear

    def cov(self, inflation: float) -> FloatArray:
        """Return the covariance (5, 5) for an inflation of the independent part."""
        return inflation * self.independent + self.common


def scatter_of(fit: DiscFit) -> DiscScatter:
    """Return the parts of the covariance of centroid and second moments.

    Of a fit that `check_disc_fit` accepts: one with enough redundancy.
    """
    scaled, inverse = fit.scaled, np.linalg.inv(fit.normal).astype(np.float64)
    own = inverse[:GEOMETRY_COUNT]
    root = np.linalg.cholesky(own[:, :GEOMETRY_COUNT])
    to_own = np.linalg.solve(root, own)  # in units of N⁻¹
    of_own, of_all = np.ascontiguousarray((to_own @ scaled).T), np.ascontiguousarray(scaled.T)
    score, weight = fit.misfit.score, fit.misfit.weight
    sums, products, arcs = sums_over_arcs(of_own, of_all, score, weight, _arcs(fit))
    ratio = scatter_ratio(sums, products, to_own, inverse)
    sums, products, _ = sums_over_arcs(of_own, of_all, score, weight, _blocks(fit))
    expected = max(_scatter_left(products, to_own, inverse), _NEARLY_NONE)
    shares = np.einsum("bkp,kp->b", products, to_own)
    equal = float(shares.sum() ** 2 / np.sum(shares * shares))
    over_blocks = BlockScatter(float(np.sum(sums * sums)) / expected, expected, equal)
    if _edges_tell_displacement(fit):  # then `RingUnknowns` has what that does
        common_px = max(_FLOOR_PX, _LEFT_OF_RING * _of_camera_px(fit))
    else:
        common_px = common_displacement_px(fit)
    # an edge that is displaced everywhere grows both semi-axes alike: M by the identity
    grown = np.array((0.0, 0.0, 1.0, 0.0, 1.0)) * common_px
    common = np.outer(grown, grown) + np.diag([_FLOOR_PX**2] * GEOMETRY_COUNT)
    if fit.free.tone.is_shaped:
        aside_px = _TONED_FALL * fit.state.blur.mean_sd_px * fit.state.slope
        common[:2, :2] += np.outer(aside_px, aside_px)
    bent_px = _bend_px(fit)
    common[:2, :2] += bent_px @ bent_px
    to_moments = moments_by_stretch(fit.state.geometry)
    # errors over deviations of a noise that is estimated are distributed as Student's t
    freedom = fit.noise_freedom
    of_noise = freedom / (freedom - 2.0)
    return DiscScatter(
        of_noise * (to_moments @ own[:, :GEOMETRY_COUNT] @ to_moments.T),
        to_moments @ common @ to_moments.T,
        ratio,
        arcs,
        over_blocks,
        not (fit.sample.is_burnt or fit.free.is_light_curved),
    )


def scatter_ratio(
    sums: FloatArray, products: FloatArray, to_own: FloatArray, inverse: FloatArray
) -> float:
    """Return the scatter of the arcs' scores over the one that the model expects.

    Parameters
    ----------
    sums : (arcs, 5) array
        Scores of every arc, as they move the ellipse.
    products : (arcs, 5, p) array
        Normal matrices A of the arcs, of which the rows are carried to the ellipse in the same way.
    to_own : (5, p) array
        What carries them: the rows of the ellipse in N⁻¹, in units of their own root.
    inverse : (p, p) array
        N⁻¹, of all arcs and the priors.
    """
    left = _scatter_left(products, to_own, inverse)
    return float(np.sum(sums * sums)) / max(left, _LEAST_LEFT)


def _scatter_left(products: FloatArray, to_own: FloatArray, inverse: FloatArray) -> float:
    """Return the scatter of scores that a fit leaves of residuals as expected.

    Of an arc whose normal matrix is A, it leaves A − A N⁻¹ A.
    """
    return float(np.sum(products.sum(axis=0) * to_own) - np.sum((products @ inverse) * products))


def inflations(scatters: Sequence[DiscScatter]) -> FloatArray:
    """Return what to multiply the covariances (n,) of the discs of one photograph with.

    The ratio of one disc is uncertain, and that of a photograph is not: compression and jagged
    print are the same for all. Each disc's own ratio counts like its arcs, the photograph's like
    forty. What may be above 1 by chance is taken off: a disc alone has eight arcs or a few more.

    A factor is below 1 if the whole photograph shows that, beyond chance. Compression and a
    camera's denoising leave residuals that cancel each other over neighbouring pixels: by JPEG of
    quality 92, the squared scatter of blocks is 0.5 to 0.75 of what independent residuals would
    leave, and squared errors are smaller in the same way. It does not hold for burnt discs, whose
    levels are known beforehand rather than by residuals, nor for discs at the edge of a shadow,
    whose residuals are not those of noise.
    """
    if not scatters:
        return np.empty(0)
    is_noise_alone = np.array([each.is_noise_alone for each in scatters])
    ratios = np.array([each.ratio for each in scatters])
    arcs = np.array([each.arcs for each in scatters], dtype=np.float64)
    ratios[is_noise_alone] *= _blocks_over_arcs([each for each in scatters if each.is_noise_alone])
    in_common = _typical(ratios)
    of_chance = np.array(_ARC_VARIANCE / arcs.sum())
    shown = max(1.0 - float(beyond_chance(np.array(1.0 - in_common), of_chance)), _LEAST_FACTOR)
    least = np.where(is_noise_alone, shown, 1.0)
    weight = arcs + _ARCS_IN_COMMON
    pooled = (arcs * ratios + _ARCS_IN_COMMON * in_common) / weight
    shared = _ARCS_IN_COMMON * (2.0 * arcs + _ARCS_IN_COMMON) / arcs.sum()
    return least + beyond_chance(pooled - least, _ARC_VARIANCE * (arcs + shared) / weight**2)


def _blocks_over_arcs(scatters: Sequence[DiscScatter]) -> float:
    """Return the scatter over JPEG's blocks as a share of that over arcs; 1 if none was compressed.

    Errors of compression cancel each other over a block, and less so over arcs of edges, which are
    not along its borders. A few discs do not tell it.
    """
    blocks = [each.over_blocks for each in scatters]
    count = sum(each.count for each in blocks)
    if count < _FEWEST_BLOCKS:
        return 1.0
    weights = np.array([each.expected for each in blocks])
    over_blocks = _typical(np.array([each.ratio for each in blocks]), weights)
    over_arcs = _typical(np.array([each.ratio for each in scatters]))
    of_chance = np.array(_BLOCK_VARIANCE / count)
    return 1.0 - float(beyond_chance(np.array(1.0 - over_blocks / over_arcs), of_chance))


def _typical(ratios: FloatArray, weights: FloatArray | None = None) -> float:
    """Return the mean of ratios (n,), of which single discs' may be far above."""
    usual = np.minimum(ratios, _OUTLYING_RATIO * np.median(ratios))
    return float(np.average(usual, weights=weights))


def beyond_chance(excess: FloatArray, variance: FloatArray) -> FloatArray:
    """Return what excesses (n,) are beyond those that chance makes of none; ≥ 0.

    As the estimator of James and Stein: large ones stay as they are. Of chance alone 0.13 standard
    deviations are left in the mean. If only those below 0 were cut off, 0.4 would be: variances of
    a disc alone would be 16 % too large.
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
    """Return the standard deviation of the displacement that all of the edge shares [px].

    As of coded targets: from what edges scatter beyond the noise of the plateaus, and beyond what
    so few pixels do by chance, and from how far the middle of the edge is within what is clipped.
    """
    noise, blur_px = fit.noise, fit.state.blur.mean_sd_px
    state, tone, limits = fit.state, fit.free.tone, fit.sample.censoring
    is_edge = (fit.share > 0.2) & (fit.share < 0.8) & ~limits.is_clipped
    chance = np.array(_PIXEL_VARIANCE / max(int(np.count_nonzero(is_edge)), 1))
    excess = beyond_chance((noise.sd / noise.plateau_sd) ** 2 - 1.0, chance) * noise.plateau_sd**2
    at_edges = median_at_edges(excess, fit.share, 0.3, 0.7, 0.0)
    black, white = state.plateaus(tone)
    slope_per_px = (white - black) / (math.sqrt(2.0 * math.pi) * blur_px)
    burnt, sunk = state.share_at(limits.high, tone), state.share_at(limits.low, tone)
    hidden = max(0.5 - burnt, sunk - 0.5, 0.0)
    reach_px = blur_px * float(ndtri(min(0.5 + hidden, 1.0 - 1e-3)))
    of_edges_px = _COMMON_SHARE * math.sqrt(max(at_edges, 0.0)) / slope_per_px
    return max(_FLOOR_PX, _EXTRAPOLATED_SHARE * reach_px, of_edges_px, _of_camera_px(fit))


def _of_camera_px(fit: DiscFit) -> float:
    """Return by how much the camera may displace all edges alike, as standard deviation [px].

    Compression takes as much from both sides of an edge, unless a curve or burnt white makes them
    differ. Where all is burnt, clipped values that are smeared show that there was compression.
    """
    free, limits = fit.free, fit.sample.censoring
    of_curve = _OF_UNKNOWN_CURVE if free.is_curve_unknown else 0.0
    of_compression = of_focus = 0.0
    if fit.sample.is_burnt:
        of_focus = _OUT_OF_FOCUS_AND_BURNT if free.kurtosis else 0.0
        is_smeared = math.isfinite(limits.ceiling) or math.isfinite(limits.floor)
        of_compression = _OF_COMPRESSION_OF_BURNT * (free.is_compressed or is_smeared)
    elif free.tone is not Tone.LINEAR:
        of_compression = _OF_COMPRESSION * free.is_compressed
    return math.hypot(of_curve, of_compression, of_focus) * fit.state.blur.mean_sd_px


def _edges_tell_displacement(fit: DiscFit) -> bool:
    """Tell whether a ring's edges are far enough apart to show how far ink spreads over them."""
    pixels, state = fit.sample.pixels, fit.state
    if not len(pixels.inner):
        return False
    gap_px = -float(np.diff(pixels.circles[:, 2]).max()) * mean_radius_px(state.geometry)
    return gap_px > max(_LEAST_GAP_PX, _LEAST_GAP * state.blur.mean_sd_px)


def _bend_px(fit: DiscFit) -> FloatArray:
    """Return by how much light beyond second order may displace the centre (2, 2) [px].

    The step of a shadow has all orders. The next ones count as much as the second: a relative
    change of the light, over the margin that is used, displaces edges by so much of the blur.
    """
    blur = fit.state.blur
    return blur.mean_sd_px * outward_px(blur) ** 2 * fit.light_curvature


def _arcs(fit: DiscFit) -> IndexArray:
    """Return the number (n,) of the arc that every pixel is at."""
    geometry, places = fit.state.geometry, fit.sample.pixels.places_px
    stretch = geometry[[2, 3, 3, 4]].reshape(2, 2)
    u, v = np.linalg.solve(stretch, places - geometry[:2, None])
    length_px = 2.0 * math.pi * math.sqrt(abs(float(np.linalg.det(stretch))))
    count = max(round(length_px / _ARC_PX), _FEWEST_ARCS)
    turn = np.arctan2(v, u) / (2.0 * np.pi) % 1.0
    return np.asarray(np.minimum((turn * count).astype(np.intp), count - 1))


def _blocks(fit: DiscFit) -> IndexArray:
    """Return the number (n,) of the block that every pixel is in, if the photograph is whole."""
    columns, rows = fit.sample.pixels.places_px.astype(np.intp) // _BLOCK_PX
    numbers = rows * (fit.sample.window.frame_px // _BLOCK_PX + 1) + columns
    return np.unique(numbers, return_inverse=True)[1]
