"""What to change in flight.toml where vehicle and camera disagree, in words."""

from __future__ import annotations

import math

import numpy as np

from kgcp.quality.consistency import Consistency
from kgcp.quality.corrections import Correction
from kgcp.quality.number_text import amount

_EXPLAINED = 2.0  # χ² over its degrees of freedom that corrections may leave
_AXES = {"forward": 0, "right": 1, "down": 2}


def advice(consistency: Consistency) -> tuple[str, ...]:
    """Return one line per correction that is due; none where all is well.

    A correction is due where it is more than chance, and more than what flight.toml itself calls
    uncertain. It is offered only if the corrections together explain the disagreement; otherwise
    they mean nothing, and the line says so.
    """
    if is_explained(consistency):
        return tuple(remedy for _, remedy in corrections(consistency))
    along, across, up = rms_m(consistency)
    left = math.sqrt(consistency.estimate.variance_factor)
    line = (
        f"vehicle and camera differ by {along:.3f} m along, {across:.3f} m across and {up:.3f} m up"
        " (RMS), which no correction of lever arm, time, readout or boresight explains:"
        f" {left:.1f} times what the standard deviations say would be left"
    )
    return (line,)


def is_explained(consistency: Consistency) -> bool:
    """Tell whether the corrections, if any are due, explain the disagreement."""
    due = [each for each in consistency.estimate.corrections if each.is_significant]
    is_credible = all(correction.is_credible for correction in due)
    return is_credible and consistency.estimate.variance_factor <= _EXPLAINED


def corrections(consistency: Consistency) -> tuple[tuple[str, str], ...]:
    """Return what differs, and the remedy, for each correction that is due."""
    due = [
        correction
        for correction in consistency.estimate.corrections
        if correction.is_significant
        and abs(correction.value or 0.0) > consistency.stated_sd.get(correction.name, 0.0)
    ]
    along, across, up = rms_m(consistency)
    sentence = (
        f"vehicle and camera differ by {along:.3f} m along, {across:.3f} m across, {up:.3f} m up"
        " (RMS)"
    )
    return tuple((sentence, _line(correction)) for correction in due)


def rms_m(consistency: Consistency) -> tuple[float, float, float]:
    """Return the RMS of the offsets along, across and up, outliers left out [m]."""
    kept = np.array(
        [
            discrepancy.offset_m
            for discrepancy in consistency.discrepancies
            if not discrepancy.is_outlier
        ]
    )
    along, across, up = np.sqrt(np.mean(kept**2, axis=0)).tolist()
    return along, across, up


def _line(correction: Correction) -> str:
    text = _remedy(correction)
    if correction.tangled_with:
        others = " and ".join(correction.tangled_with)
        text += f"; only if {others} is right: this flight cannot tell them apart"
    return text


def _remedy(correction: Correction) -> str:
    quantity, _, unit = correction.name.rpartition("_")
    change = f"{amount(correction.value or 0.0, correction.sd)} {unit}"
    if quantity == "time_offset":
        return f"add {change} to [vehicle] time_offset_s in flight.toml"
    if quantity == "readout":
        return f"add {change} to [camera] readout_s in flight.toml"
    if quantity.startswith("lever_arm_"):
        axis = quantity.removeprefix("lever_arm_")
        return f"add {change} to [vehicle] lever_arm_m[{_AXES[axis]}] ({axis}) in flight.toml"
    axis = quantity.removeprefix("boresight_")
    return (
        f"the images are turned by {change} about the camera's {axis} axis against the reference"
        " poses: check that [reference] poses and [camera] are of the same adjustment"
    )
