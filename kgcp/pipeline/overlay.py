"""All rings of a flight as a contact sheet: what was fitted, what that leaves, and the values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from kgcp.errors import Rejection, Status
from kgcp.geometry.arrays import GreyArray
from kgcp.io.images.frames import read_grey
from kgcp.io.images.remote import at_hand
from kgcp.io.tables.detections import FrameResult
from kgcp.measurement.adjustment.residual_image import contours_px, residuals_of
from kgcp.measurement.records import Miss, Observation, Outcome
from kgcp.pipeline.detection_run import Looks
from kgcp.pipeline.execution.resilient_map import Loss
from kgcp.pipeline.frame_task import FrameTask
from kgcp.report.contact_sheet import Card, ContactSheet
from kgcp.report.ring_picture import Pictures, Scene, draw_scene

_LOSSES = {Loss.DIED: "the process that drew it ended twice", Loss.LATE: "it took too long"}
_TURN = np.linspace(0.0, 2.0 * np.pi, 97)


@dataclass(frozen=True, slots=True)
class Sketch:
    """One row of the table, to be shown.

    Attributes
    ----------
    card : Card
        Without the name of a picture.
    pictures : Pictures or None
        None: nothing says where a ring is, or the frame could not be read again.
    is_lost : bool
        Whether there should be pictures.
    """

    card: Card
    pictures: Pictures | None = None
    is_lost: bool = False


def draw_overlay(sheet: ContactSheet, flight_name: str, looks: Looks, task: FrameTask) -> int:
    """Draw the last result of every frame, and write the page.

    Returns
    -------
    int
        Rings that could not be drawn, since their frame could not be read again.

    Raises
    ------
    KgcpError
        If the sheet cannot be written.
    """
    drawn: dict[int, list[Card]] = {}
    lost = 0
    for row, result, made in looks.through(partial(sketch_frame, task)):
        sketches = _lost(result, _LOSSES[made]) if isinstance(made, Loss) else made
        lost += sum(sketch.is_lost for sketch in sketches)
        drawn[row] = [
            _placed(sheet, sketch, f"{row + 1:06d}-{place}")
            for place, sketch in enumerate(sketches)
        ]
    sheet.finish(flight_name, [card for row in sorted(drawn) for card in drawn[row]])
    return lost


def _placed(sheet: ContactSheet, sketch: Sketch, stem: str) -> Card:
    if sketch.pictures is None:
        return sketch.card
    sheet.add(stem, sketch.pictures)
    return replace(sketch.card, stem=stem)


def sketch_frame(task: FrameTask, result: FrameResult) -> list[Sketch]:
    """Read a frame again and draw all rings of its result, in the order of the table's rows."""
    if not any(map(_has_place, result.outcomes)):
        return [Sketch(_card(result.frame, one)) for one in _in_order(result)]
    try:
        with at_hand(task.frames_folder, result.frame) as path:
            grey = read_grey(path, task.camera)
    except Rejection as rejection:
        return _lost(result, str(rejection))
    return [_sketch(task, grey, result.frame, outcome) for outcome in _in_order(result)]


def _in_order(result: FrameResult) -> list[Outcome]:
    return sorted(
        result.outcomes, key=lambda one: (one.target, 0 if isinstance(one, Miss) else one.instance)
    )


def _has_place(outcome: Outcome) -> bool:
    return isinstance(outcome, Observation) or outcome.outline is not None


def _lost(result: FrameResult, why: str) -> list[Sketch]:
    return [
        Sketch(_card(result.frame, one, note=f"not drawn: {why}"), is_lost=True)
        if _has_place(one)
        else Sketch(_card(result.frame, one))
        for one in _in_order(result)
    ]


def _sketch(task: FrameTask, grey: GreyArray, frame: str, outcome: Outcome) -> Sketch:
    if isinstance(outcome, Miss):
        card = _card(frame, outcome)
        outline = outcome.outline
        if outline is None:
            return Sketch(card)
        scene = Scene(outline.centre, outline.a, (outline.points(_TURN),), None)
        return Sketch(card, draw_scene(grey, scene))
    target = next(one for one in task.targets if one.name == outcome.target)
    appearance = outcome.appearance
    note, residuals = "", None
    try:
        residuals = residuals_of(grey, task.camera, target, outcome.pose, appearance.blur_px)
    except Rejection as rejection:
        note = f"no residuals: {rejection}"
    curves = tuple(contours_px(task.camera, target, outcome.pose))
    scene = Scene(outcome.centre_px, appearance.radius_px, curves, residuals)
    noise = None if residuals is None else 100.0 * residuals.edge_noise
    return Sketch(_card(frame, outcome, noise, note), draw_scene(grey, scene))


def _card(
    frame: str, outcome: Outcome, residual_percent: float | None = None, note: str = ""
) -> Card:
    if isinstance(outcome, Miss):
        return Card(
            frame=frame,
            target=outcome.target,
            instance=0,
            status=outcome.reason.status.value,
            reason=outcome.reason.value,
            headline=outcome.reason.value,
            text=_joined(outcome.detail, note),
            radius_px=None if outcome.outline is None else outcome.outline.a,
        )
    distance_m, known = outcome.pose.distance_m, outcome.uncertainty
    sd = "" if known is None else f" ± {1e3 * known.sd_distance_m:.1f} mm"
    return Card(
        frame=frame,
        target=outcome.target,
        instance=outcome.instance,
        status=Status.MEASURED.value,
        reason="",
        headline=f"{distance_m:.3f} m{sd}",
        text=_joined(*_values(outcome, residual_percent), note),
        distance_m=distance_m,
        sd_percent=None if known is None else 100.0 * known.sd_distance_m / distance_m,
        radius_px=outcome.appearance.radius_px,
        residual_percent=residual_percent,
    )


def _values(seen: Observation, residual_percent: float | None) -> list[str]:
    """Say the values in few words; those that are not known are left out."""
    look, known = seen.appearance, seen.uncertainty
    x, y = seen.centre_px
    sd = "" if known is None else f" ± {np.sqrt(np.diag(known.centre_cov_px2).max()):.3f}"
    texts = [f"centre ({x:.2f}, {y:.2f}){sd} px", f"radius {look.radius_px:.1f} px"]
    if seen.ring != seen.target:
        texts.append(f"by {seen.ring}")
    if seen.is_guided:
        texts.append("second look")
    angles = (seen.pose.roll_deg, seen.pose.pitch_deg, seen.heading_deg)
    texts.append("roll {}°, pitch {}°, heading {}°".format(*(_signed(one, 1) for one in angles)))
    if seen.alternative is not None:
        ambiguity = seen.alternative.ambiguity
        texts.append(f"ambiguity {ambiguity:.{1 if ambiguity < 100.0 else 0}f}")
    if look.blur_px is not None:
        texts.append(f"blur {look.blur_px:.2f} px")
    if look.edge_shift_px is not None:
        texts.append(f"edge shift {_signed(look.edge_shift_px, 2)} px")
    texts.append(f"levels {look.black:.2f} … {look.white:.2f}")
    texts.append(f"clipped {100.0 * look.saturated:.0f}\xa0%")
    texts.append(f"score {seen.score:.2f}")
    if residual_percent is not None:
        texts.append(f"residuals {residual_percent:.1f}\xa0%")
    return texts


def _signed(value: float, digits: int) -> str:
    rounded = round(value, digits) + 0.0  # −0.00 would look like a finding
    return f"{rounded:.{digits}f}".replace("-", "−")


def _joined(*texts: str) -> str:
    return " · ".join(filter(None, texts))
