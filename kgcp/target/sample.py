"""The pixels that take part in the adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.geometry.pose import Pose
from kgcp.target.coverage import white_level
from kgcp.target.light import PARAM_COUNT, Grid, Imager, Light, plateau_levels
from kgcp.target.noise import BoolArray, Censoring
from kgcp.target.pairs import REACH_SIGMAS, Blur, EdgePairs, pair_edges
from kgcp.target.plate import Circles, PlateView, largest_metres_per_px, view_plate
from kgcp.target.window import Window

_BORDER_SIGMAS, _BORDER_PX = 2.5, 0.8  # how far beyond the outer circle plate is needed …
_BORDER_RADII = 0.2  # … and how far it is looked for at most
_CLEAR_SIGMAS = 2.6  # from the outer circle on, where the plate shows its own level
_FOREIGN_CONTRAST = 0.15  # off the plate's level: not plate, or mixed with what is not …
_FOREIGN_SIGMAS = 1.7  # … and so much farther its blur is felt
_NEAR_SIGMAS, _NEAR_PX = 2.0, 0.3  # half width of the band around an edge that is used
_PLATEAU_PIXELS = 400  # enough for the levels and their noise


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


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The pixels that take part, chosen for an approximate pose and blur."""

    imaging: Imaging
    levels: FloatArray
    normalised: FloatArray
    normalised_from_px: FloatArray
    imager: Imager
    censoring: Censoring
    pairs: EdgePairs


def choose_sample(imaging: Imaging, pose: Pose, blur: Blur, light: Light | None) -> Sample:
    """Choose the pixels near edges, and a share of the plateaus.

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
    view = view_plate(pose, window.normalised, window.normalised_from_px)
    x, y = view.points_m / imaging.outer_radius_m
    border_px = _BORDER_SIGMAS * blur.largest_sd_px + _BORDER_PX
    limit = 1.0 + min(_BORDER_RADII, border_px / imaging.outer_radius_px)
    within = x * x + y * y < limit * limit
    if light is not None:
        within &= ~_reached_by_surroundings(imaging, np.hypot(x, y) - 1.0, blur, light)
    near, in_tail = _edge_zones(view, imaging, blur)
    flat = np.flatnonzero(within & ~near & ~in_tail)
    chosen = within & near
    chosen[flat[:: max(1, len(flat) // _PLATEAU_PIXELS)]] = True
    index = np.flatnonzero(chosen)
    if len(index) < 4 * PARAM_COUNT:
        raise Rejection(Reason.EDGES_LOST, f"{len(index)} pixels of the target")
    normalised = np.ascontiguousarray(window.normalised[:, index])
    normalised_from_px = np.ascontiguousarray(window.normalised_from_px[:, :, index])
    clip = imaging.censoring
    return Sample(
        imaging=imaging,
        levels=window.levels[index],
        normalised=normalised,
        normalised_from_px=normalised_from_px,
        imager=Imager(
            Grid(
                window.width,
                window.height,
                index,
                (window.pixels(index) - imaging.centre_px).T / imaging.outer_radius_px,
                _unblurred(view, imaging.circles) if imaging.sharpening_px > 0.0 else np.zeros(0),
            ),
            imaging.response,
            imaging.sharpening_px,
        ),
        censoring=Censoring(clip.high, clip.low, clip.at_high[index], clip.at_low[index]),
        pairs=_pairs(view_plate(pose, normalised, normalised_from_px), imaging, blur),
    )


def _pairs(view: PlateView, imaging: Imaging, blur: Blur) -> EdgePairs:
    """Pair the pixels with the measured circles; the others are as they are for this pose."""
    measured = imaging.circles.part(slice(0, imaging.measured_count))
    others = imaging.circles.part(slice(imaging.measured_count, None))
    pairs = pair_edges(view, measured, blur)
    reach_m = REACH_SIGMAS * blur.largest_sd_px * largest_metres_per_px(view)
    x, y = view.points_m
    if (x * x + y * y).min() > (others.radii_m.max(initial=-reach_m) + reach_m) ** 2:
        return pairs  # all replicas lie inside
    added = white_level(view, blur, pair_edges(view, others, blur)) - 1.0
    return replace(pairs, background=pairs.background + added)


def _reached_by_surroundings(
    imaging: Imaging, beyond: FloatArray, blur: Blur, light: Light
) -> BoolArray:
    """Tell which pixels of the window blur may mix with something that is not plate.

    Parameters
    ----------
    imaging : Imaging
    beyond : (n,) array
        Distance beyond the outer circle, in ring radii.
    blur : Blur
    light : Light
    """
    window = imaging.window
    size = (window.height, window.width)
    black, white = plateau_levels(light, imaging.response)
    contrast, white = white - black, min(white, 1.0)
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
    return np.asarray(reached.ravel() > 0) & (beyond > -2.0 * reach / imaging.outer_radius_px)


def _edge_zones(view: PlateView, imaging: Imaging, blur: Blur) -> tuple[BoolArray, BoolArray]:
    """Tell which pixels are near a measured edge, and which in the tails of any."""
    metres_per_px = largest_metres_per_px(view)
    near_m = (_NEAR_SIGMAS * blur.largest_sd_px + _NEAR_PX) * metres_per_px
    tail_m = REACH_SIGMAS * blur.largest_sd_px * metres_per_px
    near = np.zeros(view.points_m.shape[1], dtype=bool)
    in_tail = near.copy()
    circles = imaging.circles
    for index, radius in enumerate(circles.radii_m):
        x, y = view.points_m - circles.centres_m[:, index, None]
        off_edge = np.abs(np.sqrt(x * x + y * y) - radius)
        if index < imaging.measured_count:
            near |= off_edge < near_m
        in_tail |= off_edge < tail_m
    return near, in_tail


def _unblurred(view: PlateView, circles: Circles) -> FloatArray:
    """Return the white share of all pixels of a window without blur."""
    share = np.ones(view.points_m.shape[1])
    for centre, radius, sign in zip(
        circles.centres_m.T, circles.radii_m, circles.signs, strict=True
    ):
        x, y = view.points_m - centre[:, None]
        share += sign * (x * x + y * y < radius * radius)
    return share
