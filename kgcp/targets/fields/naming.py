"""Who is who: the discs of a photograph as the discs of a field.

A lattice is grown from the discs themselves, and then laid on the field's. The ellipse of a disc is
the image of a circle: in its own affine frame the neighbours have the distances and angles that
they have on the board, however it is tilted. So the lattice needs no grid finder, no straight rows
and no complete view, and a hexagonal lattice cannot be taken for a square one, which a homography
alone allows.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.targets.fields.layout import Field

_NEIGHBOUR = (0.7, 1.4)  # distance of a neighbour over the expected one
_SEED_TOLERANCE = 0.25  # of the distance, where the second neighbour must be
_STEP_TOLERANCE = 0.3  # of a step, where the next disc must be
_STRAIGHT = 0.2  # of a step: how far a disc may be from the middle of two opposite neighbours
_SIZE_RATIO = 2.2  # of neighbouring discs: marks differ, letters and dust more
_SHAPE_RATIO = 1.6  # of the axes of a disc in the affine frame of its neighbour
_SEEDS = 24
_LEAST_DISCS = 6
# A hole narrower than this (half its shorter axis, px) may look filled: with 1.35 px all were seen,
# with 0.9 px none.
_LEAST_HOLE_PX = 1.2
_OUTSIDE = 0.12  # share of a lattice's discs that may be none of the field's


class NamingProblem(StrEnum):
    """Why the discs of a photograph got no names."""

    TOO_FEW = "too_few"  # discs that look like the field's
    NO_LATTICE = "no_lattice"  # discs that do not lie like the field's
    TWO_FIELDS = "two_fields"
    AMBIGUOUS = "ambiguous"  # part of a field that could be another part


@dataclass(frozen=True, slots=True, eq=False)
class SeenDiscs:
    """What naming needs to know of the discs of one photograph."""

    centres: FloatArray  # (n, 2) [px]
    # (n, 2, 2): symmetric, from the unit circle to the disc's ellipse [px]
    stretches: FloatArray
    is_hollow: BoolArray  # (n,): whether there is a hole in it


@dataclass(frozen=True, slots=True, eq=False)
class Naming:
    """Discs of a photograph with the discs of the field that they are."""

    disc: IndexArray  # (k,): indices of the photograph's discs
    point: IndexArray  # (k,): indices of the field's
    marks: int  # how many of them are marks
    # whether the field could lie there turned, too: it looks the same then
    is_symmetric: bool


def name_discs(seen: SeenDiscs, field: Field) -> Naming | NamingProblem:
    """Return which disc of the field each disc of a photograph is.

    Parameters
    ----------
    seen : SeenDiscs
        Of the field's polarity; others among them are left out.
    """
    if len(seen.centres) < _LEAST_DISCS:
        return NamingProblem.TOO_FEW
    lattice = _largest_lattice(seen, field, np.ones(len(seen.centres), dtype=np.bool_))
    if len(lattice) < _LEAST_DISCS:
        return NamingProblem.NO_LATTICE
    naming = _placed(lattice, seen, field)
    if isinstance(naming, NamingProblem):
        return naming
    is_left = np.ones(len(seen.centres), dtype=np.bool_)
    is_left[list(lattice.values())] = False
    second = _largest_lattice(seen, field, is_left)
    if len(second) >= max(2 * _LEAST_DISCS, len(lattice) // 2):
        return NamingProblem.TWO_FIELDS
    return naming


_Lattice = dict[tuple[int, int], int]  # lattice coordinates → index of the disc


def _largest_lattice(seen: SeenDiscs, field: Field, is_free: BoolArray) -> _Lattice:
    """Return the lattice with most discs that grows from any of the likeliest seeds."""
    free = np.flatnonzero(is_free)
    largest: _Lattice = {}
    if len(free) < _LEAST_DISCS:
        return largest
    frames = np.linalg.inv(seen.stretches)
    steps = np.einsum("nij,nmj->nmi", frames[free], seen.centres[free] - seen.centres[free, None])
    distances = np.linalg.norm(steps, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = float(np.median(distances.min(axis=1)))
    stated = (2.0 * field.neighbour_m / field.diameter_m,) if field.is_diameter_stated else ()
    for expected in (*stated, nearest):
        is_near = (distances > _NEIGHBOUR[0] * expected) & (distances < _NEIGHBOUR[1] * expected)
        lonely = np.abs(is_near.sum(axis=1) - field.turns)
        middle = np.linalg.norm(seen.centres[free] - np.median(seen.centres[free], axis=0), axis=1)
        tried: set[int] = set()
        for seed in np.lexsort((middle, lonely)).tolist():
            if len(tried) == _SEEDS:
                break
            if free[seed] in largest.values():
                continue
            tried.add(seed)
            basis = _seed_basis(seen, field, free, seed, distances[seed], expected)
            if basis is None:
                continue
            lattice = _grown(seen, free, int(free[seed]), basis)
            if len(lattice) > len(largest):
                largest = lattice
            if 2 * len(largest) > len(free):
                return largest
    return largest


def _seed_basis(
    seen: SeenDiscs,
    field: Field,
    free: IndexArray,
    seed: int,
    distances: FloatArray,
    expected: float,
) -> FloatArray | None:
    """Return two steps of the lattice (2, 2) as columns [px], from the affine frame of a disc."""
    own = int(free[seed])
    stretch = seen.stretches[own]
    frame = np.linalg.inv(stretch)
    angle = 2.0 * math.pi / field.turns
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    for first in np.argsort(distances, kind="stable")[: field.turns].tolist():
        if not _NEIGHBOUR[0] * expected < distances[first] < _NEIGHBOUR[1] * expected:
            continue
        step = seen.centres[free[first]] - seen.centres[own]
        second = stretch @ turn @ frame @ step
        gaps = np.linalg.norm(
            np.einsum("ij,nj->ni", frame, seen.centres[free] - seen.centres[own] - second), axis=1
        )
        best = int(np.argmin(gaps))
        if gaps[best] < _SEED_TOLERANCE * distances[first]:
            return np.stack((step, seen.centres[free[best]] - seen.centres[own]), axis=1)
    return None


def _grown(seen: SeenDiscs, free: IndexArray, seed: int, basis: FloatArray) -> _Lattice:
    """Return the lattice that grows from a disc, the surest step first.

    Every disc has a basis of its own, which follows the perspective and the lens.
    """
    lattice: _Lattice = {(0, 0): seed}
    bases = {(0, 0): basis}
    places = {(0, 0): seen.centres[seed]}
    taken = {seed}
    queue: list[tuple[float, int, tuple[int, int], tuple[int, int]]] = []

    def propose(node: tuple[int, int]) -> None:
        """Put what may be the neighbours of a node into the queue, the surest first."""
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            step = (sign, 0) if axis == 0 else (0, sign)
            there = (node[0] + step[0], node[1] + step[1])
            if there in lattice:
                continue
            along = bases[node][:, axis]
            back = (node[0] - step[0], node[1] - step[1])
            if back in places:  # steps grow or shrink evenly under perspective
                along = sign * (places[node] - places[back])
            gaps = np.linalg.norm(
                seen.centres[free] - (places[node] + sign * along), axis=1
            ) / np.linalg.norm(along)
            best = int(np.argmin(gaps))
            if gaps[best] < _STEP_TOLERANCE:
                heapq.heappush(queue, (float(gaps[best]), int(free[best]), node, there))

    propose((0, 0))
    while queue:
        _, disc, origin, node = heapq.heappop(queue)
        if node in lattice or disc in taken or not _is_alike(seen, lattice[origin], disc):
            continue
        lattice[node], places[node] = disc, seen.centres[disc]
        taken.add(disc)
        bases[node] = _own_basis(node, places, bases[origin])
        propose(node)
    return _straight(lattice, places)


def _is_alike(seen: SeenDiscs, disc: int, other: int) -> bool:
    """Return whether another disc has about the size and shape of its neighbour."""
    relative = np.linalg.solve(seen.stretches[disc], seen.stretches[other])
    large, small = np.linalg.svd(relative)[1]
    size = math.sqrt(large * small)
    is_sized = 1.0 / _SIZE_RATIO < size < _SIZE_RATIO
    return bool(is_sized and large < _SHAPE_RATIO * small)


def _own_basis(
    node: tuple[int, int], places: dict[tuple[int, int], FloatArray], inherited: FloatArray
) -> FloatArray:
    """Return a disc's steps along both axes, by its neighbours where there are any."""
    basis = inherited.copy()
    for axis, (du, dv) in enumerate(((1, 0), (0, 1))):
        after = places.get((node[0] + du, node[1] + dv))
        before = places.get((node[0] - du, node[1] - dv))
        if after is not None and before is not None:
            basis[:, axis] = 0.5 * (after - before)
        elif after is not None:
            basis[:, axis] = after - places[node]
        elif before is not None:
            basis[:, axis] = places[node] - before
    return basis


