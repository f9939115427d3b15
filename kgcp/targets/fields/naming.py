"""Identification of the discs of a photograph with those of a field on a lattice.

A lattice is grown from disc to disc, and then matched with the field's. The ellipse of each disc is
the image of a circle. It defines an affine frame in which the neighbours have the distances and
angles that they have on the board, whatever its tilt. So the method needs neither straight rows nor
a complete view. Nor can it mistake a hexagonal lattice for a square one, as homographies alone can.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.targets.fields.layout import Field

_NEIGHBOUR_RANGE = (0.7, 1.4)  # distance of a neighbour, relative to the expected one
_SEED_TOLERANCE = 0.25  # position error of a seed's second neighbour, relative to its distance
_STEP_TOLERANCE = 0.3  # position error of the next disc, relative to the step
# Distance of a disc from the midpoint of two opposite neighbours, relative to the step.
_STRAIGHTNESS = 0.2
# Largest size ratio of neighbouring discs. Marks differ by less, letters and dust by more.
_MAX_SIZE_RATIO = 2.2
_MAX_AXIS_RATIO = 1.6  # of a disc in the affine frame of its neighbour
_MAX_SEEDS = 24
_MIN_DISCS = 6
# A hole whose smaller semi-axis is less than this may look filled. In trials, all holes with a
# semi-axis of 1.35 px were seen, and none with 0.9 px.
_MIN_HOLE_PX = 1.2
_MAX_OUTSIDE = 0.12  # share of a lattice's discs that may lie outside the field


class NamingProblem(StrEnum):
    """Why the discs of a photograph could not be identified."""

    TOO_FEW = "too_few"  # there are too few discs like the field's
    NO_LATTICE = "no_lattice"  # the discs are not arranged like the field's
    TWO_FIELDS = "two_fields"
    AMBIGUOUS = "ambiguous"  # the visible part of the field looks like another part


@dataclass(frozen=True, slots=True, eq=False)
class SeenDiscs:
    """The discs of one photograph."""

    centres: FloatArray  # (n, 2) [px]
    # (n, 2, 2): symmetric matrices that map the unit circle to the disc's ellipse [px]
    stretches: FloatArray
    is_hollow: BoolArray  # (n,): whether a hole is visible


@dataclass(frozen=True, slots=True, eq=False)
class Naming:
    """Identified discs of a photograph."""

    disc: IndexArray  # (k,): indices of the photograph's discs
    point: IndexArray  # (k,): indices of the same discs in the field
    marks: int  # number of marks among them
    is_symmetric: bool  # whether the field looks the same in another orientation


def name_discs(seen: SeenDiscs, field: Field) -> Naming | NamingProblem:
    """Identify the discs of a photograph.

    Parameters
    ----------
    seen : SeenDiscs
        Discs of the field's polarity; those that are not part of the field are left out.
    """
    if len(seen.centres) < _MIN_DISCS:
        return NamingProblem.TOO_FEW
    lattice = _largest_lattice(seen, field, np.ones(len(seen.centres), dtype=np.bool_))
    if len(lattice) < _MIN_DISCS:
        return NamingProblem.NO_LATTICE
    naming = _matched_with_field(lattice, seen, field)
    if isinstance(naming, NamingProblem):
        return naming
    is_free = np.ones(len(seen.centres), dtype=np.bool_)
    is_free[list(lattice.values())] = False
    second = _largest_lattice(seen, field, is_free)
    if len(second) >= max(2 * _MIN_DISCS, len(lattice) // 2):
        return NamingProblem.TWO_FIELDS
    return naming


_Lattice = dict[tuple[int, int], int]  # lattice coordinates → index of the disc


def _largest_lattice(seen: SeenDiscs, field: Field, is_free: BoolArray) -> _Lattice:
    """Return the largest lattice that grows from any of the best seeds."""
    free = np.flatnonzero(is_free)
    largest: _Lattice = {}
    if len(free) < _MIN_DISCS:
        return largest
    frames = np.linalg.inv(seen.stretches)
    steps = np.einsum("nij,nmj->nmi", frames[free], seen.centres[free] - seen.centres[free, None])
    distances = np.linalg.norm(steps, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = float(np.median(distances.min(axis=1)))
    stated = (2.0 * field.neighbour_m / field.diameter_m,) if field.is_diameter_stated else ()
    for expected in (*stated, nearest):
        is_near = (distances > _NEIGHBOUR_RANGE[0] * expected) & (
            distances < _NEIGHBOUR_RANGE[1] * expected
        )
        missing = np.abs(is_near.sum(axis=1) - field.turns)
        off_centre = np.linalg.norm(
            seen.centres[free] - np.median(seen.centres[free], axis=0), axis=1
        )
        tried: set[int] = set()
        for seed in np.lexsort((off_centre, missing)).tolist():
            if len(tried) == _MAX_SEEDS:
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
    """Return the two basis steps of the lattice at a disc, as columns (2, 2) [px]."""
    disc = int(free[seed])
    stretch = seen.stretches[disc]
    frame = np.linalg.inv(stretch)
    angle = 2.0 * math.pi / field.turns
    cosine, sine = math.cos(angle), math.sin(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    for first in np.argsort(distances, kind="stable")[: field.turns].tolist():
        if not _NEIGHBOUR_RANGE[0] * expected < distances[first] < _NEIGHBOUR_RANGE[1] * expected:
            continue
        step = seen.centres[free[first]] - seen.centres[disc]
        second = stretch @ rotation @ frame @ step
        gaps = np.linalg.norm(
            np.einsum("ij,nj->ni", frame, seen.centres[free] - seen.centres[disc] - second), axis=1
        )
        best = int(np.argmin(gaps))
        if gaps[best] < _SEED_TOLERANCE * distances[first]:
            return np.stack((step, seen.centres[free[best]] - seen.centres[disc]), axis=1)
    return None


def _grown(seen: SeenDiscs, free: IndexArray, seed: int, basis: FloatArray) -> _Lattice:
    """Return the lattice that grows from a disc, the most certain step first.

    Every disc has its own basis, so that the lattice follows perspective and distortion.
    """
    lattice: _Lattice = {(0, 0): seed}
    bases = {(0, 0): basis}
    places = {(0, 0): seen.centres[seed]}
    taken = {seed}
    queue: list[tuple[float, int, tuple[int, int], tuple[int, int]]] = []

    def propose(node: tuple[int, int]) -> None:
        """Put possible neighbours of a node into the queue."""
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            step = (sign, 0) if axis == 0 else (0, sign)
            neighbour = (node[0] + step[0], node[1] + step[1])
            if neighbour in lattice:
                continue
            along = bases[node][:, axis]
            back = (node[0] - step[0], node[1] - step[1])
            if back in places:  # the opposite step predicts best: perspective changes steps slowly
                along = sign * (places[node] - places[back])
            gaps = np.linalg.norm(
                seen.centres[free] - (places[node] + sign * along), axis=1
            ) / np.linalg.norm(along)
            best = int(np.argmin(gaps))
            if gaps[best] < _STEP_TOLERANCE:
                heapq.heappush(queue, (float(gaps[best]), int(free[best]), node, neighbour))

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
    """Tell whether a disc has a similar size and shape as its neighbour."""
    relative = np.linalg.solve(seen.stretches[disc], seen.stretches[other])
    large, small = np.linalg.svd(relative)[1]
    size = math.sqrt(large * small)
    is_sized = 1.0 / _MAX_SIZE_RATIO < size < _MAX_SIZE_RATIO
    return bool(is_sized and large < _MAX_AXIS_RATIO * small)


def _own_basis(
    node: tuple[int, int], places: dict[tuple[int, int], FloatArray], inherited: FloatArray
) -> FloatArray:
    """Return a disc's steps along both axes, from its neighbours if there are any."""
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
    """Return the lattice without discs that are not midway between opposite neighbours."""
    kept = {}
    for (u, v), disc in lattice.items():
        gaps = []
        for du, dv in ((1, 0), (0, 1)):
            after, before = places.get((u + du, v + dv)), places.get((u - du, v - dv))
            if after is not None and before is not None:
                middle = places[u, v] - 0.5 * (after + before)
                gaps.append(2.0 * np.linalg.norm(middle) / np.linalg.norm(after - before))
        if not gaps or min(gaps) < _STRAIGHTNESS:
            kept[u, v] = disc
    return kept


