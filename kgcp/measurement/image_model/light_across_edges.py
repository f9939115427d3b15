"""Light that changes across an edge: what blur makes of the product of both.

Blur spreads light times reflectance, and not each of them alone. With f the contrast that the light
makes and S the white share, both blurred by a Gaussian of covariance Σ already,

    blurred(light · reflectance) = f S + ∇fᵀ Σ ∇S + …

(the terms go on with Σ² ∇∇f ∇∇S / 2, small while a penumbra is wider than the blur). In the
penumbra of a shadow the second term displaces edges by up to 0.1 px, all edges along the shadow in
one direction.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.ray_plate import VIEW_ROWS, across_edge, meet_plate


def spread_share_gradient(
    pose: FloatArray,
    rays: FloatArray,
    covariance: tuple[float, float, float],
    incidence: EdgeIncidence,
) -> FloatArray:
    """Return Σ ∇S (2, n) [px]: the white share's gradient in the image, times the blur.

    Parameters
    ----------
    pose : (3, 4) array
        `Pose.matrix`.
    rays : (6, n) array
        As of a window.
    covariance : (3,) tuple
        Σ, of the blur: xx, yy, xy [px²].
    """
    views, rows = np.empty((VIEW_ROWS, rays.shape[1])), np.zeros((2, rays.shape[1]))
    meet_plate(pose, rays, views)
    _add_gradient(views, *covariance, incidence.circles, incidence.starts, incidence.members, rows)
    return rows


@compiled
def _add_gradient(
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
            per_px_out = -sign * math.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * sd)
            rows[0, i] += per_px_out * (xx * nx + xy * ny)
            rows[1, i] += per_px_out * (xy * nx + yy * ny)
