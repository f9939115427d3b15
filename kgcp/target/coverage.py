"""The plate under blur: white share of every pixel, with derivatives for the adjustment.

The plate is a sum of discs, white minus black: blur is linear, so every circle is blurred on its
own (`kgcp.target.profile`) and the results are added. Blur lives in the image; within its reach
the map from image to plate is taken as affine, pixel by pixel, so that a disc stays an exact circle
on the plate and the blur becomes an anisotropic Gaussian there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.target.bent_edge import (
    EdgeCoordinate,
    edge_coordinate,
    edge_level,
    smeared_edge,
    still_edge,
)
from kgcp.target.pairs import Blur, EdgePairs, Meeting, meet
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
    a = view.metres_per_px
    parts = _contributions(view, blur, pairs)
    total = np.empty((len(parts), a.shape[2]))
    for row, part in zip(total, parts, strict=True):
        row[:] = np.bincount(pairs.pixel, weights=pairs.sign * part, minlength=a.shape[2])
    jacobian = np.zeros((11, a.shape[2]))
    by_plate = jacobian[:3]
    np.multiply(total[1], view.slides[0], out=by_plate)
    by_plate += total[2] * view.slides[1]
    by_plate += total[3] * view.depth_gradient[:, None]
    arm = view.arms_m
    jacobian[3] = arm[1] * by_plate[2] - arm[2] * by_plate[1]
    jacobian[4] = arm[2] * by_plate[0] - arm[0] * by_plate[2]
    jacobian[5] = arm[0] * by_plate[1] - arm[1] * by_plate[0]
    by_xx = _quadratic(total[4:7], a[:, 0], a[:, 0])
    by_yy = _quadratic(total[4:7], a[:, 1], a[:, 1])
    jacobian[6] = by_xx + by_yy
    jacobian[7] = by_xx - by_yy
    jacobian[8] = 2.0 * _quadratic(total[4:7], a[:, 0], a[:, 1])
    if blur.has_streak:
        jacobian[9] = a[0, 0] * total[7] + a[1, 0] * total[8]
        jacobian[10] = a[0, 1] * total[7] + a[1, 1] * total[8]
    return WhiteShare(pairs.background + total[0], jacobian)


def white_level(view: PlateView, blur: Blur, pairs: EdgePairs) -> FloatArray:
    """Return the white share (n,) alone: the value of `white_share`."""
    spread, streak_m = _spread_on_plate(view.metres_per_px, blur), _streak_on_plate(view, blur)
    small = np.zeros(pairs.small.stop)
    for node, weight in _streak_nodes(blur):
        feel = meet(view.points_m + node * streak_m, spread, pairs, pairs.small)
        small += weight * _small_levels(feel, pairs)
    feel = meet(view.points_m, spread, pairs, pairs.large)
    along, across = _along_and_across(feel, streak_m, pairs)
    smear = np.abs(along) if blur.has_streak else None
    large = edge_level(_edge_of(feel, across, pairs), smear)
    values = pairs.sign * np.concatenate((small, large))
    shares = np.bincount(pairs.pixel, weights=values, minlength=len(pairs.background))
    return pairs.background + shares


def _contributions(view: PlateView, blur: Blur, pairs: EdgePairs) -> FloatArray:
    """Return what every pair contributes to its pixel.

    Only small circles need steps along a streak: for large ones it is integrated in closed form.

    Returns
    -------
    (9, m) array, or (7, m) without a streak
        White share; its derivative by the plate's motion along the two plate axes (sign of the
        slides); by the relative depth; by the blur's covariance on the plate, xx, xy, yy; by the
        two components of the streak on the plate.
    """
    spread, streak_m = _spread_on_plate(view.metres_per_px, blur), _streak_on_plate(view, blur)
    small = np.zeros((9, pairs.small.stop))
    for node, weight in _streak_nodes(blur):
        feel = meet(view.points_m + node * streak_m, spread, pairs, pairs.small)
        part = weight * _derivatives(feel, _small_discs(feel, pairs))
        small[:7] += part
        small[7:] -= node * part[1:3]
    feel = meet(view.points_m, spread, pairs, pairs.large)
    along, across = _along_and_across(feel, streak_m, pairs)
    edge = _edge_of(feel, across, pairs)
    if not blur.has_streak:
        return np.concatenate((small[:7], _derivatives(feel, still_edge(edge))), axis=1)
    disc, by_smear = smeared_edge(edge, np.abs(along))
    x, y = feel.x, feel.y
    by_along, by_across = np.sign(along) * by_smear, disc.d_var_tangential * across / 6.0
    by_streak = (by_along * x - by_across * y, by_along * y + by_across * x)
    large = np.concatenate((_derivatives(feel, disc), np.stack(by_streak)))
    turn = (by_along * across - by_across * along) / feel.rho  # of the streak against the circle
    large[1] += turn * y
    large[2] -= turn * x
    large[3] += by_along * along + by_across * across
    return np.concatenate((small, large), axis=1)


def _streak_on_plate(view: PlateView, blur: Blur) -> FloatArray:
    """Return the motion of every plate point during exposure (2, n) [m]."""
    a = view.metres_per_px
    streak: FloatArray = a[:, 0] * blur.streak_x + a[:, 1] * blur.streak_y
    return streak


def _along_and_across(
    feel: Meeting, streak_m: FloatArray, pairs: EdgePairs
) -> tuple[FloatArray, FloatArray]:
    """Return the streak's radial and tangential components at large circles [m]."""
    x, y = (row.take(pairs.pixel[pairs.large]) for row in streak_m)
    return x * feel.x + y * feel.y, y * feel.x - x * feel.y


