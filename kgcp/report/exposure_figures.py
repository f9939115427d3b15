"""Figures of what exposure does: to residuals, to edges, and what it would do to one edge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from kgcp.bias.slopes import Slope
from kgcp.report.canvas import (
    BLUE,
    GREEN,
    GREY,
    VERMILION,
    Picture,
    Points,
    picture,
    scatter,
    sheet,
)
from kgcp.report.numbers import BiasNumbers, EdgeNumbers, Influence
from kgcp.report.reexpose import Reexposed

_CONFIDENCE = 1.96  # deviations: 95 %


def error_against_exposure(numbers: BiasNumbers) -> Picture:
    """Draw residual and δ against every exposure quantity that varies, with fitted slopes."""
    left = numbers.residual_percent - numbers.explained_percent
    shift = numbers.data.exposure["edge_shift_px"]
    displaced = [
        one
        for one in numbers.influences
        if numbers.is_displaced and one.quantity.name != "edge_shift_px"
    ]
    count = -(-(len(numbers.influences) + len(displaced)) // 2)
    with sheet(7.0, 2.7 * count) as figure:
        panels = iter(figure.subplots(count, 2, squeeze=False).ravel())
        points = []
        # pairs side by side, and δ, which has no partner, behind them
        for influence in (*displaced, *(one for one in numbers.influences if one not in displaced)):
            axes = next(panels)
            axes.axhline(0.0, color="black", linewidth=0.8)
            points.append(scatter(axes, influence.rows, influence.values, left[influence.rows]))
            _line(axes, influence, influence.residual)
            axes.set_ylabel("error [%]", fontsize=11)
            if influence not in displaced:
                continue
            axes = next(panels)
            known = np.isfinite(shift[influence.rows])
            rows, x = influence.rows[known], influence.values[known]
            points.append(scatter(axes, rows, x, shift[rows], None, GREEN))
            _line(axes, influence, influence.edge_shift)
            axes.set_ylabel("δ [px]", fontsize=11)
        for axes in panels:
            axes.set_visible(False)
        return picture(figure, points)


def _line(axes: Axes, influence: Influence, slope: Slope | None) -> None:
    """Draw a fitted line with its confidence, and name the abscissa."""
    axes.set_xlabel(influence.quantity.label, fontsize=11)
    axes.tick_params(labelsize=10)
    axes.locator_params(nbins=5)
    if slope is None:
        return
    x = np.linspace(influence.values.min(), influence.values.max(), 60)
    y, sd = slope.line(influence.quantity.measure(x))
    low, high = axes.get_ylim()
    axes.plot(x, y, color=VERMILION, linewidth=1.8)
    axes.fill_between(
        x,
        y - _CONFIDENCE * sd,
        y + _CONFIDENCE * sd,
        color=VERMILION,
        alpha=0.18,
        linewidth=0.0,
    )
    axes.set_ylim(low, high)


def one_edge_against_two(numbers: BiasNumbers, edges: EdgeNumbers) -> Picture:
    """Draw errors of the distances by one edge and by two, and their difference against δ."""
    rows = edges.rows
    distance = numbers.data.distance_m[rows]
    with sheet(7.0, 6.4) as figure:
        upper, lower = figure.subplots(2, 1)
        upper.axhline(0.0, color="black", linewidth=0.8)
        one, two = 100.0 * edges.one_m / distance, 100.0 * edges.two_m / distance
        both = np.concatenate((one, two))
        points = [
            scatter(upper, rows, distance, one, "one edge", VERMILION, "x", both),
            scatter(upper, rows, distance, two, "both edges", among=both),
        ]
        upper.set_xlabel("reference distance [m]")
        upper.set_ylabel("error [%]")
        upper.legend(loc="best", ncols=2)
        shift = numbers.data.exposure["edge_shift_px"][rows]
        points.append(scatter(lower, rows, shift, one - two, None, GREEN))
        lower.set_xlabel("edge shift δ [px]")
        lower.set_ylabel("one edge − both [%]")
        return picture(figure, points)


def change_by_reexposure(results: Sequence[Reexposed]) -> Picture:
    """Draw the paper's Figure 10: how distances move when grey values are multiplied."""
    gains = sorted({result.gain for result in results})
    colours = dict(zip(gains, (BLUE, VERMILION, GREEN, GREY), strict=False))
    with sheet(7.0, 4.2) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color="black", linewidth=0.8)
        points: list[Points] = []
        for gain in gains:
            kept = [one for one in results if one.gain == gain and one.change_percent is not None]
            lost = [one for one in results if one.gain == gain and one.change_percent is None]
            label = f"grey × {gain:g}"
            points.append(_changes(axes, kept, colours[gain], label))
            if lost:
                x = np.array([one.radius_px for one in lost])
                axes.plot(x, np.zeros(len(x)), "x", color=colours[gain], label=f"{label}: lost")
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:.0f}")
        axes.set_xlabel("radius of the ring [px]")
        axes.set_ylabel("change of distance [%]")
        axes.legend(loc="best")
        return picture(figure, [panel for panel in points if panel.rows.size])


def _changes(axes: Axes, kept: Sequence[Reexposed], colour: str, label: str) -> Points:
    x = np.array([one.radius_px for one in kept])
    y = np.array([one.change_percent for one in kept], dtype=np.float64)
    sd = np.array([one.sd_percent or 0.0 for one in kept])
    axes.errorbar(
        x, y, yerr=sd, fmt="o", color=colour, ecolor=colour, elinewidth=1.0, capsize=3, label=label
    )
    return Points(axes, np.array([one.row for one in kept], dtype=np.intp), x, y)
