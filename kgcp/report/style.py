"""Common parts of all figures: style, PNG bytes, and the positions of their points."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kgcp.geometry.arrays import FloatArray, IndexArray

# Okabe and Ito's palette: distinct for colour-blind readers and in grey print
BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
MARK_STEPS = 10_000  # of a picture's width and height
_DPI = 180
_WIDTH_IN = 5.6  # letters of 12 pt have 10.5 px on a telephone that is 390 px wide
_MAX_LARGE = 400  # points that are drawn large; more are drawn small
_MAX_DEVIATION = 8.0  # robust standard deviations; points farther off are drawn at the border
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
    "legend.fontsize": 10.0,
    "savefig.dpi": _DPI,
    "svg.hashsalt": "kgcp",  # identifiers of the same figure are the same
}


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Measurements drawn in one panel."""

    axes: Axes
    rows: IndexArray  # (m,): numbers of the measurements, in the order of time
    # (m,): in the panel's coordinates
    x: FloatArray
    y: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A figure as a file, with the places of its points."""

    png: bytes
    rows: IndexArray  # (m,): numbers of the drawn measurements; one may be in several panels
    # (m, 2): their places from the picture's left and top, in 1/`MARK_STEPS` of width and height
    places: IndexArray


@contextmanager
def sheet(height_in: float) -> Iterator[Figure]:
    """Yield an empty figure in kgcp's style, whatever the user's matplotlibrc says."""
    with style.context(["default", _STYLE]):
        yield Figure(figsize=(_WIDTH_IN, height_in), dpi=_DPI, layout="constrained")


def picture(figure: Figure, points: Sequence[Points] = ()) -> Picture:
    """Draw a figure: byte for byte the same for the same numbers."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    size = np.array([figure.bbox.width, figure.bbox.height])
    rows = [np.zeros(0, dtype=np.intp)]
    places = [np.zeros((0, 2))]
    for panel in points:
        shown = panel.axes.transData.transform(np.column_stack((panel.x, panel.y))) / size
        rows.append(panel.rows)
        places.append(np.column_stack((shown[:, 0], 1.0 - shown[:, 1])))
    steps = np.rint(MARK_STEPS * np.concatenate(places)).astype(np.intp)
    return Picture(stream.getvalue(), np.concatenate(rows), steps)


def scatter(
    axes: Axes,
    rows: IndexArray,
    x: FloatArray,
    y: FloatArray,
    label: str | None = None,
    colour: str = BLUE,
    marker: str = "o",
    among: FloatArray | None = None,
) -> Points:
    """Draw measurements; those far from all others are drawn at the border, as triangles.

    The limits follow from `y`, or from `among` (m,) if several kinds share a panel.
    """
    low, high = _limits(y if among is None else among)
    shown = np.clip(y, low, high)
    size = 4.0 if len(y) <= _MAX_LARGE else 2.0
    inside = shown == y
    axes.plot(x[inside], y[inside], marker, color=colour, markersize=size, alpha=0.7, label=label)
    for beyond, triangle in ((y > high, "^"), (y < low, "v")):
        axes.plot(x[beyond], shown[beyond], triangle, color=colour, markersize=6.0)
    return Points(axes, rows, x, shown)


def _limits(values: FloatArray) -> tuple[float, float]:
    middle = float(np.median(values))
    spread = float(np.median(np.abs(values - middle))) / 0.6745
    if spread == 0.0:
        return float(values.min()), float(values.max())
    near = values[np.abs(values - middle) <= _MAX_DEVIATION * spread]
    margin = 0.15 * float(np.ptp(near))
    low, high = float(values.min()), float(values.max())
    return max(low, near.min() - margin), min(high, near.max() + margin)
