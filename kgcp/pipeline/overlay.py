"""Contact sheet of all rings of a flight: fitted contours, residuals and values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from kgcp.errors import Reason, Rejection, Status
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.io.images.frames import read_grey
from kgcp.io.images.remote import at_hand
from kgcp.measurement.adjustment.residual_image import contours_px, residual_image_of
from kgcp.measurement.guided import Prediction
from kgcp.measurement.image_model.window import contour_px
from kgcp.measurement.records import Considered, FrameResult, Measurement, Miss, Outcome
from kgcp.measurement.search.template_match import match_templates, polar_patch
from kgcp.pipeline.detection_run import DetectionRun
from kgcp.pipeline.execution.resilient_map import TaskFailure
from kgcp.pipeline.frame_task import DetectionJob
from kgcp.pipeline.guidance import is_out_of_view
from kgcp.quality.number_text import minus
from kgcp.report.contact_sheet import DROPPED, Card, ContactSheet
from kgcp.report.ring_picture import Pictures, RingView, draw_ring
from kgcp.targets.layout import Target
from kgcp.targets.plain import PlainTarget

_LOSSES = {
    TaskFailure.CRASHED: "the process that drew it ended twice",
    TaskFailure.TIMED_OUT: "it took too long",
}
_MISSES = {Status.NOT_FOUND.value, Status.REJECTED.value}
_TURN = np.linspace(0.0, 2.0 * np.pi, 97)
_CIRCLE = np.stack((np.cos(_TURN), np.sin(_TURN)), axis=-1)


@dataclass(frozen=True, slots=True)
class Sketch:
    """One card of the sheet before it is written."""

    card: Card  # without the name of its picture
    # None: the place of the ring is unknown, or the frame could not be read again
    pictures: Pictures | None = None
    is_lost: bool = False  # whether pictures are missing because the frame could not be read again


def draw_overlay(
    sheet: ContactSheet,
    flight_name: str,
    run: DetectionRun,
    job: DetectionJob,
    predictions: Mapping[int, Mapping[str, Prediction]],
) -> int:
    """Draw the latest result of every frame, and write the page.

    Workers draw. This process writes their pictures as they arrive, and keeps only the cards.

    Parameters
    ----------
    predictions : mapping of mappings
        Predictions by row and target, which are added to the texts of misses.

    Returns
    -------
    int
        Number of rings that could not be drawn because their frame could not be read again.

    Raises
    ------
    KgcpError
        If the sheet cannot be written.
    """
    cards: dict[int, list[Card]] = {}
    lost = 0
    for row, result, made in run.map_results(partial(sketch_frame, job)):
        sketches = _lost(result, _LOSSES[made]) if isinstance(made, TaskFailure) else made
        lost += sum(sketch.is_lost for sketch in sketches)
        cards[row] = []
        for place, sketch in enumerate(sketches):
            card = _with_prediction(sketch.card, predictions.get(row, {}), job.camera)
            if sketch.pictures is not None and card.reason != Reason.OUT_OF_VIEW:
                stem = f"{row + 1:06d}-{place}"
                sheet.add(stem, sketch.pictures)
                card = replace(card, stem=stem)
            cards[row].append(card)
    sheet.finish(flight_name, [card for row in sorted(cards) for card in cards[row]])
    return lost


def _with_prediction(card: Card, predictions: Mapping[str, Prediction], camera: Camera) -> Card:
    """Add the prediction of its target to the card of a miss."""
    if card.target not in predictions or card.status not in _MISSES:
        return card
    prediction = predictions[card.target]
    if is_out_of_view(Reason.of(card.reason), prediction, camera):
        word = Reason.OUT_OF_VIEW.value
        return Card(
            frame=card.frame,
            target=card.target,
            instance=0,
            status=Reason.OUT_OF_VIEW.status.value,
            reason=word,
            headline=word,
            text=f"{prediction}, outside the frame",
        )
    return replace(card, text=_joined(card.text, str(prediction)))


def sketch_frame(job: DetectionJob, result: FrameResult) -> list[Sketch]:
    """Read a frame again and draw all rings of its result, in the order of the table's rows.

    Dropped rings follow, those that passed most tests first.
    """
    rings = _rings(result)
    if not any(_has_place(ring) for ring in rings):
        return [Sketch(_card(result.frame, ring)) for ring in rings]
    try:
        with at_hand(job.frames_folder, result.frame) as path:
            grey = read_grey(path, job.camera)
    except Rejection as rejection:
        return _lost(result, str(rejection))
    return [_sketch(job, grey, result.frame, ring) for ring in rings]


def _rings(result: FrameResult) -> list[Outcome | Considered]:
    """Return the contents of the cards: all outcomes, then dropped rings that no miss shows."""
    outcomes = sorted(
        result.outcomes,
        key=lambda outcome: (outcome.target, 0 if isinstance(outcome, Miss) else outcome.instance),
    )
    shown = {outcome.outline for outcome in outcomes if isinstance(outcome, Miss)}
    return [*outcomes, *(outcome for outcome in result.dropped if outcome.outline not in shown)]


def _has_place(ring: Outcome | Considered) -> bool:
    return isinstance(ring, Measurement) or ring.outline is not None


def _lost(result: FrameResult, why: str) -> list[Sketch]:
    return [
        Sketch(_card(result.frame, ring, note=f"not drawn: {why}"), is_lost=True)
        if _has_place(ring)
        else Sketch(_card(result.frame, ring))
        for ring in _rings(result)
    ]


def _sketch(job: DetectionJob, grey: GreyArray, frame: str, ring: Outcome | Considered) -> Sketch:
    target = next(target for target in job.all_targets if target.name == ring.target)
    if isinstance(target, PlainTarget):
        return _plain_sketch(job, grey, frame, target, ring)
    if not isinstance(ring, Measurement):
        pictures = None
        if ring.outline is not None:
            pictures = draw_ring(grey, _dropped_view(grey, ring.outline, target))
        return Sketch(_card(frame, ring), pictures)
    appearance = ring.appearance
    note, residual_image = "", None
    try:
        residual_image = residual_image_of(grey, job.camera, target, ring.pose, appearance.blur_px)
    except Rejection as rejection:
        note = f"no residuals: {rejection}"
    curves = tuple(contours_px(job.camera, target, ring.pose))
    view = RingView(ring.centre_px, appearance.radius_px, curves, residual_image)
    share = None if residual_image is None else 100.0 * residual_image.edge_noise
    if residual_image is not None and residual_image.white is not None:
        note = f"uneven light: white from {np.nanmin(residual_image.white):.0%} of its largest"
        if residual_image.may_be_hidden:
            note = "something seems to hide a part of the plate, or its light is very uneven"
    return Sketch(_card(frame, ring, share, note), draw_ring(grey, view))


def _plain_sketch(
    job: DetectionJob,
    grey: GreyArray,
    frame: str,
    target: PlainTarget,
    ring: Outcome | Considered,
) -> Sketch:
    if not isinstance(ring, Measurement):
        return Sketch(_card(frame, ring))
    curves = tuple(contour_px(job.camera, ring.pose, radius_m) for radius_m in target.radii_m)
    view = RingView(ring.centre_px, ring.appearance.radius_px, curves)
    return Sketch(_card(frame, ring), draw_ring(grey, view))


def _dropped_view(grey: GreyArray, outline: Ellipse, target: Target) -> RingView:
    """Return the view of a dropped ring with the dots of the most similar ring of the target."""
    patch = polar_patch(grey, outline)
    matches = [(match_templates(patch, ring, outline.mean_radius), ring) for ring in target.rings]
    best, ring = max(matches, key=lambda pair: pair[0].score)
    turn = math.radians(best.lag_deg)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    plate_m = ring.dot_centres_m()[:, None] + 0.5 * ring.dot_diameter_m * _CIRCLE
    unit = plate_m @ rotation.T / (0.5 * ring.outer_diameter_m)
    dots = tuple(outline.centre + points @ outline.stretch.T for points in unit)
    return RingView(outline.centre, outline.a, (outline.points(_TURN),), expected=dots)


def _card(
    frame: str,
    ring: Outcome | Considered,
    residual_percent: float | None = None,
    note: str = "",
) -> Card:
    if isinstance(ring, Measurement):
        return _measured_card(frame, ring, residual_percent, note)
    reason = ring.reason.value if ring.reason else ""
    if isinstance(ring, Miss):
        status, texts = ring.reason.status.value, [ring.detail]
    else:
        outline = ring.outline
        where = f"ring at ({outline.x:.0f}, {outline.y:.0f}), radius {outline.mean_radius:.1f} px"
        status, texts = DROPPED, [f"compared with {ring.ring}", where, ring.detail]
        if "score" not in ring.detail:
            texts.append(f"score {ring.score:.2f}")
    return Card(
        frame=frame,
        target=ring.target,
        instance=0,
        status=status,
        reason=reason,
        headline=reason,
        text=_joined(*texts, note),
        radius_px=None if ring.outline is None else ring.outline.a,
    )


def _measured_card(
    frame: str, observation: Measurement, residual_percent: float | None, note: str
) -> Card:
    distance_m, spread = observation.pose.distance_m, observation.uncertainty
    sd = "" if spread is None else f" ± {1e3 * spread.sd_distance_m:.1f} mm"
    return Card(
        frame=frame,
        target=observation.target,
        instance=observation.instance,
        status=Status.MEASURED.value,
        reason="",
        headline=f"{distance_m:.3f} m{sd}",
        text=_joined(*_values(observation, residual_percent), note),
        distance_m=distance_m,
        sd_percent=None if spread is None else 100.0 * spread.sd_distance_m / distance_m,
        radius_px=observation.appearance.radius_px,
        residual_percent=residual_percent,
    )


def _values(observation: Measurement, residual_percent: float | None) -> Iterator[str]:
    """Yield the values as short texts; unknown ones are left out."""
    appearance, spread = observation.appearance, observation.uncertainty
    x, y = observation.centre_px
    sd = "" if spread is None else f" ± {np.sqrt(np.diag(spread.centre_cov_px2).max()):.3f}"
    yield f"centre ({x:.2f}, {y:.2f}){sd} px"
    yield f"radius {appearance.radius_px:.1f} px"
    if observation.ring != observation.target:
        yield f"by {observation.ring}"
    if observation.is_guided:
        yield "second look"
    angles = (observation.pose.roll_deg, observation.pose.pitch_deg, observation.heading_deg)
    roll, pitch, heading = (minus(f"{angle:.1f}") for angle in angles)
    yield f"roll {roll}°, pitch {pitch}°, heading {heading}°"
    if observation.alternative is not None:
        ambiguity = observation.alternative.ambiguity
        yield f"ambiguity {ambiguity:.{1 if ambiguity < 100.0 else 0}f}"
    if appearance.blur_px is not None:
        yield f"blur {appearance.blur_px:.2f} px"
    if appearance.edge_shift_px is not None:
        yield f"edge shift {minus(f'{appearance.edge_shift_px:.2f}')} px"
    yield f"levels {appearance.black:.2f} … {appearance.white:.2f}"
    yield f"clipped {100.0 * appearance.saturated:.0f}\xa0%"
    if math.isfinite(observation.score):
        yield f"score {observation.score:.2f}"
    if residual_percent is not None:
        yield f"residuals {residual_percent:.1f}\xa0%"


def _joined(*texts: str) -> str:
    return " · ".join(filter(None, texts))
