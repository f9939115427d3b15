"""Codes of targets: their distances, and the choice of new codes with large distances."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TypeVar

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.settings import require_range
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import AnyTarget
from kgcp.targets.validation import check_targets, rotations_coincide, same_shape

_Kind = TypeVar("_Kind", bound=AnyTarget)

LEAST_DISTANCE = 2.0
"""Least distance of new codes, in dots. One dot in another place counts two; dirt or a shadow may
change less than that."""
DOTS = (3, 6)  # fewer dots distinguish too few codes; more dots overlap in any arrangement
_GRID_DEG, _STARTS = 5.0, 6
# A coarser grid may hold more codes. Two codes differ if a dot is displaced by more than a dot's
# width, which is two steps of a grid just coarser than half of that width. On the fine grid, the
# search leaves gaps between codes into which no other fits: it finds 43 codes of four dots. On the
# coarse grid, it finds 50, from a quarter of its starts.
_COARSE_GRIDS_DEG, _COARSE_STARTS = (6.0, 8.0, 9.0, 10.0, 12.0, 15.0, 18.0, 20.0, 24.0), 40
_STRIDE = 8  # between starts in the list of candidates, best ones first
_MIN_SPACING = 1.5  # between dots, relative to a dot's width: ink must be visible between them
_MAX_CANDIDATES = 10_000  # those with the largest distance to themselves
_MIN_GAIN = 1e-4  # of an exchange, in dots

# Proportions of Cucci's target, relative to the outer diameter: inner circle, code circle, dots.
_INNER, _CODE, _DOT = 1.0 / 2.0, 1.0 / 1.4, 1.0 / 7.0


def dots_apart(first: Ring, second: Ring, *, mirrored: bool = False) -> float:
    """Return the least distance of two codes over all rotations, in dots.

    Parameters
    ----------
    first, second : Ring
        Rings of the same shape.
    mirrored : bool
        Whether the second one is seen from behind.
    """
    code, other = np.array(first.code_deg), np.array(second.code_deg)
    width_deg = 2.0 * max(first.dot_half_angle_deg, second.dot_half_angle_deg)
    overlap = _overlap(code[None], -other if mirrored else other, width_deg)[0].max()
    return len(code) + len(other) - 2.0 * float(overlap)


def dots_apart_turned(ring: Ring) -> float:
    """Return the least distance of a code to itself rotated by a dot's width or more, in dots."""
    code = np.array(ring.code_deg)
    overlap = _turned_overlap(code[None], 2.0 * ring.dot_half_angle_deg)[0]
    return 2.0 * (len(code) - float(overlap))


def least_apart(rings: Sequence[Ring]) -> float:
    """Return the least distance of any code to itself rotated, and to others of its shape."""
    distances = [dots_apart_turned(ring) for ring in rings]
    for first, second in itertools.combinations(rings, 2):
        if same_shape(first, second):
            distances += [dots_apart(first, second, mirrored=m) for m in (False, True)]
    return min(distances)


def check_new_codes(new: Sequence[Target], known: Sequence[Target]) -> None:
    """Refuse new targets whose codes could be confused, with each other or with known ones.

    Raises
    ------
    SettingError
        If `check_targets` refuses them, or if a new code is closer than `LEAST_DISTANCE` dots to
        itself rotated or to another code, rotated or mirrored.
    """
    check_targets((*known, *new))
    for target in new:
        if (apart := dots_apart_turned(target.ring)) < LEAST_DISTANCE:
            raise _confusable(target.ring, "itself, turned", apart)
    pairs = (
        *itertools.combinations(new, 2),
        *((target, other) for target in new for other in known),
    )
    for (target, other), mirrored in itertools.product(pairs, (False, True)):
        if not same_shape(target.ring, other.ring):
            continue
        apart = dots_apart(target.ring, other.ring, mirrored=mirrored)
        if apart < LEAST_DISTANCE:
            which = f"that of {other.name!r}{', seen from behind' if mirrored else ''}"
            raise _confusable(target.ring, which, apart)


def _confusable(ring: Ring, other: str, apart: float) -> SettingError:
    return SettingError(
        "code_deg",
        f"the code of {ring.name!r} is only {apart:.1f} dots away from {other}",
        f"give one that is at least {LEAST_DISTANCE:g} dots away, or have one proposed",
    )


