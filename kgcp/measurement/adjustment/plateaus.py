"""Plateaus, ink and plate clear of all edges: how even the light is, and whether white is burnt."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.image_model.light_field import LightField
from kgcp.measurement.image_model.photometry import Light, decoded
from kgcp.measurement.image_model.shadow_search import FoundShadows, PlateauPixels, find_shadows
from kgcp.measurement.image_model.unblurred import UnblurredPlate, unblurred_plate

# Tuning, by the flights `light` of `benchmarks.accuracy.evaluate`. Where nothing else is said,
# lengths are in radii of the ring, and light is in contrasts.
_CLEAR_SIGMAS, _CLEAR_PX, _MOST_CLEAR = 2.0, 1.0, 0.1  # distance from an edge; at most in radii
_BORDER = 0.18  # width of the plate beyond the ring
_SMOOTHED = 0.16  # σ that levels are smoothed with
_BINS_PER_SIGMA = 4.0  # of a wide smoothing
# Where no plateau is near, one farther off counts: by a wider smoothing, with a small weight
_WIDE, _WIDE_SHARE = 3.0, 0.02
_UNEVEN = 0.12  # if smoothed levels vary by more, one pair of levels would mislead
# Plate around that is so much brighter than its median is under glare; plate is at least so far
# above the ink's level, and ink so far below the plate's around it.
_GLARE, _DARKEST_PLATE, _DARKER_INK = 0.06, 0.35, 0.5
_GLARE_REACH, _LEAST_WEIGHT = 1.5, 1e-3  # in smoothings; weight of plate that is near enough
_LEAST_CONTRAST = 0.1
_FEWEST_PIXELS = 24  # of ink and of plate
_MOST_PIXELS = 4000  # in which edges of shadows are looked for
# White between these shares of the range may be burnt below its end. What is brighter than this
# share of the contrast is then taken for the edge of burnt white. With 0.7 or 0.85 instead of 0.8,
# errors of three sets of phones' burnt plates (R 37 to 140 px) are 0.8 to 2.2 times as large.
_BURNT_WHITE, _EDGE_OF_BURNT = (0.8, 0.985), 0.8
_LIT = 0.1  # plate that is so near the brightest plate is in full light
# Largest noise of burnt white, in grey values and as a share of the noise of ink. The second pair
# is for ink that compression has smoothed. Of 288 simulated plates by phones that are not burnt (R
# 37 to 290 px; PNG, JPEG quality 95 and 92), none is taken for burnt. Of 48 burnt ones with R ≥ 150
# px, 47 are. Of 16 smaller burnt ones with quality 92 only 6 are, as what compression leaves beside
# edges looks like noise: `extensions` compares fits there. With qualities of 75 to 88, a few that
# are not burnt are taken for it, from R 78 px on; that costs precision alone.
_NOISE_OF_BURNT = ((0.27, 0.4), (0.145, 0.7))
_CENTRAL, _CENTRAL_SD = 0.7, 0.557  # share of the smallest values, and their RMS if normal
# Second difference along both axes, scaled to the noise of a pixel: it is 0 for light that changes
# steadily.
_SECOND_DIFFERENCE = np.outer((1.0, -2.0, 1.0), (1.0, -2.0, 1.0)) / 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Plateaus:
    """Levels of ink and plate all over a window, from the pixels that show them."""

    levels: FloatArray  # (2, n): of ink and of plate, at every pixel
    typical: tuple[float, float]  # medians
    extremes: tuple[float, float]  # the darkest ink and the brightest plate, smoothed
    variation: float  # of the levels, as a share of the contrast
    flat: tuple[IndexArray, IndexArray]  # pixels of ink and plate clear of edges

    @property
    def is_uneven(self) -> bool:
        """Whether the levels vary so much that one pair of them would mislead."""
        return self.variation > _UNEVEN


def look_at_plateaus(problem: FitProblem, pose: Pose, sd_px: float) -> Plateaus | None:
    """Find the plateaus, smoothed over the window; None if too little of them is seen."""
    window = problem.window
    unblurred = unblurred_plate(problem.circles, problem.measured_count, pose, window.rays)
    clear = _clear_of_edges(problem, unblurred, sd_px)
    ink, plate = (np.flatnonzero(kind) for kind in _kinds(problem, unblurred, clear))
    if min(len(ink), len(plate)) < _FEWEST_PIXELS:
        return None
    levels = np.array([_smoothed_over(problem, flat) for flat in (ink, plate)])
    black, white = (float(np.median(window.smooth[flat])) for flat in (ink, plate))
    if white <= black:
        return None
    darkest, dark = np.quantile(levels[0, ink], (0.05, 0.95)).tolist()
    bright, brightest = np.quantile(levels[1, plate], (0.05, 0.95)).tolist()
    return Plateaus(
        levels=levels,
        typical=(black, white),
        extremes=(darkest, brightest),
        variation=max(dark - darkest, brightest - bright) / (white - black),
        flat=(ink, plate),
    )


def as_if_burnt(problem: FitProblem, plateaus: Plateaus) -> FitProblem | None:
    """Return the problem with white taken for clipped, if it may be burnt below the range's end.

    Cameras that map tones locally, or to another exposure, do so after the sensor has clipped. The
    plate is brighter than it seems then, and the curve that displaces its edges has a corner that
    three shapes cannot follow.
    """
    ink, plate = plateaus.typical[0], plateaus.extremes[1]
    least, most = _BURNT_WHITE
    is_shown = problem.window.binning == 1 and not problem.is_ring_small
    if not is_shown or not least < plate < most * problem.censoring.high:
        return None
    return problem.with_burnt_white(plate, ink + _EDGE_OF_BURNT * (plate - ink))


def is_white_without_noise(problem: FitProblem, plateaus: Plateaus) -> bool:
    """Tell whether white has less noise than rounding alone makes, as only burnt white has."""
    ink, plate = plateaus.typical[0], plateaus.extremes[1]
    dark, bright = plateaus.flat
    bright = bright[problem.window.smooth[bright] > plate - _LIT * (plate - ink)]
    if len(bright) < _FEWEST_PIXELS:
        return False
    of_ink, of_plate = _noise_in_counts(problem, dark), _noise_in_counts(problem, bright)
    return any(of_plate < sd and of_plate < share * of_ink for sd, share in _NOISE_OF_BURNT)


def _noise_in_counts(problem: FitProblem, flat: IndexArray) -> float:
    """Return the standard deviation of the noise at some pixels, robust against edges nearby."""
    window = problem.window
    image = (window.levels / window.levels_per_count).reshape(window.height, window.width)
    rough = cv2.filter2D(image, -1, _SECOND_DIFFERENCE, borderType=cv2.BORDER_REPLICATE).ravel()[
        flat
    ]
    count = max(1, int(_CENTRAL * len(rough)))
    central = np.partition(rough * rough, count - 1)[:count]
    return math.sqrt(float(central.mean())) / _CENTRAL_SD


def _clear_of_edges(problem: FitProblem, unblurred: UnblurredPlate, sd_px: float) -> BoolArray:
    px_per_m = problem.outer_radius_px / problem.outer_radius_m
    clear_px = min(_CLEAR_SIGMAS * sd_px + _CLEAR_PX, _MOST_CLEAR * problem.outer_radius_px)
    within = unblurred.rho_m < (1.0 + _BORDER) * problem.outer_radius_m
    if problem.visible is not None:
        turns = np.arctan2(unblurred.points_m[1], unblurred.points_m[0]) / (2.0 * math.pi)
        count = len(problem.visible)
        within &= problem.visible[np.rint(turns * count).astype(np.intp) % count]
    return np.asarray(within & (unblurred.edge_distance_m >= clear_px / px_per_m))


def _kinds(
    problem: FitProblem, unblurred: UnblurredPlate, clear: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Tell which clear pixels (n,) show ink, and which plate.

    Ink as bright as plate, or plate as dark as ink, is evidence of another code, and must not pass
    for uneven light. Glare makes ink brighter, but the plate around it, too.
    """
    values = problem.window.smooth
    is_ink, is_plate = clear & (unblurred.share < 0.5), clear & (unblurred.share > 0.5)
    if is_ink.any() and is_plate.any():
        ink, plate = (float(np.median(values[kind])) for kind in (is_ink, is_plate))
        contrast = plate - ink
        around = _plate_around(problem, is_plate)
        limit = np.where(around > plate + _GLARE * contrast, around, plate)
        is_ink &= values < limit - _DARKER_INK * contrast
        is_plate &= values > ink + _DARKEST_PLATE * contrast
    return is_ink, is_plate


