"""Circles whose contour runs through opened dots into the ring: what closes them again.

Blur and overexposure open the dots towards the plate. The contour of the outer circle then dips
into each of them, too far for the circle test of §2.2, but its convex hull is the circle still.
"""

from __future__ import annotations

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.settings import DetectSettings
from kgcp.target.contours import Contours

_RIM = (0.9, 1.1)  # of the half widths of a contour's box: between them is its rim
_SECTORS = 16
_MIN_SECTORS = 10  # four dots leave this much of the rim at any blur
_MAX_BOX_RATIO = 1.3
_MAX_HULL_DEVIATION = 0.07  # of a hull's mean radius: squares are out
_MIN_CORNERS = 10


def circular_hulls(contours: Contours, settings: DetectSettings) -> list[FloatArray]:
    """Return the corners (k, 2) of the convex hulls that pass the circle test [px]."""
    if len(contours) == 0:
        return []
    hulls = (_hull(contours.contour(int(i))) for i in np.flatnonzero(_goes_round(contours)))
    return [hull for hull in hulls if _is_circular(hull, settings)]


def _goes_round(contours: Contours) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Tell for each contour (m,) whether most sectors of its box's rim have a part of it."""
    starts, counts = contours.starts[:-1], np.diff(contours.starts)
    low = np.minimum.reduceat(contours.points, starts)
    high = np.maximum.reduceat(contours.points, starts)
    half = np.maximum(0.5 * (high - low), 0.5)
    unit = contours.points - np.repeat(0.5 * (low + high), counts, axis=0)
    unit /= np.repeat(half, counts, axis=0)
    radii = np.hypot(unit[:, 0], unit[:, 1])
    sectors = np.floor((np.arctan2(unit[:, 1], unit[:, 0]) / np.pi + 1.0) * (0.5 * _SECTORS))
    seen = np.left_shift(1, sectors.astype(np.intp) % _SECTORS)
    seen[(radii < _RIM[0]) | (radii > _RIM[1])] = 0
    sectors_seen = _count_bits(np.bitwise_or.reduceat(seen, starts))
    round_box = half.max(axis=1) < _MAX_BOX_RATIO * half.min(axis=1)
    return np.asarray(round_box & (sectors_seen >= _MIN_SECTORS))


def _count_bits(masks: IndexArray) -> IndexArray:
    return np.asarray((masks[:, None] >> np.arange(_SECTORS) & 1).sum(axis=1))


def _hull(points: FloatArray) -> FloatArray:
    return cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64)


def _is_circular(hull: FloatArray, settings: DetectSettings) -> bool:
    """§2.2 on the corners of a hull, about the middle of its box: corners are unevenly spread."""
    offsets = hull - 0.5 * (hull.min(axis=0) + hull.max(axis=0))
    radii = np.hypot(offsets[:, 0], offsets[:, 1])
    return bool(
        len(hull) >= _MIN_CORNERS
        and radii.mean() > settings.min_radius_px
        and radii.std() < _MAX_HULL_DEVIATION * radii.mean()
    )
