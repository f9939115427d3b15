"""Names below the figures of placed targets."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from kgcp.report.places.figures import name_ticks
from kgcp.report.style import picture, sheet


@pytest.mark.parametrize(
    ("count", "name"),
    [
        (1, "a name that is far longer than anybody should choose one"),
        (4, "GCP-1"),
        (5, "WWWWW"),
        (10, "GCP-001"),
        (24, "a rather long name"),
        (300, "GCP-001"),
        (3, "地面点"),  # which the typeface lacks: a warning would be an error here
    ],
)
def test_names_neither_overlap_nor_leave_the_figure(count: int, name: str) -> None:
    with sheet(3.4) as figure:
        axes = figure.subplots()
        axes.plot(np.arange(count), np.zeros(count), "o")
        name_ticks(axes, np.arange(count), [name] * count)
        axes.set_xlim(-0.5, count - 0.5)
        picture(figure)
        boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
        height_px = axes.get_window_extent().height
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
        assert all(box.y0 >= 0.0 for box in boxes)
        assert figure.bbox.x0 <= boxes[0].x0
        assert boxes[-1].x1 <= figure.bbox.x1
        assert height_px > 0.4 * figure.bbox.height
