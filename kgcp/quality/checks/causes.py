"""Search for the slip, or the two slips, that explain why vehicle and camera disagree.

Each slip of `slips` is undone in turn, then each pair of them. The cause is the likeliest of those
after which the disagreement is within the stated standard deviations, or nearly vanishes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import minimize_scalar

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import geoid_height_m
from kgcp.quality.checks.doubt import Cause, Doubt, grave
from kgcp.quality.checks.encounters import Encounters, misfit_of
from kgcp.quality.checks.slips import Slip, clock_slip, remeasured, slips, without_distortion

MISFIT = 4.0
"""Median square of offsets over their variance above which a cause is looked for."""

_EXPLAINED_MISFIT = 2.0  # largest misfit that the stated standard deviations explain
_NEGLIGIBLE_SHARE = 0.01  # of the misfit, after a cause, if the standard deviations are too small
_EQUAL_RATIO = 1.5  # of misfits, below which two causes explain equally well
_MIN_GAIN = 4.0  # least ratio of the misfits before and after a cause
_MIN_OFFSET_M = 0.04  # median offset below which no slip is looked for
_SCAN_S, _SCAN_STEP_S = 120.0, 0.25  # of shifts of the clock
_MIN_COVERED_SHARE = 0.6  # of the frames, that must be within the trajectory after a shift
_FAR_M = 1e7  # stands for an infinite offset
_MIN_SHIFT_S = 0.3
_MAX_K1 = 0.5
_MIN_SCALE_ERROR = 0.005
_GEOID_TOLERANCE_M = 2.0
_MIN_GEOID_M = 3.0  # least difference of heights that may be that of geoid and ellipsoid
_ONE_KIND = "give both in heights of one kind: ellipsoidal, or by a compound crs with its geoid"
_OTHER_HEIGHTS = (
    "check lever_arm_m[2] (down), the antenna's height and phase centre, and whether both files"
    " have heights of one kind"
)


@dataclass(frozen=True, slots=True)
class _Trial:
    slips: tuple[Slip, ...]
    encounters: Encounters
    misfit: float


def causes_of(encounters: Encounters, *, is_correctable: bool = False) -> tuple[Doubt, ...]:
    """Return the doubts about slips that explain the disagreement of vehicle and camera.

    There are none if the two agree, or if no slip explains the disagreement.

    Parameters
    ----------
    is_correctable : bool
        Whether small corrections of flight.toml explain it, too. If so, only slips with a fixed
        amount are tried.
    """
    before = encounters.misfit
    if not before > MISFIT or encounters.apart_m < _MIN_OFFSET_M:
        return ()
    singles = [_trial((slip,), encounters) for slip in slips(encounters)]
    single = _likeliest(singles, before)
    if is_correctable or (single is not None and single.misfit <= _EXPLAINED_MISFIT):
        return () if single is None else _doubts(single, encounters)
    best = _better(single, _likeliest(_fitted(encounters), before), _EQUAL_RATIO)
    if best is None or best.misfit > _EXPLAINED_MISFIT:
        best = _better(best, _likeliest(_pairs(singles), before), _MIN_GAIN)
    return () if best is None else _doubts(best, encounters)


def _better(known: _Trial | None, other: _Trial | None, gain: float) -> _Trial | None:
    """Return the other trial if its misfit is smaller by a factor, else the known one."""
    if known is None or (other is not None and other.misfit * gain < known.misfit):
        return other
    return known


def _trial(undoing: tuple[Slip, ...], encounters: Encounters) -> _Trial:
    with np.errstate(all="ignore"):  # positions far from the trajectory overflow
        for slip in undoing:
            encounters = slip.undone(encounters)
        return _Trial(undoing, encounters, encounters.misfit)


def _likeliest(trials: Sequence[_Trial], before: float) -> _Trial | None:
    """Return the first trial that explains the disagreement as well as the best one; None: none."""
    least = min((trial.misfit for trial in trials), default=np.inf)
    equal = max(_EXPLAINED_MISFIT, _EQUAL_RATIO * least)
    # The misfit of frames outside the trajectory is infinite; a share of it has no meaning.
    allowed = (
        max(_EXPLAINED_MISFIT, _NEGLIGIBLE_SHARE * before)
        if np.isfinite(before)
        else _EXPLAINED_MISFIT
    )
    if least > allowed or least > before / _MIN_GAIN:
        return None
    limit = min(equal, before / _MIN_GAIN)
    return next((trial for trial in trials if trial.misfit <= limit), None)


def _pairs(singles: Sequence[_Trial]) -> list[_Trial]:
    """Try two slips of different groups, and each slip with a shift of heights."""
    possible = [trial for trial in singles if np.isfinite(trial.misfit)]
    # slips of the camera come first in a pair, and are undone only once, because that takes long
    possible.sort(key=lambda trial: trial.slips[0].group != "camera")
    positions = [
        (trial.encounters.by_vehicle_m, trial.encounters.by_camera_m) for trial in possible
    ]
    trials = []
    for (i, first), (j, second) in combinations(enumerate(possible), 2):
        (first_slip,), (second_slip,) = first.slips, second.slips
        if first_slip.group == second_slip.group:
            continue
        if first_slip.is_of_vehicle == second_slip.is_of_vehicle:
            undone = _trial((second_slip,), first.encounters)
        else:  # each is already undone on its own side; the two sides are combined
            vehicle, camera = (i, j) if first_slip.is_of_vehicle else (j, i)
            both = possible[vehicle].encounters.with_camera_of(possible[camera].encounters)
            offset = positions[vehicle][0] - positions[camera][1]
            undone = _Trial((second_slip,), both, misfit_of(offset, both.variance_m2))
        trials.append(replace(undone, slips=(first_slip, second_slip)))
    heights = ((trial, _heights(trial.encounters)) for trial in possible)
    trials += [replace(fit, slips=(*trial.slips, *fit.slips)) for trial, fit in heights]
    return trials


def _fitted(encounters: Encounters) -> list[_Trial]:
    """Try slips whose amount is estimated from the offsets, the likelier first."""
    return [
        _heights(encounters),
        *_clock(encounters),
        *_scales(encounters),
        *_distortion(encounters),
        _principal_point(encounters),
        _lever_arm(encounters),
        _position(encounters),
    ]


def _heights(encounters: Encounters) -> _Trial:
    """Shift all positions up or down."""
    offset = encounters.offset_m
    up_m = np.array([0.0, 0.0, float(np.nanmedian(offset[:, 2]))])
    words, remedy = _height_words(encounters, float(up_m[2]))
    slip = Slip(Cause.HEIGHTS, "heights", words, remedy, lambda other: other)
    moved = replace(encounters, centre_m=encounters.centre_m + up_m)
    is_large = abs(up_m[2]) > _MIN_OFFSET_M
    misfit = misfit_of(offset - up_m, encounters.variance_m2) if is_large else np.inf
    return _Trial((slip,), moved, misfit)


def _height_words(encounters: Encounters, up_m: float) -> tuple[str, str]:
    which = "above" if up_m > 0.0 else "below"
    words = f"only heights differ: the vehicle puts it {abs(up_m):.2f} m {which} the camera"
    frame = encounters.vehicle.local_frame
    longitude, latitude, _ = frame.geodetic_deg(np.zeros((1, 3)))[0].tolist()
    geoid_m = geoid_height_m(longitude, latitude)
    if geoid_m is not None and abs(abs(up_m) - abs(geoid_m)) < _GEOID_TOLERANCE_M:
        low = "the trajectory" if up_m * geoid_m < 0.0 else "the file of reference poses"
        words += f", and geoid and ellipsoid differ by as much there ({geoid_m:.1f} m)"
        return f"{words}: heights in {low} seem to be above the geoid", _ONE_KIND
    if abs(up_m) > _MIN_GEOID_M:
        return f"{words}; geoids are up to 107 m from the ellipsoid, 15 … 65 m in Europe", _ONE_KIND
    return words, _OTHER_HEIGHTS


def _clock(encounters: Encounters) -> list[_Trial]:
    """Search for a shift of all times by up to two minutes."""
    motion = encounters.vehicle.motion
    scan = np.arange(-_SCAN_S, _SCAN_S + _SCAN_STEP_S, _SCAN_STEP_S)
    times = encounters.time_s + scan[:, None]
    covered = (times >= motion.time_s[0]) & (times <= motion.time_s[-1])
    # coarse search: linear interpolation between samples, with the lever arm as it is
    moved = np.stack([np.interp(times, motion.time_s, axis) for axis in motion.position_m.T], -1)
    apart = np.linalg.norm(moved - encounters.position_m + encounters.offset_m, axis=2)
    apart[~covered] = np.nan
    enough = np.isfinite(apart).mean(axis=1) > _MIN_COVERED_SHARE
    if not enough.any():
        return []
    start = float(scan[enough][np.argmin(np.nanmedian(apart[enough], axis=1))])

    def apart_m(shift_s: float) -> float:
        return min(encounters.at(encounters.time_s + shift_s).apart_m, _FAR_M)

    bounds = (start - _SCAN_STEP_S, start + _SCAN_STEP_S)
    shift_s = float(minimize_scalar(apart_m, bounds=bounds, method="bounded").x)
    if abs(shift_s) < _MIN_SHIFT_S:
        return []
    slip = clock_slip(round(shift_s, 3), "frames and trajectory differ in time")
    return [_trial((slip,), encounters)]


def _scales(encounters: Encounters) -> list[_Trial]:
    """Scale all distances: by the target's size, or by the focal length."""
    camera = encounters.camera
    measured = np.linalg.norm(encounters.in_camera_m, axis=1)
    factor = float(np.nanmedian(np.linalg.norm(_sights(encounters), axis=1) / measured))
    if abs(factor - 1.0) < _MIN_SCALE_ERROR:
        return []
    zoomed = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    words = (
        f"all distances seem to be {abs(factor - 1.0):.2%} too {'short' if factor > 1 else 'long'}"
    )
    trials = (
        Slip(
            Cause.DISTANCE_SCALE,
            "distance",
            words,
            f"check the diameters in [[target]] (factor {factor:.5g}), and fx, fy in [camera]",
            lambda other: replace(other, in_camera_m=factor * other.in_camera_m),
        ),
        Slip(
            Cause.DISTANCE_SCALE,
            "camera",
            f"{words}, and directions seem to be those of another focal length",
            f"check fx and fy in [camera]: {zoomed.fx:.5g} and {zoomed.fy:.5g} would fit",
            lambda other: remeasured(other, zoomed),
        ),
    )
    return [_trial((slip,), encounters) for slip in trials]


