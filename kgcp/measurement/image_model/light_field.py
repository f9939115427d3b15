"""Uneven light: how the levels of ink and plate vary over a window.

What is added to the levels of ink and of plate has three parts: an offset, a smooth part (splines
on two grids of knots), and straight edges of shadows. All act before tone curve and sharpening, as
the levels do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.shadow_edges import INK, ShadowEdges

LightAfterStep = Callable[[FloatArray, FloatArray], FloatArray]
"""A function that returns the light (2, n) on ink and on plate after a step (2, n).

In even light, that on ink is 0 and that on plate 1.
"""
SPAN = 3  # knots along either axis on which a point depends: quadratic splines
_EVEN = np.array(((0.0,), (1.0,)))  # light on ink and on plate in even light
LEVEL_OFFSET_PRECISION = 4.0
"""Precision of the offsets' prior: as weak as that of the steps at shadow edges."""


@dataclass(frozen=True, slots=True, eq=False)
class Knots:
    """g grids of spline knots over a window."""

    spacings_px: tuple[float, ...]  # (g,)
    # (g,): corner of each grid's first cell [px], and numbers of knots
    x0_px: tuple[float, ...]
    y0_px: tuple[float, ...]
    columns: tuple[int, ...]
    rows: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of knots of each grid."""
        return tuple(c * r for c, r in zip(self.columns, self.rows, strict=True))

    def of_grid(self, grid: int) -> slice:
        """Return the slice of all knots that belongs to a grid."""
        first = sum(self.counts[:grid])
        return slice(first, first + self.counts[grid])

    def weights(self, pixels: FloatArray) -> tuple[IndexArray, FloatArray]:
        """Return the knots (n, 9 g) on which points (2, n) depend, and their weights."""
        reach = SPAN * SPAN
        knots = np.empty((pixels.shape[1], reach * len(self.spacings_px)), np.intp)
        weights = np.empty(knots.shape)
        first = 0
        for g, spacing in enumerate(self.spacings_px):
            part = slice(g * reach, (g + 1) * reach)
            counts = self.columns[g], self.rows[g]
            corner = self.x0_px[g], self.y0_px[g]
            _fill_in_weights(
                pixels, corner, spacing, counts, first, knots[:, part], weights[:, part]
            )
            first += self.counts[g]
        return knots, weights

    def places_px(self, grid: int) -> FloatArray:
        """Return the positions of a grid's knots (2, k)."""
        return _places_px(self, grid)


def lay_knots(
    x_px: tuple[float, float],
    y_px: tuple[float, float],
    centre_px: FloatArray,
    spacings_px: tuple[float, ...],
) -> Knots:
    """Return grids over the pixels between two columns and two rows, inclusive.

    `centre_px` (2,) is in the middle of a cell of every grid. So the knots around it do not depend
    on where the window ends, nor on the frame's orientation.
    """
    x0_px, columns = _cells_over(*x_px, float(centre_px[0]), spacings_px)
    y0_px, rows = _cells_over(*y_px, float(centre_px[1]), spacings_px)
    return Knots(spacings_px, x0_px, y0_px, columns, rows)


def _cells_over(
    first_px: float, last_px: float, centre_px: float, spacings_px: tuple[float, ...]
) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Return the start of each grid's first cell along an axis [px], and the numbers of knots."""
    begins, counts = [], []
    for spacing in spacings_px:
        before = math.ceil((centre_px - (first_px - 0.5)) / spacing - 0.5)
        begin = centre_px - (before + 0.5) * spacing
        begins.append(begin)
        counts.append(math.ceil((last_px + 0.5 - begin) / spacing) + SPAN - 1)
    return tuple(begins), tuple(counts)


@compiled
def _fill_in_weights(
    pixels: FloatArray,
    corner: tuple[float, float],
    spacing: float,
    counts: tuple[int, int],
    first: int,
    knots: IndexArray,
    weights: FloatArray,
) -> None:
    (x0, y0), (columns, rows) = corner, counts
    along_x, along_y = np.empty(3), np.empty(3)
    for i in range(pixels.shape[1]):
        column, across = _cell(pixels[0, i], x0, spacing, columns)
        row, down = _cell(pixels[1, i], y0, spacing, rows)
        _fill_spline(across, along_x)
        _fill_spline(down, along_y)
        for r in range(3):
            for c in range(3):
                knots[i, 3 * r + c] = first + (row + r) * columns + column + c
                weights[i, 3 * r + c] = along_y[r] * along_x[c]


