"""Sentences on what to change in flight.toml if vehicle and camera disagree."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.consistency import Consistency
from kgcp.quality.corrections import MAX_VARIANCE_FACTOR, Correction
from kgcp.quality.number_text import amount

_AXES = {"forward": 0, "right": 1, "down": 2}
_LIKE_DOWN = (
    "wrong heights of trajectory or reference poses look the same, and so do wrong fx, fy or"
    " diameters if all distances are similar"
)


def advice(consistency: Consistency, doubts: Sequence[Doubt]) -> tuple[str, ...]:
    """Return one line per correction to apply; none if vehicle and camera agree.

    These are the corrections that the doubts offer. Where none is offered, because corrections do
    not explain the disagreement, or because a doubt names a likelier cause, for which they would
    compensate, a single line says so.
    """
    if agrees(consistency):
        return ()
    offered = {doubt.remedy for doubt in doubts}
    lines = tuple(remedy for _, remedy in corrections(consistency) if remedy in offered)
    return lines or (f"{_difference(consistency)}, and {_why_no_correction(consistency)}",)


def _why_no_correction(consistency: Consistency) -> str:
    if is_explained(consistency):
        return "no correction is offered, because a doubt names a likelier cause"
    if consistency.estimate.variance_factor <= MAX_VARIANCE_FACTOR:
        return "only implausibly large corrections would explain it"
    ratio = math.sqrt(consistency.estimate.variance_factor)
    return (
        "no correction of lever arm, time, readout, boresight, diameter or focal length explains"
        f" it: even after corrections, residuals are {ratio:.1f} times their standard deviations"
    )


def agrees(consistency: Consistency) -> bool:
    """Tell whether vehicle and camera agree, so that no correction is due."""
    return is_explained(consistency) and not corrections(consistency)


def is_explained(consistency: Consistency) -> bool:
    """Tell whether credible corrections, or none at all, explain the disagreement."""
    due = [each for each in consistency.estimate.corrections if each.is_significant]
    is_credible = all(correction.is_credible for correction in due)
    return is_credible and consistency.estimate.variance_factor <= MAX_VARIANCE_FACTOR


def corrections(consistency: Consistency) -> tuple[tuple[str, str], ...]:
    """Return the sentence on the disagreement and the remedy, for each correction that is due.

    A correction is due if it is significant and larger than the standard deviation that flight.toml
    states.
    """
    due = [
        correction
        for correction in consistency.estimate.corrections
        if correction.is_significant
        and abs(correction.value or 0.0) > consistency.stated_sd.get(correction.name, 0.0)
    ]
    sentence = _difference(consistency)
    return tuple((sentence, _remedy_with_condition(correction)) for correction in due)


def _difference(consistency: Consistency) -> str:
    along, across, up = rms_m(consistency)
    return (
        f"vehicle and camera differ by {along:.3f} m along, {across:.3f} m across, {up:.3f} m up"
        " (RMS)"
    )


def rms_m(consistency: Consistency) -> tuple[float, float, float]:
    """Return the RMS of the offsets along, across and up, without outliers [m]."""
    kept = np.array(
        [
            discrepancy.offset_m
            for discrepancy in consistency.discrepancies
            if not discrepancy.is_outlier
        ]
    )
    along, across, up = np.sqrt(np.mean(kept**2, axis=0)).tolist()
    return along, across, up


def _remedy_with_condition(correction: Correction) -> str:
    text = _remedy(correction)
    if correction.tangled_with:
        others = " and ".join(correction.tangled_with)
        text += f"; this flight cannot tell it apart from {others}, which must be right"
    return text


def _remedy(correction: Correction) -> str:
    quantity, _, unit = correction.name.rpartition("_")
    change = f"{amount(correction.value or 0.0, correction.sd)} {unit}"
    if quantity == "time_offset":
        return f"add {change} to [vehicle] time_offset_s in flight.toml"
    if unit == "percent":
        keys = "fx and fy in [camera]" if quantity == "focal_length" else "diameters in [[target]]"
        return f"change {keys} by {change.replace('percent', '%')}, then run 'kgcp detect' again"
    if quantity == "readout":
        return f"add {change} to [camera] readout_s in flight.toml, then run 'kgcp detect' again"
    if quantity.startswith("lever_arm_"):
        axis = quantity.removeprefix("lever_arm_")
        text = f"add {change} to [vehicle] lever_arm_m[{_AXES[axis]}] ({axis}) in flight.toml"
        return f"{text}; {_LIKE_DOWN}" if axis == "down" else text
    axis = quantity.removeprefix("boresight_")
    return (
        "check that [reference] poses and [camera] come from the same adjustment: the images are"
        f" rotated by {change} about the camera's {axis} axis relative to the reference poses"
    )
