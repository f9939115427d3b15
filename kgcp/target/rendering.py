"""The inner loop of the measurement, compiled: what blurred discs add to the pixels in reach."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from kgcp.compiled import compiled, inlined
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.target.quadrature import CHORD_COUNTS, CHORDS, Quadrature

_EDGE = float(Quadrature.EDGE)
_SHORTEST_SMEAR = 1e-3  # of the blur: below, differences of the profile lose their digits
_NOWHERE_M = 1e-12  # keeps directions finite in a circle's centre
_FAR = 6.0  # standard deviations beyond which there is nothing to 1e-9
_PER_SIGMA = 64  # entries of the table
_ENTRIES = np.arange(2 * _FAR * _PER_SIGMA + 1) / _PER_SIGMA - _FAR
_TABLE = np.stack((ndtr(_ENTRIES), np.exp(-0.5 * _ENTRIES**2) / math.sqrt(2.0 * math.pi)), axis=1)

_SHORTEST_STREAK = 0.1  # of the blur: below, it has no direction

_ChordProfile = tuple[float, float, float, float, float, float, float]
_EdgeProfile = tuple[float, float, float, float, float]
_Blur = tuple[float, float, float, float, float]  # on the plate: xx, xy, yy [m²], streak x, y [m]
_Contribution = tuple[float, float, float, float, float, float, float, float, float]


@inlined
def normal(z: float) -> tuple[float, float]:
    """Return the standard normal distribution function, to 1e-9, and its density.

    Taylor's series about the nearest entry of a table: several times faster than an exponential.
    """
    if abs(z) >= _FAR:
        return (0.0 if z < 0.0 else 1.0), 0.0
    entry = int((z + _FAR) * _PER_SIGMA + 0.5)
    below, density = _TABLE[entry, 0], _TABLE[entry, 1]
    at = entry / _PER_SIGMA - _FAR
    h, bend = z - at, 0.5 * (at * at - 1.0)
    third = at * (at * at - 3.0) / 6.0
    slope = 1.0 + h * (h * bend * (1.0 / 3.0) - 0.5 * at - 0.25 * third * h * h)
    return below + density * h * slope, density * (1.0 + h * (h * (bend - h * third) - at))


@inlined
def smeared_normal(z: float, half: float) -> tuple[float, float, float]:
    """Return the mean of the normal distribution function from z − half to z + half.

    And its derivatives by z and by `half`, which is at least 0.
    """
    if half == 0.0:
        below, density = normal(z)
        return below, density, 0.0
    half = max(half, _SHORTEST_SMEAR)
    high, low = z + half, z - half
    below_high, density_high = normal(high)
    below_low, density_low = normal(low)
    mean = (high * below_high - low * below_low + density_high - density_low) / (2.0 * half)
    by_half = (0.5 * (below_high + below_low) - mean) / half
    return mean, (below_high - below_low) / (2.0 * half), by_half


@inlined
def chord_profile(
    x: float,
    y: float,
    radius: float,
    along: float,
    across: float,
    mixed: float,
    smear: float,
    rule: int,
) -> _ChordProfile:
    """Return the coverage of a disc under Gaussian blur and a streak, from its chords.

    Parameters
    ----------
    x, y : float
        The point from the disc's centre, along the chords and across.
    radius : float
        Of the disc, in the same unit.
    along, across, mixed : float
        The blur's covariance in these directions, unit squared.
    smear : float
        Length of the streak, which is along the chords.
    rule : int
        A `Quadrature` by chords.

    Returns
    -------
    value : float
        0 outside, 1 inside.
    d_x, d_y, d_along, d_across, d_mixed, d_smear : float
        Its derivatives.
    """
    ratio = mixed / across
    conditional = max(along - mixed * ratio, 1e-6 * along)
    per_sd, per_sd_across = 1.0 / math.sqrt(conditional), 1.0 / math.sqrt(across)
    half_smear = 0.5 * smear * per_sd
    value = first = sideways = second = by_width = by_slope = by_half = 0.0
    for k in range(CHORD_COUNTS[rule]):
        off, half = radius * CHORDS[rule, 0, k] - y, radius * CHORDS[rule, 1, k]
        there = off * per_sd_across
        if abs(there) > _FAR:
            continue
        weight = half * normal(there)[1]
        centre = x + ratio * off
        far, near = (half - centre) * per_sd, (-half - centre) * per_sd
        below_far, by_far, by_half_far = smeared_normal(far, half_smear)
        below_near, by_near, by_half_near = smeared_normal(near, half_smear)
        share = weight * (below_far - below_near)
        slope = weight * (by_far - by_near)
        by_length = weight * (by_half_far - by_half_near)
        value += share
        first += slope
        sideways += share * there
        second += weight * (by_far * far - by_near * near) + by_length * half_smear
        by_slope -= slope * off
        by_width += share * (there * there - 1.0)
        by_half += by_length
    step = math.pi / (CHORD_COUNTS[rule] + 1) * per_sd_across
    by_conditional = -0.5 * step * second * per_sd * per_sd
    first *= step * per_sd
    by_slope *= step * per_sd
    by_across = 0.5 * step * by_width + (by_conditional * mixed - by_slope) * ratio
    return (
        step * value,
        -first,
        step * sideways * per_sd_across + first * ratio,
        by_conditional,
        by_across / across,
        by_slope / across - 2.0 * by_conditional * ratio,
        0.5 * step * by_half * per_sd,
    )


@inlined
def edge_profile(
    rho: float, radius: float, radial: float, tangential: float, smear: float
) -> _EdgeProfile:
    """Return the coverage of a disc that is large against the blur, in closed form.

    The chord that tangential blur reaches is a parabola. To second order it shifts the edge inwards
    by var_t/(2 r) + 3 var_t²/(8 r³) and widens it by var_t²/(2 r²). A uniform motion along the
    radial direction averages the profile over its length, the smear.

    Returns
    -------
    value : float
    d_rho, d_radial, d_tangential, d_smear : float
        Its derivatives.
    """
    bend = 0.5 / radius
    sag = tangential * bend
    sd = math.sqrt(radial + 2.0 * sag * sag)
    z = (radius - sag * (1.0 + 3.0 * sag * bend) - rho) / sd
    half = smear / (2.0 * sd)
    value, by_z, by_half = smeared_normal(z, half)
    by_variance = -0.5 * (by_z * z + by_half * half) / (sd * sd)
    by_depth = by_z / sd
    shift = bend + 6.0 * tangential * bend**3
    widening = 4.0 * tangential * bend * bend
    d_tangential = widening * by_variance - shift * by_depth
    return value, -by_depth, by_variance, d_tangential, by_half / (2.0 * sd)


@inlined
def _turned(x: float, y: float, xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """Return the blur's covariance along a direction, across it and mixed."""
    along = (xx * x + 2.0 * xy * y) * x + yy * y * y
    return along, xx + yy - along, (yy - xx) * x * y + xy * (x * x - y * y)


