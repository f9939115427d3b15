"""Rays over a frame: how well they are known, and how those of two cameras differ.

A shift of the principal point and a turn of the camera look nearly the same. What a user of a
camera meets is what is left after the best turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.calibration import (
    CALIBRATION_PARAMETERS,
    CalibrationCovariance,
    distort_jacobian_by_calibration,
)
from kgcp.geometry.camera import Camera

_GRID = 25  # points along the longer side of the frame


@dataclass(frozen=True, slots=True, eq=False)
class CameraDifference:
    """How another camera images the rays of a camera, apart from a turn."""

    pixels: FloatArray  # (n, 2) [px]
    shifts_px: FloatArray  # (n, 2): NaN where the model has no ray

    @property
    def sizes_px(self) -> FloatArray:
        """Lengths of the shifts that there are."""
        sizes = np.linalg.norm(self.shifts_px, axis=1)
        return np.asarray(sizes[np.isfinite(sizes)])

    @property
    def rms_px(self) -> float:
        """Root mean square of the shifts [px]."""
        return float(np.sqrt(np.mean(self.sizes_px**2)))

    @property
    def largest_px(self) -> float:
        """Largest shift [px]."""
        return float(self.sizes_px.max())


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """A grid of pixels and their rays."""

    shape: tuple[int, int]
    pixels: FloatArray  # (n, 2)
    normalised: FloatArray  # (n, 2): zeros where there is no ray
    is_there: BoolArray  # (n,)
    by_turn: FloatArray  # (2k, 3): orthonormal, of the k rays that there are

    @classmethod
    def of(cls, camera: Camera) -> _Rays:
        """Return the rays of a camera on an even grid of pixels."""
        rows = max(2, round(_GRID * camera.height / camera.width))
        across = np.linspace(0.0, camera.width - 1.0, _GRID)
        x, y = np.meshgrid(across, np.linspace(0.0, camera.height - 1.0, rows))
        pixels = np.column_stack((x.ravel(), y.ravel()))
        normalised = camera.undistort(pixels)
        is_there = np.all(np.isfinite(normalised), axis=1)
        normalised = np.where(is_there[:, None], normalised, 0.0)
        u, v = normalised.T
        turns = np.stack((u * v, -(1.0 + u * u), v, 1.0 + v * v, -u * v, -u), axis=1)
        by_turn = camera.distort_jacobian(normalised) @ turns.reshape(-1, 2, 3)
        basis = np.linalg.qr(by_turn[is_there].reshape(-1, 3))[0]
        return cls((rows, _GRID), pixels, normalised, is_there, basis)

    def without_turn(self, moved: FloatArray) -> FloatArray:
        """Return what (n, 2, …) is left of movements of the pixels, zeros where there is no ray."""
        kept = moved[self.is_there].reshape(2 * int(np.count_nonzero(self.is_there)), -1)
        left = np.zeros_like(moved)
        rest = kept - self.by_turn @ (self.by_turn.T @ kept)
        left[self.is_there] = rest.reshape(-1, *moved.shape[1:])
        return left


def ray_deviations_px(camera: Camera, covariance: CalibrationCovariance) -> FloatArray:
    """Return the standard deviation (h, w) of every ray of a grid over the frame [px]."""
    rays = _Rays.of(camera)
    by_camera = distort_jacobian_by_calibration(camera, rays.normalised)
    left = rays.without_turn(by_camera).reshape(-1, len(CALIBRATION_PARAMETERS))
    variances = np.einsum("ij,jk,ik->i", left, covariance.cov, left)
    sd = np.sqrt(np.maximum(variances, 0.0).reshape(-1, 2).sum(axis=1))
    return np.asarray(np.where(rays.is_there, sd, np.nan).reshape(rays.shape))


def compare_cameras(camera: Camera, other: Camera) -> CameraDifference:
    """Return where another camera images the rays of a camera, minus where this one does.

    Both are of the same frame size.
    """
    rays = _Rays.of(camera)
    shifts = rays.without_turn(other.distort(rays.normalised) - rays.pixels)
    is_there = rays.is_there[:, None]
    return CameraDifference(rays.pixels, np.where(is_there, shifts, np.nan))
