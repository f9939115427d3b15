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
        x, y = rays[:2]
        about_x, about_y, about_z = self.rotation.velocity_rad_s
        # Ω × d for d = (x, y, 1), brought back to the third component 1
        across = about_x * y - about_y * x
        by_time = np.array((about_y - about_z * y - x * across, about_z * x - about_x - y * across))
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
    x, y = camera.undistort(centre_px[None])[0].tolist()
    # Ω × d for d = (x, y, 1), brought back to the third component 1
    by_rotation = np.array([[-x * y, 1.0 + x * x, -y], [-1.0 - y * y, x * y, x]])
    by_place = camera.distort_jacobian(np.array([x, y]))
    return np.asarray(_delay_s_px(camera) * by_place @ by_rotation)


def _delay_s_px(camera: Camera) -> float:
    """Return how much later a row is exposed than the one before it [s/px]."""
    return camera.readout_s / (camera.height - 1)
