"""The pixels around one target, and all that the camera says about them once and for all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.geometry.raster import normalised_window

_CONTOUR_POINTS = 72


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A rectangle of pixels, flattened row by row.

    Attributes
    ----------
    x0, y0, width, height : int
        The rectangle in the frame [px].
    levels : (n,) array
        Grey values, 0…1 of the data type's range.
    levels_per_count : float
        One grey value's step.
    normalised : (2, n) array
        Normalised image coordinates of the pixel centres, free of distortion.
    normalised_from_px : (2, 2, n) array
        Derivative of `normalised` with respect to the raw pixel coordinates.
    """

    x0: int
    y0: int
    width: int
    height: int
    levels: FloatArray
    levels_per_count: float
    normalised: FloatArray
    normalised_from_px: FloatArray

    def pixels(self, chosen: IndexArray) -> FloatArray:
        """Return raw pixel coordinates (m, 2) of the chosen pixels."""
        index = np.arange(self.width * self.height)[chosen]
        return np.column_stack(
            (self.x0 + index % self.width, self.y0 + index // self.width)
        ).astype(np.float64)


def contour_px(camera: Camera, pose: Pose, radius_m: float) -> FloatArray:
    """Return points (72, 2) of the image of a circle about the target's centre [px]."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CONTOUR_POINTS, endpoint=False)
    circle = radius_m * np.column_stack((np.cos(angle), np.sin(angle)))
    return camera.project(pose.transform(circle))


def semi_major_axis_px(camera: Camera, pose: Pose, radius_m: float) -> float:
    """Return the semi-major axis of the image of a circle about the target's centre [px]."""
    contour = contour_px(camera, pose, radius_m)
    return float(0.5 * np.linalg.norm(contour[:36] - contour[36:], axis=1).max())


def cut_window(
    grey: GreyArray, camera: Camera, pose: Pose, radius_m: float, margin_px: float
) -> Window:
    """Cut out the image of a circle with a margin around it.

    Raises
    ------
    Rejection
        `CUT` if less than a quarter of the circle's box is within the frame.
    """
    contour = contour_px(camera, pose, radius_m)
    low, high = contour.min(axis=0) - margin_px, contour.max(axis=0) + margin_px
    height, width = grey.shape
    x0, y0 = (max(0, int(np.floor(value))) for value in low)
    x1, y1 = (
        min(size, int(np.ceil(value)) + 1)
        for value, size in zip(high, (width, height), strict=True)
    )
    if (x1 - x0) <= 0 or (y1 - y0) <= 0 or (x1 - x0) * (y1 - y0) < 0.25 * np.prod(high - low):
        raise Rejection(Reason.CUT, f"box {low.round()} … {high.round()} px")
    scale = float(np.iinfo(grey.dtype).max) if np.issubdtype(grey.dtype, np.integer) else 1.0
    normalised, normalised_from_px = normalised_window(
        camera, np.arange(x0, x1, dtype=np.float64), np.arange(y0, y1, dtype=np.float64)
    )
    return Window(
        x0=x0,
        y0=y0,
        width=x1 - x0,
        height=y1 - y0,
        levels=grey[y0:y1, x0:x1].ravel().astype(np.float64) / scale,
        levels_per_count=1.0 / scale,
        normalised=normalised,
        normalised_from_px=normalised_from_px,
    )
