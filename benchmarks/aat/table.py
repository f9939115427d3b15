"""Summary of many adjusted blocks: errors, their ratio to the prediction, and the benefit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.aat.settings import Control
from kgcp.geometry.arrays import FloatArray

_UP = 2
_COLUMNS = (
    "calibration",
    "control",
    "RMS E / N / H [cm]",
    "predicted E / N / H [cm]",
    "scatter / predicted E / N / H",
    "of all together",
    "f: RMS (predicted) [px]",
    "GNSS only's H RMS / this, median",
)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Result of one block with one calibration and kind of control.

    Attributes
    ----------
    error_m : (c, 3) array
        Errors of the check points: east, north, up [m].
    cov_m2 : (3 c, 3 c) array
        Their covariance by the adjustment.
    """

    error_m: FloatArray
    cov_m2: FloatArray
    focal_error_px: float
    sd_focal_px: float

    @property
    def height_rms_m(self) -> float:
        """RMS of the height errors of the check points [m]."""
        return float(np.sqrt(np.mean(self.error_m[:, _UP] ** 2)))

    @property
    def variance_m2(self) -> FloatArray:
        """Predicted variances (c, 3)."""
        return np.diagonal(self.cov_m2).reshape(-1, 3)

    @property
    def mahalanobis2(self) -> float:
        """χ² of all errors by their joint covariance, divided by their number; ideally 1."""
        error_m = self.error_m.ravel()
        return float(error_m @ np.linalg.solve(self.cov_m2, error_m)) / len(error_m)


Trials = Mapping[tuple[str, Control], Sequence[Trial]]
"""Results by calibration and control, each in the order of the seeds."""


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """Summary of all blocks with one calibration and kind of control.

    Attributes
    ----------
    rms_m, predicted_m : (3,) arrays
        RMS of errors and of predicted standard deviations over all check points of all blocks:
        east, north, up [m].
    scatter : (3,) array
        RMS of the errors divided by their predicted standard deviations, ideally 1.
    sd_scatter : (3,) array
        Standard deviation of `scatter` for this number of blocks.
    whole_scatter : float
        The same for all errors of a block together, by their joint covariance.
    benefit : float
        Height RMS with GNSS only divided by that of this row: median over the blocks.
    """

    rms_m: FloatArray
    predicted_m: FloatArray
    scatter: FloatArray
    sd_scatter: FloatArray
    whole_scatter: float
    focal_rms_px: float
    focal_predicted_px: float
    benefit: float


def summarise(trials: Sequence[Trial], by_gnss: Sequence[Trial]) -> Row:
    """Summarise blocks; `by_gnss` are the same blocks with GNSS only."""
    errors = np.array([trial.error_m for trial in trials])
    variances = np.array([trial.variance_m2 for trial in trials])
    squares = np.mean(
        errors**2 / variances, axis=1
    )  # per block, since the errors of its points are correlated
    scatter = np.sqrt(squares.mean(axis=0))
    ratios = [
        alone.height_rms_m / trial.height_rms_m
        for alone, trial in zip(by_gnss, trials, strict=True)
    ]
    return Row(
        rms_m=np.sqrt(np.mean(errors**2, axis=(0, 1))),
        predicted_m=np.sqrt(np.mean(variances, axis=(0, 1))),
        scatter=scatter,
        sd_scatter=squares.std(axis=0) / (2.0 * scatter * math.sqrt(len(trials))),
        whole_scatter=math.sqrt(np.mean([trial.mahalanobis2 for trial in trials])),
        focal_rms_px=_rms([trial.focal_error_px for trial in trials]),
        focal_predicted_px=_rms([trial.sd_focal_px for trial in trials]),
        benefit=float(np.median(ratios)),
    )


def rows_of(trials: Trials) -> dict[tuple[str, Control], Row]:
    """Summarise every calibration and kind of control."""
    return {
        (calibration, control): summarise(some, trials[calibration, Control.GNSS])
        for (calibration, control), some in trials.items()
    }


def table_lines(rows: Mapping[tuple[str, Control], Row]) -> Iterator[str]:
    """Yield the table, as Markdown."""
    yield _line(_COLUMNS)
    yield _line(["---"] * len(_COLUMNS))
    for (calibration, control), row in rows.items():
        yield _line(
            (
                calibration,
                control.value,
                _three(100.0 * row.rms_m, 1),
                _three(100.0 * row.predicted_m, 1),
                f"{_three(row.scatter, 2)} (± {row.sd_scatter.max():.2f})",
                f"{row.whole_scatter:.2f}",
                f"{row.focal_rms_px:.2f} ({row.focal_predicted_px:.2f})",
                f"{row.benefit:.1f}",
            )
        )


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _three(values: FloatArray, digits: int) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in values)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
