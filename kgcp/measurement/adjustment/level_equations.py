"""Normal equations with levels that vary: many unknowns, few of which a pixel depends on.

The levels are values at knots, with a prior of zero mean. They are eliminated from the equations of
all other parameters by the Schur complement, so that these remain as small as without levels:

    N = A − B C⁻¹ Bᵀ

A is the normal matrix of pose, blur, light and shadows' edges, C that of the levels with their
prior, and B has the mixed terms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri, dtrtrs

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.noise import Misfit


class AtKnots(NamedTuple):
    """The knots that pixels depend on. All pixels of a cell depend on the same knots."""

    order: IndexArray  # (n,): the pixels, sorted by cell
    starts: IndexArray  # (c + 1,): the pixels of cell i are order[starts[i]:starts[i + 1]]
    knots: IndexArray  # (c, j): the knots of every cell
    weights: FloatArray  # (n, j): weights of the knots in every pixel, sorted as `order`

    @staticmethod
    def of(knots: IndexArray, weights: FloatArray) -> AtKnots:
        """Put the pixels of each cell together.

        Given are the knots (n, j) of every pixel and their weights (n, j), for one pixel at least.
        The first and the last knot of a pixel must determine the others, as they do on two grids.
        """
        ends = knots[:, 0], knots[:, -1]
        order = np.lexsort(ends)
        is_new = np.any([np.diff(end[order]) != 0 for end in ends], axis=0)
        starts = np.concatenate(([0], np.flatnonzero(is_new) + 1, [len(order)]))
        return AtKnots(order, starts, knots[order[starts[:-1]]], weights[order])


@dataclass(frozen=True, slots=True, eq=False)
class LevelEquations:
    """The equations of one linearisation, the levels eliminated."""

    scaled: FloatArray  # (p, n): Jacobian by the p other parameters, in units of the noise
    normal: FloatArray  # (p, p): normal matrix, priors included
    at_knots: AtKnots
    # (2, n): derivatives by the levels of ink and of plate, in units of the noise
    by_level: FloatArray
    count: int  # k, of the knots
    # (q,): which of the 2 k levels (of ink at all knots, then of plate) any pixel depends on
    used: IndexArray
    root: FloatArray  # (q, q): Cholesky factor of C, the lower triangle
    half_mixed: FloatArray  # (q, p): L⁻¹ Bᵀ, with C = L Lᵀ
    precision: FloatArray  # (q,): of the levels' prior

    def gradient_of_levels(self, score: FloatArray, values: FloatArray) -> FloatArray:
        """Return the gradient (q,) by the levels, at their `values` (2, k)."""
        gradient = gather(self.at_knots, self.by_level, score, self.count)[self.used]
        return np.asarray(gradient - self.precision * values.ravel()[self.used])

    def half_solved(self, gradient: FloatArray) -> FloatArray:
        """Return L⁻¹ times a gradient (q,)."""
        return solved(self.root, gradient)

    def step_of_levels(self, half: FloatArray, step: FloatArray) -> FloatArray:
        """Return the step (2, k) of the levels that belongs to a step (p,) of the others.

        `half` is the gradient of the levels after `half_solved`.
        """
        values = np.zeros(2 * self.count)
        remaining = half - self.half_mixed @ step
        values[self.used] = solved(self.root, remaining, is_transposed=True)
        return values.reshape(2, -1)

    def projected(self) -> FloatArray:
        """Return B C⁻¹ (p, q): how the levels follow the other parameters."""
        return solved(self.root, self.half_mixed, is_transposed=True).T

    def rows(self) -> FloatArray:
        """Return the Jacobian (p, n) without the part that the levels explain."""
        rows, by_knot = self.scaled.copy(), np.zeros((2 * self.count, len(self.scaled)))
        by_knot[self.used] = self.projected().T
        _subtract_explained(*self.at_knots, self.by_level, by_knot, rows)
        return rows

    def scatter_explained(self, of_pose: FloatArray, weight: FloatArray, arc: IndexArray) -> float:
        """Return the trace of the scatter of sums over arcs that the levels explain.

        The sums are those of the scores times the derivatives `of_pose` (n, 6).
        """
        parts = _by_arc(*self.at_knots, self.by_level, weight, of_pose, arc, self.count)
        half = solved(self.root, parts.reshape(-1, 2 * self.count)[:, self.used].T)
        return float(np.sum(half * half))

    def square_explained(self, row: FloatArray, weight: FloatArray) -> float:
        """Return the part of the weighted square of a row (n,) that the levels explain."""
        half = self.half_solved(
            gather(self.at_knots, self.by_level, row * weight, self.count)[self.used]
        )
        return float(half @ half)

    def variances(self) -> FloatArray:
        """Return the variances (q,) of the levels, with all other parameters unknown."""
        inverse, _ = dtrtri(self.root, lower=1)
        projected = self.projected()
        by_others = np.linalg.lstsq(self.normal, projected, rcond=1e-12)[0]
        own = np.einsum("ij,ij->j", inverse, inverse)  # C⁻¹ = L⁻ᵀ L⁻¹
        return np.asarray(own + np.sum(projected * by_others, axis=0))


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
    own.ravel()[:: len(own) + 1] += known
    root, failure = dpotrf(own.T, lower=1, clean=0, overwrite_a=1)
    if failure:
        raise Rejection(Reason.POOR_FIT, "singular equations of levels")
    half_mixed = solved(root, mixed.T)
    return LevelEquations(
        scaled=scaled,
        normal=normal - half_mixed.T @ half_mixed,
        at_knots=at_knots,
        by_level=by_level,
        count=count,
        used=used,
        root=root,
        half_mixed=half_mixed,
        precision=known,
    )


def solved(root: FloatArray, vectors: FloatArray, *, is_transposed: bool = False) -> FloatArray:
    """Return L⁻¹ or L⁻ᵀ times vectors."""
    solution, _ = dtrtrs(root, vectors, lower=1, trans=int(is_transposed))
    return np.asarray(solution)


def gather(at_knots: AtKnots, by_level: FloatArray, values: FloatArray, count: int) -> FloatArray:
    """Sum values times derivatives over pixels, for the levels of ink and plate at knots (2 k,)."""
    return _gather(*at_knots, by_level, values, count)


@compiled
def _gather(
    order: IndexArray,
    starts: IndexArray,
    knots: IndexArray,
    weights: FloatArray,
    by_level: FloatArray,
    values: FloatArray,
    count: int,
) -> FloatArray:
    reach = knots.shape[1]
    total, of_ink, of_plate = np.zeros(2 * count), np.empty(reach), np.empty(reach)
    for cell in range(len(knots)):
        of_ink[:], of_plate[:] = 0.0, 0.0
        for m in range(starts[cell], starts[cell + 1]):
            i = order[m]
            by_ink, by_plate = values[i] * by_level[0, i], values[i] * by_level[1, i]
            for j in range(reach):
                of_ink[j] += weights[m, j] * by_ink
                of_plate[j] += weights[m, j] * by_plate
        for j in range(reach):
            total[knots[cell, j]] += of_ink[j]
            total[count + knots[cell, j]] += of_plate[j]
    return total


@compiled
def _products(
    order: IndexArray,
    starts: IndexArray,
    knots: IndexArray,
    weights: FloatArray,
    by_level: FloatArray,
    weight: FloatArray,
    scaled: FloatArray,
    count: int,
) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Return the normal matrix C (q, q) of the levels, the mixed one B (p, q), and which are used.

    Only the upper triangle of C is filled in. The pixels of a cell are summed up by one product of
    small matrices.
    """
    reach, rows = knots.shape[1], scaled.shape[0]
    used, number = _used(starts, knots, weights, count)
    q, width, most = len(used), 3 * reach + 2 * rows, np.max(starts[1:] - starts[:-1])
    own, mixed = np.zeros((2 * q, 2 * q)), np.zeros((q, 2 * rows))
    products, of_cell = np.empty((most, width)), np.empty((reach, width))
    for cell in range(len(knots)):
        first, end = starts[cell], starts[cell + 1]
        for m in range(first, end):
            i = order[m]
            _fill_products(weights[m], by_level[:, i], weight[i], scaled[:, i], products[m - first])
        np.dot(weights[first:end].T, products[: end - first], of_cell)
        _add_cell(of_cell, knots[cell], number, own, mixed)
    by_level_and_row = np.empty((rows, 2 * q))
    for p in range(rows):
        by_level_and_row[p, :q], by_level_and_row[p, q:] = mixed[:, p], mixed[:, rows + p]
    return own, by_level_and_row, np.append(used, used + count)


