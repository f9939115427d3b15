"""The verdict of the bias report: the grade, the reasons for it, and further remarks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from statistics import median

import numpy as np

from kgcp.quality.bias_causes import Term
from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.number_text import counted, rounded
from kgcp.report.bias.numbers import BIASED_SIGMAS, BiasNumbers, RangeRow
from kgcp.report.bias.reexposure import GAINS, Reexposed
from kgcp.report.bias.wording import (
    LABELS,
    effect_of_reference,
    exposure_sentence,
    meaning_of,
    sd_by_reference,
    signed_amount,
    value_of,
)


class FlightGrade(IntEnum):
    """Grade of a flight; the worst of all findings counts."""

    GOOD = 0
    LOOK = 1
    UNUSABLE = 2

    @property
    def words(self) -> str:
        """The grade, as the report prints it."""
        return ("Good", "Check the findings below", "Not usable as it is")[self]


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the grades."""

    min_frames: int = 10  # compared frames that the grade "good" requires
    unusable_rms_percent: float = 1.0  # of the errors; the paper has 1 % up to 100 m
    mean_percent: float = 0.02  # of a mean error that neither noise nor the reference explains
    # of a significant scale and offset that the reference does not explain
    scale_percent: float = 0.02
    offset_m: float = 0.01
    exposure_share: float = 0.1  # of the variance that exposure explains, if a term is significant
    reexposure_percent: float = 0.1  # RMS change of distances measured again, darker and brighter
    standardised_low: float = 0.5  # scatter of the fit's residuals over their reported sds
    standardised_high: float = 1.5
    lost_share: float = 0.05  # of measurements that are misplaced or outliers
    unusable_lost_share: float = 0.3
    detection_rate: float = 0.8  # of frames with the target fully in view


LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence of the verdict."""

    grade: FlightGrade  # that the flight gets; `GOOD`: the sentence only informs
    text: str
    section: str  # id of the section of the page that shows the numbers


@dataclass(frozen=True, slots=True)
class Verdict:
    """All findings, the most serious first."""

    findings: tuple[Finding, ...]

    @property
    def grade(self) -> FlightGrade:
        """The worst grade of the findings."""
        return max(finding.grade for finding in self.findings)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict as text, line by line."""
        return (f"{self.grade.words}.", *(finding.text for finding in self.findings))


def assess(
    numbers: BiasNumbers,
    reexposed: Sequence[Reexposed] = (),
    *,
    agrees: bool = True,
    doubts: Sequence[Doubt] = (),
) -> Verdict:
    """Judge a flight.

    Parameters
    ----------
    reexposed : sequence of Reexposed
        Distances of frames that were measured again.
    agrees : bool
        Whether vehicle and camera put the target at the same place.
    doubts : sequence of Doubt
        About the flight's inputs.
    """
    is_grave = any(doubt.is_grave for doubt in doubts)
    findings = [
        _accuracy(numbers),
        _bias(numbers),
        *_contradictions(doubts, agrees=agrees),
        # of wrong inputs they would only name consequences, with remedies that make it worse
        *([] if is_grave else [*_causes(numbers), *_scatter(numbers), *_attitudes(numbers)]),
        *_exclusions(numbers),
        *_reexposure(reexposed),
        *_detection(numbers),
        *_reservations(numbers),
    ]
    return Verdict(tuple(sorted(findings, key=lambda finding: -finding.grade)))


def _accuracy(numbers: BiasNumbers) -> Finding:
    count = numbers.total.percent.count
    parts = [f"{row.label} {_rms(row)}" for row in numbers.halves]
    text = f"Distance error (RMS) over {counted(count, 'frame')}: {'; '.join(parts)}."
    if numbers.total.percent.rms > LIMITS.unusable_rms_percent:
        return Finding(
            FlightGrade.UNUSABLE,
            f"{text} Over all distances it is above {LIMITS.unusable_rms_percent:g} %: something is"
            " wrong with target, camera, times, reference or exposure.",
            "error",
        )
    if count < LIMITS.min_frames:
        needed = f"The grade 'good' requires at least {LIMITS.min_frames} frames."
        return Finding(FlightGrade.LOOK, f"{text} {needed}", "error")
    return Finding(FlightGrade.GOOD, text, "error")


def _rms(row: RangeRow) -> str:
    frames = counted(row.percent.count, "frame")
    return f"{row.percent.rms:.3f} % ({1000.0 * row.metres.rms:.0f} mm, {frames})"


