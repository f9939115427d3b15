"""The bias report as one self-contained HTML page."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from kgcp.geometry.arrays import FloatArray
from kgcp.io.tables.gcps import BIAS_COLUMNS
from kgcp.quality.bias_study import Comparison
from kgcp.quality.exposure_effects import QUANTITIES
from kgcp.report.bias import wording
from kgcp.report.bias.closeups import Closeup
from kgcp.report.bias.numbers import BiasNumbers
from kgcp.report.bias.reexposure import Reexposed
from kgcp.report.bias.summary import Json, finite
from kgcp.report.bias.verdict import LIMITS, Verdict
from kgcp.report.style import MARK_STEPS, Picture

_DIGITS = 7  # significant, of the values in the page; bias.parquet has all


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """All that a page shows.

    Attributes
    ----------
    name : str
        Of the flight.
    numbers : BiasNumbers
    verdict : Verdict
    pictures : mapping of str to Picture
        By the name of the figure; one that is missing is left out of the page.
    rows : sequence of mapping
        Of `bias.parquet`, for the measurements in time.
    closeups : sequence of Closeup
    worst : sequence of int
        Rows of the largest deviations, the largest first.
    deviations : (n,) array
        What scale and offset leave of the errors, over its standard deviation.
    reexposed : sequence of Reexposed
    summary : mapping
        What `bias_summary.json` holds.
    """

    name: str
    numbers: BiasNumbers
    verdict: Verdict
    pictures: Mapping[str, Picture]
    rows: Sequence[Mapping[str, object]]
    closeups: Sequence[Closeup]
    worst: Sequence[int]
    deviations: FloatArray
    reexposed: Sequence[Reexposed]
    summary: Json


def render_page(content: Content) -> str:
    """Return the page."""
    environment = Environment(
        loader=PackageLoader("kgcp.report.bias"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["signed"] = _signed
    environment.filters["fixed"] = lambda value, digits: f"{value:.{digits}f}"
    images = {
        name: f"data:image/png;base64,{base64.b64encode(one.png).decode('ascii')}"
        for name, one in content.pictures.items()
    }
    template = environment.get_template("bias_report.html")
    return template.render(
        content=content,
        numbers=content.numbers,
        verdict=content.verdict,
        images=images,
        data=_embedded(_data(content)),
        limits=LIMITS,
        words=wording,
    )


def _signed(value: float, digits: int) -> str:
    return wording.minus(f"{value:+.{digits}f}")


def _embedded(data: Json) -> Markup:
    """Return JSON that may stand in a script element, whatever names it holds."""
    text = json.dumps(finite(data), allow_nan=False, separators=(",", ":"))
    # ASCII already; without these three no text can end the element or begin a comment
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # noqa: S704  nothing in it is markup any more


def _data(content: Content) -> Json:
    names = [column.name for column in BIAS_COLUMNS]
    return {
        "columns": {name: [_cell(row[name]) for row in content.rows] for name in names},
        "deviations": [_cell(one) for one in content.deviations.tolist()],
        "labels": {quantity.name: quantity.label for quantity in QUANTITIES},
        "steps": MARK_STEPS,
        "pictures": {
            name: [one.rows.tolist(), one.places.ravel().tolist()]
            for name, one in content.pictures.items()
            if one.rows.size
        },
        "closeups": {str(one.row): _closeup(one) for one in content.closeups},
        "summary": content.summary,
    }


def _cell(value: object) -> object:
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, datetime):
        return value.isoformat().replace("+00:00", "Z")
    return value


def _closeup(one: Closeup) -> Json:
    return {
        "width": one.width,
        "height": one.height,
        "jpeg": one.jpeg,
        "circles": [np.round(circle, 1).ravel().tolist() for circle in one.circles],
    }


def deviations_of(numbers: BiasNumbers) -> FloatArray:
    """Return what scale and offset leave of the errors (n,), over its standard deviation."""
    errors = numbers.data.errors
    left = numbers.residual_percent - numbers.explained_percent
    sd = 100.0 * np.sqrt(errors.total) / numbers.data.distance_m
    return np.asarray(left / sd)


def frames_of(compared: Sequence[Comparison]) -> list[str]:
    """Return the names of the frames."""
    return [one.attempt.frame for one in compared]
