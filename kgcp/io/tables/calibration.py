"""Tables of a calibration: the observations, the adjusted field, and the photographs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.io.files.csv_text import csv_text
from kgcp.io.tables.columns import (
    INTEGER,
    NUMBER,
    NUMBERS,
    TEXT,
    Column,
    Row,
    matrix_cell,
    row_of,
    sd_cell,
)
from kgcp.measurement.discs.records import ellipse_of_moments
from kgcp.measurement.field_photograph import PhotoDiscs, PhotoMiss
from kgcp.network.calibration_records import CameraCalibration, PointModel


@dataclass(frozen=True, slots=True, eq=False)
class ObservedDisc:
    """One disc in one photograph, as it took part in the adjustment."""

    photo: str
    point: str
    vector: FloatArray  # (5,)
    cov: FloatArray  # (5, 5)
    appearance: FloatArray  # (5,): as `PhotoDiscs.appearance`
    named_by: str
    residual: FloatArray  # (2,)
    redundancy: float
    weight: float
    is_used: bool
    perspective: FloatArray  # (2,)
    in_marker: FloatArray  # (2,)


@dataclass(frozen=True, slots=True, eq=False)
class FieldDisc:
    """One disc of the field."""

    name: str
    nominal: FloatArray  # (3,)
    adjusted: FloatArray | None  # (3,); None: no photograph determines it
    cov: FloatArray | None  # (3, 3); None: likewise, or the points are fixed
    rays: int


@dataclass(frozen=True, slots=True, eq=False)
class PhotoRow:
    """Result of one photograph."""

    photo: str
    reason: str  # empty: it was used
    detail: str
    pose: Pose | None
    cov: FloatArray | None  # (6, 6)
    discs: int
    used: int
    rms_px: float | None
    tilt_deg: float | None


OBSERVATION_COLUMNS: tuple[Column[ObservedDisc], ...] = (
    Column("photo", TEXT, lambda disc: disc.photo),
    Column("point", TEXT, lambda disc: disc.point),
    Column("named_by", TEXT, lambda disc: disc.named_by),
    *Column[ObservedDisc].of_vector(("x_px", "y_px"), lambda disc: disc.vector),
    *Column[ObservedDisc].of_sds(("sd_x_px", "sd_y_px"), lambda disc: disc.cov),
    Column("cov", NUMBERS, lambda disc: matrix_cell(disc.cov)),
    Column("a_px", NUMBER, lambda disc: ellipse_of_moments(disc.vector).a),
    Column("b_px", NUMBER, lambda disc: ellipse_of_moments(disc.vector).b),
    Column(
        "angle_deg", NUMBER, lambda disc: math.degrees(ellipse_of_moments(disc.vector).angle_rad)
    ),
    Column("status", TEXT, lambda disc: "used" if disc.is_used else "rejected"),
    *Column[ObservedDisc].of_vector(("residual_x_px", "residual_y_px"), lambda disc: disc.residual),
    Column("redundancy", NUMBER, lambda disc: disc.redundancy),
    Column("weight", NUMBER, lambda disc: disc.weight),
    *Column[ObservedDisc].of_vector(("ecc_x_px", "ecc_y_px"), lambda disc: disc.perspective),
    *Column[ObservedDisc].of_vector(
        ("ecc_lens_x_px", "ecc_lens_y_px"), lambda disc: disc.in_marker
    ),
    *Column[ObservedDisc].of_vector(
        ("inside", "outside", "blur_px", "clipped"), lambda disc: disc.appearance
    ),
)

FIELD_COLUMNS: tuple[Column[FieldDisc], ...] = (
    Column("point", TEXT, lambda disc: disc.name),
    *Column[FieldDisc].of_vector(("x_m", "y_m", "z_m"), lambda disc: disc.adjusted),
    *Column[FieldDisc].of_sds(("sd_x_m", "sd_y_m", "sd_z_m"), lambda disc: disc.cov),
    Column("cov", NUMBERS, lambda disc: matrix_cell(disc.cov)),
    *Column[FieldDisc].of_vector(
        ("change_x_m", "change_y_m", "change_z_m"),
        lambda disc: None if disc.adjusted is None else disc.adjusted - disc.nominal,
    ),
    Column("rays", INTEGER, lambda disc: disc.rays),
)

PHOTO_COLUMNS: tuple[Column[PhotoRow], ...] = (
    Column("photo", TEXT, lambda row: row.photo),
    Column("status", TEXT, lambda row: "not_used" if row.reason else "used"),
    Column("reason", TEXT, lambda row: row.reason),
    Column("detail", TEXT, lambda row: row.detail),
    Column("discs", INTEGER, lambda row: row.discs),
    Column("discs_used", INTEGER, lambda row: row.used),
    Column("rms_px", NUMBER, lambda row: row.rms_px),
    Column("tilt_deg", NUMBER, lambda row: row.tilt_deg),
    *Column[PhotoRow].of_vector(
        ("tx_m", "ty_m", "tz_m"), lambda row: row.pose.translation_m if row.pose else None
    ),
    Column("rotation", NUMBERS, lambda row: matrix_cell(row.pose.rotation) if row.pose else None),
    Column("pose_cov", NUMBERS, lambda row: matrix_cell(row.cov)),
)


def observation_rows(
    calibration: CameraCalibration, discs: Mapping[str, PhotoDiscs]
) -> Iterator[Row]:
    """Yield a row per disc and photograph."""
    names = calibration.field.names()
    solution, precision = calibration.solution, calibration.precision
    row = 0
    for view in calibration.views:
        measured = discs[view.photo]
        for index, point in enumerate(view.point.tolist()):
            disc = ObservedDisc(
                view.photo,
                names[point],
                view.vectors[index],
                view.covs[index],
                measured.appearance[index],
                "guided" if measured.is_guided[index] else calibration.field.named_by,
                solution.residuals[row],
                float(precision.redundancy[row]),
                float(solution.weights[row]),
                bool(solution.is_used[row]),
                calibration.eccentricity.perspective_px[row],
                calibration.eccentricity.in_marker_px[row],
            )
            yield row_of(OBSERVATION_COLUMNS, disc)
            row += 1


def field_discs(calibration: CameraCalibration) -> list[FieldDisc]:
    """Return the discs of the field as they were adjusted."""
    points, nominal = calibration.solution.estimate.points, calibration.field.points_m()
    observed = calibration.network.observations.point[calibration.solution.is_used]
    rays = np.bincount(observed, minlength=len(points)).tolist()
    first_point = calibration.network.cameras.values.size
    inverse = calibration.precision.inverse * calibration.precision.variance_factor
    discs = []
    is_fixed = calibration.points_used is PointModel.FIXED
    for index, name in enumerate(calibration.field.names()):
        adjusted, cov = points[index] if is_fixed or rays[index] else None, None
        if not is_fixed and rays[index]:
            block = slice(first_point + 3 * index, first_point + 3 * index + 3)
            cov = inverse[block, block]
        discs.append(FieldDisc(name, nominal[index], adjusted, cov, rays[index]))
    return discs


def field_csv(discs: list[FieldDisc]) -> str:
    """Return the field as CSV: name, x, y, z and their standard deviations [m].

    Discs that no photograph determines are left out: their nominal positions are not a result.
    """
    rows = []
    for disc in discs:
        if disc.adjusted is None:
            continue
        sds = ["" if (sd := sd_cell(disc.cov, axis)) is None else f"{sd:.9f}" for axis in range(3)]
        rows.append([disc.name, *(f"{value:.9f}" for value in disc.adjusted), *sds])
    return csv_text(["name", "x", "y", "z", "sd_x", "sd_y", "sd_z"], rows)


def photo_rows(
    calibration: CameraCalibration, misses: tuple[PhotoMiss, ...], photos: tuple[str, ...]
) -> list[PhotoRow]:
    """Return a row per photograph, in the order of `photos`."""
    solution, precision = calibration.solution, calibration.precision
    rows = {
        miss.photo: PhotoRow(miss.photo, miss.reason, miss.detail, None, None, 0, 0, None, None)
        for miss in misses
    }
    view_of = calibration.network.observations.view
    for index, view in enumerate(calibration.views):
        is_in_view = view_of == index
        used = is_in_view & solution.is_used
        squares = np.sum(solution.residuals[used] ** 2, axis=1)
        estimate = solution.estimate
        pose = Pose(estimate.rotations[index], estimate.translations[index])
        rows[view.photo] = PhotoRow(
            view.photo,
            "",
            "",
            pose,
            precision.variance_factor * precision.pose_inverses[index],
            int(np.count_nonzero(is_in_view)),
            int(np.count_nonzero(used)),
            float(np.sqrt(squares.mean())),
            math.degrees(math.acos(min(1.0, abs(float(pose.rotation[2, 2]))))),
        )
    return [rows[photo] for photo in photos]
