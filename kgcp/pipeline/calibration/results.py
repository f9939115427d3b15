"""The files of a calibration: camera, tables, numbers and report."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp import __version__
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.io.files.atomic import write_all
from kgcp.io.flight.camera_file import camera_toml
from kgcp.io.flight.field_file import field_toml
from kgcp.io.formats.camera_writers import (
    ONE_FOCAL_LENGTH,
    CalibratedCamera,
    camera_file,
    not_renewed,
)
from kgcp.io.tables.calibration import (
    FIELD_COLUMNS,
    OBSERVATION_COLUMNS,
    PHOTO_COLUMNS,
    PhotoRow,
    field_csv,
    field_discs,
    observation_rows,
    photo_rows,
)
from kgcp.io.tables.columns import SCHEMA_VERSION, row_of
from kgcp.io.tables.parquet import write_table
from kgcp.network.calibration_records import CalibrationSettings, LensModel
from kgcp.pipeline.calibration.against import OtherCalibration
from kgcp.pipeline.calibration.run import PhotoCalibration
from kgcp.quality.calibration_verdict import (
    CalibrationNumbers,
    CalibrationVerdict,
    calibration_numbers,
    change_if_neglected,
    judge,
)
from kgcp.quality.camera_conventions import convention_words
from kgcp.quality.disc_light import DiscLight, light_on_discs
from kgcp.quality.frame_rays import compare_cameras
from kgcp.report.calibration.figures import draw_comparison, draw_figures
from kgcp.report.calibration.page import CalibrationPage, CameraComparison, render_calibration

CAMERA_FILE = "camera.toml"
PAGE_FILE = "calibration.html"
FIELD_FILES = ("field.toml", "field.csv")
"""Files of the stated and of the adjusted field."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResults:
    """The files of a calibration and their content."""

    files: tuple[Path, ...]
    left_out: dict[str, str]  # requested formats that cannot hold the camera: format → reason
    not_renewed: tuple[str, ...]  # formats with outdated files of an earlier run
    numbers: CalibrationNumbers
    verdict: CalibrationVerdict
    photos: tuple[PhotoRow, ...]
    summary: dict[str, object]  # calibration.json
    comparison: CameraComparison | None = None


def require_formats(formats: Sequence[str], settings: CalibrationSettings) -> None:
    """Refuse formats that cannot hold the requested model, before anything is measured.

    If it is open whether fx and fy differ, this cannot be checked before.

    Raises
    ------
    KgcpError
        Naming the terms that a format cannot hold.
    """
    fy = 101.0 if settings.is_same_aspect is False else 100.0
    k4 = 0.01 if settings.lens is LensModel.RATIONAL else 0.0
    camera = Camera(100, 100, 100.0, fy, 50.0, 50.0, k4=k4)
    size = len(CALIBRATION_PARAMETERS)
    for form in formats:
        camera_file(CalibratedCamera(camera, np.eye(size), 0.0), form)


def light_of(made: PhotoCalibration) -> DiscLight:
    """Return the effects of light on the levels of the discs in all photographs that took part."""
    return light_on_discs(
        (discs.vectors[:, :2], discs.appearance[:, :2], discs.appearance[:, 3])
        for discs in made.discs.values()
    )


def write_results(
    made: PhotoCalibration,
    out: Path,
    formats: Sequence[str],
    other: OtherCalibration | None = None,
) -> CalibrationResults:
    """Write all files of a calibration into a folder.

    If the camera has two focal lengths, formats with a single one are left out. Forcing the camera
    to have one would make it fit worse in all other files.

    Parameters
    ----------
    other : OtherCalibration, optional
        A calibration to compare with.
    formats : sequence of str
        Some of `kgcp.io.formats.camera_writers.CAMERA_FORMATS`.

    Raises
    ------
    KgcpError
        If a format cannot hold the lens model, or a file cannot be written.
    """
    calibration = made.calibration
    numbers = calibration_numbers(calibration, light_of(made))
    verdict = judge(calibration, numbers)
    comparison = None
    if other is not None:
        difference = compare_cameras(calibration.camera, other.camera)
        words = convention_words(
            calibration.camera, other.camera, numbers.sd, numbers.mean_ray_sd_px
        )
        comparison = CameraComparison(other.name, other.camera, difference, words)
    exported = CalibratedCamera(calibration.camera, calibration.covariance.cov, numbers.rms_px)
    left_out = _left_out(calibration.camera, formats)
    texts = dict(camera_file(exported, form) for form in formats if form not in left_out)
    texts[CAMERA_FILE] = camera_toml(
        calibration.camera, calibration.covariance, made.exif_camera, verdict.grade
    )
    stated, adjusted = FIELD_FILES
    texts[stated] = field_toml(calibration.field)
    discs = field_discs(calibration)
    texts[adjusted] = field_csv(discs)
    photos = photo_rows(calibration, made.misses, made.photos)
    summary = _summary(made, numbers, verdict, photos, comparison)
    texts["calibration.json"] = json.dumps(summary, indent=1) + "\n"
    tables = (
        ("observations.parquet", OBSERVATION_COLUMNS, observation_rows(calibration, made.discs)),
        ("field.parquet", FIELD_COLUMNS, (row_of(FIELD_COLUMNS, disc) for disc in discs)),
        ("photos.parquet", PHOTO_COLUMNS, (row_of(PHOTO_COLUMNS, row) for row in photos)),
    )
    names = sorted([*texts, *(name for name, _, _ in tables), PAGE_FILE])
    figures = draw_figures(calibration, numbers)
    if comparison is not None:
        figures["against"] = draw_comparison(calibration.camera, comparison.difference)
    page = CalibrationPage(calibration, numbers, verdict, photos, figures, names, comparison)
    texts[PAGE_FILE] = render_calibration(page)
    about = {"schema_version": SCHEMA_VERSION, "version": __version__}
    for name, columns, rows in tables:
        write_table(out / name, columns, rows, about)
    write_all({out / name: text.encode() for name, text in texts.items()})
    files = tuple(out / name for name in names)
    return CalibrationResults(
        files,
        left_out,
        not_renewed(out, files),
        numbers,
        verdict,
        tuple(photos),
        summary,
        comparison,
    )


