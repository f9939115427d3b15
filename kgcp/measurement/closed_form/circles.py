"""Nearly circular contours, and clusters of concentric ones: §2.2 of Cucci (2016)."""

from __future__ import annotations

import math

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.conic import Ellipse, ellipse_from_conic, fit_ellipse, sampson_distance
from kgcp.measurement.closed_form.contours import Contours, circular_hulls, find_contours
from kgcp.settings import DetectSettings

# Standard deviation of the radius, relative to its mean, up to which the convex hull of a rough
# contour is tested. Open arcs have more.
_MAX_ROUGH_DEVIATION = 0.45
_FIT_PASSES = 3
_MAX_AXIS_RATIO = 2.0  # corresponds to a tilt of 60°
# Largest distance of the centres of concentric circles: 1 px plus 0.2 of the smaller radius.
_CONCENTRIC = 0.2
_CONCENTRIC_PX = 1.0
_SAME_CIRCLE_PX = 0.7  # difference of centre coordinates and semi-axes below which circles are one
_TWIN_RADIUS_PX = 1.1  # difference in radius of the contours on the two sides of a thin edge


def paper_outlines(grey: GreyArray, settings: DetectSettings) -> tuple[Ellipse, ...]:
    """Return the ellipses that may be rings according to §2.1 and §2.2 of the paper.

    The paper tests only the largest circle of each cluster for the code. Here every member is
    tested, because a shadow or the outline of the plate can be concentric and larger.
    """
    clusters = concentric_clusters(near_circular(find_contours(grey, settings), settings))
    return tuple(ellipse for cluster in clusters for ellipse in cluster)


def near_circular(contours: Contours, settings: DetectSettings) -> tuple[Ellipse, ...]:
    """Return the contours that pass the paper's circle test, as ellipses [px].

    With μ and σ the mean and the standard deviation of the radius about the contour's mean point, a
    contour passes if μ > μ_min and σ < k μ.

    Blur or overexposure can open the dots towards the plate. Then the contour runs through the dots
    into the ring. Therefore the convex hull is tested in place of a contour that is too rough to
    pass but long enough to surround a ring.
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
    single = _without_twins(centres[candidates], mean[candidates])
    curves = [contours.contour(int(index)) for index in candidates[single]]
    curves += circular_hulls(contours.chosen(np.flatnonzero(rough)), settings)
    fits = (_preliminary_ellipse(curve) for curve in curves)
    return tuple(ellipse for ellipse in fits if ellipse is not None)


def _without_twins(centres: FloatArray, mean_radii: FloatArray) -> IndexArray:
    """Return the indices of one circle per edge, the larger: an edge has a contour on each side."""
    kept: list[int] = []
    for index in np.argsort(-mean_radii, kind="stable"):
        near = np.abs(centres[kept] - centres[index]).max(axis=1) < _SAME_CIRCLE_PX
        if not np.any(near & (mean_radii[kept] - mean_radii[index] < _TWIN_RADIUS_PX)):
            kept.append(int(index))
    return np.array(sorted(kept), dtype=np.intp)


def _preliminary_ellipse(points: FloatArray) -> Ellipse | None:
    """Fit an ellipse to a contour robustly: without parts where dots or clutter break into it."""
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

    The contours on both sides of an edge give nearly the same ellipse. Of ellipses that agree to a
    fraction of a pixel only the larger is kept.
    """
    if not ellipses:
        return ()
    ordered = sorted(ellipses, key=lambda ellipse: (-ellipse.mean_radius, ellipse.x, ellipse.y))
    centres = np.array([ellipse.centre for ellipse in ordered])
    reach = _CONCENTRIC_PX + _CONCENTRIC * np.array([ellipse.mean_radius for ellipse in ordered])
    is_free = np.ones(len(ordered), dtype=bool)
    clusters = []
    for first in range(len(ordered)):
        if not is_free[first]:
            continue
        members = is_free & (np.linalg.norm(centres - centres[first], axis=1) <= reach)
        is_free &= ~members
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
