"""Residuals of a flight's distances as arrays, with what may explain them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.bias_study import Comparison
from kgcp.quality.robust_gls import ErrorModel

ROUNDING = 1e-9  # a quantity that varies by less does not vary
# Without stated standard deviations the scatter sets the scale, and these only the proportions.
_UNSTATED_EDGE_PX = 0.05
_UNSTATED_WHITE_M, _UNSTATED_LASTING_M = 0.005, 0.01


@dataclass(frozen=True, slots=True)
class Quantity:
    """One thing that an exposure may act by."""

    name: str  # of the column
    label: str  # what it is, with its unit
    per: str  # of what one unit is called in the regression
    is_log: bool = False  # whether factors count, not differences: then the unit is a factor of two
    # whether 0 means that nothing is displaced; of others only changes can be told
    is_absolute: bool = False

    def measure(self, values: FloatArray) -> FloatArray:
        """Return values (n,) in the regression's unit; NaN where there is none."""
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
"""In the order in which they are believed: of those that look alike the last is given up."""


@dataclass(frozen=True, slots=True, eq=False)
class DistanceResiduals:
    """Residuals of n distances, with all that may explain them, in the order of time."""

    # (n,): reference distance, and the radius in the image that gave the measured one
    distance_m: FloatArray
    radius_px: FloatArray
    residual_m: FloatArray  # (n,): measured minus reference distance
    errors: ErrorModel  # of the residuals, in m²
    # the columns of `QUANTITIES` by name; NaN where a frame has none
    exposure: dict[str, FloatArray]

    @classmethod
    def of(
        cls,
        compared: Sequence[Comparison],
        measured_m: FloatArray,
        radius_px: FloatArray | None = None,
    ) -> Self:
        """Collect comparisons with a measurement, `in_time`.

        Parameters
        ----------
        measured_m : (n,) array
            Measured distances [m].
        radius_px : (n,) array, optional
            Radii that gave them; those of the detections if not given.
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
    """Sort comparisons by time, those without one by their frames' names behind the others."""
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
        [pair.sds.independent_m if pair.sds else _UNSTATED_WHITE_M for pair in compared]
    )
    place = np.array([pair.sds.place_m if pair.sds else _UNSTATED_LASTING_M for pair in compared])
    times = np.array([pair.attempt.time_s for pair in compared], dtype=np.float64)
    if not np.isfinite(times).all():  # without times it is not known which are neighbours
        times = np.arange(float(len(independent)))
        return ErrorModel(
            measured**2 + independent**2 + place**2, np.zeros_like(independent), times
        )
    return ErrorModel(measured**2 + independent**2, place**2, times)
