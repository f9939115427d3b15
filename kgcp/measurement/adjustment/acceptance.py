"""Acceptance tests: what a fit must show before it is reported as this target."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.measurement.adjustment.problem import SMALL_RING_PX
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.image_model.noise import median_at_edges, outlier_share
from kgcp.measurement.image_model.photometry import plateau_levels
from kgcp.measurement.records import Measurement
from kgcp.targets.layout import Ring

_MAX_OUTLIERS = 0.3
_MAX_EDGE_NOISE = 0.15  # of the contrast: the largest residuals near edges
_UNDEFINED_EDGE_NOISE = 2.0  # where residuals or contrast are missing: above any limit
_MAX_RELATIVE_SD, _MAX_RELATIVE_SD_OF_SMALL = 0.01, 0.02
_POSITIONS = 72  # around the code circle
_MIN_PIXELS = 3  # to tell the light at a position
# Residual light at a position, in units of a whole dot's: above the first, a dot is there that the
# code does not have; below minus the second, a dot of the code is missing.
_EXTRA_DOT, _MISSING_DOT = 0.45, 0.6
# A dot is moved if one side of it has so much more light and the other side so much less.
_MOVED_DOT = 0.2
_DOTS_PER_MISSING = 4  # one dot in this many may be missing, hidden by dirt


def edge_noise(fit: TargetFit) -> float:
    """Return the median residual near edges as a share of the contrast; 2 if it is undefined."""
    black, white = plateau_levels(fit.parameters.light, fit.sample.problem.tone)
    residual = median_at_edges(fit.sd, fit.prediction.share, 0.2, 0.8, math.nan)
    return residual / (white - black) if residual > 0.0 and white > black else _UNDEFINED_EDGE_NOISE


def check_fit(fit: TargetFit) -> None:
    """Refuse a fit that leaves too many outliers or too large residuals.

    Raises
    ------
    Rejection
        `POOR_FIT`.
    """
    outlying = outlier_share(fit.misfit, fit.prediction.levels, fit.sample.censoring)
    noise = edge_noise(fit)
    if outlying > _MAX_OUTLIERS or noise > _MAX_EDGE_NOISE:
        raise Rejection(
            Reason.POOR_FIT, f"{outlying:.0%} outliers, residuals {noise:.0%} of the contrast"
        )


def check_precision(measurement: Measurement) -> None:
    """Refuse a measurement so uncertain that it can hardly be of this target.

    Even far, blurred and badly exposed targets are measured to some parts in a thousand. Clutter
    that happens to be round and dotted leaves large residuals, and with them large deviations.

    Raises
    ------
    Rejection
        `POOR_FIT`.
    """
    if measurement.uncertainty is None:
        return
    relative_sd = measurement.uncertainty.sd_distance_m / measurement.pose.distance_m
    is_small = measurement.appearance.radius_px < SMALL_RING_PX
    if relative_sd > (_MAX_RELATIVE_SD_OF_SMALL if is_small else _MAX_RELATIVE_SD):
        raise Rejection(Reason.POOR_FIT, f"distance uncertain by {relative_sd:.1%}")


def check_code(fit: TargetFit) -> None:
    """Refuse a ring with an extra dot, a moved dot, or too many missing dots.

    The residuals of the fit are averaged over discs of a dot's size all around the code circle.
    Up to one missing dot in four is accepted: dirt may hide it.

    Raises
    ------
    Rejection
        `OTHER_CODE`.
    """
    ring = fit.sample.problem.ring
    excess = _excess_light_around_code_circle(fit, ring)
    at_dot, between, sides = _positions_by_code(ring)
    extra = float(excess[between].max(initial=0.0))
    missing = int(np.count_nonzero(excess[at_dot] < -_MISSING_DOT))
    moved, dot, is_larger = _most_moved_dot(excess, sides)
    if (
        extra > _EXTRA_DOT
        or missing > len(ring.code_deg) // _DOTS_PER_MISSING
        or moved > _MOVED_DOT
    ):
        light = f"{extra:.0%} of a dot's light elsewhere, {moved:.0%} beside the dot at"
        place = f"{ring.code_deg[dot]:g} deg, at {'larger' if is_larger else 'smaller'} angles"
        raise Rejection(Reason.OTHER_CODE, f"{missing} dots missing, {light} {place}")


@cache
def _positions_by_code(ring: Ring) -> tuple[IndexArray, BoolArray, BoolArray]:
    """Relate the 72 positions on the code circle to the d dots of a code.

    Returns
    -------
    at_dot : (d,) array of int
        Position nearest to each dot.
    between : (72,) array of bool
        Positions clear of all dots.
    sides : (2, 72, d) array of bool
        Positions just before, and just after, each dot.
    """
    angles_deg = np.arange(_POSITIONS) * (360.0 / _POSITIONS)
    off_dot_deg = (angles_deg[:, None] - np.array(ring.code_deg) + 180.0) % 360.0 - 180.0
    reach_deg = 2.0 * ring.dot_half_angle_deg
    before = (off_dot_deg < 0.0) & (off_dot_deg >= -reach_deg)
    after = (off_dot_deg > 0.0) & (off_dot_deg <= reach_deg)
    distance_deg = np.abs(off_dot_deg)
    between = distance_deg.min(axis=1) > reach_deg
    return distance_deg.argmin(axis=0), between, np.stack((before, after))


def _most_moved_dot(excess: FloatArray, sides: BoolArray) -> tuple[float, int, bool]:
    """Return the dot with most light that is too much on one side and too little on the other.

    Returns
    -------
    light : float
    dot : int
        Its index in the code.
    is_larger : bool
        Whether it is too much where angles are larger than the dot's.
    """
    beside = excess[:, None] * sides
    surplus, deficit = beside.max(axis=1), -beside.min(axis=1)
    moved = np.minimum(surplus, deficit[::-1])
    side, dot = divmod(int(moved.argmax()), moved.shape[1])
    return float(moved[side, dot]), dot, side == 1


def _excess_light_around_code_circle(fit: TargetFit, ring: Ring) -> FloatArray:
    """Return the light (72,) beyond the fit, all around the code circle; 1 is a whole dot's.

    It is 0, which says nothing, where too few pixels are seen.
    """
    sample, clip = fit.sample, fit.sample.censoring.high
    black, white = plateau_levels(fit.parameters.light, sample.problem.tone)
    excess = sample.levels - np.minimum(fit.prediction.levels, clip)
    excess = excess / max(min(white, clip) - black, sample.problem.window.levels_per_count)
    code_m, dot_m = 0.5 * ring.code_diameter_m, 0.5 * ring.dot_diameter_m
    counts, sums = np.zeros(_POSITIONS), np.zeros(_POSITIONS)
    _gather_around(fit.prediction.points_m, excess, code_m, dot_m, counts, sums)
    px_per_m = sample.problem.outer_radius_px / sample.problem.outer_radius_m
    ratio = dot_m * px_per_m / fit.parameters.blur.mean_sd_px
    visible = 0.85 * (1.0 - math.exp(-0.5 * ratio * ratio))  # of a dot's light after the blur
    return np.where(counts >= _MIN_PIXELS, sums / np.maximum(counts, 1.0) / visible, 0.0)


@compiled
def _gather_around(
    points_m: FloatArray,
    excess: FloatArray,
    code_m: float,
    dot_m: float,
    counts: FloatArray,
    sums: FloatArray,
) -> None:
    """Count the pixels within discs on the code circle, and add up their excess light."""
    step = 2.0 * math.pi / len(counts)
    reach = math.ceil(math.asin(min(1.0, dot_m / code_m)) / step)
    angles = np.arange(len(counts)) * step
    centres_x, centres_y = code_m * np.cos(angles), code_m * np.sin(angles)
    for i in range(points_m.shape[1]):
        x, y = points_m[0, i], points_m[1, i]
        if abs(math.sqrt(x * x + y * y) - code_m) > dot_m:
            continue
        nearest = round(math.atan2(y, x) / step)
        for beside in range(-reach, reach + 1):
            k = (nearest + beside) % len(counts)
            dx, dy = x - centres_x[k], y - centres_y[k]
            if dx * dx + dy * dy < dot_m * dot_m:
                counts[k] += 1.0
                sums[k] += excess[i]
