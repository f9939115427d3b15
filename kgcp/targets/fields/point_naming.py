"""Who is who in a field without a lattice: by the codes around its discs, or by their places.

By places, a disc and a neighbour of a photograph are tried as every disc of the field with each of
its neighbours. The ellipse of the disc gives the affine map from its plane, but for turn and scale,
which the neighbour tells. What other discs must then be where is looked up; the likeliest guesses
are followed, disc by disc, by a homography.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import ComplexArray, FloatArray, IndexArray
from kgcp.geometry.homography import homography_between, mapped
from kgcp.targets.fields.layout import LEAST_POINTS
from kgcp.targets.fields.naming import Naming, NamingProblem, SeenDiscs
from kgcp.targets.fields.points import CodeRing, PointField, gaps_between

_SEEDS, _PARTNERS = 8, 4  # discs of a photograph to begin with, and their neighbours
_NEIGHBOURS = 8  # of the field's discs
_FLAT = 0.05  # of a distance: how far neighbours may be from the plane of a disc
_TOLERANCE = 0.2  # of the distance of the nearest neighbour, where a disc must be
_FOLLOWED = 12  # guesses
_LEAST_FOR_MAP = 5  # discs, of which one may be wrong without being fitted
_GROWTH = 1.6  # times as far as the discs that are named by now
# Of the field's discs, what fewer may agree with by chance: of those in view, and of all.
_LEAST_SHARE, _LEAST_OF_FIELD = 0.6, 0.25
_CLEAR = 0.75  # of the discs that are named: another naming must have fewer


def name_by_codes(
    codes: Sequence[int | None], field: PointField, ring: CodeRing
) -> Naming | NamingProblem:
    """Return which disc of the field each disc of a photograph is, by codes as they were read.

    A code that stands twice in a photograph names none.
    """
    point_of = {
        ring.canonical(point.code): index
        for index, point in enumerate(field.points)
        if point.code is not None
    }
    counts = Counter(codes)
    named = [
        (disc, point_of[code])
        for disc, code in enumerate(codes)
        if code is not None and code in point_of and counts[code] == 1
    ]
    if len(named) < LEAST_POINTS:
        return NamingProblem.TOO_FEW
    disc, point = np.array(named).T
    return Naming(disc, point, len(named), is_symmetric=False)


def name_by_places(seen: SeenDiscs, field: PointField) -> Naming | NamingProblem:
    """Return which disc of the field each disc of a photograph is, by how they lie.

    Discs that do not lie in one plane with most are left out.
    """
    if len(seen.centres) < LEAST_POINTS:
        return NamingProblem.TOO_FEW
    surroundings = _surroundings(field)
    guesses = sorted(
        (guess for seed in _seeds(seen) for guess in _guesses(seen, surroundings, seed)),
        key=lambda guess: -guess.score,
    )
    points_m, pitch_m = field.points_m(), field.pitch_m
    namings = [_followed(seen, points_m, pitch_m, guess) for guess in guesses[:_FOLLOWED]]
    namings = [naming for naming in namings if len(naming) >= LEAST_POINTS]
    if not namings:
        return NamingProblem.NO_LATTICE
    best = max(namings, key=len)
    for other in namings:
        shared = set(best.items()) & set(other.items())
        if not shared and len(other) > _CLEAR * len(best):
            return NamingProblem.AMBIGUOUS
    disc, point = np.array(sorted(best.items())).T
    return Naming(disc, point, 0, is_symmetric=False)


@dataclass(frozen=True, slots=True, eq=False)
class _Surrounding:
    """A disc of the field, and where its neighbours are in its plane, from one side."""

    point: int  # of the field
    plane: FloatArray  # (2, 3): two directions of the disc's plane, as the image has them
    flat: ComplexArray  # (n,) [m]


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """A disc of a photograph as one of the field, and how the plane about it is seen."""

    score: float  # share of the neighbours that are where they must be
    point: int  # of the field
    plane: FloatArray  # (2, 3): two directions of the disc's plane, as the image has them
    centre: FloatArray  # (2,) [px]
    by_plane: FloatArray  # (2, 2): pixels by the plane's coordinates


def _seeds(seen: SeenDiscs) -> list[int]:
    """Return the discs that are nearest to the middle of all."""
    off = np.linalg.norm(seen.centres - np.median(seen.centres, axis=0), axis=1)
    return [int(disc) for disc in np.argsort(off, kind="stable")[:_SEEDS]]


def _surroundings(field: PointField) -> list[tuple[_Surrounding, _Surrounding]]:
    """Return each disc that has neighbours in its plane, seen from either side."""
    points, gaps = field.points_m(), gaps_between(field.points_m())
    surroundings = []
    for point, normal in enumerate(field.normals()):
        around = np.argsort(gaps[point], kind="stable")[:_NEIGHBOURS]
        offsets = points[around] - points[point]
        is_flat = np.abs(offsets @ normal) < _FLAT * gaps[point, around]
        if np.count_nonzero(is_flat) < 3:
            continue
        first, second = _plane(normal)
        front, back = np.stack((first, second)), np.stack((first, -second))
        surroundings.append(
            (
                _Surrounding(point, front, (offsets[is_flat] @ front.T) @ (1.0, 1j)),
                _Surrounding(point, back, (offsets[is_flat] @ back.T) @ (1.0, 1j)),
            )
        )
    return surroundings


def _guesses(
    seen: SeenDiscs, surroundings: Sequence[tuple[_Surrounding, _Surrounding]], seed: int
) -> list[_Guess]:
    """Return the best guess for each disc of the field that a disc of a photograph could be."""
    stretch = seen.stretches[seed]
    steps = (seen.centres - seen.centres[seed]) @ np.linalg.inv(stretch).T  # a circle's plane
    distances = np.linalg.norm(steps, axis=1)
    near = np.argsort(distances, kind="stable")[1 : 2 * _NEIGHBOURS + 1]
    targets = steps[near] @ (1.0, 1j)  # plane vectors as complex numbers: turns are products
    guesses = []
    for sides in surroundings:
        best: _Guess | None = None
        for side in sides:
            factors = targets[:_PARTNERS, None] / side.flat  # turn and scale
            turned = factors[:, :, None] * side.flat  # (partner, own neighbour, all)
            misses = np.abs(turned[..., None] - targets).min(axis=3)
            nearest = np.abs(turned).min(axis=2)
            scores = np.mean(misses < _TOLERANCE * nearest[..., None], axis=2).ravel()
            top = int(scores.argmax())
            if best is None or scores[top] > best.score:
                factor = factors.ravel()[top]
                turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
                by_plane = stretch @ turn
                best = _Guess(
                    float(scores[top]), side.point, side.plane, seen.centres[seed], by_plane
                )
        if best is not None:
            guesses.append(best)
    return guesses


def _plane(normal: FloatArray) -> FloatArray:
    """Return two perpendicular unit vectors (2, 3) square to another."""
    helper = np.eye(3)[int(np.abs(normal).argmin())]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return np.stack((first, np.cross(normal, first)))


def _followed(
    seen: SeenDiscs, points_m: FloatArray, pitch_m: float, guess: _Guess
) -> dict[int, int]:
    """Return which disc of the field each disc of a photograph is, by a guess for one of them.

    The map from the plane of that one is widened step by step, to all discs that are about in it.
    """
    offsets = points_m - points_m[guess.point]
    distances = np.linalg.norm(offsets, axis=1)
    height = np.abs(offsets @ np.cross(guess.plane[0], guess.plane[1]))
    flat = offsets @ guess.plane.T
    candidates = np.flatnonzero(height <= _FLAT * np.maximum(distances, pitch_m))
    order = candidates[np.argsort(distances[candidates], kind="stable")]
    homography = np.eye(3)
    homography[:2, :2], homography[:2, 2] = guess.by_plane, guess.centre
    count = min(_NEIGHBOURS + 1, len(order))
    while True:
        chosen = order[:count]
        disc, index = _matched(seen, mapped(homography, flat[chosen]))
        if len(disc) < _LEAST_FOR_MAP:
            return {}
        point = chosen[index]
        homography = homography_between(flat[point], seen.centres[disc])
        if count == len(order):
            in_view = _in_view(seen, mapped(homography, flat[order]))
            if len(disc) < max(_LEAST_SHARE * in_view, _LEAST_OF_FIELD * len(order)):
                return {}  # by chance
            return dict(zip(disc.tolist(), point.tolist(), strict=True))
        count = min(int(_GROWTH * count) + 1, len(order))


def _in_view(seen: SeenDiscs, places: FloatArray) -> int:
    """Return how many places (n, 2) are among those where discs are seen."""
    low, high = seen.centres.min(axis=0), seen.centres.max(axis=0)
    return int(np.count_nonzero(np.all((places >= low) & (places <= high), axis=1)))


def _matched(seen: SeenDiscs, places: FloatArray) -> tuple[IndexArray, IndexArray]:
    """Return the discs that are where some must be (n, 2), and which of these they are."""
    room = gaps_between(places).min(axis=1)
    offsets_x, offsets_y = places.T[:, :, None] - seen.centres.T[:, None]
    gaps = np.sqrt(offsets_x**2 + offsets_y**2)
    nearest, owner = gaps.argmin(axis=1), gaps.argmin(axis=0)
    index = np.arange(len(places))
    is_matched = (gaps[index, nearest] < _TOLERANCE * room) & (owner[nearest] == index)
    return nearest[is_matched], index[is_matched]
