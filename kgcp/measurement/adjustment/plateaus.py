"""How even the light is, from what is flat on the plate: ink and white clear of all edges."""

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
from kgcp.measurement.image_model.seen_shadows import FlatPixels, SeenShadows, find_shadows
from kgcp.measurement.image_model.unblurred import UnblurredPlate, unblurred_plate

# Tuning, by the flights `light` of `benchmarks.accuracy.evaluate`; lengths in radii, light in
# contrasts, where nothing else is said.
_CLEAR_SIGMAS, _CLEAR_PX, _MOST_CLEAR = 2.0, 1.0, 0.1  # of an edge
_BORDER = 0.18  # of the plate beyond the ring
_SMOOTHED = 0.16
_BINS = 4.0  # in the σ of a smoothing
_WIDE, _WIDE_SHARE = 3.0, 0.02  # where nothing flat is near, what is farther off counts
_UNEVEN = 0.12  # smoothed levels vary so much: one pair of them would mislead
_GLARE, _DARKEST_PLATE, _DARKER_INK = 0.06, 0.35, 0.5
_GLARE_REACH, _SEEN = 1.5, 1e-3
_LEAST_CONTRAST = 0.1
_FEWEST_PIXELS = 24  # of ink and of plate
_MOST_PIXELS = 4000  # that tell where edges of shadows lie
# Grey value of white that may be burnt below the end of the range, and from where on up to there
# what is seen is its edge. With 0.7 or 0.85 of the contrast instead of 0.8, errors of three sets of
# phones' burnt plates (R 37 to 140 px) are 0.8 to 2.2 times as large.
_BURNT_WHITE, _EDGE_OF_BURNT = (0.8, 0.985), 0.8
_LIT = 0.1  # of the contrast: so near the brightest plate, it is in full light
# Noise of burnt white in grey values, and as a share of that of ink, at most; the second pair is
# for ink that compression has smoothed. Of 288 plates by phones that are not burnt (R 37 to 290 px;
# PNG, quality 95 and 92), none is taken for burnt. Of 48 burnt ones with R ≥ 150 px, 47 are; of 16
# smaller ones with quality 92 only 6, for what compression leaves beside edges looks like noise.
_NOISE_OF_BURNT = ((0.27, 0.4), (0.145, 0.7))
_CENTRAL, _CENTRAL_SD = 0.7, 0.557  # share of the smallest values; their RMS if normal
# The second difference both ways: light that changes steadily does not show in it.
_ROUGHNESS = np.outer((1.0, -2.0, 1.0), (1.0, -2.0, 1.0)) / 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Plateaus:
    """Levels of ink and plate all over a window, from where they are seen."""

    levels: FloatArray  # (2, n): of ink and of plate, at every pixel
    typical: tuple[float, float]  # medians
    extremes: tuple[float, float]  # the darkest ink and the brightest plate, smoothed
    uneven: float  # how much they vary, of the contrast
    flat: tuple[IndexArray, IndexArray]  # pixels of ink and plate clear of edges

    @property
    def is_uneven(self) -> bool:
        """Whether the levels vary so much that one pair of them would mislead."""
        return self.uneven > _UNEVEN


def look_at_plateaus(problem: FitProblem, pose: Pose, sd_px: float) -> Plateaus | None:
    """Smooth ink and plate each over what is seen of them; None if too little is."""
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
        uneven=max(dark - darkest, brightest - bright) / (white - black),
        flat=(ink, plate),
    )


def without_burnt_white(problem: FitProblem, plateaus: Plateaus) -> FitProblem:
    """Return the problem with white taken for clipped, if it is burnt below the end of the range.

    Cameras that map tones locally, or to another exposure, do so after the sensor has clipped.
    The plate is brighter there than it seems, and its edges are displaced by a curve that no three
    shapes follow. What gives burnt white away is its noise, less than rounding alone makes.
    """
    shows_noise = problem.window.binning == 1 and not problem.is_ring_small
    ink, plate = plateaus.typical[0], plateaus.extremes[1]
    least, most = _BURNT_WHITE
    if not shows_noise or not least < plate < most * problem.censoring.high:
        return problem
    dark, bright = plateaus.flat
    bright = bright[problem.window.smooth[bright] > plate - _LIT * (plate - ink)]
    if len(bright) < _FEWEST_PIXELS:
        return problem
    of_ink, of_plate = _noise_in_counts(problem, dark), _noise_in_counts(problem, bright)
    if not any(of_plate < sd and of_plate < share * of_ink for sd, share in _NOISE_OF_BURNT):
        return problem
    return problem.with_burnt_white(plate, ink + _EDGE_OF_BURNT * (plate - ink))


def _noise_in_counts(problem: FitProblem, flat: IndexArray) -> float:
    """Return the standard deviation of the noise at some pixels, robust against edges nearby."""
    window = problem.window
    image = (window.levels / window.levels_per_count).reshape(window.height, window.width)
    rough = cv2.filter2D(image, -1, _ROUGHNESS, borderType=cv2.BORDER_REPLICATE).ravel()[flat]
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
    return np.asarray(within & (unblurred.off_edge_m >= clear_px / px_per_m))


def _kinds(
    problem: FitProblem, unblurred: UnblurredPlate, clear: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Tell what is ink and what is plate.

    Ink as bright as plate is a dot of another code, and so is dark plate: neither may pass for
    light. Glare makes ink brighter, but the plate around it, too.
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
    return np.where(near > _SEEN, total / np.maximum(near, _SEEN), 0.0)


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
    """Blur a window's values; where that is wide, in bins of a quarter of its σ."""
    image = values.reshape(problem.window.height, problem.window.width)
    count = max(1, int(sigma_px / _BINS))  # pixels along a bin's side
    if count == 1:
        blurred = cv2.GaussianBlur(image, (0, 0), sigma_px)
    else:
        size = [math.ceil(length / count) for length in image.shape[::-1]]
        bins = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        # means over bins, and straight lines between them, blur too
        sigma = math.sqrt((sigma_px / count) ** 2 - 1.0 / 12.0 - 1.0 / 6.0)
        bins = cv2.GaussianBlur(bins, (0, 0), sigma)
        blurred = cv2.resize(bins, image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(blurred, dtype=np.float64).ravel()


def evened_window(problem: FitProblem, plateaus: Plateaus) -> FitProblem:
    """Return the window as it would be in even light, by the levels seen."""
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
    """Return a field whose finest knots have the levels seen."""
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


def shadows_across(problem: FitProblem, plateaus: Plateaus) -> list[SeenShadows]:
    """Return straight edges of shadows that explain how the levels vary, the fewest first."""
    step = max(1, sum(map(len, plateaus.flat)) // _MOST_PIXELS)
    chosen = [flat[::step] for flat in plateaus.flat]
    index = np.concatenate(chosen)
    flat = FlatPixels(
        offsets=problem.window.pixels(index) - problem.centre_px[:, None],
        kind=np.repeat((0, 1), [len(each) for each in chosen]),
        levels=problem.window.smooth[index],
        high=problem.censoring.high,
    )
    return find_shadows(flat, problem.tone)
