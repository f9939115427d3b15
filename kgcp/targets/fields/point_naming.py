"""Identification of discs in a field without a lattice: by codes around them, or by their places.

By places, a disc of the photograph and a neighbour are tried as every disc of the field with each
of its neighbours. The disc's ellipse gives the affine map from its plane up to rotation and scale,
and the neighbour gives these. The map predicts where other discs must be. The best guesses are
then extended step by step to more discs with a homography.
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

_SEEDS, _PARTNERS = 8, 4  # start discs in a photograph, and neighbours tried for each
_NEIGHBOURS = 8  # neighbours of each of the field's discs
_FLATNESS = 0.05  # largest height of neighbours above a disc's plane, relative to their distance
_TOLERANCE = 0.2  # position error of a disc, relative to the distance of its nearest neighbour
_MAX_GUESSES = 12  # guesses that are extended
_MIN_FOR_MAP = 5  # discs of a homography: one wrong disc of five does not fit unnoticed
_GROWTH = 1.6  # factor of the number of discs from step to step
# Smallest share of the field's discs that must agree: of those in view, and of all. Smaller shares
# may agree by chance.
_MIN_IN_VIEW, _MIN_OF_FIELD = 0.6, 0.25
# A naming is ambiguous if another one without common discs has more than this share of its discs.
_AMBIGUOUS_SHARE = 0.75


def name_by_codes(
    codes: Sequence[int | None], field: PointField, ring: CodeRing
) -> Naming | NamingProblem:
    """Identify the discs of a photograph by the codes that were read.

    A code that occurs twice in a photograph is ignored. If many do, there are two copies of the
    field, and it is unclear to which of them the other discs belong.
    """
    point_of = {
        ring.canonical(point.code): index
        for index, point in enumerate(field.points)
        if point.code is not None
    }
    counts = Counter(code for code in codes if code is not None and code in point_of)
    if sum(count > 1 for count in counts.values()) >= LEAST_POINTS:
        return NamingProblem.TWO_FIELDS
    named = [
        (disc, point_of[code])
        for disc, code in enumerate(codes)
        if code is not None and counts[code] == 1
    ]
    if len(named) < LEAST_POINTS:
        return NamingProblem.TOO_FEW
    disc, point = np.array(named).T
    return Naming(disc, point, len(named), is_symmetric=False)


def name_by_places(seen: SeenDiscs, field: PointField) -> Naming | NamingProblem:
    """Identify the discs of a photograph by their arrangement.

    Discs outside the plane in which most lie are left out.
    """
    if len(seen.centres) < LEAST_POINTS:
        return NamingProblem.TOO_FEW
    surroundings = _surroundings(field)
    guesses = sorted(
        (guess for seed in _seeds(seen) for guess in _guesses(seen, surroundings, seed)),
        key=lambda guess: -guess.score,
    )
    points_m, pitch_m = field.points_m(), field.pitch_m
    namings = [_extended(seen, points_m, pitch_m, guess) for guess in guesses[:_MAX_GUESSES]]
    namings = [naming for naming in namings if len(naming) >= LEAST_POINTS]
    if not namings:
        return NamingProblem.NO_LATTICE
    best = max(namings, key=len)
    for other in namings:
        shared = set(best.items()) & set(other.items())
        if not shared and len(other) > _AMBIGUOUS_SHARE * len(best):
            return NamingProblem.AMBIGUOUS
    disc, point = np.array(sorted(best.items())).T
    return Naming(disc, point, 0, is_symmetric=False)


@dataclass(frozen=True, slots=True, eq=False)
class _Surrounding:
    """A disc of the field with its neighbours in its plane, seen from one side."""

    point: int  # index in the field
    plane: FloatArray  # (2, 3): two axes in the disc's plane, oriented as in the image
    flat: ComplexArray  # (n,): neighbours' coordinates along these axes, x + iy [m]


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """A guess at the identity of one disc of a photograph, with the affine map of its plane."""

    score: float  # share of the neighbours that are where they must be
    point: int  # index in the field
    plane: FloatArray  # (2, 3): two axes in the disc's plane, oriented as in the image
    centre: FloatArray  # (2,) [px]
    px_per_m: FloatArray  # (2, 2): derivatives of pixels by coordinates along these axes


def _seeds(seen: SeenDiscs) -> list[int]:
    """Return the discs that are nearest to the middle of all."""
    distances = np.linalg.norm(seen.centres - np.median(seen.centres, axis=0), axis=1)
    return [int(disc) for disc in np.argsort(distances, kind="stable")[:_SEEDS]]


def _surroundings(field: PointField) -> list[tuple[_Surrounding, _Surrounding]]:
    """Return each disc that has neighbours in its plane, seen from both sides."""
    points, gaps = field.points_m(), gaps_between(field.points_m())
    surroundings = []
    for point, normal in enumerate(field.normals()):
        around = np.argsort(gaps[point], kind="stable")[:_NEIGHBOURS]
        offsets = points[around] - points[point]
        is_flat = np.abs(offsets @ normal) < _FLATNESS * gaps[point, around]
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
    # in the affine frame in which the disc is a unit circle
    steps = (seen.centres - seen.centres[seed]) @ np.linalg.inv(stretch).T
    distances = np.linalg.norm(steps, axis=1)
    near = np.argsort(distances, kind="stable")[1 : 2 * _NEIGHBOURS + 1]
    targets = steps[near] @ (1.0, 1j)  # as complex numbers: rotation and scale are products
    guesses = []
    for sides in surroundings:
        best: _Guess | None = None
        for side in sides:
            factors = targets[:_PARTNERS, None] / side.flat  # rotation and scale
            predicted = factors[:, :, None] * side.flat  # (partner, its neighbour, all neighbours)
            misses = np.abs(predicted[..., None] - targets).min(axis=3)
            nearest = np.abs(predicted).min(axis=2)
            scores = np.mean(misses < _TOLERANCE * nearest[..., None], axis=2).ravel()
            top = int(scores.argmax())
            if best is None or scores[top] > best.score:
                factor = factors.ravel()[top]
                similarity = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
                px_per_m = stretch @ similarity
                best = _Guess(
                    float(scores[top]), side.point, side.plane, seen.centres[seed], px_per_m
                )
        if best is not None:
            guesses.append(best)
    return guesses


def _plane(normal: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) perpendicular to a normal and to each other."""
    helper = np.eye(3)[int(np.abs(normal).argmin())]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return np.stack((first, np.cross(normal, first)))


