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
    "causes": "what the error is made of",
    "rate": "detection rate",
    "exposure": "error against exposure",
    "edges": "one edge against two",
    "reexposure": "measured again",
    "standardised": "errors over their standard deviations",
    "worst": "largest residuals",
    "left-out": "what is left out",
}
"""Of the sections that findings lead to, by their ids."""
_DIGITS = 7  # significant, of the values in the page; bias.parquet has all


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """All that a page shows."""

    name: str  # of the flight
    headline: str  # program, day, camera, target, CRS
    facts: Sequence[Fact]  # what the report was made from
    agreement: str  # of vehicle and camera, in a sentence
    advice: Sequence[str]  # what to change in flight.toml
    doubts: Sequence[Doubt]  # what else does not fit
    numbers: BiasNumbers
    verdict: Verdict
    learnt: str  # of the camera, in sentences; empty: nothing
    # by the name of the figure; one that is missing is left out of the page
    pictures: Mapping[str, Picture]
    rows: Sequence[Mapping[str, object]]  # of `bias.parquet`, for the measurements in time
    # by the measurement's place in time, as `draw_closeup` returns them
    closeups: Mapping[int, tuple[bytes, tuple[FloatArray, ...]]]
    reexposed: Sequence[Reexposed]
    summary: Json  # what `bias_summary.json` holds


def render_page(content: Content) -> str:
    """Return the page."""
    return page_template("bias_report.html").render(
        content=content,
        numbers=content.numbers,
        verdict=content.verdict,
        images=embedded_pictures({name: each.png for name, each in content.pictures.items()}),
        data=_embedded(_data(content)),
        limits=LIMITS,
        words=wording,
        titles=_TITLES,
    )


def _embedded(data: Json) -> Markup:
    """Return JSON that is safe in a script element, whatever names it contains."""
    text = json.dumps(finite(data), allow_nan=False, separators=(",", ":"))
    # ASCII already; without these three no text can end the element or begin a comment
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # noqa: S704  nothing in it is markup any more


def _data(content: Content) -> Json:
    names = [column.name for column in BIAS_COLUMNS]
    return {
        "columns": {name: [_cell(row[name]) for row in content.rows] for name in names},
        "residuals": [_cell(each) for each in content.numbers.standardised_residuals.tolist()],
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
