"""Whether the light on discs and ground is what it must be: as much more on white as on ink.

Light multiplies what a surface reflects, so that where it falls off over a photograph, bright
levels change the most. Of a negative it is the dark ones, and where white is burnt, the bright ones
do not change either. Then nothing tells how the light falls off over a bright level, and edges are
taken for displaced by it: by a few hundredths of a pixel, all in one direction.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray

_LEAST_CHANGE = 0.02  # of the dark levels: below, neither says anything
# Bright levels over dark ones. Photographs of all sorts have 1.2 to 13, simulated negatives 0.1 to
# 0.4 (0.9 by a film's curve, which is not told), burnt film 0.2.
_LEAST_RATIO = 0.5
_BURNT = 0.05  # share of clipped pixels
_FEWEST_DISCS = 12  # for a light of second order
_OUTLYING = 3.0  # robust deviations


@dataclass(frozen=True, slots=True)
class DiscLight:
    """How much the light changes the levels of discs and ground within photographs."""

    # standard deviation over a photograph of what changes smoothly, RMS of the photographs; of full
    # scale. Burnt photographs do not count if they are fewer than half.
    dark: float
    bright: float
    clipped: float  # median share of clipped pixels in these; NaN: not known

    @property
    def doubt(self) -> str:
        """What is wrong with the light; empty: nothing."""
        if self.dark < _LEAST_CHANGE or self.bright >= _LEAST_RATIO * self.dark:
            return ""
        is_whole = self.clipped <= _BURNT
        cause = "they look like" if is_whole else "white is burnt, or they are"
        return (
            f"the light changes dark levels of the photographs by {100.0 * self.dark:.1f} % and"
            f" bright ones by {100.0 * self.bright:.1f} % only: {cause} negatives"
        )


def light_on_discs(photographs: Iterable[tuple[FloatArray, FloatArray, FloatArray]]) -> DiscLight:
    """Return how much the light changes the levels of discs and of the ground around them.

    Parameters
    ----------
    photographs : iterable of ((k, 2) array, (k, 2) array, (k,) array)
        Of k discs each, six or more: places [px], levels inside and outside before clipping as
        share of full scale, and share of clipped pixels.
    """
    all_photographs = list(photographs)
    unburnt = [each for each in all_photographs if not np.median(each[2]) > _BURNT]
    considered = unburnt if 2 * len(unburnt) > len(all_photographs) else all_photographs
    changes, clipped = [], []
    for places_px, levels, share in considered:
        terms = _terms(places_px)
        ordered = np.sort(levels, axis=1)
        changes.append([_smooth_change(terms, level) for level in ordered.T])
        clipped.append(share)
    dark, bright = np.sqrt(np.mean(np.square(changes), axis=0)).tolist()
    return DiscLight(dark, bright, float(np.median(np.concatenate(clipped))))


def _terms(places_px: FloatArray) -> FloatArray:
    """Return terms (k, 6) of second order, or (k, 3) of first order for few discs."""
    x, y = ((places_px - places_px.mean(axis=0)) / places_px.std()).T
    linear = np.stack((np.ones_like(x), x, y), axis=1)
    if len(x) < _FEWEST_DISCS:
        return linear
    return np.column_stack((linear, x * x, x * y, y * y))


def _smooth_change(terms: FloatArray, level: FloatArray) -> float:
    """Return the standard deviation of what is smooth in levels (k,), outliers left out."""
    found = np.linalg.lstsq(terms, level)[0]
    residuals = np.abs(level - terms @ found)
    is_near = residuals <= _OUTLYING * 1.4826 * np.median(residuals)
    if np.count_nonzero(is_near) >= 2 * terms.shape[1]:
        found = np.linalg.lstsq(terms[is_near], level[is_near])[0]
    return float(np.std(terms @ found))
