"""Straight shadow edges on a plate, and what they add to the levels of ink and plate.

The shade of a building lies beyond a single edge, that of an antenna between two edges. Where one
shade hides the sun, another one has no effect. So the effects of edges are not a plain sum:

    added = Σ_j a_j Φ_j Π_i (1 − Φ_i)

a_j is what edge j adds to the level of ink or plate (negative for shade), and Φ_j is the share of
it at a place: the normal distribution function of the distance beyond the edge. i are the single
edges before j. Of a shade between two edges, the second edge adds what the first one takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray

ANGLE, OFFSET, LOG_WIDTH, INK, PLATE = range(5)  # columns of `ShadowEdges.rows`
_MIN_SUNLIT_SHARE = 1e-12  # avoids divisions by zero deep in the shade

# Weak normal priors of an edge, in the order ANGLE to PLATE: the penumbra's σ is 2 px within a
# factor of e, and the steps are 0 ± half the contrast. Direction and offset have no prior.
EDGE_MEAN = np.array((0.0, 0.0, 0.7, 0.0, 0.0))
EDGE_PRECISION = np.array((0.0, 0.0, 1.0, 4.0, 4.0))


@dataclass(frozen=True, slots=True, eq=False)
class ShadowEdges:
    """s straight shadow edges, relative to a target's centre."""

    # (s, 5): direction of an edge's normal [rad], its offset from the centre along the normal [px],
    # logarithm of the penumbra's σ [px], and what is added to the levels of ink and plate beyond it
    rows: FloatArray
    # number of single edges, which come first; pairs with a shade between them follow
    single_count: int

    @property
    def penalty(self) -> float:
        """Contribution of the priors to the negative log-likelihood."""
        return float(0.5 * np.sum(EDGE_PRECISION * (self.rows - EDGE_MEAN) ** 2))

    @property
    def pull(self) -> FloatArray:
        """Contribution of the priors to the log-likelihood's gradient (5 s,)."""
        return np.asarray((EDGE_PRECISION * (EDGE_MEAN - self.rows)).ravel())

    @property
    def precision(self) -> FloatArray:
        """Precisions of the priors (5 s,)."""
        return np.tile(EDGE_PRECISION, len(self.rows))

    def added_with_gradient(self, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what is added to ink and plate (2, n), and the contrast's gradient (2, n) [1/px].

        `offsets` (2, n) are positions relative to the centre [px].
        """
        if not len(self.rows):
            return np.zeros(offsets.shape), np.zeros(offsets.shape)
        z, beyond, sun = self._seen_from(offsets)
        added = self.rows[:, INK:].T @ (beyond * sun)
        contrast = self.rows[:, PLATE] - self.rows[:, INK]
        by_z = self._by_sigmas(contrast[:, None], z, beyond, sun)
        angle, _, log_width = self.rows[:, :INK].T
        per_px = np.exp(-log_width)
        return added, np.stack(((np.cos(angle) * per_px) @ by_z, (np.sin(angle) * per_px) @ by_z))

    def derivatives(self, offsets: FloatArray, by_level: FloatArray) -> FloatArray:
        """Return the derivatives (5 s, n) by the rows, from those by the levels (2, n)."""
        z, beyond, sun = self._seen_from(offsets)
        by_z = self._by_sigmas(self.rows[:, INK:] @ by_level, z, beyond, sun)
        derivatives = np.empty((len(self.rows), 5, offsets.shape[1]))
        for k, (angle, _, log_width, _, _) in enumerate(self.rows.tolist()):
            across = math.cos(angle) * offsets[1] - math.sin(angle) * offsets[0]
            per_px = math.exp(-log_width)
            derivatives[k, ANGLE] = by_z[k] * across * per_px
            derivatives[k, OFFSET] = -by_z[k] * per_px
            derivatives[k, LOG_WIDTH] = -by_z[k] * z[k]
            derivatives[k, INK:] = by_level * (beyond[k] * sun[k])
        return derivatives.reshape(-1, offsets.shape[1])

    def sunlit_share(self, offsets: FloatArray) -> FloatArray:
        """Return the share of the sun (n,) that the single edges leave at positions (2, n)."""
        if not self.single_count:
            return np.ones(offsets.shape[1])
        _, beyond, _ = self._seen_from(offsets)
        return np.asarray(np.prod(1.0 - beyond[: self.single_count], axis=0))

    def _seen_from(self, offsets: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return z, Φ(z) and the sun for each edge, all (s, n).

        z is the distance beyond the edge in σ of its penumbra. The sun is the share of it that the
        single edges before this one leave.
        """
        angle, offset_px, log_width = self.rows[:, :INK].T[:, :, None]
        along = np.cos(angle) * offsets[0] + np.sin(angle) * offsets[1]
        z = (along - offset_px) * np.exp(-log_width)
        beyond, sun = ndtr(z), np.ones(z.shape)
        for k in range(self.single_count):
            sun[k + 1 :] *= 1.0 - beyond[k]
        return z, beyond, sun

    def _by_sigmas(
        self, added: FloatArray, z: FloatArray, beyond: FloatArray, sun: FloatArray
    ) -> FloatArray:
        """Return the derivatives (s, n) of Σ added Φ(z) sun by z."""
        terms, by_beyond = added * beyond * sun, added * sun
        for k in range(min(self.single_count, len(terms) - 1)):
            by_beyond[k] -= terms[k + 1 :].sum(axis=0) / np.maximum(
                1.0 - beyond[k], _MIN_SUNLIT_SHARE
            )
        return np.asarray(by_beyond * np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))


NO_EDGES = ShadowEdges(np.empty((0, 5)), 0)
