"""One of each group of circles that are nearly the same."""

from __future__ import annotations

import math

import numpy as np

from kgcp.compiled import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray


def distinct(
    centres: FloatArray, radii: FloatArray, clearness: FloatArray, near: float, alike: float
) -> IndexArray:
    """Return the indices of circles without those that are like a clearer one, clearest first.

    Parameters
    ----------
    centres : (n, 2) array
    radii, clearness : (n,) array
    near : float
        Distance up to which two circles may be the same, of the clearer one's radius.
    alike : float
        Difference of the logarithms of their radii up to which they may be.
    """
    order, by_row = np.argsort(-clearness, kind="stable"), np.argsort(centres[:, 1], kind="stable")
    return order[_is_first(centres, radii, order, by_row, near, alike)[order]]


@compiled
def _is_first(
    centres: FloatArray,
    radii: FloatArray,
    order: IndexArray,
    by_row: IndexArray,
    near: float,
    alike: float,
) -> BoolArray:
    """Tell which circles (n,) are like no clearer one, from their orders by clearness and row."""
    first = np.ones(len(radii), np.bool_)
    position, rank = np.empty(len(radii), np.intp), np.empty(len(radii), np.intp)
    for i in range(len(radii)):
        position[by_row[i]], rank[order[i]] = i, i
    for one in order:
        if not first[one]:
            continue
        reach = near * radii[one]
        for step in (-1, 1):
            place = position[one] + step
            while 0 <= place < len(by_row):
                other = by_row[place]
                y = centres[other, 1] - centres[one, 1]
                if abs(y) > reach:
                    break
                x = centres[other, 0] - centres[one, 0]
                if x * x + y * y <= reach * reach and rank[other] > rank[one]:
                    first[other] &= abs(math.log(radii[other] / radii[one])) > alike
                place += step
    return first
