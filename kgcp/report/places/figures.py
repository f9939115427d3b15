"""Figures of the report of placed targets."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.io.print.typeface import printable
from kgcp.network.ground.target_places import PlacedTarget
from kgcp.report.style import BLUE, GREEN, GREY, VERMILION, Picture, picture, sheet

_COLOURS = {"x": BLUE, "y": VERMILION, "z": GREEN}
_EXPECTED_CHI2 = 5.0  # of the five numbers of a frame
_MM = 1e3
_MAX_NAME_LETTERS = 16  # longer names are cut; the page's tables have them in full
_MAX_LINE_LETTERS = 26  # of horizontal names; more letters are written upright
_MAX_NAMES = 25  # that fit side by side upright


def draw_places(placed: tuple[PlacedTarget, ...]) -> dict[str, bytes]:
    """Return the figures of the page by their names, as PNG."""
    figures = {"diameters": _diameters(placed), "frames": _frames(placed)}
    if any(target.check.residual_m is not None for target in placed):
        figures["positions"] = _positions(placed)
    return {name: figure.png for name, figure in figures.items()}


def _diameters(placed: tuple[PlacedTarget, ...]) -> Picture:
    """Draw the diameters' residuals with two standard deviations."""
    places = np.arange(len(placed))
    differences = [target.check.diameter_permille for target in placed]
    sd = [
        1e3 * target.check.sd_diameter_residual_m / target.check.stated_diameter_m
        for target in placed
    ]
    with sheet(3.4) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.errorbar(
            places, differences, yerr=2.0 * np.array(sd), fmt="o", color=BLUE, capsize=4.0
        )
        name_ticks(axes, places, [target.target for target in placed])
        axes.set_xlim(-0.5, len(placed) - 0.5)
        axes.set_ylabel("diameter: measured − stated [‰]")
        return picture(figure)


def _shortened(name: str) -> str:
    return printable(
        name if len(name) <= _MAX_NAME_LETTERS else f"{name[: _MAX_NAME_LETTERS - 1]}…"
    )


def name_ticks(axes: Axes, places: FloatArray | IndexArray, names: list[str]) -> None:
    """Write names below their places: upright if they fill the line, some if they are many."""
    shown = slice(None, None, math.ceil(len(names) / _MAX_NAMES))
    texts = [_shortened(name) for name in names[shown]]
    is_upright = max(map(len, texts)) * len(texts) > _MAX_LINE_LETTERS
    rotation = 90.0 if is_upright else 0.0
    axes.set_xticks(places[shown], texts, parse_math=False, rotation=rotation)  # may have dollars


def _positions(placed: tuple[PlacedTarget, ...]) -> Picture:
    """Draw the positions' residuals with two standard deviations."""
    stated = [target for target in placed if target.check.residual_m is not None]
    with sheet(3.8) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color="black", linewidth=0.8)
        for index, (name, colour) in enumerate(_COLOURS.items()):
            differences = np.array([_residual_mm(target, index) for target in stated])
            sd = np.array([_sd_mm(target, index) for target in stated])
            places = np.arange(len(stated)) + 0.2 * (index - 1)
            axes.errorbar(
                places, differences, yerr=2.0 * sd, fmt="o", color=colour, capsize=4.0, label=name
            )
        name_ticks(axes, np.arange(len(stated)), [target.target for target in stated])
        axes.set_xlim(-0.5, len(stated) - 0.5)
        axes.set_ylabel("position: measured − stated [mm]")
        axes.legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
        return picture(figure)


def _residual_mm(target: PlacedTarget, axis: int) -> float:
    residual = target.check.residual_m
    return float("nan") if residual is None else _MM * float(residual[axis])


def _sd_mm(target: PlacedTarget, axis: int) -> float:
    cov = target.check.cov_m2
    return float("nan") if cov is None else _MM * float(np.sqrt(cov[axis, axis]))


def _frames(placed: tuple[PlacedTarget, ...]) -> Picture:
    """Draw how well every frame fits, target by target."""
    with sheet(3.8) as figure:
        axes = figure.subplots()
        axes.axhline(_EXPECTED_CHI2, color=GREY, linewidth=0.8, label="expected")
        first, middles = 0, []
        for target in placed:
            rows = first + np.arange(len(target.frames))
            used, chi2 = target.is_used, np.maximum(target.chi2, 1e-3)
            axes.plot(rows[used], chi2[used], "o", color=BLUE, markersize=3.5)
            axes.plot(rows[~used], chi2[~used], "x", color=VERMILION, markersize=7.0)
            middles.append(rows.mean())
            first += len(rows) + 1
        axes.set_yscale("log")
        name_ticks(axes, np.array(middles), [target.target for target in placed])
        axes.set_xlabel("frames, target by target (×: excluded)")
        axes.set_ylabel("χ² of 5 numbers")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))
        return picture(figure)