def _straight(lattice: _Lattice, places: dict[tuple[int, int], FloatArray]) -> _Lattice:
    """Return the lattice without discs that are not in the middle of their neighbours."""
    kept = {}
    for (u, v), disc in lattice.items():
        gaps = []
        for du, dv in ((1, 0), (0, 1)):
            after, before = places.get((u + du, v + dv)), places.get((u - du, v - dv))
            if after is not None and before is not None:
                middle = places[u, v] - 0.5 * (after + before)
                gaps.append(2.0 * np.linalg.norm(middle) / np.linalg.norm(after - before))
        if not gaps or min(gaps) < _STRAIGHT:
            kept[u, v] = disc
    return kept


def _placed(lattice: _Lattice, seen: SeenDiscs, field: Field) -> Naming | NamingProblem:
    """Lay a lattice on the field's: all turns and shifts, of which the marks must leave one."""
    nodes = np.array(list(lattice))
    discs = np.array(list(lattice.values()))
    field_nodes = field.nodes()
    low = field_nodes.min(axis=0)
    table = np.full(np.ptp(field_nodes, axis=0) + 1, -1)
    table[tuple((field_nodes - low).T)] = np.arange(len(field_nodes))
    kinds = _Kinds.of(seen, field, lattice)
    placements: list[tuple[float, int, IndexArray]] = []  # score, marks, points
    turned = nodes
    for _ in range(field.turns):
        turned = turned @ _lattice_turn(field.turns).T
        first, last = turned.min(axis=0), turned.max(axis=0)
        reach = low + np.array(table.shape) - 1
        slack = 1 + (last - first) // 8  # discs outside, which are no discs of the field
        for du in range(int(low[0] - first[0] - slack[0]), int(reach[0] - last[0] + slack[0]) + 1):
            for dv in range(
                int(low[1] - first[1] - slack[1]), int(reach[1] - last[1] + slack[1]) + 1
            ):
                points = _looked_up(table, turned + np.array((du, dv)) - low)
                is_inside = points >= 0
                outside = len(nodes) - np.count_nonzero(is_inside)
                if outside > _OUTSIDE * len(nodes):
                    continue
                agreement, marks = kinds.agreement(discs[is_inside], points[is_inside])
                placements.append((agreement - outside, marks, points))
    if not placements:
        return NamingProblem.NO_LATTICE
    best = max(score for score, _, _ in placements)
    chosen = [(marks, points) for score, marks, points in placements if score == best]
    marks, points = max(chosen, key=lambda each: _uprightness(seen, field, discs, each[1]))
    symmetries = field.symmetries()
    others = [other for _, other in chosen if other is not points]
    if not all(_is_turned(points, other, symmetries) for other in others):
        return NamingProblem.AMBIGUOUS
    is_inside = points >= 0
    return Naming(discs[is_inside], points[is_inside], marks, len(chosen) > 1)


