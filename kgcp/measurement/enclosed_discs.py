"""Groups of discs within one closed boundary: an EO device, before its discs are named."""

from __future__ import annotations

import cv2
import numpy as np
from cv2.typing import MatLike

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Response
from kgcp.geometry.grey_range import full_scale
from kgcp.measurement.discs.measure import measure_discs
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import Disc, Polarity

_LEVELS = (0.25, 0.5, 0.75)  # thresholds of a boundary, between the levels of discs and ground
_LEAST_AREA = 3.0  # of a region, relative to the area of its discs


def enclosed_discs(grey: GreyArray, count: int, response: Response) -> list[list[Disc]]:
    """Find closed regions with exactly this many discs of one polarity.

    A boundary is any closed shape: a line around the discs, or the edge of a plate. Regions with
    the same discs count once.

    Parameters
    ----------
    grey : (height, width) array
        Grey values of 8 or 16 bits.
    count : int
        Number of discs in a region.
    response : Response
        How grey values follow light.

    Returns
    -------
    list of list of Disc
        Groups in the order of their discs' places.
    """
    outlines = [each for each in find_outlines(grey) if not each.is_hole]
    measured = measure_discs(grey, outlines, response=response)
    discs = [each for each in measured if isinstance(each, Disc)]
    groups: set[tuple[int, ...]] = set()
    for polarity in Polarity:
        mine = [i for i, each in enumerate(discs) if each.polarity is polarity]
        if len(mine) >= count:
            groups |= _groups(grey, [discs[i] for i in mine], mine, count)
    discs_by_group = [[discs[i] for i in group] for group in sorted(groups)]
    return sorted(discs_by_group, key=lambda group: (group[0].y, group[0].x))


def _groups(
    grey: GreyArray, discs: list[Disc], numbers: list[int], count: int
) -> set[tuple[int, ...]]:
    """Return groups of `count` discs in one hole of a region that is above or below a level."""
    places = np.array([disc.centre_px for disc in discs])
    areas = np.array([4.0 * np.pi * _root_determinant(disc) for disc in discs])
    groups = set()
    for contour in _holes(grey, discs):
        left, top, width, height = cv2.boundingRect(contour)
        near = np.flatnonzero(
            (places[:, 0] > left)
            & (places[:, 0] < left + width)
            & (places[:, 1] > top)
            & (places[:, 1] < top + height)
        )
        if len(near) < count:
            continue
        inside = [
            int(i)
            for i in near
            if cv2.pointPolygonTest(contour, places[i].tolist(), measureDist=False) > 0.0
        ]
        is_large = cv2.contourArea(contour) > _LEAST_AREA * areas[inside].sum()
        if len(inside) == count and is_large:
            groups.add(tuple(numbers[i] for i in inside))
    return groups


def _holes(grey: GreyArray, discs: list[Disc]) -> list[MatLike]:
    """Return the contours of holes, for thresholds between the levels of discs and ground."""
    full = full_scale(grey)
    inside = float(np.median([disc.inside for disc in discs]))
    outside = float(np.median([disc.outside for disc in discs]))
    holes = []
    for share in _LEVELS:
        above = (grey > full * (inside + share * (outside - inside))).astype(np.uint8)
        for region in (above, 1 - above):
            contours, tree = cv2.findContours(region, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
            if tree is not None:
                holes += [
                    contour
                    for contour, (_, _, _, parent) in zip(contours, tree[0], strict=True)
                    if parent >= 0
                ]
    return holes


def _root_determinant(disc: Disc) -> float:
    _, _, xx, xy, yy = disc.vector.tolist()
    return float(np.sqrt(max(xx * yy - xy * xy, 0.0)))


def centres_and_covariances(discs: list[Disc]) -> tuple[FloatArray, FloatArray]:
    """Return centroids (n, 2) [px] and their covariances (n, 2, 2) [px²]."""
    return (
        np.array([disc.centre_px for disc in discs]),
        np.array([disc.centre_cov_px2 for disc in discs]),
    )
