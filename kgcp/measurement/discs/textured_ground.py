"""The edge of a disc on ground that has a texture.

Texture is not like the noise of pixels: it is correlated, and a pixel shows it only as far as it
sees the ground. The residuals have the covariance

    Σ = s² h hᵀ ∘ ρ + σ² I

with the derivative h of a pixel's grey value by the light of the ground, the texture's standard
deviation s and correlation ρ, and the noise σ of pixels.

Least squares with the weights Σ⁻¹ rely most on the inner side of the edge, where pixels see little
of the ground, and predict the texture at the edge from the ground beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.measurement.discs.adjust_disc import foreign_pixels
from kgcp.measurement.discs.affine_model import Geometry, distances_px, mean_radius_px
from kgcp.measurement.discs.covariance import (
    DiscScatter,
    inflations,
    moments_by_stretch,
    scatter_over_arcs,
)
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

# Tuning: `benchmarks.ground.plain_targets --kind "bare white disc"` shows errors and deviations.
_ROUNDS, _TEXTURE_ROUNDS = 5, 2
_SETTLED_PX = 0.001  # a smaller step ends the rounds
_UNSETTLED_PX = 0.02  # if the last step is larger, there is no result
# Most pixels of a sector. With 150, stated deviations are 7 % smaller than errors; with 400, 2 %.
_MOST_PIXELS = 400
_MOST_IN_MODES, _TEXTURE_SECTORS = 150, 8  # pixels, and number, of sectors that tell the texture
_EVERY_OF_MIDDLE = 7  # one in this many pixels of the disc's middle is used: for its level
# Pixels that see at least this share of ground tell the texture; those that see at most this share
# are on the disc.
_GROUND, _DISC = 0.98, 0.5
_FEWEST = 10  # pixels, to tell noise or texture
_DISC_PARAMETERS = 2  # level and blur, which the disc's pixels determine alone
_MUCH_CLIPPED = 0.05  # largest share of clipped pixels on the disc, and on the ground
# Discs above this radius may lie on more than one kind of ground. Half on grass and half on
# asphalt, errors at R 25 px were 1.5 times the deviations of a single texture. So their variances
# are taken to be at least those of independent pixels.
_ONE_GROUND_PX = 20.0
_LEAST_NOISE_COUNTS = 0.3  # of quantisation alone
_SLOPES = np.array((Row.SLOPE_X, Row.SLOPE_Y))


def fit_on_texture(
    fit: DiscFit, scatter: DiscScatter, others: Sequence[Geometry]
) -> tuple[DiscFit, DiscScatter]:
    """Adjust a disc again, with the covariance of the ground's texture.

    Parameters
    ----------
    fit, scatter
        Of the adjustment with independent pixels.
    others : sequence of Geometry
        Edges whose pixels are left out.

    Raises
    ------
    NoFit
        If the equations cannot be solved, the steps do not settle, disc or ground are burnt, or
        hardly any ground is left.
    """
    sample, state = _sample_with_all_ground(fit, others), fit.state
    current = _linearised(fit, sample, state)
    seen, ground_share = _is_seen(current), _ground_share(current)
    is_ground, is_disc = ground_share > _GROUND, ground_share < _DISC
    for part in (is_ground, is_disc):
        if np.count_nonzero(part) < _FEWEST or np.mean(~seen[part]) > _MUCH_CLIPPED:
            raise NoFit
    centre_px, places_px = state.geometry[:2], sample.pixels.places_px
    sectors = sectors_about(centre_px, places_px, _MOST_PIXELS)
    narrow = sectors_about(centre_px, places_px, _MOST_IN_MODES)
    every = math.ceil(len(narrow) / _TEXTURE_SECTORS)
    modes = TextureModes.of([each.only(is_ground & seen) for each in narrow[::every]])
    for number in range(_ROUNDS):
        noise = _noise(current)
        if number < _TEXTURE_ROUNDS:
            columns = np.vstack((_by_ground(current), current.jacobian[_SLOPES])).T
            texture = modes.likeliest(columns, sample.levels - current.levels, noise)
        normal, gradient = _with_priors(current, _equations(current, sectors, texture, noise))
        step = np.zeros(COUNT)
        step[fit.free.rows] = np.linalg.solve(normal, gradient)
        if not np.isfinite(step).all():
            raise NoFit
        state = state.moved(step, fit.free.tone)
        moved_px = float(np.abs(step[:GEOMETRY_COUNT]).max())
        if number >= _TEXTURE_ROUNDS and moved_px < _SETTLED_PX:
            break
        current = _linearised(fit, sample, state)
    if moved_px > _UNSETTLED_PX:
        raise NoFit
    arcs = sectors_about(centre_px, places_px, math.ceil(places_px.shape[1] / scatter.arcs))
    return replace(fit, state=state), _scatter(
        scatter, state, normal, _equations(current, arcs, texture, noise)
    )


def _ground_share(fit: DiscFit) -> FloatArray:
    """Return the share (n,) of every pixel that sees the ground."""
    return fit.share if fit.sample.pixels.is_dark else 1.0 - fit.share


def _linearised(fit: DiscFit, sample: DiscSample, state: DiscState) -> DiscFit:
    return disc_fit_at(sample, state, fit.free, np.ones(len(sample.levels)))


def _noise(fit: DiscFit) -> float:
    """Return the noise of pixels, from those within the disc."""
    seen, count = np.flatnonzero(_is_seen(fit)), fit.sample.window.levels_per_count
    share = _ground_share(fit)[seen]
    within = seen[share < 1.0 - _GROUND]
    if len(within) < _FEWEST:
        within = seen[np.argsort(share, kind="stable")[:_FEWEST]]
    residuals = (fit.sample.levels - fit.levels)[within]
    variance = float(residuals @ residuals) / (len(within) - _DISC_PARAMETERS)
    return math.sqrt(max(variance, (_LEAST_NOISE_COUNTS * count) ** 2))


def _sample_with_all_ground(fit: DiscFit, others: Sequence[Geometry]) -> DiscSample:
    """Return a sample of all pixels around the edge, without those of foreign things.

    No pixel is left out to save time: it is neighbouring pixels that tell the texture.
    """
    before, state, window = fit.sample, fit.state, fit.sample.window
    index, _ = choose_pixels(window, state.geometry, state.blur, others, is_thinned=False)
    off_px = distances_px(window.places_px(index), state.geometry)
    is_middle = off_px < -REACH_SIGMAS * state.blur.largest_sd_px
    row, column = np.divmod(index, window.width)
    index = index[~is_middle | ((3 * row + column) % _EVERY_OF_MIDDLE == 0)]
    limits = find_censoring(window.levels, window.levels_per_count, window.width)

    def sample_of(index: IndexArray) -> DiscSample:
        """Take pixels of the window, by their flat indices."""
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
    """Tell which pixels (n,) count: all but those that are clipped and modelled as clipped."""
    limits = fit.sample.censoring
    is_clipped = (limits.at_high & (fit.levels >= limits.high)) | (
        limits.at_low & (fit.levels <= limits.low)
    )
    return ~is_clipped


def _equations(
    fit: DiscFit, sectors: Sequence[Sector], texture: GroundTexture, noise: float
) -> FloatArray:
    """Return the equations (k, p, p + 1) of k sectors: normal matrices and, last, gradients."""
    rows, by_ground, seen = fit.jacobian[fit.free.rows], _by_ground(fit), _is_seen(fit)
    both = np.vstack((rows, fit.sample.levels - fit.levels)).T
    products = np.zeros((len(sectors), len(rows), len(rows) + 1))
    for of_sector, sector in zip(products, sectors, strict=True):
        part = sector.only(seen)
        cov = texture.cov(part.distances_px(), by_ground[part.index])
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


def _scatter(
    plain: DiscScatter, state: DiscState, normal: FloatArray, of_arcs: FloatArray
) -> DiscScatter:
    """Return the parts of the covariance, from the equations (arcs, p, p + 1) of arcs.

    A stone or a painted line at the edge is no texture. It displaces one arc, and so shows in the
    scatter over arcs.
    """
    inverse: FloatArray = np.linalg.inv(normal).astype(np.float64)
    own = inverse[:GEOMETRY_COUNT]
    to_own = np.linalg.solve(np.linalg.cholesky(own[:, :GEOMETRY_COUNT]), own)
    scatter, expected = scatter_over_arcs(
        of_arcs[:, :, -1] @ to_own.T, to_own @ of_arcs[:, :, :-1], to_own, inverse
    )
    to_moments = moments_by_stretch(state.geometry)
    independent = to_moments @ own[:, :GEOMETRY_COUNT] @ to_moments.T
    textured = replace(plain, independent=independent, scatter=scatter, expected=expected)
    if mean_radius_px(state.geometry) <= _ONE_GROUND_PX:
        return textured
    least, stated = (float(inflations([each])[0]) * each.independent for each in (plain, textured))
    scale = float(np.trace(np.linalg.solve(stated, least))) / GEOMETRY_COUNT
    return replace(textured, independent=max(scale, 1.0) * independent)
