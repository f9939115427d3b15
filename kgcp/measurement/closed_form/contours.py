"""Edge contours of a frame (§2.1 of Cucci 2016), and hulls of contours that dots interrupt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.measurement.search.pyramid import eight_bit
from kgcp.settings import DetectSettings

_SMOOTHING_PX = 0.8  # like a lens's blur: suppresses edges of noise and texture, but not of rings

# A contour is taken to surround a ring if it passes through enough sectors of the rim of its
# bounding box.
_RIM = (0.9, 1.1)  # radii of the rim, in units of the box's half widths
_SECTORS = 16
_MIN_SECTORS = 10  # four dots leave at least these sectors of the rim, at any blur
_MAX_BOX_RATIO = 1.3  # of the sides of the bounding box
_MAX_HULL_DEVIATION = 0.07  # of the radius, relative to its mean; excludes squares
_MIN_CORNERS = 10  # of a hull


@dataclass(frozen=True, slots=True, eq=False)
class Contours:
    """Contours of a frame, concatenated."""

    points: FloatArray  # (n, 2): x, y of the contours' pixels in order [px]
    starts: IndexArray  # (m + 1,): contour i is `points[starts[i]:starts[i + 1]]`

    def __len__(self) -> int:
        """Count the contours."""
        return len(self.starts) - 1

    def contour(self, index: int) -> FloatArray:
        """Return the points (k, 2) of one contour [px]."""
        return self.points[self.starts[index] : self.starts[index + 1]]

    def chosen(self, indices: IndexArray) -> Contours:
        """Return the contours with the given indices (k,)."""
        return joined_contours([self.contour(int(index)) for index in indices])


def joined_contours(contours: Sequence[npt.NDArray[Any]]) -> Contours:
    """Return a record of contours, each given by its points (k, 2)."""
    starts = np.zeros(len(contours) + 1, dtype=np.intp)
    np.cumsum([len(contour) for contour in contours], out=starts[1:])
    points = np.concatenate(contours) if contours else np.zeros((0, 2))
    return Contours(points=points.astype(np.float64), starts=starts)


def find_contours(grey: GreyArray, settings: DetectSettings) -> Contours:
    """Detect Canny edges and follow their contours (Suzuki & Abe 1985).

    A thin closed edge gives two contours, one along each side.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame, uint8 or uint16.
    settings : DetectSettings
        Gives the hysteresis thresholds. Contours too short for `min_radius_px` are left out.
    """
    smooth = cv2.GaussianBlur(eight_bit(grey), (0, 0), _SMOOTHING_PX)
    edges = cv2.Canny(smooth, settings.canny_low, settings.canny_high)
    contours, _ = cv2.findContours(edges, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    # a digital circle has at least 4 √2 pixels per pixel of radius
    shortest = max(6, int(4.0 * np.sqrt(2.0) * settings.min_radius_px))
    return joined_contours([contour[:, 0] for contour in contours if len(contour) >= shortest])


def circular_hulls(contours: Contours, settings: DetectSettings) -> list[FloatArray]:
    """Return the corners (k, 2) of the convex hulls that pass the circle test [px]."""
    if len(contours) == 0:
        return []
    hulls = [
        cv2.convexHull(contours.contour(int(i)).astype(np.float32))[:, 0].astype(np.float64)
        for i in np.flatnonzero(_are_surrounding(contours))
    ]
    return [hull for hull in hulls if _is_circular(hull, settings)]


def _are_surrounding(contours: Contours) -> BoolArray:
    """Return for each contour (m,) whether it passes through most sectors of its box's rim."""
    starts, counts = contours.starts[:-1], np.diff(contours.starts)
    low = np.minimum.reduceat(contours.points, starts)
    high = np.maximum.reduceat(contours.points, starts)
    half = np.maximum(0.5 * (high - low), 0.5)
    unit = contours.points - np.repeat(0.5 * (low + high), counts, axis=0)
    unit /= np.repeat(half, counts, axis=0)
    radii = np.hypot(unit[:, 0], unit[:, 1])
    sectors = np.floor((np.arctan2(unit[:, 1], unit[:, 0]) / np.pi + 1.0) * (0.5 * _SECTORS))
    sector_bits = np.left_shift(1, sectors.astype(np.intp) % _SECTORS)
    sector_bits[(radii < _RIM[0]) | (radii > _RIM[1])] = 0
    masks = np.bitwise_or.reduceat(sector_bits, starts)
    occupied = (masks[:, None] >> np.arange(_SECTORS) & 1).sum(axis=1)
    has_square_box = half.max(axis=1) < _MAX_BOX_RATIO * half.min(axis=1)
    return np.asarray(has_square_box & (occupied >= _MIN_SECTORS))


def _is_circular(hull: FloatArray, settings: DetectSettings) -> bool:
    """Apply the circle test of §2.2 to the corners of a hull.

    The radii are taken about the middle of the bounding box, because corners are unevenly spaced
    and their mean is not the centre.
    """
    offsets = hull - 0.5 * (hull.min(axis=0) + hull.max(axis=0))
    radii = np.hypot(offsets[:, 0], offsets[:, 1])
    return bool(
        len(hull) >= _MIN_CORNERS
        and radii.mean() > settings.min_radius_px
        and radii.std() < _MAX_HULL_DEVIATION * radii.mean()
    )
