"""How the edge of a large disc looks: in closed form, with blur and motion.

Where the radius is many times the blur, the chord that tangential blur reaches is a parabola. To
second order it shifts the edge inwards by var_t/(2 r) + 3 var_t²/(8 r³) and widens it by
var_t²/(2 r²). A uniform motion along the radial direction averages the profile over its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray
from kgcp.target.profile import Coverage, density

_SHORTEST_SMEAR = 1e-3  # of the blur: below, differences of the profile lose their digits


@dataclass(frozen=True, slots=True, eq=False)
class EdgeCoordinate:
    """Where n points lie in the edges of large discs.

    Attributes
    ----------
    z : (n,) array
        Depth within the disc, in standard deviations.
    sd : (n,) array
        Standard deviation of the edge.
    bend : (n,) array
        1/(2 r).
    var_tangential : (n,) array
    """

    z: FloatArray
    sd: FloatArray
    bend: FloatArray
    var_tangential: FloatArray

    def coverage(self, value: FloatArray, by_z: FloatArray, by_sd: FloatArray) -> Coverage:
        """Return the coverage from its value and derivatives in this coordinate."""
        bend, var_tangential = self.bend, self.var_tangential
        by_variance = 0.5 * by_sd / self.sd
        by_depth = by_z / self.sd
        shift = bend + 6.0 * var_tangential * bend**3
        widening = 4.0 * var_tangential * bend * bend
        return Coverage(
            value=value,
            d_rho=-by_depth,
            d_var_radial=by_variance,
            d_var_tangential=widening * by_variance - shift * by_depth,
            d_covariance=np.zeros_like(value),
        )


def edge_coordinate(
    rho: FloatArray, radius: FloatArray, var_radial: FloatArray, var_tangential: FloatArray
) -> EdgeCoordinate:
    """Return where points lie in the edges of large discs; arguments as for `blurred_disc`."""
    bend = 0.5 / radius
    sag = var_tangential * bend
    sd = np.sqrt(var_radial + 2.0 * sag * sag)
    z = (radius - sag * (1.0 + 3.0 * sag * bend) - rho) / sd
    return EdgeCoordinate(z, sd, bend, var_tangential)


def still_edge(at: EdgeCoordinate) -> Coverage:
    """Return the coverage without motion."""
    slope = density(at.z)
    return at.coverage(np.asarray(ndtr(at.z)), slope, -slope * at.z / at.sd)


def smeared_edge(at: EdgeCoordinate, smear: FloatArray) -> tuple[Coverage, FloatArray]:
    """Return the coverage with motion, and its derivative (n,) with respect to the smear.

    Parameters
    ----------
    at : EdgeCoordinate
    smear : (n,) array
        Length of the motion along the radial direction, not negative.
    """
    half = np.maximum(smear / (2.0 * at.sd), _SHORTEST_SMEAR)
    high, low = at.z + half, at.z - half
    ndtr_high, ndtr_low = ndtr(high), ndtr(low)
    value = _averaged(high, low, half)
    by_z = (ndtr_high - ndtr_low) / (2.0 * half)
    by_half = (0.5 * (ndtr_high + ndtr_low) - value) / half
    by_sd = -(by_z * at.z + by_half * half) / at.sd
    return at.coverage(value, by_z, by_sd), by_half / (2.0 * at.sd)


def edge_level(at: EdgeCoordinate, smear: FloatArray | None) -> FloatArray:
    """Return the value alone, of `smeared_edge` or, without a smear, of `still_edge`."""
    if smear is None:
        return np.asarray(ndtr(at.z))
    half = np.maximum(smear / (2.0 * at.sd), _SHORTEST_SMEAR)
    return _averaged(at.z + half, at.z - half, half)


def _averaged(high: FloatArray, low: FloatArray, half: FloatArray) -> FloatArray:
    """Return the mean of the normal distribution function from `low` to `high`."""
    integral: FloatArray = high * ndtr(high) - low * ndtr(low) + density(high) - density(low)
    return integral / (2.0 * half)
