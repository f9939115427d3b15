"""What the adjustment of a ring as a whole takes for known: the level within, and its ink's width.

Such a ring has two levels, ink and the same ground inside and outside, and its circles grow alike.
If the inside is a little darker or brighter, that displaces the edges. And what a tone curve or
burnt light leave of the edges' displacement widens the ink at all circles: the outer one grows, the
next one shrinks. Of a disc nothing tells that from its size. Of a ring the other edges do.

The ratio of the contrasts within and outside, and the ink's width, are therefore two more unknowns,
with priors about 1 and 0. They enter after the adjustment, by one Gauss-Newton step, as all else is
at its optimum then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.discs.affine_model import Geometry
from kgcp.measurement.discs.covariance import common_displacement_px
from kgcp.measurement.discs.disc_levels import GEOMETRY_COUNT
from kgcp.measurement.discs.fit_disc import DiscFit, DiscState

_PRIOR_SD = 0.1  # of the ratio
_STEP = 1e-3  # of the white share and of the outer radius, for differences
_MOST_OFF, _LEAST_SIGMAS = 0.2, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class HoleLevel:
    """The contrast within a ring over that outside it, and what it does to the outer edge.

    Attributes
    ----------
    ratio, sd : float
        By the pixels alone.
    correction : (5,) array
        Of the geometry: what the likeliest ratio and width of the ink make of it.
    cov : (5, 5) array
        What not knowing the two adds to the geometry's covariance.
    """

    ratio: float
    sd: float
    correction: Geometry
    cov: FloatArray

    @classmethod
    def of(cls, fit: DiscFit) -> HoleLevel:
        """Linearise at an adjusted ring."""
        slopes = np.array([_by_level_within(fit), _by_width(fit)]) / fit.sd
        shared = fit.scaled @ (fit.misfit.weight * slopes).T
        by_both = np.linalg.solve(fit.normal, shared)
        information = (fit.misfit.weight * slopes) @ slopes.T - shared.T @ by_both
        score = slopes @ fit.misfit.score
        sd = 1.0 / math.sqrt(max(float(information[0, 0]), 1e-12))
        sd_width = common_displacement_px(fit) / _mean_radius_px(fit)
        cov = np.linalg.inv(information + np.diag((_PRIOR_SD**-2, sd_width**-2)))
        moves: FloatArray = -by_both[:GEOMETRY_COUNT].astype(np.float64)
        return cls(
            1.0 + sd * sd * float(score[0]), sd, moves @ (cov @ score), moves @ cov @ moves.T
        )

    @property
    def is_seen(self) -> bool:
        """Whether the areas within are there, about as bright as the ground."""
        tolerance = max(_MOST_OFF, _LEAST_SIGMAS * self.sd)
        return abs(self.ratio - 1.0) < tolerance and self.ratio > _LEAST_SIGMAS * self.sd

    def corrected(self, state: DiscState) -> DiscState:
        """Return a state whose geometry is that of the likeliest ratio and width."""
        vector = state.vector.copy()
        vector[:GEOMETRY_COUNT] += self.correction
        return DiscState(vector)


def _by_level_within(fit: DiscFit) -> FloatArray:
    """Return the derivatives (n,) of the grey values by the contrast within."""
    pixels, state = fit.sample.pixels, fit.state
    within = pixels.circles[1:, 3] @ pixels.shares_within(state.geometry, state.blur)[1:]
    return _by_share(fit, _STEP * within)


def _by_width(fit: DiscFit) -> FloatArray:
    """Return the same by how far ink goes beyond each circle, in outer radii."""
    pixels, state = fit.sample.pixels, fit.state
    circles = pixels.circles.copy()
    circles[::2, 2] += _STEP
    circles[1::2, 2] -= _STEP
    wider = replace(pixels, circles=circles).white_share(state.geometry, state.blur).value
    return _by_share(fit, wider - fit.share)


def _by_share(fit: DiscFit, change: FloatArray) -> FloatArray:
    pixels, state = fit.sample.pixels, fit.state
    share = pixels.white_share(state.geometry, state.blur)
    changed = replace(share, value=share.value + change)
    levels, _ = fit.sample.level_model.linearised(changed, state.vector)
    return np.asarray((levels - fit.levels) / _STEP)


def _mean_radius_px(fit: DiscFit) -> float:
    _, _, xx, xy, yy = fit.state.geometry.tolist()
    return math.sqrt(abs(xx * yy - xy * xy))