def propose_codes(
    ring: Ring, count: int, dots: int, known: Sequence[Ring] = ()
) -> tuple[tuple[float, ...], ...]:
    """Return codes with a large least distance to themselves, each other and known ones.

    Candidates are all codes on a grid with ink between the dots. Each search starts with one of the
    best candidates, and adds the candidate that is farthest from all chosen ones. Then chosen codes
    are exchanged for better ones as long as possible. The best of several searches is returned; it
    need not be the optimum.

    Parameters
    ----------
    ring : Ring
        Ring with the wanted proportions; its code is ignored.
    count, dots : int
        Number of codes, and of dots in each.
    known : sequence of Ring
        Rings of this shape that are already in use.

    Raises
    ------
    SettingError
        If so many codes could be confused with each other.
    """
    require_range("dots", dots, *DOTS)
    if not len(_candidates(dots, 2.0 * ring.dot_half_angle_deg, _GRID_DEG)):
        raise SettingError(
            "dots", f"{dots} of this size do not fit on the code circle", "ask for fewer"
        )
    codes, least = _farthest_codes(ring, count, dots, known, _GRID_DEG, _STARTS)
    coarse = next((step for step in _COARSE_GRIDS_DEG if step > ring.dot_half_angle_deg), None)
    if least < LEAST_DISTANCE and coarse is not None:
        codes, least = max(
            (codes, least),
            _farthest_codes(ring, count, dots, known, coarse, _COARSE_STARTS),
            key=itemgetter(1),
        )
    if least < LEAST_DISTANCE:
        raise SettingError(
            "new",
            f"the best {count} codes of {dots} dots are only {least:.1f} dots apart",
            "ask for fewer codes or for more dots",
        )
    return codes


def _farthest_codes(
    ring: Ring, count: int, dots: int, known: Sequence[Ring], grid_deg: float, starts: int
) -> tuple[tuple[tuple[float, ...], ...], float]:
    """Return codes on one grid that are far apart, and their least distance; 0 without codes.

    The distance of codes that `check_targets` does not distinguish counts as zero. Each of their
    dots may differ by half a dot, which can add up to more than `LEAST_DISTANCE`.
    """
    width_deg = 2.0 * ring.dot_half_angle_deg
    candidates = _candidates(dots, width_deg, grid_deg)
    own = 2.0 * (dots - _turned_overlap(candidates, width_deg))
    for other in known:
        code = np.array(other.code_deg)
        half_deg = min(ring.dot_half_angle_deg, other.dot_half_angle_deg)
        own = np.minimum(own, _apart(candidates, code, width_deg))
        own[rotations_coincide(candidates, code, half_deg)] = 0.0
    best = np.argsort(-own, kind="stable")[:_MAX_CANDIDATES]
    field = _Candidates(candidates[best], own[best], width_deg, grid_deg, {})
    first = range(0, min(len(best), starts * _STRIDE), _STRIDE)
    results = [_search(field, start, count) for start in first]
    chosen, least = max(results, key=itemgetter(1), default=([], 0.0))
    if len(set(chosen)) < count:
        return (), 0.0
    return tuple(tuple(map(float, field.codes[index])) for index in sorted(chosen)), least


def _candidates(dots: int, width_deg: float, grid_deg: float) -> FloatArray:
    """Return the codes (m, dots) on a grid, once per rotation, the first dot at 0 [deg]."""
    steps = round(360.0 / grid_deg)
    least = math.ceil(_MIN_SPACING * width_deg / grid_deg)
    free = steps - dots * least  # to be distributed among the gaps
    if free < 0:
        return np.empty((0, dots))
    bars = np.array(list(itertools.combinations(range(free + dots - 1), dots - 1)))
    ends = np.hstack((np.full((len(bars), 1), -1), bars, np.full((len(bars), 1), free + dots - 1)))
    gaps = least + np.diff(ends, axis=1) - 1
    turned = np.stack([_as_number(np.roll(gaps, turn, axis=1)) for turn in range(dots)])
    gaps = gaps[turned[0] == turned.min(axis=0)]
    starts = np.cumsum(gaps, axis=1)[:, :-1]
    return np.asarray(grid_deg * np.hstack((np.zeros((len(gaps), 1)), starts)))


