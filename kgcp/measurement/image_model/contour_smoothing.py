"""Smoothing along contours: what it does to edges that are curved.

Noise reduction in cameras smooths along edges more than across them, and a lens's tails and
sharpening change the second moment of the point spread without changing how steep edges are. A
smoothing of variance β along a contour of curvature k displaces it by ½ β k towards its centre of
curvature: dots, inner and outer circle shrink, each by another length. The blur's own share of that
is in the blurred discs already; β is what there is beyond it, of either sign.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.ray_plate import VIEW_ROWS, across_edge, meet_plate


def smoothing_row(
    pose: FloatArray,
    rays: FloatArray,
    covariance: tuple[float, float, float],
    incidence: EdgeIncidence,
) -> FloatArray:
    """Return the derivative (n,) of the white share by smoothing along contours [1/px²].

    Parameters
    ----------
    pose : (3, 4) array
        `Pose.matrix`.
    rays : (6, n) array
        As of a window.
    covariance : (3,) tuple
        Of the blur: xx, yy, xy [px²].
    """
    views, row = np.empty((VIEW_ROWS, rays.shape[1])), np.zeros(rays.shape[1])
    meet_plate(pose, rays, views)
    _add_smoothing(views, *covariance, incidence.circles, incidence.starts, incidence.members, row)
    return row


@compiled
def _add_smoothing(
    views: FloatArray,
    xx: float,
    yy: float,
    xy: float,
    circles: FloatArray,
    starts: IndexArray,
    members: IndexArray,
    row: FloatArray,
) -> None:
    """Add the circles' shares.

    A pixel's step along the contour in the image is a step t on the plate along the circle, whose
    edge is displaced by t² / 2r there.
    """
    for c in range(len(circles)):
        radius_m, sign = circles[c, 2], circles[c, 3]
        for m in range(starts[c], starts[c + 1]):
            i = members[m]
            x, y = views[0, i] - circles[c, 0], views[1, i] - circles[c, 1]
            out_m, per_px, nx, ny = across_edge(views, i, x, y)
            sd_m = per_px * math.sqrt(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny)
            z = (radius_m - out_m) / sd_m
            density = math.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * sd_m)
            step_x = views[3, i] * nx - views[2, i] * ny
            step_y = views[5, i] * nx - views[4, i] * ny
            along_m = (x * step_y - y * step_x) / out_m
            row[i] -= sign * density * along_m * along_m / (2.0 * radius_m)
