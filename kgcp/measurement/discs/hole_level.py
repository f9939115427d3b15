"""How bright the areas within a ring are, against the ground around it.

A ring that is measured as a whole has two levels: ink, and the same ground inside and outside. If
the inside is a little darker or brighter, that displaces the edges. The ratio of the two contrasts
is therefore one more unknown, with a prior about 1. It enters after the adjustment, by one
Gauss-Newton step, as all else is at its optimum then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.discs.affine_model import Geometry
from kgcp.measurement.discs.disc_levels import GEOMETRY_COUNT
from kgcp.measurement.discs.fit_disc import DiscFit, DiscState

_PRIOR_SD = 0.1
_STEP = 1e-3  # of the white share, for differences
_MOST_OFF, _LEAST_SIGMAS = 0.2, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class HoleLevel:
    """The contrast within a ring over that outside it, and what it does to the outer edge.

    Attributes
    ----------
    ratio, sd : float
        By the pixels alone.
    moves : (5,) array
        Of the geometry, by the ratio.
    """

    ratio: float
    sd: float
    moves: Geometry

    @classmethod
    def of(cls, fit: DiscFit) -> HoleLevel:
        """Linearise at an adjusted ring."""
        pixels, state = fit.sample.pixels, fit.state
        share = pixels.white_share(state.geometry, state.blur)
        within = pixels.circles[1:, 3] @ pixels.shares_within(state.geometry, state.blur)[1:]
        brighter = replace(share, value=share.value + _STEP * within)
        levels, _ = fit.sample.level_model.linearised(brighter, state.vector)
        slope = (levels - fit.levels) / (_STEP * fit.sd)
        shared = fit.scaled @ (fit.misfit.weight * slope)
        by_ratio = np.linalg.solve(fit.normal, shared)
        information = float(slope @ (fit.misfit.weight * slope) - shared @ by_ratio)
        sd = 1.0 / math.sqrt(max(information, 1e-12))
        moves: FloatArray = -by_ratio[:GEOMETRY_COUNT].astype(np.float64)
        return cls(1.0 + sd * sd * float(slope @ fit.misfit.score), sd, moves)

    @property
    def is_seen(self) -> bool:
        """Whether the areas within are there, about as bright as the ground."""
        tolerance = max(_MOST_OFF, _LEAST_SIGMAS * self.sd)
        return abs(self.ratio - 1.0) < tolerance and self.ratio > _LEAST_SIGMAS * self.sd

    @property
    def cov(self) -> FloatArray:
        """What not knowing the ratio adds to the geometry's covariance (5, 5)."""
        return np.outer(self.moves, self.moves) / (self.sd**-2 + _PRIOR_SD**-2)

    def moved(self, state: DiscState) -> DiscState:
        """Return a state whose geometry is that of the likeliest ratio."""
        share = _PRIOR_SD**2 / (_PRIOR_SD**2 + self.sd**2)
        vector = state.vector.copy()
        vector[:GEOMETRY_COUNT] += share * (self.ratio - 1.0) * self.moves
        return DiscState(vector)
