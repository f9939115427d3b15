"""Rolling shutter: rows are exposed one after the other while the scene turns about the camera.

The pose of a target refers to the moment at which the row of its centre is exposed. At a time τ
later, the scene has turned by Ω τ. A pixel with the ray d then sees what the ray d − (Ω × d) τ
would have seen at the reference moment.
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
    """Exposure times of the pixels of a window, and the scene's rotation."""

    # (n,): time from the exposure of the row of the target's centre to that of each pixel [s]
    delay_s: FloatArray
    delay_s_px: float  # from one row to the next [s/px]
    rotation: SceneRotation

    @classmethod
    def of(
        cls, camera: Camera, rows: FloatArray, centre_row: float, rotation: SceneRotation
    ) -> Self:
        """Return the shutter for pixels in the rows (n,) of a camera's frame."""
        return cls((rows - centre_row) * _delay_s_px(camera), _delay_s_px(camera), rotation)

    def rays_at_one_moment(self, rays: FloatArray) -> FloatArray:
        """Return the rays that see the same at the moment when the target's centre is exposed.

        Parameters
        ----------
        rays : (6, n) array
            As `Window.rays`.

        Returns
        -------
        (6, n) array
            As `rays`. The derivatives include the delay from row to row.
        """
        by_time = np.tensordot(self.rotation.velocity_rad_s, ray_motions(*rays[:2]), axes=(0, 1))
        moved = rays.copy()
        moved[:2] -= by_time * self.delay_s
        moved[[3, 5]] -= by_time * self.delay_s_px
        return moved


def motion_per_row(camera: Camera, centre_px: FloatArray) -> FloatArray:
    """Return the motion of the image from one row to the next, per rate of rotation of the scene.

    Parameters
    ----------
    centre_px : (2,) array
        Position in the raw image.

    Returns
    -------
    (2, 3) array
        Derivatives of the motion [px/px] by the rotation about the camera's axes [rad/s].
    """
    ray = camera.undistort(centre_px[None])[0]
    by_place = camera.distort_jacobian(ray)
    return np.asarray(_delay_s_px(camera) * by_place @ ray_motions(*ray[:, None])[..., 0])


def ray_motions(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the velocity of rays (x, y, 1) when the scene turns.

    It is Ω × d for the rays d, projected so that the third component stays 1.

    Parameters
    ----------
    x, y : (n,) arrays

    Returns
    -------
    (2, 3, n) array
        Velocities of x and y per component of Ω [rad/s].
    """
    one = np.ones_like(x)
    return np.array([[-x * y, one + x * x, -y], [-one - y * y, x * y, x]])


def _delay_s_px(camera: Camera) -> float:
    """Return the time between the exposures of successive rows [s/px]."""
    return camera.readout_s / (camera.height - 1)