def _distortion(encounters: Encounters) -> list[_Trial]:
    """Give a camera without distortion the first coefficient."""
    camera = encounters.camera
    if camera != without_distortion(camera):
        return []

    def misfit(k1: float) -> float:
        return min(remeasured(encounters, replace(camera, k1=k1)).misfit, encounters.misfit)

    k1 = float(minimize_scalar(misfit, bounds=(-_MAX_K1, _MAX_K1), method="bounded").x)
    slip = Slip(
        Cause.DISTORTION,
        "camera",
        "distances and directions seem to be those of a lens with distortion, but the camera has"
        " none",
        f"calibrate the camera; if only k1 is given, {k1:.3f} fits best",
        lambda other: remeasured(other, replace(camera, k1=k1)),
    )
    return [_trial((slip,), encounters)]


def _principal_point(encounters: Encounters) -> _Trial:
    """Shift the principal point, which is nearly the same as a small rotation of the camera."""
    camera = encounters.camera
    expected_m = np.einsum("nji,nj->ni", encounters.enu_from_camera, _sights(encounters))
    known = np.isfinite(expected_m).all(axis=1) & (expected_m[:, 2] > 0.0)
    if not known.any():
        return _Trial((), encounters, np.inf)
    x, y = np.median(encounters.pixel[known] - camera.project(expected_m[known]), axis=0).tolist()
    cx, cy = camera.cx + x, camera.cy + y
    if not (0.0 <= cx < camera.width and 0.0 <= cy < camera.height):
        return _Trial((), encounters, np.inf)
    slip = Slip(
        Cause.PRINCIPAL_POINT,
        "camera",
        f"in all frames, targets are {np.hypot(x, y):.1f} px from where reference poses put them,"
        f" by ({x:.1f}, {y:.1f}) px",
        f"check cx and cy in [camera] ({cx:.1f}, {cy:.1f} would fit), and that the reference poses"
        " belong to this camera",
        lambda other: remeasured(other, replace(camera, cx=cx, cy=cy)),
    )
    return _trial((slip,), encounters)


