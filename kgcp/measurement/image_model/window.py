"""The pixels around one target, with their rays: all that does not depend on the pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.grey_range import full_scale
from kgcp.geometry.pixel_grid import rays_of_window
from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.noise import find_censoring

_ANGLES = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
_UNIT_CIRCLE = np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES)))


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A rectangle of pixels, flattened in row-major order.

    For a large target, the pixels are bins: means over squares of frame pixels.
    """

    # the rectangle in the frame, in pixels of the window
    x0: int
    y0: int
    width: int
    height: int
    levels: FloatArray  # (n,): grey values, 0…1 of the data type's range
    smooth: FloatArray  # (n,): the same after a median filter of 3 × 3 pixels
    levels_per_count: float  # step of one grey value
    # (6, n): normalised image coordinates x, y of the pixel centres, free of distortion, and their
    # derivatives xx, xy, yx, yy by the raw pixel coordinates
    rays: FloatArray
    # binning factor: each window pixel is the mean of `binning` × `binning` frame pixels
    binning: int = 1
    # (n,): share of clipped frame pixels in every bin; None without binning
    clipped: FloatArray | None = None

    def nearest(self, point_px: FloatArray) -> int:
        """Return the index of the pixel nearest to a point (2,) of the raw image."""
        x, y = (round(float(value)) for value in point_px)
        column = min(max(x - self.x0, 0), self.width - 1)
        return min(max(y - self.y0, 0), self.height - 1) * self.width + column

    def pixels(self, chosen: IndexArray) -> FloatArray:
        """Return the raw pixel coordinates (2, m) of pixels with the given indices (m,)."""
        rows, columns = np.divmod(chosen, self.width)
        pixels = np.empty((2, len(chosen)))
        np.add(columns, self.x0, out=pixels[0])
        np.add(rows, self.y0, out=pixels[1])
        return pixels


def contour_px(camera: Camera, pose: Pose, radius_m: float) -> FloatArray:
    """Return the image of a circle about the target's centre: points (72, 2) [px]."""
    return camera.project(pose.transform(radius_m * _UNIT_CIRCLE))


def semi_major_axis_px(contour: FloatArray) -> float:
    """Return the semi-major axis of a circle's image, from its points by `contour_px` [px]."""
    half = len(contour) // 2
    return float(0.5 * np.hypot(*(contour[:half] - contour[half:]).T).max())


def cut_window(
    grey: GreyArray, camera: Camera, contour: FloatArray, margin_px: float, binning: int = 1
) -> Window:
    """Cut out the image of a circle, given by `contour_px`, with a margin around it.

    With `binning`, camera, contour and margin refer to the binned pixels (`Camera.binned`).

    Raises
    ------
    Rejection
        `CUT` if less than a quarter of the circle's bounding box with margin is within the frame.
    """
    low, high = contour.min(axis=0) - margin_px, contour.max(axis=0) + margin_px
    height, width = (size // binning for size in grey.shape)
    x0, y0 = (max(0, int(np.floor(value))) for value in low)
    x1, y1 = (
        min(size, int(np.ceil(value)) + 1)
        for value, size in zip(high, (width, height), strict=True)
    )
    if (x1 - x0) <= 0 or (y1 - y0) <= 0 or (x1 - x0) * (y1 - y0) < 0.25 * np.prod(high - low):
        raise Rejection(Reason.CUT, f"box {low.round()} … {high.round()} px")
    scale = full_scale(grey)
    rays = rays_of_window(
        camera, np.arange(x0, x1, dtype=np.float64), np.arange(y0, y1, dtype=np.float64)
    )
    part = grey[binning * y0 : binning * y1, binning * x0 : binning * x1]
    means = part if binning == 1 else _binned(part, binning)
    smooth = cv2.medianBlur(means.astype(np.float32), 3)
    levels: FloatArray = means.ravel() / scale
    return Window(
        x0=x0,
        y0=y0,
        width=x1 - x0,
        height=y1 - y0,
        levels=levels,
        smooth=np.divide(smooth.ravel(), scale, dtype=np.float64),
        levels_per_count=1.0 / scale,
        rays=rays,
        binning=binning,
        clipped=None if binning == 1 else _clipped(part, binning, levels, 1.0 / scale),
    )


def _clipped(part: GreyArray, binning: int, levels: FloatArray, count: float) -> FloatArray:
    """Return the share (n,) of clipped pixels in every bin."""
    limits = find_censoring(levels, count, part.shape[1] // binning)
    clipped = (part >= limits.high / count) | (part <= limits.low / count)
    return _binned(clipped, binning).ravel()


def _binned(values: np.ndarray[tuple[int, int], Any], count: int) -> FloatArray:
    """Return the means over squares of `count` × `count` pixels."""
    height, width = (size // count for size in values.shape)
    columns = values.reshape(height, count, width * count).sum(axis=1, dtype=np.float64)
    return np.asarray(columns.reshape(height, width, count).sum(axis=2) / (count * count))
