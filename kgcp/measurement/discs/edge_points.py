"""Edge points around many ellipses at once: the steepest slope of the right sign along each ray.

Rays start at an ellipse's centre. Their directions are evenly spaced where it is the unit circle.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray

RAYS = 48
_STEP_PX = 0.5  # between samples
_SLOPE_STEPS = 2  # a slope is taken over this many samples on either side
_MOST_SAMPLES = 64
_ANGLES = 2.0 * np.pi / RAYS * np.arange(RAYS)
DIRECTIONS = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), axis=-1)


@compiled
def sample_edges(
    image: GreyArray,
    ellipses: FloatArray,
    signs: FloatArray,
    reach_px: FloatArray,
    edges: FloatArray,
    strengths: FloatArray,
    levels: FloatArray,
) -> None:
    """Find the steepest slope along the rays of many ellipses.

    Parameters
    ----------
    image : (height, width) array
    ellipses : (n, 5) array
        Centre and symmetric stretch, as by `find_blobs`.
    signs : (n,) array
        +1: brighter outwards, as of dark discs; −1: darker outwards.
    reach_px : (n,) array
        How far from the ellipse edges are looked for.
    edges : (n, rays) array
        Receives the edges' distances from the centre, in units of the ellipse.
    strengths : (n, rays) array
        Receives the slopes times the sign [grey values per pixel]; 0 beyond the image's border.
    levels : (n, 2, rays) array
        Receives the grey values beside the edge: inside and outside.
    """
    values = np.empty(_MOST_SAMPLES)
    for i in range(len(ellipses)):
        x, y, xx, xy, yy = ellipses[i]
        for k in range(len(DIRECTIONS)):
            dx = xx * DIRECTIONS[k, 0] + xy * DIRECTIONS[k, 1]
            dy = xy * DIRECTIONS[k, 0] + yy * DIRECTIONS[k, 1]
            length = math.sqrt(dx * dx + dy * dy)
            span = min(reach_px[i], 0.9 * length) + _SLOPE_STEPS * _STEP_PX
            count = min(2 * math.ceil(span / _STEP_PX) + 1, _MOST_SAMPLES)
            step, first = 2.0 * span / (count - 1), length - span
            edges[i, k], strengths[i, k] = 1.0, 0.0
            levels[i, 0, k] = levels[i, 1, k] = 0.0
            if not _sample(image, x, y, dx / length, dy / length, first, step, values[:count]):
                continue
            best, slope, inner, outer = _steepest(values[:count], signs[i])
            edges[i, k] = (first + step * best) / length
            strengths[i, k] = slope / (2 * _SLOPE_STEPS * step)
            levels[i, 0, k], levels[i, 1, k] = inner, outer


@compiled
def _sample(
    image: GreyArray,
    x: float,
    y: float,
    dx: float,
    dy: float,
    first: float,
    step: float,
    values: FloatArray,
) -> bool:
    """Fill in bilinear grey values along a ray; False if it leaves the image."""
    last_x, last_y, last = image.shape[1] - 1, image.shape[0] - 1, first + step * (len(values) - 1)
    for far in (first, last):
        if not (0.0 <= x + far * dx < last_x and 0.0 <= y + far * dy < last_y):
            return False
    for j in range(len(values)):
        column, row = x + (first + step * j) * dx, y + (first + step * j) * dy
        left, top = int(column), int(row)
        u, v = column - left, row - top
        upper = float(image[top, left]) * (1.0 - u) + float(image[top, left + 1]) * u
        lower = float(image[top + 1, left]) * (1.0 - u) + float(image[top + 1, left + 1]) * u
        values[j] = upper + v * (lower - upper)
    return True


@compiled
def _steepest(values: FloatArray, sign: float) -> tuple[float, float, float, float]:
    """Return the steepest place between samples, the slope, and the levels on either side of it.

    The levels are the values where the slope ends: the first samples, inwards and outwards, beyond
    which the values no longer fall or rise.
    """
    count, best, steepest = len(values), _SLOPE_STEPS, 0.0
    for j in range(_SLOPE_STEPS, count - _SLOPE_STEPS):
        slope = sign * (values[j + _SLOPE_STEPS] - values[j - _SLOPE_STEPS])
        if slope > steepest:
            best, steepest = j, slope
    beside = 0.0
    if _SLOPE_STEPS < best < count - _SLOPE_STEPS - 1:
        before = sign * (values[best + _SLOPE_STEPS - 1] - values[best - _SLOPE_STEPS - 1])
        after = sign * (values[best + _SLOPE_STEPS + 1] - values[best - _SLOPE_STEPS + 1])
        bend = before - 2.0 * steepest + after
        beside = min(max(0.5 * (before - after) / bend, -0.5), 0.5) if bend < 0.0 else 0.0
    inner, outer = best, best
    while inner > 0 and sign * (values[inner] - values[inner - 1]) > 0.0:
        inner -= 1
    while outer < count - 1 and sign * (values[outer + 1] - values[outer]) > 0.0:
        outer += 1
    return best + beside, steepest, values[inner], values[outer]


@compiled
def mark_inliers(
    edges: FloatArray,
    strengths: FloatArray,
    ellipses: FloatArray,
    fitted: FloatArray,
    limits_px: FloatArray,
    inlying: BoolArray,
    residual_px: FloatArray,
) -> None:
    """Mark edges near fitted ellipses, and fill in their RMS distance from these.

    Parameters
    ----------
    edges, strengths : (n, rays) arrays
        By `sample_edges`, for `ellipses` (n, 5).
    fitted : (n, 5) array
        By `fit_ellipses` in the frame of the ellipse: centre, semi-axes, direction.
    limits_px : (n,) array
        Largest distance of an edge that counts.
    """
    for i in range(len(edges)):
        x, y, a, b, angle = fitted[i]
        scale = math.sqrt(max(ellipses[i, 2] * ellipses[i, 4] - ellipses[i, 3] ** 2, 0.0))
        c, s = math.cos(angle), math.sin(angle)
        weak = 0.25 * np.median(strengths[i])
        total, count = 0.0, 0
        for k in range(edges.shape[1]):
            dx, dy = edges[i, k] * DIRECTIONS[k, 0] - x, edges[i, k] * DIRECTIONS[k, 1] - y
            along, across = (c * dx + s * dy) / a, (c * dy - s * dx) / b
            rho = math.sqrt(along * along + across * across)
            slope = math.sqrt((along / a) ** 2 + (across / b) ** 2) / max(rho, 1e-9)
            off_px = scale * (rho - 1.0) / max(slope, 1e-9)
            is_strong = strengths[i, k] > weak
            inlying[i, k] = is_strong and abs(off_px) < limits_px[i]
            if inlying[i, k]:
                total += off_px * off_px
                count += 1
        residual_px[i] = math.sqrt(total / count) if count else np.inf
