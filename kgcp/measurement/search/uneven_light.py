"""Correction of uneven light on rings: their grey values as they would be in even light."""

from __future__ import annotations

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.search.templates import edge_rows
from kgcp.targets.layout import Ring

MIN_CORRECTED_RADIUS_PX = 8.0
"""Radius below which no levels can be read beside edges: such rings are not corrected."""
# Samples on either side of an angle from which a level is taken: together wider than a dot and
# narrower than a shadow.
_HALF_INK, _HALF_PLATE = 10, 5
# Rank of the sample that is the level. For the plate it is the median. For ink it is lower, because
# blurred dots are brighter than ink.
_INK_RANK, _PLATE_RANK = 7, 5
_SMOOTHING = 3.0  # σ of the levels' smoothing kernel, in samples
_REACH = 8  # of the kernel to either side, in samples
_KERNEL = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / _SMOOTHING) ** 2)
_KERNEL /= _KERNEL.sum()
_MIN_VARIATION = 0.15  # of the levels, relative to the contrast; below, the light counts as even
_MIN_CONTRAST = 0.2  # at any angle, relative to the typical one; less is not a ring


def light_corrected_patch(patch: FloatArray, ring: Ring, shift: int) -> FloatArray | None:
    """Return a polar patch as it would be if ink and plate had the same levels at all angles.

    The levels are measured on either side of both edges, smoothed around the ring, and interpolated
    linearly between the edges. They are much smoother than the dots of a code, so that the
    correction cannot create a code.

    None if the levels are even, or if a part does not look like a ring.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    shift : int
        Radial shift of the template that fits best.
    """
    plate, outside, disc, inside = (row + shift for row in edge_rows(ring))
    whites = _smooth_levels(patch[[plate, disc]], _PLATE_RANK, _HALF_PLATE)
    blacks = _smooth_levels(patch[[outside, inside]], _INK_RANK, _HALF_INK)
    steps = whites - blacks
    typical = _median(steps.ravel())
    if typical <= 0.0 or steps.min() < _MIN_CONTRAST * typical:
        return None
    if max(np.ptp(whites, axis=1).max(), np.ptp(blacks, axis=1).max()) < _MIN_VARIATION * typical:
        return None
    (white_out, white_in), (black_out, black_in) = whites, blacks
    rows = np.arange(len(patch))[:, None]
    share = np.clip((rows - inside) / (outside - inside), 0.0, 1.0)
    black = black_in + share * (black_out - black_in)
    share = np.clip((rows - disc) / (plate - disc), 0.0, 1.0)
    white = white_in + share * (white_out - white_in)
    contrast = np.maximum(white - black, _MIN_CONTRAST * typical)
    middle = _median(black.ravel())
    return np.asarray(middle + typical * (patch - black) / contrast)


def _median(values: FloatArray) -> float:
    """Return the median of an even number of values; faster than numpy's, which checks for NaN."""
    half = len(values) // 2
    ordered = np.partition(values, (half - 1, half))
    return 0.5 * float(ordered[half - 1] + ordered[half])


def _smooth_levels(circles: FloatArray, rank: int, half: int) -> FloatArray:
    """Return smoothed levels at all angles of circles.

    The level at an angle is the value of a rank among those up to `half` samples away on either
    side. `circles` (n, angles) are values at equidistant angles.
    """
    levels, smoothed = np.empty(circles.shape), np.empty(circles.shape)
    _fill_in_ranked(_closed(circles, half), rank, half, levels)
    _smooth(_closed(levels, _REACH), _KERNEL, smoothed)
    return smoothed


def _closed(circles: FloatArray, reach: int) -> FloatArray:
    """Extend circles periodically by `reach` values at both ends."""
    return np.concatenate((circles[:, -reach:], circles, circles[:, :reach]), axis=1)


@compiled
def _fill_in_ranked(closed: FloatArray, rank: int, half: int, out: FloatArray) -> None:
    """Fill in the value of a rank, counted from 0, among neighbouring values.

    It is the largest value that has at most `rank` smaller ones. A few hundred vectorised
    comparisons at all angles are faster than sorting so few values.
    """
    angles, width = out.shape[1], 2 * half + 1
    less = np.empty(angles)
    for i in range(len(out)):
        circle, ranked = closed[i], out[i]
        ranked[:] = -np.inf
        for k in range(width):
            less[:] = 0.0
            for j in range(width):
                for a in range(angles):
                    less[a] += 1.0 if circle[a + j] < circle[a + k] else 0.0
            for a in range(angles):
                if less[a] <= rank and circle[a + k] > ranked[a]:
                    ranked[a] = circle[a + k]


@compiled
def _smooth(closed: FloatArray, kernel: FloatArray, out: FloatArray) -> None:
    """Fill in the convolution of closed circles with a kernel."""
    for i in range(len(out)):
        circle, smoothed = closed[i], out[i]
        smoothed[:] = 0.0
        for k in range(len(kernel)):
            for a in range(len(smoothed)):
                smoothed[a] += kernel[k] * circle[a + k]
