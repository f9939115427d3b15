"""How well one ring in a frame looks like a target's, whole or in part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.search.partial_match import (
    best_partial_template,
    may_show_code,
    visible_angles,
)
from kgcp.measurement.search.sampling import sample_ellipses, sample_grey
from kgcp.measurement.search.templates import (
    ANGLES,
    CIRCLE,
    SAMPLED_RADII,
    SHIFTS,
    best_template,
    code_rows,
    templates_of,
)
from kgcp.targets.layout import Ring

_MAX_MISFIT, _MISFIT_FAINT, _MISFIT_BY_DOTS = 0.45, 0.2, 0.5
_CLEAR_SCORE = 0.9
_DARKEST_BLACK = -0.3  # of the contrast: sharpening makes small rings darker than black
_EVERYWHERE = np.ones(ANGLES, dtype=bool)
CODE_LIKE = 0.7
"""Score above which a ring with dots is a code, if another one."""


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """How well one ring in the frame looks like a target's.

    Attributes
    ----------
    score : float
        Normalised cross-correlation with the best template, of what is seen of the ring, -1…1.
    lag_deg : float
        Heading of the plate's +x axis, as an angle of the sampled circles [deg].
    black, white : float
        Levels of ink and plate [grey values].
    misfit : float
        Largest difference to the template along the code, of a dot's contrast: 1 is a dot too
        many or too few.
    dot_contrast : float
        Of the template's dots, of the ring's contrast: less than 1 where they are blurred.
    visible : (angles,) array of bool, or None
        Where the ring is seen, by angles of the sampled circles; None: everywhere.
    """

    score: float
    lag_deg: float
    black: float
    white: float
    misfit: float
    dot_contrast: float
    visible: BoolArray | None

    @property
    def limit(self) -> float:
        """What `misfit` may be: less where blur leaves little of the dots."""
        return min(_MAX_MISFIT, _MISFIT_FAINT + _MISFIT_BY_DOTS * self.dot_contrast)

    @property
    def is_clear(self) -> bool:
        """Tell whether the whole ring looks like the target's."""
        return self.score >= _CLEAR_SCORE and self.misfit <= self.limit

    def check(self, min_score: float) -> None:
        """Raise `Rejection` unless this is the target's ring."""
        contrast = self.white - self.black
        if self.score < min(CODE_LIKE, min_score):
            reason = Reason.CODE_MISMATCH
        elif self.misfit > self.limit:
            reason = Reason.OTHER_CODE
        elif self.score < min_score:
            reason = Reason.CODE_MISMATCH
        elif contrast <= 0.0 or self.black < _DARKEST_BLACK * contrast:
            raise Rejection(Reason.NO_CONTRAST, f"levels {self.black:.0f} and {self.white:.0f}")
        else:
            return
        numbers = f"score {self.score:.2f}, a dot off by {self.misfit:.2f} of {self.limit:.2f}"
        raise Rejection(reason, numbers)


def judge_at(grey: GreyArray, camera: Camera, pose: Pose, ring: Ring) -> Verdict:
    """Compare a ring with its templates as a pose puts them; angles are the plate's."""
    radii_m = 0.5 * ring.outer_diameter_m * SAMPLED_RADII
    points = camera.project_circles(pose.rotation, pose.translation_m, radii_m, CIRCLE)
    return judge(sample_grey(grey, points), ring)


def polar_patch(grey: GreyArray, outline: Ellipse) -> FloatArray:
    """Sample a frame around an outline, for `judge`: (radii, angles)."""
    return np.asarray(sample_ellipses(grey, (outline,), SAMPLED_RADII, CIRCLE)[0])


def judge(patch: FloatArray, ring: Ring) -> Verdict:
    """Compare a polar patch (radii, angles) of the frame with the ring's templates.

    Where a part of the ring is hidden, the rest of it is compared.
    """
    match = best_template(patch, templates_of(ring))
    verdict, shift = _verdict(patch, ring, match, None), match[2]
    if verdict.is_clear:
        return verdict
    visible = visible_angles(patch[shift : len(patch) - 2 * SHIFTS + shift], ring)
    if visible is None or not may_show_code(patch, visible, ring, shift):
        return verdict
    partial = best_partial_template(patch, visible, ring)
    return verdict if partial is None else _verdict(patch, ring, partial, visible)


def _verdict(
    patch: FloatArray, ring: Ring, match: tuple[float, int, int, int], visible: BoolArray | None
) -> Verdict:
    templates = templates_of(ring)
    score, index, shift, lag = match
    image = templates.images[index]
    black, contrast, dot_contrast, misfit = _compare(
        *(image, lag, patch[shift : shift + len(image)], templates.weights),
        *(_EVERYWHERE if visible is None else visible, *code_rows(ring), _half_dot(ring)),
    )
    return Verdict(
        score=score,
        lag_deg=lag * 360.0 / ANGLES,
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
    seen: FloatArray,
    weights: FloatArray,
    visible: BoolArray,
    first: int,
    last: int,
    half: int,
) -> tuple[float, float, float, float]:
    """Fit black and contrast to what is seen of a ring, by an image (rows, angles) of it.

    Of the means over the code's rows, `first` to `last`, smoothed over `half` a dot either side,
    the range in the image and the largest difference between both are returned, too.
    """
    total = mean = square = seen_mean = product = 0.0
    rows, angles = image.shape
    turned = np.empty(image.shape)
    turned[:, lag:], turned[:, :lag] = image[:, : angles - lag], image[:, angles - lag :]
    for r in range(rows):
        for a in range(angles):
            if visible[a]:
                wanted, found = turned[r, a], seen[r, a]
                total += weights[r]
                mean += weights[r] * wanted
                seen_mean += weights[r] * found
                square += weights[r] * wanted * wanted
                product += weights[r] * wanted * found
    mean, seen_mean = mean / total, seen_mean / total
    contrast = (product / total - mean * seen_mean) / (square / total - mean * mean)
    black = seen_mean - contrast * mean
    dots, rest = np.zeros(angles), np.zeros(angles)
    for r in range(first, last + 1):
        for a in range(angles):
            dots[a] += turned[r, a]
            if visible[a]:
                rest[a] += seen[r, a] - black - contrast * turned[r, a]
    share = 1.0 / ((last + 1 - first) * (2 * half + 1))
    least, most, misfit = np.inf, -np.inf, 0.0
    for a in range(angles):
        dot = off = 0.0
        for step in range(-half, half + 1):
            dot += share * dots[(a + step) % angles]
            off += share * rest[(a + step) % angles]
        least, most, misfit = min(least, dot), max(most, dot), max(misfit, abs(off))
    return black, contrast, most - least, misfit


def _half_dot(ring: Ring) -> int:
    """Return about half the width of a dot, in samples."""
    return max(1, round(ring.dot_half_angle_deg * ANGLES / 360.0))