def _bias(numbers: BiasNumbers) -> Finding:
    if numbers.total.percent.count == 1:
        return Finding(FlightGrade.LOOK, "One frame is not enough to determine a bias.", "error")
    is_stated = numbers.total.sd_reference_percent is not None
    beyond = "noise and errors of the reference" if is_stated else "noise"
    if numbers.biased:
        material = any(abs(row.percent.mean) >= LIMITS.mean_percent for row in numbers.biased)
        text = f"Biased: measured distances are {_sides(numbers.biased)}."
        return Finding(FlightGrade.LOOK if material else FlightGrade.GOOD, text, "error")
    if numbers.biased_by_motion:
        text = (
            f"Measured distances are {_sides(numbers.biased_by_motion)}, more than {beyond}"
            " explain. The camera's motion while its frames are read out is unknown and may be the"
            " cause: give poses and times of frames that follow each other, the camera's rates, or"
            " a smaller motion_sd_deg_s if it hardly moves."
        )
        return Finding(FlightGrade.LOOK, text, "error")
    text = f"No bias beyond {beyond}: the mean error is {_mean(numbers.total)}."
    return Finding(FlightGrade.GOOD, text, "error")


def _sides(rows: Sequence[RangeRow]) -> str:
    """Return on which side the mean errors of ranges are, and their sizes."""
    sides = [(row, "long" if row.percent.mean > 0.0 else "short") for row in rows]
    return "; ".join(f"too {side} ({row.label}), on average by {_mean(row)}" for row, side in sides)


def _contradictions(doubts: Sequence[Doubt], *, agrees: bool) -> Iterator[Finding]:
    """Yield a finding if inputs contradict each other; distances may hardly show it."""
    if any(doubt.is_grave for doubt in doubts):
        text = (
            "The inputs raise a grave doubt: correct them first. The errors include its effect; the"
            " report names no other causes."
        )
        yield Finding(FlightGrade.LOOK, text, "consistency")
    elif not agrees:
        text = (
            "Vehicle and camera do not put the target at the same place: the points of 'kgcp"
            " export-gcp' may be wrong, even if the distances are right."
        )
        yield Finding(FlightGrade.LOOK, text, "consistency")
    elif doubts:
        text = f"The inputs raise {counted(len(doubts), 'doubt')}."
        yield Finding(FlightGrade.LOOK, text, "consistency")


def _mean(row: RangeRow) -> str:
    """Return a mean error with its noise and the errors that all frames may share."""
    text = signed_amount(row.percent.mean, row.percent.sd_mean, "%")
    shared = []
    if row.sd_reference_percent is not None:
        shared.append(f"the reference can cause ± {rounded(row.sd_reference_percent)} %")
    if row.sd_motion_percent:
        shared.append(f"unknown motion of the camera ± {rounded(row.sd_motion_percent)} %")
    return f"{text} ({', '.join(shared)})" if shared else text


def _causes(numbers: BiasNumbers) -> Iterator[Finding]:
    regression = numbers.regression
    if regression is None:
        text = "Scale and offset cannot be separated: too few frames, or distances too similar."
        yield Finding(FlightGrade.LOOK, text, "causes")
        return
    basic = [term for term in regression.terms if term.name in {"scale", "offset_m"}]
    found = [term for term in basic if _is_beyond_reference(term, numbers)]
    if not found:
        values = " and ".join(
            f"{LABELS[term.name]} {value_of(term)}{_possible(term, numbers)}" for term in basic
        )
        is_explained = any(term.is_significant for term in basic)
        what = "Not significant:"
        if is_explained:
            by_motion = " or unknown motion" if numbers.total.sd_motion_percent else ""
            what = f"Errors of the reference{by_motion} may explain"
        yield Finding(FlightGrade.GOOD, f"{what} {values}.", "causes")
    large = {"scale": 0.01 * LIMITS.scale_percent, "offset_m": LIMITS.offset_m}
    for term in regression.terms:
        if term in found:
            material = abs(term.value) >= large[term.name]
            text = meaning_of(term)
            possible = effect_of_reference(term, numbers)
            if possible is not None:
                text += f" Errors of the reference can cause {possible}."
            yield Finding(FlightGrade.LOOK if material else FlightGrade.GOOD, text, "causes")
        elif term.name == "edge_curvature_px2":
            yield Finding(FlightGrade.LOOK, meaning_of(term), "causes")
    material = (
        regression.is_exposure_significant and regression.exposure_share >= LIMITS.exposure_share
    )
    yield Finding(
        FlightGrade.LOOK if material else FlightGrade.GOOD,
        exposure_sentence(regression),
        "exposure",
    )