def _lattice_turn(turns: int) -> IndexArray:
    """Return one turn of the lattice about a node, in its own coordinates (2, 2)."""
    return np.array([[0, -1], [1, 0]]) if turns == 4 else np.array([[0, -1], [1, 1]])


def _looked_up(table: IndexArray, nodes: IndexArray) -> IndexArray:
    is_there = np.all((nodes >= 0) & (nodes < table.shape), axis=1)
    points = np.full(len(nodes), -1)
    points[is_there] = table[tuple(nodes[is_there].T)]
    return points


def _uprightness(seen: SeenDiscs, field: Field, discs: IndexArray, points: IndexArray) -> float:
    """Return how far the field's x axis points to the right of the photograph.

    Of the ways in which a symmetric field may lie, that one is taken in which it is upright: so it
    is the same in all photographs by a camera that is held the same way.
    """
    inside = points >= 0
    across = field.points_m()[points[inside], 0]
    right = seen.centres[discs[inside], 0]
    return float(np.corrcoef(across, right)[0, 1])


def _is_turned(points: IndexArray, other: IndexArray, symmetries: list[IndexArray]) -> bool:
    """Return whether another placement shows the same discs of a symmetric field, turned.

    Of a whole view of a symmetric board one is as good as the other; parts of a board that look the
    same are not the same discs.
    """
    is_outside = points < 0
    if not np.array_equal(is_outside, other < 0):
        return False
    inside = ~is_outside
    return any(np.array_equal(turn[points[inside]], other[inside]) for turn in symmetries)


