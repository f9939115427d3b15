"""Why vehicle and camera disagree: the slip, or the two slips, that would explain it.

Every slip of `slips` is undone in turn, and then every pair of them. The cause is the likeliest of
those that leave no more than the stated standard deviations, or next to nothing of what there was.
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
from kgcp.quality.checks.slips import Slip, clock_slip, remeasured, slips

MISFIT = 4.0
"""Median square of offsets over their variance above which a cause is looked for."""

_EXPLAINED = 2.0  # misfit that the stated standard deviations may leave
_NEARLY = 0.01  # share of the misfit that may be left where these are too small
_ALIKE = 1.5  # ratio of misfits below which two causes explain equally well
_GAIN = 4.0  # ratio of misfits that a cause must gain at least
_SMALLEST_M = 0.04  # median offset below which nothing is a slip
_SCAN_S, _SCAN_STEP_S = 120.0, 0.25
_COVERED_SHARE = 0.6  # of the frames, for a shift to be believed
_FARTHEST_M = 1e7
_LEAST_SHIFT_S = 0.3
_LEAST_SCALE = 0.01
_GEOID_TOLERANCE_M = 2.0
_LEAST_GEOID_M = 3.0
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
    """Return what explains the disagreement of vehicle and camera, if slips do.

    An empty tuple: they agree, or no slip explains it.

    Parameters
    ----------
    is_correctable : bool
        Whether small corrections of flight.toml explain it, too. Then only slips of which the
        amount is certain are named.
    """
    before = encounters.misfit
    if not before > MISFIT or encounters.apart_m < _SMALLEST_M:
        return ()
    singles = [_trial((slip,), encounters) for slip in slips(encounters)]
    single = _likeliest(singles, before)
    if is_correctable or (single is not None and single.misfit <= _EXPLAINED):
        return () if single is None else _doubts(single, encounters)
    best = _better(single, _likeliest(_fitted(encounters), before), _ALIKE)
    if best is None or best.misfit > _EXPLAINED:
        best = _better(best, _likeliest(_pairs(singles), before), _GAIN)
    return () if best is None else _doubts(best, encounters)


def _better(known: _Trial | None, other: _Trial | None, gain: float) -> _Trial | None:
    """Return the other trial if it explains better by a factor, else the one that is known."""
    if known is None or (other is not None and other.misfit * gain < known.misfit):
        return other
    return known


def _trial(undoing: tuple[Slip, ...], encounters: Encounters) -> _Trial:
    with np.errstate(all="ignore"):  # places far from the trajectory
        for slip in undoing:
            encounters = slip.undone(encounters)
        return _Trial(undoing, encounters, encounters.misfit)


def _likeliest(trials: Sequence[_Trial], before: float) -> _Trial | None:
    """Return the first trial that explains as much as the best one."""
    least = min((trial.misfit for trial in trials), default=np.inf)
    enough = max(_EXPLAINED, _ALIKE * least)
    # An infinite misfit, of frames outside the trajectory, has no share that may be left.
    allowed = max(_EXPLAINED, _NEARLY * before) if np.isfinite(before) else _EXPLAINED
    if least > allowed or least > before / _GAIN:
        return None
    limit = min(enough, before / _GAIN)
    return next((trial for trial in trials if trial.misfit <= limit), None)


def _pairs(singles: Sequence[_Trial]) -> list[_Trial]:
    """Try two slips of different groups, and one slip with what is fitted."""
    possible = [trial for trial in singles if np.isfinite(trial.misfit)]
    possible.sort(key=lambda trial: trial.slips[0].group != "camera")  # undone once: it takes long
    places = [(trial.encounters.by_vehicle_m, trial.encounters.by_camera_m) for trial in possible]
    trials = []
    for (i, first), (j, second) in combinations(enumerate(possible), 2):
        (one,), (other,) = first.slips, second.slips
        if one.group == other.group:
            continue
        if one.is_of_vehicle == other.is_of_vehicle:
            undone = _trial((other,), first.encounters)
        else:  # either side is undone already: the two need only be brought together
            vehicle, camera = (i, j) if one.is_of_vehicle else (j, i)
            both = possible[vehicle].encounters.seen_by(possible[camera].encounters)
            offset = places[vehicle][0] - places[camera][1]
            undone = _Trial((other,), both, misfit_of(offset, both.variance_m2))
        trials.append(replace(undone, slips=(one, other)))
    heights = ((trial, _heights(trial.encounters)) for trial in possible)
    trials += [replace(fit, slips=(*trial.slips, *fit.slips)) for trial, fit in heights]
    return trials


def _fitted(encounters: Encounters) -> list[_Trial]:
    """Try slips whose amount follows from the offsets themselves, the likelier first."""
    return [
        _heights(encounters),
        *_clock(encounters),
        *_scales(encounters),
        _principal_point(encounters),
        _arm(encounters),
        _place(encounters),
    ]


def _heights(encounters: Encounters) -> _Trial:
    """Move all places up or down."""
    offset = encounters.offset_m
    up_m = np.array([0.0, 0.0, float(np.nanmedian(offset[:, 2]))])
    words, remedy = _height_words(encounters, float(up_m[2]))
    slip = Slip(Cause.HEIGHTS, "heights", words, remedy, lambda other: other)
    moved = replace(encounters, centre_m=encounters.centre_m + up_m)
    is_large = abs(up_m[2]) > _SMALLEST_M
    misfit = misfit_of(offset - up_m, encounters.variance_m2) if is_large else np.inf
    return _Trial((slip,), moved, misfit)


def _height_words(encounters: Encounters, up_m: float) -> tuple[str, str]:
    which = "above" if up_m > 0.0 else "below"
    words = f"only heights differ: the vehicle's place is {abs(up_m):.2f} m {which} the camera's"
    frame = encounters.vehicle.local_frame
    longitude, latitude, _ = frame.geodetic_deg(np.zeros((1, 3)))[0].tolist()
    geoid_m = geoid_height_m(longitude, latitude)
    if geoid_m is not None and abs(abs(up_m) - abs(geoid_m)) < _GEOID_TOLERANCE_M:
        low = "the trajectory" if up_m * geoid_m < 0.0 else "the file of reference poses"
        words += f", as much as geoid and ellipsoid there ({geoid_m:.1f} m)"
        return f"{words}: heights in {low} seem to be above the geoid", _ONE_KIND
    if abs(up_m) > _LEAST_GEOID_M:
        return f"{words}; geoids lie up to 107 m from the ellipsoid, 15 … 65 m in Europe", _ONE_KIND
    return words, _OTHER_HEIGHTS


def _clock(encounters: Encounters) -> list[_Trial]:
    """Look for one shift of all times, within two minutes."""
    motion = encounters.vehicle.motion
    scan = np.arange(-_SCAN_S, _SCAN_S + _SCAN_STEP_S, _SCAN_STEP_S)
    times = encounters.time_s + scan[:, None]
    covered = (times >= motion.time_s[0]) & (times <= motion.time_s[-1])
    # coarsely: along straight lines between samples, without turning the lever arm
    moved = np.stack([np.interp(times, motion.time_s, axis) for axis in motion.position_m.T], -1)
    apart = np.linalg.norm(moved - encounters.position_m + encounters.offset_m, axis=2)
    apart[~covered] = np.nan
    enough = np.isfinite(apart).mean(axis=1) > _COVERED_SHARE
    if not enough.any():
        return []
    start = float(scan[enough][np.argmin(np.nanmedian(apart[enough], axis=1))])

    def apart_m(shift_s: float) -> float:
        return min(encounters.at(encounters.time_s + shift_s).apart_m, _FARTHEST_M)

    bounds = (start - _SCAN_STEP_S, start + _SCAN_STEP_S)
    shift_s = float(minimize_scalar(apart_m, bounds=bounds, method="bounded").x)
    if abs(shift_s) < _LEAST_SHIFT_S:
        return []
    slip = clock_slip(round(shift_s, 3), "frames and trajectory differ in time")
    return [_trial((slip,), encounters)]


def _scales(encounters: Encounters) -> list[_Trial]:
    """Make all distances longer or shorter: by the target's size, or by the focal length."""
    camera = encounters.camera
    seen = np.linalg.norm(encounters.in_camera_m, axis=1)
    factor = float(np.nanmedian(np.linalg.norm(_sights(encounters), axis=1) / seen))
    if abs(factor - 1.0) < _LEAST_SCALE:
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
            f"{words}, and directions as if by another focal length",
            f"check fx and fy in [camera]: {zoomed.fx:.5g} and {zoomed.fy:.5g} would fit",
            lambda other: remeasured(other, zoomed),
        ),
    )
    return [_trial((slip,), encounters) for slip in trials]