def _extended(
    seen: SeenDiscs, points_m: FloatArray, pitch_m: float, guess: _Guess
) -> dict[int, int]:
    """Extend a guess to other discs; return disc of the photograph → point, empty if it fails.

    The map of the first disc's plane is fitted to more discs step by step, up to all discs of the
    field near this plane.
    """
    offsets = points_m - points_m[guess.point]
    distances = np.linalg.norm(offsets, axis=1)
    height = np.abs(offsets @ np.cross(guess.plane[0], guess.plane[1]))
    flat = offsets @ guess.plane.T
    candidates = np.flatnonzero(height <= _FLATNESS * np.maximum(distances, pitch_m))
    order = candidates[np.argsort(distances[candidates], kind="stable")]
    homography = np.eye(3)
    homography[:2, :2], homography[:2, 2] = guess.px_per_m, guess.centre
    count = min(_NEIGHBOURS + 1, len(order))
    while True:
        chosen = order[:count]
        disc, index = _matched(seen, mapped(homography, flat[chosen]))
        if len(disc) < _MIN_FOR_MAP:
            return {}
        point = chosen[index]
        homography = homography_between(flat[point], seen.centres[disc])
        if count == len(order):
            in_view = _in_view(seen, mapped(homography, flat[order]))
            if len(disc) < max(_MIN_IN_VIEW * in_view, _MIN_OF_FIELD * len(order)):
                return {}  # may agree by chance
            return dict(zip(disc.tolist(), point.tolist(), strict=True))
        count = min(int(_GROWTH * count) + 1, len(order))


def _in_view(seen: SeenDiscs, places: FloatArray) -> int:
    """Return how many places (n, 2) are within the bounds of the visible discs."""
    low, high = seen.centres.min(axis=0), seen.centres.max(axis=0)
    return int(np.count_nonzero(np.all((places >= low) & (places <= high), axis=1)))


def _matched(seen: SeenDiscs, places: FloatArray) -> tuple[IndexArray, IndexArray]:
    """Return the discs that match predicted places (n, 2), and the indices of these places."""
    spacing = gaps_between(places).min(axis=1)
    offsets_x, offsets_y = places.T[:, :, None] - seen.centres.T[:, None]
    gaps = np.sqrt(offsets_x**2 + offsets_y**2)
    nearest, owner = gaps.argmin(axis=1), gaps.argmin(axis=0)
    index = np.arange(len(places))
    is_matched = (gaps[index, nearest] < _TOLERANCE * spacing) & (owner[nearest] == index)
    return nearest[is_matched], index[is_matched]