def _sights(encounters: Encounters) -> FloatArray:
    """Return the vectors (n, 3) from camera to target by reference and vehicle, in ENU [m]."""
    measured = np.einsum("nij,nj->ni", encounters.enu_from_camera, encounters.in_camera_m)
    return np.asarray(encounters.offset_m + measured)


def _lever_arm(encounters: Encounters) -> _Trial:
    """Shift the target on the vehicle."""
    body = np.swapaxes(encounters.frame_from_body, 1, 2)
    shift = -np.nanmedian(np.einsum("nij,nj->ni", body, encounters.offset_m), axis=0)
    arm = encounters.lever_arm_m + shift
    values = ", ".join(f"{value:.2f}" for value in arm.tolist())
    slip = Slip(
        Cause.LEVER_ARM,
        "lever arm",
        f"the lever arm seems to be wrong by {np.linalg.norm(shift):.2f} m: the difference is"
        " constant in the vehicle's axes",
        f"measure it again; [{values}] m (forward, right, down) would fit",
        lambda other: replace(other, lever_arm_m=arm),
    )
    return _trial((slip,), encounters)


def _position(encounters: Encounters) -> _Trial:
    """Shift all positions by one vector."""
    shift = np.nanmedian(encounters.offset_m, axis=0)
    east, north, up = shift.tolist()
    slip = Slip(
        Cause.CRS,
        "place",
        f"in all frames, the vehicle puts it {_metres(east, 'east', 'west')},"
        f" {_metres(north, 'north', 'south')} and {_metres(up, 'above', 'below')} the camera's"
        " position",
        "check the datum of both files and the coordinates of the base station",
        lambda other: replace(other, centre_m=other.centre_m + shift),
    )
    return _trial((slip,), encounters)


def _metres(value: float, positive: str, negative: str) -> str:
    return f"{abs(value):.2f} m {positive if value >= 0.0 else negative}"


def _doubts(trial: _Trial, encounters: Encounters) -> tuple[Doubt, ...]:
    before_m, after_m = encounters.apart_m, trial.encounters.apart_m
    together = "" if len(trial.slips) == 1 else " (one of two causes at once)"
    figures = {"apart_m": before_m, "left_m": after_m, "after": trial.misfit}
    if np.isfinite(encounters.misfit):
        figures["misfit"] = encounters.misfit
    return tuple(
        grave(
            slip.code,
            f"vehicle and camera put the target {_length(before_m)} apart (median): {slip.words};"
            f" corrected, {_length(after_m)} would remain{together}",
            slip.remedy,
            figures,
        )
        for slip in trial.slips
    )


def _length(metres: float) -> str:
    if metres >= 1000.0:
        return f"{metres / 1000.0:.4g} km"
    return f"{metres:.3f} m" if metres < 10.0 else f"{metres:.1f} m"
