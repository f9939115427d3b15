"""Residuals of a flight's distances, with the quantities that may explain them, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.bias_study import Comparison
from kgcp.quality.robust_gls import ErrorModel

ROUNDING = 1e-9  # a quantity that varies by less counts as constant
# Standard deviations where none are stated: of an edge, and of independent and correlated errors of
# the reference. They set proportions only; the scatter of the residuals sets the scale.
_UNSTATED_EDGE_PX = 0.05
_UNSTATED_INDEPENDENT_M, _UNSTATED_CORRELATED_M = 0.005, 0.01


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity by which exposure may displace edges."""

    name: str  # of the column
    label: str  # with its unit
    per: str  # name of one unit in the regression
    is_log: bool = False  # whether its logarithm counts; the unit is then a factor of two
    # whether edges are not displaced at 0; for others, only the effect of changes is determined
    is_absolute: bool = False

    def measure(self, values: FloatArray) -> FloatArray:
        """Return values (n,) in the regression's unit; NaN if missing or not positive."""
        if not self.is_log:
            return values
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log2(values)
        return np.where(np.isfinite(logs), logs, np.nan)


QUANTITIES = (
    Quantity("edge_shift_px", "edge shift δ [px]", "px of δ", is_absolute=True),
    Quantity("exposure_time_s", "exposure time [s]", "doubling", is_log=True),
    Quantity("iso", "ISO", "doubling", is_log=True),
    Quantity("white", "level of white", "full range"),
    Quantity("saturated", "share of clipped pixels", "share of 1"),
    Quantity("blur_px", "edge spread σ [px]", "px of σ"),
    Quantity("black", "level of black", "full range"),
    Quantity("f_number", "f-number", "doubling", is_log=True),
)
"""Likeliest first: of quantities that cannot be separated, the last is not estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class DistanceResiduals:
    """Residuals of n distances and the quantities that may explain them, in the order of time."""

    distance_m: FloatArray  # (n,): reference distances
    radius_px: FloatArray  # (n,): radii in the image from which distances were measured
    residual_m: FloatArray  # (n,): measured minus reference distance
    errors: ErrorModel  # of the residuals, in m²
    # (n,) each: the columns of `QUANTITIES` by name; NaN: not known in a frame
    exposure: dict[str, FloatArray]

    @classmethod
    def of(
        cls,
        compared: Sequence[Comparison],
        measured_m: FloatArray,
        radius_px: FloatArray | None = None,
    ) -> Self:
        """Collect comparisons with a measurement, sorted by `in_time`.

        Parameters
        ----------
        measured_m : (n,) array
            Measured distances [m].
        radius_px : (n,) array, optional
            Radii from which they were measured.  [default: those of the detections]
        """
        distance = np.array([pair.reference_distance_m for pair in compared])
        radius = radius_px
        if radius is None:
            radius = np.array(
                [pair.attempt.exposure.radius_px or pair.expected_radius_px for pair in compared]
            )
        return cls(
            distance_m=distance,
            radius_px=radius,
            residual_m=measured_m - distance,
            errors=_error_model(compared, _UNSTATED_EDGE_PX * distance / radius),
            exposure={
                quantity.name: np.array(
                    [getattr(pair.attempt.exposure, quantity.name) for pair in compared],
                    dtype=np.float64,
                )
                for quantity in QUANTITIES
            },
        )


def in_time(compared: Sequence[Comparison]) -> list[Comparison]:
    """Sort comparisons by time; those without a time follow, by the names of their frames."""
    return sorted(
        compared,
        key=lambda pair: (
            pair.attempt.time_s is None,
            pair.attempt.time_s or 0.0,
            pair.attempt.frame,
            pair.attempt.target,
        ),
    )


def varies(values: FloatArray) -> bool:
    """Tell whether values (n,) differ by more than rounding."""
    return len(values) > 1 and float(np.ptp(values)) > ROUNDING


def _error_model(compared: Sequence[Comparison], unstated_m: FloatArray) -> ErrorModel:
    sightings = [pair.attempt.sighting for pair in compared]
    measured = np.array(
        [
            otherwise
            if sighting is None or sighting.sd_distance_m is None
            else sighting.sd_distance_m
            for sighting, otherwise in zip(sightings, unstated_m, strict=True)
        ]
    )
    independent = np.array(
        [pair.sds.independent_m if pair.sds else _UNSTATED_INDEPENDENT_M for pair in compared]
    )
    trajectory = np.array(
        [pair.sds.trajectory_m if pair.sds else _UNSTATED_CORRELATED_M for pair in compared]
    )
    times = np.array([pair.attempt.time_s for pair in compared], dtype=np.float64)
    if not np.isfinite(times).all():  # without times, correlations are unknown
        times = np.arange(float(len(independent)))
        return ErrorModel(
            measured**2 + independent**2 + trajectory**2, np.zeros_like(independent), times
        )
    return ErrorModel(measured**2 + independent**2, trajectory**2, times)
