"""The pixels that take part in the adjustment."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.masks import (
    SeenPlate,
    background_mask,
    occluded_mask,
    see_plate,
)
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.image_model.blur import (
    REACH_SIGMAS,
    Blur,
    EdgeIncidence,
    find_edge_incidence,
    reach_px,
)
from kgcp.measurement.image_model.blurred_plate import white_share_without_derivatives
from kgcp.measurement.image_model.noise import Censoring
from kgcp.measurement.image_model.photometry import (
    PLAIN_COUNT,
    Light,
    PhotometricModel,
    plateau_levels,
)
from kgcp.measurement.image_model.sharpening import unsharp_mask

_BORDER_SIGMAS, _BORDER_PX = 2.5, 0.8  # width of the border beyond the outer circle that is used
_BORDER_RADII = 0.2  # its largest width
_NEAR_PX = 0.3  # added to half the width of the band around an edge that is used
_PLATEAU_PIXELS = 400  # enough for the levels and their noise
NEAR_SIGMAS = 2.0
"""Half the width of the band around an edge that is used, in σ of the blur; see `select_pixels`."""
_SMALL_PX = 40.0  # radius below which sharpening depends on the far tails of edges
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # its multiples, modulo 1, are spread evenly


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The pixels that take part, chosen for an approximate pose and blur."""

    problem: FitProblem
    index: IndexArray  # (n,): the pixels, in the flattened window
    pixels: FloatArray  # (2, n): where they are in the raw image
    is_thinned: bool  # whether more pixels would have been useful
    levels: FloatArray  # (n,)
    rays: FloatArray  # (6, n): as in `Window`
    photometry: PhotometricModel
    censoring: Censoring
    incidence: EdgeIncidence

    @property
    def clipped(self) -> FloatArray | BoolArray:
        """Share of clipped pixels (n,) in each."""
        bins = self.problem.window.clipped
        if bins is None:
            return self.censoring.is_clipped
        return bins[self.index]


def select_pixels(
    problem: FitProblem,
    pose: Pose,
    blur: Blur,
    light: Light | None,
    *,
    max_pixels: int | None = None,
    slack_px: float = 0.0,
    near_sigmas: float = NEAR_SIGMAS,
    plateau_pixels: int = _PLATEAU_PIXELS,
) -> Sample:
    """Choose pixels near edges and some of the plateaus, at most `max_pixels` of both.

    Pixels are not used if blur may have mixed them with the surroundings of the plate, or with
    something that hides a part of the target. Both masks need the levels (`light`); without these,
    neither is made. The pose may be off by `slack_px`.

    Pixels beyond `near_sigmas` of the blur from an edge are left out. In the far tails of an edge
    they say little about it but cost as much as any other, and they are the first to show effects
    that are not modelled.

    Raises
    ------
    Rejection
        `EDGES_LOST` if too little of the target is within the frame.
    """
    seen = see_plate(problem, pose, blur, slack_px)
    unused = np.zeros(len(seen.unblurred.rho_m), dtype=np.bool_)
    if light is not None:
        unused = background_mask(seen, light, slack_px)
        unused |= occluded_mask(seen, light, slack_px)
    if problem.visible is not None:
        sectors = _sectors_about_normal(seen.unblurred.points_m, len(problem.visible))
        unused |= ~problem.visible[sectors]
    index = _useful_pixels(seen, unused, near_sigmas, plateau_pixels)
    most = problem.most_pixels if max_pixels is None else max_pixels
    is_sparse = most is not None and len(index) > most
    if most is not None and is_sparse:
        index = index[_GOLDEN * np.arange(len(index)) % 1.0 < most / len(index)]
    if len(index) < 4 * PLAIN_COUNT:
        raise Rejection(Reason.EDGES_LOST, f"only {len(index)} usable pixels of the target")
    is_thinned = is_sparse and max_pixels is not None
    return _sample(seen, pose, light, index, is_thinned=is_thinned, is_sparse=is_sparse)


def whole_plate(problem: FitProblem, pose: Pose, blur: Blur, light: Light) -> Sample:
    """Return all pixels of the ring and its border, hidden ones too, for pictures of residuals.

    Only pixels that blur mixes with the surroundings of the plate, whatever the pose, are left out.
    """
    seen = see_plate(problem, pose, blur)
    reach_m = (1.0 + _BORDER_RADII) * problem.outer_radius_m
    unused = background_mask(seen, light, slack_px=math.inf)
    index = np.flatnonzero((seen.unblurred.rho_m < reach_m) & ~unused)
    return _sample(seen, pose, light, index, is_thinned=False, is_sparse=False)


def _sample(
    seen: SeenPlate,
    pose: Pose,
    light: Light | None,
    index: IndexArray,
    *,
    is_thinned: bool,
    is_sparse: bool,
) -> Sample:
    """Collect pixels; `is_sparse` says that some of those beside edges are left out."""
    problem = seen.problem
    window, clip = problem.window, problem.censoring
    rays, pixels = np.take(window.rays, index, axis=1), window.pixels(index)
    return Sample(
        problem=problem,
        index=index,
        pixels=pixels,
        is_thinned=is_thinned,
        levels=window.levels[index],
        rays=rays,
        photometry=_photometric_model(seen, pose, light, index, pixels, is_sparse=is_sparse),
        censoring=replace(clip, at_high=clip.at_high[index], at_low=clip.at_low[index]),
        incidence=_edge_incidence(seen, pose, rays, index),
    )


