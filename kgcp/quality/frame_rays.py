"""Rays of a camera over the frame: their standard deviations, and differences between cameras.

A shift of the principal point has nearly the same effect as a rotation of the camera, and every
orientation absorbs rotations. What matters to a user is therefore what the best rotation leaves.
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
    """Difference between two cameras' images of the same rays, apart from a rotation."""

    pixels: FloatArray  # (n, 2): of the first camera [px]
    # (n, 2): pixel of the same ray in the other camera, minus this one; NaN: no ray
    shifts_px: FloatArray

    @property
    def sizes_px(self) -> FloatArray:
        """Lengths of the shifts, without NaN [px]."""
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

    shape: tuple[int, int]  # rows and columns
    pixels: FloatArray  # (n, 2)
    normalised: FloatArray  # (n, 2): zeros without a ray
    has_ray: BoolArray  # (n,)
    # (2k, 3): orthonormal basis of the displacements of the k pixels with a ray by rotations
    rotation_basis: FloatArray

    @classmethod
    def of(cls, camera: Camera) -> _Rays:
        """Return the rays of a camera on an even grid of pixels."""
        rows = max(2, round(_GRID * camera.height / camera.width))
        across = np.linspace(0.0, camera.width - 1.0, _GRID)
        x, y = np.meshgrid(across, np.linspace(0.0, camera.height - 1.0, rows))
        pixels = np.column_stack((x.ravel(), y.ravel()))
        normalised = camera.undistort(pixels)
        has_ray = np.all(np.isfinite(normalised), axis=1)
        normalised = np.where(has_ray[:, None], normalised, 0.0)
        u, v = normalised.T
        turns = np.stack((u * v, -(1.0 + u * u), v, 1.0 + v * v, -u * v, -u), axis=1)
        by_turn = camera.distort_jacobian(normalised) @ turns.reshape(-1, 2, 3)
        basis = np.linalg.qr(by_turn[has_ray].reshape(-1, 3))[0]
        return cls((rows, _GRID), pixels, normalised, has_ray, basis)

    def without_rotation(self, displacements: FloatArray) -> FloatArray:
        """Return displacements (n, 2, …) of the pixels minus the best rotation; 0 without a ray."""
        kept = displacements[self.has_ray].reshape(2 * int(np.count_nonzero(self.has_ray)), -1)
        residuals = np.zeros_like(displacements)
        residuals_of_kept = kept - self.rotation_basis @ (self.rotation_basis.T @ kept)
        residuals[self.has_ray] = residuals_of_kept.reshape(-1, *displacements.shape[1:])
        return residuals


def ray_deviations_px(camera: Camera, covariance: CalibrationCovariance) -> FloatArray:
    """Return the standard deviations (h, w) of rays on a grid over the frame [px]."""
    rays = _Rays.of(camera)
    by_camera = distort_jacobian_by_calibration(camera, rays.normalised)
    jacobian = rays.without_rotation(by_camera).reshape(-1, len(CALIBRATION_PARAMETERS))
    variances = np.einsum("ij,jk,ik->i", jacobian, covariance.cov, jacobian)
    sd = np.sqrt(np.maximum(variances, 0.0).reshape(-1, 2).sum(axis=1))
    return np.asarray(np.where(rays.has_ray, sd, np.nan).reshape(rays.shape))


def compare_cameras(camera: Camera, other: Camera) -> CameraDifference:
    """Return where another camera images the rays of a camera, minus where this one does.

    Both must have the same frame size.
    """
    rays = _Rays.of(camera)
    shifts = rays.without_rotation(other.distort(rays.normalised) - rays.pixels)
    has_ray = rays.has_ray[:, None]
    return CameraDifference(rays.pixels, np.where(has_ray, shifts, np.nan))
