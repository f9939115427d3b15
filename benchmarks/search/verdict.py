"""Comparison of a frame's measurements with its truth: what was found, missed and wrong."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.search.scene import Shot, radius_px, tilt_deg
from benchmarks.search.sets import FrameSet
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import image_heading_deg
from kgcp.measurement.records import Measurement, Miss, Outcome
from kgcp.simulation.scene import PlatePose

_Z95 = 1.959964
_MAX_CENTRE_PX, _MAX_CENTRE_SIGMAS, _MAX_DISTANCE, _MAX_HEADING_DEG = 1.0, 6.0, 0.02, 10.0
_NEAREST_PX = 3.0  # a measurement belongs to a plate within this distance, or half its radius


@dataclass(frozen=True, slots=True)
class FrameVerdict:
    """Result of the search in one frame.

    Attributes
    ----------
    wanted, found : int
        Number of plates that should be found, and that were measured well enough.
    decoys : int
        Number of plates that should not be found.
    missed, off, wrong : tuple of (word, text)
        Plates not measured, plates measured badly, and measurements of something else, each with
        its reason or kind and a description.
    """

    index: int
    wanted: int
    found: int
    decoys: int
    missed: tuple[tuple[str, str], ...]
    off: tuple[tuple[str, str], ...]
    wrong: tuple[tuple[str, str], ...]


@dataclass(slots=True)
class _Notes:
    missed: list[tuple[str, str]] = field(default_factory=list)
    off: list[tuple[str, str]] = field(default_factory=list)
    wrong: list[tuple[str, str]] = field(default_factory=list)


def judge_frame(index: int, shot: Shot, outcomes: Sequence[Outcome]) -> FrameVerdict:
    """Compare the outcomes of a frame with its plates.

    A plate is found if it is measured under its name with the centre within one pixel or six
    reported standard deviations, the distance within 2 % and the heading within ten degrees. It is
    `off` if it is measured less accurately. A measurement is `wrong` if it belongs to no plate of
    its name, because it is farther from all of them than three pixels and half their radius, or if
    it is the second one of a plate.
    """
    left = [outcome for outcome in outcomes if isinstance(outcome, Measurement)]
    notes = _Notes()
    for placed in shot.wanted:
        observation = _nearest(shot.camera, placed, left)
        words = f"{describe(shot, placed)}"
        if observation is None:
            notes.missed.append(_miss_of(placed, outcomes, words))
            continue
        left.remove(observation)
        problems = "; ".join(_problems(shot.camera, placed, observation))
        if problems:
            notes.off.append((observation.ring, f"{words}: {problems}"))
    notes.wrong += [_wrong(shot, observation) for observation in left]
    wanted = len(shot.wanted)
    found = wanted - len(notes.missed) - len(notes.off)
    return FrameVerdict(
        index,
        wanted,
        found,
        len(shot.decoys),
        tuple(notes.missed),
        tuple(notes.off),
        tuple(notes.wrong),
    )


def describe(shot: Shot, seen: PlatePose) -> str:
    """Return the position, size, tilt and light of a plate in the image, in words."""
    x, y = shot.camera.project(seen.pose.translation_m)
    return (
        f"{seen.plate.target.name} at ({x:.0f}, {y:.0f}) R {radius_px(shot.camera, seen):.1f} px"
        f" tilt {tilt_deg(seen.pose):.0f}° {shot.chain.name} gain {shot.gain:.2f}"
        f" blur {shot.optics.psf_px:.2f} px"
    )


def _distance_px(camera: Camera, seen: PlatePose, observation: Measurement) -> float:
    centre = camera.project(seen.pose.translation_m)
    return float(np.linalg.norm(observation.centre_px - centre))


def _nearest(camera: Camera, seen: PlatePose, left: list[Measurement]) -> Measurement | None:
    reach = max(_NEAREST_PX, 0.5 * radius_px(camera, seen))
    near = [
        (_distance_px(camera, seen, observation), i)
        for i, observation in enumerate(left)
        if observation.target == seen.plate.target.name
    ]
    near = [(distance, i) for distance, i in near if distance < reach]
    return left[min(near)[1]] if near else None


def _miss_of(seen: PlatePose, outcomes: Sequence[Outcome], words: str) -> tuple[str, str]:
    for outcome in outcomes:
        if isinstance(outcome, Miss) and outcome.target == seen.plate.target.name:
            score = "" if outcome.score is None else f" (score {outcome.score:.2f})"
            return outcome.reason.value, f"{words}: {outcome.detail}{score}"
    return "another_instance", f"{words}: only another one was measured"


def _problems(camera: Camera, seen: PlatePose, observation: Measurement) -> Iterator[str]:
    off_px, limit_px = _distance_px(camera, seen, observation), _MAX_CENTRE_PX
    if observation.uncertainty is not None:
        worst = float(np.linalg.eigvalsh(observation.uncertainty.centre_cov_px2)[-1])
        limit_px = max(limit_px, _MAX_CENTRE_SIGMAS * math.sqrt(max(worst, 0.0)))
    if off_px > limit_px:
        yield f"centre off by {off_px:.2f} px"
    ratio = observation.pose.distance_m / seen.pose.distance_m - 1.0
    if abs(ratio) > _MAX_DISTANCE:
        yield f"distance off by {ratio:+.1%}"
    turn = observation.heading_deg - image_heading_deg(camera, seen.pose)
    if abs((turn + 180.0) % 360.0 - 180.0) > _MAX_HEADING_DEG:
        yield f"heading off by {(turn + 180.0) % 360.0 - 180.0:+.0f}°"


def _wrong(shot: Shot, observation: Measurement) -> tuple[str, str]:
    x, y = observation.centre_px
    text = (
        f"{observation.target} by ring {observation.ring} at ({x:.1f}, {y:.1f}),"
        f" R {observation.appearance.radius_px:.1f} px, score {observation.score:.3f}"
    )
    plates = [(placed.plate.target.name, placed) for placed in shot.wanted] + list(shot.decoys)
    for kind, seen in plates:
        if _distance_px(shot.camera, seen, observation) < radius_px(shot.camera, seen):
            return kind, f"{text}; there is {kind}: {describe(shot, seen)}"
    return "nothing there", text


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return Wilson's interval of 95 % of a proportion; E. B. Wilson, JASA 22 (1927), 209–212."""
    if trials == 0:
        return 0.0, 1.0
    share, spread = successes / trials, _Z95**2 / trials
    middle = share + 0.5 * spread
    half = math.sqrt(share * (1.0 - share) * spread + 0.25 * spread**2)
    low, high = (middle - half) / (1.0 + spread), (middle + half) / (1.0 + spread)
    return max(0.0, low), min(1.0, high)


