"""Figures of the bias report: errors, detection rates, effects of exposure, and the camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.measurement.image_model.srgb import srgb_decoded
from kgcp.quality.learnt_imaging import LearntImaging
from kgcp.quality.statistics import Slope, moving_statistics
from kgcp.report.bias.numbers import BiasNumbers, DetectionRate, EdgeNumbers, Influence
from kgcp.report.bias.reexposure import Reexposed
from kgcp.report.style import BLUE, GREEN, GREY, VERMILION, Picture, Points, picture, scatter, sheet

WINDOW_M = 10.0  # of the paper's Figure 9
_SIGNED = "PuOr"  # orange and violet: distinct to all kinds of colour vision
_MIN_LOG_RATIO = 4.0  # of radii: a logarithmic axis then shows at least two powers of two
_BINS = [0.5 * step - 5.25 for step in range(22)]

_FULL_SCALE = 255.0  # of grey values
_GREY_BINS, _MIN_PER_BIN = 8, 3
_CONFIDENCE = 1.96  # standard deviations: 95 %


def draw_figures(
    numbers: BiasNumbers,
    camera: Camera,
    reexposed: Sequence[Reexposed],
    learnt: LearntImaging | None,
) -> Mapping[str, Picture]:
    """Return the figures for which there are numbers, by their names."""
    pictures = {"error": error_against_distance(numbers)}
    if learnt is not None:
        pictures["camera"] = learnt_camera(learnt)
    if numbers.expected_visible:
        pictures["rate"] = detection_rate(numbers)
    if numbers.influences:
        pictures["exposure"] = error_against_exposure(numbers)
    if numbers.edges is not None and numbers.is_displaced:
        pictures["edges"] = one_edge_against_two(numbers, numbers.edges)
    if reexposed:
        pictures["reexposure"] = change_by_reexposure(reexposed)
    if numbers.standardised is not None:
        pictures["standardised"] = standardised_histogram(numbers)
    pictures["time"] = error_in_time(numbers)
    pictures["image"] = error_over_image(numbers, camera)
    pictures["map"] = flight_map(numbers)
    return pictures


def error_against_distance(numbers: BiasNumbers) -> Picture:
    """Draw the paper's Figure 9: errors with moving mean and sd, in metres and percent."""
    distance = numbers.data.distance_m
    with sheet(6.2) as figure:
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
        figure.legend(*upper.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return picture(figure, [metres, percent])


def _errors(
    axes: Axes, numbers: BiasNumbers, error: FloatArray, sd: FloatArray, fitted: FloatArray
) -> Points:
    distance = numbers.data.distance_m
    moving = moving_statistics(distance, error, WINDOW_M)
    axes.axhline(0.0, color="black", linewidth=0.8)
    _band(axes, moving.centre, moving.mean, moving.sd, "± 1 sd")
    axes.plot(moving.centre, moving.mean, color=VERMILION, linewidth=2.0, label="mean, 10 m")
    is_stated = np.isfinite(sd)
    if is_stated.any():
        reported = moving_statistics(distance[is_stated], sd[is_stated], WINDOW_M)
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
    with sheet(5.4) as figure:
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
    """Draw errors over their reported standard deviations, and the normal distribution."""
    raw = numbers.data.residual_m / numbers.sd_m
    remaining = (numbers.data.residual_m - _systematic_m(numbers)) / numbers.sd_m
    with sheet(3.8) as figure:
        axes = figure.subplots()
        for values, colour, filled, label in (
            (raw, BLUE, True, "error / reported sd"),
            (remaining, VERMILION, False, "without scale and offset"),
        ):
            shown = np.clip(values[np.isfinite(values)], _BINS[0], _BINS[-1])
            share = np.full(len(shown), 1.0 / (len(shown) * 0.5))
            axes.hist(
                shown,
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
        axes.set_xlabel("error / reported standard deviation  (outer bins: and beyond)")
        axes.set_ylabel("density")
        drawn = axes.get_legend_handles_labels()
        figure.legend(*drawn, loc="outside upper center", ncols=3, columnspacing=1.0)
        return picture(figure)


def _systematic_m(numbers: BiasNumbers) -> FloatArray:
    return 0.01 * numbers.explained_percent * numbers.data.distance_m


def error_in_time(numbers: BiasNumbers) -> Picture:
    """Draw errors in metres over time, or in the order of frames if some have no time."""
    time_s = np.array([pair.attempt.time_s for pair in numbers.compared], dtype=np.float64)
    minutes, label = (time_s - time_s[0]) / 60.0, "time since the first measurement [min]"
    if not np.isfinite(time_s).all():
        minutes, label = np.arange(float(len(time_s))), "frames in order"
    with sheet(3.2) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color="black", linewidth=0.8)
        points = scatter(axes, np.arange(len(minutes)), minutes, numbers.data.residual_m)
        axes.set_xlabel(label)
        axes.set_ylabel("error [m]")
        return picture(figure, [points])


def error_over_image(numbers: BiasNumbers, camera: Camera) -> Picture:
    """Draw errors in percent where in the image they were measured."""
    measured = (pair.attempt.sighting for pair in numbers.compared)
    centre_px = np.array([sighting.centre_px for sighting in measured if sighting is not None])
    with sheet(0.8 + 3.9 * min(1.4, camera.height / camera.width)) as figure:
        axes = figure.subplots()
        axes.set_aspect("equal")
        points = _coloured(figure, axes, centre_px, numbers.residual_percent, "error [%]")
        axes.set_xlim(-0.5, camera.width - 0.5)
        axes.set_ylim(camera.height - 0.5, -0.5)
        axes.set_xlabel("x [px]")
        axes.set_ylabel("y [px]")
        return picture(figure, [points])


def flight_map(numbers: BiasNumbers) -> Picture:
    """Draw the positions of cameras and target, coloured by the error."""
    places = np.array([pair.target_m for pair in numbers.compared])
    cameras = np.array([pair.camera_m for pair in numbers.compared])
    with sheet(4.8) as figure:
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


def error_against_exposure(numbers: BiasNumbers) -> Picture:
    """Draw residual and δ against every exposure quantity that varies, with fitted slopes."""
    remaining = numbers.residual_percent - numbers.explained_percent
    shift = numbers.data.exposure["edge_shift_px"]
    displaced = [
        influence
        for influence in numbers.influences
        if numbers.is_displaced and influence.quantity.name != "edge_shift_px"
    ]
    count = -(-(len(numbers.influences) + len(displaced)) // 2)
    with sheet(2.3 * count) as figure:
        panels = iter(figure.subplots(count, 2, squeeze=False).ravel())
        points = []
        # error and δ side by side; panels of the error without one of δ follow
        alone = [influence for influence in numbers.influences if influence not in displaced]
        for influence in (*displaced, *alone):
            axes = next(panels)
            axes.axhline(0.0, color="black", linewidth=0.8)
            points.append(
                scatter(axes, influence.rows, influence.values, remaining[influence.rows])
            )
            _line(axes, influence, influence.residual)
            axes.set_ylabel("error [%]", fontsize=11)
            if influence not in displaced:
                continue
            axes = next(panels)
            has_shift = np.isfinite(shift[influence.rows])
            rows, x = influence.rows[has_shift], influence.values[has_shift]
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
    axes.locator_params(nbins=4)
    axes.locator_params(axis="x", nbins=3)
    if slope is None:
        return
    x = np.linspace(influence.values.min(), influence.values.max(), 60)
    y, sd = slope.line(influence.quantity.measure(x))
    low, high = axes.get_ylim()
    axes.plot(x, y, color=VERMILION, linewidth=1.8)
    _band(axes, x, y, _CONFIDENCE * sd)
    axes.set_ylim(low, high)


def _band(
    axes: Axes, x: FloatArray, middle: FloatArray, half: FloatArray, label: str | None = None
) -> None:
    low, high = middle - half, middle + half
    axes.fill_between(x, low, high, color=VERMILION, alpha=0.18, linewidth=0.0, label=label)


def one_edge_against_two(numbers: BiasNumbers, edges: EdgeNumbers) -> Picture:
    """Draw errors of the distances by one edge and by two, and their difference against δ."""
    rows = edges.rows
    distance = numbers.data.distance_m[rows]
    with sheet(5.6) as figure:
        upper, lower = figure.subplots(2, 1)
        upper.axhline(0.0, color="black", linewidth=0.8)
        by_one = 100.0 * edges.outer_edge_m / distance
        by_two = 100.0 * edges.both_edges_m / distance
        both = np.concatenate((by_one, by_two))
        points = [
            scatter(upper, rows, distance, by_one, "one edge", VERMILION, "x", both),
            scatter(upper, rows, distance, by_two, "both edges", among=both),
        ]
        upper.set_xlabel("reference distance [m]")
        upper.set_ylabel("error [%]")
        upper.legend(loc="best", ncols=2)
        shift = numbers.data.exposure["edge_shift_px"][rows]
        points.append(scatter(lower, rows, shift, by_one - by_two, None, GREEN))
        lower.set_xlabel("edge shift δ [px]")
        lower.set_ylabel("one edge − both [%]")
        return picture(figure, points)


def change_by_reexposure(results: Sequence[Reexposed]) -> Picture:
    """Draw the paper's Figure 10: changes of distances when grey values are multiplied."""
    gains = sorted({result.gain for result in results})
    colours = dict(zip(gains, (BLUE, VERMILION, GREEN, GREY), strict=False))
    with sheet(3.8) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color="black", linewidth=0.8)
        points: list[Points] = []
        for gain in gains:
            of_gain = [result for result in results if result.gain == gain]
            measured = [result for result in of_gain if result.change_percent is not None]
            failed = [result for result in of_gain if result.change_percent is None]
            label = f"grey × {gain:g}"
            if measured:
                marker = "v" if gain < 1.0 else "^"  # both stay visible where changes agree
                points.append(_changes(axes, measured, colours[gain], marker, label))
            if failed:
                x = np.array([result.radius_px for result in failed])
                axes.plot(
                    x, np.zeros(len(x)), "x", color=colours[gain], label=f"{label}: not measured"
                )
        radii = [result.radius_px for result in results]
        if max(radii) > _MIN_LOG_RATIO * min(radii):
            axes.set_xscale("log", base=2)
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:.0f}")
        axes.set_xlabel("radius of the ring [px]")
        axes.set_ylabel("change of distance [%]")
        axes.legend(loc="best")
        return picture(figure, points)