@dataclass(frozen=True, slots=True, eq=False)
class _Kinds:
    """How discs look, and how those of the field should."""

    log_size: FloatArray  # (n,): of seen discs, against the median of their neighbours
    is_hollow: BoolArray
    half_width_px: FloatArray  # (n,): half the shorter axis
    field_log_size: FloatArray  # (m,): against the field's usual diameter
    field_hole: FloatArray  # (m,): diameter of the hole over the disc's
    is_mark: BoolArray  # (m,)

    @classmethod
    def of(cls, seen: SeenDiscs, field: Field, lattice: _Lattice) -> _Kinds:
        """Return how discs look beside their neighbours on the lattice, and how they should.

        A disc that has no neighbours counts as one of the usual size.
        """
        sizes = 0.5 * np.log(np.linalg.det(seen.stretches))
        relative = np.zeros(len(sizes))
        for (u, v), disc in lattice.items():
            around = [
                lattice[u + du, v + dv]
                for du in (-1, 0, 1)
                for dv in (-1, 0, 1)
                if (du or dv) and (u + du, v + dv) in lattice
            ]
            if around:
                relative[disc] = sizes[disc] - np.median(sizes[around])
        field_size = np.log(2.0 * field.radii_m() / field.diameter_m)
        hole = field.inner_radii_m() / field.radii_m()
        is_mark = (np.abs(field_size) > 0.05) | ((hole > 0.0) != (field.inner_diameter_m > 0.0))
        half_width_px = np.linalg.norm(seen.stretches, ord=-2, axis=(1, 2))
        return cls(relative, seen.is_hollow, half_width_px, field_size, hole, is_mark)

    def agreement(self, discs: IndexArray, points: IndexArray) -> tuple[float, int]:
        """Return how well discs look like points, and how many of them are marks.

        Each disc counts at most once, against what the others could be: sizes that are nearer to
        another kind of disc of the field, and holes that are or are not there. A hole that is too
        small to be seen speaks neither for a place nor against it.
        """
        if not self.is_mark.any():
            return 0.0, 0
        kinds = np.unique(self.field_log_size)
        is_nearest = (
            kinds[np.abs(self.log_size[discs, None] - kinds).argmin(axis=1)]
            == self.field_log_size[points]
        )
        hole = self.field_hole[points]
        has_hole = self.is_hollow[discs] == (hole > 0.0)
        may_look_filled = (hole > 0.0) & (hole * self.half_width_px[discs] < _LEAST_HOLE_PX)
        is_right = is_nearest & (has_hole | (may_look_filled & ~self.is_hollow[discs]))
        marks = self.is_mark[points] & has_hole
        return float(np.count_nonzero(is_right) - len(discs)), int(
            np.count_nonzero(marks & is_right)
        )