def _principal_point(encounters: Encounters) -> _Trial:
    """Move the principal point, or turn the camera by a little against the reference."""
    camera = encounters.camera
    ahead = np.einsum("nji,nj->ni", encounters.enu_from_camera, _sights(encounters))
    known = np.isfinite(ahead).all(axis=1) & (ahead[:, 2] > 0.0)
    if not known.any():
        return _Trial((), encounters, np.inf)
    x, y = np.median(encounters.pixel[known] - camera.project(ahead[known]), axis=0).tolist()
    cx, cy = camera.cx + x, camera.cy + y
    if not (0.0 <= cx < camera.width and 0.0 <= cy < camera.height):
        return _Trial((), encounters, np.inf)
    slip = Slip(
        Cause.PRINCIPAL_POINT,
        "camera",
        f"targets are {np.hypot(x, y):.1f} px from where reference poses put them, by"
        f" ({x:.1f}, {y:.1f}) px in all frames",
        f"check cx and cy in [camera] ({cx:.1f}, {cy:.1f} would fit), and that the reference poses"
        " are of this camera",
        lambda other: remeasured(other, replace(camera, cx=cx, cy=cy)),
    )
    return _trial((slip,), encounters)


def _sights(encounters: Encounters) -> FloatArray:
    """Return the vectors (n, 3) from camera to target by reference and vehicle, in ENU [m]."""
    measured = np.einsum("nij,nj->ni", encounters.enu_from_camera, encounters.in_camera_m)
    return np.asarray(encounters.offset_m + measured)


