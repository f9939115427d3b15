"""Nearly circular contours and clusters of concentric ones: §2.2 of Cucci (2016)."""

from __future__ import annotations

import math

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.conic import Ellipse, ellipse_from_conic, fit_ellipse, sampson_distance
from kgcp.measurement.closed_form.contours import Contours, circular_hulls, find_contours
from kgcp.settings import DetectSettings

_MAX_ROUGH_DEVIATION = 0.45  # of the mean radius: an arc has more
_FIT_PASSES = 3
_MAX_AXIS_RATIO = 2.0  # tilts to 60°
_CONCENTRIC = 0.2  # of the smaller circle's radius
_CONCENTRIC_PX = 1.0
_SAME_CIRCLE_PX = 0.7
_TWIN_RADIUS_PX = 1.1


def paper_outlines(grey: GreyArray, settings: DetectSettings) -> tuple[Ellipse, ...]:
    """Return what the paper's search takes for rings: §2.1 and §2.2 in turn.

    The paper tests the largest circle of each cluster for its code. A shadow or the plate's own
    outline can be concentric and larger, so that here every member is tested.
    """
    clusters = concentric_clusters(near_circular(find_contours(grey, settings), settings))
    return tuple(ellipse for cluster in clusters for ellipse in cluster)


def near_circular(contours: Contours, settings: DetectSettings) -> tuple[Ellipse, ...]:
    """Return the contours that pass the paper's circle test, as ellipses [px].

    With the mean μ and the standard deviation σ of the radius about the contour's mean point a
    contour passes if μ > μ_min and σ < k μ. Where blur or overexposure open the dots towards the
    plate, the contour runs through them into the ring: of a contour long enough to go round, but
    too rough to pass, the convex hull is tested in its place.
    """
    if len(contours) == 0:
        return ()
    starts = contours.starts[:-1]
    counts = np.diff(contours.starts)
    centres = np.add.reduceat(contours.points, starts) / counts[:, None]
    offsets = contours.points - np.repeat(centres, counts, axis=0)
    radii = np.sqrt(np.einsum("ni,ni->n", offsets, offsets))
    mean = np.add.reduceat(radii, starts) / counts
    deviation = np.sqrt(np.maximum(np.add.reduceat(radii**2, starts) / counts - mean**2, 0.0))
    circular = (mean > settings.min_radius_px) & (deviation < settings.max_circle_deviation * mean)
    rough = ~circular & (deviation < _MAX_ROUGH_DEVIATION * mean)
    rough &= counts > 2.0 * math.pi * settings.min_radius_px
    candidates = np.flatnonzero(circular)
    single = _one_per_edge(centres[candidates], mean[candidates])
    curves = [contours.contour(int(index)) for index in candidates[single]]
    curves += circular_hulls(contours.chosen(np.flatnonzero(rough)), settings)
    fits = (_preliminary_ellipse(curve) for curve in curves)
    return tuple(ellipse for ellipse in fits if ellipse is not None)


def _one_per_edge(centres: FloatArray, mean_radii: FloatArray) -> IndexArray:
    """Return the indices of circles without their smaller twins: an edge has a contour a side."""
    kept: list[int] = []
    for index in np.argsort(-mean_radii, kind="stable"):
        near = np.abs(centres[kept] - centres[index]).max(axis=1) < _SAME_CIRCLE_PX
        if not np.any(near & (mean_radii[kept] - mean_radii[index] < _TWIN_RADIUS_PX)):
            kept.append(int(index))
    return np.array(sorted(kept), dtype=np.intp)


def _preliminary_ellipse(points: FloatArray) -> Ellipse | None:
    """Fit an ellipse to one contour, leaving out where dots or clutter break into it."""
    try:
        conic = fit_ellipse(points)
        for _ in range(_FIT_PASSES):
            distance = np.abs(sampson_distance(conic, points))
            near = distance <= max(1.0, 2.5 * float(np.median(distance)))
            if near.all():
                break
            conic = fit_ellipse(points[near])
        ellipse = ellipse_from_conic(conic)
    except Rejection:
        return None
    return ellipse if ellipse.a <= _MAX_AXIS_RATIO * ellipse.b else None


def concentric_clusters(ellipses: tuple[Ellipse, ...]) -> tuple[tuple[Ellipse, ...], ...]:
    """Group ellipses with a common centre, the largest of each group first.

    Both contours along one edge are one circle: of ellipses that agree within a pixel's fraction
    the larger is kept.
    """
    if not ellipses:
        return ()
    ordered = sorted(ellipses, key=lambda ellipse: (-ellipse.mean_radius, ellipse.x, ellipse.y))
    centres = np.array([ellipse.centre for ellipse in ordered])
    reach = _CONCENTRIC_PX + _CONCENTRIC * np.array([ellipse.mean_radius for ellipse in ordered])
    free = np.ones(len(ordered), dtype=bool)
    clusters = []
    for first in range(len(ordered)):
        if not free[first]:
            continue
        members = free & (np.linalg.norm(centres - centres[first], axis=1) <= reach)
        free &= ~members
        clusters.append(_distinct([ordered[i] for i in np.flatnonzero(members)]))
    return tuple(clusters)


def _distinct(ellipses: list[Ellipse]) -> tuple[Ellipse, ...]:
    kept: list[Ellipse] = []
    for ellipse in ellipses:
        if not any(_are_one_circle(ellipse, other) for other in kept):
            kept.append(ellipse)
    return tuple(kept)


def _are_one_circle(first: Ellipse, second: Ellipse) -> bool:
    difference = np.array(
        [first.x - second.x, first.y - second.y, first.a - second.a, first.b - second.b]
    )
    return bool(np.all(np.abs(difference) < _SAME_CIRCLE_PX))
