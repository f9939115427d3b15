"""Figures of residuals: against distance, in time, over the image and on the ground; rates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from kgcp.bias.statistics import moving_statistics
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
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
from kgcp.report.numbers import BiasNumbers
from kgcp.report.ranges import DetectionRate

WINDOW_M = 10.0  # of the paper's Figure 9
_SIGNED = "PuOr"  # orange and violet: told apart whatever one's colour vision
_BINS = [0.5 * step - 5.25 for step in range(22)]


def error_against_distance(numbers: BiasNumbers) -> Picture:
    """Draw the paper's Figure 9: errors with moving mean and deviation, in metres and percent."""
    distance = numbers.data.distance_m
    with sheet(7.0, 7.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        metres = _errors(
            upper, numbers, numbers.data.residual_m, numbers.sd_m, _systematic_m(numbers)
        )
        sd_percent = 100.0 * numbers.sd_m / distance
        percent = _errors(
            lower, numbers, numbers.residual_percent, sd_percent, numbers.explained_percent
        )
        upper.set_ylabel("error [m]")
        lower.set_ylabel("error [% of distance]")
        lower.set_xlabel("reference distance [m]")
        figure.legend(*upper.get_legend_handles_labels(), loc="outside upper center", ncols=5)
        return picture(figure, [metres, percent])


def _errors(
    axes: Axes, numbers: BiasNumbers, error: FloatArray, sd: FloatArray, fitted: FloatArray
) -> Points:
    distance = numbers.data.distance_m
    moving = moving_statistics(distance, error, WINDOW_M)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.fill_between(
        moving.centre,
        moving.mean - moving.sd,
        moving.mean + moving.sd,
        color=VERMILION,
        alpha=0.18,
        linewidth=0.0,
        label="± 1 sd",
    )
    axes.plot(moving.centre, moving.mean, color=VERMILION, linewidth=2.0, label="mean, 10 m")
    known = np.isfinite(sd)
    if known.any():
        reported = moving_statistics(distance[known], sd[known], WINDOW_M)
        for sign, label in ((1.0, "reported ± 1 sd"), (-1.0, None)):
            axes.plot(
                reported.centre, sign * reported.mean, "--", color=GREY, linewidth=1.4, label=label
            )
    points = scatter(axes, np.arange(len(error)), distance, error, "frame")
    if numbers.regression is not None:
        order = np.argsort(distance)
        axes.plot(distance[order], fitted[order], color=GREEN, linewidth=1.6, label="fitted")
    return points


def detection_rate(numbers: BiasNumbers) -> Picture:
    """Draw the paper's Figure 8: detection rate, with 95 % intervals."""
    with sheet(7.0, 6.4) as figure:
        upper, lower = figure.subplots(2, 1)
        _rates(upper, numbers.rates, [0.5 * (rate.low + rate.high) for rate in numbers.rates])
        upper.set_xlabel("reference distance [m]  (small numbers: frames)")
        radii = [float(np.sqrt(rate.low * rate.high)) for rate in numbers.radius_rates]
        _rates(lower, numbers.radius_rates, radii)
        lower.set_xscale("log", base=2)
        lower.set_xticks(radii, [f"{radius:.0f}" for radius in radii])
        lower.minorticks_off()
        lower.set_xlabel("radius of the ring by the reference [px]")
        return picture(figure)


def _rates(axes: Axes, rates: Sequence[DetectionRate], centre: Sequence[float]) -> None:
    value = np.array([rate.rate for rate in rates])
    below = value - [rate.confidence_low for rate in rates]
    above = [rate.confidence_high for rate in rates] - value
    axes.errorbar(
        centre,
        100.0 * value,
        yerr=100.0 * np.maximum(np.vstack((below, above)), 0.0),
        fmt="o",
        color=BLUE,
        ecolor=GREY,
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
            color=GREY,
        )
    axes.set_ylim(0.0, 105.0)
    axes.set_ylabel("detected [%]")


def standardised_histogram(numbers: BiasNumbers) -> Picture:
    """Draw residuals over their reported deviations against the normal distribution."""
    raw = numbers.standardised_residuals
    left = (numbers.data.residual_m - _systematic_m(numbers)) / numbers.sd_m
    with sheet(7.0, 4.0) as figure:
        axes = figure.subplots()
        for values, colour, filled, label in (
            (raw, BLUE, True, "error / reported sd"),
            (left, VERMILION, False, "without scale and offset"),
        ):
            known = np.clip(values[np.isfinite(values)], _BINS[0], _BINS[-1])
            share = np.full(len(known), 1.0 / (len(known) * 0.5))
            axes.hist(
                known,
                bins=_BINS,
                weights=share,
                histtype="stepfilled" if filled else "step",
                color=colour,
                alpha=0.35 if filled else 1.0,
                linewidth=2.0,
                label=label,
            )
        x = np.linspace(-5.0, 5.0, 201)
        normal = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
        axes.plot(x, normal, "--", color="black", linewidth=1.5, label="normal, sd 1")
        axes.set_xlabel("error / reported standard deviation  (ends: and beyond)")
        axes.set_ylabel("density")
        axes.legend(loc="upper right")
        return picture(figure)


def _systematic_m(numbers: BiasNumbers) -> FloatArray:
    return 0.01 * numbers.explained_percent * numbers.data.distance_m


def error_in_time(numbers: BiasNumbers, minutes: FloatArray, label: str) -> Picture:
    """Draw errors in metres in the order of time (n,)."""
    with sheet(7.0, 3.6) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color="black", linewidth=0.8)
        points = scatter(axes, np.arange(len(minutes)), minutes, numbers.data.residual_m)
        axes.set_xlabel(label)
        axes.set_ylabel("error [m]")
        return picture(figure, [points])


