"""Blurred discs: their share in each pixel, with derivatives (compiled; the inner loop).

A pixel sees the integral over a disc of the point spread, which is an anisotropic Gaussian
convolved with a motion. Over two dimensions it has no closed form. Along one direction it has;
along the other there are two rules (docs/method/image_model.md, "Blurred discs", derives both):

- If a disc is large compared with the blur, its edge is a parabola within the blur. The mean over
  that is a straight edge that is displaced, widened and skewed (`_add_straight`).
- If it is small, the integral is a sum over chords at equal steps of an angle (`_add_chords`).

Most of the measurement's time is spent here, so the code is written for speed. Pixels are processed
in batches, in loops without branches, so that they are vectorised. A batch is one flat array, row
after row. Derivatives are computed with the values, from the same intermediate results.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled, fused
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.quadrature import (
    BEND,
    CHORD_COUNTS,
    CHORDS,
    EXPONENTIAL,
    FAR,
    SQUARINGS,
    TAIL_RATIO,
    Quadrature,
)

_EDGE = float(Quadrature.EDGE)
# Limits of the motion's length, relative to the blur's σ, at which formulas change. The first two
# are limits of half the length. tests/measurement/image_model/test_blurred_discs.py compares the
# results on both sides of each with plain integration.
_SHORT_SMEAR = 0.2  # below, a series replaces differences, which would lose their digits
_MIN_SMEAR = 0.01  # chords take shorter motions as so long: the results are the same
_MIN_STREAK = 0.1  # below, the direction of the motion has no effect
_MIN_DISTANCE_M = 1e-12  # keeps directions finite at a circle's centre
_PER_ROOT_2PI = 1.0 / math.sqrt(2.0 * math.pi)
_BATCH = 16  # pixels: two to four full vectors, and all rows fit into the first-level cache
# Rows of a batch. Input: position on the plate from the circle's centre, blur and streak there.
_X, _Y, _XX, _XY, _YY, _STREAK_X, _STREAK_Y, *_RESULTS = range(0, 32 * _BATCH, _BATCH)
# Results: the white share, and its derivatives in the order of `render`.
_VALUE, _BY_X, _BY_Y, _BY_DEPTH, _BY_XX, _BY_XY, _BY_YY, _BY_STREAK_X, _BY_STREAK_Y = _RESULTS[:9]
# Intermediate values of `_add_chords`: directions of the chords, blur along and across them, sums.
_U, _V, _ALONG, _ACROSS, _MIXED, _SMEAR, _PER_SD, _PER_SD_ACROSS = _RESULTS[9:17]
_FIRST, _SIDEWAYS, _SECOND, _BY_SLOPE, _BY_WIDTH, _BY_HALF = _RESULTS[17:23]

_E0, _E1, _E2, _E3, _E4, _E5, _E6 = EXPONENTIAL
_R0, _R1, _R2, _R3, _R4, _R5, _R6, _R7 = TAIL_RATIO


@fused
def _normal(z: float) -> tuple[float, float]:
    """Return the standard normal distribution function, to 3e-8, and its density.

    `math.erf` has branches and is not vectorised. Here the density is a polynomial for exp(−z²/64),
    squared five times. The tail is the density times Mills' ratio, a polynomial in 1 / (1 + 0.3 z).
    The polynomials are fitted in `quadrature`.
    """
    far = min(abs(z), FAR)
    q = far * far * (0.5 / 2**SQUARINGS)
    q2 = q * q
    # Estrin's scheme: pairs of terms are independent of each other
    root = _E0 + _E1 * q + (_E2 + _E3 * q) * q2 + (_E4 + _E5 * q + _E6 * q2) * (q2 * q2)
    square = root * root
    square *= square
    square *= square
    square *= square
    density, t = _PER_ROOT_2PI * square * square, 1.0 / (1.0 + BEND * far)
    t2 = t * t
    low, high = _R0 + _R1 * t + (_R2 + _R3 * t) * t2, _R4 + _R5 * t + (_R6 + _R7 * t) * t2
    tail = density * (low + high * (t2 * t2))
    return (1.0 - tail if z > 0.0 else tail), density


@fused
def _long_smear(z: float, half: float) -> tuple[float, float, float, float, float]:
    """Return the mean of the normal distribution function over z − half … z + half.

    Returned are the mean, its derivatives by z and by `half`, and the densities at both ends. z
    Φ(z) + φ(z) is an antiderivative of Φ, so the mean is the difference of its values at the ends,
    divided by the length.
    """
    below_high, density_high = _normal(z + half)
    below_low, density_low = _normal(z - half)
    rise, both, per_length = below_high - below_low, below_high + below_low, 0.5 / half
    mean = (z * rise + half * both + density_high - density_low) * per_length
    by_half = (both - 2.0 * mean) * per_length
    return mean, rise * per_length, by_half, density_low, density_high


@fused
def _smeared_normal(
    z: float, half: float, slant: float, motion_t: float, smears: bool
) -> tuple[float, float, float, float]:
    """Return the mean of `_long_smear` for any length, its derivatives, and the skew of the edge.

    Without a streak (not `smears`) the length is 0.

    The skew is what a unit of the edge's curvature adds. It is the mean over the streak of φ(y)
    times (slant · y + motion_t · s)² − slant² − motion_t²/12. Here s is the position on the streak,
    −½ … ½, and y = z − 2 · half · s the blur along the radius. It has a closed form, too, from
    moments of φ between the ends of the streak. For short streaks, their differences would lose
    digits, and the first terms of a series in `half` are used.
    """
    (below, density), slanted, moved = _normal(z), slant * slant, motion_t * motion_t
    curving = (z * z - 1.0) * density
    if not smears:
        return below, density, 0.0, slanted * curving
    third, long = half * (1.0 / 3.0), max(half, _SHORT_SMEAR)
    mean, by_z, by_half, low, high = _long_smear(z, long)
    per_length, middle = 0.5 / long, 0.5 * (high + low)
    leaning, mixed = z * (high - low) * per_length - middle, (middle - by_z) * per_length
    apart = (by_z * (1.0 + z * z) + leaning) * per_length * per_length - by_z * (1.0 / 12.0)
    bent = 2.0 * slant * motion_t * mixed + moved * apart - slanted * (leaning + 2.0 * middle)
    if half < _SHORT_SMEAR:
        mean, by_half = below - 0.5 * z * density * half * third, -z * density * third
        by_z = density + 0.5 * curving * half * third
        bent = curving * (slanted + (slant * motion_t + moved * half * (1.0 / 30.0)) * third)
    return mean, by_z, by_half, bent


@fused
def _turned(x: float, y: float, xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """Return the blur's variances along and across a direction (x, y), and their covariance."""
    along = (xx * x + 2.0 * xy * y) * x + yy * y * y
    return along, xx + yy - along, (yy - xx) * x * y + xy * (x * x - y * y)


