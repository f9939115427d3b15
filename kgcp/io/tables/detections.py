"""From one frame's result to its rows in `detections.parquet`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kgcp.errors import Status
from kgcp.geometry.arrays import FloatArray
from kgcp.io.images.frames import Exif
from kgcp.io.tables.columns import DETECTION_COLUMNS, Row, time_cell
from kgcp.measurement.records import (
    Appearance,
    CommonUncertainty,
    Miss,
    Observation,
    Outcome,
    Uncertainty,
)

_NULL_ROW: dict[str, object] = {column.name: None for column in DETECTION_COLUMNS}


@dataclass(frozen=True, slots=True)
class FrameResult:
    """All that was learned from one frame.

    Attributes
    ----------
    frame : str
        Path relative to the frames folder.
    time_s : float or None
        Mid-exposure, Unix UTC [s].
    exif : Exif
        Exposure quantities.
    outcomes : tuple of Outcome
        At least one per target, in the targets' order.
    """

    frame: str
    time_s: float | None
    exif: Exif
    outcomes: tuple[Outcome, ...]


def detection_rows(result: FrameResult) -> list[Row]:
    """Return the rows of one frame, one per target and instance, by target and instance."""
    shared = {
        "frame": result.frame,
        "time": time_cell(result.time_s),
        "exposure_time_s": result.exif.exposure_time_s,
        "iso": result.exif.iso,
        "f_number": result.exif.f_number,
    }
    rows: list[tuple[tuple[str, int], Row]] = []
    for outcome in result.outcomes:
        cells = _miss_cells(outcome) if isinstance(outcome, Miss) else _measured_cells(outcome)
        instance = 0 if isinstance(outcome, Miss) else outcome.instance
        key = {"target": outcome.target, "instance": instance}
        rows.append(((outcome.target, instance), {**_NULL_ROW, **shared, **key, **cells}))
    return [row for _, row in sorted(rows, key=lambda pair: pair[0])]


def _miss_cells(miss: Miss) -> Mapping[str, object]:
    return {
        "status": miss.reason.status.value,
        "reason": miss.reason.value,
        "detail": miss.detail,
        "candidates": miss.candidates,
        "guided": False,
        "scale_used": "",
        "score": miss.score,
    }


def _measured_cells(seen: Observation) -> Mapping[str, object]:
    return {
        "status": Status.MEASURED.value,
        "reason": "",
        "detail": "",
        "candidates": 0,
        "guided": seen.is_guided,
        "scale_used": seen.ring,
        "x_px": float(seen.centre_px[0]),
        "y_px": float(seen.centre_px[1]),
        "distance_m": seen.pose.distance_m,
        **_named(("tx_m", "ty_m", "tz_m"), seen.pose.translation_m),
        **_named(("qw", "qx", "qy", "qz"), seen.pose.quaternion_wxyz),
        "roll_deg": seen.pose.roll_deg,
        "pitch_deg": seen.pose.pitch_deg,
        "heading_deg": seen.heading_deg,
        "score": seen.score,
        **_appearance_cells(seen.appearance),
        **({} if seen.uncertainty is None else _uncertainty_cells(seen.uncertainty)),
        **({} if seen.common is None else _common_cells(seen.common)),
        **_alternative_cells(seen),
    }


def _appearance_cells(appearance: Appearance) -> Mapping[str, object]:
    return {
        "radius_px": appearance.radius_px,
        "blur_px": appearance.blur_px,
        "edge_shift_px": appearance.edge_shift_px,
        "black": appearance.black,
        "white": appearance.white,
        "saturated": appearance.saturated,
    }


def _uncertainty_cells(uncertainty: Uncertainty) -> Mapping[str, object]:
    centre = uncertainty.centre_cov_px2
    return {
        "sd_x_px": float(np.sqrt(centre[0, 0])),
        "sd_y_px": float(np.sqrt(centre[1, 1])),
        "cov_xy_px2": float(centre[0, 1]),
        "sd_distance_m": uncertainty.sd_distance_m,
        "sd_roll_deg": uncertainty.sd_roll_deg,
        "sd_pitch_deg": uncertainty.sd_pitch_deg,
        "sd_heading_deg": uncertainty.sd_heading_deg,
        "pose_cov": uncertainty.pose_cov.ravel().tolist(),
    }


def _common_cells(common: CommonUncertainty) -> Mapping[str, object]:
    return {
        "sd_common_distance_m": common.sd_distance_m,
        "sd_common_direction_mrad": common.sd_direction_mrad,
        "common_pose_cov": common.pose_cov.ravel().tolist(),
    }


def _alternative_cells(seen: Observation) -> Mapping[str, object]:
    if seen.alternative is None:
        return {}
    names = ("alt_qw", "alt_qx", "alt_qy", "alt_qz")
    return {
        **_named(names, seen.alternative.pose.quaternion_wxyz),
        "ambiguity": seen.alternative.ambiguity,
    }


def _named(names: tuple[str, ...], values: FloatArray) -> dict[str, object]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}