def _changes(
    axes: Axes, measured: Sequence[Reexposed], colour: str, marker: str, label: str
) -> Points:
    x = np.array([result.radius_px for result in measured])
    y = np.array([result.change_percent for result in measured], dtype=np.float64)
    sd = np.array([result.sd_percent or 0.0 for result in measured])
    axes.errorbar(x, y, yerr=sd, fmt=marker, color=colour, elinewidth=1.0, capsize=3, label=label)
    return Points(axes, np.array([result.row for result in measured], dtype=np.intp), x, y)


def learnt_camera(learnt: LearntImaging) -> Picture:
    """Draw light against grey value, and the noise of grey values, both with their scatter."""
    with sheet(6.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        _draw_curve(upper, learnt)
        _draw_noise(lower, learnt)
        lower.set_xlabel("grey value (0 … 255)")
        figure.legend(*upper.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return picture(figure)


def _draw_curve(axes: Axes, learnt: LearntImaging) -> None:
    grey, (low, middle, high) = _FULL_SCALE * learnt.grey, learnt.light
    axes.plot(grey, srgb_decoded(learnt.grey), "--", color=GREY, linewidth=1.4, label="sRGB")
    axes.fill_between(grey, low, high, color=VERMILION, alpha=0.25, linewidth=0.0, label="± 1 sd")
    axes.plot(grey, middle, color=VERMILION, linewidth=2.0, label="estimated")
    axes.set_ylabel("light")


def _draw_noise(axes: Axes, learnt: LearntImaging) -> None:
    grey, sd = (_FULL_SCALE * learnt.noise).T
    axes.plot(grey, sd, ".", color=BLUE, alpha=0.6)
    edges = np.linspace(0.0, _FULL_SCALE, _GREY_BINS + 1)
    middles, medians = [], []
    for first, last in pairwise(edges):
        within = (grey >= first) & (grey < last)
        if within.sum() >= _MIN_PER_BIN:
            middles.append(0.5 * (first + last))
            medians.append(float(np.median(sd[within])))
    axes.plot(middles, medians, color=VERMILION, linewidth=2.0)
    axes.set_ylabel("noise [grey values]")
    axes.set_ylim(bottom=0.0)
