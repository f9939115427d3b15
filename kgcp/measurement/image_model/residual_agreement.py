"""Sums over arcs of edges, from which the correlation of residuals along edges is estimated."""

from __future__ import annotations

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray


@compiled
def sums_over_arcs(
    of_own: FloatArray, of_all: FloatArray, score: FloatArray, weight: FloatArray, arc: IndexArray
) -> tuple[FloatArray, FloatArray, int]:
    """Return two kinds of sums over the pixels of each arc, and the number of arcs with pixels.

    The first are sums of the derivatives `of_own` (n, k) times the scores (n,): (arcs, k). The
    second are sums of the products of `of_own` and `of_all` (n, p), times the weights (n,): (arcs,
    k, p). `arc` (n,) is the arc number of every pixel.
    """
    count, own, room = arc.max() + 1, of_own.shape[1], of_all.shape[1]
    sums, products = np.zeros((count, own)), np.zeros((count, own, room))
    pixels = np.zeros(count, np.intp)
    for i in range(len(arc)):
        a = arc[i]
        pixels[a] += 1
        for k in range(own):
            sums[a, k] += of_own[i, k] * score[i]
            weighted = of_own[i, k] * weight[i]
            for j in range(room):
                products[a, k, j] += weighted * of_all[i, j]
    return sums, products, (pixels > 0).sum()
