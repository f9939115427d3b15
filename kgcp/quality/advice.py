"""What to change in flight.toml where vehicle and camera disagree, in words."""

from __future__ import annotations

import math

import numpy as np

from kgcp.quality.consistency import Consistency
from kgcp.quality.corrections import Correction
from kgcp.quality.number_text import amount

_UNEXPLAINED = 3.0  # χ² over its degrees of freedom: disagreement without a single culprit
_FARTHEST_M = 100.0  # what a second and some metres of lever arm make of a vehicle's place
_AXES = {"forward": 0, "right": 1, "down": 2}


def advice(consistency: Consistency) -> tuple[str, ...]:
    """Return one line per correction that is due; none where all is well.

    A correction is due where it is more than chance, and more than what flight.toml itself calls
    uncertain. Where maps or clocks do not belong together, corrections mean nothing.
    """
    distance_m = math.hypot(*rms_m(consistency))
    strange = [
        correction
        for correction in consistency.estimate.corrections
        if correction.is_significant and not correction.is_credible
    ]
    if strange or distance_m > _FARTHEST_M:
        return (_mismatch(distance_m),)
    lines = [
        _line(correction)
        for correction in consistency.estimate.corrections
        if correction.is_significant
        and abs(correction.value or 0.0) > consistency.stated_sd.get(correction.name, 0.0)
    ]
    factor = consistency.estimate.variance_factor
    if factor > _UNEXPLAINED:
        lines.append(
            f"vehicle and camera disagree {math.sqrt(factor):.1f} times as much as their standard"
            " deviations say, whatever is corrected: look at consistency.parquet for when, and"
            " check sd_x … of trajectory and reference poses"
        )
    return tuple(lines)


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


def _mismatch(distance_m: float) -> str:
    return (
        f"vehicle and camera put the target {distance_m:.0f} m apart, which no correction explains:"
        " check in flight.toml that [vehicle] crs and [reference] crs are those of the files, and"
        " that all times are of one clock (GPS time is 18 s ahead of UTC: [vehicle] time_system)"
    )


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
