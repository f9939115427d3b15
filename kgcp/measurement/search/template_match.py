"""Comparison of a ring in a frame, whole or partly hidden, with the templates of a target."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, SingleArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.search.code_signal import CodeMatch
from kgcp.measurement.search.correlation import TemplateBank, build_bank, correlate
from kgcp.measurement.search.sampling import sample_ellipses, sample_grey
from kgcp.measurement.search.templates import (
    ANGLES,
    BLUR_CLIP_PAIRS,
    CIRCLE,
    FREQUENCIES,
    SAMPLED_RADII,
    SHIFTS,
    TEMPLATE_RADII,
    code_rows,
    edge_rows,
    templates_of,
)
from kgcp.measurement.search.uneven_light import MIN_CORRECTED_RADIUS_PX, light_corrected_patch
from kgcp.targets.layout import Ring

# Tuning of the comparison. There are two benchmarks: `benchmarks.search.hard_frames` for the
# targets found (results in docs/method/search.md, "Constants of the search"), and
# `benchmarks.search.false_alarms`.
MIN_SCORE_OF_A_CODE = 0.7
"""Score above which a ring with dots carries some code, though perhaps another one."""
_CLEAR_SCORE = 0.9  # of a whole ring; above, no part of it is hidden
_MIN_SCORE_TO_CORRECT = 0.6  # for a correction of the light; most rings of something else have less
# Limit of the misfit. A dot too many or too few is a misfit of 1. The limit is min(0.45, 0.2 + 0.5
# · contrast of the dots), because noise may look like a dot if the dots are faint.
_MAX_MISFIT, _MISFIT_FAINT, _MISFIT_BY_DOTS = 0.45, 0.2, 0.5
_MIN_BLACK = -0.3  # relative to the contrast; sharpening makes small rings darker than black
# The other constants are for partly hidden rings. The first is the quantile of an edge's steps that
# is typical of its visible part, however much is hidden.
_TYPICAL = 0.65
_MIN_STEP = 0.35  # of a visible edge, relative to the typical one
_MIN_RUN = 13  # samples of a hidden part; a dot that is too large takes fewer
_BORDER = 2  # samples beside a hidden part that blur may mix with it
_MAX_HIDDEN = 0.4  # share of the angles
# Share of the code's dots that must be visible. That the visible part has no other dots is as
# informative.
_MIN_VISIBLE_DOTS = 0.5
_OTHER_LAG = 6  # samples; matches that are farther off belong to another heading
_MARGIN = 0.04  # by which the best score must exceed those of other headings
# Least score along the visible part of the code circle, the best over all headings. 160 hidden or
# cut targets had 0.77 or more.
_MIN_CODE_CIRCLE_SCORE = 0.6

_TYPICAL_RANK = round(_TYPICAL * (ANGLES - 1))
_CODE_TEMPLATE = BLUR_CLIP_PAIRS.index((0.07, 1.0))  # the template whose code circle is compared
_EVERYWHERE = np.ones(ANGLES, dtype=bool)


@dataclass(frozen=True, slots=True, eq=False)
class TemplateMatch:
    """Agreement of one ring in the frame with the ring of a target."""

    score: float  # normalised cross-correlation of the visible part with the best template, -1…1
    lag_deg: float  # direction of the plate's +x axis, as an angle of the sampled circles [deg]
    # levels of ink and plate [grey values]
    black: float
    white: float
    # largest difference from the template along the code circle, relative to a dot's contrast: 1
    # for a dot too many or too few
    misfit: float
    # contrast of the template's dots, relative to the ring's: less than 1 if they are blurred
    dot_contrast: float
    # (angles,): whether the ring is visible at each angle of the sampled circles; None if it is
    # everywhere
    visible: BoolArray | None

    @property
    def limit(self) -> float:
        """Largest `misfit` that is accepted: less if blur leaves little of the dots."""
        return min(_MAX_MISFIT, _MISFIT_FAINT + _MISFIT_BY_DOTS * self.dot_contrast)

    @property
    def is_clear(self) -> bool:
        """Whether the whole ring agrees with that of the target."""
        return self.score >= _CLEAR_SCORE and self.misfit <= self.limit

    def check(self, min_score: float) -> None:
        """Raise `Rejection` unless this is the ring of the target."""
        contrast = self.white - self.black
        if self.score < min(MIN_SCORE_OF_A_CODE, min_score):
            reason = Reason.CODE_MISMATCH
        elif self.misfit > self.limit:
            reason = Reason.OTHER_CODE
        elif self.score < min_score:
            reason = Reason.CODE_MISMATCH
        elif contrast <= 0.0 or self.black < _MIN_BLACK * contrast:
            raise Rejection(
                Reason.NO_CONTRAST,
                f"levels of ink and plate: {self.black:.0f} and {self.white:.0f}",
            )
        else:
            return
        numbers = (
            f"score {self.score:.2f}, a dot is off by {self.misfit:.2f}, limit {self.limit:.2f}"
        )
        raise Rejection(reason, numbers)

    def code_match(self, ring: Ring, outline: Ellipse) -> CodeMatch:
        """Return the match of a ring with this outline."""
        return CodeMatch(ring, outline, self.score, self.lag_deg, self.black, self.white)


class TemplatePlacement(NamedTuple):
    """The template with the best score, its radial shift in rows and its lag in samples."""

    score: float
    template: int
    shift: int
    lag: int


def match_templates_at(grey: GreyArray, camera: Camera, pose: Pose, ring: Ring) -> TemplateMatch:
    """Compare a ring with its templates at a predicted pose; angles are those on the plate."""
    radii_m = 0.5 * ring.outer_diameter_m * SAMPLED_RADII
    points = camera.project_circles(pose.rotation, pose.translation_m, radii_m, CIRCLE)
    return match_templates(sample_grey(grey, points), ring, _radius_px(camera, pose, ring))


def light_corrected_code(
    grey: GreyArray, camera: Camera, pose: Pose, ring: Ring
) -> FloatArray | None:
    """Return the grey values along the code circle (360,) of a pose, corrected for uneven light.

    None if the light is even, if a part does not look like a ring, or if the ring is small.
    """
    if _radius_px(camera, pose, ring) < MIN_CORRECTED_RADIUS_PX:
        return None
    radii_m = 0.5 * ring.outer_diameter_m * SAMPLED_RADII
    points = camera.project_circles(pose.rotation, pose.translation_m, radii_m, CIRCLE)
    even = light_corrected_patch(sample_grey(grey, points), ring, SHIFTS)
    if even is None:
        return None
    row = int(np.abs(SAMPLED_RADII * ring.outer_diameter_m - ring.code_diameter_m).argmin())
    sampled_deg = np.arange(ANGLES) * (360.0 / ANGLES)
    return np.asarray(np.interp(np.arange(360.0), sampled_deg, even[row], period=360.0))


def _radius_px(camera: Camera, pose: Pose, ring: Ring) -> float:
    return 0.5 * ring.outer_diameter_m * camera.mean_focal_px / pose.distance_m


def polar_patch(grey: GreyArray, outline: Ellipse) -> FloatArray:
    """Return the polar samples (radii, angles) around an outline that `match_templates` takes."""
    return np.asarray(sample_ellipses(grey, (outline,), SAMPLED_RADII, CIRCLE)[0])


def match_templates(patch: FloatArray, ring: Ring, radius_px: float) -> TemplateMatch:
    """Compare a polar patch (radii, angles) of the frame with the ring's templates.

    In uneven light, rings that are not too small are compared after a correction of the light. If a
    part of the ring is hidden, the rest is compared.
    """
    templates = templates_of(ring)
    whole = best_placement(correlate(patch, templates))
    template_match = _matched(patch, ring, whole, None)
    if template_match.is_clear:
        return template_match
    if template_match.score > _MIN_SCORE_TO_CORRECT and radius_px >= MIN_CORRECTED_RADIUS_PX:
        even = light_corrected_patch(patch, ring, whole.shift)
        if even is not None:
            in_even_light = _matched(even, ring, best_placement(correlate(even, templates)), None)
            if in_even_light.is_clear:
                return in_even_light
    visible = visible_angles(patch[whole.shift : whole.shift + len(TEMPLATE_RADII)], ring)
    if visible is None or not may_show_code(patch, visible, ring, whole.shift):
        return template_match
    scores = correlate(patch, templates, visible)
    part = best_placement(scores)
    if not _tells_heading(scores, part, visible, ring):
        return template_match
    return _matched(patch, ring, part, visible)


def best_placement(scores: SingleArray) -> TemplatePlacement:
    """Return the largest of the scores (templates, shifts, lags) with its indices."""
    place, lag = divmod(int(scores.argmax()), scores.shape[2])
    template, shift = divmod(place, scores.shape[1])
    return TemplatePlacement(float(scores[template, shift, lag]), template, shift, lag)


def _matched(
    patch: FloatArray, ring: Ring, place: TemplatePlacement, visible: BoolArray | None
) -> TemplateMatch:
    templates = templates_of(ring)
    image = templates.images[place.template]
    first, last = code_rows(ring)
    black, contrast, dot_contrast, misfit = _compare(
        image,
        place.lag,
        patch[place.shift : place.shift + len(image)],
        templates.weights,
        _EVERYWHERE if visible is None else visible,
        first,
        last,
        max(1, round(ring.dot_half_angle_deg * ANGLES / 360.0)),
    )
    return TemplateMatch(
        score=place.score,
        lag_deg=place.lag * 360.0 / ANGLES,
        black=black,
        white=black + contrast,
        misfit=misfit / max(abs(contrast) * dot_contrast, 1e-6),
        dot_contrast=dot_contrast,
        visible=visible,
    )


@compiled
def _compare(
    image: FloatArray,
    lag: int,
    patch: FloatArray,
    weights: FloatArray,
    visible: BoolArray,
    first: int,
    last: int,
    half: int,
) -> tuple[float, float, float, float]:
    """Fit black and contrast of a template `image` (rows, angles) to the visible part of a patch.

    Returned are black, contrast, and two properties of the signal along the code: the range of the
    template's signal, and the largest difference between template and patch. The signal is the mean
    over the rows `first` to `last`, smoothed over `half` samples, half a dot, on either side.
    """
    total = image_mean = image_square = patch_mean = product = 0.0
    rows, angles = image.shape
    turned = np.empty(image.shape)
    turned[:, lag:], turned[:, :lag] = image[:, : angles - lag], image[:, angles - lag :]
    for r in range(rows):
        for a in range(angles):
            if visible[a]:
                total += weights[r]
                image_mean += weights[r] * turned[r, a]
                patch_mean += weights[r] * patch[r, a]
                image_square += weights[r] * turned[r, a] * turned[r, a]
                product += weights[r] * turned[r, a] * patch[r, a]
    image_mean, patch_mean = image_mean / total, patch_mean / total
    contrast = product / total - image_mean * patch_mean
    contrast /= image_square / total - image_mean * image_mean
    black = patch_mean - contrast * image_mean
    dots, residuals = np.zeros(angles), np.zeros(angles)
    for r in range(first, last + 1):
        for a in range(angles):
            dots[a] += turned[r, a]
            if visible[a]:
                residuals[a] += patch[r, a] - black - contrast * turned[r, a]
    share = 1.0 / ((last + 1 - first) * (2 * half + 1))
    least, most, misfit = np.inf, -np.inf, 0.0
    for a in range(angles):
        dot = residual = 0.0
        for step in range(-half, half + 1):
            dot += share * dots[(a + step) % angles]
            residual += share * residuals[(a + step) % angles]
        least, most, misfit = min(least, dot), max(most, dot), max(misfit, abs(residual))
    return black, contrast, most - least, misfit


def visible_angles(patch: FloatArray, ring: Ring) -> BoolArray | None:
    """Return at which angles (angles,) both edges of a ring are visible.

    None if nothing is hidden, or too much. The patch (rows, angles) is sampled at `TEMPLATE_RADII`.
    """
    plate, outside, disc, inside = edge_rows(ring)
    visible = np.empty(ANGLES, dtype=bool)
    hidden = _mark_visible(patch[plate] - patch[outside], patch[disc] - patch[inside], visible)
    return visible if 0 < hidden <= _MAX_HIDDEN * ANGLES else None


@compiled
def _mark_visible(outwards: FloatArray, inwards: FloatArray, visible: BoolArray) -> int:
    """Fill in where the steps at both edges, `outwards` and `inwards`, are large; count the others.

    Runs of missing edges that are shorter than `_MIN_RUN` are noise or dots, and count as visible.
    """
    least_outwards = _MIN_STEP * np.partition(outwards, _TYPICAL_RANK)[_TYPICAL_RANK]
    least_inwards = _MIN_STEP * np.partition(inwards, _TYPICAL_RANK)[_TYPICAL_RANK]
    for a in range(ANGLES):
        visible[a] = outwards[a] > least_outwards and inwards[a] > least_inwards
    is_middle = np.zeros(ANGLES, np.bool_)  # of `_MIN_RUN` angles that are all hidden
    length = 0
    for step in range(ANGLES + _MIN_RUN - 1):  # beyond the end, because runs may wrap around
        length = 0 if visible[step % ANGLES] else length + 1
        if length >= _MIN_RUN:
            is_middle[(step - _MIN_RUN // 2) % ANGLES] = True
    reach = _MIN_RUN // 2 + _BORDER
    visible[:] = True
    for a in range(ANGLES):
        if is_middle[a]:
            for step in range(-reach, reach + 1):
                visible[(a + step) % ANGLES] = False
    return int(ANGLES - visible.sum())


def may_show_code(patch: FloatArray, visible: BoolArray, ring: Ring, shift: int) -> bool:
    """Return whether the visible part of the code circle resembles the code at any heading.

    Most other rings do not, which saves the comparison with all templates.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    visible : (angles,) array of bool
        Which angles are compared.
    shift : int
        Radial shift of the template that fits the whole ring best.
    """
    first, last = code_rows(ring)
    along_code = patch[shift + first : shift + last + 1].sum(axis=0)
    return bool(
        correlate(along_code[None], _code_circle(ring), visible).max() > _MIN_CODE_CIRCLE_SCORE
    )


@lru_cache(maxsize=64)
def _code_circle(ring: Ring) -> TemplateBank:
    """Return the code circle of a blurred ring as a template of one row."""
    first, last = code_rows(ring)
    along_code = templates_of(ring).images[_CODE_TEMPLATE, first : last + 1].sum(axis=0)
    return build_bank(along_code[None, None], np.ones(1), FREQUENCIES)


def _tells_heading(
    scores: SingleArray, best: TemplatePlacement, visible: BoolArray, ring: Ring
) -> bool:
    """Return whether enough dots are visible, and no other heading scores nearly as high."""
    lags = np.arange(best.lag + _OTHER_LAG, best.lag + ANGLES - _OTHER_LAG + 1)
    elsewhere = scores.max(axis=(0, 1)).take(lags, mode="wrap").max()
    dots = [round(deg * ANGLES / 360.0) + best.lag for deg in ring.code_deg]
    visible_dots = int(visible.take(dots, mode="wrap").sum())
    is_clear = bool(elsewhere <= best.score - _MARGIN)
    return visible_dots >= _MIN_VISIBLE_DOTS * len(dots) and is_clear