def error_over_image(numbers: BiasNumbers, centre_px: FloatArray, camera: Camera) -> Picture:
    """Draw errors in percent where in the image (n, 2) they were measured."""
    with sheet(7.0, 0.8 + 5.1 * min(1.4, camera.height / camera.width)) as figure:
        axes = figure.subplots()
        axes.set_aspect("equal")
        points = _coloured(figure, axes, centre_px, numbers.residual_percent, "error [%]")
        axes.set_xlim(-0.5, camera.width - 0.5)
        axes.set_ylim(camera.height - 0.5, -0.5)
        axes.set_xlabel("x [px]")
        axes.set_ylabel("y [px]")
        return picture(figure, [points])


def flight_map(numbers: BiasNumbers) -> Picture:
    """Draw where the cameras were, and where the target was, coloured by the error."""
    places = np.array([one.place_m for one in numbers.compared])
    cameras = np.array([one.camera_m for one in numbers.compared])
    with sheet(7.0, 6.0) as figure:
        axes = figure.subplots()
        axes.set_aspect("equal", adjustable="datalim")
        sights = np.stack((cameras, places, np.full_like(places, np.nan)), axis=1).reshape(-1, 3)
        axes.plot(*sights[:, :2].T, color="#cccccc", linewidth=0.5)
        axes.plot(*cameras[:, :2].T, "+", color=GREY, markersize=5, label="camera")
        points = _coloured(figure, axes, places, numbers.data.residual_m, "error [m]")
        axes.set_xlabel("east [m]")
        axes.set_ylabel("north [m]")
        axes.legend(loc="best")
        return picture(figure, [points])


def _coloured(
    figure: Figure, axes: Axes, places: FloatArray, error: FloatArray, label: str
) -> Points:
    largest = float(np.quantile(np.abs(error), 0.98)) or 1.0
    drawn = axes.scatter(
        places[:, 0],
        places[:, 1],
        c=np.clip(error, -largest, largest),
        s=np.clip(14.0 + 40.0 * np.abs(error) / largest, 14.0, 54.0),
        cmap=_SIGNED,
        norm=TwoSlopeNorm(0.0, -largest, largest),
        edgecolors=GREY,
        linewidths=0.5,
    )
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.85)
    return Points(axes, np.arange(len(error)), places[:, 0], places[:, 1])
