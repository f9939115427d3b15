"""Checks of standard deviations: those that are missing, 0, in another unit, or too small."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from kgcp.geometry.arrays import BoolArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.quality.number_text import counted, rounded
from kgcp.settings import VehicleSettings
from kgcp.targets.plain import AnyTarget

_MIN_SD_M, _MAX_SD_M = 0.0005, 10.0  # usual range of a receiver's positions
_MAX_LEVER_ARM_SD_M, _MAX_TIME_SD_S = 0.5, 0.5
_MAX_TARGET_SD_M = 5.0  # a hand-held receiver is better
# Scatter from epoch to epoch that is doubted: the least one, its least ratio to the stated standard
# deviations, and what a vehicle's accelerations may add to it.
_MIN_SCATTER_M, _MIN_SCATTER_RATIO, _SCATTER_M_S2 = 0.02, 2.0, 1.0
_SCATTER_STEP_S = 0.1
_FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
_EVEN_STEPS = 1.2  # ratio of the longest to the shortest
_MIN_DIFFERENCES, _MAX_DIFFERENCES = 20, 100_000
_SD_OF_MEDIAN = 1.4826  # of a normal distribution over the median of absolute deviations
_REMEDY = (
    "give those of the receiver's software, or remove their columns from the trajectory's file"
)
_MISSING_REMEDIES = {  # by the format of the trajectory's file, with the columns of a CSV file
    "csv": "export the trajectory with them, as {columns}",
    "sbet": "name the file that has them, POSPac's smrmsg, as [vehicle] accuracies",
    "tum": "its format has none: give the trajectory as a CSV file with {columns}",
}
_POSES_REMEDY = "give those of the adjustment, or remove their columns from the poses' file"


def check_deviations(motion: Motion, form: str) -> Iterator[Doubt]:
    """Yield doubts about standard deviations of a trajectory.

    They may be missing, 0, in millimetres or variances, or smaller than the positions' scatter.

    Parameters
    ----------
    form : str
        Format of the trajectory's file, which decides how missing ones can be given.
    """
    sd_m = motion.sd_position_m
    if sd_m is None:
        effect = "points will have none"
        yield _missing("positions", effect, form, "sd_x, sd_y, sd_z")
    elif motion.sd_attitude_deg is None:
        effect = "the lever arm's direction counts as exact"
        yield _missing("attitudes", effect, form, "sd_roll_deg, sd_pitch_deg, sd_heading_deg")
    if sd_m is not None:
        effect = "points there are weighted far too much"
        is_zero = np.any(sd_m == 0.0, axis=1)
        yield from _zeros(is_zero, "trajectory's positions", "epochs", effect, _REMEDY)
        usual_m = np.median(sd_m, axis=0)
        if 0.0 < usual_m.min() < _MIN_SD_M:
            yield _in_another_unit(usual_m.min(), "which suggests variances, or values in degrees")
        elif usual_m.max() > _MAX_SD_M:
            yield _in_another_unit(usual_m.max(), "which suggests millimetres")
        elif usual_m.min() > 0.0:
            yield from _scatter(motion, float(np.linalg.norm(usual_m)))
    if motion.sd_attitude_deg is not None:
        effect = "the lever arm's direction counts as exact"
        # of all three angles: level ground may be known better than can be written
        is_zero = np.all(motion.sd_attitude_deg == 0.0, axis=1)
        yield from _zeros(is_zero, "trajectory's attitudes", "epochs", effect, _REMEDY)


def _missing(of: str, effect: str, form: str, columns: str) -> Doubt:
    remedy = _MISSING_REMEDIES.get(form, "export the trajectory with them")
    return mild(
        Cause.STANDARD_DEVIATIONS,
        f"the trajectory has no standard deviations of its {of}: {effect}",
        remedy.format(columns=columns),
        {},
    )


def _scatter(motion: Motion, stated_m: float) -> Iterator[Doubt]:
    """Yield the doubt about positions that scatter from epoch to epoch by more than is stated.

    The fourth differences of evenly spaced positions are those of their errors: a vehicle's motion
    hardly has any. A receiver's errors change slowly, so that they scatter by less than is stated.
    Rounded coordinates scatter by 0.3 of their steps.
    """
    usual_s = float(np.median(np.diff(motion.time_s)))
    # a fast logger's rounded positions mostly repeat from epoch to epoch
    for every in sorted({1, max(1, round(_SCATTER_STEP_S / usual_s))}):
        scatter_m = _scatter_m(motion, every)
        by_motion_m = _SCATTER_M_S2 * (every * usual_s) ** 2
        if scatter_m <= max(_MIN_SCATTER_M, _MIN_SCATTER_RATIO * stated_m, by_motion_m):
            continue
        yield mild(
            Cause.STANDARD_DEVIATIONS,
            f"the trajectory's positions scatter by {rounded(scatter_m)} m from epoch to epoch, but"
            f" their standard deviations are {rounded(stated_m)} m (medians): points are less"
            " accurate than is stated",
            "export the trajectory again with all digits of its coordinates, if they were rounded;"
            " otherwise give standard deviations that include this scatter",
            {"scatter_m": scatter_m, "sd_m": stated_m},
        )
        return


def _scatter_m(motion: Motion, every: int) -> float:
    """Return the scatter of every k-th position about its neighbours [m]; 0: not known."""
    time_s, position_m = motion.time_s[::every], motion.position_m[::every]
    width = len(_FOURTH_DIFFERENCE)
    if len(time_s) < width:
        return 0.0
    steps_s = np.lib.stride_tricks.sliding_window_view(np.diff(time_s), width - 1)
    even = np.flatnonzero(steps_s.max(axis=1) <= _EVEN_STEPS * steps_s.min(axis=1))
    if len(even) < _MIN_DIFFERENCES:
        return 0.0
    even = even[:: -(-len(even) // _MAX_DIFFERENCES)]
    windows = np.lib.stride_tricks.sliding_window_view(position_m, width, axis=0)
    usual_m = np.median(np.abs(windows[even] @ _FOURTH_DIFFERENCE), axis=0)
    of_one = _SD_OF_MEDIAN / np.linalg.norm(_FOURTH_DIFFERENCE)
    return float(of_one * np.linalg.norm(usual_m))


def check_pose_deviations(poses: ReferencePoses) -> Iterator[Doubt]:
    """Yield doubts about reference poses that count as exact."""
    if poses.sd_position_m is not None:
        effect = "reference distances count as far too accurate"
        is_zero = np.any(poses.sd_position_m == 0.0, axis=1)
        yield from _zeros(is_zero, "reference poses' positions", "poses", effect, _POSES_REMEDY)
    if poses.sd_angle_deg is not None:
        effect, is_zero = "directions count as exact", poses.sd_angle_deg == 0.0
        yield from _zeros(is_zero, "reference poses' angles", "poses", effect, _POSES_REMEDY)


def check_vehicle_deviations(settings: VehicleSettings) -> Iterator[Doubt]:
    """Yield doubts about deviations of lever arm and time that seem to be in mm or ms."""
    for key, value, limit, unit in (
        ("sd_lever_arm_m", max(settings.sd_lever_arm_m), _MAX_LEVER_ARM_SD_M, "m"),
        ("sd_time_s", settings.sd_time_s, _MAX_TIME_SD_S, "s"),
    ):
        if value > limit:
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                f"[vehicle] {key} is {value:g} {unit}, which makes all points very uncertain",
                f"give it in {unit}, not in m{unit}",
                {key: value},
            )


def check_target_deviations(targets: Iterable[AnyTarget]) -> Iterator[Doubt]:
    """Yield the doubt about deviations of static targets that seem to be in millimetres."""
    large = [target for target in targets if max(target.sd_position_m) > _MAX_TARGET_SD_M]
    if large:
        sd_m = max(large[0].sd_position_m)
        others = f", and that of {counted(len(large) - 1, 'other target')}" if large[1:] else ""
        yield mild(
            Cause.STANDARD_DEVIATIONS,
            f"sd_position_m of {large[0].name} is {sd_m:g} m{others}, which suggests millimetres",
            "give it in m, not in mm",
            {"sd_m": sd_m, "targets": float(len(large))},
        )


def _zeros(is_zero: BoolArray, values: str, rows: str, effect: str, remedy: str) -> Iterator[Doubt]:
    """Yield the doubt about deviations that are 0 in some of n rows, unless there are none."""
    count = int(is_zero.sum())
    if count:
        which = f"{count} of {len(is_zero)} {rows}" if count < len(is_zero) else f"all {rows}"
        sentence = f"standard deviations of the {values} are 0 for {which}: {effect}"
        yield mild(Cause.STANDARD_DEVIATIONS, sentence, remedy, {rows: float(count)})


def _in_another_unit(sd_m: float, words: str) -> Doubt:
    return mild(
        Cause.STANDARD_DEVIATIONS,
        f"standard deviations of the trajectory's positions are {sd_m:.2g} m (median), {words}",
        "give standard deviations in metres",
        {"sd_m": float(sd_m)},
    )
