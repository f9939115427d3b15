"""Sums over arcs of edges, from which the correlation of residuals along edges is estimated."""

from __future__ import annotations

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray


@compiled
def sums_over_arcs(
    own_derivatives: FloatArray,
    all_derivatives: FloatArray,
    score: FloatArray,
    weight: FloatArray,
    arc: IndexArray,
) -> tuple[FloatArray, FloatArray, int]:
    """Return two kinds of sums over the pixels of each arc, and the number of arcs with pixels.

    The first are sums of `own_derivatives` (n, k) times the scores (n,): (arcs, k). The second are
    sums of products of `own_derivatives` and `all_derivatives` (n, p), times the weights (n,):
    (arcs, k, p). `arc` (n,) is the arc number of every pixel.
    """
    count, own_count, all_count = arc.max() + 1, own_derivatives.shape[1], all_derivatives.shape[1]
    sums, products = np.zeros((count, own_count)), np.zeros((count, own_count, all_count))
    pixels = np.zeros(count, np.intp)
    for i in range(len(arc)):
        a = arc[i]
        pixels[a] += 1
        for k in range(own_count):
            sums[a, k] += own_derivatives[i, k] * score[i]
            weighted = own_derivatives[i, k] * weight[i]
            for j in range(all_count):
                products[a, k, j] += weighted * all_derivatives[i, j]
    return sums, products, int((pixels > 0).sum())
