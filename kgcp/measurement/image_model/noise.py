"""The likelihood of grey values: noise that follows the level, clipped and outlying pixels.

Noise is estimated from the plateaus of ink and plate, in between it grows linearly with the level
(shot noise); near edges it is inflated to what the residuals there show (jagged prints, JPEG).
Under a tone curve it is estimated in bands of the white share: the curve raises that of dark
levels, and demosaicing leaves most of it on the dark side of edges.
Clipped pixels are censored observations (Tobin): they only say "at least white". Outliers (dirt,
a finger of shadow, a hidden part) are weighted down as by a heavy-tailed distribution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray

OUTLIER_SIGMAS = 3.5
"""Farther from the model than so many standard deviations, a value is an outlier."""
# Sigmas short of the limit at which a clipped pixel pulls as strongly as an outlier.
_FARTHEST_CLIPPED = 3.23249
_MIN_NOISE_COUNTS = 0.3  # quantisation alone: 1/√12 of a grey value
_TRIM = 0.9
_TRIMMED_VARIANCE = 0.6230  # of a unit normal variable within its central 90 %
_MIN_SAMPLES = 8
# Of the variance of ink, that plate may have in it. What jagged edges scatter is not that: without
# a limit, the noise of ink was taken for none, and a tone curve did not settle.
_MOST_OF_PLATE = 0.1
# Values pile up at a top if it has more than this share of the pixels, and less than that lies just
# below, above this share of the top.
_PILED_UP, _BELOW_TOP = 0.05, 0.98
_MOST_SMEARED = 6  # grey values below the top in which smeared pixels are looked for
# Compression smears if these exceed the next six by this share of them: in 120 frames without it by
# 0.8 at most, unless the plate is at the top itself; in 200 JPEGs nearly always by 1 to 30. As long
# as the share was one of the clipped pixels, 0.15, the smears of large plates counted as exact: of
# burnt rings of R > 26 px in JPEGs of a known response, distances were off by 0.12 % (RMS), now by
# 0.005 %. What lies within so many standard deviations of the excess counts as clipped, too.
_SMEARED, _SMEAR_SIGMAS = 1.0, 2.5
# Beside edges, grey values pile up just below the top without compression, too: the blur ends
# there, and in colour one channel is clipped after the other. Compression smears over whole blocks.
# So among pixels just below the top, those with no darker one beside them must have at least this
# part of the share that they have among all near the top. In JPEGs of burnt discs of R 5 to 15 px
# (quality 75 to 97) they nearly always have 0.4 to 3 times that share. Without compression, where
# film's curve made 47 of 240 discs look smeared, they mostly have none. In six of the photographs
# `ros10`, 239 of 593 discs looked smeared by their edges alone; their centres scattered by 0.103 px
# and scatter by 0.085 px now.
_AWAY = 0.2

# Share of what a model exceeds a ceiling by that is compared with seen pixels. Without any, a model
# that is far too bright would not come back. Of burnt discs in JPEGs, radii were off by up to 0.16
# px without a ceiling, and are by 0.09 px.
_BEYOND_CLIPPING = 0.1

# Bands of the white share: limits and middles. They are narrow at both ends, where demosaicing and
# tone curves change the noise most. Errors of the flight `consumer` fell from 0.0103 to 0.0087 %.
_LIMITS = np.array([0.02, 0.15, 0.35, 0.65, 0.85, 0.98])
_MIDDLES = np.array([0.005, 0.07, 0.25, 0.5, 0.75, 0.93, 0.995])
_LINE_PIXELS = 10.0  # of a band, that the line between the variances of ink and plate is worth


@dataclass(frozen=True, slots=True, eq=False)
class Censoring:
    """Clipped pixels, and the limits that clip them."""

    # levels at and beyond which a value only says "at least" and "at most"
    high: float
    low: float
    # (n,): the pixels concerned
    at_high: BoolArray
    at_low: BoolArray
    # where light is clipped before its noise comes, which is that of compression; infinite: after
    ceiling: float = math.inf
    floor: float = -math.inf
    brightest: float = 1.0  # grey value that clipped white is seen with

    @property
    def is_clipped(self) -> BoolArray:
        """Which pixels (n,) are clipped, at either end."""
        return self.at_high | self.at_low

    @property
    def share(self) -> float:
        """Share of clipped pixels; 0 of none."""
        return float(np.count_nonzero(self.is_clipped) / max(len(self.at_high), 1))


def find_censoring(levels: FloatArray, levels_per_count: float, width: int) -> Censoring:
    """Find where a window is clipped: at the ends of the range, or where values pile up.

    Compression smears clipped pixels over some grey values below, which say no more than they do.
    Its errors come after clipping.

    Parameters
    ----------
    levels : (n,) array
        Grey values, 0…1 of the data type's range, row by row.
    levels_per_count : float
        Step from one grey value to the next.
    width : int
        Pixels of a row.
    """
    high, low = 1.0 - 0.5 * levels_per_count, 0.5 * levels_per_count
    top, near_top, near_bottom = float(levels.max()), *_pixels_near_ends(levels, levels_per_count)
    brightest = 1.0
    # a sensor of fewer bits than its files saturates below the end of the range
    if top < high:
        at_top = float(np.mean(levels == top))
        if at_top > _PILED_UP > float(np.mean(levels > _BELOW_TOP * top)) - at_top:
            high, brightest = top - 0.5 * levels_per_count, top
    of_top, of_bottom = (_smeared_over(number) for number in (near_top, near_bottom))
    if of_top and not _is_smeared_away(1.0 - levels, levels_per_count, width):
        of_top = 0
    if of_bottom and not _is_smeared_away(levels, levels_per_count, width):
        of_bottom = 0
    high, low = high - of_top * levels_per_count, low + of_bottom * levels_per_count
    ceiling, floor = 1.0 if of_top else math.inf, 0.0 if of_bottom else -math.inf
    return Censoring(high, low, levels >= high, levels <= low, ceiling, floor, brightest)


@compiled
def _pixels_near_ends(levels: FloatArray, levels_per_count: float) -> IndexArray:
    """Count pixels (2, 13) by their distance in grey values from the top and from the bottom."""
    number = np.zeros((2, 2 * _MOST_SMEARED + 1), np.intp)
    for level in levels:
        from_top, from_bottom = (1.0 - level) / levels_per_count, level / levels_per_count
        if from_top < number.shape[1] - 0.5:
            number[0, int(np.rint(from_top))] += 1
        if from_bottom < number.shape[1] - 0.5:
            number[1, int(np.rint(from_bottom))] += 1
    return number


def _smeared_over(number: IndexArray) -> int:
    """Return over how many grey values clipped pixels are smeared; 0 if they are not.

    Parameters
    ----------
    number : (13,) array of int
        Pixels by grey values from the end of the range.
    """
    if number[0] <= _MIN_SAMPLES:
        return 0
    steps = np.arange(1, _MOST_SMEARED + 1)
    excess = np.maximum(number[steps] - number[_MOST_SMEARED + 1 :].mean(), 0.0)
    least = max(_SMEARED * number[_MOST_SMEARED + 1 :].sum(), _MIN_SAMPLES)
    if not least <= excess.sum() <= number[0]:  # more of them are a plateau just below the end
        return 0
    return math.ceil(_SMEAR_SIGMAS * math.sqrt(float(excess @ steps**2 / excess.sum())))


@compiled
def _is_smeared_away(from_end: FloatArray, levels_per_count: float, width: int) -> bool:
    """Return whether pixels near an end of the range are smeared away from edges, too.

    Parameters
    ----------
    from_end : (n,) array
        Levels, as distances from the end.
    """
    reach, clipped = (_MOST_SMEARED + 0.5) * levels_per_count, 0.5 * levels_per_count
    height = len(from_end) // width
    near, smeared, away, smeared_away = 0, 0, 0, 0
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            middle = row * width + column
            if from_end[middle] >= reach:
                continue
            is_smeared, is_away = from_end[middle] >= clipped, True
            for place in (middle - width, middle, middle + width):
                for beside in (place - 1, place, place + 1):
                    is_away &= from_end[beside] < reach
            near += 1
            smeared += is_smeared
            away += is_away
            smeared_away += is_smeared and is_away
    return smeared_away > 0 and smeared_away * near >= _AWAY * smeared * away


@dataclass(frozen=True, slots=True, eq=False)
class GreyNoise:
    """Noise of n pixels."""

    sd: FloatArray  # (n,): as level
    plateau_sd: FloatArray  # (n,): without what only edges have


def estimate_noise(
    residuals: FloatArray,
    share: FloatArray,
    usable: BoolArray,
    levels_per_count: float,
    *,
    in_bands: bool = False,
    from_edges: bool = False,
    is_linear_in_share: bool = True,
) -> GreyNoise:
    """Return the noise of every pixel from the residuals of a fit.

    Parameters
    ----------
    residuals : (n,) array
        Observed − modelled levels.
    share : (n,) array
        White share.
    usable : (n,) array of bool
        Not clipped.
    levels_per_count : float
        Step from one grey value to the next.
    in_bands : bool
        Whether noise is estimated in bands of the share, instead of along a line from ink to plate.
    from_edges : bool
        Whether the noise of ink, or of plate, is taken from edges where there is too little of it.
    is_linear_in_share : bool
        Whether the variance is about linear in the share: then that of ink and of plate alone is
        told from pixels that have a little of the other one in them.
    """
    sd, plateau_sd = np.empty_like(residuals), np.empty_like(residuals)
    floor = (_MIN_NOISE_COUNTS * levels_per_count) ** 2
    _estimate(
        residuals, share, usable, floor, (in_bands, from_edges, is_linear_in_share), sd, plateau_sd
    )
    return GreyNoise(sd, plateau_sd)


@compiled
def _estimate(
    residuals: FloatArray,
    share: FloatArray,
    usable: BoolArray,
    floor: float,
    choices: tuple[bool, bool, bool],
    sd: FloatArray,
    plateau_sd: FloatArray,
) -> None:
    in_bands, from_edges, is_linear_in_share = choices
    ink, white = _plateau_variances(residuals, share, usable, floor, from_edges, is_linear_in_share)
    edge, of_edge = np.empty(len(share)), 0
    for i in range(len(share)):
        within = min(max(share[i], 0.0), 1.0)
        variance = max(ink + (white - ink) * within, floor)
        plateau_sd[i] = math.sqrt(variance)
        if usable[i] and 0.2 < within < 0.8:
            edge[of_edge] = residuals[i] * residuals[i] / variance
            of_edge += 1
    standardised = _trimmed_variance(edge[:of_edge])
    excess = 0.0 if math.isnan(standardised) else max(0.0, standardised - 1.0)
    if in_bands:
        of_band = _band_variances(residuals, share, usable, (ink, white, excess, floor))
        _interpolate(share, 0.5 * np.log(of_band), sd)
        return
    for i in range(len(share)):
        sd[i] = math.sqrt(_variance_at(share[i], ink, white, excess, floor))


@compiled
def _interpolate(share: FloatArray, log_sd: FloatArray, sd: FloatArray) -> None:
    """Fill in the deviations between those of the bands' middles, linear in the logarithm.

    Without a branch and without a library's exponential, so that vector units take several: its
    argument is halved ten times, and the power of it squared as often.
    """
    for i in range(len(share)):
        value = log_sd[0]
        for k in range(len(_MIDDLES) - 1):
            width = _MIDDLES[k + 1] - _MIDDLES[k]
            within = min(max(share[i] - _MIDDLES[k], 0.0), width)
            value += within * ((log_sd[k + 1] - log_sd[k]) / width)
        sd[i] = value
    for i in range(len(sd)):
        x = sd[i] * (1.0 / 1024.0)
        power = 1.0 + x * (1.0 + x * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120)))))
        for _ in range(10):
            power *= power
        sd[i] = power


@inlined
def _variance_at(share: float, ink: float, white: float, excess: float, floor: float) -> float:
    """Return the variance between those of ink and white, inflated towards the middle of edges."""
    within = min(max(share, 0.0), 1.0)
    return max(ink + (white - ink) * within, floor) * (1.0 + excess * 4.0 * within * (1.0 - within))


@compiled
def _band_variances(
    residuals: FloatArray,
    share: FloatArray,
    usable: BoolArray,
    of_line: tuple[float, float, float, float],
) -> FloatArray:
    """Return the variances of the bands, shrunk towards `_variance_at` where pixels are few."""
    ink, white, excess, floor = of_line
    squares, starts = _by_band(residuals, share, usable)
    variances = np.empty(len(_MIDDLES))
    for band in range(len(_MIDDLES)):
        variances[band] = _variance_at(_MIDDLES[band], ink, white, excess, floor)
        number = starts[band + 1] - starts[band]
        shown = _trimmed_variance(squares[starts[band] : starts[band + 1]])
        if not math.isnan(shown):
            weight = number / (number + _LINE_PIXELS)
            variances[band] = max(weight * shown + (1.0 - weight) * variances[band], floor)
    return variances


@compiled
def _by_band(
    residuals: FloatArray, share: FloatArray, usable: BoolArray
) -> tuple[FloatArray, IndexArray]:
    """Return the squares of usable residuals, band after band, and where each band starts."""
    bands, count = np.zeros(len(share), np.uint8), len(_MIDDLES)
    for limit in _LIMITS:
        for i in range(len(share)):
            bands[i] += share[i] >= limit
    starts = np.zeros(count + 1, np.intp)
    for i in range(len(share)):
        starts[bands[i] + 1] += usable[i]
    for band in range(count):
        starts[band + 1] += starts[band]
    squares, places = np.empty(starts[count]), starts.copy()
    for i in range(len(share)):
        if usable[i]:
            squares[places[bands[i]]] = residuals[i] * residuals[i]
            places[bands[i]] += 1
    return squares, starts


@compiled
def _plateau_variances(
    residuals: FloatArray,
    share: FloatArray,
    usable: BoolArray,
    floor: float,
    from_edges: bool,  # noqa: FBT001 - compiled functions have no keywords
    is_linear_in_share: bool,  # noqa: FBT001
) -> tuple[float, float]:
    """Return the variances of ink and plate.

    The pixels of a plateau have a little of the other one in them: of dark ink, whose noise is
    small, that is 3 to 8 % of the variance. So the line through both is taken to the ends. Of plain
    discs under an unknown tone curve it is not: that curve was learnt less well. If one plateau is
    not seen, it is that of the other, or what edges tell; if neither is, both are that of all
    pixels.
    """
    ink, of_ink = _mean_variance(residuals, share, usable, -math.inf, 0.15)
    white, of_white = _mean_variance(residuals, share, usable, 0.85, math.inf)
    is_ink_seen, is_white_seen = not math.isnan(ink), not math.isnan(white)
    if not (is_ink_seen or is_white_seen):
        variance, _ = _mean_variance(residuals, share, usable, -math.inf, math.inf)
        variance = floor if math.isnan(variance) else variance
        return variance, variance
    if not (is_ink_seen and is_white_seen):
        seen = ink if is_ink_seen else white
        at_edges, of_edges = _mean_variance(residuals, share, usable, 0.2, 0.8)
        if not from_edges or math.isnan(at_edges):
            return seen, seen
        if is_ink_seen:  # ink is no noisier than plate
            white, of_white = max(at_edges, seen), of_edges
        else:
            ink, of_ink = min(at_edges, seen), of_edges
    if not is_linear_in_share:
        of_ink = 0.0 if is_ink_seen else of_ink
        of_white = 1.0 if is_white_seen else of_white
    slope = (white - ink) / (of_white - of_ink)
    least_ink = (1.0 - _MOST_OF_PLATE) * ink if is_ink_seen else floor
    return max(ink - slope * of_ink, least_ink, floor), max(white + slope * (1.0 - of_white), floor)


@compiled
def _mean_variance(
    residuals: FloatArray, share: FloatArray, usable: BoolArray, low: float, high: float
) -> tuple[float, float]:
    """Return the variance of usable pixels with a share between limits, and their mean share."""
    squares, number, total = np.empty(len(share)), 0, 0.0
    for i in range(len(share)):
        if usable[i] and low < share[i] < high:
            squares[number] = residuals[i] * residuals[i]
            total += min(max(share[i], 0.0), 1.0)
            number += 1
    return _trimmed_variance(squares[:number]), total / max(number, 1)


@compiled
def median_at_edges(
    values: FloatArray, share: FloatArray, ink: float, plate: float, otherwise: float
) -> float:
    """Return the median of values (n,) where the white share (n,) is between two limits."""
    at_edges, count = np.empty(len(values)), 0
    for i in range(len(values)):
        if ink < share[i] < plate:
            at_edges[count] = values[i]
            count += 1
    return float(np.median(at_edges[:count])) if count else otherwise


@compiled
def _trimmed_variance(squares: FloatArray) -> float:
    """Return the variance of the central part, scaled to the whole; NaN if there are too few."""
    if len(squares) < _MIN_SAMPLES:
        return math.nan
    count = max(1, int(_TRIM * len(squares)))
    total = 0.0
    for square in np.partition(squares, count - 1)[:count]:
        total += square
    return total / (count * _TRIMMED_VARIANCE)


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """Negative log-likelihood of a window, and what Newton's method needs of it."""

    total: float  # up to a constant
    score: FloatArray  # (n,): its derivative with respect to the standardised model, times −1
    weight: FloatArray  # (n,): its second derivative, made positive


