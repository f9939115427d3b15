"""Straight edges of shadows over a plate, and what they take from the light.

A shade lies beyond one edge, as that of a building, or between two, as that of an antenna. Where
one shade hides the sun, another takes nothing more. So what edges add is not a plain sum:

    added = Σ_j a_j Φ_j Π_i (1 − Φ_i),

with a_j what edge j adds to the level of ink or plate, Φ_j how much of that is reached at a place
(the normal distribution of its distance), and i the edges before j that bound a shade alone. Of a
shade between two edges, the second edge adds back what the first one takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray

ANGLE, OFFSET, LOG_WIDTH, INK, PLATE = range(5)
_LEAST_SHARE = 1e-12  # of the sun, beyond an edge

# Weak priors of an edge, ANGLE to PLATE: a penumbra of σ = 2 px within a factor of e, and steps of
# half the contrast. Direction and offset have none.
EDGE_MEAN = np.array((0.0, 0.0, 0.7, 0.0, 0.0))
EDGE_PRECISION = np.array((0.0, 0.0, 1.0, 4.0, 4.0))


@dataclass(frozen=True, slots=True, eq=False)
class ShadowEdges:
    """Straight edges of shadows, about a target's centre."""

    # (s, 5): direction of an edge's normal [rad], offset along that from the centre [px], logarithm
    # of the penumbra's σ [px], and what is added beyond to the levels of ink and plate
    rows: FloatArray
    # how many rows, the first ones, bound a shade alone; pairs follow, with a shade between them
    alone_count: int

    @property
    def penalty(self) -> float:
        """The priors' part of the negative log-likelihood."""
        return float(0.5 * np.sum(EDGE_PRECISION * (self.rows - EDGE_MEAN) ** 2))

    @property
    def pull(self) -> FloatArray:
        """The priors' part (5 s,) of the log-likelihood's gradient."""
        return np.asarray((EDGE_PRECISION * (EDGE_MEAN - self.rows)).ravel())

    @property
    def precision(self) -> FloatArray:
        """Of the priors (5 s,)."""
        return np.tile(EDGE_PRECISION, len(self.rows))

    def added_with_gradient(self, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what is added to the levels of ink and plate, and the gradient of their contrast.

        Both (2, n), the gradient [1/px], at places (2, n) about the centre [px].
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
        """Return derivatives (5 s, n) by the rows, given those by the levels, (2, n)."""
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

    def sun_left(self, offsets: FloatArray) -> FloatArray:
        """Return the share of the sun (n,) that edges alone leave at places (2, n)."""
        if not self.alone_count:
            return np.ones(offsets.shape[1])
        _, beyond, _ = self._seen_from(offsets)
        return np.asarray(np.prod(1.0 - beyond[: self.alone_count], axis=0))

    def _seen_from(self, offsets: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return how far places are beyond each edge, in σ of its penumbra, and Φ of that.

        The third one is the share of the sun that the edges before it leave. All are (s, n).
        """
        angle, offset_px, log_width = self.rows[:, :INK].T[:, :, None]
        along = np.cos(angle) * offsets[0] + np.sin(angle) * offsets[1]
        z = (along - offset_px) * np.exp(-log_width)
        beyond, sun = ndtr(z), np.ones(z.shape)
        for k in range(self.alone_count):
            sun[k + 1 :] *= 1.0 - beyond[k]
        return z, beyond, sun

    def _by_sigmas(
        self, added: FloatArray, z: FloatArray, beyond: FloatArray, sun: FloatArray
    ) -> FloatArray:
        """Return the derivatives (s, n) by z of Σ added Φ(z) sun."""
        terms, by_beyond = added * beyond * sun, added * sun
        for k in range(min(self.alone_count, len(terms) - 1)):
            by_beyond[k] -= terms[k + 1 :].sum(axis=0) / np.maximum(1.0 - beyond[k], _LEAST_SHARE)
        return np.asarray(by_beyond * np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))


NO_EDGES = ShadowEdges(np.empty((0, 5)), 0)
