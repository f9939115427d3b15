"""A plan's figure, as PNG or SVG: byte for byte the same for the same plan."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes

from kgcp.errors import SettingError
from kgcp.io.files.atomic import write_bytes
from kgcp.report.style import BLUE, GREY, VERMILION, sheet
from kgcp.simulation.outlook import Outlook

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
    """Draw distance, centre and detection against height.

    Raises
    ------
    KgcpError
        If the file is neither PNG nor SVG, or cannot be written.
    """
    check_figure_name(path)
    suffix = path.suffix.lower()
    stream = io.BytesIO()
    with sheet(8.0) as figure:
        distance, centre, detection = figure.subplots(3, 1, sharex=True)
        figure.suptitle(title, fontsize=12)
        _draw_distance(distance, outlooks)
        _draw_centre(centre, outlooks)
        _draw_found(detection, outlooks)
        detection.set_xscale("log")
        detection.set_xlabel("height above the target [m]")
        heights = [outlook.height_m for outlook in outlooks]
        detection.set_xticks(heights, labels=[f"{height:g}" for height in heights])
        detection.tick_params(axis="x", which="minor", length=0.0, labelbottom=False)
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
    axes.set_ylabel("sd of distance [mm]")


def _draw_centre(axes: Axes, outlooks: Sequence[Outlook]) -> None:
    points = [(o.height_m, o.sd_centre_px) for o in outlooks if o.sd_centre_px is not None]
    axes.plot(*_columns(points), "o-", color=BLUE)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("sd of centre per axis [px]")


def _draw_found(axes: Axes, outlooks: Sequence[Outlook]) -> None:
    heights = [o.height_m for o in outlooks]
    rates = [100.0 * o.found for o in outlooks]
    below = [100.0 * (o.found - o.found_low) for o in outlooks]
    above = [100.0 * (o.found_high - o.found) for o in outlooks]
    axes.errorbar(heights, rates, yerr=(below, above), fmt="o", color=BLUE, ecolor=GREY, capsize=4)
    axes.set_ylim(0.0, 105.0)
    axes.set_ylabel("found [%]")


def _columns(pairs: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in pairs], [y for _, y in pairs]
