"""Rows that are exposed one after the other, while the scene turns about the camera.

The pose of a target is that of the moment at which the row of its centre is exposed. At a time τ
after it, the scene has turned by Ω τ: a pixel looks along the ray d where, at the moment of the
centre, it would have looked along d − (Ω × d) τ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.measurement.plate_prior import SceneRotation


@dataclass(frozen=True, slots=True, eq=False)
class RollingShutter:
    """When the pixels of a window are exposed."""

    # (n,): how much later every pixel is exposed than the row of the target's centre [s]
    delay_s: FloatArray
    delay_s_px: float  # from one row to the next [s/px]
    rotation: SceneRotation  # of the scene meanwhile

    @classmethod
    def of(
        cls, camera: Camera, rows: FloatArray, centre_row: float, rotation: SceneRotation
    ) -> Self:
        """Return the delays of pixels in the rows (n,) of a camera's frame."""
        return cls((rows - centre_row) * _delay_s_px(camera), _delay_s_px(camera), rotation)

    def rays_at_one_moment(self, rays: FloatArray) -> FloatArray:
        """Return where pixels would have looked, had all been exposed with the target's centre.

        Parameters
        ----------
        rays : (6, n) array
            As of `Window.rays`.

        Returns
        -------
        (6, n) array
            As `rays`; the derivatives are those along the moved rows.
        """
        by_time = np.tensordot(self.rotation.velocity_rad_s, ray_motions(*rays[:2]), axes=(0, 1))
        moved = rays.copy()
        moved[:2] -= by_time * self.delay_s
        moved[[3, 5]] -= by_time * self.delay_s_px
        return moved


def motion_per_row(camera: Camera, centre_px: FloatArray) -> FloatArray:
    """Return by how much the image moves from one row to the next, per rotation of the scene.

    Parameters
    ----------
    centre_px : (2,) array
        Where in the raw image.

    Returns
    -------
    (2, 3) array
        Derivatives of the motion [px/px] by the rotation about the camera's axes [rad/s].
    """
    ray = camera.undistort(centre_px[None])[0]
    by_place = camera.distort_jacobian(ray)
    return np.asarray(_delay_s_px(camera) * by_place @ ray_motions(*ray[:, None])[..., 0])


def ray_motions(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return how rays (x, y, 1) move where the scene turns.

    That is Ω × d for the rays d, brought back to the third component 1.

    Parameters
    ----------
    x, y : (n,) arrays

    Returns
    -------
    (2, 3, n) array
        Derivatives of x and y by time, by each component of Ω [rad/s].
    """
    one = np.ones_like(x)
    return np.array([[-x * y, one + x * x, -y], [-one - y * y, x * y, x]])


def _delay_s_px(camera: Camera) -> float:
    """Return how much later a row is exposed than the one before it [s/px]."""
    return camera.readout_s / (camera.height - 1)
