"""What edges show beyond the Gaussian blur of an evenly lit plate, to first order.

**Skew.** A point spread with the third cumulants κ adds −1/6 Σ κ_ijk ∂_ijk C to the blurred disc C
(the next term of its expansion after the Gaussian). C is taken as that of an edge with the disc's
curvature.

**Smoothing along contours.** Noise reduction in cameras smooths along edges more than across them,
and a lens's tails and sharpening change the second moment of the point spread without changing how
steep edges are. A smoothing of variance β along a contour of curvature k displaces it by ½ β k
towards its centre of curvature: dots, inner and outer circle shrink, each by another length. The
blur's own share of that is in the blurred discs already; β is what there is beyond it, of either
sign.

**Light across edges.** Blur spreads light times reflectance, and not each of them alone. With f the
contrast that the light makes and S the white share, both blurred by a Gaussian of covariance Σ
already,

    blurred(light · reflectance) = f S + ∇fᵀ Σ ∇S + …

(the terms go on with Σ² ∇∇f ∇∇S / 2, small while a penumbra is wider than the blur). In the
penumbra of a shadow the second term displaces edges by up to 0.1 px, all edges along the shadow in
one direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.ray_plate import VIEW_ROWS, meet_plate


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
    return _summed_over_edges(_add_skew, 4, pose, rays, covariance, incidence)


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
    """Add −⅙ of the third derivatives of the blurred discs.

    Along normal n and tangent t of its edge, a disc that is blurred to C at the distance ρ from its
    centre has ∂ₙₙₙC = (1 − z²) φ(z) / σ³ and, since the edge is bent, ∂ₙₜₜC = C″/ρ − C′/ρ².
    """
    for c in range(len(circles)):
        radius_m, sign = circles[c, 2], circles[c, 3]
        for m in range(starts[c], starts[c + 1]):
            i = members[m]
            x, y = views[0, i] - circles[c, 0], views[1, i] - circles[c, 1]
            out_m, per_px, nx, ny = _across_edge(views, i, x, y)
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


def smoothing_row(
    pose: FloatArray,
    rays: FloatArray,
    covariance: tuple[float, float, float],
    incidence: EdgeIncidence,
) -> FloatArray:
    """Return the derivative (n,) of the white share by smoothing along contours [1/px²].

    Parameters are those of `skew_rows`.
    """
    (row,) = _summed_over_edges(_add_smoothing, 1, pose, rays, covariance, incidence)
    return np.asarray(row)


@compiled
def _add_smoothing(
    views: FloatArray,
    xx: float,
    yy: float,
    xy: float,
    circles: FloatArray,
    starts: IndexArray,
    members: IndexArray,
    rows: FloatArray,
) -> None:
    """Add by how much the discs shrink where contours are smoothed.

    A pixel's step along the contour in the image is a step t on the plate along the circle, whose
    edge is displaced by t² / 2r there.
    """
    for c in range(len(circles)):
        radius_m, sign = circles[c, 2], circles[c, 3]
        for m in range(starts[c], starts[c + 1]):
            i = members[m]
            x, y = views[0, i] - circles[c, 0], views[1, i] - circles[c, 1]
            out_m, per_px, nx, ny = _across_edge(views, i, x, y)
            sd_m = per_px * math.sqrt(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny)
            z = (radius_m - out_m) / sd_m
            density = math.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * sd_m)
            step_x = views[3, i] * nx - views[2, i] * ny
            step_y = views[5, i] * nx - views[4, i] * ny
            along_m = (x * step_y - y * step_x) / out_m
            rows[0, i] -= sign * density * along_m * along_m / (2.0 * radius_m)


def spread_share_gradient(
    pose: FloatArray,
    rays: FloatArray,
    covariance: tuple[float, float, float],
    incidence: EdgeIncidence,
) -> FloatArray:
    """Return Σ ∇S (2, n) [px]: the white share's gradient in the image, times the blur.

    Parameters are those of `skew_rows`; Σ is the covariance.
    """
    return _summed_over_edges(_add_gradient, 2, pose, rays, covariance, incidence)


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
    """Add Σ times the gradients of the blurred discs: −φ(z) / σ along the normals of edges."""
    for c in range(len(circles)):
        radius_m, sign = circles[c, 2], circles[c, 3]
        for m in range(starts[c], starts[c + 1]):
            i = members[m]
            x, y = views[0, i] - circles[c, 0], views[1, i] - circles[c, 1]
            out_m, per_px, nx, ny = _across_edge(views, i, x, y)
            sd = math.sqrt(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny)
            z = (radius_m - out_m) / (per_px * sd)
            per_px_out = -sign * math.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * sd)
            rows[0, i] += per_px_out * (xx * nx + xy * ny)
            rows[1, i] += per_px_out * (xy * nx + yy * ny)


def _summed_over_edges(
    add: Callable[..., None],
    count: int,
    pose: FloatArray,
    rays: FloatArray,
    covariance: tuple[float, float, float],
    incidence: EdgeIncidence,
) -> FloatArray:
    """Return what a kernel adds to rows (count, n) for the edges near every pixel."""
    views, rows = np.empty((VIEW_ROWS, rays.shape[1])), np.zeros((count, rays.shape[1]))
    meet_plate(pose, rays, views)
    add(views, *covariance, incidence.circles, incidence.starts, incidence.members, rows)
    return rows


@inlined
def _across_edge(
    views: FloatArray, i: int, x: float, y: float
) -> tuple[float, float, float, float]:
    """Return how a circle's edge lies in the image at pixel i, which is at (x, y) from its centre.

    Distance from the centre [m], metres on the plate per pixel square to the edge, and the unit
    normal of the edge in the image, outwards.
    """
    out_m = max(math.sqrt(x * x + y * y), 1e-9)
    right = (x * views[2, i] + y * views[4, i]) / out_m
    down = (x * views[3, i] + y * views[5, i]) / out_m
    per_px = math.sqrt(right * right + down * down)
    return out_m, per_px, right / per_px, down / per_px
