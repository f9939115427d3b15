"""The likelihood of grey values: level-dependent noise, clipped pixels and outliers.

The noise variance is estimated on ink and on plate, and taken as linear in the level between them
(shot noise). Near edges it is inflated if the residuals there scatter more (jagged prints, JPEG).
Under a tone curve it is estimated in bands of the white share instead: the curve amplifies the
noise of dark levels, and demosaicing leaves most of its errors on the dark side of edges.

Clipped pixels are censored observations (Tobin): they only say "at least white". Outliers (dirt, a
narrow shadow, a hidden part) are downweighted, as if the distribution had heavy tails.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray

OUTLIER_SIGMAS = 3.5
"""A value farther from the model than this many standard deviations is an outlier."""
# Distance below the clipping limit, in σ, at which the score of a clipped pixel equals that of an
# outlier at its limit. Beyond, the score is kept constant.
_MAX_CLIPPED_SIGMAS = 3.23249
_MIN_NOISE_COUNTS = 0.3  # in grey values; quantisation alone makes 1/√12
_KEPT_SHARE = 0.9  # of the squared residuals, in the trimmed variance
_TRIMMED_VARIANCE = 0.6230  # of a unit normal variable, within its central 90 %
_MIN_SAMPLES = 8
# Largest share of the variance of ink pixels that is attributed to the plate in them. Residuals at
# jagged edges scatter for another reason. Without a limit, this scatter was subtracted from the
# noise of ink until nothing was left, and the tone curve did not converge.
_MAX_PLATE_IN_INK = 0.1
# A sensor that clips below full scale is recognised by equal values: more than the first share of
# the pixels has the largest value, and fewer lie just below it, down to the second share of that
# value.
_PILED_UP, _JUST_BELOW = 0.05, 0.98
# Compression smears clipped pixels over some grey values below the limit ("smeared" pixels). They
# are looked for in the next six grey values, and their number there is compared with that in the
# six below.
_MAX_SMEAR_COUNTS = 6
# Compression is detected if the six contain more pixels than the six below, by at least the first
# number times the latter. In 120 frames without compression this excess was at most 0.8, unless the
# plate itself was at the limit. In 200 JPEGs it was nearly always 1 to 30. Before, the excess was
# compared with 0.15 of the clipped pixels. Then the smeared pixels of large plates went undetected
# and counted as exact: burnt rings of R > 26 px in JPEGs with a known response had distances off by
# 0.12 % (RMS), now by 0.005 %. Pixels within the second number of standard deviations of the
# excess's distribution count as clipped, too.
_MIN_SMEAR_EXCESS, _SMEAR_SIGMAS = 1.0, 2.5
# Beside edges, grey values pile up just below the limit without compression, too: blur ends there,
# and in colour frames one channel clips after the other. But compression smears over whole blocks.
# Therefore smeared pixels must also show away from edges, that is among pixels without a darker
# neighbour. Their share there must be at least this fraction of their share among all pixels near
# the limit. In JPEGs of burnt discs of R 5 to 15 px (quality 75 to 97) the fraction is nearly
# always 0.4 to 3. Without compression it is mostly 0, even where film's curve made 47 of 240 discs
# look smeared. In six of the photographs `ros10`, 239 of 593 discs looked smeared because of their
# edges alone; with this test, the scatter of their centres fell from 0.103 px to 0.085 px.
_MIN_SMEARED_AWAY = 0.2
# Windows with fewer pixels within six grey values of the end do not tell smeared ones. Larger ones
# of `ros10` do: the scatter of its centres would be 0.080 instead of 0.076 px.
_TELLING_PIXELS = 100
# Of the few pixels of a small disc, this share must be smeared (of more, eight pixels). With at
# least eight in any case, single burnt bright discs in JPEGs of quality 92 were too large by 0.28
# px at R 2.5 px and 0.14 px at 3 px, now by 0.19 and 0.05 px.
_SMEARED_OF_FEW = 0.2
# Largest shares of clipped pixels at which both levels are well seen: of all, and of the bright
# ones, since a small bright disc fills little of its window
_MUCH_CLIPPED, _MUCH_OF_BRIGHT = 0.05, 0.1

# If light is clipped before the noise is added (`Censoring.ceiling`), pixels below the clipping
# limit are compared with the clipped model. This share of the model's excess over the ceiling still
# counts: without it, a model that is far too bright would never come back. Radii of burnt discs in
# JPEGs were off by up to 0.16 px without a ceiling, now by up to 0.09 px.
_BEYOND_CLIPPING = 0.1

# Limits and middles of the bands of the white share. They are narrow at both ends, where
# demosaicing and tone curves change the noise most. With bands, distance errors of the flight
# `consumer` fell from 0.0103 to 0.0087 %.
_BAND_LIMITS = np.array([0.02, 0.15, 0.35, 0.65, 0.85, 0.98])
_BAND_MIDDLES = np.array([0.005, 0.07, 0.25, 0.5, 0.75, 0.93, 0.995])
# The variance of a band is a weighted mean of its own and of that on the line between ink and
# plate. The line weighs as much as this many pixels.
_LINE_PIXELS = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Censoring:
    """Clipped pixels, and the levels at which they are clipped."""

    # levels from which on a value only says "at least" or "at most"
    high: float
    low: float
    # (n,): which pixels are clipped
    at_high: BoolArray
    at_low: BoolArray
    # Levels at which light is clipped before the noise is added, as that of compression is.
    # Infinite if it is clipped after.
    ceiling: float = math.inf
    floor: float = -math.inf
    brightest: float = 1.0  # level of clipped white in the frame

    @property
    def is_clipped(self) -> BoolArray:
        """Whether each pixel (n,) is clipped, at either end."""
        return self.at_high | self.at_low

    @property
    def share(self) -> float:
        """Share of clipped pixels; 0 if there are no pixels."""
        return float(np.count_nonzero(self.is_clipped) / max(len(self.at_high), 1))

    def hides_a_level(self, levels: FloatArray) -> bool:
        """Tell whether a level is hardly seen, since its pixels (n,) are clipped."""
        middle = 0.5 * float(np.min(levels, initial=1.0) + np.max(levels, initial=0.0))
        bright = max(int(np.count_nonzero(levels > middle)), 1)
        return bool(
            self.share > _MUCH_CLIPPED or np.count_nonzero(self.at_high) > _MUCH_OF_BRIGHT * bright
        )


def find_censoring(
    levels: FloatArray, levels_per_count: float, width: int, smear: tuple[int, int] = (0, 0)
) -> Censoring:
    """Find the levels at which a window is clipped, and its clipped pixels.

    These levels are the ends of the range, or where values pile up below them. If compression has
    smeared clipped pixels over some neighbouring grey values, these count as clipped, too. Errors
    of compression are added after clipping: then `ceiling` and `floor` are set.

    Parameters
    ----------
    levels : (n,) array
        Grey values, 0…1 of the data type's range, in row-major order.
    levels_per_count : float
        Step from one grey value to the next.
    width : int
        Pixels of a row.
    smear : (int, int)
        By `find_smear`, of the whole photograph. It counts if the window has too few pixels near
        the end of the range to tell.
    """
    high, low = 1.0 - 0.5 * levels_per_count, 0.5 * levels_per_count
    top, brightest = float(levels.max()), 1.0
    # a sensor with fewer bits than its files saturates below the end of the range
    if top < high:
        at_top = float(np.mean(levels == top))
        if at_top > _PILED_UP > float(np.mean(levels > _JUST_BELOW * top)) - at_top:
            high, brightest = top - 0.5 * levels_per_count, top
    top_smear, bottom_smear = find_smear([(levels, width)], levels_per_count)
    if any(smear):
        near = _pixels_near_ends(levels, levels_per_count)[:, : _MAX_SMEAR_COUNTS + 1].sum(axis=1)
        of_all_top, of_all_bottom = np.where(near < _TELLING_PIXELS, smear, 0).tolist()
        top_smear, bottom_smear = max(top_smear, of_all_top), max(bottom_smear, of_all_bottom)
    high, low = high - top_smear * levels_per_count, low + bottom_smear * levels_per_count
    ceiling, floor = 1.0 if top_smear else math.inf, 0.0 if bottom_smear else -math.inf
    return Censoring(high, low, levels >= high, levels <= low, ceiling, floor, brightest)


def find_smear(
    windows: Sequence[tuple[FloatArray, int]], levels_per_count: float
) -> tuple[int, int]:
    """Return over how many grey values compression has smeared clipped pixels, at top and bottom.

    It is 0 if it has not. The windows of small discs tell it only together.

    Parameters
    ----------
    windows : sequence of ((n,) array, int)
        Grey values and pixels of a row, as for `find_censoring`.
    """
    near = np.sum([_pixels_near_ends(each, levels_per_count) for each, _ in windows], axis=0)
    top, bottom = (_smear_counts(number) for number in near)
    if top and not _is_smeared_away([(1.0 - each, w) for each, w in windows], levels_per_count):
        top = 0
    if bottom and not _is_smeared_away(windows, levels_per_count):
        bottom = 0
    return top, bottom


@compiled
def _pixels_near_ends(levels: FloatArray, levels_per_count: float) -> IndexArray:
    """Return the numbers of pixels (2, 13) that are 0…12 grey values from top and from bottom."""
    number = np.zeros((2, 2 * _MAX_SMEAR_COUNTS + 1), np.intp)
    for level in levels:
        from_top, from_bottom = (1.0 - level) / levels_per_count, level / levels_per_count
        if from_top < number.shape[1] - 0.5:
            number[0, int(np.rint(from_top))] += 1
        if from_bottom < number.shape[1] - 0.5:
            number[1, int(np.rint(from_bottom))] += 1
    return number


def _smear_counts(number: IndexArray) -> int:
    """Return over how many grey values compression has smeared clipped pixels; 0 if it has not.

    Parameters
    ----------
    number : (13,) array of int
        Number of pixels by their distance from the end of the range, in grey values.
    """
    fewest = min(_SMEARED_OF_FEW * number[: _MAX_SMEAR_COUNTS + 1].sum(), _MIN_SAMPLES)
    if number[0] <= fewest:
        return 0
    steps = np.arange(1, _MAX_SMEAR_COUNTS + 1)
    excess = np.maximum(number[steps] - number[_MAX_SMEAR_COUNTS + 1 :].mean(), 0.0)
    least = max(_MIN_SMEAR_EXCESS * number[_MAX_SMEAR_COUNTS + 1 :].sum(), fewest)
    if not least <= excess.sum() <= number[0]:  # more than are clipped: a plateau near the end
        return 0
    return math.ceil(_SMEAR_SIGMAS * math.sqrt(float(excess @ steps**2 / excess.sum())))


def _is_smeared_away(windows: Sequence[tuple[FloatArray, int]], levels_per_count: float) -> bool:
    """Return whether pixels near an end of the range are smeared away from edges, too.

    Parameters
    ----------
    windows : sequence of ((n,) array, int)
        Distances of the levels from the end of the range, and pixels of a row.
    """
    counts = [_count_smeared(from_end, levels_per_count, width) for from_end, width in windows]
    near, smeared, away, smeared_away = np.sum(counts, axis=0).tolist()
    return bool(smeared_away > 0 and smeared_away * near >= _MIN_SMEARED_AWAY * smeared * away)


@compiled
def _count_smeared(
    from_end: FloatArray, levels_per_count: float, width: int
) -> tuple[int, int, int, int]:
    """Count the pixels near an end of the range: all, smeared, away from edges, and both."""
    reach, clipped = (_MAX_SMEAR_COUNTS + 0.5) * levels_per_count, 0.5 * levels_per_count
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
    return near, smeared, away, smeared_away


@dataclass(frozen=True, slots=True, eq=False)
class GreyNoise:
    """Standard deviations of n pixels' noise, as levels."""

    sd: FloatArray  # (n,)
    plateau_sd: FloatArray  # (n,): without the excess at edges


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
    """Estimate the noise of every pixel from the residuals of a fit.

    Parameters
    ----------
    residuals : (n,) array
        Observed − modelled levels.
    share : (n,) array
        White share.
    usable : (n,) array of bool
        Pixels to estimate from: those that are not clipped.
    levels_per_count : float
        Step from one grey value to the next.
    in_bands : bool
        Whether the variance is estimated in bands of the share, instead of on a line from ink to
        plate.
    from_edges : bool
        Whether the noise of ink, or of plate, is taken from edges if there are too few of its
        pixels.
    is_linear_in_share : bool
        Whether the variance is about linear in the share. If so, the variances of pure ink and pure
        plate are extrapolated, since pixels of each contain a little of the other.
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
    edge, edge_count = np.empty(len(share)), 0
    for i in range(len(share)):
        within = min(max(share[i], 0.0), 1.0)
        variance = max(ink + (white - ink) * within, floor)
        plateau_sd[i] = math.sqrt(variance)
        if usable[i] and 0.2 < within < 0.8:
            edge[edge_count] = residuals[i] * residuals[i] / variance
            edge_count += 1
    standardised = _trimmed_variance(edge[:edge_count])
    excess = 0.0 if math.isnan(standardised) else max(0.0, standardised - 1.0)
    if in_bands:
        band_variances = _band_variances(residuals, share, usable, (ink, white, excess, floor))
        _interpolate(share, 0.5 * np.log(band_variances), sd)
        return
    for i in range(len(share)):
        sd[i] = math.sqrt(_variance_at(share[i], ink, white, excess, floor))


@compiled
def _interpolate(share: FloatArray, log_sd: FloatArray, sd: FloatArray) -> None:
    """Fill in standard deviations, interpolated between the bands' middles in the logarithm.

    The loops have no branches and call no library function, so that they are vectorised. The
    exponential is a polynomial of the argument divided by 2¹⁰, squared ten times.
    """
    for i in range(len(share)):
        value = log_sd[0]
        for k in range(len(_BAND_MIDDLES) - 1):
            width = _BAND_MIDDLES[k + 1] - _BAND_MIDDLES[k]
            within = min(max(share[i] - _BAND_MIDDLES[k], 0.0), width)
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
    """Return the variance at a share: on the line from ink to white, inflated at edges."""
    within = min(max(share, 0.0), 1.0)
    return max(ink + (white - ink) * within, floor) * (1.0 + excess * 4.0 * within * (1.0 - within))


@compiled
def _band_variances(
    residuals: FloatArray,
    share: FloatArray,
    usable: BoolArray,
    line: tuple[float, float, float, float],
) -> FloatArray:
    """Return the variances of the bands, drawn towards `_variance_at` if there are few pixels."""
    ink, white, excess, floor = line
    squares, starts = _by_band(residuals, share, usable)
    variances = np.empty(len(_BAND_MIDDLES))
    for band in range(len(_BAND_MIDDLES)):
        variances[band] = _variance_at(_BAND_MIDDLES[band], ink, white, excess, floor)
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
    """Return the squares of usable residuals, sorted by band, and where each band starts."""
    bands, count = np.zeros(len(share), np.uint8), len(_BAND_MIDDLES)
    for limit in _BAND_LIMITS:
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

    Pixels that count as ink contain a little plate and vice versa. Dark ink has little noise, and
    the plate in it makes 3 to 8 % of the variance. Therefore the line through the mean variances
    and mean shares of both is extrapolated to the shares 0 and 1. This is not done for plain discs
    under an unknown tone curve, because the curve was learnt less well then.

    If there are too few pixels of ink or of plate, its variance is that of the other one, or
    (`from_edges`) that at edges. If there are too few of both, the variance of all pixels is used.
    """
    ink, ink_share = _mean_variance(residuals, share, usable, -math.inf, 0.15)
    white, white_share = _mean_variance(residuals, share, usable, 0.85, math.inf)
    is_ink_seen, is_white_seen = not math.isnan(ink), not math.isnan(white)
    if not (is_ink_seen or is_white_seen):
        variance, _ = _mean_variance(residuals, share, usable, -math.inf, math.inf)
        variance = floor if math.isnan(variance) else variance
        return variance, variance
    if not (is_ink_seen and is_white_seen):
        seen = ink if is_ink_seen else white
        at_edges, edge_share = _mean_variance(residuals, share, usable, 0.2, 0.8)
        if not from_edges or math.isnan(at_edges):
            return seen, seen
        if is_ink_seen:  # ink is no noisier than plate
            white, white_share = max(at_edges, seen), edge_share
        else:
            ink, ink_share = min(at_edges, seen), edge_share
    if not is_linear_in_share:
        ink_share = 0.0 if is_ink_seen else ink_share
        white_share = 1.0 if is_white_seen else white_share
    slope = (white - ink) / (white_share - ink_share)
    least_ink = (1.0 - _MAX_PLATE_IN_INK) * ink if is_ink_seen else floor
    return max(ink - slope * ink_share, least_ink, floor), max(
        white + slope * (1.0 - white_share), floor
    )


