"""The pixels that take part in the adjustment."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np

from kgcp.compiled import compiled
from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Response
from kgcp.geometry.pose import Pose
from kgcp.target.coverage import white_level
from kgcp.target.light import PARAM_COUNT, Imager, Light, plateau_levels
from kgcp.target.noise import BoolArray, Censoring
from kgcp.target.pairs import REACH_SIGMAS, Blur, EdgePairs, pair_edges
from kgcp.target.plate import Circles, largest_metres_per_px, plate_points
from kgcp.target.sharpening import unsharp_mask
from kgcp.target.window import Window

_BORDER_SIGMAS, _BORDER_PX = 2.5, 0.8  # how far beyond the outer circle plate is needed …
_BORDER_RADII = 0.2  # … and how far it is looked for at most
_CLEAR_SIGMAS = 2.6  # from the outer circle on, where the plate shows its own level
_FOREIGN_CONTRAST = 0.15  # off the plate's level: not plate, or mixed with what is not …
_FOREIGN_SIGMAS = 1.7  # … and so much farther its blur is felt
_NEAR_SIGMAS, _NEAR_PX = 2.0, 0.3  # half width of the band around an edge that is used
_SCALE_PIXELS = 100  # enough to see how the plate's scale varies
_PLATEAU_PIXELS = 400  # enough for the levels and their noise
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # its multiples are spread evenly
_FEW_PIXELS = 600  # enough to come near the minimum, at a fraction of the time


@dataclass(frozen=True, slots=True, eq=False)
class Imaging:
    """What is known of the imaging, and of the plate, before the adjustment.

    Attributes
    ----------
    window : Window
    circles : Circles
        All circles of the plate.
    measured_count : int
        The first so many of them are measured; of the others only what they add there is modelled.
    outer_radius_m, outer_radius_px : float
        Of the ring that is measured.
    centre_px : (2,) array
        Approximate, raw image.
    focal_px : float
        Mean principal distance.
    censoring : Censoring
        Of the whole window.
    response : Response
    sharpening_px : float
        σ of the unsharp mask to be modelled [px]; 0: none.
    """

    window: Window
    circles: Circles
    measured_count: int
    outer_radius_m: float
    outer_radius_px: float
    centre_px: FloatArray
    focal_px: float
    censoring: Censoring
    response: Response
    sharpening_px: float

    @property
    def few_pixels(self) -> int | None:
        """How many pixels a first approach needs; None: all, for an unsharp mask needs them."""
        return None if self.sharpening_px else _FEW_PIXELS


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


def choose_sample(
    imaging: Imaging, pose: Pose, blur: Blur, light: Light | None, most: int | None = None
) -> Sample:
    """Choose the pixels near edges, and a share of the plateaus; `most` of them, where given.

    Beyond the outer circle only pixels that the surroundings of the plate do not reach by blur are
    used: what is foreign is seen from the levels, once they are known (`light`).

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
        zone[_reached_by_surroundings(imaging, points, blur, light)] = _Zone.UNUSED
    near, flat = np.flatnonzero(zone == _Zone.NEAR), np.flatnonzero(zone == _Zone.FLAT)
    index = np.concatenate((near, flat[:: max(1, len(flat) // _PLATEAU_PIXELS)]))
    index.sort()
    is_thinned = most is not None and len(index) > most
    if most is not None and is_thinned:
        index = index[_GOLDEN * np.arange(len(index)) % 1.0 < most / len(index)]
    if len(index) < 4 * PARAM_COUNT:
        raise Rejection(Reason.EDGES_LOST, f"{len(index)} pixels of the target")
    rays, clip = window.rays[:, index], imaging.censoring
    return Sample(
        imaging=imaging,
        index=index,
        is_thinned=is_thinned,
        levels=window.levels[index],
        rays=rays,
        imager=_imager(imaging, points, index),
        censoring=Censoring(clip.high, clip.low, clip.at_high[index], clip.at_low[index]),
        pairs=_pairs(imaging, pose, blur, rays, points[:, index], scale),
    )


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


def _reached_by_surroundings(
    imaging: Imaging, points_m: FloatArray, blur: Blur, light: Light
) -> BoolArray:
    """Tell which pixels of the window blur may mix with something that is not plate.

    Parameters
    ----------
    imaging : Imaging
    points_m : (2, n) array
        Where the pixels' rays meet the plate.
    blur : Blur
    light : Light
    """
    window = imaging.window
    size = (window.height, window.width)
    black, white = plateau_levels(light, imaging.response)
    contrast, white = white - black, min(white, 1.0)
    beyond = np.hypot(*points_m) / imaging.outer_radius_m - 1.0
    seen = cv2.medianBlur(window.levels.reshape(size).astype(np.float32), 3).ravel()
    outside = beyond * imaging.outer_radius_px > _CLEAR_SIGMAS * blur.largest_sd_px
    foreign = outside & (np.abs(seen - white) > _FOREIGN_CONTRAST * contrast)
    reach = _FOREIGN_SIGMAS * blur.largest_sd_px
    half = int(np.ceil(reach))
    columns, rows = np.meshgrid(*2 * [np.arange(-half, half + 1)])
    xx, yy, xy = blur.total_covariance
    determinant = xx * yy - xy * xy
    distance2 = (yy * columns**2 - 2.0 * xy * columns * rows + xx * rows**2) / determinant
    kernel = (distance2 <= _FOREIGN_SIGMAS**2).astype(np.uint8)
    reached = cv2.dilate(foreign.reshape(size).astype(np.uint8), kernel)
    return np.asarray((reached.ravel() > 0) & (beyond > -2.0 * reach / imaging.outer_radius_px))