def _plate_around(problem: FitProblem, is_plate: BoolArray) -> FloatArray:
    """Return the level of the plate near every pixel; 0 where there is none near."""
    sigma_px = _GLARE_REACH * _smoothing_px(problem)
    weight = is_plate.astype(np.float64)
    near, total = (
        _blurred(problem, values, sigma_px) for values in (weight, weight * problem.window.smooth)
    )
    return np.where(near > _LEAST_WEIGHT, total / np.maximum(near, _LEAST_WEIGHT), 0.0)


def _smoothed_over(problem: FitProblem, flat: IndexArray) -> FloatArray:
    """Smooth the window over some of its pixels (n,)."""
    weight = np.zeros(len(problem.window.smooth))
    weight[flat] = 1.0
    light = weight * problem.window.smooth
    sigma_px = _smoothing_px(problem)
    near, total = (_blurred(problem, values, sigma_px) for values in (weight, light))
    wide, broad = (_blurred(problem, values, _WIDE * sigma_px) for values in (weight, light))
    return np.asarray((total + _WIDE_SHARE * broad) / (near + _WIDE_SHARE * wide + 1e-9))


def _smoothing_px(problem: FitProblem) -> float:
    return max(2.0, _SMOOTHED * problem.outer_radius_px)


def _blurred(problem: FitProblem, values: FloatArray, sigma_px: float) -> FloatArray:
    """Blur a window's values; if σ is large, in bins of a quarter of it."""
    image = values.reshape(problem.window.height, problem.window.width)
    count = max(1, int(sigma_px / _BINS_PER_SIGMA))  # pixels along a bin's side
    if count == 1:
        blurred = cv2.GaussianBlur(image, (0, 0), sigma_px)
    else:
        size = [math.ceil(length / count) for length in image.shape[::-1]]
        bins = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        # averaging over bins (1/12), and interpolating between them (1/6), blur, too
        sigma = math.sqrt((sigma_px / count) ** 2 - 1.0 / 12.0 - 1.0 / 6.0)
        bins = cv2.GaussianBlur(bins, (0, 0), sigma)
        blurred = cv2.resize(bins, image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(blurred, dtype=np.float64).ravel()


def evened_window(problem: FitProblem, plateaus: Plateaus) -> FitProblem:
    """Return the problem with the window as it would be in even light, by the levels seen."""
    window = problem.window
    (black, white), (ink, plate) = plateaus.typical, plateaus.levels
    contrast = np.maximum(plate - ink, _LEAST_CONTRAST * (white - black))
    factor = (white - black) / contrast
    levels = black + (window.levels - ink) * factor
    smooth = black + (window.smooth - ink) * factor
    return replace(problem, window=replace(window, levels=levels, smooth=smooth))


def field_of(
    field: LightField, problem: FitProblem, plateaus: Plateaus, light: Light
) -> LightField:
    """Return the field with the levels seen as the values of its finest knots."""
    window, finest = problem.window, len(field.knots.spacings_px) - 1
    x, y = np.rint(field.knots.places_px(finest)).astype(np.intp)
    columns = np.clip(x - window.x0, 0, window.width - 1)
    at = np.clip(y - window.y0, 0, window.height - 1) * window.width + columns
    values = np.zeros_like(field.values)
    seen = decoded(plateaus.levels[:, at], problem.tone)
    levels = seen - np.array([[light.black], [light.white]])
    added = levels / (light.white - light.black)
    offsets = added.mean(axis=1)
    values[:, -len(at) :] = added - offsets[:, None]
    return replace(field, values=values, offsets=offsets)


def shadows_across(problem: FitProblem, plateaus: Plateaus) -> list[FoundShadows]:
    """Return straight edges of shadows that explain how the levels vary, the fewest first."""
    step = max(1, sum(map(len, plateaus.flat)) // _MOST_PIXELS)
    chosen = [flat[::step] for flat in plateaus.flat]
    index = np.concatenate(chosen)
    flat = PlateauPixels(
        offsets=problem.window.pixels(index) - problem.centre_px[:, None],
        kind=np.repeat((0, 1), [len(each) for each in chosen]),
        levels=problem.window.smooth[index],
        high=problem.censoring.high,
    )
    return find_shadows(flat, problem.tone)
