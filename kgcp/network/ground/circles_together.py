"""Several circles in space placed together, from frames that share their errors.

Errors of the exterior orientations beyond the stated ones show in the residuals of all circles, and
are estimated from them. A circle that was moved meanwhile must not contribute, and must not be
placed in between.
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

_MAX_NOISE_ROUNDS = 6  # rounds of estimating the noise and rejecting frames with it
_SETTLED_NOISE = 0.1  # relative change of a standard deviation between two rounds
# A circle stands apart if its noise is larger than that of the median circle by this factor: it was
# moved, or something else was taken for it. Errors of poses are similar for all circles. At least
# this many circles are needed for a median.
_APART_RATIO, _MIN_CIRCLES = 4.0, 3
# The splits of two circles are the same if at least this share of their common frames are on the
# same side of both, and if the offsets differ by at most this share of the larger one. The second
# limit is wide because images hardly show an offset along the rays.
_MIN_SAME_SIDE, _MAX_OFFSET_DIFFERENCE = 0.8, 0.75
# Largest step of reference poses beyond their stated errors [m]. Without fixed ambiguities they
# change by decimetres, and half a degree of attitude is 0.26 m at 30 m.
_MAX_POSE_STEP_M = 0.3
# One of two circles can stand apart only if each is in at least this many frames. With eight, their
# variances differ 16-fold by chance once in 70 000 flights.
_MIN_FRAMES_OF_TWO = 8
_MAX_FACTOR = 10.0  # largest variance factor that is accepted with the estimated noise
_AGREEING_FACTOR = 3.0  # the same for frames that agree; three exceed it by chance once in 700
_DRAWS = 40  # of three frames: if 60 % of the frames are right, a draw is in 99.9 % of the cases


class MovedCircleError(NoCircleError):
    """A circle was moved, and no place is shown by more than half of its frames."""

    def __init__(self, move: Split) -> None:
        super().__init__("no more than half of the frames show one place")
        self.move = move


def place_circles(
    camera: Camera, many: Sequence[CircleViews]
) -> tuple[list[PlacedCircle | NoCircleError], ExtraNoise]:
    """Place several circles with the noise that their residuals show together.

    The frames before and after some moment may show two places of a circle. If it was moved, it is
    placed from the side with more frames. If all circles seem to move alike, the poses stepped; for
    a single circle, this cannot be decided. In these cases all frames are used.

    A circle with far larger residuals than the others gets its own noise, and does not contribute
    to that of the others. A circle with contradictory residuals may be left although none stands
    apart, for example with only two circles. It is placed from the majority of its frames, or else
    gets its own noise.

    Parameters
    ----------
    many : sequence of CircleViews
        The frames of each circle are in the order in which they were taken.

    Returns
    -------
    placed : list of PlacedCircle or NoCircleError
        In the circles' order; a `MovedCircleError` if no place is shown by more than half of the
        frames.
    noise : ExtraNoise
        Noise added to the stated covariances of circles that do not stand apart.
    """
    sides = [np.ones(len(views), dtype=np.bool_) for views in many]
    moves: dict[int, Split] = {}
    while True:
        chosen = [views.chosen(side) for views, side in zip(many, sides, strict=True)]
        outcomes, noise = _with_common_noise(camera, chosen)
        next_moves, steps = _moves_and_steps(camera, chosen, outcomes)
        if not next_moves:
            break
        for index, split in next_moves.items():
            frames = np.flatnonzero(sides[index])
            larger = split.larger_side(len(frames))
            sides[index][frames[~larger]] = False
            moves.setdefault(index, replace(split, first=int(frames[split.first])))
    for index, move in moves.items():
        outcome = outcomes[index]
        if isinstance(outcome, PlacedCircle):
            fit = seen_in(camera, many[index], outcome, sides[index])
            is_majority = 2 * np.count_nonzero(fit.is_used) > len(many[index])
            moved = replace(outcome, fit=fit, move=move)
            outcomes[index] = moved if is_majority else MovedCircleError(move)
    for index, split in steps.items():
        if index not in moves:
            outcomes[index] = _by_both_sides(camera, many[index], outcomes[index], split)
    return outcomes, noise


def _by_both_sides(
    camera: Camera, views: CircleViews, outcome: PlacedCircle | NoCircleError, split: Split
) -> PlacedCircle | NoCircleError:
    """Place a circle from the frames before and after a step of the poses.

    The noise of its places is at least half of the step.
    """
    if isinstance(outcome, NoCircleError) or outcome.has_own_noise:
        return outcome
    off_m = float(np.linalg.norm(split.off_m))
    sights_m = np.linalg.norm(outcome.fit.circle.centre_m - views.camera_m, axis=1)
    half_px = 0.5 * camera.fx * off_m / float(np.median(sights_m))
    noise = replace(outcome.noise, centre_px=max(outcome.noise.centre_px, half_px))
    again = _attempt(camera, views, noise)
    if isinstance(again, NoCircleError):
        return again
    return replace(again, step=split)


def _moves_and_steps(
    camera: Camera,
    many: Sequence[CircleViews],
    outcomes: Sequence[PlacedCircle | NoCircleError],
) -> tuple[dict[int, Split], dict[int, Split]]:
    """Return the splits by moves of circles, and those that steps of the poses may have caused.

    Correlated errors of the poses seem to move all circles. Therefore a circle counts as moved only
    if it gains far more by a second place than most, and if the others do not seem to move alike.
    For a single circle, moves and steps are distinguished only by size: poses make no large steps.
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
    if len(splits) >= _MIN_CIRCLES:
        limit = max(1.0, _APART_RATIO * float(np.median([split.gain for split in splits.values()])))
    significant = {index: split for index, split in splits.items() if split.gain > 1.0}
    moved = {
        index: split
        for index, split in significant.items()
        if split.gain > limit and not _is_by_poses(index, many, splits)
    }
    unmoved = {index: split for index, split in splits.items() if index not in moved}
    step_count = sum(index in significant for index in unmoved)
    if not step_count or 2 * step_count < len(unmoved):
        return moved, {}
    return moved, {
        index: split for index, split in unmoved.items() if _APART_RATIO * split.gain > 1.0
    }


