"""Point spreads that are not symmetric: what their third moments do to the edges.

A point spread with the third cumulants κ adds −1/6 Σ κ_ijk ∂_ijk C to the blurred disc C (the next
term of its expansion after the Gaussian). C is taken as that of an edge with the disc's curvature.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.ray_plate import VIEW_ROWS, across_edge, meet_plate

SKEW_ROWS = 4


def skew_rows(
    pose: FloatArray,
    rays: FloatArray,
    covariance: tuple[float, float, float],
    incidence: EdgeIncidence,
) -> FloatArray:
    """Return the derivatives (4, n) of the white share by the point spread's third cumulants.

    Their order is xxx, xxy, xyy, yyy [1/px³].

    Parameters
    ----------
    pose : (3, 4) array
        `Pose.matrix`.
    rays : (6, n) array
        As of a window.
    covariance : (3,) tuple
        Of the blur: xx, yy, xy [px²].
    """
    views, rows = np.empty((VIEW_ROWS, rays.shape[1])), np.zeros((SKEW_ROWS, rays.shape[1]))
    meet_plate(pose, rays, views)
    _add_skew(views, *covariance, incidence.circles, incidence.starts, incidence.members, rows)
    return rows


@compiled
def _add_skew(
    views: FloatArray,
    xx: float,
    yy: float,
    xy: float,
    circles: FloatArray,
    starts: IndexArray,
    members: IndexArray,
    rows: FloatArray,
) -> None:
    for c in range(len(circles)):
        radius_m, sign = circles[c, 2], circles[c, 3]
        for m in range(starts[c], starts[c + 1]):
            i = members[m]
            x, y = views[0, i] - circles[c, 0], views[1, i] - circles[c, 1]
            out_m, per_px, nx, ny = across_edge(views, i, x, y)
            sd = math.sqrt(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny)
            z = (radius_m - out_m) / (per_px * sd)
            density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
            out_px = max(out_m / per_px, sd)
            third = (1.0 - z * z) * density / (sd * sd * sd)
            bent = (-z / (sd * sd) + 1.0 / (sd * out_px)) * density / out_px
            tx, ty = -ny, nx
            factor = -sign / 6.0
            rows[0, i] += factor * (third * nx * nx * nx + 3.0 * bent * nx * tx * tx)
            rows[3, i] += factor * (third * ny * ny * ny + 3.0 * bent * ny * ty * ty)
            mixed = third * nx * nx * ny + bent * (2.0 * nx * tx * ty + tx * tx * ny)
            rows[1, i] += 3.0 * factor * mixed
            mixed = third * nx * ny * ny + bent * (2.0 * ny * tx * ty + ty * ty * nx)
            rows[2, i] += 3.0 * factor * mixed