def _sectors_about_normal(points_m: FloatArray, count: int) -> IndexArray:
    """Return the number (n,) of the equal sector about the normal that each point (2, n) is in."""
    turns = np.arctan2(points_m[1], points_m[0]) / (2.0 * math.pi)
    return np.asarray(np.rint(turns * count).astype(np.intp) % count)


def _useful_pixels(
    seen: SeenPlate, unused: BoolArray, near_sigmas: float, plateau_pixels: int
) -> IndexArray:
    """Return the pixels near edges and some of the plateaus, without the `unused` ones.

    Pixels of plateaus are used only where no circle reaches that is not measured.
    """
    problem, sd_px, scale = seen.problem, seen.blur.largest_sd_px, seen.metres_per_px
    tail_m = REACH_SIGMAS * sd_px * scale
    border_px = _BORDER_SIGMAS * sd_px + _BORDER_PX
    limit = 1.0 + min(_BORDER_RADII, border_px / problem.outer_radius_px)
    index = np.empty(len(unused), dtype=np.intp)
    count = _fill_in_pixels(
        seen.unblurred.rho_m,
        seen.unblurred.measured_edge_distance_m,
        unused,
        (near_sigmas * sd_px + _NEAR_PX) * scale,
        tail_m,
        _unmeasured_m(seen),
        limit * problem.outer_radius_m,
        plateau_pixels,
        index,
    )
    return index[:count]


def _unmeasured_m(seen: SeenPlate) -> float:
    """Return how far from the target's centre the blurred edges of unmeasured circles reach."""
    problem = seen.problem
    radii_m = problem.circles.radii_m[problem.measured_count :]
    reach_m = reach_px(seen.blur) * seen.metres_per_px
    return float(radii_m.max()) + reach_m if len(radii_m) else 0.0


@compiled
def _fill_in_pixels(
    rho_m: FloatArray,
    edge_distance_m: FloatArray,
    unused: BoolArray,
    near_m: float,
    tail_m: float,
    unmeasured_m: float,
    limit_m: float,
    plateau_pixels: int,
    index: IndexArray,
) -> int:
    """Fill in all pixels near edges, and some of those clear of all edges; return how many."""
    flat = 0
    for i in range(len(rho_m)):
        is_flat = edge_distance_m[i] >= tail_m and unmeasured_m <= rho_m[i] < limit_m
        flat += is_flat and not unused[i]
    step, number, count = max(1, flat // plateau_pixels), 0, 0
    for i in range(len(rho_m)):
        if unused[i] or rho_m[i] >= limit_m:
            continue
        is_used = edge_distance_m[i] < near_m
        if edge_distance_m[i] >= tail_m and rho_m[i] >= unmeasured_m:
            is_used = number % step == 0
            number += 1
        if is_used:
            index[count] = i
            count += 1
    return count


def _photometric_model(
    seen: SeenPlate,
    pose: Pose,
    light: Light | None,
    index: IndexArray,
    pixels: FloatArray,
    *,
    is_sparse: bool,
) -> PhotometricModel:
    problem, window = seen.problem, seen.problem.window
    offsets = (pixels - problem.centre_px[:, None]) / problem.outer_radius_px
    if problem.sharpening_px == 0.0 or light is None:
        return PhotometricModel(offsets, problem.tone, None)
    shown = seen.unblurred.share
    if is_sparse or problem.outer_radius_px < _SMALL_PX:
        shown = _white_share_shown(seen, pose, light, index)
    mask = unsharp_mask((window.height, window.width), index, shown, problem.sharpening_px)
    return PhotometricModel(offsets, problem.tone, mask)


def _white_share_shown(seen: SeenPlate, pose: Pose, light: Light, index: IndexArray) -> FloatArray:
    """Return the white shares that sharpening assumes for pixels that are not adjusted.

    They are the modelled levels under this pose, blur and light, as shares between ink and plate.
    Pixels of `index`, which are adjusted, have their share without blur.
    """
    problem, scale, shown = seen.problem, seen.metres_per_px, seen.unblurred.share.copy()
    is_other = seen.unblurred.edge_distance_m < REACH_SIGMAS * seen.blur.largest_sd_px * scale
    is_other[index] = False
    others = np.flatnonzero(is_other)
    rays, points_m = (
        np.take(a, others, axis=1) for a in (problem.window.rays, seen.unblurred.points_m)
    )
    incidence = find_edge_incidence(points_m, scale, problem.circles, seen.blur, seen.spread)
    share = white_share_without_derivatives(pose.matrix, rays, seen.blur.vector, incidence).value
    even = PhotometricModel(np.zeros((2, len(others))), problem.tone, None)
    black, white = plateau_levels(light, problem.tone)
    shown[others] = (even.levels(share, light) - black) / (white - black)
    return shown


def _edge_incidence(
    seen: SeenPlate, pose: Pose, rays: FloatArray, index: IndexArray
) -> EdgeIncidence:
    """Pair pixels with the measured circles; the other circles are fixed, as under this pose."""
    problem, blur, scale = seen.problem, seen.blur, seen.metres_per_px
    points_m = np.take(seen.unblurred.points_m, index, axis=1)
    measured = problem.circles.part(slice(0, problem.measured_count))
    incidence = find_edge_incidence(points_m, scale, measured, blur, seen.spread)
    if seen.unblurred.rho_m[index].min() > _unmeasured_m(seen):
        return incidence
    others = problem.circles.part(slice(problem.measured_count, None))
    replicas = find_edge_incidence(points_m, scale, others, blur, seen.spread)
    added = white_share_without_derivatives(pose.matrix, rays, blur.vector, replicas).value - 1.0
    return replace(incidence, background=incidence.background + added)
