"""Two more unknowns of a ring that is adjusted as a whole: the level within, and the ink's width.

The adjustment of such a ring assumes two levels, ink and the same ground inside and outside, and
circles that grow together. Two things break that. If the inside is darker or brighter than the
outside, edges are displaced. And what the model of a tone curve or of burnt light lacks widens the
ink at all circles: the outer one grows, the next one shrinks. On a disc nothing tells this widening
from the size; on a ring the other edges do.

So the ratio of the contrasts within and outside, and the width of the ink, are two more unknowns,
with priors around 1 and 0. They are estimated after the adjustment, by one Gauss-Newton step, since
all other unknowns are at their optimum then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.discs.affine_model import Geometry, mean_radius_px
from kgcp.measurement.discs.covariance import common_displacement_px, levels_changed
from kgcp.measurement.discs.disc_levels import GEOMETRY_COUNT
from kgcp.measurement.discs.fit_disc import DiscFit, DiscState

_PRIOR_SD = 0.1  # of the ratio
_STEP = 1e-3  # of white share and outer radius, for numerical derivatives
_MOST_OFF, _LEAST_SIGMAS = 0.2, 4.0  # largest deviation of the ratio from 1; in deviations


@dataclass(frozen=True, slots=True, eq=False)
class RingUnknowns:
    """Ratio of a ring's contrasts and width of its ink, and their effect on the geometry.

    Attributes
    ----------
    ratio, sd : float
        Contrast within the ring divided by that outside it, and its standard deviation, from the
        pixels alone, without a prior.
    correction : (5,) array
        Of the geometry, for the likeliest ratio and width.
    cov : (5, 5) array
        Added to the geometry's covariance, since the two are not known exactly.
    """

    ratio: float
    sd: float
    correction: Geometry
    cov: FloatArray

    @classmethod
    def of(cls, fit: DiscFit) -> RingUnknowns:
        """Linearise at an adjusted ring."""
        changes = np.array([_STEP * _share_by_ratio(fit), _change_by_width(fit)])
        slopes = levels_changed(fit, changes) / (_STEP * fit.sd)
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
        """Whether the areas within are there, and about as bright as the ground."""
        tolerance = max(_MOST_OFF, _LEAST_SIGMAS * self.sd)
        return abs(self.ratio - 1.0) < tolerance and self.ratio > _LEAST_SIGMAS * self.sd

    def corrected(self, state: DiscState) -> DiscState:
        """Return a state with the corrected geometry."""
        vector = state.vector.copy()
        vector[:GEOMETRY_COUNT] += self.correction
        return DiscState(vector)


def _share_by_ratio(fit: DiscFit) -> FloatArray:
    """Return the derivative (n,) of the white share by the ratio of the contrasts."""
    pixels, state = fit.sample.pixels, fit.state
    return np.asarray(pixels.circles[1:, 3] @ pixels.shares_within(state.geometry, state.blur)[1:])


def _change_by_width(fit: DiscFit) -> FloatArray:
    """Return the change (n,) of the white share if the ink reaches farther beyond every circle.

    It reaches farther by `_STEP` outer radii.
    """
    pixels, state = fit.sample.pixels, fit.state
    circles = pixels.circles.copy()
    circles[::2, 2] += _STEP
    circles[1::2, 2] -= _STEP
    wider = replace(pixels, circles=circles).white_share(state.geometry, state.blur)
    return wider.value - fit.share
