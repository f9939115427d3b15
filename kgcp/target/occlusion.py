"""Rings of which something hides a part: where, and how well the rest fits."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import FloatArray
from kgcp.target.layout import Ring
from kgcp.target.noise import BoolArray
from kgcp.target.template import ANGLES, SAMPLED_RADII, SHIFTS, templates_of

ComplexArray = npt.NDArray[np.complex128]

_TYPICAL = 0.65  # quantile of steps of light that is not hidden, however much else is
_MIN_STEP = 0.35  # of the typical one
_SHORTEST = 13  # samples; a dot that is too large takes less
_BORDER = 2  # samples beside a hidden part that blur may mix with it
_MOST_HIDDEN = 0.4
_DOTS_SEEN = 0.5  # of the code; that there are no others where the ring is seen counts as much
_OTHER_LAG = 6  # samples; a match farther off is another heading
_MARGIN = 0.04  # of the score, to other headings


def visible_angles(seen: FloatArray, ring: Ring) -> BoolArray | None:
    """Tell at which angles a ring shows both of its edges.

    Parameters
    ----------
    seen : (rows, angles) array
        Grey values at the templates' radii.
    ring : Ring

    Returns
    -------
    (angles,) array of bool, or None
        None if nothing is hidden, or too much.
    """
    code = ring.code_diameter_m / ring.outer_diameter_m
    dot = ring.dot_diameter_m / ring.outer_diameter_m
    outwards = _row(seen, 1.1) - _row(seen, 0.5 * (1.0 + code + dot))
    inwards = _row(seen, 0.85 * ring.inner_ratio) - _row(
        seen, 0.5 * (ring.inner_ratio + code - dot)
    )
    visible = np.ones(ANGLES, dtype=bool)
    for step in (outwards, inwards):
        visible &= step > _MIN_STEP * np.sort(step)[round(_TYPICAL * (ANGLES - 1))]
    core = _all_around(~visible, _SHORTEST // 2)
    if not core.any():
        return None
    visible = _all_around(~core, _SHORTEST // 2 + _BORDER)
    return visible if visible.mean() >= 1.0 - _MOST_HIDDEN else None


def _all_around(flags: BoolArray, reach: int) -> BoolArray:
    """Tell where flags are set, and so many samples on either side."""
    around = np.concatenate((flags[-reach:], flags, flags[:reach]))
    return np.convolve(around, np.ones(2 * reach + 1), "valid") > 2 * reach + 0.5


def _row(seen: FloatArray, ratio: float) -> FloatArray:
    radii = SAMPLED_RADII[SHIFTS:-SHIFTS]
    return np.asarray(seen[int(np.abs(radii - ratio).argmin())])


def best_partial_template(
    patch: FloatArray, visible: BoolArray, ring: Ring
) -> tuple[float, int, int, int] | None:
    """Return score, template, shift and lag that fit the visible part of a patch best.

    None if the visible dots leave more than one heading, or if too few of them are seen.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    visible : (angles,) array of bool
    ring : Ring
    """
    score = _correlation(patch, visible, ring)
    lag, template, shift = np.unravel_index(int(score.argmax()), score.shape)
    best = float(score[lag, template, shift])
    by_lag = np.roll(score.max(axis=(1, 2)), -lag)
    others = by_lag[_OTHER_LAG : ANGLES - _OTHER_LAG + 1]
    at_dots = (np.rint(np.array(ring.code_deg) * ANGLES / 360.0).astype(int) + lag) % ANGLES
    seen = int(np.count_nonzero(visible[at_dots]))
    if seen < _DOTS_SEEN * len(at_dots) or others.max() > best - _MARGIN:
        return None
    return best, int(template), int(shift), int(lag)


@lru_cache(maxsize=16)
def _spectra(ring: Ring) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return spectra of the weighted templates: by (frequency, t, row); sums (t, frequency).

    The sums over the rows are those of the templates and of their squares.
    """
    templates = templates_of(ring)
    weighted = templates.images * templates.weights[:, None]
    plain = np.conj(np.fft.rfft(weighted, axis=2))
    squares = np.conj(np.fft.rfft(np.sum(weighted * templates.images, axis=1), axis=1))
    return plain.transpose(2, 0, 1).copy(), plain.sum(axis=1), squares


def _correlation(patch: FloatArray, visible: BoolArray, ring: Ring) -> FloatArray:
    """Return the normalised cross-correlation of what is visible: (lag, template, shift)."""
    by_row, plain, squares = _spectra(ring)
    weights = templates_of(ring).weights
    mask = np.fft.rfft(visible.astype(np.float64))
    total = float(weights.sum() * visible.sum())
    sum_t = np.fft.irfft(plain * mask, ANGLES).T / total  # lag, template
    sum_tt = np.fft.irfft(squares * mask, ANGLES).T / total
    spread_t = np.sqrt(np.maximum(sum_tt - sum_t**2, 1e-12))
    masked = patch * visible
    window = np.arange(len(patch) - len(weights) + 1)[:, None] + np.arange(len(weights))
    sums = np.stack((masked.sum(axis=1), np.einsum("ra,ra->r", masked, masked)))
    mean, power = sums[:, window] @ weights / total  # of every shift
    spread = np.sqrt(np.maximum(power - mean**2, 1e-12))
    spectrum = np.fft.rfft(masked, axis=1).T
    cross = np.fft.irfft(by_row @ spectrum[:, window.T], ANGLES, axis=0)
    covariance = cross / total - sum_t[:, :, None] * mean
    return np.asarray(covariance / (spread_t[:, :, None] * spread))
