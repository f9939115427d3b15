"""The [camera] table of flight.toml: the camera, the accuracy of its calibration, its tilt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, CalibrationCovariance
from kgcp.geometry.camera import Camera, Response, TimeReference
from kgcp.io.flight.toml_file import read_toml
from kgcp.io.flight.toml_table import TomlTable
from kgcp.io.formats.calibrations import FORMATS, read_calibration
from kgcp.quality.checks.calibration import CalibrationGrade
from kgcp.quality.checks.frame_header import ExifCamera
from kgcp.settings import require_range

_NEEDED = ("fx", "fy", "cx", "cy")  # what has no default
DEVIATION_KEYS = tuple(f"sd_{name}" for name in CALIBRATION_PARAMETERS)
CAMERA_KEYS = (
    *("guessed", "file", "format", "camera", "width", "height", *CALIBRATION_PARAMETERS),
    *(*DEVIATION_KEYS, "cov_of", "cov", "plumb_sd_deg"),
    *("response", "readout_s", "motion_sd_deg_s", "time_reference"),
)


OWN_FORMAT = "kgcp"
"""Of a camera.toml, as `kgcp calibrate` writes it."""
_EXIF_KEYS = ("exif_camera", "exif_focal_mm", "exif_focal_35_mm")
OWN_KEYS = (
    *("width", "height", *CALIBRATION_PARAMETERS, "response", "cov_of", "cov"),
    *(*_EXIF_KEYS, "verdict"),
)
_FORMATS = (OWN_FORMAT, *FORMATS.names)
# Distances follow from them; a ring's from the one along which its image is longest.
_BOTH = "state how well fx and fy are known, both: what is not stated counts as exact"


def read_camera(table: TomlTable, folder: Path) -> Camera:
    """Return the camera, from the table or the calibration file that it names.

    Raises
    ------
    KgcpError
        Naming file, key and remedy.
    """
    response = table.optional("response", lambda key: table.choice(key, Response))
    moment = table.optional("time_reference", lambda key: table.choice(key, TimeReference))
    readout_s = table.number("readout_s", 0.0)
    if "motion_sd_deg_s" in table and not readout_s:
        raise table.error(
            "motion_sd_deg_s", "has no effect without readout_s", "add readout_s, or delete it"
        )
    camera = _file_camera(table, folder) if "file" in table else _inline_camera(table)
    with table.located():
        return replace(
            camera,
            response=response or camera.response,
            readout_s=readout_s,
            motion_sd_deg_s=table.number("motion_sd_deg_s", camera.motion_sd_deg_s),
            time_reference=moment or TimeReference.MIDDLE,
        )


def _inline_camera(table: TomlTable) -> Camera:
    for key in ("format", "camera"):
        if key in table:
            raise table.error(key, "needs a file", "give file as well, or delete it")
    width, height = table.integer("width"), table.integer("height")
    values: dict[str, Any] = {
        key: table.number(key, None if key in _NEEDED else 0.0) for key in CALIBRATION_PARAMETERS
    }
    with table.located():
        return Camera(width, height, **values)


def _file_camera(table: TomlTable, folder: Path) -> Camera:
    for key in ("guessed", *CALIBRATION_PARAMETERS):
        if key in table:
            raise table.error(key, "is given beside a calibration file", "delete one of the two")
    own = _own_table(table, folder)
    if own is not None:
        return read_camera(own, folder)
    return read_calibration(
        table.existing_file("file", folder),
        (table.optional("width", table.integer), table.optional("height", table.integer)),
        table.optional("format", lambda key: table.choice(key, _FORMATS)),
        table.optional("camera", table.text),
    )


def _own_table(table: TomlTable, folder: Path) -> TomlTable | None:
    """Return the [camera] of the camera.toml that a table names; None: it names none."""
    if "file" not in table:
        return None
    path = table.existing_file("file", folder)
    form = table.optional("format", lambda key: table.choice(key, _FORMATS))
    if form != OWN_FORMAT and (form is not None or path.suffix != ".toml"):
        return None
    for key in ("camera", "width", "height"):
        if key in table:
            raise table.error(key, "is given beside a camera.toml", "delete it")
    whole, _ = read_toml(path, ("camera",), "[camera] file")
    return whole.table("camera", OWN_KEYS)


def read_camera_file(path: Path) -> tuple[Camera, CalibrationCovariance | None]:
    """Return the camera of a camera.toml, and how well it is known.

    Raises
    ------
    KgcpError
        Naming file, key and remedy.
    """
    whole, _ = read_toml(path, ("camera",), "[camera] file")
    table = whole.table("camera", OWN_KEYS)
    return read_camera(table, path.parent), read_calibration_covariance(table, path.parent)


def read_calibration_covariance(table: TomlTable, folder: Path) -> CalibrationCovariance | None:
    """Return how well the camera is calibrated; None where nothing is said about it.

    A camera.toml brings its covariance with it. Beside it the table may state another.

    Raises
    ------
    KgcpError
        Naming file, key and remedy: for negative deviations, a matrix that is not a
        covariance, both of them, or accuracies without those of both fx and fy.
    """
    deviations = [key for key in DEVIATION_KEYS if key in table]
    if "cov" in table or "cov_of" in table:
        if deviations:
            raise table.error(deviations[0], "is given beside cov", "delete one of the two")
        numbers, names = np.array(table.numbers("cov")), table.texts("cov_of")
        if not {"fx", "fy"} <= {*names}:
            raise table.error("cov_of", "lacks fx or fy", _BOTH)
        size = len(names)
        cov = numbers.reshape(size, size) if numbers.size == size * size else numbers
        with table.located():
            return CalibrationCovariance.of(names, cov)
    if not deviations:
        own = _own_table(table, folder)
        return None if own is None else read_calibration_covariance(own, folder)
    for key in ("sd_fx", "sd_fy"):
        if key not in table:
            raise table.error(key, "is missing", _BOTH)
    sd = np.array([table.number(key) for key in deviations])
    with table.located():
        for key, value in zip(deviations, sd, strict=True):
            require_range(key, float(value), 0.0, 1e4)
        names = tuple(key.removeprefix("sd_") for key in deviations)
        return CalibrationCovariance.of(names, np.diag(sd**2))


def read_exif_camera(table: TomlTable, folder: Path) -> ExifCamera:
    """Return the camera by EXIF of the photographs that the named camera.toml was made from.

    Raises
    ------
    KgcpError
        Naming file, key and remedy.
    """
    own = _own_table(table, folder)
    return ExifCamera() if own is None else _exif_camera(own)


def read_exif_camera_file(path: Path) -> ExifCamera:
    """Return the camera by EXIF of the photographs that a camera.toml was made from.

    Raises
    ------
    KgcpError
        Naming file, key and remedy.
    """
    whole, _ = read_toml(path, ("camera",), "[camera] file")
    return _exif_camera(whole.table("camera", OWN_KEYS))


def _exif_camera(own: TomlTable) -> ExifCamera:
    name, *focals_mm = _EXIF_KEYS
    return ExifCamera(
        own.optional(name, own.text) or "", *(own.optional(key, own.number) for key in focals_mm)
    )


def read_calibration_grade(table: TomlTable, folder: Path) -> CalibrationGrade | None:
    """Return the verdict of `kgcp calibrate` on the camera; None where there is none.

    Raises
    ------
    KgcpError
        Naming file, key and remedy.
    """
    own = _own_table(table, folder)
    if own is None:
        return None
    return own.optional("verdict", lambda key: own.choice(key, CalibrationGrade))


def read_plumb_sd_deg(table: TomlTable) -> float | None:
    """Return how plumb the optical axis is [deg]; None where the table says nothing about it."""
    sd_deg = table.optional("plumb_sd_deg", table.number)
    with table.located():
        if sd_deg is not None:
            require_range("plumb_sd_deg", sd_deg, 0.0, 45.0, unit="deg")
    return sd_deg
