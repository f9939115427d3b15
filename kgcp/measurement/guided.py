"""The second look: a target is looked for in the small part of a frame where it must be."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.measurement.frame import measure_match
from kgcp.measurement.plate_prior import PlatePrior
from kgcp.measurement.records import Considered, Measurement
from kgcp.measurement.search.candidates import find_rings_at
from kgcp.measurement.search.code_signal import CodeMatch
from kgcp.measurement.search.template_match import match_templates, polar_patch
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Target

# Tuning of the second look. Its benchmark is the table in docs/method/search.md, "The second pass":
# four simulated flights, with the targets that the second look adds.
_SIGMAS = 4.0  # largest deviation from the prediction, in place and radius
_SMALLEST_PX = 3.0  # least radius of a ring that is looked for
_FARTHEST = 8.0  # largest deviation of the place in radii at which a prediction is of use
_LARGEST_RATIO = 2.0  # largest ratio of a radius to the predicted one at which it is of use
_SPACING, _RATIO = 0.35, 1.25  # steps of start places (in radii), and ratio of start radii
_LOWER_SCORE = 0.06  # by so much the score may be lower than in the first look
_MIN_SCORE_TO_TRY = 0.5  # of the whole ring
_TRIES = 4  # per ring: only the best candidates are measured


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where a target must be in a frame, and how large it is, with standard deviations."""

    centre_px: FloatArray  # (2,): projected centre [px]
    sd_px: float  # standard deviation of either coordinate [px]
    radius_px: float  # of the main ring [px]
    sd_log_radius: float  # standard deviation of its logarithm
    source: str  # what it was made from, in one word

    def __str__(self) -> str:
        """Text for the detail of a row."""
        x, y = self.centre_px
        return (
            f"expected by {self.source} at ({x:.0f}, {y:.0f}) ± {self.sd_px:.1f} px, radius"
            f" {self.radius_px:.1f} px ± {self.sd_log_radius:.0%}"
        )

    @property
    def is_sure(self) -> bool:
        """Whether it is certain enough to look there alone."""
        return (
            _SIGMAS * self.sd_px <= _FARTHEST * self.radius_px
            and _SIGMAS * self.sd_log_radius <= math.log(_LARGEST_RATIO)
        )

    def is_visible(self, camera: Camera) -> bool:
        """Tell whether the centre must be in the frame, and the ring large enough to be seen."""
        x, y = self.centre_px
        return bool(
            0.0 <= x <= camera.width - 1.0
            and 0.0 <= y <= camera.height - 1.0
            and self.radius_px >= _SMALLEST_PX
        )

    def is_outside(self, camera: Camera) -> bool:
        """Tell whether no part of the ring can be in the frame."""
        x, y = self.centre_px
        reach = self.radius_px * math.exp(_SIGMAS * self.sd_log_radius) + _SIGMAS * self.sd_px
        return bool(max(-x, x - camera.width + 1.0, -y, y - camera.height + 1.0) > reach)

    def check(self, measurement: Measurement) -> None:
        """Raise `Rejection` (`POOR_FIT`) unless a measurement agrees, in place and in radius."""
        off_px = float(np.linalg.norm(measurement.centre_px - self.centre_px))
        ratio = measurement.appearance.radius_px / self.radius_px
        if off_px > _SIGMAS * self.sd_px or abs(math.log(ratio)) > _SIGMAS * self.sd_log_radius:
            raise Rejection(Reason.POOR_FIT, f"{off_px:.1f} px and {ratio - 1.0:+.0%} off; {self}")


def measure_guided(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    prediction: Prediction,
    settings: DetectSettings,
    prior: PlatePrior,
    rivals: Sequence[Measurement],
) -> tuple[Measurement | None, tuple[Considered, ...]]:
    """Look for one target where it must be, even if its ring is faint.

    Rings are tracked from all possible places and radii, without the ring filter and the ring
    check. A measurement must agree with the prediction and pass all tests of the first look, but
    with a slightly lower score of the ring.

    Parameters
    ----------
    rivals : sequence of Measurement
        Other targets in this frame.

    Returns
    -------
    measurement : Measurement or None
        The first that passes. The main ring's candidates are tried before the replicas'.
    considered : tuple of Considered
        All candidates that were tried.
    """
    lowered = replace(settings, min_score=max(settings.min_score - _LOWER_SCORE, 0.01))
    considered = []
    for match in _candidates(grey, target, prediction):
        candidate = Considered(
            target.name, match.ring.name, match.outer, match.score, is_match=True
        )
        if any(rival.covers(candidate.outline) for rival in rivals):
            continue
        try:
            measurement = measure_match(grey, camera, target, match, lowered, prior)
            prediction.check(measurement)
        except Rejection as rejection:
            considered.append(replace(candidate, reason=rejection.reason, detail=rejection.detail))
            continue
        return replace(measurement, is_guided=True), (*considered, candidate)
    return None, tuple(considered)


def _candidates(grey: GreyArray, target: Target, prediction: Prediction) -> Iterator[CodeMatch]:
    """Yield the rings most like the target's, ring by ring, best first."""
    for ring in target.rings:
        scale = ring.outer_diameter_m / target.ring.outer_diameter_m
        if scale * prediction.radius_px < _SMALLEST_PX:
            continue
        matches = [
            template_match.code_match(ring, outline)
            for outline in _outlines(grey, prediction, scale)
            for template_match in (match_templates(polar_patch(grey, outline), ring, outline.a),)
            if template_match.score > _MIN_SCORE_TO_TRY
        ]
        matches.sort(key=lambda match: -match.score)
        yield from matches[:_TRIES]


def _outlines(grey: GreyArray, prediction: Prediction, scale: float) -> list[Ellipse]:
    """Track rings from all places and radii that the prediction allows."""
    radius = scale * prediction.radius_px
    reach = _SIGMAS * prediction.sd_px
    steps = math.ceil(reach / (_SPACING * radius))
    line = np.linspace(-reach, reach, 2 * steps + 1)
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    offsets = offsets[np.hypot(*offsets.T) <= reach + 1e-9]
    widest = _SIGMAS * prediction.sd_log_radius
    sizes = math.ceil(widest / math.log(_RATIO))
    radii = radius * np.exp(np.linspace(-widest, widest, 2 * sizes + 1))
    outlines = find_rings_at(
        grey,
        np.repeat(prediction.centre_px + offsets, len(radii), axis=0),
        np.tile(radii, len(offsets)),
    )
    return [
        outline
        for outline in outlines
        if np.linalg.norm(outline.centre - prediction.centre_px) <= reach + _SPACING * radius
        and abs(math.log(outline.a / radius)) <= widest + math.log(_RATIO)
    ]
