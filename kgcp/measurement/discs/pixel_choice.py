"""The pixels that a disc is measured from: those around its edge that no other edge reaches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.geometry.grey_range import full_scale
from kgcp.measurement.discs.affine_model import Geometry
from kgcp.measurement.image_model.blur import Blur

# Width of the band beyond the reach of the blur that is used, too: it tells the levels and how the
# light falls off. With 3 px, standard deviations of discs of 5 px are 5 % above the bound. A wider
# band has more pixels that are not ground.
_FLAT_PX = 3.0
_REACH_SIGMAS = 3.5
# Pixels nearer to another edge than this many σ plus pixels are left out, as its blur reaches them.
# On crowded boards little ground is left, and nearer pixels are used: the other edge changes them
# by 2 % of the contrast at most, which costs less than to miss them.
_CLEAR, _CROWDED = (2.8, 0.6), (2.0, 0.4)
_EVERY_PX = 3  # of the disc's middle, every third pixel each way is enough for its level
# From these radii on, every second or third of the other pixels that no blur reaches is used. They
# are half of all pixels; leaving them out costs 5 or 6 % of the bound.
_SECOND_RADIUS_PX, _THIRD_RADIUS_PX = 25.0, 60.0
_BLURRED_SIGMAS = 3.5
_LEAST_GROUND = 0.3  # pixels of ground that are needed, per pixel of the edge's length
_MIN_GROUND = 10
_MARGIN_PX = 4  # around the pixels, for the mask of a camera's sharpening


@dataclass(frozen=True, slots=True, eq=False)
class DiscWindow:
    """A rectangle of a photograph around a disc."""

    x0: int
    y0: int
    width: int
    height: int
    levels: FloatArray  # (height · width,): 0…1 of the grey values' range
    levels_per_count: float
    photo: GreyArray  # the whole photograph

    @property
    def frame_px(self) -> int:
        """The longer side of the photograph."""
        return int(max(self.photo.shape))

    def places_px(self, index: IndexArray) -> FloatArray:
        """Return the raw pixel coordinates (2, n) of flat indices."""
        rows, columns = np.divmod(index, self.width)
        return np.stack((columns + self.x0, rows + self.y0)).astype(np.float64)


def cut_disc_window(grey: GreyArray, geometry: Geometry, reach_px: float) -> DiscWindow:
    """Cut out an ellipse with a margin around it, as far as the photograph goes."""
    x, y, xx, xy, yy = geometry.tolist()
    half_x, half_y = math.hypot(xx, xy) + reach_px, math.hypot(xy, yy) + reach_px
    x0, y0 = max(math.floor(x - half_x), 0), max(math.floor(y - half_y), 0)
    x1 = min(math.ceil(x + half_x) + 1, grey.shape[1])
    y1 = min(math.ceil(y + half_y) + 1, grey.shape[0])
    scale = full_scale(grey)
    levels = grey[y0:y1, x0:x1].astype(np.float64).ravel() / scale
    # floats have no steps; they count as 16 bits
    count = 1.0 / scale if np.issubdtype(grey.dtype, np.integer) else 1.0 / 65535.0
    return DiscWindow(x0, y0, x1 - x0, y1 - y0, levels, count, grey)


def outward_px(blur: Blur) -> float:
    """Return how far from the edge pixels are used [px]."""
    return _REACH_SIGMAS * blur.largest_sd_px + _FLAT_PX


def window_reach_px(blur: Blur) -> float:
    """Return how far from the edge a window reaches [px]."""
    return outward_px(blur) + _MARGIN_PX


def choose_pixels(
    window: DiscWindow,
    geometry: Geometry,
    blur: Blur,
    neighbours: Sequence[Geometry],
    *,
    is_thinned: bool = True,
) -> tuple[IndexArray, bool]:
    """Return flat indices of the pixels to use, and whether they are enough of the ground.

    Parameters
    ----------
    neighbours : sequence of Geometry
        Other edges: beside this one, around it, or inside it.
    is_thinned : bool
        Whether only some of the pixels that no blur reaches are used, in the middle and of large
        discs.
    """
    sd_px = blur.largest_sd_px
    others = np.array(neighbours, dtype=np.float64).reshape(-1, 5)
    box = (window.x0, window.y0, window.width, window.height)
    length_px = 2.0 * math.pi * math.sqrt(max(geometry[2] * geometry[4] - geometry[3] ** 2, 0.0))
    every = (_EVERY_PX, _every(length_px / (2.0 * math.pi))) if is_thinned else (1, 1)
    least = max(_LEAST_GROUND * length_px, _MIN_GROUND)
    for sigmas, more_px in (_CLEAR, _CROWDED):
        chosen = np.zeros(window.height * window.width, np.bool_)
        lengths_px = (outward_px(blur), sigmas * sd_px + more_px, sd_px)
        ground = _choose(box, geometry, lengths_px, others, every, chosen)
        if ground >= least:
            break
    return np.flatnonzero(chosen), bool(ground >= least)


def _every(radius_px: float) -> int:
    """Return n, if every n-th of the pixels that no blur reaches is used."""
    return 1 + int(radius_px >= _SECOND_RADIUS_PX) + int(radius_px >= _THIRD_RADIUS_PX)


@compiled
def _choose(
    box: tuple[int, int, int, int],
    geometry: FloatArray,
    lengths_px: tuple[float, float, float],
    others: FloatArray,
    every: tuple[int, int],
    chosen: BoolArray,
) -> int:
    """Mark the pixels to use; return how many are on the ground, left-out ones counted."""
    x0, y0, width, height = box
    reach_px, clear_px, sd_px = lengths_px
    is_around = np.zeros(len(others), np.bool_)
    for k in range(len(others)):
        is_around[k] = (
            _off(geometry[0], geometry[1], others[k]) < 0.0
            and others[k, 2] * others[k, 4] - others[k, 3] ** 2
            > geometry[2] * geometry[4] - geometry[3] ** 2
        )
    ground = 0
    for row in range(height):
        for column in range(width):
            x, y = float(x0 + column), float(y0 + row)
            off_px = _off(x, y, geometry)
            if off_px > reach_px:
                continue
            every_in_middle, every_beside = every
            if off_px < -reach_px and (row % every_in_middle or column % every_in_middle):
                continue
            if abs(off_px) > _BLURRED_SIGMAS * sd_px and (row + column) % every_beside:
                continue
            is_free = True
            for k in range(len(others)):
                off_other = _off(x, y, others[k])
                is_free &= off_other < -clear_px if is_around[k] else off_other > clear_px
            if is_free:
                chosen[row * width + column] = True
                ground += (off_px > sd_px) * (
                    every_beside if off_px > _BLURRED_SIGMAS * sd_px else 1
                )
    return ground


@compiled
def _off(px: float, py: float, geometry: FloatArray) -> float:
    """Return the distance of a point from an ellipse to first order, negative inside."""
    determinant = geometry[2] * geometry[4] - geometry[3] * geometry[3]
    a, b, d = geometry[4] / determinant, -geometry[3] / determinant, geometry[2] / determinant
    x, y = px - geometry[0], py - geometry[1]
    u, v = a * x + b * y, b * x + d * y
    rho = math.sqrt(u * u + v * v)
    slope_x, slope_y = a * u + b * v, b * u + d * v
    slope = math.sqrt(slope_x * slope_x + slope_y * slope_y)
    return (rho - 1.0) * rho / slope if rho > 1e-6 else -math.sqrt(determinant)
