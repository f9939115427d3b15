"""Detection of circles that were moved during a flight: frames before and after show two places."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import circle_derivatives
from kgcp.network.ground.space_circle import CircleViews, SpaceCircle

LEAST_SIDE = 3
"""Least number of frames before and after a move. Fewer are rejected as outliers instead."""

_FALSE_ALARM = 1e-5  # probability that the frames of one place seem to show two
_MAX_CHI2 = 100.0  # limit of the χ² of a frame's place, so that outliers do not dominate
_MEDIAN_CHI2 = 1.386  # of two numbers
_ROUNDS = 8
_COARSE_COUNT = 24  # splits that are tried before the search is refined


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """The best split of a circle's frames into those of two places.

    Attributes
    ----------
    first : int
        The first frame that shows the second place.
    off_m : (3,) array
        Vector from the first to the second place.
    gain : float
        Decrease of χ² by a second place, relative to the decrease that chance exceeds once in
        100 000 circles.
    """

    first: int
    off_m: FloatArray
    gain: float

    def larger_side(self, count: int) -> BoolArray:
        """Return which of `count` frames are on the side of the split with more frames."""
        after = np.arange(count) >= self.first
        return after if 2 * np.count_nonzero(after) > count else ~after


def best_split(
    camera: Camera, views: CircleViews, circle: SpaceCircle, covs: FloatArray
) -> Split | None:
    """Return the split of the frames that two places explain best; None: too few frames.

    Parameters
    ----------
    views : CircleViews
        In the order in which they were taken.
    circle : SpaceCircle
        Close to one of the two places, or between them.
    covs : (n, 2, 2) array
        Covariances of the places in the images, up to a common factor.
    """
    count = len(views)
    circles = circle.in_cameras(views)
    slopes = circle_derivatives(camera, circles)
    residuals = (views.moments - slopes.moments)[:, :2]
    design = slopes.by_centre[:, :2]
    design = design @ np.swapaxes(views.world_from_camera, 1, 2)
    splits = range(LEAST_SIDE, count - LEAST_SIDE + 1)
    if not splits or not (np.isfinite(residuals).all() and np.isfinite(design).all()):
        return None
    whitened = np.linalg.inv(np.linalg.cholesky(covs))
    residuals, design = np.einsum("nij,nj->ni", whitened, residuals), whitened @ design

    def norms(first: int) -> FloatArray:
        before, after = slice(None, first), slice(first, None)
        parts = [_place(residuals[part], design[part])[1] for part in (before, after)]
        return np.concatenate(parts)

    def misfit(first: int) -> float:
        return float(np.sum(norms(first)))

    stride = max(1, len(splits) // _COARSE_COUNT)
    coarse = splits.index(min(splits[::stride], key=misfit))
    first = min(splits[max(0, coarse - stride) : coarse + stride + 1], key=misfit)
    off_m = (
        _place(residuals[first:], design[first:])[0] - _place(residuals[:first], design[:first])[0]
    )
    split_chi2, single_chi2 = norms(first) ** 2, _place(residuals, design)[1] ** 2
    # two places are six unknowns of 2 n observations
    variance = max(1.0, float(np.median(split_chi2)) / _MEDIAN_CHI2 * count / (count - 3.0))
    gain = float(np.sum(_limited(single_chi2 / variance) - _limited(split_chi2 / variance)))
    by_chance = 3.0 * float(fdtri(3, 2 * count - 6, 1.0 - _FALSE_ALARM))
    return Split(first, off_m, gain / by_chance)


@compiled
def _place(residuals: FloatArray, design: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shift (3,) with the least sum of the residuals' norms, and these norms (n,)."""
    count = len(residuals)
    weights, norms, shift = np.ones(count), np.empty(count), np.empty(3)
    for _ in range(_ROUNDS):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for i in range(count):
            for axis in range(2):
                for j in range(3):
                    slope = weights[i] * design[i, axis, j]
                    right[j] += slope * residuals[i, axis]
                    for k in range(3):
                        normal[j, k] += slope * design[i, axis, k]
        shift[:] = np.linalg.lstsq(normal, right, 1e-14)[0]
        for i in range(count):
            square = 0.0
            for axis in range(2):
                off = residuals[i, axis]
                for j in range(3):
                    off -= design[i, axis, j] * shift[j]
                square += off * off
            norms[i] = math.sqrt(square)
        weights[:] = 1.0 / np.maximum(norms, 0.1 * float(np.median(norms)) + 1e-9)
    return shift, norms


def _limited(chi2: FloatArray) -> FloatArray:
    return np.minimum(chi2, _MAX_CHI2)