@compiled
def _add_grid(
    pixels: FloatArray,
    corner: tuple[float, float],
    spacing: float,
    counts: tuple[int, int],
    values: FloatArray,
    result: FloatArray,
) -> None:
    """Add one grid's part to `result` (4, n): ink, plate, and the gradient x, y of their contrast.

    Sums over the columns of knots are computed first, because consecutive pixels in a row of a cell
    share them.
    """
    (x0, y0), (columns, rows) = corner, counts
    along, slopes, sums = np.empty(3), np.empty(3), np.empty((3, 3))
    last, last_y, first_of_row, down = -1, math.nan, 0, 0.0
    for i in range(pixels.shape[1]):
        column, across = _cell(pixels[0, i], x0, spacing, columns)
        if pixels[1, i] != last_y:
            last_y = pixels[1, i]
            row, down = _cell(last_y, y0, spacing, rows)
            first_of_row, last = row * columns, -1
        if first_of_row + column != last:
            last = first_of_row + column
            _fill_spline(down, along)
            _fill_slopes(down, spacing, slopes)
            for c in range(3):
                ink, plate, below = 0.0, 0.0, 0.0
                for r in range(3):
                    k = last + c + r * columns
                    ink += along[r] * values[0, k]
                    plate += along[r] * values[1, k]
                    below += slopes[r] * (values[1, k] - values[0, k])
                sums[0, c], sums[1, c], sums[2, c] = ink, plate, below
        left, right = 0.5 * (1.0 - across) * (1.0 - across), 0.5 * across * across
        middle = 1.0 - left - right
        result[0, i] += left * sums[0, 0] + middle * sums[0, 1] + right * sums[0, 2]
        result[1, i] += left * sums[1, 0] + middle * sums[1, 1] + right * sums[1, 2]
        rising = (across - 1.0) * (sums[1, 0] - sums[0, 0])
        rising += (1.0 - 2.0 * across) * (sums[1, 1] - sums[0, 1])
        result[2, i] += (rising + across * (sums[1, 2] - sums[0, 2])) / spacing
        result[3, i] += left * sums[2, 0] + middle * sums[2, 1] + right * sums[2, 2]


@inlined
def _cell(at_px: float, first_px: float, spacing: float, count: int) -> tuple[int, float]:
    """Return the first of the three knots along an axis, and the position in the cell, 0…1."""
    t = (at_px - first_px) / spacing
    knot = min(max(int(np.floor(t)), 0), count - 3)
    return knot, t - knot


@inlined
def _fill_spline(t: float, weights: FloatArray) -> None:
    """Fill in the weights (3,) of the three knots: a quadratic B-spline."""
    weights[0], weights[2] = 0.5 * (1.0 - t) * (1.0 - t), 0.5 * t * t
    weights[1] = 1.0 - weights[0] - weights[2]


@inlined
def _fill_slopes(t: float, spacing: float, slopes: FloatArray) -> None:
    """Fill in the derivatives (3,) of the weights [1/px]."""
    slopes[0], slopes[1], slopes[2] = (t - 1.0) / spacing, (1.0 - 2.0 * t) / spacing, t / spacing


