"""The edge of a disc on ground that has a texture.

Texture is no noise of single pixels. It is alike in neighbouring ones, and a pixel has it only as
far as it sees the ground. With h the derivative of a pixel's grey value by the ground's light, s
the texture's standard deviation, ρ its correlation and σ the noise of pixels, the residuals have
the covariance

    Σ = s² h hᵀ ∘ ρ + σ² I.

Least squares with Σ⁻¹ make most of the inner side of the edge, where little of the ground is left,
and predict the texture at the edge from the ground beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.measurement.discs.adjust_disc import foreign_pixels
from kgcp.measurement.discs.affine_model import Geometry, distances_px
from kgcp.measurement.discs.covariance import DiscScatter, moments_by_stretch
from kgcp.measurement.discs.disc_levels import COUNT, GEOMETRY_COUNT, Row
from kgcp.measurement.discs.fit_disc import (
    DiscFit,
    DiscSample,
    DiscState,
    NoFit,
    disc_fit_at,
    noise_at,
)
from kgcp.measurement.discs.ground_texture import (
    GroundTexture,
    Sector,
    TextureModes,
    sectors_about,
)
from kgcp.measurement.discs.pixel_choice import choose_pixels
from kgcp.measurement.image_model.blur import REACH_SIGMAS
from kgcp.measurement.image_model.noise import find_censoring

# Tuning; `benchmarks.ground.plain_targets --kind "bare white disc"` has errors and deviations.
_ROUNDS, _TEXTURE_ROUNDS, _SETTLED_PX = 5, 2, 0.001
# Pixels in a sector: of 150, deviations are 7 % smaller than errors; of 400, 2 %.
_MOST_PIXELS = 400
_MOST_IN_MODES, _TEXTURE_SECTORS = 150, 8  # of those that tell the texture
_EVERY_OF_MIDDLE = 7  # of the disc's middle, which tells its level
_GROUND = 0.98  # share of the ground that a pixel sees, at least, to tell the texture
_FEWEST = 10  # pixels, to tell noise or texture
_OF_DISC = 2  # parameters that the disc's pixels alone tell: level and blur
_LEAST_LEFT = 1.0  # of the scatter, after the fit
_LEAST_NOISE_COUNTS = 0.3  # quantisation alone
_SLOPES = np.array((Row.SLOPE_X, Row.SLOPE_Y))


def fit_on_texture(
    fit: DiscFit, scatter: DiscScatter, others: Sequence[Geometry]
) -> tuple[DiscFit, DiscScatter]:
    """Adjust a disc anew, with the covariance of the ground's texture.

    Parameters
    ----------
    fit, scatter
        As adjusted to noise of single pixels. They are returned as they are if hardly any ground is
        seen that is not clipped.
    others : sequence of Geometry
        Edges whose pixels are left out.

    Raises
    ------
    NoFit
        If the equations cannot be solved.
    """
    sample, state = _with_all_pixels(fit, others), fit.state
    now = _linearised(fit, sample, state)
    centre_px, places_px = state.geometry[:2], sample.pixels.places_px
    is_ground = (_ground_share(now) > _GROUND) & _is_seen(now)
    if np.count_nonzero(is_ground) < _FEWEST:
        return fit, scatter
    sectors = sectors_about(centre_px, places_px, _MOST_PIXELS)
    small = sectors_about(centre_px, places_px, _MOST_IN_MODES)
    every = math.ceil(len(small) / _TEXTURE_SECTORS)
    modes = TextureModes.of([each.only(is_ground) for each in small[::every]])
    for number in range(_ROUNDS):
        noise = _noise(now)
        if number < _TEXTURE_ROUNDS:
            columns = np.vstack((_by_ground(now), now.jacobian[_SLOPES])).T
            texture = modes.likeliest(columns, sample.levels - now.levels, noise)
        normal, gradient = _with_priors(now, _equations(now, sectors, texture, noise))
        step = np.zeros(COUNT)
        step[fit.free.rows] = np.linalg.solve(normal, gradient)
        if not np.isfinite(step).all():
            raise NoFit
        state = state.moved(step, fit.free.tone)
        if number >= _TEXTURE_ROUNDS and np.abs(step[:GEOMETRY_COUNT]).max() < _SETTLED_PX:
            break
        now = _linearised(fit, sample, state)
    arcs = sectors_about(centre_px, places_px, math.ceil(places_px.shape[1] / scatter.arcs))
    ratio = _scatter_ratio(normal, _equations(now, arcs, texture, noise))
    to_moments = moments_by_stretch(state.geometry)
    cov = np.linalg.inv(normal)[:GEOMETRY_COUNT, :GEOMETRY_COUNT]
    independent = to_moments @ cov @ to_moments.T
    return replace(fit, state=state), replace(scatter, independent=independent, ratio=ratio)


def _ground_share(fit: DiscFit) -> FloatArray:
    """Return how much (n,) of every pixel sees the ground."""
    return fit.share if fit.sample.pixels.is_dark else 1.0 - fit.share


def _linearised(fit: DiscFit, sample: DiscSample, state: DiscState) -> DiscFit:
    return disc_fit_at(sample, state, fit.free, np.ones(len(sample.levels)))


def _noise(fit: DiscFit) -> float:
    """Return the noise of pixels, from those of the disc."""
    share, count = _ground_share(fit), fit.sample.window.levels_per_count
    within = np.flatnonzero(_is_seen(fit) & (share < 1.0 - _GROUND))
    if len(within) < _FEWEST:
        within = np.argsort(share, kind="stable")[:_FEWEST]
    residuals = (fit.sample.levels - fit.levels)[within]
    variance = float(residuals @ residuals) / (len(within) - _OF_DISC)
    return math.sqrt(max(variance, (_LEAST_NOISE_COUNTS * count) ** 2))


def _with_all_pixels(fit: DiscFit, others: Sequence[Geometry]) -> DiscSample:
    """Return a sample of all pixels around the edge, but those of foreign things.

    Texture is told by neighbouring pixels: none of the ground is left out.
    """
    before, state, window = fit.sample, fit.state, fit.sample.window
    index, _ = choose_pixels(window, state.geometry, state.blur, others, is_thinned=False)
    off_px = distances_px(window.places_px(index), state.geometry)
    is_middle = off_px < -REACH_SIGMAS * state.blur.largest_sd_px
    index = index[~is_middle | (index % _EVERY_OF_MIDDLE == 0)]
    limits = find_censoring(window.levels, window.levels_per_count)

    def sample_of(index: IndexArray) -> DiscSample:
        return DiscSample.of(
            window,
            index,
            state,
            limits,
            fit.free,
            is_dark=before.pixels.is_dark,
            radius_px=before.radius_px,
        )

    sample = sample_of(index)
    noise = noise_at(sample, state)
    foreign = foreign_pixels(disc_fit_at(sample, state, fit.free, noise.sd))
    return sample if foreign is None else sample_of(index[~foreign[index]])


def _by_ground(fit: DiscFit) -> FloatArray:
    """Return the derivatives (n,) of the grey values by the light of the ground."""
    row = Row.WHITE if fit.sample.pixels.is_dark else Row.BLACK
    return np.asarray(fit.jacobian[row])


def _is_seen(fit: DiscFit) -> BoolArray:
    """Return which pixels (n,) are not clipped; others agree with the model, as far as it goes."""
    limits = fit.sample.censoring
    is_clipped = (limits.at_high & (fit.levels >= limits.high)) | (
        limits.at_low & (fit.levels <= limits.low)
    )
    return ~is_clipped


def _equations(
    fit: DiscFit, sectors: Sequence[Sector], texture: GroundTexture, noise: float
) -> FloatArray:
    """Return the equations (k, p, p + 1) of each sector: normal matrix and gradient."""
    rows, by_ground, seen = fit.jacobian[fit.free.rows], _by_ground(fit), _is_seen(fit)
    both = np.vstack((rows, fit.sample.levels - fit.levels)).T
    products = np.zeros((len(sectors), len(rows), len(rows) + 1))
    for of_sector, sector in zip(products, sectors, strict=True):
        part = sector.only(seen)
        cov = texture.cov(part.distances_px, by_ground[part.index])
        cov.ravel()[:: len(cov) + 1] += noise * noise
        root, failure = dpotrf(cov, lower=1, clean=0)
        if failure:
            raise NoFit
        half, _ = dtrtrs(root, both[part.index], lower=1)
        of_sector[:] = half[:, :-1].T @ half
    return products


def _with_priors(fit: DiscFit, equations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrix (p, p) and the gradient (p,) of all sectors and the priors."""
    free, total = fit.free, equations.sum(axis=0)
    normal = total[:, :-1] + free.precision[np.ix_(free.rows, free.rows)]
    return normal, total[:, -1] + (free.precision @ (free.mean - fit.state.vector))[free.rows]


def _scatter_ratio(normal: FloatArray, equations: FloatArray) -> float:
    """Return the scatter of the arcs' gradients over the expected one, as they move the ellipse.

    A stone or a painted line at the edge is no texture: it pulls at one arc.
    """
    inverse = np.linalg.inv(normal)
    own = inverse[:GEOMETRY_COUNT]
    to_own = np.linalg.solve(np.linalg.cholesky(own[:, :GEOMETRY_COUNT]), own)
    moved = equations[:, :, -1] @ to_own.T
    # of an arc whose normal matrix is A, the fit leaves A − A N⁻¹ A
    products = to_own @ equations[:, :, :-1]
    left = float(np.sum(products.sum(axis=0) * to_own) - np.sum((products @ inverse) * products))
    return float(np.sum(moved * moved)) / max(left, _LEAST_LEFT)
