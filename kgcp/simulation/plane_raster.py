"""Windows of the image back-projected onto a plane: pixel integration by exact coverage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pixel_grid import normalised_grid
from kgcp.geometry.pose import Pose
from kgcp.simulation.regions import Region


@dataclass(frozen=True, slots=True)
class PixelWindow:
    """A rectangle of whole pixels; it may reach beyond the frame."""

    # first pixel
    column: int
    row: int
    # number of pixels
    width: int
    height: int

    def meets(self, camera: Camera) -> bool:
        """Whether some of the window is within the camera's frame."""
        return -self.width < self.column < camera.width and -self.height < self.row < camera.height

    def exceeds(self, camera: Camera) -> bool:
        """Whether the window is wider or higher than the camera's frame."""
        return self.width > camera.width or self.height > camera.height

    def near(self, camera: Camera, margin_px: int) -> PixelWindow:
        """Return the part of the window that is at most `margin_px` outside the camera's frame."""
        column, row = max(self.column, -margin_px), max(self.row, -margin_px)
        last_column = min(self.column + self.width, camera.width + margin_px)
        last_row = min(self.row + self.height, camera.height + margin_px)
        return PixelWindow(column, row, last_column - column, last_row - row)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneRaster:
    """The plane coordinates of every sub-pixel of a window."""

    camera: Camera
    pose: Pose  # plane → camera; the plane is z = 0
    window: PixelWindow
    oversampling: int  # sub-pixels per pixel and axis
    # (height · oversampling, width · oversampling): where the rays through the sub-pixels' centres
    # meet the plane [m]
    x_m: FloatArray
    y_m: FloatArray

    @classmethod
    def of(
        cls, camera: Camera, pose: Pose, window: PixelWindow, oversampling: int = 1
    ) -> PlaneRaster:
        """Cast rays through the distorted camera onto the plane of `pose`."""
        columns = _sub_pixels(window.column, window.width, oversampling)
        rows = _sub_pixels(window.row, window.height, oversampling)
        x, y = normalised_grid(camera, columns, rows)
        plane = np.column_stack((pose.rotation[:, :2], pose.translation_m))
        inverse = np.linalg.inv(plane)
        scale = 1.0 / (inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2])
        x_m = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) * scale
        y_m = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) * scale
        return cls(camera, pose, window, oversampling, x_m, y_m)

    def paint(self, image: FloatArray, shape: Region, value: float, opacity: float = 1.0) -> None:
        """Paint a shape over `image`, in place, each sub-pixel by the share that it covers."""
        place = self._slices(shape)
        if place is None:
            return
        piece = image[place]
        piece += opacity * self._coverage(shape, place) * (value - piece)

    def _slices(self, shape: Region) -> tuple[slice, slice] | None:
        """Return the sub-pixels that may see the shape; None if it is outside the window."""
        corner, size = outline_box(self.camera, self.pose, shape)
        origin = np.array([self.window.column, self.window.row]) - 0.5
        first = np.floor((corner - origin) * self.oversampling).astype(int) - 2
        last = np.ceil((corner + size - origin) * self.oversampling).astype(int) + 2
        limits = np.array(self.x_m.shape[::-1])
        first, last = np.maximum(first, 0), np.minimum(last, limits)
        if np.any(last <= first):
            return None
        return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))

    def _coverage(self, shape: Region, place: tuple[slice, slice]) -> FloatArray:
        """Share of each sub-pixel that lies inside the shape.

        Exact for straight edges: with the projections a, b of the sub-pixel's sides on the edge
        normal, the share grows with the distance like the distribution function of the sum of two
        uniform variables. A curved edge is moved by κ(a² + b²)/24, which keeps the area of a
        circle of curvature κ.
        """
        distance = shape.signed_distance(self.x_m[place], self.y_m[place])
        covered = (distance < 0.0).astype(np.float64)
        rows, columns = np.nonzero(np.abs(distance) < self._largest_step(place))
        near = distance[rows, columns]
        rows, columns = rows + place[0].start, columns + place[1].start
        gx, gy = shape.outward(self.x_m[rows, columns], self.y_m[rows, columns])
        across, down = self._steps(rows, columns)
        a = np.abs(gx * across[0] + gy * across[1])
        b = np.abs(gx * down[0] + gy * down[1])
        near = near + shape.curvature_per_m * (a * a + b * b) / 24.0
        covered[rows - place[0].start, columns - place[1].start] = _share_inside(near, a, b)
        return covered

    def _steps(
        self, rows: FloatArray, columns: FloatArray
    ) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Return the plane vectors from one sub-pixel to the next, rightwards and downwards [m]."""
        last_row, last_column = np.subtract(self.x_m.shape, 1)
        right, left = np.minimum(columns + 1, last_column), np.maximum(columns - 1, 0)
        below, above = np.minimum(rows + 1, last_row), np.maximum(rows - 1, 0)
        x_m, y_m = self.x_m, self.y_m
        n_across, n_down = right - left, below - above
        return (
            (
                (x_m[rows, right] - x_m[rows, left]) / n_across,
                (y_m[rows, right] - y_m[rows, left]) / n_across,
            ),
            (
                (x_m[below, columns] - x_m[above, columns]) / n_down,
                (y_m[below, columns] - y_m[above, columns]) / n_down,
            ),
        )

    def _largest_step(self, place: tuple[slice, slice]) -> float:
        """Return an upper bound of the width of sub-pixels within `place` [m]."""
        corner_rows = np.array([place[0].start, place[0].stop - 1])[[0, 0, 1, 1]]
        corner_columns = np.array([place[1].start, place[1].stop - 1])[[0, 1, 0, 1]]
        across, down = self._steps(corner_rows, corner_columns)
        return float(1.2 * np.sqrt(np.max(np.square(across) + np.square(down)) * 2.0))


def _sub_pixels(first: int, pixels: int, oversampling: int) -> FloatArray:
    """Return the centres of the sub-pixels along one axis [px]."""
    centres: FloatArray = np.arange(pixels * oversampling, dtype=np.float64) + 0.5
    centres /= oversampling
    centres += first - 0.5
    return centres


def _share_inside(distance: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return P(U + V > distance) for U, V uniform within ±a/2, ±b/2."""
    wide = np.maximum(np.maximum(a, b), 1e-12)  # no width at a circle's centre: a step
    narrow = np.maximum(np.minimum(a, b), 1e-3 * wide)  # the limit of a ramp, before 0/0
    mean, half = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    distance = np.clip(distance, -mean, mean)
    square = np.square(mean - distance)
    square -= np.square(np.maximum(half - distance, 0.0))
    square -= np.square(np.maximum(-half - distance, 0.0))
    return np.asarray(square / (2.0 * wide * narrow))


def outline_box(camera: Camera, pose: Pose, shape: Region) -> tuple[FloatArray, FloatArray]:
    """Return corner and size (2,) of a box that holds the shape's image [px]."""
    pixels = camera.project(pose.transform(shape.hull()))
    return pixels.min(axis=0), np.ptp(pixels, axis=0)
