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
from kgcp.measurement.discs.affine_model import Geometry, mean_radius_px
from kgcp.measurement.discs.covariance import common_displacement_px
from kgcp.measurement.discs.disc_levels import GEOMETRY_COUNT
from kgcp.measurement.discs.fit_disc import DiscFit, DiscState

_PRIOR_SD = 0.1  # of the ratio
_STEP = 1e-3  # of the white share and of the outer radius, for differences
_MOST_OFF, _LEAST_SIGMAS = 0.2, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class RingUnknowns:
    """The contrast within a ring over that outside it, its ink's width, and what both displace.

    Attributes
    ----------
    ratio, sd : float
        Of the contrasts, by the pixels alone.
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
    def of(cls, fit: DiscFit) -> RingUnknowns:
        """Linearise at an adjusted ring."""
        changes = np.array([_STEP * _within(fit), _wider_ink(fit)])
        slopes = _levels_changed(fit, changes) / (_STEP * fit.sd)
        shared = fit.scaled @ (fit.misfit.weight * slopes).T
        by_both = np.linalg.solve(fit.normal, shared)
        information = (fit.misfit.weight * slopes) @ slopes.T - shared.T @ by_both
        score = slopes @ fit.misfit.score
        sd = 1.0 / math.sqrt(max(float(information[0, 0]), 1e-12))
        sd_width = common_displacement_px(fit) / mean_radius_px(fit.state.geometry)
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


def _within(fit: DiscFit) -> FloatArray:
    """Return the change (n,) of the white share by the contrast within."""
    pixels, state = fit.sample.pixels, fit.state
    return np.asarray(pixels.circles[1:, 3] @ pixels.shares_within(state.geometry, state.blur)[1:])


def _wider_ink(fit: DiscFit) -> FloatArray:
    """Return the change (n,) of the white share if ink goes farther beyond each circle by a step.

    The step is `_STEP` outer radii.
    """
    pixels, state = fit.sample.pixels, fit.state
    circles = pixels.circles.copy()
    circles[::2, 2] += _STEP
    circles[1::2, 2] -= _STEP
    wider = replace(pixels, circles=circles).white_share(state.geometry, state.blur)
    return wider.value - fit.share


def _levels_changed(fit: DiscFit, changes: FloatArray) -> FloatArray:
    """Return the changes (k, n) of the grey values that go with those of the white share (k, n)."""
    pixels, state = fit.sample.pixels, fit.state
    share = pixels.white_share(state.geometry, state.blur)
    changed = [replace(share, value=share.value + change) for change in changes]
    levels = [fit.sample.level_model.linearised(each, state.vector)[0] for each in changed]
    return np.array(levels) - fit.levels
