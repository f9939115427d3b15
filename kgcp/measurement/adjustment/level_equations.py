"""Normal equations with many values of levels, of which each pixel knows few.

The levels are random: they have a prior of zero mean. They are eliminated from the equations of all
else by the Schur complement, so that those remain as small as without levels:

    N = A − B C⁻¹ Bᵀ,

with A of pose, blur, light and shadows' edges, C of the levels with their prior, and B mixed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.noise import Misfit


class AtKnots(NamedTuple):
    """The knots (n, j) that every pixel depends on, ascending, and by how much each (n, j)."""

    knots: IndexArray
    weights: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LevelEquations:
    """The equations of one linearisation, the levels eliminated."""

    scaled: FloatArray  # (p, n): Jacobian by all else, in units of the noise
    normal: FloatArray  # (p, p): n, priors included
    at_knots: AtKnots
    # (2, n): derivatives by the levels of ink and of plate, in units of the noise
    by_level: FloatArray
    count: int  # of the knots
    # (q,): the values that some pixel depends on: of ink at all knots, then of plate
    used: IndexArray
    root: FloatArray  # (q, q): lower Cholesky factor of C
    # (p, q): b, and B C⁻¹
    mixed: FloatArray
    projected: FloatArray
    precision: FloatArray  # (q,): of the levels' prior

    def gradient_of_levels(self, score: FloatArray, values: FloatArray) -> FloatArray:
        """Return the gradient (q,) by the levels, at their `values` (2, k)."""
        gradient = gather(self.at_knots, self.by_level, score, self.count)[self.used]
        return np.asarray(gradient - self.precision * values.ravel()[self.used])

    def half_solved(self, gradient: FloatArray) -> FloatArray:
        """Return L⁻¹ times a gradient (q,), with C = L Lᵀ."""
        return solved(self.root, gradient)

    def step_of_levels(self, gradient: FloatArray, step: FloatArray) -> FloatArray:
        """Return the levels' step (2, k) that goes with that of all else (p,)."""
        left = self.half_solved(gradient - self.mixed.T @ step)
        values = np.zeros(2 * self.count)
        values[self.used] = solved(self.root, left, is_transposed=True)
        return values.reshape(2, -1)

    def rows(self) -> FloatArray:
        """Return the Jacobian (p, n) less what the levels take over of it."""
        rows, by_knot = self.scaled.copy(), np.zeros((2 * self.count, len(self.scaled)))
        by_knot[self.used] = self.projected.T
        _take_over(*self.at_knots, self.by_level, by_knot, rows)
        return rows

    def taken_over(self, of_pose: FloatArray, weight: FloatArray, arc: IndexArray) -> float:
        """Return how much the levels take of the scatter (trace) of sums over arcs.

        The sums are of the scores with the derivatives `of_pose` (n, 6).
        """
        parts = _by_arc(*self.at_knots, self.by_level, weight, of_pose, arc, self.count)
        half = solved(self.root, parts.reshape(-1, 2 * self.count)[:, self.used].T)
        return float(np.sum(half * half))

    def taken_of(self, row: FloatArray, weight: FloatArray) -> float:
        """Return how much the levels take of the weighted square of a row (n,)."""
        half = self.half_solved(
            gather(self.at_knots, self.by_level, row * weight, self.count)[self.used]
        )
        return float(half @ half)

    def variances(self) -> FloatArray:
        """Return the variances (q,) of the levels, all else being unknown, too."""
        inverse, _ = dpotri(self.root, lower=1)
        by_others = np.linalg.lstsq(self.normal, self.projected, rcond=1e-12)[0]
        return np.asarray(np.diag(inverse) + np.sum(self.projected * by_others, axis=0))


def eliminate_levels(
    scaled: FloatArray,
    normal: FloatArray,
    at_knots: AtKnots,
    by_level: FloatArray,
    current: Misfit,
    precision: FloatArray,
) -> LevelEquations:
    """Eliminate the levels, of a prior `precision` (2, k), from a normal matrix A (p, p).

    Raises
    ------
    Rejection
        `POOR_FIT` if the levels' own equations cannot be solved.
    """
    count = precision.shape[1]
    own, mixed, used = _products(*at_knots, by_level, current.weight, scaled, count)
    known = precision.ravel()[used]
    own[np.diag_indices_from(own)] += known
    root, failure = dpotrf(own, lower=1, clean=1)
    if failure:
        raise Rejection(Reason.POOR_FIT, "singular equations of levels")
    projected = solved(root, solved(root, mixed.T), is_transposed=True).T
    return LevelEquations(
        scaled=scaled,
        normal=normal - projected @ mixed.T,
        at_knots=at_knots,
        by_level=by_level,
        count=count,
        used=used,
        root=root,
        mixed=mixed,
        projected=projected,
        precision=known,
    )


def solved(root: FloatArray, vectors: FloatArray, *, is_transposed: bool = False) -> FloatArray:
    """Return L⁻¹ or L⁻ᵀ times vectors."""
    trans: Literal["T", "N"] = "T" if is_transposed else "N"
    return np.asarray(solve_triangular(root, vectors, lower=True, trans=trans, check_finite=False))


