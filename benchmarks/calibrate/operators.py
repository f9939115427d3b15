"""Measuring methods of three programs on the same discs.

    python -m benchmarks.calibrate.operators

The methods are the grey-weighted centroid above a threshold (as in Australis), the target function
of Otepka & Fraser (2004), and kgcp's image model. Each measures the same rendered photographs of
dark and of bright discs. The output is the table of docs/method/discs.md: the RMS of the centre's
errors divided by the Cramér-Rao bound, and the mean error along the light's gradient [px], of dark
or of bright discs, whichever is larger.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence

from benchmarks.calibrate.operator import Outcome, Setup, measure
from benchmarks.pool import ordered_map
from kgcp.measurement.discs.records import Operator, Polarity
from kgcp.pipeline.execution.threads import use_one_thread_each

_RATIO = 0.8  # of the axes of the discs' images
_GRADIENT = 0.05  # relative change of the light over one radius
ROWS = {
    "linear, even light": ("linear", 0.0),
    "linear": ("linear", _GRADIENT),
    "sRGB": ("srgb", _GRADIENT),
    "white clipped, 1.5 times over": ("clipped", _GRADIENT),
    "film, curve unknown": ("unknown_film", _GRADIENT),
    "film, sharpened, JPEG": ("consumer", _GRADIENT),
}
"""Case and gradient by name of the row."""

_OPERATORS = (Operator.CENTROID, Operator.GAUSSIAN, Operator.MODEL)


def setups(radii: Sequence[float], photographs: int, seed: int) -> list[Setup]:
    """Return all setups: by row, radius and operator, for dark and for bright discs."""
    return [
        Setup(case, polarity, radius, _RATIO, photographs, operator, gradient, seed)
        for case, gradient in ROWS.values()
        for radius in radii
        for operator in _OPERATORS
        for polarity in Polarity
    ]


def cell(pair: Sequence[Outcome]) -> str:
    """Return RMS over bound of all discs, the larger bias, and n/m if only n of m are found."""
    found, present = sum(len(one.errors) for one in pair), sum(one.present for one in pair)
    if not found:
        return f"0/{present}"
    squares = [one.over_bound**2 * len(one.errors) for one in pair if len(one.errors)]
    text = f"{math.sqrt(sum(squares) / found):.2f}"
    if pair[0].setup.gradient:
        bias_px = max((one.bias_px for one in pair if len(one.errors)), key=abs)
        text = f"{text} ({bias_px:+.4f})"
    return text if found == present else f"{text} {found}/{present}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--radii", nargs="+", type=float, default=[5.0, 15.0])
    parser.add_argument(
        "--photographs", type=int, default=3, help="photographs of 20 discs, per polarity"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    outcomes = ordered_map(
        measure,
        setups(arguments.radii, arguments.photographs, arguments.seed),
        jobs=arguments.jobs,
        start=use_one_thread_each,
        start_arguments=(),
    )
    print("| camera | R px | centroid | Otepka & Fraser | kgcp |")
    print("|---|---|---|---|---|")
    for name in ROWS:
        for radius in arguments.radii:
            cells = []
            for _ in _OPERATORS:
                pair = [next(outcomes) for _ in Polarity]
                cells.append(cell(pair))
            print(f"| {name} | {radius:g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
