"""The plate under blur: white share of every pixel, with derivatives for the adjustment.

The plate is a sum of discs, white minus black: blur is linear, so every circle is blurred on its
own and the results are added. Blur lives in the image; within its reach the map from image to plate
is taken as affine, pixel by pixel, so that a disc stays an exact circle on the plate and the blur
becomes an anisotropic Gaussian there. `kgcp.measurement.image_model.blurred_discs` does it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.blurred_discs import render
from kgcp.measurement.image_model.ray_plate import (
    PLATE_ROWS,
    SLOPE_ROWS,
    carry_slopes,
    views_of,
)


@dataclass(frozen=True, slots=True, eq=False)
class WhiteShare:
    """White share of n pixels and its derivatives."""

    views: FloatArray  # (15, n): of the pixels, by `meet_plate`
    value: FloatArray  # (n,): 0: ink, 1: plate
    # (11, n): with respect to translation [m], rotation vector [rad] (left perturbation in the
    # camera frame), blur (xx + yy)/2, (xx − yy)/2, xy [px²] and streak x, y [px]; (0, n) by
    # `white_share_only`
    jacobian: FloatArray

    @property
    def points_m(self) -> FloatArray:
        """Where the pixels' rays meet the plate (2, n)."""
        return self.views[:2]


def white_share(
    pose: FloatArray, rays: FloatArray, blur: FloatArray, incidence: EdgeIncidence
) -> WhiteShare:
    """Return the white share of every pixel, with derivatives.

    Parameters
    ----------
    pose : (3, 4) array
        `Pose.matrix`.
    rays : (6, n) array
        As of a window.
    blur : (5,) array
        `Blur.vector`.
    """
    views, on_plate = _rendered(pose, rays, blur, incidence, PLATE_ROWS)
    slopes = np.empty((SLOPE_ROWS, rays.shape[1]))
    carry_slopes(pose, views, on_plate, slopes)
    return WhiteShare(views, on_plate[0], slopes)


def white_share_only(
    pose: FloatArray, rays: FloatArray, blur: FloatArray, incidence: EdgeIncidence
) -> WhiteShare:
    """Return the white share of every pixel without derivatives, at less than half the cost."""
    views, on_plate = _rendered(pose, rays, blur, incidence, 1)
    return WhiteShare(views, on_plate[0], np.empty((0, rays.shape[1])))


def _rendered(
    pose: FloatArray, rays: FloatArray, blur: FloatArray, incidence: EdgeIncidence, rows: int
) -> tuple[FloatArray, FloatArray]:
    """Return views (15, n) and what is seen (rows, n)."""
    views, on_plate = views_of(pose, rays), np.zeros((rows, rays.shape[1]))
    on_plate[0] = incidence.background
    render(views, blur, incidence.circles, incidence.starts, incidence.members, on_plate)
    return views, on_plate