def gather(at_knots: AtKnots, by_level: FloatArray, values: FloatArray, count: int) -> FloatArray:
    """Return Σ values · derivatives over pixels, by the levels of ink and plate at knots (2 k,)."""
    return _gather(*at_knots, by_level, values, count)


@compiled
def _gather(
    knots: IndexArray, weights: FloatArray, by_level: FloatArray, values: FloatArray, count: int
) -> FloatArray:
    total = np.zeros(2 * count)
    for i in range(len(knots)):
        for j in range(knots.shape[1]):
            weighted = weights[i, j] * values[i]
            total[knots[i, j]] += weighted * by_level[0, i]
            total[count + knots[i, j]] += weighted * by_level[1, i]
    return total


@compiled
def _products(
    knots: IndexArray,
    weights: FloatArray,
    by_level: FloatArray,
    weight: FloatArray,
    scaled: FloatArray,
    count: int,
) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Return the levels' own normal matrix, the mixed one (p, q), and the values that are used.

    The knots of a pixel ascend, so that only upper triangles are added up.
    """
    reach, rows = knots.shape[1], scaled.shape[0]
    used, number = _used(knots, weights, count)
    q = len(used)
    ink_ink, mixed_both, plate_plate = np.zeros((3, q, q))
    mixed = np.zeros((q, 2, rows))  # by knot, so that what is added lies side by side
    at, share = np.empty(reach, np.intp), np.empty(reach)
    by_row = scaled.T.copy()
    for i in range(len(knots)):
        ink, plate = by_level[0, i], by_level[1, i]
        ii, ip, pp = weight[i] * ink * ink, weight[i] * ink * plate, weight[i] * plate * plate
        near = 0
        for j in range(reach):
            if weights[i, j] != 0.0:
                at[near], share[near] = number[knots[i, j]], weights[i, j]
                near += 1
        for j in range(near):
            a = at[j]
            for k in range(j, near):
                b, both = at[k], share[j] * share[k]
                ink_ink[a, b] += both * ii
                mixed_both[a, b] += both * ip
                plate_plate[a, b] += both * pp
            of_ink, of_plate = share[j] * weight[i] * ink, share[j] * weight[i] * plate
            by_ink, by_plate = mixed[a, 0], mixed[a, 1]
            for p in range(rows):
                by_ink[p] += of_ink * by_row[i, p]
            for p in range(rows):
                by_plate[p] += of_plate * by_row[i, p]
    by_level_and_row = np.empty((rows, 2 * q))
    for p in range(rows):
        by_level_and_row[p, :q], by_level_and_row[p, q:] = mixed[:, 0, p], mixed[:, 1, p]
    own = _whole(ink_ink, mixed_both, plate_plate)
    return own, by_level_and_row, np.append(used, used + count)


@compiled
def _used(knots: IndexArray, weights: FloatArray, count: int) -> tuple[IndexArray, IndexArray]:
    """Return the knots (q,) that pixels use, and of every knot its number among them."""
    number = np.full(count, -1, np.intp)
    for i in range(len(knots)):
        for j in range(knots.shape[1]):
            if weights[i, j] > 0.0:
                number[knots[i, j]] = 0
    used = np.flatnonzero(number == 0)
    number[used] = np.arange(len(used))
    return used, number


@compiled
def _whole(ink_ink: FloatArray, both: FloatArray, plate_plate: FloatArray) -> FloatArray:
    q = len(ink_ink)
    own = np.empty((2 * q, 2 * q))
    for a in range(q):
        for b in range(a, q):
            own[a, b] = own[b, a] = ink_ink[a, b]
            own[q + a, q + b] = own[q + b, q + a] = plate_plate[a, b]
            own[a, q + b] = own[b, q + a] = own[q + b, a] = own[q + a, b] = both[a, b]
    return own


@compiled
def _take_over(
    knots: IndexArray,
    weights: FloatArray,
    by_level: FloatArray,
    by_knot: FloatArray,
    rows: FloatArray,
) -> None:
    count = by_knot.shape[0] // 2
    for i in range(len(knots)):
        for j in range(knots.shape[1]):
            k = knots[i, j]
            ink, plate = weights[i, j] * by_level[0, i], weights[i, j] * by_level[1, i]
            for p in range(rows.shape[0]):
                rows[p, i] -= ink * by_knot[k, p] + plate * by_knot[count + k, p]


@compiled
def _by_arc(
    knots: IndexArray,
    weights: FloatArray,
    by_level: FloatArray,
    weight: FloatArray,
    of_pose: FloatArray,
    arc: IndexArray,
    count: int,
) -> FloatArray:
    """Return the normal matrices (arcs, 6, 2 k) of the pose and the levels, of every arc."""
    parts = np.zeros((arc.max() + 1, 6, 2 * count))
    for i in range(len(knots)):
        for j in range(knots.shape[1]):
            k, w = knots[i, j], weights[i, j] * weight[i]
            for p in range(6):
                parts[arc[i], p, k] += w * by_level[0, i] * of_pose[i, p]
                parts[arc[i], p, count + k] += w * by_level[1, i] * of_pose[i, p]
    return parts
