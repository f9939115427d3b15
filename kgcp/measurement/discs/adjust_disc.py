"""The adjustment of one disc in rounds, each with its own choice of pixels and its own noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.measurement.discs.affine_model import NO_INNER, DiscPixels, Geometry, distances_px
from kgcp.measurement.discs.disc_levels import Row
from kgcp.measurement.discs.fit_disc import (
    CAMERA_ROWS,
    DiscFit,
    DiscSample,
    DiscState,
    DiscUnknowns,
    fit_disc,
)
from kgcp.measurement.discs.pixel_choice import (
    DiscWindow,
    choose_pixels,
    cut_disc_window,
    window_reach_px,
)
from kgcp.measurement.discs.records import (
    DiscOutline,
    DiscReason,
    Polarity,
    moments_of_ellipse,
)
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.noise import (
    Censoring,
    find_censoring,
    median_at_edges,
    outlier_share,
)

_ROUNDS = 3
_SETTLED_PX, _SETTLED_BLUR = 0.6, 0.2  # a round that changes edge and blur by less is the last
_FIRST_BLUR_PX, _FIRST_BLUR = 0.8, 0.3  # in pixels, at most this share of the radius
_LEAST_CONTRAST_COUNTS = 4.0
# How far the result may be from the outline, in pixels or in radii, whichever is more: the centre,
# and the size. Burnt light displaces edges by more than a pixel.
_MAX_OFF_PX, _MAX_OFF = 1.0, 0.25
_MAX_GROWN_PX, _MAX_GROWN = 2.0, 0.4
# Residuals at the edge, as a share of the contrast, and share of outliers. Small discs that are
# burnt and sharpened have residuals of up to 0.19; what is not a disc, mostly more than 0.3.
_MAX_EDGE_NOISE, _MAX_OUTLIERS = 0.2, 0.3
_LEAST_REDUNDANCY = 6.0  # with less, a standard deviation says little of the errors (Student's t)
_LEAST_CURVED_PX = 6.0  # smaller discs do not tell curved light from blur or textured ground
_CURVED = 25.0  # least χ² of five terms; noise alone exceeds it in one of ten thousand discs
_FOREIGN_SIGMAS, _FOREIGN_CONTRAST = 6.0, 0.12  # least residual of what is neither disc nor ground


class DiscRejection(Exception):  # noqa: N818 - the outcome of one disc
    """A disc cannot be measured."""

    def __init__(self, reason: DiscReason, detail: str = "") -> None:
        super().__init__(reason, detail)
        self.reason, self.detail = reason, detail


@dataclass(frozen=True, slots=True, eq=False)
class DiscTask:
    """One disc to be measured."""

    grey: GreyArray
    outline: DiscOutline
    others: Sequence[Geometry]  # other edges, whose pixels are left out
    inner: FloatArray = field(default_factory=lambda: NO_INNER)  # as in `DiscPixels`
    is_ground_even: bool = True  # False: the ground has a texture
    has_border: bool = False  # whether the ground around it is known to be even
    smear: tuple[int, int] = (0, 0)  # of the photograph, by `find_smear`

    @property
    def is_dark(self) -> bool:
        """Whether it is darker than the ground."""
        return self.outline.polarity is Polarity.DARK

    @property
    def radius_px(self) -> float:
        """Mean radius of the outline [px]."""
        return self.outline.ellipse.mean_radius


def geometry_of(vector: FloatArray) -> Geometry:
    """Return centre and symmetric stretch M (5,) of centroid and second moments M M / 4 (5,)."""
    square = 4.0 * vector[[2, 3, 3, 4]].reshape(2, 2)
    area = math.sqrt(max(float(np.linalg.det(square)), 1e-12))
    root = (square + area * np.eye(2)) / math.sqrt(float(np.trace(square)) + 2.0 * area)
    return np.array((*vector[:2], root[0, 0], root[0, 1], root[1, 1]))


def outline_geometry(outline: DiscOutline) -> Geometry:
    """Return centre and stretch (5,) of an outline."""
    return geometry_of(moments_of_ellipse(outline.ellipse))


def adjust_disc_in_any_light(task: DiscTask, free: DiscUnknowns, blur_px: float = 0.0) -> DiscFit:
    """Adjust a disc; if the edge of a shadow or of a spot crosses it, with light of second order.

    Raises
    ------
    DiscRejection, NoFit
    """
    fit = adjust_disc(task, free, blur_px=blur_px)
    if is_in_curved_light(fit, task):
        return adjust_disc(task, free.with_curved_light(), fit.state)
    return fit


def is_in_curved_light(fit: DiscFit, task: DiscTask) -> bool:
    """Tell whether residuals show that the light over a disc is not linear.

    The second order is free only then: if it were always free, that would cost accuracy.
    """
    if len(task.inner) or (task.radius_px < _LEAST_CURVED_PX and not task.has_border):
        return False
    return not fit.sample.is_burnt and fit.curvature_gain > _CURVED


def adjust_disc(
    task: DiscTask, free: DiscUnknowns, start: DiscState | None = None, blur_px: float = 0.0
) -> DiscFit:
    """Adjust a disc from its outline and a first blur, or from an earlier state.

    Raises
    ------
    DiscRejection, NoFit
    """
    first_px = blur_px or min(_FIRST_BLUR_PX, _FIRST_BLUR * task.radius_px)
    blur = Blur(first_px**2, first_px**2, 0.0) if start is None else start.blur
    geometry = outline_geometry(task.outline) if start is None else start.geometry
    state = start
    for _ in range(_ROUNDS):
        window = cut_disc_window(task.grey, geometry, window_reach_px(blur))
        _check_inside(task.grey, geometry)
        index, is_enough = choose_pixels(
            window, geometry, blur, task.others, is_thinned=not len(task.inner)
        )
        if not is_enough:
            raise DiscRejection(DiscReason.CROWDED, "too little free ground")
        state = state or _start(task, window, index, geometry, blur, free)
        limits = find_censoring(window.levels, window.levels_per_count, window.width, task.smear)
        if limits.hides_a_level(window.levels):  # a clipped level shows no gradient
            free = free.without_ink_slope()
        fit = _adjust_on(task, window, limits, index, state, free)
        foreign = foreign_pixels(fit)
        if foreign is not None:
            fit = _adjust_on(task, window, limits, index[~foreign[index]], fit.state, free)
        state = fit.state
        moved_px = float(np.abs(state.geometry - geometry).max())
        widened = abs(state.blur.largest_sd_px / blur.largest_sd_px - 1.0)
        geometry, blur = state.geometry, state.blur
        if moved_px < _SETTLED_PX and widened < _SETTLED_BLUR:
            break
    return fit


def _adjust_on(
    task: DiscTask,
    window: DiscWindow,
    limits: Censoring,
    index: IndexArray,
    state: DiscState,
    free: DiscUnknowns,
) -> DiscFit:
    sample = DiscSample.of(
        window,
        index,
        state,
        limits,
        free,
        is_dark=task.is_dark,
        radius_px=task.radius_px,
        inner=task.inner,
    )
    return fit_disc(sample, state, free)


def _start(
    task: DiscTask,
    window: DiscWindow,
    index: IndexArray,
    geometry: Geometry,
    blur: Blur,
    free: DiscUnknowns,
) -> DiscState:
    """Return the start: the outline, and levels from inside the disc and the ground around it.

    The levels are medians of pixels that no other edge reaches, so that a ring's hole is left out.
    Of a ring that is adjusted as a whole, the inside is taken from the pixels with the most ink.

    Raises
    ------
    DiscRejection
        `NO_CONTRAST`.
    """
    places_px, levels, is_dark = window.places_px(index), window.levels[index], task.is_dark
    off_px = distances_px(places_px, geometry)
    order = np.argsort(off_px)
    inmost = order[: max(3, int(np.count_nonzero(off_px < -2.0 * blur.mean_sd_px) // 2))]
    if len(task.inner):
        ring = DiscPixels.of(places_px, geometry, blur, is_dark=True, inner=task.inner)
        order = np.argsort(ring.white_share(geometry, blur).value)
        inmost = order[: max(3, int(np.count_nonzero(off_px < 0.0) // 4))]
    around = (off_px > 1.5 * blur.mean_sd_px) & (off_px < 1.5 * blur.mean_sd_px + 3.0)
    if not around.any():
        raise DiscRejection(DiscReason.CROWDED, "too little free ground")
    inside, outside = float(np.median(levels[inmost])), float(np.median(levels[around]))
    dark, bright = (inside, outside) if is_dark else (outside, inside)
    if bright - dark < _LEAST_CONTRAST_COUNTS * window.levels_per_count:
        raise DiscRejection(DiscReason.NO_CONTRAST, f"levels {inside:.3f} and {outside:.3f}")
    shared = np.intersect1d(CAMERA_ROWS, free.rows)
    start = DiscState.of(geometry, blur, (0.0, 0.0))
    start.vector[shared] = free.mean[shared]
    tone = start.tone(free.tone)
    start.vector[[Row.BLACK, Row.WHITE]] = tone.light(np.array((dark, bright)))
    return start


def _check_inside(grey: GreyArray, geometry: Geometry) -> None:
    """Refuse a disc that is not wholly within the photograph."""
    x, y, xx, xy, yy = geometry.tolist()
    half_x, half_y = math.hypot(xx, xy) + 1.0, math.hypot(xy, yy) + 1.0
    height, width = grey.shape
    if x - half_x < 0 or y - half_y < 0 or x + half_x > width - 1 or y + half_y > height - 1:
        raise DiscRejection(DiscReason.CUT, "at the border of the photograph")


def foreign_pixels(fit: DiscFit) -> BoolArray | None:
    """Return which pixels of the window show neither disc nor ground; None: none does."""
    window, index = fit.sample.window, fit.sample.index
    black, white = fit.state.plateaus(fit.free.tone)
    limit = np.maximum(_FOREIGN_SIGMAS * fit.sd, _FOREIGN_CONTRAST * (white - black))
    clips = fit.sample.censoring
    model = np.clip(fit.levels, clips.low, clips.high)
    off = np.abs(fit.sample.levels - model) > limit
    # within a ring that is adjusted as a whole, such pixels are evidence against its circles
    if len(fit.sample.pixels.inner):
        off &= distances_px(fit.sample.pixels.places_px, fit.state.geometry) > 0.0
    if not off.any():
        return None
    mask = np.zeros(len(window.levels), np.uint8)
    mask[index[off]] = 1
    grown = cv2.dilate(mask.reshape(window.height, window.width), np.ones((3, 3), np.uint8))
    return np.asarray(grown.ravel() > 0)


def check_disc_fit(fit: DiscFit, outline: DiscOutline) -> None:
    """Refuse a fit that is poor, or not that of the outlined disc.

    Raises
    ------
    DiscRejection
        `POOR_FIT` or `NO_CONTRAST`.
    """
    seen = ~fit.sample.censoring.is_clipped
    if fit.redundancy < _LEAST_REDUNDANCY:
        detail = f"only {np.count_nonzero(seen)} unclipped pixels for {len(fit.free.rows)} unknowns"
        raise DiscRejection(DiscReason.POOR_FIT, detail)
    outlying = outlier_share(fit.misfit, fit.levels, fit.sample.censoring)
    black, white = fit.state.plateaus(fit.free.tone)
    residual = median_at_edges(fit.sd, fit.share, 0.2, 0.8, math.nan)
    if not white - black > _LEAST_CONTRAST_COUNTS * fit.sample.window.levels_per_count:
        raise DiscRejection(DiscReason.NO_CONTRAST, f"levels {black:.3f} and {white:.3f}")
    if not residual < _MAX_EDGE_NOISE * (white - black) or outlying > _MAX_OUTLIERS:
        share = residual / (white - black)
        raise DiscRejection(DiscReason.POOR_FIT, f"residuals {share:.0%} of the contrast")
    off = np.abs(fit.state.geometry - outline_geometry(outline))
    radius_px, off_px, grown_px = outline.ellipse.mean_radius, off[:2].max(), off[2:].max()
    is_near = off_px <= max(_MAX_OFF_PX, _MAX_OFF * radius_px)
    if not is_near or grown_px > max(_MAX_GROWN_PX, _MAX_GROWN * radius_px):
        raise DiscRejection(DiscReason.POOR_FIT, f"{max(off_px, grown_px):.1f} px from its outline")
