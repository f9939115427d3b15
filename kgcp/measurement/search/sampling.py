"""Interpolated grey values of a frame, at points and on ellipses around rings."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, GreyArray, SingleArray
from kgcp.geometry.conic import Ellipse

MIN_EDGE_SLOPE = 0.25  # grey values per pixel; smaller slopes are due to rounding


def sample_grey(grey: GreyArray, points: npt.NDArray[np.floating]) -> FloatArray:
    """Sample a frame bilinearly at points (m, n, 2) [px]; border pixels are repeated outside."""
    maps = points.astype(np.float32, copy=False)
    values = cv2.remap(  # type: ignore[call-overload]  # the stubs lack maps of both x and y
        grey, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(values, dtype=np.float64)


def sample_ellipses(
    grey: GreyArray, outlines: Sequence[Ellipse], factors: FloatArray, circle: FloatArray
) -> FloatArray:
    """Sample a frame as `sample_grey`, on n outlines that are scaled by factors (m,): (n, m, k).

    `circle` (k, 2) are the points of the unit circle that are mapped to the ellipses.
    """
    shape = len(outlines), len(factors), len(circle)
    if not outlines:
        return np.empty(shape)
    points = np.empty((*shape, 2), dtype=np.float32)
    for outline, around in zip(outlines, points, strict=True):
        _place_points(
            outline.x,
            outline.y,
            outline.a,
            outline.b,
            outline.angle_rad,
            factors,
            circle,
            around,
        )
    return sample_grey(grey, points.reshape(len(outlines), -1, 2)).reshape(shape)


@compiled
def _place_points(
    x: float,
    y: float,
    a: float,
    b: float,
    angle_rad: float,
    factors: FloatArray,
    circle: FloatArray,
    points: SingleArray,
) -> None:
    """Fill in points (m, k, 2) on an ellipse that is scaled by factors (m,) about its centre."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    for m in range(len(factors)):
        xx = factors[m] * (a * cosine * cosine + b * sine * sine)
        xy = factors[m] * (a - b) * cosine * sine
        yy = factors[m] * (a * sine * sine + b * cosine * cosine)
        for k in range(len(circle)):
            points[m, k, 0] = x + xx * circle[k, 0] + xy * circle[k, 1]
            points[m, k, 1] = y + xy * circle[k, 0] + yy * circle[k, 1]
