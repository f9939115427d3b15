"""The frame camera, with Brown-Conrady distortion in OpenCV's order of coefficients.

The origin of pixel coordinates is the centre of the top-left pixel. Camera axes are x right, y
down, z forward. "Normalised" coordinates are (x/z, y/z) in the camera frame, free of distortion.
"Raw" pixels are those of the frame, with distortion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from numbers import Real
from typing import Self

import numpy as np
import numpy.typing as npt

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.distortion import (
    Lens,
    Scale,
    distort_circles,
    distort_points,
    fill_in_jacobians,
    first_fold_r2,
    undistort_points,
)
from kgcp.settings import require_range, require_word

# The slowest sensors take a third of a second. Beyond a second, the number is in milliseconds.
_MAX_READOUT_S = 1.0


class Response(StrEnum):
    """Relation of grey values to light."""

    LINEAR = "linear"
    SRGB = "srgb"
    UNKNOWN = "unknown"


class TimeReference(StrEnum):
    """The moment of the exposure that a frame's time stamp refers to."""

    START = "start"
    MIDDLE = "middle"
    END = "end"

    def to_middle_s(self, exposure_time_s: float) -> float:
        """Return the time from this moment to mid-exposure [s]."""
        return {"start": 0.5, "middle": 0.0, "end": -0.5}[self.value] * exposure_time_s


