"""The search for edges that may be a plain target's, within reach of its prediction."""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.measurement.discs.outlines import follow_outlines
from kgcp.measurement.discs.records import DiscOutline, Polarity

_SPACING = 0.4  # spacing of the start places, in smaller semi-axes
# How far an edge may be from a start: in radii, but at least this many pixels
_REACH, _LEAST_REACH_PX = 0.45, 2.0
# Two outlines are of the same edge if their centres are nearer than this (in radii) and the ratio
# of their radii is smaller than this.
_SAME_PLACE, _SAME_SIZE = 0.35, 1.15
_LEAST_SEMI_AXIS_PX = 1.0


def edges_like(
    grey: GreyArray, expected: Ellipse, polarity: Polarity, reach_px: float
) -> list[DiscOutline]:
    """Find edges that look like an expected one, up to a distance from its place.

    Parameters
    ----------
    expected : Ellipse
        In raw pixels.
    polarity : Polarity
        Of the area within, against that around.
    reach_px : float
        How far the centre may be from the expected one.

    Returns
    -------
    list of DiscOutline
        Different edges, those of the expected size first.
    """
    if expected.b < _LEAST_SEMI_AXIS_PX:
        return []
    centres = _lattice(expected.centre, reach_px, _SPACING * expected.b)
    height, width = grey.shape
    is_inside = np.all((centres >= 0.0) & (centres <= (width - 1.0, height - 1.0)), axis=1)
    guesses = [
        DiscOutline.predicted(Ellipse(x, y, expected.a, expected.b, expected.angle_rad), polarity)
        for x, y in centres[is_inside].tolist()
    ]
    follow_px = max(_REACH * expected.mean_radius, _LEAST_REACH_PX)
    followed = follow_outlines(grey, guesses, follow_px)
    outlines = [outline for outline in followed if outline is not None]
    distinct: list[DiscOutline] = []
    for outline in sorted(outlines, key=lambda each: each.residual_px):
        if not any(_is_same(outline, other) for other in distinct):
            distinct.append(outline)
    return sorted(distinct, key=lambda each: abs(_log_size(each.ellipse, expected)))


def _lattice(centre: FloatArray, reach_px: float, spacing_px: float) -> FloatArray:
    """Return places (n, 2) within a distance, at the corners of equilateral triangles."""
    rows = math.ceil(reach_px / (spacing_px * math.sqrt(0.75)))
    columns = math.ceil(reach_px / spacing_px) + 1
    row, column = np.mgrid[-rows : rows + 1, -columns : columns + 1]
    offsets = spacing_px * np.stack((column + 0.5 * (row % 2), math.sqrt(0.75) * row), axis=-1)
    offsets = offsets.reshape(-1, 2)
    return np.asarray(centre + offsets[np.hypot(*offsets.T) <= reach_px + spacing_px])


def _is_same(outline: DiscOutline, other: DiscOutline) -> bool:
    apart_px = float(np.linalg.norm(outline.ellipse.centre - other.ellipse.centre))
    ratio = outline.ellipse.mean_radius / other.ellipse.mean_radius
    return (
        apart_px < _SAME_PLACE * other.ellipse.mean_radius and 1.0 / _SAME_SIZE < ratio < _SAME_SIZE
    )


def _log_size(ellipse: Ellipse, expected: Ellipse) -> float:
    return math.log(ellipse.mean_radius / expected.mean_radius)
