"""camera.toml: a camera with the full covariance of its calibration."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.io.flight.toml_draft import toml_text
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.quality.checks.calibration import CalibrationGrade


def camera_toml(
    camera: Camera,
    covariance: CalibrationCovariance | None,
    by_exif: ExifCamera | None = None,
    grade: CalibrationGrade | None = None,
) -> str:
    """Return the text of a camera.toml, whose numbers are read back to the last bit.

    Without a covariance it says nothing about how well the camera is known.
    """
    lines = [
        "# Written by kgcp. In flight.toml:",
        "#",
        "#     [camera]",
        '#     file = "camera.toml"',
        '#     format = "kgcp"',
        "",
        *camera_lines(camera),
        *_exif_lines(by_exif or ExifCamera()),
        *([] if grade is None else [f"verdict = {toml_text(grade.value)}"]),
    ]
    if covariance is None:
        return "\n".join(lines) + "\n"
    estimated = np.flatnonzero(covariance.cov.any(axis=1)).tolist()
    names = ", ".join(f'"{CALIBRATION_PARAMETERS[index]}"' for index in estimated)
    lines += [f"cov_of = [{names}]", "cov = ["]
    for row in covariance.cov[np.ix_(estimated, estimated)].tolist():
        lines.append(f"    {', '.join(map(repr, row))},")
    lines.append("]")
    return "\n".join(lines) + "\n"


def camera_lines(camera: Camera) -> Iterator[str]:
    """Yield the table [camera]: size, parameters, those of distortion unless 0, and response."""
    yield "[camera]"
    yield f"width = {camera.width}"
    yield f"height = {camera.height}"
    for name in CALIBRATION_PARAMETERS:
        value = float(getattr(camera, name))
        if name in CALIBRATION_PARAMETERS[:4] or value != 0.0:
            yield f"{name} = {value!r}"
    yield f'response = "{camera.response.value}"'


def _exif_lines(camera: ExifCamera) -> Iterator[str]:
    """Yield what EXIF says about the camera, where it says something."""
    if camera.name:
        yield f"exif_camera = {toml_text(camera.name)}"
    if camera.focal_mm is not None:
        yield f"exif_focal_mm = {toml_text(camera.focal_mm)}"
    if camera.focal_35_mm is not None:
        yield f"exif_focal_35_mm = {toml_text(camera.focal_35_mm)}"