@fused
def _add_straight(w: FloatArray, radius: float, smears: bool, only_level: bool) -> None:
    """Compute a batch for a circle that is large compared with the blur, in closed form.

    Within the tangential blur ε, the circle is a parabola: the edge is at r − ε²/2r − ε⁴/8r³. Let v
    be the variance of ε. The mean shifts the edge inwards by v/2r + 3v²/8r³, and the variance
    v²/2r² widens it. Motion along the radius averages the profile over its length. Tangential
    motion shifts the edge like tangential blur, but widens it less: a uniform distribution has
    shorter tails than a Gaussian of the same variance.

    If blur or streak is oblique to the radius, its radial and tangential components are correlated,
    which changes the curvature term. The derivatives of this correction (a few per cent) are
    neglected.
    """
    bend = 0.5 / radius
    for j in range(_BATCH):
        rho = math.sqrt(w[_X + j] * w[_X + j] + w[_Y + j] * w[_Y + j]) + _MIN_DISTANCE_M
        per_rho = 1.0 / rho
        x, y = w[_X + j] * per_rho, w[_Y + j] * per_rho
        radial, across, mixed = _turned(x, y, w[_XX + j], w[_XY + j], w[_YY + j])
        motion_r = w[_STREAK_X + j] * x + w[_STREAK_Y + j] * y if smears else 0.0
        motion_t = w[_STREAK_Y + j] * x - w[_STREAK_X + j] * y if smears else 0.0
        streaked = motion_t * motion_t * (1.0 / 12.0)
        tangential, sag = across + streaked, (across + streaked) * bend
        widened = (2.0 * tangential * tangential - 1.2 * streaked * streaked) * bend * bend
        per_sd = 1.0 / math.sqrt(radial + widened)
        z = (radius - sag * (1.0 + 3.0 * sag * bend) - rho) * per_sd
        half = 0.5 * abs(motion_r) * per_sd
        # with the radial motion counted outwards
        outward_t = motion_t if motion_r > 0.0 else -motion_t
        level, by_z, by_half, bent = _smeared_normal(z, half, mixed * per_sd, outward_t, smears)
        w[_VALUE + j] = level - bent * bend * per_sd
        if only_level:
            continue
        by_rho, by_r = -by_z * per_sd, -0.5 * (by_z * z + by_half * half) * per_sd * per_sd
        by_t = 4.0 * tangential * bend * bend * by_r + bend * (1.0 + 6.0 * sag * bend) * by_rho
        by_length = (0.5 if motion_r > 0.0 else -0.5) * by_half * per_sd
        by_cross = by_t * motion_t * (1.0 / 6.0)
        turn = (2.0 * (by_r - by_t) * mixed + by_length * motion_t - by_cross * motion_r) * per_rho
        w[_BY_X + j], w[_BY_Y + j] = turn * y - by_rho * x, -turn * x - by_rho * y
        w[_BY_DEPTH + j] = 2.0 * (by_r * radial + by_t * tangential) + by_length * motion_r
        w[_BY_XX + j], w[_BY_XY + j] = by_r * x * x + by_t * y * y, (by_r - by_t) * x * y
        w[_BY_YY + j] = by_r * y * y + by_t * x * x
        w[_BY_STREAK_X + j] = by_length * x - by_cross * y
        w[_BY_STREAK_Y + j] = by_length * y + by_cross * x