def _left_out(camera: Camera, formats: Sequence[str]) -> dict[str, str]:
    """Return the formats that cannot hold the camera's second focal length, with the reason."""
    difference_px = abs(camera.fx - camera.fy)
    why = f"fx and fy differ by {difference_px:.2g} px, and the format holds one focal length"
    return {form: why for form in formats if form in ONE_FOCAL_LENGTH and difference_px > 0.0}


def _summary(
    made: PhotoCalibration,
    numbers: CalibrationNumbers,
    verdict: CalibrationVerdict,
    photos: Sequence[PhotoRow],
    comparison: CameraComparison | None,
) -> dict[str, object]:
    calibration = made.calibration
    camera = calibration.camera
    trend, step = numbers.focal_changes.trend, numbers.focal_changes.step
    against = {} if comparison is None else {"against": comparison.numbers(camera)}
    return {
        **against,
        "kgcp_version": __version__,
        "verdict": verdict.grade.value,
        "reasons": verdict.reasons,
        "advice": verdict.advice,
        "camera": {
            "width": camera.width,
            "height": camera.height,
            **{name: getattr(camera, name) for name in CALIBRATION_PARAMETERS},
        },
        "sd": dict(zip(CALIBRATION_PARAMETERS, numbers.sd.tolist(), strict=True)),
        "cov_of": CALIBRATION_PARAMETERS,
        "cov": calibration.covariance.cov.tolist(),
        "estimated": calibration.network.model.names,
        "insignificant": calibration.insignificant,
        "undetermined": calibration.undetermined,
        "tangled": calibration.tangled,
        "photographs": len(photos),
        "photographs_used": numbers.views,
        "places": numbers.places,
        "discs": numbers.discs,
        "discs_used": numbers.discs_used,
        "rms_fixed_px": numbers.rms_fixed_px,
        "rms_px": numbers.rms_px,
        "misfit_px": numbers.misfit_px,
        "operator_sd_px": numbers.operator_sd_px,
        "variance_factor": calibration.precision.variance_factor,
        "points": calibration.points_used.value,
        "coverage": numbers.coverage,
        "largest_angle_deg": numbers.normals_deg,
        "radius_scale": calibration.radius_scale,
        "flatness_m": numbers.flatness_m,
        "bars": [
            {"from": bar.first, "to": bar.second, "sd_m": bar.sd_m, "residual_m": residual_m}
            for bar, residual_m in zip(
                calibration.field.bars, calibration.bar_residuals_m, strict=True
            )
        ],
        "focal_change_px": None if trend is None else trend.change_px,
        "focal_change_p": None if trend is None else trend.p_value,
        "focal_step": None
        if step is None
        else {
            "first_photo": calibration.views[step.first].photo,
            "change_px": step.change_px,
            "p": step.p_value,
        },
        "bending_m": None if numbers.bending is None else numbers.bending.height_m,
        "bending_px": None if numbers.bending is None else numbers.bending.image_px,
        "change_if_eccentricity_neglected": change_if_neglected(calibration),
        "not_used": {row.photo: row.reason for row in photos if row.reason},
        "photo_rms_px": {
            row.photo: row.rms_px
            for row in photos
            if row.rms_px is not None and math.isfinite(row.rms_px)
        },
    }