@inlined
def _fill_products(
    shares: FloatArray, by_level: FloatArray, weight: float, by_row: FloatArray, out: FloatArray
) -> None:
    """Fill in the weighted products of a pixel's derivatives.

    First come ink · ink, ink · plate and plate · plate, each times the shares of its knots; then
    ink, and plate, times all rows.
    """
    reach, rows = len(shares), len(by_row)
    of_ink, of_plate = weight * by_level[0], weight * by_level[1]
    ii, ip, pp = of_ink * by_level[0], of_ink * by_level[1], of_plate * by_level[1]
    for k in range(reach):
        out[k], out[reach + k], out[2 * reach + k] = ii * shares[k], ip * shares[k], pp * shares[k]
    for p in range(rows):
        out[3 * reach + p], out[3 * reach + rows + p] = of_ink * by_row[p], of_plate * by_row[p]


@compiled
def _add_cell(
    cell: FloatArray, knots: IndexArray, number: IndexArray, own: FloatArray, mixed: FloatArray
) -> None:
    """Add the sums of a cell, laid out as by `_fill_products`, to both matrices."""
    reach, q = len(knots), len(own) // 2
    for j in range(reach):
        a = number[knots[j]]
        if a < 0:  # no pixel has a weight there
            continue
        for k in range(reach):
            b = number[knots[k]]
            if b >= 0:
                own[a, q + b] += cell[j, reach + k]
                if b >= a:
                    own[a, b] += cell[j, k]
                    own[q + a, q + b] += cell[j, 2 * reach + k]
        for p in range(mixed.shape[1]):
            mixed[a, p] += cell[j, 3 * reach + p]