def _as_number(gaps: np.ndarray[tuple[int, ...], np.dtype[np.int_]]) -> FloatArray:
    """Return each row of small integers (m, n) as one number that orders like the row."""
    return np.asarray(gaps @ 360.0 ** np.arange(gaps.shape[1])[::-1])


def _overlap(codes: FloatArray, other: FloatArray, width_deg: float) -> FloatArray:
    """Return the overlap of codes (m, n) with another one in dots, for rotations (m, k).

    The rotations are those that put some dot exactly onto another. The largest overlap is among
    them: with dots as arcs, overlap as a function of rotation is a sum of triangles, and has its
    maxima at their peaks.
    """
    between = other[None, None, :] - codes[:, :, None]
    turns = between.reshape(len(codes), 1, 1, -1)
    return np.asarray(_share(between[..., None] - turns, width_deg).sum(axis=(1, 2)))


def _share(off_deg: FloatArray, width_deg: float) -> FloatArray:
    """Return the overlap 0…1 of two dots with an angular offset along the code circle."""
    off_deg = np.abs((off_deg + 180.0) % 360.0 - 180.0)
    return np.asarray(np.maximum(1.0 - off_deg / width_deg, 0.0))


def _turned_overlap(codes: FloatArray, width_deg: float) -> FloatArray:
    """Return the largest overlap (m,) of codes with themselves rotated by a dot's width or more."""
    first, second = np.nonzero(~np.eye(codes.shape[1], dtype=bool))
    turns = codes[:, second] - codes[:, first]
    overlap = np.zeros(turns.shape)
    for i, j in itertools.product(range(codes.shape[1]), repeat=2):
        overlap += _share((codes[:, j] - codes[:, i])[:, None] - turns, width_deg)
    overlap[np.abs((turns + 180.0) % 360.0 - 180.0) < width_deg] = 0.0
    return np.asarray(overlap.max(axis=1, initial=0.0))  # a single dot has no such rotation


