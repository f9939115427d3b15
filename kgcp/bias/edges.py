"""Distances by one edge and by two: what an exposure that moves the edges does to them."""

from __future__ import annotations

from dataclasses import dataclass

from kgcp.bias.study import Comparison
from kgcp.settings import Method


@dataclass(frozen=True, slots=True)
class EdgeDistances:
    """Distances of one target by its edges.

    Attributes
    ----------
    one_m : float
        As the outer edge alone gives it, displaced by exposure as it is [m].
    two_m : float
        With both edges, whose common displacement drops out [m].
    one_px : float
        Radius of the displaced outer edge [px].
    """

    one_m: float
    two_m: float
    one_px: float


def edge_distances(one: Comparison, method: Method) -> EdgeDistances | None:
    """Return both distances of a comparison; None where it has no measurement, or no δ.

    Exposure displaces the outer edge by δ towards the dark ring, from the radius R to R − δ, and
    a distance is inversely proportional to the radius. The paper's chain takes the pose from the
    outer edge; the image model has displaced edges among its unknowns.
    """
    seen, look = one.attempt.sighting, one.attempt.exposure
    if seen is None or look.edge_shift_px is None or look.radius_px is None:
        return None
    if method is Method.PAPER:  # there the radius is that of the displaced edge
        share = look.edge_shift_px / look.radius_px
        return EdgeDistances(seen.distance_m, seen.distance_m / (1.0 + share), look.radius_px)
    displaced_px = look.radius_px - look.edge_shift_px
    one_m = seen.distance_m * look.radius_px / displaced_px
    return EdgeDistances(one_m, seen.distance_m, displaced_px)
