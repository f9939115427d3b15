"""The pixels that take part in the adjustment."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from kgcp.compiled import compiled
from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.target.coverage import white_level
from kgcp.target.foreign import hidden_pixels, reached_by_surroundings, see_plate
from kgcp.target.imager import Imager
from kgcp.target.imaging import Imaging
from kgcp.target.light import PARAM_COUNT, Light
from kgcp.target.noise import BoolArray, Censoring
from kgcp.target.pairs import REACH_SIGMAS, Blur, EdgePairs, pair_edges
from kgcp.target.plate import largest_metres_per_px, plate_points
from kgcp.target.sharpening import unsharp_mask

_BORDER_SIGMAS, _BORDER_PX = 2.5, 0.8  # how far beyond the outer circle plate is needed …
_BORDER_RADII = 0.2  # … and how far it is looked for at most
_NEAR_SIGMAS, _NEAR_PX = 2.0, 0.3  # half width of the band around an edge that is used
_SCALE_PIXELS = 100  # enough to see how the plate's scale varies
_PLATEAU_PIXELS = 400  # enough for the levels and their noise
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # its multiples are spread evenly


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The pixels that take part, chosen for an approximate pose and blur.

    Attributes
    ----------
    imaging : Imaging
    index : (n,) array of int
        The pixels, in the flattened window.
    is_thinned : bool
        There would be more.
    levels : (n,) array
    rays : (6, n) array
        As in `Window`.
    imager : Imager
    censoring : Censoring
    pairs : EdgePairs
    """

    imaging: Imaging
    index: IndexArray
    is_thinned: bool
    levels: FloatArray
    rays: FloatArray
    imager: Imager
    censoring: Censoring
    pairs: EdgePairs

    @property
    def clipped(self) -> FloatArray | BoolArray:
        """Share of clipped pixels (n,) in each."""
        bins = self.imaging.window.clipped
        if bins is None:
            return self.censoring.at_high | self.censoring.at_low
        return bins[self.index]