@compiled
def _mean_variance(
    residuals: FloatArray, share: FloatArray, usable: BoolArray, low: float, high: float
) -> tuple[float, float]:
    """Return variance and mean share of the usable pixels with a share between limits."""
    squares, number, total = np.empty(len(share)), 0, 0.0
    for i in range(len(share)):
        if usable[i] and low < share[i] < high:
            squares[number] = residuals[i] * residuals[i]
            total += min(max(share[i], 0.0), 1.0)
            number += 1
    return _trimmed_variance(squares[:number]), total / max(number, 1)


@compiled
def median_at_edges(
    values: FloatArray, share: FloatArray, low: float, high: float, default: float
) -> float:
    """Return the median of values (n,) at pixels whose white share (n,) is between two limits."""
    at_edges, count = np.empty(len(values)), 0
    for i in range(len(values)):
        if low < share[i] < high:
            at_edges[count] = values[i]
            count += 1
    return float(np.median(at_edges[:count])) if count else default


@compiled
def _trimmed_variance(squares: FloatArray) -> float:
    """Return the variance from the smallest squares, scaled to all; NaN if there are too few."""
    if len(squares) < _MIN_SAMPLES:
        return math.nan
    count = max(1, int(_KEPT_SHARE * len(squares)))
    total = 0.0
    for square in np.partition(squares, count - 1)[:count]:
        total += square
    return total / (count * _TRIMMED_VARIANCE)


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """Negative log-likelihood of a window, with its derivatives for Newton's method."""

    total: float  # up to a constant
    score: FloatArray  # (n,): first derivative by the model in units of σ, with opposite sign
    weight: FloatArray  # (n,): second derivative by the same, made positive


