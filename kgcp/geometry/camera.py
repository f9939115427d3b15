"""The frame camera: Brown-Conrady distortion in OpenCV's order, exactly invertible.

Pixel (0, 0) is the centre of the top-left pixel; camera axes are x right, y down, z forward.
"Normalised" coordinates are (x/z, y/z) in that frame, free of distortion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.settings import require_range

_MAX_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-8  # convergence is quadratic: the step leaves its square


class Response(StrEnum):
    """How grey values follow light."""

    LINEAR = "linear"
    SRGB = "srgb"
    UNKNOWN = "unknown"


class TimeReference(StrEnum):
    """Which moment of the exposure the frames' times are of."""

    START = "start"
    MIDDLE = "middle"
    END = "end"

    def to_middle_s(self, exposure_time_s: float) -> float:
        """Return what leads from this moment to mid-exposure [s]."""
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
        Distortion coefficients in OpenCV's meaning and order (k4…k6: rational denominator).
    response : Response
        How grey values follow light.
    readout_s : float
        Rolling shutter: time from the first to the last row [s]; 0 is a global shutter.
    time_reference : TimeReference
        What the frames' times are of, before they are brought to mid-exposure.
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
    time_reference: TimeReference = TimeReference.MIDDLE

    def __post_init__(self) -> None:
        for key, size in (("width", self.width), ("height", self.height)):
            require_range(key, size, 2, 100_000, unit="px")
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
            if not math.isfinite(getattr(self, key)):
                raise SettingError(key, "is not a finite number", "give a number or leave it out")
        require_range("readout_s", self.readout_s, 0.0, 10.0, unit="s")

    @property
    def mean_focal_px(self) -> float:
        """Geometric mean of the two principal distances [px]."""
        return math.sqrt(self.fx * self.fy)

    def project(self, points_camera: FloatArray) -> FloatArray:
        """Project points (n, 3) in the camera frame [m] to raw pixels (n, 2)."""
        return self.distort(points_camera[..., :2] / points_camera[..., 2:3])

    def distort(self, normalised: FloatArray) -> FloatArray:
        """Map normalised coordinates (n, 2) to raw pixels (n, 2)."""
        distorted = self._distorted(normalised)
        return np.stack(
            (self.fx * distorted[..., 0] + self.cx, self.fy * distorted[..., 1] + self.cy), axis=-1
        )

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Map raw pixels (n, 2) to normalised coordinates (n, 2).

        Newton's method with the analytic Jacobian, to 1e-13; points that the distortion model
        cannot reach (beyond its fold) come back as NaN.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        wanted = np.stack(
            ((pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy), axis=-1
        )
        if not self._is_distorted:
            return wanted
        normalised = wanted.copy()
        step = np.full_like(wanted, np.inf)
        with np.errstate(all="ignore"):  # points beyond the fold diverge and become NaN below
            for _ in range(_MAX_NEWTON_STEPS):
                error = self._distorted(normalised) - wanted
                step = _solve_2x2(self._distorted_jacobian(normalised), error)
                normalised = normalised - step
                if not np.any(np.abs(step) > _NEWTON_TOLERANCE):
                    break
            lost = ~np.all(np.abs(step) <= _NEWTON_TOLERANCE, axis=-1)
        normalised[lost] = np.nan
        return normalised

    def distort_jacobian(self, normalised: FloatArray) -> FloatArray:
        """Return the derivatives (n, 2, 2) of `distort`: rows x, y [px], columns the input."""
        scale = np.array([[self.fx], [self.fy]])
        jacobian: FloatArray = self._distorted_jacobian(normalised) * scale
        return jacobian

    @property
    def _is_distorted(self) -> bool:
        return any((self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6))

    def _radial(self, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the radial factor and its derivative with respect to r²."""
        above = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        below = 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        slope_above = self.k1 + r2 * (2.0 * self.k2 + 3.0 * r2 * self.k3)
        slope_below = self.k4 + r2 * (2.0 * self.k5 + 3.0 * r2 * self.k6)
        factor = above / below
        return factor, (slope_above - factor * slope_below) / below

    def _distorted(self, normalised: FloatArray) -> FloatArray:
        x, y = normalised[..., 0], normalised[..., 1]
        r2 = x * x + y * y
        factor, _ = self._radial(r2)
        xy2 = 2.0 * x * y
        return np.stack(
            (
                x * factor + self.p1 * xy2 + self.p2 * (r2 + 2.0 * x * x),
                y * factor + self.p1 * (r2 + 2.0 * y * y) + self.p2 * xy2,
            ),
            axis=-1,
        )

    def _distorted_jacobian(self, normalised: FloatArray) -> FloatArray:
        x, y = normalised[..., 0], normalised[..., 1]
        factor, slope = self._radial(x * x + y * y)
        p1, p2 = self.p1, self.p2
        off_diagonal = 2.0 * (slope * x * y + p1 * x + p2 * y)
        xx = factor + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = factor + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        first = np.stack((xx, off_diagonal), axis=-1)
        second = np.stack((off_diagonal, yy), axis=-1)
        return np.stack((first, second), axis=-2)


def _solve_2x2(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve (n, 2, 2) systems by Cramer's rule: far faster than LAPACK on tiny matrices."""
    a, b = matrix[..., 0, 0], matrix[..., 0, 1]
    c, d = matrix[..., 1, 0], matrix[..., 1, 1]
    determinant = a * d - b * c
    x, y = right[..., 0], right[..., 1]
    return np.stack((d * x - b * y, a * y - c * x), axis=-1) / determinant[..., None]