def _is_by_poses(index: int, many: Sequence[CircleViews], splits: Mapping[int, Split]) -> bool:
    """Tell whether poses may explain a split.

    They may if at least half of the other circles have the same split. Without other circles, they
    may if the offset is no larger than a step of poses.
    """
    split = splits[index]
    if len(splits) == 1:
        return float(np.linalg.norm(split.off_m)) < _MAX_POSE_STEP_M
    same_count = sum(
        _is_same_split(many[index], split, many[other], splits[other])
        for other in splits
        if other != index
    )
    return 2 * same_count >= len(splits) - 1


def _is_same_split(views: CircleViews, split: Split, others: CircleViews, other: Split) -> bool:
    """Tell whether two circles seem to move at nearly the same frame by nearly the same offset."""
    rows = {frame: row for row, frame in enumerate(others.frame_keys)}
    same_side = [
        (row >= split.first) == (rows[frame] >= other.first)
        for row, frame in enumerate(views.frame_keys)
        if frame in rows
    ]
    if (
        not same_side
        or np.mean(same_side) < _MIN_SAME_SIDE
        or split.gain > _APART_RATIO * other.gain
    ):
        return False
    largest_m = max(np.linalg.norm(split.off_m), np.linalg.norm(other.off_m))
    return bool(np.linalg.norm(split.off_m - other.off_m) <= _MAX_OFFSET_DIFFERENCE * largest_m)


