"""Several circles in space placed together, from frames that share their errors.

What the exterior orientations lack, the residuals of all circles show. A circle that was moved
while it was photographed must not count among them, nor be placed between its places.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.network.ground.moved_circle import Split, best_split
from kgcp.network.ground.space_circle import CircleViews, ExtraNoise, NoCircleError
from kgcp.network.ground.target_plane import (
    REJECTED_CHI2,
    PlacedCircle,
    circle_through,
    extra_noise,
    fit_to_agreeing,
    place_circle,
    seen_in,
    total_covariances,
    without_other,
)

_EXTRA_ROUNDS = 6  # of noise and of frames that are left out because of it
_SETTLED_NOISE = 0.1  # change of a deviation between two rounds
# A circle whose images are off by so many times as much as the median circle's was moved, or others
# were taken for it. What poses lack, all circles have about alike.
_APART, _LEAST_CIRCLES = 4.0, 3
# Splits of two circles are alike if this share of the frames that show both are on the same sides,
# and if their offsets differ by no more than this share of the larger one: along the rays, images
# hardly show an offset.
_LEAST_SAME_SIDE, _MOST_UNLIKE = 0.8, 0.75
# A step larger than this is no error of poses that do not state it [m]: without fixed ambiguities
# they change by decimetres, and half a degree of attitude is 0.26 m at 30 m.
_MOST_STEP_M = 0.3
# Each of two circles must be seen in at least so many frames to stand apart: with eight, their
# variances differ 16-fold by chance once in 70 000 flights.
_FRAMES_OF_TWO = 8
_MOST_FACTOR = 10.0  # of the variance, that the estimated noise may leave
_AGREEING_FACTOR = 3.0  # of the frames that agree; three exceed it by chance once in 700
_DRAWS = 40  # of three frames: one of them is right in 99.9 % if 60 % of the frames are


class MovedCircleError(NoCircleError):
    """A circle was moved, and no more than half of its frames show one place."""

    def __init__(self, move: Split) -> None:
        super().__init__("no more than half of the frames show one place")
        self.move = move


def place_circles(
    camera: Camera, many: Sequence[CircleViews]
) -> tuple[list[PlacedCircle | NoCircleError], ExtraNoise]:
    """Place several circles, with the deviations that their residuals show together.

    A circle that was moved, as its frames before and after say, is placed by the side with more
    frames. If all seem to move alike, the poses did; of a single circle, it cannot be told: they
    are placed by the frames of both sides.

    One that stands apart by its residuals has deviations of its own, and no part in those of the
    others. One that its residuals contradict though none stands apart, as of two circles, is placed
    by most of its frames, or with deviations of its own.

    Parameters
    ----------
    many : sequence of CircleViews
        Each in the order in which its frames were taken.

    Returns
    -------
    placed : list of PlacedCircle or NoCircleError
        In the circles' order; a `MovedCircleError`, if no more than half of the frames show one
        place.
    noise : ExtraNoise
        What was added to the stated covariances of circles that do not stand apart.
    """
    sides = [np.ones(len(views), dtype=np.bool_) for views in many]
    moves: dict[int, Split] = {}
    while True:
        chosen = [views.chosen(side) for views, side in zip(many, sides, strict=True)]
        outcomes, noise = _with_common_noise(camera, chosen)
        found, steps = _splits(camera, chosen, outcomes)
        if not found:
            break
        for index, split in found.items():
            frames = np.flatnonzero(sides[index])
            larger = split.larger_side(len(frames))
            sides[index][frames[~larger]] = False
            moves.setdefault(index, replace(split, first=int(frames[split.first])))
    for index, move in moves.items():
        outcome = outcomes[index]
        if isinstance(outcome, PlacedCircle):
            fit = seen_in(camera, many[index], outcome, sides[index])
            is_most = 2 * np.count_nonzero(fit.is_used) > len(many[index])
            moved = replace(outcome, fit=fit, move=move)
            outcomes[index] = moved if is_most else MovedCircleError(move)
    for index, split in steps.items():
        if index not in moves:
            outcomes[index] = _by_both_sides(camera, many[index], outcomes[index], split)
    return outcomes, noise


def _by_both_sides(
    camera: Camera, views: CircleViews, outcome: PlacedCircle | NoCircleError, split: Split
) -> PlacedCircle | NoCircleError:
    """Place a circle between the places that the frames before and after a step of poses show."""
    if isinstance(outcome, NoCircleError) or outcome.is_apart:
        return outcome
    off_m = float(np.linalg.norm(split.off_m))
    sights_m = np.linalg.norm(outcome.fit.circle.centre_m - views.camera_m, axis=1)
    half_px = 0.5 * camera.fx * off_m / float(np.median(sights_m))
    noise = replace(outcome.noise, centre_px=max(outcome.noise.centre_px, half_px))
    again = _attempt(camera, views, noise)
    if isinstance(again, NoCircleError):
        return again
    return replace(again, step=split)


def _splits(
    camera: Camera,
    many: Sequence[CircleViews],
    outcomes: Sequence[PlacedCircle | NoCircleError],
) -> tuple[dict[int, Split], dict[int, Split]]:
    """Return the splits of the circles that were moved, and those that the poses may have made.

    Poses whose errors follow each other seem to move all circles: what most gain by a second place
    does not count, nor what others move by alike. A single circle does not tell a move from a step
    of the poses, but for one that is larger than those are.
    """
    splits = {}
    for index, (views, outcome) in enumerate(zip(many, outcomes, strict=True)):
        if isinstance(outcome, PlacedCircle):
            circle = outcome.fit.circle
            covs = total_covariances(camera, views, circle, ExtraNoise())[:, :2, :2]
            split = best_split(camera, views, circle, covs)
            if split is not None:
                splits[index] = split
    limit = 1.0
    if len(splits) >= _LEAST_CIRCLES:
        limit = max(1.0, _APART * float(np.median([split.gain for split in splits.values()])))
    found = {index: split for index, split in splits.items() if split.gain > 1.0}
    moved = {
        index: split
        for index, split in found.items()
        if split.gain > limit and not _is_of_poses(index, many, splits)
    }
    stay = {index: split for index, split in splits.items() if index not in moved}
    stepped = sum(index in found for index in stay)
    if not stepped or 2 * stepped < len(stay):
        return moved, {}
    return moved, {index: split for index, split in stay.items() if _APART * split.gain > 1.0}


def _is_of_poses(index: int, many: Sequence[CircleViews], splits: Mapping[int, Split]) -> bool:
    """Tell whether half of the other circles move alike, or a single one by what poses may."""
    split = splits[index]
    if len(splits) == 1:
        return float(np.linalg.norm(split.off_m)) < _MOST_STEP_M
    alike = sum(
        _is_same_split(many[index], split, many[other], splits[other])
        for other in splits
        if other != index
    )
    return 2 * alike >= len(splits) - 1


def _is_same_split(views: CircleViews, split: Split, others: CircleViews, other: Split) -> bool:
    """Tell whether two circles seem to move at nearly the same frame, and by nearly the same."""
    rows = {tuple(place): row for row, place in enumerate(others.camera_m.tolist())}
    same = [
        (row >= split.first) == (rows[tuple(place)] >= other.first)
        for row, place in enumerate(views.camera_m.tolist())
        if tuple(place) in rows
    ]
    if not same or np.mean(same) < _LEAST_SAME_SIDE or split.gain > _APART * other.gain:
        return False
    largest_m = max(np.linalg.norm(split.off_m), np.linalg.norm(other.off_m))
    return bool(np.linalg.norm(split.off_m - other.off_m) <= _MOST_UNLIKE * largest_m)


def _with_common_noise(
    camera: Camera, many: Sequence[CircleViews]
) -> tuple[list[PlacedCircle | NoCircleError], ExtraNoise]:
    """Place several circles, with the deviations that their residuals show together."""
    noise, own = ExtraNoise(), dict[int, ExtraNoise]()
    used = [noise] * len(many)
    outcomes = [_attempt(camera, views, noise) for views in many]
    for _ in range(_EXTRA_ROUNDS):
        noise, own = _noise_of_all(camera, many, outcomes)
        settled = True
        for index, views in enumerate(many):
            if not _is_alike(used[index], own.get(index, noise)):
                used[index] = own.get(index, noise)
                outcomes[index] = _attempt(camera, views, used[index])
                settled = False
        if settled:
            break
    for index, (views, outcome) in enumerate(zip(many, outcomes, strict=True)):
        if not isinstance(outcome, PlacedCircle):
            continue
        if index in own or outcome.fit.variance_factor > _MOST_FACTOR:
            outcomes[index] = _by_most_frames(camera, views, noise) or _by_own_noise(
                camera, views, outcome
            )
    return outcomes, noise


def _by_own_noise(
    camera: Camera, views: CircleViews, outcome: PlacedCircle
) -> PlacedCircle | NoCircleError:
    """Place a circle by all frames, with the deviations that its own residuals show."""
    if outcome.fit.variance_factor > _MOST_FACTOR:
        again = _attempt(camera, views, extra_noise(camera, [(views, outcome.fit)]))
        if isinstance(again, NoCircleError):
            return again
        outcome = again
    return replace(outcome, is_apart=True)


def _by_most_frames(camera: Camera, views: CircleViews, noise: ExtraNoise) -> PlacedCircle | None:
    """Place a circle by the frames that most agree with; None if no more than half agree.

    Three frames of an even draw give each start: where a circle was moved, a start by all frames
    leads to between its places.
    """
    rng = np.random.default_rng(0)
    for _ in range(_DRAWS):
        drawn = views.chosen(np.isin(np.arange(len(views)), rng.permutation(len(views))[:3]))
        try:
            start = circle_through(camera, drawn, noise)
        except NoCircleError:
            continue
        if start is None:
            continue
        fit = fit_to_agreeing(camera, views, start, noise)
        if fit is None or fit.variance_factor > _AGREEING_FACTOR:
            continue
        if 2 * np.count_nonzero(fit.chi2 <= REJECTED_CHI2) > len(views):
            return without_other(camera, views, fit, noise)
    return None


def _noise_of_all(
    camera: Camera, many: Sequence[CircleViews], outcomes: Sequence[PlacedCircle | NoCircleError]
) -> tuple[ExtraNoise, dict[int, ExtraNoise]]:
    """Return the deviations that circles show together, and those of circles that stand apart."""
    pairs = {
        index: (views, outcome.fit)
        for index, (views, outcome) in enumerate(zip(many, outcomes, strict=True))
        if isinstance(outcome, PlacedCircle)
    }
    if not pairs:
        return ExtraNoise(), {}
    own = {index: extra_noise(camera, [pair]) for index, pair in pairs.items()}
    apart = _apart(
        {index: _deviation_px(pairs[index][0], own[index]) for index in pairs},
        min(int(np.count_nonzero(fit.is_used)) for _, fit in pairs.values()),
    )
    common = extra_noise(camera, [pair for index, pair in pairs.items() if index not in apart])
    return common, {index: own[index] for index in apart}


def _apart(deviation_px: Mapping[int, float], frames: int) -> set[int]:
    """Return the circles whose images are off by far more than those of most.

    Of two circles the worse one, if both are seen in enough frames to know their deviations.
    """
    if len(deviation_px) == 2 and frames >= _FRAMES_OF_TWO:
        best, worst = sorted(deviation_px, key=lambda index: deviation_px[index])
        return {worst} if deviation_px[worst] > _APART * deviation_px[best] else set()
    if len(deviation_px) < _LEAST_CIRCLES:
        return set()
    limit_px = _APART * float(np.median(list(deviation_px.values())))
    apart = {index for index, px in deviation_px.items() if px > limit_px}
    return apart if 2 * len(apart) < len(deviation_px) else set()


def _deviation_px(views: CircleViews, noise: ExtraNoise) -> float:
    """Return the deviation of a circle's places in its images, per coordinate [px]."""
    stated = 0.5 * float(np.median(np.trace(views.cov[:, :2, :2], axis1=1, axis2=2)))
    return math.sqrt(stated + noise.centre_px**2)


def _is_alike(first: ExtraNoise, second: ExtraNoise) -> bool:
    """Tell whether another adjustment with this noise would change next to nothing."""
    return bool(
        np.allclose(
            (first.centre_px, first.outline_px, first.centre_factor, first.outline_factor),
            (second.centre_px, second.outline_px, second.centre_factor, second.outline_factor),
            rtol=_SETTLED_NOISE,
            atol=1e-4,
        )
    )


def _attempt(camera: Camera, views: CircleViews, noise: ExtraNoise) -> PlacedCircle | NoCircleError:
    """Return what `place_circle` returns or raises."""
    try:
        return place_circle(camera, views, noise)
    except NoCircleError as error:
        return error
