"""From a ring with the right code to the pose that the measurement starts from.

docs/method.md, "The start", describes it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import circle_planes, pose_on_plane
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.ellipse_fit import fit_ellipses
from kgcp.measurement.records import InitialPose
from kgcp.measurement.search.code_signal import (
    CODE_ANGLES_RAD,
    CODE_CIRCLE,
    CodeMatch,
    clear_of_dots,
    match_code,
    points_of_code,
)
from kgcp.measurement.search.edge_tracking import FINEST_RADIUS_PX
from kgcp.measurement.search.sampling import FAINTEST_SLOPE, sample_ellipses, sample_grey
from kgcp.measurement.search.template_match import code_in_even_light
from kgcp.targets.layout import Target

# Tuning of the start. The adjustment corrects all of it; a start that is worse costs rounds, and
# beyond some per cent of the distance frames (`benchmarks.accuracy.presets`, CPU time and found).
_REACH_PX, _STEP_PX = 3.0, 0.2  # of the profile across an edge
_MAX_TURN_DEG = 8.0  # by which a heading of the search may be off
_AXIS_ERROR_PX = 0.3  # of an outline
_CLEAR_CODE = 0.85  # score below which uneven light may be what makes the code unlike itself
# Of a ring from here on, a pixel of the image that its outline comes from is four pixels or more.
# Outlines were off by up to 2 px there, starts tilted the wrong way by 15°, and two of 240 plates
# in sharpened frames came to rest 0.4 % off, at 2 and 3 σ.
_LARGE_PX = 4.0 * FINEST_RADIUS_PX
_OUTLINE_REACH, _OUTLINE_SAMPLES = 0.045, 33  # of the profile: in radii, and how many
_RISE = 6  # samples over which the grey values rise
_FAINT_RISE = 0.3  # of the typical one: shade leaves more, what hides the edge less
_OUTLINE_REFITS, _STRAY = 2, 3.0  # medians from the ellipse, beyond which it is no edge of the ring

_OUTLINE_RAD = CODE_ANGLES_RAD[::5]  # of an ellipse enough points give its undistorted image
_EVERYWHERE = np.ones(len(_OUTLINE_RAD), dtype=bool)
_EDGE_RAD, _EDGE = CODE_ANGLES_RAD[::4], CODE_CIRCLE[::4]


def initial_pose(grey: GreyArray, camera: Camera, target: Target, match: CodeMatch) -> InitialPose:
    """Return the better one of the two poses that the outline of a matched ring has.

    The outline is good to some tenths of a pixel, and the image model needs no more.

    Raises
    ------
    Rejection
        POOR_ELLIPSE, if the outline lies beyond the lens model's reach.
    """
    match = replace(match, outer=_at_full_size(grey, match))
    ring = match.ring
    towards = camera.undistort(match.outer.points(math.radians(match.lag_deg) + _OUTLINE_RAD))
    cone = _ellipse_through(towards, _EVERYWHERE)
    if cone is None:
        raise Rejection(Reason.POOR_ELLIPSE, "the outline is beyond the lens model's reach")
    poses = [
        pose_on_plane(plane, 0.5 * ring.outer_diameter_m, towards[0])
        for plane in circle_planes(cone.conic)
    ]
    codes = sample_grey(grey, np.array([points_of_code(camera, pose, ring) for pose in poses]))
    scores, lags_deg = match_code(codes, ring)
    if scores.max() < _CLEAR_CODE:
        even = [code_in_even_light(grey, camera, pose, ring) for pose in poses]
        if all(code is not None for code in even):
            even_scores, even_lags_deg = match_code(np.array(even), ring)
            if even_scores.max() > scores.max():
                scores, lags_deg = even_scores, even_lags_deg
    best = int(scores.argmax())
    turn_deg = (float(lags_deg[best]) + 180.0) % 360.0 - 180.0
    pose = poses[best]
    if abs(turn_deg) < _MAX_TURN_DEG:  # otherwise something hides the code, as the search knows
        pose = pose.turned(turn_deg)
    # At a tilt of 0 the image does not change with it, to first order: an adjustment that starts
    # there stays there. So the start is tilted by what the outline cannot tell from 0.
    pose = pose.tilted(math.acos(max(0.0, 1.0 - _AXIS_ERROR_PX / match.outer.mean_radius)))
    outer_px, outer_slope = _edge_of_profile(grey, match, ring.outer_diameter_m)
    inner_px, _ = _edge_of_profile(grey, match, ring.inner_diameter_m)
    contrast = match.white - match.black
    slope = max(outer_slope, FAINTEST_SLOPE)
    shift_px = (inner_px - ring.inner_ratio * outer_px) / (1.0 + ring.inner_ratio)
    return InitialPose(
        ring=ring.name,
        score=float(scores[best]),
        pose=pose,
        radius_px=match.outer.a * target.ring.outer_diameter_m / ring.outer_diameter_m,
        edge_shift_px=shift_px,
        blur_px=contrast / (math.sqrt(2.0 * math.pi) * slope),
    )


def _at_full_size(grey: GreyArray, match: CodeMatch) -> Ellipse:
    """Return the outline as the frame itself shows it; large ones come from a reduced image.

    The edge is where grey values rise most along the rays, except for those that hardly rise and
    those far from an ellipse through all others.
    """
    ring, outline = match.ring, match.outer
    radius_px = outline.mean_radius
    if radius_px < _LARGE_PX:
        return outline
    factors = 1.0 + np.linspace(-_OUTLINE_REACH, _OUTLINE_REACH, _OUTLINE_SAMPLES)
    px_per_m = 2.0 * radius_px / ring.outer_diameter_m
    clear = clear_of_dots(_EDGE_RAD, ring, ring.outer_diameter_m, match.lag_deg, px_per_m)
    values = sample_ellipses(grey, (outline,), factors, _EDGE[clear])[0]
    rises = values[_RISE:] - values[:-_RISE]
    at = factors[rises.argmax(axis=0)] + 0.5 * (factors[_RISE] - factors[0])
    points = outline.centre + at[:, None] * (outline.points(_EDGE_RAD[clear]) - outline.centre)
    steepest = rises.max(axis=0)
    seen = steepest > _FAINT_RISE * np.median(steepest)
    fitted = _ellipse_through(points, seen)
    for _ in range(_OUTLINE_REFITS):
        if fitted is None:
            return outline
        on_circle = np.linalg.solve(fitted.stretch, (points - fitted.centre).T)
        off = np.abs(np.hypot(*on_circle) - 1.0)
        seen &= off <= _STRAY * np.median(off[seen])
        fitted = _ellipse_through(points, seen)
    return outline if fitted is None else fitted


def _ellipse_through(points: FloatArray, seen: BoolArray) -> Ellipse | None:
    """Fit an ellipse to some of the points (n, 2) all around; None if there is none."""
    lengths, directions = np.empty((1, len(points))), np.empty_like(points)
    x, y, unit = _measure_spokes(points, lengths[0], directions)
    ellipses, shares = np.empty((1, 5)), np.empty(1)
    fit_ellipses(lengths, seen[None], directions, math.inf, ellipses, shares)
    if not shares[0]:
        return None
    right, down, a, b, angle_rad = ellipses[0].tolist()
    return Ellipse(x + unit * right, y + unit * down, unit * a, unit * b, angle_rad)


@compiled
def _measure_spokes(
    points: FloatArray, lengths: FloatArray, directions: FloatArray
) -> tuple[float, float, float]:
    """Fill in how far and in which direction points are from their mean, which is returned.

    The unit of the lengths is their mean, which is returned, too.
    """
    x, y, unit, count = 0.0, 0.0, 0.0, len(points)
    for i in range(count):
        x, y = x + points[i, 0] / count, y + points[i, 1] / count
    for i in range(count):
        lengths[i] = math.hypot(points[i, 0] - x, points[i, 1] - y)
        directions[i, 0] = (points[i, 0] - x) / lengths[i]
        directions[i, 1] = (points[i, 1] - y) / lengths[i]
        unit += lengths[i] / count
    for i in range(count):
        lengths[i] /= unit
    return x, y, unit


def _edge_of_profile(
    grey: GreyArray, match: CodeMatch, edge_diameter_m: float
) -> tuple[float, float]:
    """Return where the mean grey values along the radii change most at an edge, and by how much.

    The first is a radius [px], the second in grey values per pixel.
    """
    ring, outline = match.ring, match.outer
    share = edge_diameter_m / ring.outer_diameter_m
    reach_px = min(_REACH_PX, 0.5 * (1.0 - ring.inner_ratio) * outline.mean_radius)
    radii_px = share * outline.mean_radius + np.arange(-reach_px, reach_px, _STEP_PX)
    px_per_m = 2.0 * outline.mean_radius / ring.outer_diameter_m
    clear = clear_of_dots(_EDGE_RAD, ring, edge_diameter_m, match.lag_deg, px_per_m)
    factors = radii_px / outline.mean_radius
    values = sample_ellipses(grey, (outline,), factors, _EDGE[clear])[0]
    sign = 1.0 if edge_diameter_m > ring.inner_diameter_m else -1.0
    steepest, rise = _steepest(values, sign)
    return float(radii_px[steepest]), rise / _STEP_PX


@compiled
def _steepest(values: FloatArray, sign: float) -> tuple[int, float]:
    """Return where the means of some rows rise most, or fall with −1, and by how much per row."""
    rows, angles = values.shape
    means = np.zeros(rows)
    for r in range(rows):
        for a in range(angles):
            means[r] += sign * values[r, a] / angles
    best, most = 0, means[1] - means[0]
    for r in range(1, rows):
        after = means[min(r + 1, rows - 1)]
        rise = (after - means[r - 1]) / (min(r + 1, rows - 1) + 1 - r)
        if rise > most:
            best, most = r, rise
    return best, most