@dataclass(frozen=True, slots=True, eq=False)
class LightField:
    """What uneven light adds to the levels of ink and plate over a window."""

    knots: Knots
    values: FloatArray  # (2, k): for ink and plate at all knots
    precision: FloatArray  # (2, k): of the values' priors, whose means are 0
    offsets: FloatArray  # (2,): added to the levels of ink and plate everywhere
    shadows: ShadowEdges  # relative to the centre
    centre_px: FloatArray  # (2,): the target's centre

    @property
    def penalty(self) -> float:
        """Contribution of the priors to the negative log-likelihood."""
        for_offsets = 0.5 * LEVEL_OFFSET_PRECISION * float(self.offsets @ self.offsets)
        for_values = 0.5 * float(np.sum(self.precision * self.values**2))
        return for_values + for_offsets + self.shadows.penalty

    def added(self, pixels: FloatArray) -> FloatArray:
        """Return what is added to the levels of ink and plate (2, n) at pixels (2, n)."""
        return self.added_with_gradient(pixels)[0]

    def added_with_gradient(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the same as `added`, and the gradient (2, n) [1/px] of plate minus ink."""
        result = np.zeros((4, pixels.shape[1]))
        for grid in range(len(self.knots.spacings_px)):
            _add_values(self.knots, grid, self.values[:, self.knots.of_grid(grid)], pixels, result)
        added, gradient = result[:2] + self.offsets[:, None], result[2:]
        by_shadows, gradient_of_shadows = self.shadows.added_with_gradient(
            self._about_centre(pixels)
        )
        return added + by_shadows, gradient + gradient_of_shadows

    def edge_rows(self, pixels: FloatArray, by_level: FloatArray) -> FloatArray:
        """Return the derivatives (5 s, n) of grey values by the parameters of s shadow edges.

        `by_level` (2, n) are those by the levels of ink and plate.
        """
        return self.shadows.derivatives(self._about_centre(pixels), by_level)

    def _about_centre(self, pixels: FloatArray) -> FloatArray:
        return pixels - self.centre_px[:, None]

    def moved(
        self,
        values: FloatArray,
        offsets: FloatArray,
        edges: FloatArray,
        light_after: LightAfterStep,
    ) -> LightField:
        """Return the field after a step of values, offsets and shadow edges.

        The light x is not simply moved by its step. `light_after` moves it to x + step + a
        correction, which is nearly linear in x. Therefore the correction is distributed to offsets,
        grids and edges in the same way as the light is.
        """
        base, step = _EVEN + self.offsets[:, None], offsets[:, None]

        def correction(added: FloatArray, step: FloatArray) -> FloatArray:
            return light_after(base + added, step) - (base + added + step)

        nothing = np.zeros((2, 1))
        for_offsets = correction(nothing, step)
        edges, values = self.shadows.rows + edges, self.values + values
        for old, new in zip(self.shadows.rows, edges, strict=True):
            amplitude, change = old[INK:, None], (new - old)[INK:, None]
            new[INK:] += (correction(amplitude, step + change) - for_offsets)[:, 0]
        added, distributed = nothing, for_offsets
        for grid in range(len(self.knots.spacings_px)):
            part = self.knots.of_grid(grid)
            own, own_step = self.values[:, part], values[:, part] - self.values[:, part]
            change = correction(added + own, step + own_step) - distributed
            values[:, part] += change
            if grid + 1 < len(self.knots.spacings_px):
                places = self.knots.places_px(grid + 1)
                added = added + _of_grid(self.knots, grid, own, places)
                step = step + _of_grid(self.knots, grid, own_step, places)
                distributed = distributed + _of_grid(self.knots, grid, change, places)
        offsets = self.offsets + offsets + for_offsets[:, 0]
        return replace(
            self, values=values, offsets=offsets, shadows=replace(self.shadows, rows=edges)
        )


@lru_cache(maxsize=4)
def _places_px(knots: Knots, grid: int) -> FloatArray:
    spacing = knots.spacings_px[grid]
    x = knots.x0_px[grid] + spacing * (np.arange(knots.columns[grid]) - 0.5)
    y = knots.y0_px[grid] + spacing * (np.arange(knots.rows[grid]) - 0.5)
    columns, rows = np.meshgrid(x, y)
    return np.stack((columns.ravel(), rows.ravel()))


def _add_values(
    knots: Knots, grid: int, values: FloatArray, pixels: FloatArray, result: FloatArray
) -> None:
    """Apply `_add_grid` to the values (2, k) of one grid."""
    counts = knots.columns[grid], knots.rows[grid]
    spacing = knots.spacings_px[grid]
    corner = knots.x0_px[grid], knots.y0_px[grid]
    _add_grid(pixels, corner, spacing, counts, values.copy(), result)


def _of_grid(knots: Knots, grid: int, values: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return what one grid with values (2, k) adds to ink and plate at pixels (2, n)."""
    result = np.zeros((4, pixels.shape[1]))
    _add_values(knots, grid, values, pixels, result)
    return result[:2]
