"""Figures of the bias report, as PNG: byte for byte the same for the same numbers."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kgcp.bias.statistics import moving_statistics
from kgcp.geometry.arrays import FloatArray
from kgcp.report.numbers import DetectionRate, Influence

WINDOW_M = 10.0  # of the paper's Figure 9

# Okabe and Ito's palette, told apart by colour-blind readers and in grey print
_BLUE, _VERMILION, _GREY = "#0072B2", "#D55E00", "#666666"
_STYLE = {
    "font.size": 12.0,
    "font.family": "DejaVu Sans",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "savefig.dpi": 150,
}


def error_against_distance(
    distance_m: FloatArray, residual_m: FloatArray, residual_percent: FloatArray
) -> bytes:
    """Draw the paper's Figure 9: errors with moving mean and deviation, in metres and percent."""
    with _page(7.0, 7.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        _errors(upper, distance_m, residual_m, "error [m]")
        _errors(lower, distance_m, residual_percent, "error [% of distance]")
        lower.set_xlabel("reference distance [m]")
        upper.legend(loc="upper left", fontsize=10, ncols=3, borderaxespad=0.0)
        upper.margins(y=0.18)
        return _png(figure)


def _errors(axes: Axes, distance_m: FloatArray, error: FloatArray, label: str) -> None:
    moving = moving_statistics(distance_m, error, WINDOW_M)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.fill_between(
        moving.centre,
        moving.mean - moving.sd,
        moving.mean + moving.sd,
        color=_VERMILION,
        alpha=0.18,
        linewidth=0.0,
        label="± 1 sd",
    )
    axes.plot(moving.centre, moving.mean, color=_VERMILION, linewidth=2.0, label="mean, 10 m")
    axes.plot(distance_m, error, "o", color=_BLUE, markersize=4, alpha=0.7, label="frame")
    axes.set_ylabel(label)


def detection_rate(rates: Sequence[DetectionRate]) -> bytes:
    """Draw the paper's Figure 8: detection rate per distance with 95 % intervals."""
    with _page(7.0, 4.4) as figure:
        axes = figure.subplots()
        centre = np.array([0.5 * (rate.low_m + rate.high_m) for rate in rates])
        value = np.array([rate.rate for rate in rates])
        below = value - [rate.confidence_low for rate in rates]
        above = [rate.confidence_high for rate in rates] - value
        axes.errorbar(
            centre,
            100.0 * value,
            yerr=100.0 * np.maximum(np.vstack((below, above)), 0.0),
            fmt="o",
            color=_BLUE,
            ecolor=_GREY,
            elinewidth=1.5,
            capsize=4,
            markersize=7,
        )
        for rate, x in zip(rates, centre, strict=True):
            axes.annotate(
                f"{rate.frames}",
                (x, 0.0),
                xytext=(0, 3),
                textcoords="offset points",
                ha="center",
                fontsize=9,
                color=_GREY,
            )
        axes.set_ylim(0.0, 105.0)
        axes.set_xlabel("reference distance [m]  (small numbers: frames)")
        axes.set_ylabel("detected [%]")
        return _png(figure)


def error_against_exposure(influences: Sequence[Influence]) -> bytes:
    """Draw the residual against every exposure quantity that varies, one panel each."""
    columns = 2
    rows = -(-len(influences) // columns)
    with _page(7.0, 2.9 * rows) as figure:
        panels = np.ravel(figure.subplots(rows, columns, sharey=True, squeeze=False))
        for axes, influence in zip(panels, influences, strict=False):
            axes.axhline(0.0, color="black", linewidth=0.8)
            axes.plot(
                influence.values,
                influence.residual_percent,
                "o",
                color=_BLUE,
                markersize=4,
                alpha=0.7,
            )
            axes.set_xlabel(influence.label, fontsize=11)
            axes.locator_params(axis="x", nbins=5)
        for axes in panels[len(influences) :]:
            axes.set_visible(False)
        for axes in panels[::columns]:
            axes.set_ylabel("error [%]")
        return _png(figure)


@contextmanager
def _page(width_in: float, height_in: float) -> Iterator[Figure]:
    with style.context(["default", _STYLE]):  # whatever the user's matplotlibrc says
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