def _arm(encounters: Encounters) -> _Trial:
    """Move the target on the vehicle."""
    body = np.swapaxes(encounters.frame_from_body, 1, 2)
    shift = -np.nanmedian(np.einsum("nij,nj->ni", body, encounters.offset_m), axis=0)
    arm = encounters.lever_arm_m + shift
    values = ", ".join(f"{value:.2f}" for value in arm.tolist())
    slip = Slip(
        Cause.LEVER_ARM,
        "lever arm",
        f"the lever arm seems to be {np.linalg.norm(shift):.2f} m off: the difference is constant"
        " in the vehicle's axes",
        f"measure it again; the images say [{values}] m (forward, right, down)",
        lambda other: replace(other, lever_arm_m=arm),
    )
    return _trial((slip,), encounters)


def _place(encounters: Encounters) -> _Trial:
    """Move all places by one vector."""
    shift = np.nanmedian(encounters.offset_m, axis=0)
    east, north, up = shift.tolist()
    slip = Slip(
        Cause.CRS,
        "place",
        f"the vehicle's place is {_metres(east, 'east', 'west')},"
        f" {_metres(north, 'north', 'south')} and {_metres(up, 'above', 'below')} the camera's in"
        " all frames",
        "check the datum of both files and the coordinates of the base station",
        lambda other: replace(other, centre_m=other.centre_m + shift),
    )
    return _trial((slip,), encounters)


def _metres(value: float, positive: str, negative: str) -> str:
    return f"{abs(value):.2f} m {positive if value >= 0.0 else negative}"


def _doubts(trial: _Trial, encounters: Encounters) -> tuple[Doubt, ...]:
    apart, left = encounters.apart_m, trial.encounters.apart_m
    together = "" if len(trial.slips) == 1 else " (one of two causes at once)"
    figures = {"apart_m": apart, "left_m": left, "after": trial.misfit}
    if np.isfinite(encounters.misfit):
        figures["misfit"] = encounters.misfit
    return tuple(
        grave(
            slip.code,
            f"vehicle and camera put the target {_length(apart)} apart (median): {slip.words};"
            f" {_length(left)} would be left{together}",
            slip.remedy,
            figures,
        )
        for slip in trial.slips
    )


def _length(metres: float) -> str:
    if metres >= 1000.0:
        return f"{metres / 1000.0:.4g} km"
    return f"{metres:.3f} m" if metres < 10.0 else f"{metres:.1f} m"
