"""First-order corrections at edges: skew, smoothing along contours, light that varies.

**Skew.** A point spread with third cumulants κ adds −1/6 Σ κ_ijk ∂_ijk C to the blurred disc C;
this is the next term of its expansion after the Gaussian. C is approximated by an edge with the
disc's curvature.

**Smoothing along contours.** Noise reduction in cameras smooths along edges more than across them.
A lens's tails and sharpening change the second moment of the point spread without changing the
slope of edges. A smoothing of variance β along a contour of curvature k displaces it by ½ β k
towards its centre of curvature. So dots, inner circle and outer circle shrink by different lengths.
The blur's own effect of this kind is part of the blurred discs; β is the rest, of either sign.

**Light across edges.** Blur acts on the product of light and reflectance, not on each of them. Let
f be the contrast due to the light and S the white share, both blurred by a Gaussian of covariance
Σ. Then

    blurred(light · reflectance) = f S + ∇fᵀ Σ ∇S + …

The next term, Σ² ∇∇f ∇∇S / 2, is small if a penumbra is wider than the blur. In the penumbra of a
shadow the second term displaces edges by up to 0.1 px: all edges along the shadow in one direction.

Pixels are processed in batches, as in `kgcp.measurement.image_model.blurred_discs`, in loops
without branches that are vectorised.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.blur import EdgeIncidence

_BATCH = 32  # pixels
# Rows of a batch. Position on the plate from the circle's centre [m]; metres on the plate along x
# and along y per raw pixel to the right and down.
_X, _Y, _X_RIGHT, _X_DOWN, _Y_RIGHT, _Y_DOWN, *_OTHERS = range(0, 14 * _BATCH, _BATCH)
# Distance from the centre [m]; metres on the plate per pixel perpendicular to the edge; the edge's
# unit normal in the image, outwards; results.
_OUT, _PER_PX, _NORMAL_X, _NORMAL_Y, _FIRST, _SECOND, _THIRD, _FOURTH = _OTHERS
_MIN_DISTANCE_M = 1e-9  # keeps directions finite at a circle's centre
_SQUARINGS = 10
_PART = 0.5**_SQUARINGS
_MIN_EXPONENT = -200.0  # keeps the polynomial finite; the density is 0 there


def skew_rows(
    views: FloatArray, covariance: tuple[float, float, float], incidence: EdgeIncidence
) -> FloatArray:
    """Return the derivatives (4, n) of the white share by the point spread's third cumulants.

    Their order is xxx, xxy, xyy, yyy [1/px³].

    Parameters
    ----------
    views : (15, n) array
        Views of the pixels, by `kgcp.measurement.image_model.ray_plate.intersect_plate`.
    covariance : (3,) tuple
        Covariance of the blur: xx, yy, xy [px²].
    """
    rows = np.zeros((4, views.shape[1]))
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
    """Add −⅙ of the third derivatives of the blurred discs.

    Let n and t be the normal and the tangent of an edge, and ρ its radius of curvature in the
    image. The derivatives of the blurred disc C are ∂ₙₙₙC = (1 − z²) φ(z) / σ³ and, because of the
    curvature, ∂ₙₜₜC = C″/ρ − C′/ρ².
    """
    w = np.ones(14 * _BATCH)
    for c in range(len(circles)):
        radius_m, factor = circles[c, 2], -circles[c, 3] / 6.0
        for first in range(starts[c], starts[c + 1], _BATCH):
            pixels = members[first : min(first + _BATCH, starts[c + 1])]
            _gather_edges(views, circles[c], pixels, w)
            for j in range(_BATCH):
                nx, ny = w[_NORMAL_X + j], w[_NORMAL_Y + j]
                sd = math.sqrt(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny)
                z = (radius_m - w[_OUT + j]) / (w[_PER_PX + j] * sd)
                density = _density(z)
                along_m = _step_along(w, j)
                bend_px = max(w[_OUT + j] * w[_PER_PX + j] / (along_m * along_m), sd)
                third = (1.0 - z * z) * density / (sd * sd * sd)
                bent = (-z / (sd * sd) + 1.0 / (sd * bend_px)) * density / bend_px
                tx, ty = -ny, nx
                w[_FIRST + j] = factor * (third * nx * nx * nx + 3.0 * bent * nx * tx * tx)
                mixed = third * nx * nx * ny + bent * (2.0 * nx * tx * ty + tx * tx * ny)
                w[_SECOND + j] = 3.0 * factor * mixed
                mixed = third * nx * ny * ny + bent * (2.0 * ny * tx * ty + ty * ty * nx)
                w[_THIRD + j] = 3.0 * factor * mixed
                w[_FOURTH + j] = factor * (third * ny * ny * ny + 3.0 * bent * ny * ty * ty)
            _add_results(w, pixels, rows)


def smoothing_row(
    views: FloatArray, covariance: tuple[float, float, float], incidence: EdgeIncidence
) -> FloatArray:
    """Return the derivative (n,) of the white share by smoothing along contours [1/px²].

    Parameters are those of `skew_rows`.
    """
    rows = np.zeros((1, views.shape[1]))
    _add_smoothing(views, *covariance, incidence.circles, incidence.starts, incidence.members, rows)
    return np.asarray(rows[0])


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
    """Add the effect of the shrinking of discs by smoothing along contours.

    A step of one pixel along the contour in the image is a step t along the circle on the plate.
    For β = 1 px², the edge is displaced by t² / 2r on the plate.
    """
    w = np.ones(14 * _BATCH)
    for c in range(len(circles)):
        radius_m, sign = circles[c, 2], circles[c, 3]
        for first in range(starts[c], starts[c + 1], _BATCH):
            pixels = members[first : min(first + _BATCH, starts[c + 1])]
            _gather_edges(views, circles[c], pixels, w)
            for j in range(_BATCH):
                nx, ny = w[_NORMAL_X + j], w[_NORMAL_Y + j]
                sd_m = w[_PER_PX + j] * math.sqrt(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny)
                density = _density((radius_m - w[_OUT + j]) / sd_m) / sd_m
                along_m = _step_along(w, j)
                w[_FIRST + j] = -sign * density * along_m * along_m / (2.0 * radius_m)
            _add_results(w, pixels, rows)


def spread_share_gradient(
    views: FloatArray, covariance: tuple[float, float, float], incidence: EdgeIncidence
) -> FloatArray:
    """Return Σ ∇S (2, n) [px]: the blur's covariance times the white share's image gradient.

    Parameters are those of `skew_rows`.
    """
    rows = np.zeros((2, views.shape[1]))
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
    """Add Σ times the gradients of the blurred discs: −φ(z) / σ along the normals of edges."""
    w = np.ones(14 * _BATCH)
    for c in range(len(circles)):
        radius_m, sign = circles[c, 2], circles[c, 3]
        for first in range(starts[c], starts[c + 1], _BATCH):
            pixels = members[first : min(first + _BATCH, starts[c + 1])]
            _gather_edges(views, circles[c], pixels, w)
            for j in range(_BATCH):
                nx, ny = w[_NORMAL_X + j], w[_NORMAL_Y + j]
                sd = math.sqrt(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny)
                per_px_out = -sign * _density((radius_m - w[_OUT + j]) / (w[_PER_PX + j] * sd)) / sd
                w[_FIRST + j] = per_px_out * (xx * nx + xy * ny)
                w[_SECOND + j] = per_px_out * (xy * nx + yy * ny)
            _add_results(w, pixels, rows)


@inlined
def _gather_edges(views: FloatArray, circle: FloatArray, pixels: IndexArray, w: FloatArray) -> None:
    """Fill a batch with positions of pixels, and with normal and scale of a circle's edge there.

    If there are too few pixels for a batch, the remaining entries are never used.
    """
    for j in range(len(pixels)):
        i = pixels[j]
        w[_X + j], w[_Y + j] = views[0, i] - circle[0], views[1, i] - circle[1]
        w[_X_RIGHT + j], w[_X_DOWN + j] = views[2, i], views[3, i]
        w[_Y_RIGHT + j], w[_Y_DOWN + j] = views[4, i], views[5, i]
    for j in range(_BATCH):
        x, y = w[_X + j], w[_Y + j]
        out_m = max(math.sqrt(x * x + y * y), _MIN_DISTANCE_M)
        right = (x * w[_X_RIGHT + j] + y * w[_Y_RIGHT + j]) / out_m
        down = (x * w[_X_DOWN + j] + y * w[_Y_DOWN + j]) / out_m
        per_px = math.sqrt(right * right + down * down)
        w[_OUT + j], w[_PER_PX + j] = out_m, per_px
        w[_NORMAL_X + j], w[_NORMAL_Y + j] = right / per_px, down / per_px


@inlined
def _step_along(w: FloatArray, j: int) -> float:
    """Return the length along the circle on the plate [m] of one pixel along its contour."""
    nx, ny = w[_NORMAL_X + j], w[_NORMAL_Y + j]
    step_x = w[_X_DOWN + j] * nx - w[_X_RIGHT + j] * ny
    step_y = w[_Y_DOWN + j] * nx - w[_Y_RIGHT + j] * ny
    along_m: float = (w[_X + j] * step_y - w[_Y + j] * step_x) / w[_OUT + j]
    return along_m


@inlined
def _density(z: float) -> float:
    """Return the standard normal density, with a relative error of 5e-11 at z = 6.

    A library's exponential is not vectorised. Here it is a polynomial of the argument divided by
    2¹⁰, squared ten times.
    """
    x = max(-0.5 * z * z, _MIN_EXPONENT) * _PART
    power = 1.0 + x * (1.0 + x * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120)))))
    for _ in range(_SQUARINGS):
        power *= power
    return power / math.sqrt(2.0 * math.pi)


@inlined
def _add_results(w: FloatArray, pixels: IndexArray, rows: FloatArray) -> None:
    """Add the results of a batch to the rows (k, n) of its pixels."""
    for k in range(rows.shape[0]):
        for j in range(len(pixels)):
            rows[k, pixels[j]] += w[_FIRST + k * _BATCH + j]
