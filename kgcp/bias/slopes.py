"""A straight line through scattered points, with how sure its slope is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.bias.regression import Noise, fit
from kgcp.bias.terms import two_sided
from kgcp.geometry.arrays import FloatArray

_MIN_COUNT = 6


@dataclass(frozen=True, slots=True, eq=False)
class Slope:
    """A line y = height + value · (x − middle).

    Attributes
    ----------
    count : int
        Points that had a part; what is far off the line had none.
    middle, height, value : float
    sd_height, sd_value : float
        Standard deviations, by the scatter about the line.
    probability : float
        Of as large a slope by chance.
    share : float
        Of the variance of y what the line explains, corrected for its one parameter.
    """

    count: int
    middle: float
    height: float
    value: float
    sd_height: float
    sd_value: float
    probability: float
    share: float

    def line(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the line at x (n,) and its standard deviation."""
        offset = x - self.middle
        return self.height + self.value * offset, np.hypot(self.sd_height, self.sd_value * offset)


def fit_slope(
    x: FloatArray, y: FloatArray, sd: FloatArray, *, is_robust: bool = True
) -> Slope | None:
    """Fit a line to points (n,) with deviations of y known to a factor; None where x says little.

    Deviations are those of the scatter; robust, unless what is far off the others counts most.
    """
    if len(x) < _MIN_COUNT or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    weight = sd**-2.0
    middle = float(weight @ x / weight.sum())
    design = np.column_stack((np.ones_like(x), x - middle))
    noise = Noise(sd**2, np.zeros_like(x), np.arange(float(len(x))))
    found = fit(design, y, noise, is_robust=is_robust)
    kept = ~found.outlier
    if np.ptp(x[kept]) == 0.0 or not found.sds.all():
        return None
    share = 1.0 - (found.chi2 / found.freedom) / (found.chi2_of([0]) / (found.freedom + 1))
    height, value = found.values.tolist()
    sd_height, sd_value = found.sds.tolist()
    chance = two_sided(value / sd_value, found.freedom)
    return Slope(
        int(kept.sum()), middle, height, value, sd_height, sd_value, chance, max(0.0, share)
    )