@inlined
def _small(dx: float, dy: float, radius: float, blur: _Blur, rule: int) -> _Contribution:
    """Return what a circle adds that is small against blur or streak.

    Returns
    -------
    value, along_x, along_y, approach, by_xx, by_xy, by_yy, streak_x, streak_y : float
        White share; its derivatives by the plate's motion along its two axes, by the relative
        depth, by the blur and by the streak on the plate.
    """
    xx, xy, yy, streak_x, streak_y = blur
    smear = math.sqrt(streak_x * streak_x + streak_y * streak_y)
    rho = math.sqrt(dx * dx + dy * dy) + _NOWHERE_M
    u, v = (streak_x / smear, streak_y / smear) if smear > 0.0 else (dx / rho, dy / rho)
    x, y = dx * u + dy * v, dy * u - dx * v
    along, across, mixed = _turned(u, v, xx, xy, yy)
    value, by_x, by_y, by_a, by_c, by_m, by_smear = chord_profile(
        x, y, radius, along, across, mixed, smear, rule
    )
    sideways = 0.0
    if smear > _SHORTEST_STREAK * math.sqrt(across):
        turn = by_x * y - by_y * x + 2.0 * mixed * (by_a - by_c) + by_m * (across - along)
        sideways = turn / smear
    return (
        value,
        by_y * v - by_x * u,
        -by_y * u - by_x * v,
        2.0 * (by_a * along + by_c * across + by_m * mixed) + by_smear * smear,
        by_a * u * u + by_c * v * v - by_m * u * v,
        (by_a - by_c) * u * v + 0.5 * by_m * (u * u - v * v),
        by_a * v * v + by_c * u * u + by_m * u * v,
        by_smear * u - sideways * v,
        by_smear * v + sideways * u,
    )


