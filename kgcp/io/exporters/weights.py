"""Accuracies that an adjustment can use: floors for points and marks, common distance errors.

A ring of 50 px is measured to a thousandth of a pixel, but no calibration is that good all over the
image. With such an accuracy, a mark would weigh as much as ten thousand tie points, and bend the
block around it. Likewise, a distance is only as good as calibration and print, whose errors are the
same in all frames. Packages cannot represent a common error, and treat it as one of each distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.gcp import Gcp

MARK_FLOOR_PX = 0.1
"""Default of the least standard deviation of a mark [px]: what good calibrations leave."""

POINT_FLOOR_M = 0.001
"""Least standard deviation of a point [m]: no survey is better, and zeros mean infinite weight."""

ASSUMED_SHARE = 3e-4
"""Standard deviation of all distances together, relative, where flight.toml states none."""


def distance_share(point: Gcp) -> float:
    """Return the relative standard deviation of calibration and print in a point's distance."""
    if not point.sd_common_distance_m:
        return ASSUMED_SHARE
    return point.sd_common_distance_m / point.distance_m


def with_floors(gcps: Sequence[Gcp], mark_floor_px: float) -> tuple[Gcp, ...]:
    """Return points with accuracies for a package: what is unknown stays unknown.

    Parameters
    ----------
    mark_floor_px : float
        Least standard deviation of a mark, in any direction [px]. The directions of its
        covariance stay.
    """
    return tuple(_with_floors(point, mark_floor_px) for point in gcps)


def _with_floors(point: Gcp, mark_floor_px: float) -> Gcp:
    sd_m = point.sd_distance_m
    if sd_m is not None:
        sd_m = math.hypot(sd_m, distance_share(point) * point.distance_m)
    return replace(
        point,
        cov_m2=_at_least(point.cov_m2, POINT_FLOOR_M),
        centre_cov_px2=_at_least(point.centre_cov_px2, mark_floor_px),
        sd_distance_m=sd_m,
    )


def _at_least(cov: FloatArray | None, floor: float) -> FloatArray | None:
    """Return a covariance with a least standard deviation in every direction."""
    if cov is None:
        return None
    variances, axes = np.linalg.eigh(cov)
    if variances[0] >= floor**2:
        return cov
    return np.asarray((axes * np.maximum(variances, floor**2)) @ axes.T)
