"""The plate under blur: white share of every pixel, with derivatives for the adjustment.

The plate is a sum of discs, white minus black: blur is linear, so every circle is blurred on its
own (`kgcp.target.profile`) and the results are added. Blur lives in the image; within its reach
the map from image to plate is taken as affine, pixel by pixel, so that a disc stays an exact circle
on the plate and the blur becomes an anisotropic Gaussian there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.target.pairs import Blur, EdgePairs
from kgcp.target.plate import PlateView
from kgcp.target.profile import (
    Coverage,
    blurred_disc,
    blurred_level,
)

_SIGMAS_PER_NODE = 0.9  # a streak is a row of Gaussians, so close that the row is smooth


@dataclass(frozen=True, slots=True, eq=False)
class WhiteShare:
    """White share of n pixels and its derivatives.

    Attributes
    ----------
    value : (n,) array
        0: ink, 1: plate.
    jacobian : (11, n) array
        With respect to translation [m], rotation vector [rad] (left perturbation in the camera
        frame), blur (xx + yy)/2, (xx − yy)/2, xy [px²] and streak x, y [px].
    """

    value: FloatArray
    jacobian: FloatArray


def white_share(view: PlateView, blur: Blur, pairs: EdgePairs) -> WhiteShare:
    """Return the white share of every pixel of a view, with derivatives."""
    nodes, weights = _streak_nodes(blur)
    a = view.metres_per_px
    spread = _spread_on_plate(a, blur)
    total = np.zeros((7, view.points_m.shape[1]))
    push = np.zeros((2, view.points_m.shape[1]))  # derivative by a shift of the plate point
    for node, weight in zip(nodes, weights, strict=True):
        shift = node * (a[:, 0] * blur.streak_x + a[:, 1] * blur.streak_y)
        part = weight * _sum_over_pairs(view.points_m + shift, spread, pairs)
        total += part
        push -= node * part[1:3]
    jacobian = np.empty((11, view.points_m.shape[1]))
    by_plate = jacobian[:3]
    np.multiply(total[1], view.slides[0], out=by_plate)
    by_plate += total[2] * view.slides[1]
    by_plate += total[3] * view.depth_gradient[:, None]
    arm = view.arms_m
    jacobian[3] = arm[1] * by_plate[2] - arm[2] * by_plate[1]
    jacobian[4] = arm[2] * by_plate[0] - arm[0] * by_plate[2]
    jacobian[5] = arm[0] * by_plate[1] - arm[1] * by_plate[0]
    by_xx = _quadratic(total[4:], a[:, 0], a[:, 0])
    by_yy = _quadratic(total[4:], a[:, 1], a[:, 1])
    jacobian[6] = by_xx + by_yy
    jacobian[7] = by_xx - by_yy
    jacobian[8] = 2.0 * _quadratic(total[4:], a[:, 0], a[:, 1])
    jacobian[9] = a[0, 0] * push[0] + a[1, 0] * push[1]
    jacobian[10] = a[0, 1] * push[0] + a[1, 1] * push[1]
    return WhiteShare(pairs.background + total[0], jacobian)


def white_level(view: PlateView, blur: Blur, pairs: EdgePairs) -> FloatArray:
    """Return the white share (n,) alone: the value of `white_share`."""
    nodes, weights = _streak_nodes(blur)
    a = view.metres_per_px
    spread = _spread_on_plate(a, blur)
    level = pairs.background.copy()
    for node, weight in zip(nodes, weights, strict=True):
        shift = node * (a[:, 0] * blur.streak_x + a[:, 1] * blur.streak_y)
        feel = _meet(view.points_m + shift, spread, pairs)
        parts = [
            blurred_level(
                feel.rho[at],
                pairs.radius_m[at],
                feel.radial[at],
                feel.tangential[at],
                feel.mixed[at],
                rule,
            )
            for rule, at in pairs.groups
        ]
        values = weight * pairs.sign * np.concatenate(parts)
        level += np.bincount(pairs.pixel, weights=values, minlength=len(level))
    return level


def _streak_nodes(blur: Blur) -> tuple[FloatArray, FloatArray]:
    """Return Gauss-Legendre nodes and weights over the exposure, from −1/2 to 1/2."""
    length = float(np.hypot(blur.streak_x, blur.streak_y))
    if length == 0.0:
        return np.zeros(1), np.ones(1)
    spacing = _SIGMAS_PER_NODE * float(np.sqrt(min(blur.xx, blur.yy)))
    nodes, weights = np.polynomial.legendre.leggauss(max(3, round(length / spacing)))
    return 0.5 * nodes, 0.5 * weights


def _spread_on_plate(a: FloatArray, blur: Blur) -> FloatArray:
    """Return the blur's covariance on the plate: xx, xy, yy as (3, n) [m²]."""
    left = np.stack((blur.xx * a[:, 0] + blur.xy * a[:, 1], blur.xy * a[:, 0] + blur.yy * a[:, 1]))
    return np.stack(
        (
            left[0, 0] * a[0, 0] + left[1, 0] * a[0, 1],
            left[0, 0] * a[1, 0] + left[1, 0] * a[1, 1],
            left[0, 1] * a[1, 0] + left[1, 1] * a[1, 1],
        )
    )


