"""Is it really this target? What a fit must show before it is reported."""

from __future__ import annotations

import math

import numpy as np

from kgcp.compiled import compiled
from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.target.adjust import Fit
from kgcp.target.layout import Ring
from kgcp.target.light import plateau_levels
from kgcp.target.observation import Observation

_MAX_OUTLIERS = 0.3
_MAX_EDGE_NOISE = 0.15  # of the contrast: the largest residuals near edges
_MAX_RELATIVE_SD = 0.01
_POSITIONS = 72  # around the code circle
_MIN_PIXELS = 3
_EXTRA, _LACK = 0.45, 0.6  # of a dot's contrast: another dot, or the lack of one
_MOVED = 0.2  # of a dot's contrast: so much more light on one side of a dot and less on the other
_DOTS_PER_MISSING = 4  # one dot in so many may be dirty


def edge_noise(fit: Fit) -> float:
    """Return the residuals near edges, of the contrast; above 1 where nothing makes sense."""
    share = fit.prediction.share
    edge = (share > 0.2) & (share < 0.8)
    black, white = plateau_levels(fit.parameters.light, fit.sample.imaging.response)
    return float(np.median(fit.sd[edge])) / (white - black) if edge.any() and white > black else 2.0


def check_fit(fit: Fit) -> None:
    """Refuse a fit that leaves too many outliers or too large residuals.

    Raises
    ------
    Rejection
        `POOR_FIT`.
    """
    censoring = fit.sample.censoring
    seen = ~(censoring.at_high | censoring.at_low)
    outlying = float(np.mean(fit.misfit.weight[seen] < 0.5))
    noise = edge_noise(fit)
    if outlying > _MAX_OUTLIERS or noise > _MAX_EDGE_NOISE:
        raise Rejection(
            Reason.POOR_FIT, f"{outlying:.0%} outliers, residuals {noise:.0%} of the contrast"
        )


def check_precision(observation: Observation) -> None:
    """Refuse a measurement so uncertain that it can hardly be of this target.

    Even far, blurred and badly exposed targets are measured to some parts in a thousand; clutter
    that happens to be round and dotted leaves residuals that say otherwise.

    Raises
    ------
    Rejection
        `POOR_FIT`.
    """
    if observation.uncertainty is None:
        return
    share = observation.uncertainty.sd_distance_m / observation.pose.distance_m
    if share > _MAX_RELATIVE_SD:
        raise Rejection(Reason.POOR_FIT, f"distance uncertain by {share:.1%}")


def check_code(fit: Fit, ring: Ring) -> None:
    """Refuse a ring that shows a dot where this code has none, or lacks more than a dirty one.

    The residuals of the fit are averaged over discs of a dot's size all around the code circle.

    Raises
    ------
    Rejection
        `OTHER_CODE`.
    """
    excess = _light_around_code_circle(fit, ring)
    angles_deg = np.arange(_POSITIONS) * (360.0 / _POSITIONS)
    off_dot_deg = (angles_deg[:, None] - np.array(ring.code_deg) + 180.0) % 360.0 - 180.0
    at_dot = np.abs(off_dot_deg).argmin(axis=0)
    between = np.abs(off_dot_deg).min(axis=1) > 2.0 * ring.dot_half_angle_deg
    with np.errstate(invalid="ignore"):  # NaN where the frame ends: says nothing
        extra = float(np.nanmax(np.append(excess[between], 0.0)))
        missing = int(np.count_nonzero(excess[at_dot] < -_LACK))
    moved = _largest_displacement(excess, off_dot_deg, ring)
    if extra > _EXTRA or missing > len(ring.code_deg) // _DOTS_PER_MISSING or moved > _MOVED:
        light = f"{extra:.0%} of a dot's light elsewhere, {moved:.0%} beside its place"
        raise Rejection(Reason.OTHER_CODE, f"{missing} dots missing, {light}")


def _largest_displacement(excess: FloatArray, off_dot_deg: FloatArray, ring: Ring) -> float:
    """Return the light that is too much on one side of a dot and too little on the other."""
    reach_deg = 2.0 * ring.dot_half_angle_deg
    left = (off_dot_deg < 0.0) & (off_dot_deg >= -reach_deg)
    right = (off_dot_deg > 0.0) & (off_dot_deg <= reach_deg)
    known = np.nan_to_num(excess)[:, None]
    most_left, most_right = (np.max(known * side, axis=0) for side in (left, right))
    lack_left, lack_right = (np.max(-known * side, axis=0) for side in (left, right))
    moved = np.maximum(np.minimum(most_left, lack_right), np.minimum(most_right, lack_left))
    return float(moved.max())


def _light_around_code_circle(fit: Fit, ring: Ring) -> FloatArray:
    """Return what the fit lacks of light all around the code circle, 1: a whole dot.

    NaN where too few pixels are seen.
    """
    sample, clip = fit.sample, fit.sample.censoring.high
    black, white = plateau_levels(fit.parameters.light, sample.imaging.response)
    lack = sample.levels - np.minimum(fit.prediction.levels, clip)
    lack = lack / max(min(white, clip) - black, sample.imaging.window.levels_per_count)
    code_m, dot_m = 0.5 * ring.code_diameter_m, 0.5 * ring.dot_diameter_m
    counts, sums = np.zeros(_POSITIONS), np.zeros(_POSITIONS)
    angles = np.arange(_POSITIONS) * (2.0 * np.pi / _POSITIONS)
    centres_m = code_m * np.stack((np.cos(angles), np.sin(angles)))
    _gather_around(fit.prediction.points_m, lack, centres_m, dot_m, counts, sums)
    px_per_m = sample.imaging.outer_radius_px / sample.imaging.outer_radius_m
    ratio = dot_m * px_per_m / fit.parameters.blur.mean_sd_px
    visible = 0.85 * (1.0 - math.exp(-0.5 * ratio * ratio))  # of a dot's light after the blur
    mean = np.full(_POSITIONS, np.nan)
    enough = counts >= _MIN_PIXELS
    mean[enough] = sums[enough] / counts[enough] / visible
    return mean


@compiled
def _gather_around(
    points_m: FloatArray,
    lack: FloatArray,
    centres_m: FloatArray,
    dot_m: float,
    counts: FloatArray,
    sums: FloatArray,
) -> None:
    """Count the pixels within discs, and add up what they lack."""
    code_m = math.sqrt(centres_m[0, 0] ** 2 + centres_m[1, 0] ** 2)
    for i in range(points_m.shape[1]):
        if abs(math.sqrt(points_m[0, i] ** 2 + points_m[1, i] ** 2) - code_m) > dot_m:
            continue
        for k in range(len(counts)):
            dx, dy = points_m[0, i] - centres_m[0, k], points_m[1, i] - centres_m[1, k]
            if dx * dx + dy * dy < dot_m * dot_m:
                counts[k] += 1.0
                sums[k] += lack[i]
