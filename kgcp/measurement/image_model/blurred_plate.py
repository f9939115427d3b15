"""The blurred plate: white share of every pixel, with derivatives for the adjustment.

The plate is a sum of white and black discs. Blur is linear, so each disc is blurred on its own and
the results are added. The blur is given in the image. Within its reach, the map from image to plate
is taken as affine, separately at each pixel. So a disc stays an exact circle on the plate, and the
blur becomes an anisotropic Gaussian there. `kgcp.measurement.image_model.blurred_discs` computes
the blurred discs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.blurred_discs import render
from kgcp.measurement.image_model.ray_plate import (
    JACOBIAN_ROWS,
    PLATE_ROWS,
    chain_to_parameters,
    plate_views,
)

KURTOSIS_STEP = 0.3
"""q of `kurtosis_row`; with a larger one, blur would reach beyond the incident pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class WhiteShare:
    """White share of n pixels and its derivatives."""

    views: FloatArray  # (15, n): views of the pixels, by `intersect_plate`
    value: FloatArray  # (n,): from ink, 0, to plate, 1
    # (11, n): derivatives by translation [m], rotation vector [rad] (left perturbation in the
    # camera frame), blur (xx + yy)/2, (xx − yy)/2, xy [px²] and streak x, y [px]. (0, n) from
    # `white_share_without_derivatives`.
    jacobian: FloatArray

    @property
    def points_m(self) -> FloatArray:
        """Points (2, n) where the pixels' rays meet the plate."""
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
        As in `Window`.
    blur : (5,) array
        `Blur.vector`.
    """
    views, on_plate = _rendered(pose, rays, blur, incidence, PLATE_ROWS)
    slopes = np.empty((JACOBIAN_ROWS, rays.shape[1]))
    chain_to_parameters(pose, views, on_plate, slopes)
    return WhiteShare(views, on_plate[0], slopes)


def white_share_without_derivatives(
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
    """Return the derivative (n,) of a white share by the excess kurtosis of the Gaussian part.

    The mean of two Gaussians with the covariances (1 + q) Σ and (1 − q) Σ has the excess kurtosis 3
    q² in all directions. Its moments up to the third are those of a Gaussian with covariance Σ. So
    the second difference of the share by q is the effect of kurtosis, which is linear and holds for
    either sign.

    Parameters
    ----------
    share : (n,) array
        Result of `white_share` with the other parameters.
    """
    changed = np.zeros(len(share))
    for factor in (1.0 + KURTOSIS_STEP, 1.0 - KURTOSIS_STEP):
        scaled = blur.copy()
        scaled[:3] *= factor
        changed += white_share_without_derivatives(pose, rays, scaled, incidence).value
    return np.asarray((changed - 2.0 * share) / (6.0 * KURTOSIS_STEP**2))


def _rendered(
    pose: FloatArray, rays: FloatArray, blur: FloatArray, incidence: EdgeIncidence, rows: int
) -> tuple[FloatArray, FloatArray]:
    """Return views (15, n), and the white share with derivatives on the plate (rows, n)."""
    views, on_plate = plate_views(pose, rays), np.zeros((rows, rays.shape[1]))
    on_plate[0] = incidence.background
    render(views, blur, incidence.circles, incidence.starts, incidence.members, on_plate)
    return views, on_plate