def choose_sample(
    imaging: Imaging,
    pose: Pose,
    blur: Blur,
    light: Light | None,
    *,
    most: int | None = None,
    slack_px: float = 0.0,
) -> Sample:
    """Choose the pixels near edges, and a share of the plateaus; `most` of them, where given.

    Pixels that blur may mix with what is foreign are not used: surroundings of the plate,
    and what hides a part of the target. It is seen from the levels, once they are known (`light`),
    by a pose that may be off by `slack_px`.

    Pixels in the far tails of an edge say little about it but cost as much as any other, and they
    feel first what the model does not know; they are left out.

    Raises
    ------
    Rejection
        `EDGES_LOST` if too little of the target is within the frame.
    """
    window = imaging.window
    some = slice(None, None, max(1, window.rays.shape[1] // _SCALE_PIXELS))
    scale = largest_metres_per_px(pose, window.rays[:, some])
    points = plate_points(pose, window.rays)
    zone = _zones(imaging, points, blur, scale)
    if light is not None:
        seen = see_plate(imaging, points, scale, blur, light)
        zone[reached_by_surroundings(seen) | hidden_pixels(seen, slack_px)] = _Zone.UNUSED
    if imaging.visible is not None:
        zone[~imaging.visible[_steps_about(points, len(imaging.visible))]] = _Zone.UNUSED
    near, flat = np.flatnonzero(zone == _Zone.NEAR), np.flatnonzero(zone == _Zone.FLAT)
    index = np.concatenate((near, flat[:: max(1, len(flat) // _PLATEAU_PIXELS)]))
    index.sort()
    is_thinned = most is not None and len(index) > most
    if most is not None and is_thinned:
        index = index[_GOLDEN * np.arange(len(index)) % 1.0 < most / len(index)]
    if len(index) < 4 * PARAM_COUNT:
        raise Rejection(Reason.EDGES_LOST, f"{len(index)} pixels of the target")
    return replace(_sample(imaging, pose, blur, points, index, scale), is_thinned=is_thinned)


def whole_plate(imaging: Imaging, pose: Pose, blur: Blur, light: Light) -> Sample:
    """Return all pixels of the ring and its border, hidden ones too: to be looked at.

    Those that blur mixes with what surrounds the plate are left out.
    """
    rays = imaging.window.rays
    points, scale = plate_points(pose, rays), largest_metres_per_px(pose, rays)
    seen = see_plate(imaging, points, scale, blur, light)
    reach_m = (1.0 + _BORDER_RADII) * imaging.outer_radius_m
    index = np.flatnonzero((seen.rho_m < reach_m) & ~reached_by_surroundings(seen))
    return _sample(imaging, pose, blur, points, index, scale)


def _sample(
    imaging: Imaging,
    pose: Pose,
    blur: Blur,
    points_m: FloatArray,
    index: IndexArray,
    metres_per_px: float,
) -> Sample:
    window, clip = imaging.window, imaging.censoring
    rays = window.rays[:, index]
    return Sample(
        imaging=imaging,
        index=index,
        is_thinned=False,
        levels=window.levels[index],
        rays=rays,
        imager=_imager(imaging, points_m, index),
        censoring=Censoring(clip.high, clip.low, clip.at_high[index], clip.at_low[index]),
        pairs=_pairs(imaging, pose, blur, rays, points_m[:, index], metres_per_px),
    )


def _steps_about(points_m: FloatArray, count: int) -> IndexArray:
    """Return in which of so many steps about the plate's normal points (2, n) are."""
    turns = np.arctan2(points_m[1], points_m[0]) / (2.0 * math.pi)
    return np.asarray(np.rint(turns * count).astype(np.intp) % count)


class _Zone(IntEnum):
    """What a pixel of the window is good for."""

    UNUSED = 0
    NEAR = 1  # it knows where an edge is
    FLAT = 2  # it knows the level of ink or plate


def _zones(imaging: Imaging, points_m: FloatArray, blur: Blur, metres_per_px: float) -> IndexArray:
    """Return the zone (n,) of every pixel. Within circles that are not measured none is used."""
    near_m = (_NEAR_SIGMAS * blur.largest_sd_px + _NEAR_PX) * metres_per_px
    tail_m = REACH_SIGMAS * blur.largest_sd_px * metres_per_px
    border_px = _BORDER_SIGMAS * blur.largest_sd_px + _BORDER_PX
    limit = 1.0 + min(_BORDER_RADII, border_px / imaging.outer_radius_px)
    circles, count = imaging.circles, imaging.measured_count
    zone = np.zeros(points_m.shape[1], dtype=np.intp)
    _fill_zones(
        points_m,
        circles.centres_m[:, :count],
        circles.radii_m[:count],
        near_m,
        tail_m,
        tail_m + circles.radii_m[count:].max(initial=-tail_m),
        limit * imaging.outer_radius_m,
        zone,
    )
    return zone


@compiled
def _fill_zones(
    points_m: FloatArray,
    centres_m: FloatArray,
    radii_m: FloatArray,
    near_m: float,
    tail_m: float,
    unmeasured_m: float,
    limit_m: float,
    zone: IndexArray,
) -> None:
    for i in range(points_m.shape[1]):
        x, y = points_m[0, i], points_m[1, i]
        square = x * x + y * y
        if square >= limit_m * limit_m:
            continue
        zone[i] = 2 if square >= unmeasured_m * unmeasured_m else 0
        for c in range(len(radii_m)):
            dx, dy = x - centres_m[0, c], y - centres_m[1, c]
            off_edge = abs(math.sqrt(dx * dx + dy * dy) - radii_m[c])
            if off_edge < near_m:
                zone[i] = 1
                break
            if off_edge < tail_m:
                zone[i] = 0


def _imager(imaging: Imaging, points_m: FloatArray, index: IndexArray) -> Imager:
    window = imaging.window
    offsets = (window.pixels(index) - imaging.centre_px).T / imaging.outer_radius_px
    if imaging.sharpening_px == 0.0:
        return Imager(offsets, imaging.response, None, np.zeros(0))
    mask = unsharp_mask(window.width, window.height, index, imaging.sharpening_px)
    circles, plateau = imaging.circles, np.ones(len(mask.others))
    others_m = points_m[:, mask.others]
    _fill_plateau(others_m, circles.centres_m, circles.radii_m, circles.signs, plateau)
    return Imager(offsets, imaging.response, mask, plateau)


@compiled
def _fill_plateau(
    points_m: FloatArray,
    centres_m: FloatArray,
    radii_m: FloatArray,
    signs: FloatArray,
    plateau: FloatArray,
) -> None:
    """Add every circle to the white share without blur."""
    for i in range(points_m.shape[1]):
        for c in range(len(radii_m)):
            dx, dy = points_m[0, i] - centres_m[0, c], points_m[1, i] - centres_m[1, c]
            if dx * dx + dy * dy < radii_m[c] * radii_m[c]:
                plateau[i] += signs[c]


def _pairs(
    imaging: Imaging,
    pose: Pose,
    blur: Blur,
    rays: FloatArray,
    points_m: FloatArray,
    metres_per_px: float,
) -> EdgePairs:
    """Pair the pixels with the measured circles; the others are as they are for this pose."""
    measured = imaging.circles.part(slice(0, imaging.measured_count))
    others = imaging.circles.part(slice(imaging.measured_count, None))
    pairs = pair_edges(points_m, metres_per_px, measured, blur)
    if not len(others.radii_m):
        return pairs
    replicas = pair_edges(points_m, metres_per_px, others, blur)
    if not len(replicas.members) and np.all(replicas.background == 1.0):
        return pairs
    added = white_level(pose, rays, blur, replicas).value - 1.0
    return replace(pairs, background=pairs.background + added)