HEADER = (
    "set             frames   found/wanted      %   95 % interval   goal  off  wrong  decoys"
    "  not found by reason"
)


def table_line(frame_set: FrameSet, verdicts: Sequence[FrameVerdict]) -> str:
    """Return a set's line of the table."""
    wanted, found = sum(v.wanted for v in verdicts), sum(v.found for v in verdicts)
    off, wrong = sum(len(v.off) for v in verdicts), sum(len(v.wrong) for v in verdicts)
    low, high = wilson(found, wanted)
    shares = (
        f"{100.0 * found / wanted:6.1f}  {100.0 * low:5.1f} – {100.0 * high:5.1f}"
        if wanted
        else f"{'–':>6}  {'–':>13}"
    )
    goal = f"{100.0 * frame_set.goal:.0f}" if frame_set.goal is not None else "–"
    reasons = Counter(word for v in verdicts for word, _ in v.missed)
    counts = [f"{word} {n} ({n / wanted:.1%})" for word, n in reasons.most_common()]
    taken = Counter(kind for v in verdicts for kind, _ in v.wrong)
    counts += [f"wrong at {kind} {n}" for kind, n in taken.most_common()]
    return (
        f"{frame_set.name:14s}  {len(verdicts):6d}  {found:6d}/{wanted:<6d} {shares}  {goal:>5s}"
        f"  {off:3d}  {wrong:5d}  {sum(v.decoys for v in verdicts):6d}  {', '.join(counts)}"
    ).rstrip()


def failure_lines(
    frame_set: FrameSet, verdicts: Sequence[FrameVerdict], most: int
) -> Iterator[str]:
    """Yield all wrong and off measurements, and the first missed plates of every reason."""
    counts: Counter[str] = Counter()
    for verdict in verdicts:
        where = f"  {frame_set.name} {verdict.index}"
        yield from (f"{where}  WRONG {kind}: {text}" for kind, text in verdict.wrong)
        yield from (f"{where}  off by ring {ring}: {text}" for ring, text in verdict.off)
        for reason, text in verdict.missed:
            counts[reason] += 1
            if counts[reason] <= most:
                yield f"{where}  {reason}: {text}"
