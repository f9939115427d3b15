"""What is not the target: surroundings of its plate, and what hides a part of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from kgcp.compiled import compiled
from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.pose import Pose
from kgcp.target.imaging import Imaging
from kgcp.target.light import Light, light_of_levels, plateau_levels
from kgcp.target.noise import BoolArray
from kgcp.target.pairs import Blur
from kgcp.target.plate import plate_points

_BLURRED_SHARE = 0.7  # of ink and of plate, that is too near to edges for the level
_ENOUGH_PIXELS = 4000  # for a median
_CLEAR_SIGMAS = 2.6  # from an edge on, where ink and plate show their own levels
_FOREIGN_CONTRAST = 0.15  # off the plate's level: not plate, or mixed with what is not …
_FOREIGN_SIGMAS = 1.7  # … and so much farther its blur is felt
_HIDDEN_CONTRAST = 0.25  # off the level of ink or plate
_NO_EDGE_SIGMAS, _NO_EDGE_CONTRAST = 1.2, 0.5  # so near an edge, this side still looks like that
_NO_EDGE_OUTSIDE_SIGMAS = 1.9  # beyond, the plate may end
_HIDDEN_SIGMAS = 4.0  # from there through the next edge
_SMALLEST_SIGMAS = 12.0  # a ring that is smaller hardly shows the level of ink anywhere
_MAX_HIDDEN = 0.5  # of all that is looked at; more is no plate, or in another light
_DOT_AREAS, _DOTS = 1.5, 1.6  # larger than a dot with what blur adds to it, or longer
_SAME_PLACE = 1e-6  # of a radius
_SMALL_SIGMAS = 3.0  # discs of smaller radii do not show their own level


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlate:
    """A window under an approximate pose, blur and light.

    Attributes
    ----------
    imaging : Imaging
    points_m : (2, n) array
        Where the pixels' rays meet the plate.
    metres_per_px : float
        Largest length on the plate that a pixel spans.
    blur : Blur
    light : Light
    rho_m : (n,) array
        Distance of the points from the target's centre.
    """

    imaging: Imaging
    points_m: FloatArray
    metres_per_px: float
    blur: Blur
    light: Light
    rho_m: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        return self.imaging.window.height, self.imaging.window.width

    def levels(self) -> tuple[float, float]:
        """Return the grey values of ink and plate."""
        return plateau_levels(self.light, self.imaging.response)

    def dilated(self, pixels: BoolArray, kernel: GreyArray) -> BoolArray:
        """Return pixels (n,) with all that a kernel around them covers."""
        reached = cv2.dilate(pixels.reshape(self.shape).view(np.uint8), kernel)
        return np.asarray(reached.ravel().view(np.bool_))


def see_plate(
    imaging: Imaging, points_m: FloatArray, metres_per_px: float, blur: Blur, light: Light
) -> SeenPlate:
    """Prepare a window for what is asked of it."""
    x, y = points_m
    return SeenPlate(imaging, points_m, metres_per_px, blur, light, np.sqrt(x * x + y * y))


def first_levels(imaging: Imaging, pose: Pose) -> Light:
    """Return black and white as medians of what an approximate pose takes for ink and plate.

    Raises
    ------
    Rejection
        `NO_CONTRAST` if ink is not darker than the plate.
    """
    window, circles = imaging.window, imaging.circles
    some = slice(None, None, _uneven(window.rays.shape[1] // _ENOUGH_PIXELS, window.width))
    levels = window.levels[some]
    x, y = points_m = plate_points(pose, window.rays[:, some])
    share, off_edge_m = np.ones(len(x)), np.empty(len(x))
    _fill_plateaus(
        points_m, circles.centres_m, circles.radii_m, circles.signs, 0.0, np.inf, share, off_edge_m
    )
    inside = x * x + y * y < imaging.outer_radius_m**2
    black, white = (
        _median_of_clearest(levels[chosen], off_edge_m[chosen])
        for chosen in (inside & (share < 0.5), inside & (share > 0.5))
    )
    if not white - black >= 4.0 * window.levels_per_count:
        raise Rejection(Reason.NO_CONTRAST, f"ink {black:.3f}, plate {white:.3f}")
    return light_of_levels(black, white, imaging.response)


def _uneven(step: int, width: int) -> int:
    """Return a step of about this size that does not stay in the same columns of a window."""
    step = max(1, step)
    while step > 1 and math.gcd(step, width) > 1:
        step -= 1
    return step


def _median_of_clearest(levels: FloatArray, off_edge_m: FloatArray) -> float:
    """Return the median of the levels that are farthest from edges; NaN without any."""
    if not len(levels):
        return math.nan
    first = int(_BLURRED_SHARE * len(levels))
    return float(np.median(levels[off_edge_m >= np.partition(off_edge_m, first)[first]]))


def reached_by_surroundings(seen: SeenPlate) -> BoolArray:
    """Tell which pixels (n,) of the window blur may mix with something that is not plate."""
    imaging, blur = seen.imaging, seen.blur
    black, white = seen.levels()
    contrast, white = white - black, min(white, 1.0)
    clear = 1.0 + _CLEAR_SIGMAS * blur.largest_sd_px / imaging.outer_radius_px
    foreign = np.abs(imaging.window.smooth - white) > _FOREIGN_CONTRAST * contrast
    foreign &= seen.rho_m > clear * imaging.outer_radius_m
    reach = _FOREIGN_SIGMAS * blur.largest_sd_px
    half = int(np.ceil(reach))
    columns, rows = np.meshgrid(*2 * [np.arange(-half, half + 1)])
    xx, yy, xy = blur.total_covariance
    determinant = xx * yy - xy * xy
    distance2 = (yy * columns**2 - 2.0 * xy * columns * rows + xx * rows**2) / determinant
    kernel = (distance2 <= _FOREIGN_SIGMAS**2).astype(np.uint8)
    reached = seen.dilated(foreign, kernel)
    inmost_m = (1.0 - 2.0 * reach / imaging.outer_radius_px) * imaging.outer_radius_m
    return np.asarray(reached & (seen.rho_m > inmost_m))


def hidden_pixels(seen: SeenPlate, slack_px: float) -> BoolArray:
    """Tell which pixels (n,) of the window show something else than ink and plate.

    By levels that are neither where it is flat, and by edges that are not there: grey values
    just beside one that are like those beyond it. The pose may be off by `slack_px`.
    """
    imaging, sd_px = seen.imaging, seen.blur.largest_sd_px
    count = seen.points_m.shape[1]
    if imaging.outer_radius_px < _SMALLEST_SIGMAS * sd_px:
        return np.zeros(count, dtype=bool)
    share, off_edge_m = np.ones(count), np.empty(count)
    circles, per_px = imaging.circles, 1.0 / seen.metres_per_px
    clear_m = (_CLEAR_SIGMAS * sd_px + slack_px) * seen.metres_per_px
    _fill_plateaus(
        *(seen.points_m, circles.centres_m, circles.radii_m, circles.signs),
        *(_SMALL_SIGMAS * sd_px * seen.metres_per_px, clear_m, share, off_edge_m),
    )
    black, white = seen.levels()
    other = np.empty(count, dtype=np.bool_)
    off_edge_px = off_edge_m * per_px - slack_px
    beyond_px = (seen.rho_m - imaging.outer_radius_m) * per_px - slack_px
    contrast = min(white, 1.0) - black
    tested = _mark_other(
        imaging.window.smooth, share, black, contrast, off_edge_px, beyond_px, sd_px, other
    )
    if other.any():
        other = _without_dots(seen, other)
    found = int(np.count_nonzero(other))
    if not found or found > _MAX_HIDDEN * tested:
        return np.zeros(count, dtype=bool)
    half = math.ceil(_HIDDEN_SIGMAS * sd_px + slack_px)
    size = (2 * half + 1, 2 * half + 1)
    return seen.dilated(other, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size).astype(np.uint8))


def _without_dots(seen: SeenPlate, other: BoolArray) -> BoolArray:
    """Leave out what may be a dot too many or too few: it lies in the ring, and is no larger.

    That speaks of another code, and must not be overlooked.
    """
    radii_m = seen.imaging.circles.radii_m
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(other.reshape(seen.shape).view(np.uint8))
    beside = (seen.rho_m > radii_m[0]) | (seen.rho_m < radii_m[1])
    dot_px = 2.0 * radii_m[2] / seen.metres_per_px
    hides = np.bincount(labels.ravel(), weights=beside) > 0
    hides |= boxes[:, cv2.CC_STAT_AREA] > _DOT_AREAS * 0.25 * math.pi * dot_px**2
    hides |= boxes[:, cv2.CC_STAT_WIDTH : cv2.CC_STAT_HEIGHT + 1].max(axis=1) > _DOTS * dot_px + 1.0
    hides[0] = False
    return np.asarray(hides[labels.ravel()])


@compiled
def _mark_other(
    smooth: FloatArray,
    share: FloatArray,
    black: float,
    contrast: float,
    off_edge_px: FloatArray,
    beyond_px: FloatArray,
    sd_px: float,
    other: BoolArray,
) -> int:
    """Mark the pixels that are not what they should be; return how many are looked at."""
    tested = 0
    for i in range(len(smooth)):
        is_clear = off_edge_px[i] > _CLEAR_SIGMAS * sd_px and beyond_px[i] < 0.0
        is_near = off_edge_px[i] > _NO_EDGE_SIGMAS * sd_px
        is_near &= beyond_px[i] < _NO_EDGE_OUTSIDE_SIGMAS * sd_px
        tested += is_clear or is_near
        off_level = abs(smooth[i] - (black + contrast * share[i]))
        other[i] = (is_clear and off_level > _HIDDEN_CONTRAST * contrast) or (
            is_near and off_level > _NO_EDGE_CONTRAST * contrast
        )
    return tested


@compiled
def _fill_plateaus(
    points_m: FloatArray,
    centres_m: FloatArray,
    radii_m: FloatArray,
    signs: FloatArray,
    small_m: float,
    reach_m: float,
    share: FloatArray,
    off_edge_m: FloatArray,
) -> None:
    """Fill in the white share without blur, and the distance to the nearest edge or small disc.

    Edges farther than the reach may count as infinitely far.
    """
    count = len(radii_m)
    # from a circle that is out of reach on to the next that may be in reach: dots of one ring are
    # all as far from the target's centre
    out_m, beyond = np.sqrt(centres_m[0] ** 2 + centres_m[1] ** 2), np.empty(count, np.intp)
    for c in range(count - 1, -1, -1):
        beyond[c] = c + 1
        is_like_next = c + 1 < count and radii_m[c] == radii_m[c + 1]
        if is_like_next and abs(out_m[c] - out_m[c + 1]) < _SAME_PLACE * radii_m[c]:
            beyond[c] = beyond[c + 1]
    for i in range(points_m.shape[1]):
        x, y = points_m[0, i], points_m[1, i]
        rho, nearest, c = math.sqrt(x * x + y * y), np.inf, 0
        while c < count:
            radius = radii_m[c]
            if abs(rho - out_m[c]) > radius + min(reach_m, nearest):
                c = beyond[c]
                continue
            dx, dy = x - centres_m[0, c], y - centres_m[1, c]
            square = dx * dx + dy * dy
            is_inside = square < radius * radius
            if is_inside:
                share[i] += signs[c]
            if is_inside and radius < small_m:
                nearest = 0.0
            limit = radius - nearest if is_inside else radius + nearest
            is_farther = square < limit * limit if is_inside else square > limit * limit
            if not is_farther or limit < 0.0:  # roots are what costs here
                nearest = min(nearest, abs(radius - math.sqrt(square)))
            c += 1
        off_edge_m[i] = nearest
