"""Test for negatives, reflections and burnt white: light must change bright levels most.

Light multiplies what a surface reflects. Where it falls off over a photograph, bright levels
therefore change the most. In a negative, the dark ones do; with burnt white, the bright ones do not
change. The falloff over bright surfaces is then unknown, and is mistaken for a displacement of
edges by a few hundredths of a pixel, all in one direction. Reflections on a glossy sheet add the
same light to dark and bright; a tone curve that is steeper in the dark then shows it there most.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray

_MIN_CHANGE = 0.02  # of the dark levels, of full scale; below, the light is too even to tell
# Least ratio of the change of bright levels to that of dark ones. It is 1.2 to 13 in photographs of
# all sorts, 0.2 in burnt film, and 0.1 to 0.4 in simulated negatives; those with a film's curve
# have 0.9 and are not recognised.
_MIN_RATIO = 0.5
_BURNT = 0.05  # median share of clipped pixels above which a photograph is burnt
_MIN_DISCS = 12  # for light of second order
_MAX_DEVIATION = 3.0  # of a level from the smooth light, in robust standard deviations


@dataclass(frozen=True, slots=True)
class DiscLight:
    """Smooth change of the levels of discs and ground within photographs."""

    # Standard deviation of the smooth part of the levels over a photograph, as share of full scale;
    # RMS of the photographs. Burnt photographs are left out if they are fewer than half.
    dark: float
    bright: float
    clipped: float  # median share of clipped pixels in the same photographs; NaN: not known

    @property
    def doubt(self) -> str:
        """What is wrong with the light; empty: nothing."""
        if self.dark < _MIN_CHANGE or self.bright >= _MIN_RATIO * self.dark:
            return ""
        is_unclipped = self.clipped <= _BURNT
        cause = "" if is_unclipped else "white is burnt, or "
        return (
            f"the light changes dark levels of the photographs by {100.0 * self.dark:.1f} % and"
            f" bright ones by {100.0 * self.bright:.1f} % only: {cause}they are negatives, or the"
            " field reflects light"
        )


def light_on_discs(photographs: Iterable[tuple[FloatArray, FloatArray, FloatArray]]) -> DiscLight:
    """Return how much the light changes the levels of discs and of the ground around them.

    Parameters
    ----------
    photographs : iterable of ((k, 2) array, (k, 2) array, (k,) array)
        For each photograph, of k ≥ 6 discs: places [px], levels inside and outside before clipping
        as share of full scale, and share of clipped pixels.
    """
    all_photographs = list(photographs)
    unburnt = [photo for photo in all_photographs if not np.median(photo[2]) > _BURNT]
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
    """Return polynomial terms of second order (k, 6), or of first order (k, 3) for few discs."""
    x, y = ((places_px - places_px.mean(axis=0)) / places_px.std()).T
    linear = np.stack((np.ones_like(x), x, y), axis=1)
    if len(x) < _MIN_DISCS:
        return linear
    return np.column_stack((linear, x * x, x * y, y * y))


def _smooth_change(terms: FloatArray, level: FloatArray) -> float:
    """Return the standard deviation of the smooth part of levels (k,), without outliers."""
    coefficients = np.linalg.lstsq(terms, level)[0]
    residuals = np.abs(level - terms @ coefficients)
    is_inlier = residuals <= _MAX_DEVIATION * 1.4826 * np.median(residuals)
    if np.count_nonzero(is_inlier) >= 2 * terms.shape[1]:
        coefficients = np.linalg.lstsq(terms[is_inlier], level[is_inlier])[0]
    return float(np.std(terms @ coefficients))