def _matched_with_field(lattice: _Lattice, seen: SeenDiscs, field: Field) -> Naming | NamingProblem:
    """Match a lattice with the field's: try all rotations and shifts; marks must leave one."""
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
        slack = 1 + (last - first) // 8  # for discs that are not part of the field
        for du in range(int(low[0] - first[0] - slack[0]), int(reach[0] - last[0] + slack[0]) + 1):
            for dv in range(
                int(low[1] - first[1] - slack[1]), int(reach[1] - last[1] + slack[1]) + 1
            ):
                points = _looked_up(table, turned + np.array((du, dv)) - low)
                is_inside = points >= 0
                outside = len(nodes) - np.count_nonzero(is_inside)
                if outside > _MAX_OUTSIDE * len(nodes):
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
    if not all(_is_symmetric(points, other, symmetries) for other in others):
        return NamingProblem.AMBIGUOUS
    is_inside = points >= 0
    return Naming(discs[is_inside], points[is_inside], marks, len(chosen) > 1)


def _lattice_turn(turns: int) -> IndexArray:
    """Return the rotation of the lattice by one turn, in lattice coordinates (2, 2)."""
    return np.array([[0, -1], [1, 0]]) if turns == 4 else np.array([[0, -1], [1, 1]])


def _looked_up(table: IndexArray, nodes: IndexArray) -> IndexArray:
    is_there = np.all((nodes >= 0) & (nodes < table.shape), axis=1)
    points = np.full(len(nodes), -1)
    points[is_there] = table[tuple(nodes[is_there].T)]
    return points


