"""The figure of docs/aat_benefit.md."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.aat.settings import Control
from benchmarks.aat.table import Trials
from kgcp.geometry.arrays import FloatArray

# Okabe and Ito's palette: distinguishable for colour-blind readers and in grey print
_COLOURS = {
    Control.GNSS: "#D55E00",
    Control.GCPS: "#E69F00",
    Control.KGCPS: "#56B4E9",
    Control.DISTANCES: "#0072B2",
}
_COLOURS_IN_FILE = 64
_LABELS = {
    Control.GNSS: "GNSS only",
    Control.GCPS: "+ 2 classic\nGCPs",
    Control.KGCPS: "+ KGCPs",
    Control.DISTANCES: "+ KGCPs with\ndistances",
}
_STYLE = {
    "font.size": 11.0,
    "font.family": "DejaVu Sans",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "savefig.dpi": 110,
}


def draw_benefit(trials: Trials, checks_along_m: FloatArray) -> bytes:
    """Return the figure as PNG: height errors along the corridor, and their RMS by control.

    Parameters
    ----------
    checks_along_m : (c,) array
        Positions of the check points along the corridor.
    """
    with style.context(["default", _STYLE]):
        figure = Figure(figsize=(8.4, 8.0), layout="constrained")
        along, by_way = figure.subplots(2, 1)
        _draw_along(along, trials, checks_along_m)
        _draw_rms(by_way, trials)
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", metadata={"Software": None})
    light = io.BytesIO()
    Image.open(drawn).convert("RGB").quantize(_COLOURS_IN_FILE).save(light, "PNG", optimize=True)
    return light.getvalue()


def _draw_along(axes: Axes, trials: Trials, checks_along_m: FloatArray) -> None:
    for control in (Control.GNSS, Control.DISTANCES):
        for number, trial in enumerate(trials["free", control]):
            up_cm = 100.0 * trial.error_m[:, 2]
            axes.plot(
                checks_along_m,
                up_cm,
                color=_COLOURS[control],
                linewidth=1.0,
                alpha=0.8,
                label=None if number else _LABELS[control].replace("\n", " "),
            )
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_title("Heights of the check points, free calibration, one line per block", loc="left")
    axes.set_xlabel("along the corridor [m]")
    axes.set_ylabel("height error [cm]")
    axes.margins(y=0.15)
    axes.legend(loc="upper right", ncols=2, borderaxespad=0.0)


def _draw_rms(axes: Axes, trials: Trials) -> None:
    calibrations = list(dict.fromkeys(calibration for calibration, _ in trials))
    for place, control in enumerate(Control):
        for side, calibration in zip((-0.18, 0.18), calibrations, strict=True):
            some = trials[calibration, control]
            rms_cm = np.array([100.0 * trial.height_rms_m for trial in some])
            spread = np.linspace(-0.08, 0.08, len(rms_cm))
            filled = calibration == calibrations[0]
            axes.plot(
                place + side + spread,
                rms_cm,
                "o" if filled else "s",
                color=_COLOURS[control],
                markersize=5.0,
                markerfacecolor=_COLOURS[control] if filled else "white",
            )
            predicted = 100.0 * np.sqrt(np.mean([trial.variance_m2[:, 2] for trial in some]))
            axes.hlines(predicted, place + side - 0.13, place + side + 0.13, color="black")
            axes.text(place + side, 0.42, f"calibration\n{calibration}", ha="center", fontsize=8.0)
    axes.set_yscale("log")
    axes.set_ylim(0.35, 100.0)
    axes.set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    axes.set_xticks(range(len(Control)), [_LABELS[control] for control in Control])
    axes.set_title("RMS of the heights, one mark per block; bar: predicted", loc="left")
    axes.set_ylabel("height RMS [cm]")