def _is_beyond_reference(term: Term, numbers: BiasNumbers) -> bool:
    """Whether neither noise nor errors of the reference nor unknown motion explain a term.

    Errors of a trajectory that last as long as the flight look like an offset, and leave no scatter
    by which the regression could tell.
    """
    motion = 0.01 * numbers.total.sd_motion_percent  # of the distances
    by_motion = {"scale": motion, "offset_m": motion * float(np.median(numbers.data.distance_m))}
    sd = math.hypot(term.sd, sd_by_reference(term, numbers) or 0.0, by_motion.get(term.name, 0.0))
    return term.is_significant and abs(term.value) > BIASED_SIGMAS * sd


def _possible(term: Term, numbers: BiasNumbers) -> str:
    possible = effect_of_reference(term, numbers)
    return "" if possible is None else f" (the reference can cause {possible})"


def _reexposure(reexposed: Sequence[Reexposed]) -> Iterator[Finding]:
    changes = [again.change_percent for again in reexposed if again.change_percent is not None]
    if not changes:
        return
    rms = math.hypot(*changes) / math.sqrt(len(changes))
    failed = len(reexposed) - len(changes)
    text = (
        f"If grey values are multiplied by {' and by '.join(f'{gain:g}' for gain in GAINS)},"
        f" distances change by {rms:.3f} % (RMS of {len(changes)}; not measured: {failed})."
    )
    grade = FlightGrade.LOOK if rms > LIMITS.reexposure_percent else FlightGrade.GOOD
    yield Finding(grade, text, "reexposure")


def _scatter(numbers: BiasNumbers) -> Iterator[Finding]:
    """Compare the scatter of the residuals with their reported standard deviations."""
    regression = numbers.regression
    if regression is None or numbers.standardised is None or numbers.sd_reference_m is None:
        return
    spread = regression.scatter
    if spread > LIMITS.standardised_high:
        yield Finding(
            FlightGrade.LOOK,
            f"Residuals scatter {spread:.1f} times as much as their reported standard deviations"
            " predict: lever arm or times may be wrong, the standard deviations of trajectory and"
            " reference poses too small, the ring not round, the plate not flat, or the distortion"
            " in [camera] wrong.",
            "standardised",
        )
    elif spread < LIMITS.standardised_low:
        yield Finding(
            FlightGrade.GOOD,
            f"Residuals scatter only {spread:.2f} times as much as their reported standard"
            " deviations predict: the standard deviations of trajectory and reference poses may be"
            " too large.",
            "standardised",
        )


def _exclusions(numbers: BiasNumbers) -> Iterator[Finding]:
    regression = numbers.regression
    outliers = 0 if regression is None else int(regression.outlier.sum())
    misplaced = len(numbers.misplaced)
    if not outliers + misplaced:
        return
    share = (outliers + misplaced) / (numbers.total.percent.count + misplaced)
    grade = FlightGrade.GOOD
    if share > LIMITS.unusable_lost_share:
        grade = FlightGrade.UNUSABLE
    elif share > LIMITS.lost_share:
        grade = FlightGrade.LOOK
    parts = []
    if misplaced:
        parts.append(
            f"Excluded from the statistics: {counted(misplaced, 'measurement')} away from"
            " the target's expected position"
        )
    if outliers:
        parts.append(
            f"Excluded from the regression: {counted(outliers, 'outlier')}, more than five"
            " standard deviations from it"
        )
    yield Finding(grade, f"{'. '.join(parts)}.", "worst")


def _detection(numbers: BiasNumbers) -> Iterator[Finding]:
    if not numbers.expected_visible:
        return
    share = numbers.detected / numbers.expected_visible
    kind = "the target fully in view" if numbers.attitudes_agree else "a reference pose"
    yield Finding(
        FlightGrade.GOOD if share >= LIMITS.detection_rate else FlightGrade.LOOK,
        f"Detected in {numbers.detected} of {numbers.expected_visible} frames with {kind}"
        f" ({100.0 * share:.1f} %).",
        "rate",
    )


def _reservations(numbers: BiasNumbers) -> Iterator[Finding]:
    """Yield the reservations against the numbers."""
    if numbers.sd_reference_m is not None:
        text = f"Reference distances are known to {rounded(1000.0 * numbers.sd_reference_m)} mm"
        sds_m = [
            pair.attempt.sighting.sd_distance_m
            for pair in numbers.compared
            if pair.attempt.sighting
        ]
        stated_m = [sd_m for sd_m in sds_m if sd_m is not None]
        if stated_m:
            text += f", measured ones to {rounded(1000.0 * median(stated_m))} mm"
        yield Finding(FlightGrade.GOOD, f"{text} (median standard deviations).", "error")


def _attitudes(numbers: BiasNumbers) -> Iterator[Finding]:
    if not numbers.attitudes_agree:
        yield Finding(
            FlightGrade.LOOK,
            "The reference attitudes do not agree with the measured points: check omega, phi,"
            " kappa. Distances do not depend on them.",
            "left-out",
        )
