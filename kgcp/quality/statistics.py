"""Statistics of residuals: spread, moving statistics, rates, slopes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.robust_gls import ErrorModel, fit, two_sided_probability

_Z_95 = 1.959963984540054
_MIN_IN_WINDOW = 3

_MIN_COUNT = 6


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean, standard deviation and root mean square of `count` values."""

    count: int  # at least 1
    # in the values' unit
    mean: float
    sd: float | None  # of one value, with count − 1 degrees of freedom; None for a single value
    rms: float

    @classmethod
    def of(cls, values: FloatArray) -> Self:
        """Describe one or more finite values (n,)."""
        sd = float(np.std(values, ddof=1)) if len(values) > 1 else None
        rms = float(np.sqrt(np.mean(values**2)))
        return cls(len(values), float(np.mean(values)), sd, rms)

    @property
    def sd_mean(self) -> float | None:
        """Standard deviation of the mean, for independent values."""
        return None if self.sd is None else self.sd / math.sqrt(self.count)


@dataclass(frozen=True, slots=True, eq=False)
class MovingStatistics:
    """Mean and standard deviation in a window that moves along x (the paper's Figure 9)."""

    centre: FloatArray  # (n,): of the windows, along x
    # (n,): of the values in each window; NaN: fewer than three values
    mean: FloatArray
    sd: FloatArray


def moving_statistics(x: FloatArray, y: FloatArray, window: float) -> MovingStatistics:
    """Return mean and standard deviation of y (n,) in windows along x (n,), in steps of window/10.

    All values must be finite, and n ≥ 1.
    """
    step = window / 10.0
    first, last = math.floor(x.min() / step), math.ceil(x.max() / step)
    centre = step * np.arange(first, last + 1, dtype=np.float64)
    inside = np.abs(x - centre[:, None]) <= 0.5 * window
    count = inside.sum(axis=1)
    enough = count >= _MIN_IN_WINDOW
    mean = np.full(len(centre), np.nan)
    sd = np.full(len(centre), np.nan)
    mean[enough] = (inside @ y)[enough] / count[enough]
    squares = np.where(inside, (y - mean[:, None]) ** 2, 0.0).sum(axis=1)
    sd[enough] = np.sqrt(squares[enough] / (count[enough] - 1))
    return MovingStatistics(centre, mean, sd)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a rate, by Wilson's score (1927, JASA 22, 209).

    Unlike p ± 1.96·√(p(1−p)/n) it stays within 0…1 and does not collapse at 0 and 1.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes in {trials} trials")
    rate, z2 = successes / trials, _Z_95**2
    centre = (rate + z2 / (2.0 * trials)) / (1.0 + z2 / trials)
    spread = math.sqrt(rate * (1.0 - rate) / trials + z2 / (4.0 * trials**2))
    half = _Z_95 * spread / (1.0 + z2 / trials)
    # rounding must not push a rate of 0 or 1 out of its own interval
    return max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half))


@dataclass(frozen=True, slots=True, eq=False)
class Slope:
    """A line y = height + value · (x − middle)."""

    count: int  # fitted points, without outliers
    middle: float
    height: float
    value: float
    # standard deviations, by the scatter about the line
    sd_height: float
    sd_value: float
    probability: float  # of as large a slope by chance
    share: float  # of the variance of y that the line explains, corrected for its one parameter

    def line(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the line at x (n,) and its standard deviation."""
        offset = x - self.middle
        return self.height + self.value * offset, np.hypot(self.sd_height, self.sd_value * offset)


def fit_slope(
    x: FloatArray, y: FloatArray, sd: FloatArray, *, is_robust: bool = True
) -> Slope | None:
    """Fit a line to points (n,); None if there are too few, or if x or y do not vary.

    Parameters
    ----------
    sd : (n,) array
        Standard deviations of y; their scale is estimated from the scatter.
    is_robust : bool
        Whether outliers are left out.
    """
    if len(x) < _MIN_COUNT or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    weight = sd**-2.0
    middle = float(weight @ x / weight.sum())
    design = np.column_stack((np.ones_like(x), x - middle))
    errors = ErrorModel(sd**2, np.zeros_like(x), np.arange(float(len(x))))
    result = fit(design, y, errors, is_robust=is_robust)
    kept = ~result.outlier
    if np.ptp(x[kept]) == 0.0 or not result.sds.all():
        return None
    share = 1.0 - (result.chi2 / result.freedom) / (result.chi2_of([0]) / (result.freedom + 1))
    height, value = result.values.tolist()
    sd_height, sd_value = result.sds.tolist()
    chance = two_sided_probability(value / sd_value, result.freedom)
    return Slope(
        int(kept.sum()), middle, height, value, sd_height, sd_value, chance, max(0.0, share)
    )