def _uprightness(seen: SeenDiscs, field: Field, discs: IndexArray, points: IndexArray) -> float:
    """Return how well the field's x axis points to the right in the photograph, -1…1.

    Of the orientations of a symmetric field, the most upright one is taken. So it is the same in
    all photographs with a camera that is held the same way.
    """
    inside = points >= 0
    across = field.points_m()[points[inside], 0]
    right = seen.centres[discs[inside], 0]
    return float(np.corrcoef(across, right)[0, 1])


def _is_symmetric(points: IndexArray, other: IndexArray, symmetries: list[IndexArray]) -> bool:
    """Tell whether another placement is the same view of a symmetric field, but rotated.

    If the whole board is visible, either placement is acceptable. Parts of a board that look the
    same are different discs, and are not.
    """
    is_outside = points < 0
    if not np.array_equal(is_outside, other < 0):
        return False
    inside = ~is_outside
    return any(np.array_equal(symmetry[points[inside]], other[inside]) for symmetry in symmetries)


@dataclass(frozen=True, slots=True, eq=False)
class _Kinds:
    """Appearance of the discs of a photograph, and of those of the field."""

    log_size: FloatArray  # (n,): size relative to the median of the neighbours, logarithm
    is_hollow: BoolArray
    half_width_px: FloatArray  # (n,): half the shorter axis
    field_log_size: FloatArray  # (m,): size relative to the field's usual diameter, logarithm
    field_hole: FloatArray  # (m,): diameter of the hole relative to the disc's
    is_mark: BoolArray  # (m,)

    @classmethod
    def of(cls, seen: SeenDiscs, field: Field, lattice: _Lattice) -> _Kinds:
        """Return the appearance of discs relative to their neighbours on the lattice.

        A disc without neighbours counts as one of the usual size.
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
        """Return the agreement of discs with points of the field, and the number of marks.

        The agreement is minus the number of discs that look wrong: their size is closer to another
        size of the field, or they have a hole where there should be none, or the reverse. A hole
        that is too small to be seen is no evidence either way.
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
        may_look_filled = (hole > 0.0) & (hole * self.half_width_px[discs] < _MIN_HOLE_PX)
        is_right = is_nearest & (has_hole | (may_look_filled & ~self.is_hollow[discs]))
        marks = self.is_mark[points] & has_hole
        return float(np.count_nonzero(is_right) - len(discs)), int(
            np.count_nonzero(marks & is_right)
        )
