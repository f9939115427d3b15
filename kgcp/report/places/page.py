"""The report of placed targets as one self-contained HTML page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from kgcp.network.ground.target_places import Placement
from kgcp.quality.number_text import minus
from kgcp.quality.place_sentences import (
    diameter_sentence,
    has_other_diameter,
    lies_elsewhere,
    position_sentence,
)


@dataclass(frozen=True, slots=True, eq=False)
class PlacesPage:
    """All that the page shows."""

    name: str  # of the flight
    crs: str
    placement: Placement
    doubts: Sequence[str]
    figures: Mapping[str, bytes]  # PNG, by name
    files: Sequence[str]


def render_places(page: PlacesPage) -> str:
    """Return the page."""
    environment = Environment(
        # the shell is that of the bias report
        loader=ChoiceLoader(
            [PackageLoader("kgcp.report.places"), PackageLoader("kgcp.report.bias")]
        ),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    statements = [
        statement
        for placed in page.placement.targets
        for statement in (
            (diameter_sentence(placed), has_other_diameter(placed)),
            (position_sentence(placed), lies_elsewhere(placed)),
        )
    ]
    environment.filters["fixed"] = lambda value, digits: minus(f"{value:.{digits}f}")
    return environment.get_template("places.html").render(
        page=page,
        placement=page.placement,
        statements=statements,
        is_good=not page.doubts and not any(is_doubtful for _, is_doubtful in statements),
        images={
            name: f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"
            for name, png in page.figures.items()
        },
    )
