"""Masks of pixels that do not show the target: surroundings of its plate, and what hides a part.

Both are found before the adjustment, with an approximate pose, blur and light: they are where grey
values cannot be those of the plate. All pixels that blur may have mixed with them are left out,
too. The rules are local and rather leave out too much: that costs a little accuracy, while leaving
out too little biases the distance. docs/method/adjustment.md, "Masks", derives them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.image_model.blur import REACH_SIGMAS, Blur
from kgcp.measurement.image_model.photometry import Light, light_of_levels, plateau_levels
from kgcp.measurement.image_model.plate import blur_on_plate, largest_metres_per_px
from kgcp.measurement.image_model.unblurred import UnblurredPlate, unblurred_plate

# Tuning of the masks, in units of the blur's σ and of the contrast. What hides a part is measured
# by the sets `hidden` and `cut` of `benchmarks.search.hard_frames`. The bias that dirt, shadows and
# surroundings leave is measured by tests/measurement/test_obstacles.py and
# adjustment/test_pixels.py, and what is lost by `benchmarks.accuracy.presets` (`far`, `consumer`).
_BLURRED_SHARE = 0.7  # share of the ink's and of the plate's pixels that is too near to edges
_ENOUGH_PIXELS = 2000  # for a median
_CLEAR_SIGMAS = 2.6  # from an edge on, ink and plate show their own levels: Φ(−2.6) is 0.5 %
_FOREIGN_CONTRAST = 0.15  # a pixel so far off the plate's level is not plate, or not alone
_FOREIGN_SIGMAS = 2.0  # reach of the blur around such a pixel
_BESIDE_RING_SIGMAS = 0.85  # from there on, grey values hardly depend on the camera's tone
_HIDDEN_CONTRAST = 0.25  # a clear pixel so far off the level of ink or plate is hidden
# From this distance on, a pixel beside an edge that is off by so much shows that the edge is
# missing
_NO_EDGE_SIGMAS, _NO_EDGE_CONTRAST = 1.2, 0.5
_NO_EDGE_OUTSIDE_SIGMAS = 1.9  # farther outside the ring, the plate may end
_HIDDEN_SIGMAS = 4.0  # left out around a hidden pixel: through the next edge
_SMALLEST_SIGMAS = 12.0  # least radius of a ring that is tested: smaller ones hardly show ink
_MAX_HIDDEN = 0.5  # of the tested pixels; if there are more, pose or light are wrong
_DOT_AREAS, _DOT_LENGTHS = 1.5, 1.6  # a hidden patch that is larger, or longer, is no dot
_SCALE_PIXELS = 100  # enough to find the largest scale on the plate
_SMALL_SIGMAS = 3.0  # discs of smaller radii do not show their own level


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlate:
    """A window under an approximate pose, blur and light."""

    problem: FitProblem
    metres_per_px: float  # largest length on the plate that any pixel spans
    blur: Blur
    spread: FloatArray  # (3,): by `blur_on_plate`
    # the plate under every pixel, with small discs and edges in reach as chosen by `see_plate`
    unblurred: UnblurredPlate

    def dilated(self, pixels: BoolArray, kernel: GreyArray) -> BoolArray:
        """Return pixels (n,) grown by a kernel."""
        shape = self.problem.window.height, self.problem.window.width
        reached = cv2.dilate(pixels.reshape(shape).view(np.uint8), kernel)
        return np.asarray(reached.ravel().view(np.bool_))


def see_plate(problem: FitProblem, pose: Pose, blur: Blur, slack_px: float = 0.0) -> SeenPlate:
    """Prepare a window for masks and pixel selection; the pose may be off by `slack_px`."""
    rays, sd_px = problem.window.rays, blur.largest_sd_px
    step = max(1, rays.shape[1] // _SCALE_PIXELS)
    scale = largest_metres_per_px(pose, np.ascontiguousarray(rays[:, ::step]))
    reach_px = max(REACH_SIGMAS * sd_px, _CLEAR_SIGMAS * sd_px + slack_px)
    middle = problem.window.nearest(problem.centre_px)
    spread = blur_on_plate(pose, rays[:, middle].copy(), blur.total_covariance, sd_px * scale)
    unblurred = unblurred_plate(
        problem.circles,
        problem.measured_count,
        pose,
        rays,
        small_radius_m=_SMALL_SIGMAS * sd_px * scale,
        reach_m=reach_px * scale,
        spread=spread,
    )
    return SeenPlate(problem, scale, blur, spread, unblurred)


def first_levels(problem: FitProblem, pose: Pose) -> Light:
    """Return black and white as medians of the ink and the plate under an approximate pose.

    Raises
    ------
    Rejection
        `NO_CONTRAST` if ink is not darker than the plate.
    """
    window = problem.window
    step = _step_across_columns(window.rays.shape[1] // _ENOUGH_PIXELS, window.width)
    some = slice(None, None, step)
    levels = np.ascontiguousarray(window.levels[some])
    outer_m, inner_m = problem.circles.radii_m[:2]  # dots are within the ring
    rays = np.ascontiguousarray(window.rays[:, some])
    circles, count = problem.circles, problem.measured_count
    unblurred = unblurred_plate(circles, count, pose, rays, reach_m=outer_m - inner_m)
    black, white = _median_levels(
        levels, unblurred.rho_m, unblurred.share, unblurred.edge_distance_m, outer_m
    )
    if not white - black >= 4.0 * window.levels_per_count:
        raise Rejection(Reason.NO_CONTRAST, f"ink {black:.3f}, plate {white:.3f}")
    return light_of_levels(black, white, problem.tone)


def _step_across_columns(step: int, width: int) -> int:
    """Return a step of about this size that visits all columns of a window in turn."""
    step = max(1, step)
    while step > 1 and math.gcd(step, width) > 1:
        step -= 1
    return step


@compiled
def _median_levels(
    levels: FloatArray,
    rho_m: FloatArray,
    share: FloatArray,
    edge_distance_m: FloatArray,
    radius_m: float,
) -> tuple[float, float]:
    """Return the levels of ink and plate within a radius, as medians of pixels clear of edges."""
    seen, off, count = np.empty((2, len(levels))), np.empty((2, len(levels))), np.zeros(2, np.intp)
    for i in range(len(levels)):
        if rho_m[i] < radius_m:
            kind = 0 if share[i] < 0.5 else 1
            seen[kind, count[kind]], off[kind, count[kind]] = levels[i], edge_distance_m[i]
            count[kind] += 1
    ink = _median_of_clearest(seen[0, : count[0]], off[0, : count[0]])
    return ink, _median_of_clearest(seen[1, : count[1]], off[1, : count[1]])


@compiled
def _median_of_clearest(levels: FloatArray, edge_distance_m: FloatArray) -> float:
    """Return the median of the levels that are farthest from edges; NaN without any."""
    if len(levels) == 0:
        return np.nan
    first = int(_BLURRED_SHARE * len(levels))
    return float(np.median(levels[edge_distance_m >= np.partition(edge_distance_m, first)[first]]))


def background_mask(seen: SeenPlate, light: Light, slack_px: float = 0.0) -> BoolArray:
    """Tell which pixels (n,) of the window may be mixed by blur with what is not plate.

    The pose may be off by `slack_px`.
    """
    problem, blur, unblurred, scale = seen.problem, seen.blur, seen.unblurred, seen.metres_per_px
    black, white = plateau_levels(light, problem.tone)
    foreign = np.empty(len(unblurred.rho_m), dtype=np.bool_)
    if not _mark_foreign(
        problem.window.smooth,
        unblurred.points_m,
        unblurred.rho_m,
        seen.spread,
        (black, white, problem.brightest),
        problem.outer_radius_m,
        blur.largest_sd_px * scale,
        slack_px * scale,
        foreign,
    ):
        return foreign
    reach_px = _FOREIGN_SIGMAS * blur.largest_sd_px
    half = math.ceil(reach_px)
    kernel = np.empty((2 * half + 1, 2 * half + 1), dtype=np.uint8)
    _fill_ellipse(*blur.total_covariance, _FOREIGN_SIGMAS, kernel)
    inmost_m = (1.0 - 2.0 * reach_px / problem.outer_radius_px) * problem.outer_radius_m
    return np.asarray(seen.dilated(foreign, kernel) & (unblurred.rho_m > inmost_m))


@compiled
def _mark_foreign(
    smooth: FloatArray,
    points_m: FloatArray,
    rho_m: FloatArray,
    spread: FloatArray,
    levels: tuple[float, float, float],
    radius_m: float,
    sd_m: float,
    slack_m: float,
    foreign: BoolArray,
) -> int:
    """Mark what is not plate outside a ring; return how many pixels that are.

    Farther than 2.6 σ from the ring, a pixel is marked if its level is not the plate's. Nearer, the
    plate may end within the blur of the ring: there a pixel is marked if it is darker than the
    profile of the ring's own edge, Φ(distance / σ), with the σ of the blur in its direction.

    `levels` are those of ink and plate, and the one that burnt white is seen with.
    """
    black, white, brightest = levels
    count, level = 0, min(white, brightest)
    for i in range(len(smooth)):
        beyond_m, foreign[i] = rho_m[i] - radius_m, False
        if beyond_m > _CLEAR_SIGMAS * sd_m:
            foreign[i] = abs(smooth[i] - level) > _FOREIGN_CONTRAST * (white - black)
        elif beyond_m > slack_m:
            x, y = points_m[0, i], points_m[1, i]
            variance = spread[0] * x * x + 2.0 * spread[1] * x * y + spread[2] * y * y
            sigmas = (beyond_m - slack_m) * rho_m[i] / (sd_m * math.sqrt(variance))
            if sigmas > _BESIDE_RING_SIGMAS:
                share = 1.0 - 0.5 * math.erfc(sigmas * math.sqrt(0.5)) - _FOREIGN_CONTRAST
                foreign[i] = smooth[i] < min(black + (white - black) * share, brightest)
        count += foreign[i]
    return count


@compiled
def _fill_ellipse(xx: float, yy: float, xy: float, sigmas: float, kernel: GreyArray) -> None:
    """Fill in 1 within this many σ of a blur around the middle, 0 elsewhere."""
    half, limit = kernel.shape[0] // 2, sigmas * sigmas * (xx * yy - xy * xy)
    for row in range(-half, half + 1):
        for column in range(-half, half + 1):
            distance2 = yy * column * column - 2.0 * xy * column * row + xx * row * row
            kernel[row + half, column + half] = 1 if distance2 <= limit else 0


def occluded_mask(seen: SeenPlate, light: Light, slack_px: float) -> BoolArray:
    """Tell which pixels (n,) of the window show something other than ink and plate.

    Clear of edges, such a pixel has neither the level of ink nor that of plate. Beside an edge, it
    has the level of the other side: the edge is missing. The pose may be off by `slack_px`.

    If more than half of all tested pixels show something else, the light or the pose is wrong
    rather than the target hidden, and nothing is left out.
    """
    problem, sd_px, unblurred = seen.problem, seen.blur.largest_sd_px, seen.unblurred
    hidden = np.zeros(len(unblurred.rho_m), dtype=np.bool_)
    if problem.outer_radius_px < _SMALLEST_SIGMAS * sd_px:
        return hidden
    black, white = plateau_levels(light, problem.tone)
    contrast, scale = min(white, problem.brightest) - black, seen.metres_per_px
    hidden_count, tested_count = _mark_hidden(
        problem.window.smooth,
        unblurred.share,
        unblurred.edge_distance_m,
        unblurred.rho_m,
        black,
        contrast,
        problem.outer_radius_m,
        slack_px * scale,
        sd_px * scale,
        hidden,
    )
    if hidden_count:
        hidden = _without_dots(seen, hidden)
        hidden_count = int(np.count_nonzero(hidden))
    if not hidden_count or hidden_count > _MAX_HIDDEN * tested_count:
        return np.zeros_like(hidden)
    half = math.ceil(_HIDDEN_SIGMAS * sd_px + slack_px)
    size = (2 * half + 1, 2 * half + 1)
    return seen.dilated(hidden, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size).astype(np.uint8))


def _without_dots(seen: SeenPlate, hidden: BoolArray) -> BoolArray:
    """Unmark patches within the ring that are no larger than a dot.

    Such a patch may be an extra or a missing dot, which is evidence of another code. If it were
    masked, it would not count against the target.
    """
    radii_m, rho_m, window = seen.problem.circles.radii_m, seen.unblurred.rho_m, seen.problem.window
    mask = hidden.reshape(window.height, window.width).view(np.uint8)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(mask)
    off_ring = (rho_m > radii_m[0]) | (rho_m < radii_m[1])
    dot_px = 2.0 * radii_m[2] / seen.metres_per_px
    label_of_pixel = labels.ravel().astype(np.intp)
    hides = np.bincount(label_of_pixel, weights=off_ring) > 0
    hides |= boxes[:, cv2.CC_STAT_AREA] > _DOT_AREAS * 0.25 * math.pi * dot_px**2
    hides |= (
        boxes[:, cv2.CC_STAT_WIDTH : cv2.CC_STAT_HEIGHT + 1].max(axis=1)
        > _DOT_LENGTHS * dot_px + 1.0
    )
    hides[0] = False
    return np.asarray(hides[label_of_pixel])


@compiled
def _mark_hidden(
    smooth: FloatArray,
    share: FloatArray,
    edge_distance_m: FloatArray,
    rho_m: FloatArray,
    black: float,
    contrast: float,
    outer_radius_m: float,
    slack_m: float,
    sd_m: float,
    hidden: BoolArray,
) -> tuple[int, int]:
    """Mark pixels that are not what they should be; return how many, and how many were tested.

    From 2.6 σ beside any edge on, a pixel is clear, and its level is known to a quarter of the
    contrast. From 1.2 σ on, blur moves it by at most 12 % of the contrast towards the level of the
    other side. If it is off by half of the contrast, the edge is missing. `share` is the white
    share without blur.
    """
    hidden_count = tested_count = 0
    for i in range(len(smooth)):
        off_m, beyond_m = edge_distance_m[i] - slack_m, rho_m[i] - outer_radius_m - slack_m
        is_clear = off_m > _CLEAR_SIGMAS * sd_m and beyond_m < 0.0
        is_near = off_m > _NO_EDGE_SIGMAS * sd_m and beyond_m < _NO_EDGE_OUTSIDE_SIGMAS * sd_m
        tested_count += is_clear or is_near
        off_level = abs(smooth[i] - (black + contrast * share[i]))
        hidden[i] = (is_clear and off_level > _HIDDEN_CONTRAST * contrast) or (
            is_near and off_level > _NO_EDGE_CONTRAST * contrast
        )
        hidden_count += hidden[i]
    return hidden_count, tested_count
