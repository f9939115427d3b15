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
        delay_s_px = camera.readout_s / (camera.height - 1)
        return cls((rows - centre_row) * delay_s_px, delay_s_px, rotation)

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
