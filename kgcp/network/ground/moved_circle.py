"""Circles that were moved while they were photographed: frames before and after show two places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import circle_derivatives
from kgcp.network.ground.space_circle import CircleViews, SpaceCircle

LEAST_SIDE = 3
"""Frames before and after a move, at least: fewer are left out as if they showed something else."""

_CHANCE = 1e-5  # that frames of one place seem to show two
_CAPPED_CHI2 = 100.0  # of a frame's place: what is further off tells nothing more
_MEDIAN_CHI2 = 1.386  # of two numbers
_ROUNDS = 8
_COARSE = 24  # splits that are tried first


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """The best split of a circle's frames into those of two places.

    Attributes
    ----------
    first : int
        The first frame of the second place.
    off_m : (3,) array
        From the first to the second place.
    gain : float
        Decrease of χ² by the second place, over what it exceeds by chance once in 100 000 circles.
    """

    first: int
    off_m: FloatArray
    gain: float

    def larger_side(self, count: int) -> BoolArray:
        """Return which of n frames show the place that more of them show, at least half."""
        after = np.arange(count) >= self.first
        return after if 2 * np.count_nonzero(after) > count else ~after


def best_split(
    camera: Camera, views: CircleViews, circle: SpaceCircle, covs: FloatArray
) -> Split | None:
    """Return the split of the frames by which two places explain them best; None: too few frames.

    Parameters
    ----------
    views : CircleViews
        In the order in which they were taken.
    circle : SpaceCircle
        Near one of the two places, or between them.
    covs : (n, 2, 2) array
        Of the places in the images, but for a common factor.
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

    stride = max(1, len(splits) // _COARSE)
    coarse = splits.index(min(splits[::stride], key=misfit))
    first = min(splits[max(0, coarse - stride) : coarse + stride + 1], key=misfit)
    off_m = (
        _place(residuals[first:], design[first:])[0] - _place(residuals[:first], design[:first])[0]
    )
    two, one = norms(first) ** 2, _place(residuals, design)[1] ** 2
    # six of the 2 n numbers are adjusted
    variance = max(1.0, float(np.median(two)) / _MEDIAN_CHI2 * count / (count - 3.0))
    gain = float(np.sum(_capped(one / variance) - _capped(two / variance)))
    by_chance = 3.0 * float(fdtri(3, 2 * count - 6, 1.0 - _CHANCE))
    return Split(first, off_m, gain / by_chance)


def _place(residuals: FloatArray, design: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shift (3,) with the least sum of residuals' norms, and these (n,)."""
    weights = np.ones(len(residuals))
    for _ in range(_ROUNDS):
        normal = np.einsum("n,nij,nik->jk", weights, design, design)
        right = np.einsum("n,nij,ni->j", weights, design, residuals)
        shift = np.linalg.lstsq(normal, right, rcond=1e-14)[0]
        norms = np.linalg.norm(residuals - design @ shift, axis=1)
        weights = 1.0 / np.maximum(norms, 0.1 * float(np.median(norms)) + 1e-9)
    return shift, norms


def _capped(chi2: FloatArray) -> FloatArray:
    return np.minimum(chi2, _CAPPED_CHI2)