def _apart(codes: FloatArray, other: FloatArray, width_deg: float) -> FloatArray:
    """Return the least distances (m,) of codes to another over all rotations and mirror images."""
    overlap = np.maximum(
        _overlap(codes, other, width_deg).max(axis=1),
        _overlap(codes, -other, width_deg).max(axis=1),
    )
    return np.asarray(codes.shape[1] + len(other) - 2.0 * overlap)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Codes on a grid, with distances computed on demand."""

    codes: FloatArray  # (m, n): [deg]
    own: FloatArray  # (m,): least distances to themselves, rotated, and to known codes
    width_deg: float  # of a dot
    grid_deg: float  # step of the grid
    rows: dict[int, FloatArray]  # index of a candidate → distances (m,) of all to it

    def apart(self, index: int) -> FloatArray:
        """Return the distances (m,) of all candidates to one of them, as `_apart`, but faster.

        On the grid, the overlap of a dot with the other code is a table over places and rotations.
        """
        if index not in self.rows:
            places_deg = self.grid_deg * np.arange(round(360.0 / self.grid_deg))
            turned = places_deg[:, None] + places_deg
            overlap = np.zeros(len(self.codes))
            for other in (self.codes[index], -self.codes[index]):
                covered = sum(_share(turned - dot, self.width_deg) for dot in other)
                table = np.asarray(covered, dtype=np.float32)
                steps = np.rint(self.codes / self.grid_deg).astype(int)
                by_turn = sum(table[column] for column in steps.T)
                overlap = np.maximum(overlap, np.max(by_turn, axis=1))
            distances = 2.0 * (self.codes.shape[1] - overlap)
            same = rotations_coincide(self.codes, self.codes[index], 0.5 * self.width_deg)
            self.rows[index] = np.where(same, 0.0, distances)
        return self.rows[index]


def _search(field: _Candidates, start: int, count: int) -> tuple[list[int], float]:
    """Choose `count` candidates that are far apart; return them and their least distance."""
    chosen = [start]
    least = np.minimum(field.own, field.apart(start))
    while len(chosen) < count:
        chosen.append(int(least.argmax()))
        least = np.minimum(least, field.apart(chosen[-1]))
    # distances of all candidates to the chosen ones, and a last row of infinities
    rows = np.array([*map(field.apart, chosen), np.full(len(least), np.inf)])
    is_better = True
    while is_better:
        is_better = False
        nearest, second = np.partition(rows, 1, axis=0)[:2]
        for place, held in enumerate(chosen):
            without = np.minimum(field.own, np.where(rows[place] == nearest, second, nearest))
            best = int(without.argmax())
            if without[best] > without[held] + _MIN_GAIN:
                chosen[place], rows[place], is_better = best, field.apart(best), True
                nearest, second = np.partition(rows, 1, axis=0)[:2]
    between = rows[:-1, chosen]
    np.fill_diagonal(between, np.inf)
    return chosen, float(min(field.own[chosen].min(), between.min()))


def chosen_targets(known: Sequence[_Kind], names: Sequence[str]) -> tuple[_Kind, ...]:
    """Return the targets with these names, or all if there are no names.

    Raises
    ------
    SettingError
        For a name that no target has.
    """
    listed = [target.name for target in known]
    for name in names:
        if name not in listed:
            problem = f"{name!r} is not in flight.toml"
            raise SettingError("target", problem, f"give one of {', '.join(listed)}")
    return tuple(target for target in known if not names or target.name in names)


def new_targets(
    known: Sequence[Target],
    diameter_m: float | None,
    codes: Sequence[str],
    count: int,
    dots: int,
) -> tuple[Target, ...]:
    """Return new targets, first those with given codes, then those with proposed ones.

    Parameters
    ----------
    known : sequence of Target
        Targets from which the new ones must differ; the first one gives the proportions.
    diameter_m : float or None
        Outer diameter; None: that of the first known target.
    codes : sequence of str
        Directions of dots [deg], separated by commas.
    count, dots : int
        Number of codes to propose, and of dots in each.

    Raises
    ------
    SettingError
        If a code is invalid or could be confused, or the diameter is missing.
    """
    ring = _model(known, diameter_m)
    names = _free_names({ring.name for target in known for ring in target.rings})
    given = [Target(replace(ring, name=next(names), code_deg=_angles(code))) for code in codes]
    check_new_codes(given, known)
    if not count:
        return tuple(given)
    others = [target.ring for target in (*known, *given) if same_shape(target.ring, ring)]
    proposed = [
        Target(replace(ring, name=next(names), code_deg=code))
        for code in propose_codes(ring, count, dots, others)
    ]
    check_new_codes([*given, *proposed], known)
    return (*given, *proposed)


def _model(known: Sequence[Target], diameter_m: float | None) -> Ring:
    """Return a ring with the wanted size and proportions."""
    if known:
        first = known[0].ring
        scale = 1.0 if diameter_m is None else diameter_m / first.outer_diameter_m
    elif diameter_m is None:
        raise SettingError(
            "diameter", "is missing", "give it in metres, or name a FLIGHT to take it from"
        )
    else:
        first, scale = Ring("new", 1.0, _INNER, _CODE, _DOT, (0.0,)), diameter_m
    return replace(
        first,
        outer_diameter_m=_rounded(scale * first.outer_diameter_m),
        inner_diameter_m=_rounded(scale * first.inner_diameter_m),
        code_diameter_m=_rounded(scale * first.code_diameter_m),
        dot_diameter_m=_rounded(scale * first.dot_diameter_m),
        sd_outer_diameter_m=0.0,
    )


def _rounded(length_m: float) -> float:
    """Return a length rounded to micrometres, so that print and flight.toml agree exactly."""
    return round(length_m, 6)


def _free_names(taken: Collection[str]) -> Iterator[str]:
    numbers = itertools.count(1)
    return (name for name in (f"T{number}" for number in numbers) if name not in taken)


def _angles(code: str) -> tuple[float, ...]:
    try:
        angles = tuple(float(word) for word in code.split(","))
    except ValueError:
        angles = (math.nan,)
    if not all(map(math.isfinite, angles)):
        raise SettingError("code", f"{code!r} is not a list of angles", "give them as 0,43,78,180")
    return angles