@inlined
def _large(dx: float, dy: float, radius: float, blur: _Blur) -> _Contribution:
    """Return what a circle adds that is large against the blur, as `_small` does.

    Motion across its edge bends it as blur does.
    """
    xx, xy, yy, streak_x, streak_y = blur
    rho = math.sqrt(dx * dx + dy * dy) + _NOWHERE_M
    x, y = dx / rho, dy / rho
    radial, tangential, mixed = _turned(x, y, xx, xy, yy)
    along, across = streak_x * x + streak_y * y, streak_y * x - streak_x * y
    value, by_rho, by_r, by_t, by_smear = edge_profile(
        rho, radius, radial, tangential + across * across / 12.0, abs(along)
    )
    by_along = by_smear if along > 0.0 else -by_smear
    by_across = by_t * across / 6.0
    turn = (2.0 * (by_r - by_t) * mixed + by_along * across - by_across * along) / rho
    approach = 2.0 * (by_r * radial + by_t * tangential) + by_along * along + by_across * across
    return (
        value,
        turn * y - by_rho * x,
        -turn * x - by_rho * y,
        approach,
        by_r * x * x + by_t * y * y,
        (by_r - by_t) * x * y,
        by_r * y * y + by_t * x * x,
        by_along * x - by_across * y,
        by_along * y + by_across * x,
    )


@compiled
def render(
    views: FloatArray,
    blur: FloatArray,
    circles: FloatArray,
    starts: IndexArray,
    members: IndexArray,
    out: FloatArray,
) -> None:
    """Add to every pixel what the circles in its reach contribute.

    Parameters
    ----------
    views : (15, n) array
        Points and scales of the pixels on the plate, by `meet_plate`.
    blur : (5,) array
        xx, yy, xy [px²], streak x, y [px].
    circles : (c, 5) array
        Centre x, y, radius, sign and rule of every circle.
    starts : (n + 1,) array, members : (m,) array
        The circles in reach of pixel i are members[starts[i]:starts[i + 1]].
    out : (9, n) or (1, n) array
        White share from circles out of reach; receives the share and, where there is room, its
        derivatives on the plate. That a turn of the plate changes the blur on it is left out: of
        second order.
    """
    is_level = out.shape[0] == 1
    for i in range(views.shape[1]):
        xx, xy, yx, yy = views[2, i], views[3, i], views[4, i], views[5, i]
        side_x, side_y = blur[0] * xx + blur[2] * xy, blur[2] * xx + blur[1] * xy
        there = (
            side_x * xx + side_y * xy,
            side_x * yx + side_y * yy,
            (blur[0] * yx + 2.0 * blur[2] * yy) * yx + blur[1] * yy * yy,
            xx * blur[3] + xy * blur[4],
            yx * blur[3] + yy * blur[4],
        )
        for m in range(starts[i], starts[i + 1]):
            c = members[m]
            dx, dy = views[0, i] - circles[c, 0], views[1, i] - circles[c, 1]
            radius, sign, rule = circles[c, 2], circles[c, 3], circles[c, 4]
            if is_level and rule == _EDGE:
                out[0, i] += sign * _large(dx, dy, radius, there)[0]
            elif is_level:
                out[0, i] += sign * _small(dx, dy, radius, there, int(rule))[0]
            else:
                if rule == _EDGE:
                    part = _large(dx, dy, radius, there)
                else:
                    part = _small(dx, dy, radius, there, int(rule))
                for k in range(9):
                    out[k, i] += sign * part[k]
