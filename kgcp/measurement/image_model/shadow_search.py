"""Straight edges of shadows, found in grey values of ink and plate clear of the plate's own edges.

The search takes the step that explains most of how the values vary, or the strip between two edges,
adjusts it together with all edges found before, and goes on in what is left.
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

_ENOUGH_EDGES = 4  # with so many, no further ones are looked for
_DIRECTIONS, _BORDERS = 36, 61  # of steps that are tried, over half a turn and across the plate
_FEWEST_PIXELS = 12  # on either side of a step, of ink or plate
# Of the variance, that a step must explain, and of what others have left. Under an edge and an
# antenna's shadow, nine of ten rings had 0.80 of the rest explained by what is there, or more.
_LEAST_EXPLAINED, _LEAST_EXPLAINED_OF_REST = 0.5, 0.7
_BY_STRIP = 0.9  # what a strip explains counts as so much: it has one border more
# Noise of grey values, of the contrast, at the least: what steps do not explain is more than noise,
# and taken for it, it would outweigh all that is known beforehand of a penumbra.
_LEAST_NOISE = 0.01
# σ of a penumbra at the start, of the plate's radius, and within a strip of its breadth; limits of
# its logarithm [px]
_FIRST_WIDTH, _WIDTH_IN_STRIP = 0.06, 0.3
_LEAST_LOG_WIDTH, _MOST_LOG_WIDTH = -1.0, 6.0
_STEPS, _TRIALS, _FIRST_DAMPING, _SETTLED = 12, 4, 1e-3, 1e-3
_ALMOST_NOTHING = 1e-6  # of full scale
# Change of ink by that of plate: shade takes from both what they have, a highlight adds to both. On
# a ring of R 29 px, a strip of 5 px seemed to brighten ink by 0.14 of what it took from the plate.
_LEAST_BY_INK, _MOST_BY_INK = -0.2, 0.6
_BURNT = 0.02  # of the contrast: so near to the limit, white may be anything above
# Level of ink in the sun, of the plate's, before any tone curve: 0.05 to 0.11 where white is burnt.
# Under a highlight ink is brighter, in one case by 0.15.
_MOST_INK = 0.13


@dataclass(frozen=True, slots=True, eq=False)
class FlatPixels:
    """Pixels of ink and plate that are clear of edges."""

    offsets: FloatArray  # (2, n): from the target's centre [px]
    kind: IndexArray  # (n,): 0 for ink, 1 for plate
    levels: FloatArray  # (n,): grey values
    high: float  # grey value from which on they are clipped


@dataclass(frozen=True, slots=True, eq=False)
class SeenShadows:
    """Straight edges of shadows, in grey values."""

    lit: FloatArray  # (2,): ink and plate before all edges
    edges: ShadowEdges

    def is_burnt(self, high: float) -> bool:
        """Tell whether the plate in the light is clipped, at the grey value `high`."""
        ink, plate = self.lit.tolist()
        return bool(plate > high - _BURNT * (plate - ink))


def find_shadows(flat: FlatPixels, tone: Tone) -> list[SeenShadows]:
    """Return straight edges that explain most of how grey values vary, the fewest first.

    Each adds a step or a strip to the one before; there is none if nothing explains most. There are
    pixels of both kinds.
    """
    means = np.array([flat.levels[flat.kind == kind].mean() for kind in (0, 1)])
    sd = _noise_of(flat, float(means[1] - means[0]))
    seen, found = SeenShadows(means, NO_EDGES), list[SeenShadows]()
    rest = _rest(seen, flat, sd)
    while len(seen.edges.rows) < _ENOUGH_EDGES and not (found and rest @ rest < len(rest)):
        start = _with_best_step(seen, flat, rest, sd)
        if start is None:
            break
        further, after = _adjusted(start, flat, sd)
        explained = 1.0 - float(after @ after) / float(rest @ rest)
        least = _LEAST_EXPLAINED_OF_REST if found else _LEAST_EXPLAINED
        if explained < least or not _may_be_shade(further, flat.high, tone):
            break
        seen, rest = further, after
        found.append(seen)
    return found


def _noise_of(flat: FlatPixels, contrast: float) -> FloatArray:
    """Return the standard deviation of grey values of ink and plate (2,)."""
    differences = (np.abs(np.diff(flat.levels[flat.kind == kind])) for kind in (0, 1))
    least = max(_LEAST_NOISE * contrast, _ALMOST_NOTHING)
    return np.array([max(float(np.median(each)), least) for each in differences])


def _rest(seen: SeenShadows, flat: FlatPixels, sd: FloatArray) -> FloatArray:
    """Return what shadows leave of the grey values (n,), in units of the noise."""
    added, _ = seen.edges.added_with_gradient(flat.offsets)
    ink, plate = seen.lit[:, None] + added
    return np.asarray((flat.levels - np.where(flat.kind, plate, ink)) / sd[flat.kind])


def _may_be_shade(seen: SeenShadows, high: float, tone: Tone) -> bool:
    """Tell whether shade or a highlight can make all edges: not what is brighter on ink alone.

    Where white is burnt, shade need not show on it but on ink, which is dark without a highlight.
    """
    if not max(float(seen.lit[0]), 0.0) < seen.lit[1]:
        return False
    by_ink, by_plate = seen.edges.rows[:, INK], seen.edges.rows[:, PLATE]
    ratios = by_ink / np.where(by_plate == 0.0, _ALMOST_NOTHING, by_plate)
    if np.all((ratios > _LEAST_BY_INK) & (ratios < _MOST_BY_INK)):
        return True
    light = decoded(np.maximum(seen.lit, 0.0), Tone.SRGB if tone.is_unknown else tone)
    ink, plate = light.tolist()
    against = by_plate * np.sign(by_ink) < -_BURNT
    shows_on_ink = by_ink * (by_ink + by_plate) > 0.0
    is_dark = seen.is_burnt(high) and ink < _MOST_INK * plate
    return bool(is_dark and np.all(shows_on_ink & ~against))


def _adjusted(
    start: SeenShadows, flat: FlatPixels, sd: FloatArray
) -> tuple[SeenShadows, FloatArray]:
    """Adjust levels and edges to the grey values (Levenberg–Marquardt).

    Also return what is left of these (n,), in units of the noise.
    """
    by_level = np.stack([(flat.kind == kind) / sd[kind] for kind in (0, 1)])
    seen, rest, damping = start, _rest(start, flat, sd), _FIRST_DAMPING
    total = 0.5 * float(rest @ rest) + seen.edges.penalty
    for _ in range(_STEPS):
        rows = np.vstack((by_level, seen.edges.derivatives(flat.offsets, by_level)))
        gradient = rows @ rest + np.append((0.0, 0.0), seen.edges.pull)
        normal = rows @ rows.T + np.diag(np.append((0.0, 0.0), seen.edges.precision))
        stiffness = np.diag(normal) + np.finfo(float).tiny
        for _ in range(_TRIALS):
            step = np.linalg.lstsq(normal + np.diag(damping * stiffness), gradient, rcond=None)[0]
            moved = _moved(seen, step)
            after = _rest(moved, flat, sd)
            gain = total - 0.5 * float(after @ after) - moved.edges.penalty
            if gain > 0.0:
                break
            damping *= 10.0
        if not gain > 0.0:
            break
        seen, rest, damping = moved, after, 0.1 * damping
        total -= gain
        if gain < _SETTLED * total:
            break
    return seen, rest


def _moved(seen: SeenShadows, step: FloatArray) -> SeenShadows:
    rows = seen.edges.rows + step[2:].reshape(-1, 5)
    rows[:, LOG_WIDTH] = np.clip(rows[:, LOG_WIDTH], _LEAST_LOG_WIDTH, _MOST_LOG_WIDTH)
    return SeenShadows(seen.lit + step[:2], replace(seen.edges, rows=rows))


def _with_best_step(
    seen: SeenShadows, flat: FlatPixels, rest: FloatArray, sd: FloatArray
) -> SeenShadows | None:
    """Add the step or strip that explains most of what is left; None if nothing explains any.

    Edges that bound a shade alone come first, and darken.
    """
    reach_px = float(np.hypot(*flat.offsets).max())
    in_sun = seen.edges.sun_left(flat.offsets) > 0.5  # elsewhere, another shade takes nothing
    offsets = np.ascontiguousarray(flat.offsets[:, in_sun])
    gain, angle, first, last, *in_noise = _best_step(
        offsets, rest[in_sun], flat.kind[in_sun], reach_px
    )
    if gain == 0.0:
        return None
    borders_px, step = np.linspace(-reach_px, reach_px, _BORDERS), np.array(in_noise) * sd
    near_px, far_px = borders_px[[first, last]].tolist()
    width_px = max(1.0, _FIRST_WIDTH * reach_px)
    rows, alone, lit = seen.edges.rows, seen.edges.alone_count, seen.lit
    if last < _BORDERS - 1:
        log_width = math.log(min(width_px, max(1.0, _WIDTH_IN_STRIP * (far_px - near_px))))
        sides = (angle, near_px, log_width, *step), (angle, far_px, log_width, *-step)
        return SeenShadows(lit, ShadowEdges(np.vstack((rows, sides)), alone))
    if step.sum() > 0.0:  # the shade lies the other way
        angle, near_px, lit, step = angle + math.pi, -near_px, lit + step, -step
    row = np.array((angle, near_px, math.log(width_px), *step))
    return SeenShadows(lit, ShadowEdges(np.insert(rows, alone, row, axis=0), alone + 1))


@compiled
def _best_step(
    offsets: FloatArray, values: FloatArray, kind: IndexArray, reach_px: float
) -> tuple[float, float, int, int, float, float]:
    """Return the step between two borders that explains most of values (n,).

    Of squares, so much that their sum is less by it; the direction; the two borders, of which the
    last one ends the plate; and by how much ink and plate differ between them.
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
                gain = (by_ink + by_plate) * (_BY_STRIP if last < bins else 1.0)
                if gain > best[0]:
                    best = (gain, angle, first, last, ink, plate)
    return best


@compiled
def _difference(count: FloatArray, total: FloatArray, first: int, last: int) -> tuple[float, float]:
    """Return the mean between two borders less that of all else, and how much that explains.

    Both are 0 where few values lie on either side.
    """
    within = count[last] - count[first]
    beside = count[-1] - within
    if min(within, beside) < _FEWEST_PIXELS:
        return 0.0, 0.0
    sum_within = total[last] - total[first]
    difference = sum_within / within - (total[-1] - sum_within) / beside
    return difference, difference * difference * within * beside / count[-1]
