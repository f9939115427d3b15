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

KURTOSIS_SPREAD = 0.3
"""q of `kurtosis_row`; larger ones would reach beyond the pixels that feel an edge."""


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


def kurtosis_row(
    share: FloatArray,
    pose: FloatArray,
    rays: FloatArray,
    blur: FloatArray,
    incidence: EdgeIncidence,
) -> FloatArray:
    """Return the derivative (n,) of a white share by the excess kurtosis of the Gaussian spread.

    A spread that is half the Gaussian of covariance (1 + q) Σ and half that of (1 − q) Σ has the
    excess kurtosis 3 q² in all directions, and moments up to the third as if both were Σ. So the
    second difference of the share by q is what kurtosis does to it, whatever the sign.

    Parameters
    ----------
    share : (n,) array
        By `white_share`; the other parameters are those it is made with.
    """
    changed = np.zeros(len(share))
    for factor in (1.0 + KURTOSIS_SPREAD, 1.0 - KURTOSIS_SPREAD):
        of_factor = blur.copy()
        of_factor[:3] *= factor
        changed += white_share_only(pose, rays, of_factor, incidence).value
    return np.asarray((changed - 2.0 * share) / (6.0 * KURTOSIS_SPREAD**2))


def _rendered(
    pose: FloatArray, rays: FloatArray, blur: FloatArray, incidence: EdgeIncidence, rows: int
) -> tuple[FloatArray, FloatArray]:
    """Return views (15, n) and what is seen (rows, n)."""
    views, on_plate = views_of(pose, rays), np.zeros((rows, rays.shape[1]))
    on_plate[0] = incidence.background
    render(views, blur, incidence.circles, incidence.starts, incidence.members, on_plate)
    return views, on_plate
