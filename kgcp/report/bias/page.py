"""The bias report as one self-contained HTML page."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from markupsafe import Markup

from kgcp.geometry.arrays import FloatArray
from kgcp.io.tables.gcps import BIAS_COLUMNS
from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.exposure_effects import QUANTITIES
from kgcp.report.bias import wording
from kgcp.report.bias.numbers import BiasNumbers
from kgcp.report.bias.origin import Fact
from kgcp.report.bias.reexposure import Reexposed
from kgcp.report.bias.summary import Json, finite
from kgcp.report.bias.verdict import LIMITS, Verdict
from kgcp.report.html_page import embedded_pictures, page_template
from kgcp.report.ring_picture import CLOSEUP_PX
from kgcp.report.style import MARK_STEPS, Picture

_TITLES = {
    "error": "error against distance",
    "causes": "causes of the error",
    "rate": "detection rate",
    "exposure": "error against exposure",
    "edges": "one edge against two",
    "reexposure": "measured again",
    "standardised": "errors over their standard deviations",
    "worst": "largest residuals",
    "left-out": "excluded frames",
    "consistency": "vehicle and camera",
}
"""Texts of the links from findings to sections, by the ids of the sections."""
_DIGITS = 7  # significant, of the values in the page; bias.parquet has all


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """All that a page shows."""

    name: str  # of the flight
    headline: str  # program, day, camera, target, CRS
    facts: Sequence[Fact]  # inputs and settings
    agreement: str  # of vehicle and camera, in a sentence
    doubts: Sequence[Doubt]  # contradictions between the inputs, and changes of flight.toml
    numbers: BiasNumbers
    verdict: Verdict
    learnt: str  # sentences on the camera, estimated from the frames; may be empty
    # by the name of the figure; the page omits missing ones
    pictures: Mapping[str, Picture]
    rows: Sequence[Mapping[str, object]]  # of `bias.parquet`, one per measurement, in time
    # as `draw_closeup` returns them, by the row of the measurement
    closeups: Mapping[int, tuple[bytes, tuple[FloatArray, ...]]]
    reexposed: Sequence[Reexposed]
    summary: Json  # contents of `bias_summary.json`


def render_page(content: Content) -> str:
    """Return the page."""
    return page_template("bias_report.html").render(
        content=content,
        numbers=content.numbers,
        verdict=content.verdict,
        images=embedded_pictures({name: figure.png for name, figure in content.pictures.items()}),
        data=_embedded(_data(content)),
        limits=LIMITS,
        words=wording,
        titles=_TITLES,
    )


def _embedded(data: Json) -> Markup:
    """Return JSON that is safe in a script element, whatever names it contains."""
    text = json.dumps(finite(data), allow_nan=False, separators=(",", ":"))
    # already ASCII; without these three characters, no text can end the element or begin a comment
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # noqa: S704  it contains no markup any more


def _data(content: Content) -> Json:
    names = [column.name for column in BIAS_COLUMNS]
    return {
        "columns": {name: [_cell(row[name]) for row in content.rows] for name in names},
        "residuals": [
            _cell(residual) for residual in content.numbers.standardised_residuals.tolist()
        ],
        "labels": {quantity.name: quantity.label for quantity in QUANTITIES},
        "steps": MARK_STEPS,
        "pictures": {
            name: [figure.rows.tolist(), figure.places.ravel().tolist()]
            for name, figure in content.pictures.items()
            if figure.rows.size
        },
        "closeup_px": CLOSEUP_PX,
        "closeups": {
            str(row): {
                "jpeg": base64.b64encode(jpeg).decode("ascii"),
                "circles": [np.round(curve, 1).ravel().tolist() for curve in curves],
            }
            for row, (jpeg, curves) in content.closeups.items()
        },
        "summary": content.summary,
    }


def _cell(value: object) -> object:
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, datetime):
        return value.isoformat().replace("+00:00", "Z")
    return value
