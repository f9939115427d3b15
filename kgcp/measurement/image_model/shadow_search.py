"""Search for straight shadow edges, in grey values of ink and plate clear of the plate's own edges.

The search finds the step, or the strip between two edges, that explains most of the variation of
the grey values. It adjusts this together with all edges found before, and continues with the
residuals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.photometry import Tone, decoded
from kgcp.measurement.image_model.shadow_edges import (
    INK,
    LOG_WIDTH,
    NO_EDGES,
    PLATE,
    ShadowEdges,
)

_ENOUGH_EDGES = 4  # the search ends with this many
_DIRECTIONS, _BORDERS = 36, 61  # tried over half a turn, and across the plate
_MIN_PIXELS = 12  # of ink or of plate, on either side of a step
# Share of the variance that the first step must explain, and share of the remaining variance that
# each further one must explain. If a ring lay under both a shadow edge and an antenna's shadow, the
# true second one explained 0.80 of the rest or more on nine of ten rings.
_MIN_EXPLAINED, _MIN_EXPLAINED_OF_REST = 0.5, 0.7
_STRIP_FACTOR = 0.9  # on what a strip explains, because it has one border more than a step
# Least noise of grey values, relative to the contrast. Residuals of the steps are more than noise.
# If they were weighted by the noise alone, they would outweigh the prior of the penumbra.
_MIN_NOISE = 0.01
# Initial σ of a penumbra: relative to the plate's radius, and in a strip at most so much of its
# width. Then limits of its logarithm [px].
_FIRST_WIDTH, _WIDTH_IN_STRIP = 0.06, 0.3
_MIN_LOG_WIDTH, _MAX_LOG_WIDTH = -1.0, 6.0
_STEPS, _TRIALS, _FIRST_DAMPING, _SETTLED = 12, 4, 1e-3, 1e-3
_TINY_LEVEL = 1e-6  # of full scale
# Range of the change of ink divided by that of plate at an edge. Shade reduces both in proportion,
# a highlight adds to both. The range includes small negative values: on a ring of R 29 px, a strip
# of 5 px seemed to brighten ink by 0.14 of what it took from the plate.
_MIN_INK_RATIO, _MAX_INK_RATIO = -0.2, 0.6
_BURNT_MARGIN = 0.02  # relative to the contrast; white so close to the limit may be burnt
# Largest level of sunlit ink relative to that of the plate, in linear light. Where the sun burnt
# the white, this ratio was 0.05 to 0.11. Under a highlight, ink is brighter.
_MAX_INK = 0.13


@dataclass(frozen=True, slots=True, eq=False)
class PlateauPixels:
    """Pixels of ink and plate that are clear of edges."""

    offsets: FloatArray  # (2, n): from the target's centre [px]
    kind: IndexArray  # (n,): 0 for ink, 1 for plate
    levels: FloatArray  # (n,): grey values
    high: float  # grey value from which on pixels are clipped


@dataclass(frozen=True, slots=True, eq=False)
class FoundShadows:
    """Straight shadow edges, in terms of grey values."""

    sunlit_levels: FloatArray  # (2,): of ink and plate, without any edge
    edges: ShadowEdges

    def is_burnt(self, high: float) -> bool:
        """Tell whether the plate in the light is clipped at the grey value `high`."""
        ink, plate = self.sunlit_levels.tolist()
        return bool(plate > high - _BURNT_MARGIN * (plate - ink))


def find_shadows(plateaus: PlateauPixels, tone: Tone) -> list[FoundShadows]:
    """Return sets of straight edges that explain the variation of the grey values, smallest first.

    Each set adds a step or a strip to the one before. The list is empty if no first step explains
    enough. `plateaus` must contain pixels of both kinds.
    """
    means = np.array([plateaus.levels[plateaus.kind == kind].mean() for kind in (0, 1)])
    sd = _noise_of(plateaus, float(means[1] - means[0]))
    shadows, results = FoundShadows(means, NO_EDGES), list[FoundShadows]()
    residuals = _residuals_of(shadows, plateaus, sd)
    while len(shadows.edges.rows) < _ENOUGH_EDGES and not (
        results and residuals @ residuals < len(residuals)
    ):
        start = _with_best_step(shadows, plateaus, residuals, sd)
        if start is None:
            break
        extended, new_residuals = _adjusted(start, plateaus, sd)
        explained = 1.0 - float(new_residuals @ new_residuals) / float(residuals @ residuals)
        least = _MIN_EXPLAINED_OF_REST if results else _MIN_EXPLAINED
        if explained < least or not _may_be_shade(extended, plateaus.high, tone):
            break
        shadows, residuals = extended, new_residuals
        results.append(shadows)
    return results


def _noise_of(plateaus: PlateauPixels, contrast: float) -> FloatArray:
    """Return the noise of ink and plate (2,), from differences of successive pixels."""
    differences = (np.abs(np.diff(plateaus.levels[plateaus.kind == kind])) for kind in (0, 1))
    least = max(_MIN_NOISE * contrast, _TINY_LEVEL)
    return np.array([max(float(np.median(each)), least) for each in differences])


def _residuals_of(shadows: FoundShadows, plateaus: PlateauPixels, sd: FloatArray) -> FloatArray:
    """Return the residuals of the grey values (n,), in units of the noise."""
    added, _ = shadows.edges.added_with_gradient(plateaus.offsets)
    ink, plate = shadows.sunlit_levels[:, None] + added
    return np.asarray((plateaus.levels - np.where(plateaus.kind, plate, ink)) / sd[plateaus.kind])


def _may_be_shade(shadows: FoundShadows, high: float, tone: Tone) -> bool:
    """Tell whether shade or highlights can cause all edges.

    Ink and plate must change in the same sense. If white is burnt, shade need not show on the
    plate, but it must show on ink, and ink must be as dark as it is without a highlight.
    """
    if not max(float(shadows.sunlit_levels[0]), 0.0) < shadows.sunlit_levels[1]:
        return False
    by_ink, by_plate = shadows.edges.rows[:, INK], shadows.edges.rows[:, PLATE]
    ratios = by_ink / np.where(by_plate == 0.0, _TINY_LEVEL, by_plate)
    if np.all((ratios > _MIN_INK_RATIO) & (ratios < _MAX_INK_RATIO)):
        return True
    light = decoded(np.maximum(shadows.sunlit_levels, 0.0), Tone.SRGB if tone.is_unknown else tone)
    ink, plate = light.tolist()
    against = by_plate * np.sign(by_ink) < -_BURNT_MARGIN
    shows_on_ink = by_ink * (by_ink + by_plate) > 0.0
    is_dark = shadows.is_burnt(high) and ink < _MAX_INK * plate
    return bool(is_dark and np.all(shows_on_ink & ~against))


def _adjusted(
    start: FoundShadows, plateaus: PlateauPixels, sd: FloatArray
) -> tuple[FoundShadows, FloatArray]:
    """Adjust levels and edges to the grey values (Levenberg–Marquardt).

    Returned are the result and its residuals (n,), in units of the noise.
    """
    by_level = np.stack([(plateaus.kind == kind) / sd[kind] for kind in (0, 1)])
    shadows, residuals, damping = start, _residuals_of(start, plateaus, sd), _FIRST_DAMPING
    total = 0.5 * float(residuals @ residuals) + shadows.edges.penalty
    for _ in range(_STEPS):
        rows = np.vstack((by_level, shadows.edges.derivatives(plateaus.offsets, by_level)))
        gradient = rows @ residuals + np.append((0.0, 0.0), shadows.edges.pull)
        normal = rows @ rows.T + np.diag(np.append((0.0, 0.0), shadows.edges.precision))
        stiffness = np.diag(normal) + np.finfo(float).tiny
        for _ in range(_TRIALS):
            step = np.linalg.lstsq(normal + np.diag(damping * stiffness), gradient, rcond=None)[0]
            moved = _moved(shadows, step)
            new_residuals = _residuals_of(moved, plateaus, sd)
            gain = total - 0.5 * float(new_residuals @ new_residuals) - moved.edges.penalty
            if gain > 0.0:
                break
            damping *= 10.0
        if not gain > 0.0:
            break
        shadows, residuals, damping = moved, new_residuals, 0.1 * damping
        total -= gain
        if gain < _SETTLED * total:
            break
    return shadows, residuals


def _moved(shadows: FoundShadows, step: FloatArray) -> FoundShadows:
    rows = shadows.edges.rows + step[2:].reshape(-1, 5)
    rows[:, LOG_WIDTH] = np.clip(rows[:, LOG_WIDTH], _MIN_LOG_WIDTH, _MAX_LOG_WIDTH)
    return FoundShadows(shadows.sunlit_levels + step[:2], replace(shadows.edges, rows=rows))


def _with_best_step(
    shadows: FoundShadows, plateaus: PlateauPixels, residuals: FloatArray, sd: FloatArray
) -> FoundShadows | None:
    """Add the step or strip that explains most of the residuals; None if there is none.

    In the result, single edges come first, each with its shade beyond it.
    """
    reach_px = float(np.hypot(*plateaus.offsets).max())
    # another shade has no effect elsewhere
    in_sun = shadows.edges.sunlit_share(plateaus.offsets) > 0.5
    offsets = np.ascontiguousarray(plateaus.offsets[:, in_sun])
    gain, angle, first, last, *in_noise = _best_step(
        offsets, residuals[in_sun], plateaus.kind[in_sun], reach_px
    )
    if gain == 0.0:
        return None
    borders_px, step = np.linspace(-reach_px, reach_px, _BORDERS), np.array(in_noise) * sd
    near_px, far_px = borders_px[[first, last]].tolist()
    width_px = max(1.0, _FIRST_WIDTH * reach_px)
    rows, singles, levels = shadows.edges.rows, shadows.edges.single_count, shadows.sunlit_levels
    if last < _BORDERS - 1:
        log_width = math.log(min(width_px, max(1.0, _WIDTH_IN_STRIP * (far_px - near_px))))
        sides = (angle, near_px, log_width, *step), (angle, far_px, log_width, *-step)
        return FoundShadows(levels, ShadowEdges(np.vstack((rows, sides)), singles))
    if step.sum() > 0.0:  # the shade is on the other side
        angle, near_px, levels, step = angle + math.pi, -near_px, levels + step, -step
    row = np.array((angle, near_px, math.log(width_px), *step))
    return FoundShadows(levels, ShadowEdges(np.insert(rows, singles, row, axis=0), singles + 1))


@compiled
def _best_step(
    offsets: FloatArray, values: FloatArray, kind: IndexArray, reach_px: float
) -> tuple[float, float, int, int, float, float]:
    """Return the strip between two borders that explains most of the values (n,).

    Returned are by how much it reduces the sum of squares, its direction [rad], the numbers of its
    two borders, and the differences of ink and of plate in it from outside. If the second border is
    the last one, the strip is a step: it extends to the end of the plate.
    """
    best = (0.0, 0.0, 0, 0, 0.0, 0.0)
    bins = _BORDERS - 1
    sums = np.empty((2, 2, bins + 1))  # of ink and plate: numbers and values before each border
    for direction in range(_DIRECTIONS):
        angle = math.pi * direction / _DIRECTIONS
        cosine, sine = math.cos(angle), math.sin(angle)
        sums[:] = 0.0
        for i in range(len(values)):
            along_px = cosine * offsets[0, i] + sine * offsets[1, i]
            k = min(int(0.5 * bins * (along_px / reach_px + 1.0)), bins - 1)
            sums[kind[i], 0, k + 1] += 1.0
            sums[kind[i], 1, k + 1] += values[i]
        for k in range(bins):
            sums[:, :, k + 1] += sums[:, :, k]
        for first in range(1, bins):
            for last in range(first + 1, bins + 1):
                ink, by_ink = _difference(sums[0, 0], sums[0, 1], first, last)
                plate, by_plate = _difference(sums[1, 0], sums[1, 1], first, last)
                gain = (by_ink + by_plate) * (_STRIP_FACTOR if last < bins else 1.0)
                if gain > best[0]:
                    best = (gain, angle, first, last, ink, plate)
    return best


@compiled
def _difference(count: FloatArray, total: FloatArray, first: int, last: int) -> tuple[float, float]:
    """Return the mean between two borders minus that of the rest, and how much that explains.

    Both are 0 if there are too few values inside or outside.
    """
    inside = count[last] - count[first]
    outside = count[-1] - inside
    if min(inside, outside) < _MIN_PIXELS:
        return 0.0, 0.0
    sum_inside = total[last] - total[first]
    difference = sum_inside / inside - (total[-1] - sum_inside) / outside
    return difference, difference * difference * inside * outside / count[-1]
