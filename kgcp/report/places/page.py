"""The report of placed targets as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from kgcp.network.ground.target_places import Placement
from kgcp.quality.place_sentences import (
    diameter_sentence,
    has_other_diameter,
    lies_elsewhere,
    position_sentence,
)
from kgcp.report.html_page import embedded_pictures, page_template


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
    statements = [
        statement
        for placed in page.placement.targets
        for statement in (
            (diameter_sentence(placed), has_other_diameter(placed)),
            (position_sentence(placed), lies_elsewhere(placed)),
        )
    ]
    stated = {sentence for sentence, _ in statements}
    return page_template("places.html").render(
        page=page,
        further_doubts=[doubt for doubt in page.doubts if doubt not in stated],
        placement=page.placement,
        statements=statements,
        is_good=not (page.doubts or page.placement.skipped)
        and not any(is_doubtful for _, is_doubtful in statements),
        images=embedded_pictures(page.figures),
    )