@fused
def _add_chords(w: FloatArray, radius: float, rule: int, smears: bool, only_level: bool) -> None:
    """Compute a batch for a circle that is small compared with blur or streak, by chords.

    Chords are parallel to the streak, or to the radius if there is none. Each is weighted by the
    density of the blur across the chords. Along a chord, the blur conditional on the component
    across is Gaussian, too, and its integral has a closed form. The chord at r sin α represents a
    width of r cos α dα, which is half its length times dα.
    """
    for j in range(_BATCH):
        dx, dy = w[_X + j], w[_Y + j]
        u, v = (w[_STREAK_X + j], w[_STREAK_Y + j]) if smears else (dx, dy)
        length = math.sqrt(u * u + v * v)
        u, v = u / (length + _MIN_DISTANCE_M), v / (length + _MIN_DISTANCE_M)
        along, across, mixed = _turned(u, v, w[_XX + j], w[_XY + j], w[_YY + j])
        sd = math.sqrt(max(along - mixed * mixed / across, 1e-6 * along))
        w[_U + j], w[_V + j] = u, v
        w[_X + j], w[_Y + j] = dx * u + dy * v, dy * u - dx * v
        w[_ALONG + j], w[_ACROSS + j], w[_MIXED + j] = along, across, mixed
        w[_SMEAR + j] = max(length, 2.0 * _MIN_SMEAR * sd) if smears else 0.0
        w[_PER_SD + j], w[_PER_SD_ACROSS + j] = 1.0 / sd, 1.0 / math.sqrt(across)
        w[_VALUE + j] = w[_FIRST + j] = w[_SIDEWAYS + j] = w[_SECOND + j] = 0.0
        w[_BY_SLOPE + j] = w[_BY_WIDTH + j] = w[_BY_HALF + j] = 0.0
    for k in range(CHORD_COUNTS[rule]):
        at, half_length = radius * CHORDS[rule, 0, k], radius * CHORDS[rule, 1, k]
        nearest = np.inf
        for j in range(_BATCH):
            nearest = min(nearest, abs(at - w[_Y + j]) * w[_PER_SD_ACROSS + j])
        if nearest < FAR:  # otherwise the chord's weight is 0 for all pixels of the batch
            _add_chord(w, at, half_length, smears, only_level)
    for j in range(_BATCH):
        scale = math.pi / (CHORD_COUNTS[rule] + 1) * w[_PER_SD_ACROSS + j]
        w[_VALUE + j] *= scale
        if only_level:
            continue
        u, v, x, y = w[_U + j], w[_V + j], w[_X + j], w[_Y + j]
        along, across, mixed = w[_ALONG + j], w[_ACROSS + j], w[_MIXED + j]
        smear, per_sd, per_across = w[_SMEAR + j], w[_PER_SD + j], w[_PER_SD_ACROSS + j]
        first, by_slope = w[_FIRST + j] * scale * per_sd, w[_BY_SLOPE + j] * scale * per_sd
        ratio = mixed * per_across * per_across
        by_a = -0.5 * scale * w[_SECOND + j] * per_sd * per_sd
        by_c = 0.5 * scale * w[_BY_WIDTH + j] + (by_a * mixed - by_slope) * ratio
        by_c *= per_across * per_across
        by_m = by_slope * per_across * per_across - 2.0 * by_a * ratio
        by_x, by_smear = -first, 0.5 * scale * w[_BY_HALF + j] * per_sd
        by_y = scale * w[_SIDEWAYS + j] * per_across + first * ratio
        turn = by_x * y - by_y * x + 2.0 * mixed * (by_a - by_c) + by_m * (across - along)
        sideways = turn / smear if smear * per_across > _MIN_STREAK else 0.0
        w[_BY_X + j], w[_BY_Y + j] = by_y * v - by_x * u, -by_y * u - by_x * v
        w[_BY_DEPTH + j] = 2.0 * (by_a * along + by_c * across + by_m * mixed) + by_smear * smear
        w[_BY_XX + j] = by_a * u * u + by_c * v * v - by_m * u * v
        w[_BY_XY + j] = (by_a - by_c) * u * v + 0.5 * by_m * (u * u - v * v)
        w[_BY_YY + j] = by_a * v * v + by_c * u * u + by_m * u * v
        w[_BY_STREAK_X + j] = by_smear * u - sideways * v
        w[_BY_STREAK_Y + j] = by_smear * v + sideways * u