def misfit(levels: FloatArray, model: FloatArray, sd: FloatArray, censoring: Censoring) -> Misfit:
    """Compare observed and modelled levels (n,) under noise of standard deviation `sd` (n,).

    Far from the model, the density of a pixel that is not clipped falls like a power of the
    distance, so that its loss grows as the logarithm. The density of a clipped pixel falls
    exponentially, so that its loss grows linearly. Beyond `censoring.ceiling` and `floor`, the
    model hardly affects the level of a pixel that is not clipped.
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
            near = min(missing, _MAX_CLIPPED_SIGMAS)
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


def outlier_share(fit: Misfit, model: FloatArray, censoring: Censoring) -> float:
    """Return the share of pixels not clipped that have less than half of their weight.

    It is 1 if all pixels are clipped.

    Parameters
    ----------
    fit : Misfit
        Of the pixels (n,).
    model : (n,) array
        Their modelled levels.
    censoring : Censoring
        Which of them are clipped, and where the light is.
    """
    seen = ~censoring.is_clipped
    is_beyond = (model > censoring.ceiling) | (model < censoring.floor)
    half = np.where(is_beyond, 0.5 * _BEYOND_CLIPPING**2, 0.5)
    return float(np.mean((fit.weight < half)[seen])) if seen.any() else 1.0
