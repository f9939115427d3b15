"""The figure of a plan, as PNG or SVG, byte for byte the same for the same plan."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from kgcp.errors import SettingError
from kgcp.io.files.atomic import write_bytes
from kgcp.io.print.typeface import printable
from kgcp.report.style import BLUE, GREY, VERMILION, sheet
from kgcp.simulation.outlook import Outlook

_MAX_FINE_RATIO = 50.0  # of the standard deviations; above, only powers of ten are labelled
_LABEL_SHARE = 0.075  # width of the label of a height, as share of the axis
_MAX_TITLE_LETTERS = 48  # per line
_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
}


def check_figure_name(path: Path) -> None:
    """Refuse a figure that is neither PNG nor SVG.

    Raises
    ------
    SettingError
    """
    if path.suffix.lower() not in _METADATA:
        raise SettingError("plot", f"{path} is neither .png nor .svg", "give one of the two")


def write_plan_figure(outlooks: Sequence[Outlook], title: str, path: Path) -> None:
    """Draw distance, centre, detection and footprint against height.

    Raises
    ------
    KgcpError
        If the file is neither PNG nor SVG, or cannot be written.
    """
    check_figure_name(path)
    suffix = path.suffix.lower()
    stream = io.BytesIO()
    with sheet(9.6) as figure:
        panels = figure.subplots(4, 1, sharex=True)
        lines = textwrap.fill(printable(title), _MAX_TITLE_LETTERS)
        figure.suptitle(lines, fontsize=12, parse_math=False)  # names may have dollars
        for draw, axes in zip(
            (_draw_distance, _draw_centre, _draw_detection, _draw_footprint), panels, strict=True
        ):
            draw(axes, outlooks)
            axes.margins(x=0.09)
        lowest = panels[-1]
        lowest.set_xscale("log")
        lowest.set_xlabel("height above the target [m]")
        _number_heights(panels, outlooks)
        figure.savefig(stream, format=suffix[1:], metadata=_METADATA[suffix])
    write_bytes(path, stream.getvalue())


def _draw_distance(axes: Axes, outlooks: Sequence[Outlook]) -> None:
    points = [(o.height_m, 1e3 * o.sd_distance_m) for o in outlooks if o.sd_distance_m is not None]
    axes.plot(*_columns(points), "o-", color=BLUE, label="one frame")
    common = [
        (o.height_m, 1e3 * o.sd_common_distance_m)
        for o in outlooks
        if o.sd_common_distance_m is not None
    ]
    if common:
        axes.plot(*_columns(common), "s--", color=VERMILION, label="calibration and print")
        axes.legend(loc="upper left", fontsize=10)
    axes.set_yscale("log")
    axes.margins(y=0.15)
    is_wide = bool(points) and points[-1][1] > _MAX_FINE_RATIO * points[0][1]
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0,) if is_wide else (1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(_plain)
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel("sd of distance [mm]")


def _draw_centre(axes: Axes, outlooks: Sequence[Outlook]) -> None:
    points = [(o.height_m, o.sd_centre_px) for o in outlooks if o.sd_centre_px is not None]
    axes.plot(*_columns(points), "o-", color=BLUE)
    axes.margins(y=0.15)
    axes.set_ylim(bottom=0.0)
    axes.yaxis.set_major_formatter(_plain)
    axes.set_ylabel("sd of centre [px]")


def _draw_detection(axes: Axes, outlooks: Sequence[Outlook]) -> None:
    heights = [o.height_m for o in outlooks]
    rates = [100.0 * o.found for o in outlooks]
    below = [100.0 * (o.found - o.found_low) for o in outlooks]
    above = [100.0 * (o.found_high - o.found) for o in outlooks]
    axes.errorbar(heights, rates, yerr=(below, above), fmt="o", color=BLUE, ecolor=GREY, capsize=4)
    axes.set_ylim(-6.0, 107.0)
    axes.set_ylabel("found [%]")


def _draw_footprint(axes: Axes, outlooks: Sequence[Outlook]) -> None:
    """Draw the image's width and height on the ground, with the number of frames per pass."""
    heights = [o.height_m for o in outlooks]
    for side, style, label in ((0, "o-", "image width"), (1, "s--", "image height")):
        axes.plot(heights, [o.footprint_m[side] for o in outlooks], style, color=BLUE, label=label)
    for outlook in outlooks:
        axes.annotate(
            f"{outlook.frames_per_pass:.0f}",
            (outlook.height_m, outlook.footprint_m[1]),
            xytext=(0, -13),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            color=GREY,
        )
    largest = max(max(o.footprint_m) for o in outlooks)
    axes.set_ylim(-0.2 * largest, 1.75 * largest)
    axes.set_yticks([tick for tick in axes.get_yticks() if 0.0 <= tick <= 1.2 * largest])
    axes.set_ylabel("footprint [m]")
    axes.legend(loc="upper left", fontsize=10, ncols=2)
    words = "small numbers: frames per pass"
    axes.annotate(words, (0.02, 0.7), xycoords="axes fraction", fontsize=10, color=GREY)


def _number_heights(panels: Sequence[Axes], outlooks: Sequence[Outlook]) -> None:
    """Label the heights below the panels, and the sizes of a pixel on the ground above them."""
    heights = [outlook.height_m for outlook in outlooks]
    labelled = [height for i, height in enumerate(heights) if _is_free(heights, i)]
    lowest, highest = panels[-1], panels[0]
    lowest.set_xticks(labelled, labels=[f"{height:g}" for height in labelled])
    lowest.tick_params(axis="x", which="minor", length=0.0, labelbottom=False)
    gsd_per_m = outlooks[0].gsd_m / outlooks[0].height_m
    above = highest.secondary_xaxis("top")
    above.set_xticks(labelled, labels=[f"{1e3 * gsd_per_m * height:.2g}" for height in labelled])
    above.tick_params(axis="x", which="minor", length=0.0, labeltop=False)
    above.tick_params(axis="x", which="major", labelsize=10)
    above.set_xlabel("size of a pixel on the ground [mm]", fontsize=10)


def _is_free(heights: Sequence[float], index: int) -> bool:
    """Tell whether the label of a height does not overlap that of the height before."""
    span = math.log(heights[-1] / heights[0]) if len(heights) > 1 else 0.0
    before = heights[max(0, index - 1)]
    return index == 0 or math.log(heights[index] / before) > _LABEL_SHARE * span


def _plain(value: float, _: object) -> str:
    return f"{value:g}"


def _columns(pairs: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in pairs], [y for _, y in pairs]