@fused
def _add_chord(
    w: FloatArray, at: float, half_length: float, smears: bool, only_level: bool
) -> None:
    """Add one chord to the sums of a batch."""
    for j in range(_BATCH):
        off, per_sd, per_across = at - w[_Y + j], w[_PER_SD + j], w[_PER_SD_ACROSS + j]
        off_sigmas = off * per_across
        _, density = _normal(off_sigmas)
        weight = half_length * density if abs(off_sigmas) < FAR else 0.0
        centre = w[_X + j] + w[_MIXED + j] * per_across * off_sigmas
        half_smear = 0.5 * w[_SMEAR + j] * per_sd
        far, near = (half_length - centre) * per_sd, (-half_length - centre) * per_sd
        if smears:
            below_far, by_far, by_half_far, _, _ = _long_smear(far, half_smear)
            below_near, by_near, by_half_near, _, _ = _long_smear(near, half_smear)
        else:
            (below_far, by_far), (below_near, by_near) = _normal(far), _normal(near)
            by_half_far = by_half_near = 0.0
        share = weight * (below_far - below_near)
        w[_VALUE + j] += share
        if only_level:
            continue
        slope, by_length = weight * (by_far - by_near), weight * (by_half_far - by_half_near)
        w[_FIRST + j] += slope
        w[_SIDEWAYS + j] += share * off_sigmas
        w[_SECOND + j] += weight * (by_far * far - by_near * near) + by_length * half_smear
        w[_BY_SLOPE + j] -= slope * off
        w[_BY_WIDTH + j] += share * (off_sigmas * off_sigmas - 1.0)
        w[_BY_HALF + j] += by_length