def _with_common_noise(
    camera: Camera, many: Sequence[CircleViews]
) -> tuple[list[PlacedCircle | NoCircleError], ExtraNoise]:
    """Place several circles with the noise that their residuals show together."""
    noise, own_noise = ExtraNoise(), dict[int, ExtraNoise]()
    used = [noise] * len(many)
    outcomes = [_attempt(camera, views, noise) for views in many]
    for _ in range(_MAX_NOISE_ROUNDS):
        noise, own_noise = _noise_of_all(camera, many, outcomes)
        is_settled = True
        for index, views in enumerate(many):
            if not _is_same_noise(used[index], own_noise.get(index, noise)):
                used[index] = own_noise.get(index, noise)
                outcomes[index] = _attempt(camera, views, used[index])
                is_settled = False
        if is_settled:
            break
    for index, (views, outcome) in enumerate(zip(many, outcomes, strict=True)):
        if not isinstance(outcome, PlacedCircle):
            continue
        if index in own_noise or outcome.fit.variance_factor > _MAX_FACTOR:
            outcomes[index] = _by_majority(camera, views, noise) or _with_own_noise(
                camera, views, outcome
            )
    return outcomes, noise


def _with_own_noise(
    camera: Camera, views: CircleViews, outcome: PlacedCircle
) -> PlacedCircle | NoCircleError:
    """Place a circle from all frames, with the noise that its own residuals show."""
    if outcome.fit.variance_factor > _MAX_FACTOR:
        again = _attempt(camera, views, extra_noise(camera, [(views, outcome.fit)]))
        if isinstance(again, NoCircleError):
            return again
        outcome = again
    return replace(outcome, has_own_noise=True)


def _by_majority(camera: Camera, views: CircleViews, noise: ExtraNoise) -> PlacedCircle | None:
    """Place a circle from a majority of frames that agree; None if there is no majority.

    Each start is a circle from three random frames. If a circle was moved, a start from all frames
    would lie between its places.
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
    """Return the noise that circles show together, and that of each circle that stands apart."""
    pairs = {
        index: (views, outcome.fit)
        for index, (views, outcome) in enumerate(zip(many, outcomes, strict=True))
        if isinstance(outcome, PlacedCircle)
    }
    if not pairs:
        return ExtraNoise(), {}
    own_noise = {index: extra_noise(camera, [pair]) for index, pair in pairs.items()}
    apart = _circles_apart(
        {index: _place_sd_px(pairs[index][0], own_noise[index]) for index in pairs},
        min(int(np.count_nonzero(fit.is_used)) for _, fit in pairs.values()),
    )
    common = extra_noise(camera, [pair for index, pair in pairs.items() if index not in apart])
    return common, {index: own_noise[index] for index in apart}


def _circles_apart(sds_px: Mapping[int, float], frames: int) -> set[int]:
    """Return the circles whose images are far noisier than those of most.

    Of two circles it is the worse one, if both are in enough frames to know their noise.
    """
    if len(sds_px) == 2 and frames >= _MIN_FRAMES_OF_TWO:
        best, worst = sorted(sds_px, key=lambda index: sds_px[index])
        return {worst} if sds_px[worst] > _APART_RATIO * sds_px[best] else set()
    if len(sds_px) < _MIN_CIRCLES:
        return set()
    limit_px = _APART_RATIO * float(np.median(list(sds_px.values())))
    apart = {index for index, px in sds_px.items() if px > limit_px}
    return apart if 2 * len(apart) < len(sds_px) else set()


def _place_sd_px(views: CircleViews, noise: ExtraNoise) -> float:
    """Return the standard deviation of a circle's places in its images, per coordinate [px]."""
    stated = 0.5 * float(np.median(np.trace(views.cov[:, :2, :2], axis1=1, axis2=2)))
    return math.sqrt(stated + noise.centre_px**2)


def _is_same_noise(first: ExtraNoise, second: ExtraNoise) -> bool:
    """Tell whether two noises are so similar that a new adjustment would change almost nothing."""
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