@dataclass(frozen=True, slots=True)
class Camera:
    """Interior orientation of a frame camera.

    Attributes
    ----------
    width, height : int
        Frame size [px].
    fx, fy, cx, cy : float
        Principal distances and principal point [px].
    k1, k2, p1, p2, k3, k4, k5, k6 : float
        Distortion coefficients as OpenCV defines and orders them (k4…k6: rational denominator).
    response : Response
        How grey values depend on light.
    readout_s : float
        Rolling shutter: time from the first to the last row [s]; negative if the last row is read
        first, 0 for a global shutter.
    motion_sd_deg_s : float
        Standard deviation of the scene's rate of rotation about each camera axis [deg/s]. Used with
        a rolling shutter where the rotation is not known.
    time_reference : TimeReference
        Moment of the exposure that the time stamps of the input refer to. They are converted to
        mid-exposure.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    response: Response = Response.UNKNOWN
    readout_s: float = 0.0
    motion_sd_deg_s: float = 5.0
    time_reference: TimeReference = TimeReference.MIDDLE

    @classmethod
    def from_opencv(
        cls,
        camera_matrix: npt.ArrayLike,
        distortion: npt.ArrayLike,
        size: tuple[int, int],
        *,
        response: Response = Response.UNKNOWN,
        readout_s: float = 0.0,
        motion_sd_deg_s: float = 5.0,
    ) -> Self:
        """Return a camera from the results of `cv2.calibrateCamera`.

        Parameters
        ----------
        camera_matrix : (3, 3) array
            Principal distances and principal point [px]; without skew.
        distortion : array of 0, 4, 5 or 8 numbers, in any shape
            k1, k2, p1, p2, k3, k4, k5, k6. OpenCV's models with 12 and 14 coefficients (thin prism,
            tilted sensor) are accepted if the further ones are zero.
        size : tuple of int
            Width and height of the frames [px], as OpenCV's `imageSize`.
        response, readout_s, motion_sd_deg_s
            See the attributes of these names.

        Raises
        ------
        SettingError
            If this camera model cannot express the matrix or the coefficients.
        """
        matrix = np.asarray(camera_matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or matrix[1:, 0].any() or tuple(matrix[2, 1:]) != (0.0, 1.0):
            raise SettingError(
                "camera_matrix",
                "is not of the form fx 0 cx, 0 fy cy, 0 0 1",
                "give the matrix that cv2.calibrateCamera returns",
            )
        if matrix[0, 1] != 0.0:
            raise SettingError(
                "camera_matrix",
                f"has a skew of {matrix[0, 1]:g}",
                "calibrate without skew, as cv2.calibrateCamera does",
            )
        numbers = np.asarray(distortion, dtype=np.float64).ravel()
        if len(numbers) not in {0, 4, 5, 8, 12, 14}:
            raise SettingError(
                "distortion",
                f"has {len(numbers)} numbers",
                "give 4, 5 or 8 coefficients in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6",
            )
        if numbers[8:].any():
            raise SettingError(
                "distortion",
                "has terms of a thin prism or a tilted sensor, which have no place in this model",
                "calibrate with cv2.CALIB_RATIONAL_MODEL or fewer terms",
            )
        k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(numbers[:8], (0, max(0, 8 - len(numbers)))).tolist()
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        return replace(
            cls(*size, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6),
            response=response,
            readout_s=readout_s,
            motion_sd_deg_s=motion_sd_deg_s,
        )

    def __post_init__(self) -> None:
        for key, size in (("width", self.width), ("height", self.height)):
            require_range(key, size, 2, 100_000, unit="px")
            if size != int(size):
                raise SettingError(key, f"{size:g} px is not a whole number", "give whole pixels")
            object.__setattr__(self, key, int(size))
        for key, focal in (("fx", self.fx), ("fy", self.fy)):
            require_range(key, focal, 0.0, 1e7, unit="px", open_low=True)
        for key, value, size in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not -0.5 * size <= value <= 1.5 * size:
                raise SettingError(
                    key,
                    f"{value:g} px is far outside a frame of {size} px",
                    "give the principal point in pixels from the centre of the top-left pixel",
                )
        for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"):
            value = getattr(self, key)
            if not isinstance(value, Real) or not math.isfinite(value):
                raise SettingError(key, "is not a finite number", "give a number or leave it out")
        require_range("readout_s", self.readout_s, -_MAX_READOUT_S, _MAX_READOUT_S, unit="s")
        for key, words in (("response", Response), ("time_reference", TimeReference)):
            object.__setattr__(self, key, require_word(key, getattr(self, key), words))
        require_range("motion_sd_deg_s", self.motion_sd_deg_s, 0.0, 1000.0, unit="deg/s")

    def binned(self, count: int) -> Camera:
        """Return the camera after binning: its pixels are squares of `count` × `count` of these."""
        height = self.height // count
        return replace(
            self,
            width=self.width // count,
            height=height,
            fx=self.fx / count,
            fy=self.fy / count,
            cx=(self.cx - 0.5 * (count - 1)) / count,
            cy=(self.cy - 0.5 * (count - 1)) / count,
            # from the middle row of the first bins to that of the last ones
            readout_s=self.readout_s * count * (height - 1) / (self.height - 1),
        )

    @property
    def mean_focal_px(self) -> float:
        """Geometric mean of the two principal distances [px]."""
        return math.sqrt(self.fx * self.fy)

    def rows_since_middle(self, pixels: FloatArray) -> FloatArray:
        """Return how far pixels (n, 2) lie below the middle row, in frame heights: -0.5 … 0.5."""
        return pixels[:, 1] / (self.height - 1) - 0.5

    def delay_s(self, pixels: FloatArray) -> FloatArray:
        """Return how much later than the middle row pixels (n, 2) are exposed: (n,) [s]."""
        return self.readout_s * self.rows_since_middle(pixels)

    def project(self, points_camera: FloatArray) -> FloatArray:
        """Project points (n, 3) in the camera frame [m] to raw pixels (n, 2)."""
        return self.distort(points_camera[..., :2] / points_camera[..., 2:3])

    def project_circles(
        self, axes: FloatArray, centre_m: FloatArray, radii_m: FloatArray, circle: FloatArray
    ) -> FloatArray:
        """Project concentric circles in a plane to raw pixels (m, k, 2).

        Parameters
        ----------
        axes : (3, 2) or (3, 3) array
            Two perpendicular unit vectors of the plane, in the camera frame, as columns.
        centre_m : (3,) array
            In the camera frame [m].
        radii_m : (m,) array
            Of the circles.
        circle : (k, 2) array
            Points of the unit circle to project, in the coordinates of these axes.
        """
        pixels = np.empty((len(radii_m), len(circle), 2))
        distort_circles(self._lens, self._scale, axes, centre_m, radii_m, circle, pixels)
        return pixels

    def distort(self, normalised: FloatArray) -> FloatArray:
        """Map normalised coordinates (n, 2) to raw pixels (n, 2)."""
        pixels = np.empty(normalised.shape)
        points = np.asarray(normalised, dtype=np.float64).reshape(-1, 2)
        distort_points(self._lens, self._scale, points, pixels.reshape(-1, 2))
        return pixels

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Map raw pixels (n, 2) to normalised coordinates (n, 2).

        Newton's method with the analytic Jacobian converges to 1e-13. Pixels that the distortion
        model cannot reach, beyond its fold, are returned as NaN.
        """
        normalised = np.empty(np.shape(pixels))
        places = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        lens, found = self._lens, normalised.reshape(-1, 2)
        undistort_points(lens, self._scale, first_fold_r2(lens), places, found)
        return normalised

    def distort_jacobian(self, normalised: FloatArray) -> FloatArray:
        """Return the Jacobians (n, 2, 2) of `distort`: rows x, y [px], columns normalised x, y."""
        slopes = np.empty((*normalised.shape, 2))
        points = np.asarray(normalised, dtype=np.float64).reshape(-1, 2)
        fill_in_jacobians(self._lens, self._scale, points, slopes.reshape(-1, 2, 2))
        return slopes

    @property
    def _lens(self) -> Lens:
        return (self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6)

    @property
    def _scale(self) -> Scale:
        return (float(self.fx), float(self.fy), float(self.cx), float(self.cy))
