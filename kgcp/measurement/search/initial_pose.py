"""The pose from which the adjustment starts, for a ring with the right code.

docs/method/search.md, "The start", describes the method.
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
from kgcp.measurement.search.edge_tracking import MIN_TRACKED_RADIUS_PX
from kgcp.measurement.search.sampling import MIN_EDGE_SLOPE, sample_ellipses, sample_grey
from kgcp.measurement.search.template_match import light_corrected_code
from kgcp.targets.layout import Target

# Tuning of the start. The adjustment corrects its errors. A worse start costs iterations, and
# frames are lost if the distance is off by more than some per cent. The benchmark is
# `benchmarks.accuracy.presets`: CPU time and number of targets found.
_REACH_PX, _STEP_PX = 3.0, 0.2  # half length and spacing of the profile across an edge
_MAX_TURN_DEG = 8.0  # largest error of the search's heading that is corrected
_AXIS_ERROR_PX = 0.3  # of the outline's semi-axes
_CLEAR_CODE_SCORE = 0.85  # below, the code is also compared with the light corrected
# The outline of larger rings is refined in the frame. The search tracks them in an image whose
# pixels are four or more frame pixels wide. Without refinement, outlines were off by up to 2 px and
# starts were tilted the wrong way by 15°. In sharpened frames, two of 240 plates then ended at
# distances that were 0.4 % off, 2 and 3 σ.
_MIN_REFINED_RADIUS_PX = 4.0 * MIN_TRACKED_RADIUS_PX
_REFINE_REACH, _REFINE_SAMPLES = 0.045, 33  # half length of the profiles, in radii; samples on each
_RISE_SAMPLES = 6  # over which the increase of the grey values is measured
_MIN_RISE = 0.3  # relative to the median one; shade leaves more, an occluded edge has less
# Edge points are dropped if their distance from the ellipse is more than this many medians.
_REFITS, _MAX_STRAY = 2, 3.0

_OUTLINE_RAD = CODE_ANGLES_RAD[::5]  # enough points of the outline to undistort it
_EVERYWHERE = np.ones(len(_OUTLINE_RAD), dtype=bool)
_EDGE_RAD, _EDGE = CODE_ANGLES_RAD[::4], CODE_CIRCLE[::4]


def initial_pose(grey: GreyArray, camera: Camera, target: Target, match: CodeMatch) -> InitialPose:
    """Return the better of the two poses that explain the outline of a matched ring.

    The outline is accurate to some tenths of a pixel, which is enough for the image model.

    Raises
    ------
    Rejection
        POOR_ELLIPSE if the outline lies beyond the reach of the distortion model.
    """
    match = replace(match, outer=_refined_outline(grey, match))
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
    if scores.max() < _CLEAR_CODE_SCORE:
        even = [light_corrected_code(grey, camera, pose, ring) for pose in poses]
        if all(code is not None for code in even):
            even_scores, even_lags_deg = match_code(np.array(even), ring)
            if even_scores.max() > scores.max():
                scores, lags_deg = even_scores, even_lags_deg
    best = int(scores.argmax())
    turn_deg = (float(lags_deg[best]) + 180.0) % 360.0 - 180.0
    pose = poses[best]
    if abs(turn_deg) < _MAX_TURN_DEG:  # else the code is partly hidden: keep the search's heading
        pose = pose.turned(turn_deg)
    # At a tilt of 0 the image does not depend on the tilt to first order, so that an adjustment
    # would never leave it. Therefore the start has at least the tilt that the outline cannot
    # distinguish from 0.
    pose = pose.tilted(math.acos(max(0.0, 1.0 - _AXIS_ERROR_PX / match.outer.mean_radius)))
    outer_px, outer_slope = _edge_of_profile(grey, match, ring.outer_diameter_m)
    inner_px, _ = _edge_of_profile(grey, match, ring.inner_diameter_m)
    contrast = match.white - match.black
    slope = max(outer_slope, MIN_EDGE_SLOPE)
    shift_px = (inner_px - ring.inner_ratio * outer_px) / (1.0 + ring.inner_ratio)
    return InitialPose(
        ring=ring.name,
        score=float(scores[best]),
        pose=pose,
        radius_px=match.outer.a * target.ring.outer_diameter_m / ring.outer_diameter_m,
        edge_shift_px=shift_px,
        blur_px=contrast / (math.sqrt(2.0 * math.pi) * slope),
    )


def _refined_outline(grey: GreyArray, match: CodeMatch) -> Ellipse:
    """Return the outline of a large ring, refined in the frame; that of a small one as it is.

    The search has tracked large rings in a reduced image. Here the edge is where grey values
    increase most along rays clear of dots. Rays with a small increase, and points far from the
    ellipse through the others, are left out.
    """
    ring, outline = match.ring, match.outer
    radius_px = outline.mean_radius
    if radius_px < _MIN_REFINED_RADIUS_PX:
        return outline
    factors = 1.0 + np.linspace(-_REFINE_REACH, _REFINE_REACH, _REFINE_SAMPLES)
    px_per_m = 2.0 * radius_px / ring.outer_diameter_m
    clear = clear_of_dots(_EDGE_RAD, ring, ring.outer_diameter_m, match.lag_deg, px_per_m)
    values = sample_ellipses(grey, (outline,), factors, _EDGE[clear])[0]
    rises = values[_RISE_SAMPLES:] - values[:-_RISE_SAMPLES]
    edges = factors[rises.argmax(axis=0)] + 0.5 * (factors[_RISE_SAMPLES] - factors[0])
    points = outline.centre + edges[:, None] * (outline.points(_EDGE_RAD[clear]) - outline.centre)
    steepest = rises.max(axis=0)
    seen = steepest > _MIN_RISE * np.median(steepest)
    fitted = _ellipse_through(points, seen)
    for _ in range(_REFITS):
        if fitted is None:
            return outline
        on_circle = np.linalg.solve(fitted.stretch, (points - fitted.centre).T)
        off = np.abs(np.hypot(*on_circle) - 1.0)
        seen &= off <= _MAX_STRAY * np.median(off[seen])
        fitted = _ellipse_through(points, seen)
    return outline if fitted is None else fitted


def _ellipse_through(points: FloatArray, seen: BoolArray) -> Ellipse | None:
    """Fit an ellipse to those points (n, 2) that are seen (n,); None if no ellipse fits."""
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
    """Fill in lengths and unit vectors from the mean of points to the points.

    Returned are x and y of the mean, and the mean length, which is the unit of the lengths.
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
    """Return radius [px] and slope [grey values per px] of an edge.

    They are those of the steepest place in the mean profile over all directions clear of dots.
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
    """Return the row at which the row means increase most, and the increase per row.

    With a `sign` of −1, where they decrease most.
    """
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