def _quadratic(matrix: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Return leftᵀ M right for symmetric 2 × 2 matrices given as xx, xy, yy."""
    form: FloatArray = (
        matrix[0] * left[0] * right[0]
        + matrix[1] * (left[0] * right[1] + left[1] * right[0])
        + matrix[2] * left[1] * right[1]
    )
    return form


def _sum_over_pairs(points_m: FloatArray, spread: FloatArray, pairs: EdgePairs) -> FloatArray:
    """Add up what every circle contributes to every pixel.

    Returns
    -------
    (7, n) array
        White share; its derivative by the plate's motion along the two plate axes (sign of the
        slides); by the relative depth; by the blur's covariance on the plate, xx, xy, yy.
    """
    count = points_m.shape[1]
    feel = _meet(points_m, spread, pairs)
    disc = _by_group(feel, pairs)
    x, y, radial, tangential, mixed = feel.x, feel.y, feel.radial, feel.tangential, feel.mixed
    x2, y2, product = x * x, y * y, x * y
    by_r, by_t, by_m = disc.d_var_radial, disc.d_var_tangential, disc.d_covariance
    # moving past a circle also turns the radial direction against the blur
    turn = (2.0 * (by_r - by_t) * mixed + by_m * (tangential - radial)) / feel.rho
    contributions = (
        disc.value,
        turn * y - disc.d_rho * x,
        -turn * x - disc.d_rho * y,
        2.0 * (by_r * radial + by_t * tangential + by_m * mixed),
        by_r * x2 + by_t * y2 - by_m * product,
        (by_r - by_t) * product + 0.5 * by_m * (x2 - y2),
        by_r * y2 + by_t * x2 + by_m * product,
    )
    total = np.empty((7, count))
    for row, values in enumerate(contributions):
        total[row] = np.bincount(pairs.pixel, weights=pairs.sign * values, minlength=count)
    return total


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """How m pixels stand to the circles whose edges they feel.

    Attributes
    ----------
    rho, x, y : (m,) array
        Distance from the circle's centre [m] and unit direction.
    radial, tangential, mixed : (m,) array
        The blur's covariance in these directions [m²].
    """

    rho: FloatArray
    x: FloatArray
    y: FloatArray
    radial: FloatArray
    tangential: FloatArray
    mixed: FloatArray


def _meet(points_m: FloatArray, spread: FloatArray, pairs: EdgePairs) -> Meeting:
    x = points_m[0].take(pairs.pixel) - pairs.centre_m[0]
    y = points_m[1].take(pairs.pixel) - pairs.centre_m[1]
    rho = np.sqrt(x * x + y * y) + 1e-12
    x /= rho
    y /= rho
    xx, xy, yy = (row.take(pairs.pixel) for row in spread)
    radial = (xx * x + 2.0 * xy * y) * x + yy * y * y
    return Meeting(
        rho=rho,
        x=x,
        y=y,
        radial=radial,
        tangential=xx + yy - radial,
        mixed=(yy - xx) * x * y + xy * (x * x - y * y),
    )


def _by_group(feel: Meeting, pairs: EdgePairs) -> Coverage:
    parts = [
        blurred_disc(
            feel.rho[at],
            pairs.radius_m[at],
            feel.radial[at],
            feel.tangential[at],
            feel.mixed[at],
            rule,
        )
        for rule, at in pairs.groups
    ]
    return Coverage(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("value", "d_rho", "d_var_radial", "d_var_tangential", "d_covariance")
        )
    )