@compiled
def _used(
    starts: IndexArray, knots: IndexArray, weights: FloatArray, count: int
) -> tuple[IndexArray, IndexArray]:
    """Return the knots that pixels use, and the number of every knot among them; −1: not used."""
    number = np.full(count, -1, np.intp)
    for cell in range(len(knots)):
        for j in range(knots.shape[1]):
            for m in range(starts[cell], starts[cell + 1]):
                if weights[m, j] > 0.0:
                    number[knots[cell, j]] = 0
                    break
    used = np.flatnonzero(number == 0)
    number[used] = np.arange(len(used))
    return used, number


@compiled
def _subtract_explained(
    order: IndexArray,
    starts: IndexArray,
    knots: IndexArray,
    weights: FloatArray,
    by_level: FloatArray,
    by_knot: FloatArray,
    rows: FloatArray,
) -> None:
    count = by_knot.shape[0] // 2
    for cell in range(len(knots)):
        first, end = starts[cell], starts[cell + 1]
        of_ink = np.dot(weights[first:end], by_knot[knots[cell]])
        of_plate = np.dot(weights[first:end], by_knot[count + knots[cell]])
        for m in range(first, end):
            i = order[m]
            for p in range(rows.shape[0]):
                ink, plate = of_ink[m - first, p], of_plate[m - first, p]
                rows[p, i] -= by_level[0, i] * ink + by_level[1, i] * plate


@compiled
def _by_arc(
    order: IndexArray,
    starts: IndexArray,
    knots: IndexArray,
    weights: FloatArray,
    by_level: FloatArray,
    weight: FloatArray,
    of_pose: FloatArray,
    arc: IndexArray,
    count: int,
) -> FloatArray:
    """Return the mixed normal matrices (arcs, 6, 2 k) of pose and levels, for every arc."""
    parts = np.zeros((arc.max() + 1, 6, 2 * count))
    for cell in range(len(knots)):
        for m in range(starts[cell], starts[cell + 1]):
            i = order[m]
            part = parts[arc[i]]
            for j in range(knots.shape[1]):
                k, w = knots[cell, j], weights[m, j] * weight[i]
                for p in range(6):
                    part[p, k] += w * by_level[0, i] * of_pose[i, p]
                    part[p, count + k] += w * by_level[1, i] * of_pose[i, p]
    return parts
