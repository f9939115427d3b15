"""Labels, marks and legends of the figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kgcp.report.bias.figures import change_by_reexposure, standardised_histogram
from kgcp.report.bias.reexposure import Reexposed
from kgcp.report.style import Picture, Points, picture


def panel_of(monkeypatch: pytest.MonkeyPatch, draw: Callable[[], Picture]) -> Axes:
    """Return the panel of a figure, as it is reexposure_panel."""
    axes: list[Axes] = []

    def keep(figure: Figure, points: Sequence[Points] = ()) -> Picture:
        shown = picture(figure, points)
        axes.extend(figure.axes)
        return shown

    monkeypatch.setattr("kgcp.report.bias.figures.picture", keep)
    draw()
    (panel,) = axes
    return panel


def reexposure_panel(monkeypatch: pytest.MonkeyPatch, results: Sequence[Reexposed]) -> Axes:
    """Return the panel of the changes by exposure."""
    return panel_of(monkeypatch, lambda: change_by_reexposure(results))


def reexposed(gain: float, radius_px: float, change_percent: float | None = 0.01) -> Reexposed:
    return Reexposed(0, gain, radius_px, change_percent, 0.02, 0.0)


@pytest.mark.parametrize("radii", [(22.0,), (33.0, 60.0), (17.0, 69.0), (9.0, 93.0)])
def test_radii_are_numbered_however_close_they_are(
    monkeypatch: pytest.MonkeyPatch, radii: tuple[float, ...]
) -> None:
    panel = reexposure_panel(
        monkeypatch, [reexposed(gain, radius) for radius in radii for gain in (0.6, 1.6)]
    )
    low, high = panel.get_xlim()
    labels = zip(panel.get_xticks(), panel.get_xticklabels(), strict=True)
    assert sum(low <= tick <= high and bool(label.get_text()) for tick, label in labels) >= 2


def test_the_legend_names_only_what_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    panel = reexposure_panel(monkeypatch, [reexposed(0.6, 22.0), reexposed(1.6, 22.0, None)])
    _, labels = panel.get_legend_handles_labels()
    assert sorted(labels) == ["grey × 0.6", "grey × 1.6: not measured"]


def test_darker_and_brighter_frames_have_different_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    panel = reexposure_panel(monkeypatch, [reexposed(0.6, 22.0), reexposed(1.6, 22.0)])
    markers = {line.get_marker() for line in panel.get_lines()}
    assert {"v", "^"} <= markers


def test_the_legend_of_the_histogram_is_above_its_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    data = SimpleNamespace(residual_m=np.full(5, 0.025), distance_m=np.full(5, 30.0))
    numbers: Any = SimpleNamespace(data=data, sd_m=np.full(5, 0.01), explained_percent=np.zeros(5))
    panel = panel_of(monkeypatch, lambda: standardised_histogram(numbers))
    figure = panel.get_figure()
    assert isinstance(figure, Figure)
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert box.y0 >= panel.get_window_extent().y1
    assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