def misfit(levels: FloatArray, model: FloatArray, sd: FloatArray, censoring: Censoring) -> Misfit:
    """Compare observed and modelled levels (n,) under noise of standard deviation `sd` (n,).

    Far from the model the density of a seen pixel falls like a power of the distance, so that its
    loss grows as the logarithm; that of a clipped pixel falls exponentially, its loss grows
    linearly. Beyond where light is clipped before its noise comes, hardly anything of the model
    shows in a seen pixel.
    """
    clips = (censoring.at_low, censoring.at_high)
    limits = (censoring.low, censoring.high, censoring.floor, censoring.ceiling)
    return Misfit(*_misfit(levels, model, sd, *clips, limits))


@compiled
def _misfit(
    levels: FloatArray,
    model: FloatArray,
    sd: FloatArray,
    at_low: BoolArray,
    at_high: BoolArray,
    limits: tuple[float, float, float, float],
) -> tuple[float, FloatArray, FloatArray]:
    low, high, floor, ceiling = limits
    score, weight = np.empty_like(levels), np.empty_like(levels)
    total = 0.0
    for i in range(len(levels)):
        if at_low[i] or at_high[i]:
            sign, limit = (-1.0, low) if at_low[i] else (1.0, high)
            missing = sign * (limit - model[i]) / sd[i]
            near = min(missing, _FARTHEST_CLIPPED)
            tail = 0.5 * math.erfc(near * math.sqrt(0.5))
            hazard = math.exp(-0.5 * near * near) / (math.sqrt(2.0 * math.pi) * tail)
            total += hazard * (missing - near) - math.log(tail)
            score[i] = sign * hazard
            curvature = hazard * (hazard - near) if missing == near else hazard / missing
            weight[i] = max(curvature, 1e-9)
            continue
        nearest = min(max(model[i], floor), ceiling)
        slope = 1.0 if nearest == model[i] else _BEYOND_CLIPPING
        z = (levels[i] - nearest - slope * (model[i] - nearest)) / sd[i]
        square = z * z / (OUTLIER_SIGMAS * OUTLIER_SIGMAS)
        if square <= 1.0:
            total += 0.5 * z * z
            weight[i] = 1.0
        else:
            total += 0.5 * OUTLIER_SIGMAS * OUTLIER_SIGMAS * (1.0 + math.log(square))
            weight[i] = 1.0 / square
        score[i] = z * weight[i] * slope
        weight[i] *= slope * slope
    return total, score, weight


def outlier_share(found: Misfit, model: FloatArray, censoring: Censoring) -> float:
    """Return the share of seen pixels that count less than half; 1 if none is seen.

    Parameters
    ----------
    found : Misfit
        Of the pixels (n,).
    model : (n,) array
        Their modelled levels.
    censoring : Censoring
        Which of them are clipped, and where light is.
    """
    seen = ~censoring.is_clipped
    is_beyond = (model > censoring.ceiling) | (model < censoring.floor)
    half = np.where(is_beyond, 0.5 * _BEYOND_CLIPPING**2, 0.5)
    return float(np.mean((found.weight < half)[seen])) if seen.any() else 1.0