@fused
def _add(w: FloatArray, radius: float, rule: float, smears: bool, only_level: bool) -> None:
    if rule == _EDGE:
        _add_straight(w, radius, smears, only_level)
    else:
        _add_chords(w, radius, int(rule), smears, only_level)


@compiled
def render(
    views: FloatArray,
    blur: FloatArray,
    circles: FloatArray,
    starts: IndexArray,
    members: IndexArray,
    out: FloatArray,
) -> None:
    """Add to every pixel the contributions of the circles within reach.

    Parameters
    ----------
    views : (15, n) array
        Views of the pixels, by `intersect_plate`.
    blur : (5,) array
        xx, yy, xy [px²], streak x, y [px].
    circles, starts, members
        As in `EdgeIncidence`.
    out : (9, n) or (1, n) array
        Row 0: white share from the circles out of reach, to which that of the others is added. The
        other rows receive the derivatives of the share: by the plate's motion along its two axes,
        by the relative depth, by the blur on the plate xx, xy, yy and by the streak there x, y. (A
        rotation of the plate also changes the blur on it; this second-order effect is neglected.)
    """
    w = np.zeros(32 * _BATCH)
    only_level, smears = out.shape[0] == 1, blur[3] != 0.0 or blur[4] != 0.0
    for c in range(len(circles)):
        r, sign, rule = circles[c, 2], circles[c, 3], circles[c, 4]
        for first in range(starts[c], starts[c + 1], _BATCH):
            pixels = members[first : min(first + _BATCH, starts[c + 1])]
            _gather(views, blur, circles[c], pixels, w)
            if only_level:  # constant arguments: four versions without branches are compiled
                _add(w, r, rule, True, True) if smears else _add(w, r, rule, False, True)
            else:
                _add(w, r, rule, True, False) if smears else _add(w, r, rule, False, False)
            for j in range(len(pixels)):
                for k in range(out.shape[0]):
                    out[k, pixels[j]] += sign * w[_VALUE + k * _BATCH + j]


@fused
def _gather(
    views: FloatArray, blur: FloatArray, circle: FloatArray, pixels: IndexArray, w: FloatArray
) -> None:
    """Fill a batch with positions of pixels from the circle's centre, and the blur on the plate.

    The blur on the plate is A B Aᵀ, with the blur B in the image and the metres per pixel A (2, 2).
    If there are too few pixels for a batch, the last one is repeated.
    """
    for j in range(_BATCH):
        i = pixels[min(j, len(pixels) - 1)]
        w[_X + j], w[_Y + j] = views[0, i] - circle[0], views[1, i] - circle[1]
        w[_XX + j], w[_XY + j], w[_YY + j] = views[2, i], views[3, i], views[4, i]
        w[_STREAK_X + j] = views[5, i]
    xx, yy, xy, move_x, move_y = blur[0], blur[1], blur[2], blur[3], blur[4]
    for j in range(_BATCH):
        a, b, c, d = w[_XX + j], w[_XY + j], w[_YY + j], w[_STREAK_X + j]
        side_x, side_y = xx * a + xy * b, xy * a + yy * b
        w[_XX + j], w[_XY + j] = side_x * a + side_y * b, side_x * c + side_y * d
        w[_YY + j] = (xx * c + 2.0 * xy * d) * c + yy * d * d
        w[_STREAK_X + j], w[_STREAK_Y + j] = a * move_x + b * move_y, c * move_x + d * move_y