def _edge_of(feel: Meeting, across: FloatArray, pairs: EdgePairs) -> EdgeCoordinate:
    """Return where pixels lie in large circles' edges; motion across bends them as blur does."""
    tangential = feel.tangential + across * across / 12.0
    return edge_coordinate(feel.rho, pairs.radius_m[pairs.large], feel.radial, tangential)


def _streak_nodes(blur: Blur) -> Iterable[tuple[float, float]]:
    """Return Gauss-Legendre nodes and weights over the exposure, from −1/2 to 1/2."""
    if not blur.has_streak:
        return ((0.0, 1.0),)
    spacing = _SIGMAS_PER_NODE * np.sqrt(min(blur.xx, blur.yy))
    count = max(3, round(np.hypot(blur.streak_x, blur.streak_y) / spacing))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return zip(0.5 * nodes, 0.5 * weights, strict=True)


def _spread_on_plate(a: FloatArray, blur: Blur) -> FloatArray:
    """Return the blur's covariance on the plate: xx, xy, yy as (3, n) [m²]."""
    x_side = blur.xx * a[:, 0] + blur.xy * a[:, 1]
    y_side = blur.xy * a[:, 0] + blur.yy * a[:, 1]
    spread = np.empty((3, a.shape[2]))
    spread[0] = x_side[0] * a[0, 0] + y_side[0] * a[0, 1]
    spread[1] = x_side[0] * a[1, 0] + y_side[0] * a[1, 1]
    spread[2] = x_side[1] * a[1, 0] + y_side[1] * a[1, 1]
    return spread


def _quadratic(matrix: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Return leftᵀ M right for symmetric 2 × 2 matrices given as xx, xy, yy."""
    form: FloatArray = (
        matrix[0] * left[0] * right[0]
        + matrix[1] * (left[0] * right[1] + left[1] * right[0])
        + matrix[2] * left[1] * right[1]
    )
    return form


def _derivatives(feel: Meeting, disc: Coverage) -> FloatArray:
    """Return the first seven rows of `_contributions` for some pairs."""
    x, y, radial, tangential, mixed = feel.x, feel.y, feel.radial, feel.tangential, feel.mixed
    x2, y2, product = x * x, y * y, x * y
    by_r, by_t, by_m = disc.d_var_radial, disc.d_var_tangential, disc.d_covariance
    # moving past a circle also turns the radial direction against the blur
    turn = (2.0 * (by_r - by_t) * mixed + by_m * (tangential - radial)) / feel.rho
    return np.stack(
        (
            disc.value,
            turn * y - disc.d_rho * x,
            -turn * x - disc.d_rho * y,
            2.0 * (by_r * radial + by_t * tangential + by_m * mixed),
            by_r * x2 + by_t * y2 - by_m * product,
            (by_r - by_t) * product + 0.5 * by_m * (x2 - y2),
            by_r * y2 + by_t * x2 + by_m * product,
        )
    )


def _small_discs(feel: Meeting, pairs: EdgePairs) -> Coverage:
    rows = np.empty((5, pairs.small.stop))
    for rule, at in pairs.small_groups:
        disc = blurred_disc(
            feel.rho[at],
            pairs.radius_m[at],
            feel.radial[at],
            feel.tangential[at],
            feel.mixed[at],
            rule,
        )
        rows[:, at] = (
            disc.value,
            disc.d_rho,
            disc.d_var_radial,
            disc.d_var_tangential,
            disc.d_covariance,
        )
    return Coverage(*rows)


def _small_levels(feel: Meeting, pairs: EdgePairs) -> FloatArray:
    levels = np.empty(pairs.small.stop)
    for rule, at in pairs.small_groups:
        levels[at] = blurred_level(
            feel.rho[at],
            pairs.radius_m[at],
            feel.radial[at],
            feel.tangential[at],
            feel.mixed[at],
            rule,
        )
    return levels
