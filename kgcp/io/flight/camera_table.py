"""The [camera] table of flight.toml: the camera, the accuracy of its calibration, its tilt."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, CalibrationCovariance
from kgcp.geometry.camera import Camera, Response, TimeReference
from kgcp.io.flight.toml_file import read_toml
from kgcp.io.flight.toml_table import TomlTable
from kgcp.io.formats.calibrations import FORMATS, read_calibration
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.quality.checks.calibration import CalibrationGrade
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


@dataclass(frozen=True, slots=True)
class StatedCamera:
    """A camera, and what its file states about how it was calibrated."""

    camera: Camera
    covariance: CalibrationCovariance | None  # None: nothing says how well it is known
    by_exif: ExifCamera  # of the photographs that it was calibrated from
    grade: CalibrationGrade | None  # the verdict of `kgcp calibrate`; None: there is none


def read_camera(table: TomlTable, folder: Path) -> StatedCamera:
    """Return the camera, from the table or the calibration file that it names.

    A camera.toml brings its covariance with it. Beside it the table may state another.

    Raises
    ------
    KgcpError
        Naming file, key and remedy: also for negative deviations, a matrix that is not a
        covariance, both of them, or accuracies without those of both fx and fy.
    """
    response = table.optional("response", lambda key: table.choice(key, Response))
    moment = table.optional("time_reference", lambda key: table.choice(key, TimeReference))
    readout_s = table.number("readout_s", 0.0)
    if "motion_sd_deg_s" in table and not readout_s:
        raise table.error(
            "motion_sd_deg_s", "has no effect without readout_s", "add readout_s, or delete it"
        )
    stated = _stated_by_file(table, folder) if "file" in table else _stated_inline(table)
    with table.located():
        camera = replace(
            stated.camera,
            response=response or stated.camera.response,
            readout_s=readout_s,
            motion_sd_deg_s=table.number("motion_sd_deg_s", stated.camera.motion_sd_deg_s),
            time_reference=moment or TimeReference.MIDDLE,
        )
    return replace(stated, camera=camera, covariance=_covariance(table) or stated.covariance)


def _stated_by_file(table: TomlTable, folder: Path) -> StatedCamera:
    for key in ("guessed", *CALIBRATION_PARAMETERS):
        if key in table:
            raise table.error(key, "is given beside a calibration file", "delete one of the two")
    own = _own_table(table, folder)
    if own is not None:
        return read_camera(own, folder)
    camera = read_calibration(
        table.existing_file("file", folder),
        (table.optional("width", table.integer), table.optional("height", table.integer)),
        table.optional("format", lambda key: table.choice(key, _FORMATS)),
        table.optional("camera", table.text),
    )
    return StatedCamera(camera, None, ExifCamera(), None)


def _stated_inline(table: TomlTable) -> StatedCamera:
    camera = _inline_camera(table)
    grade = table.optional("verdict", lambda key: table.choice(key, CalibrationGrade))
    return StatedCamera(camera, None, _exif_camera(table), grade)


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


def _own_table(table: TomlTable, folder: Path) -> TomlTable | None:
    """Return the [camera] of the camera.toml that a table names; None: it names another file."""
    path = table.existing_file("file", folder)
    form = table.optional("format", lambda key: table.choice(key, _FORMATS))
    if form != OWN_FORMAT and (form is not None or path.suffix != ".toml"):
        return None
    for key in ("camera", "width", "height"):
        if key in table:
            raise table.error(key, "is given beside a camera.toml", "delete it")
    whole, _ = read_toml(path, ("camera",), "[camera] file")
    return whole.table("camera", OWN_KEYS)


def read_camera_file(path: Path) -> StatedCamera:
    """Return the camera of a camera.toml.

    Raises
    ------
    KgcpError
        Naming file, key and remedy.
    """
    whole, _ = read_toml(path, ("camera",), "[camera] file")
    return read_camera(whole.table("camera", OWN_KEYS), path.parent)


def _covariance(table: TomlTable) -> CalibrationCovariance | None:
    """Return how well the table says that the camera is known; None: it says nothing."""
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
        return None
    for key in ("sd_fx", "sd_fy"):
        if key not in table:
            raise table.error(key, "is missing", _BOTH)
    sd = np.array([table.number(key) for key in deviations])
    with table.located():
        for key, value in zip(deviations, sd, strict=True):
            require_range(key, float(value), 0.0, 1e4)
        names = tuple(key.removeprefix("sd_") for key in deviations)
        return CalibrationCovariance.of(names, np.diag(sd**2))


def _exif_camera(table: TomlTable) -> ExifCamera:
    name, *focals_mm = _EXIF_KEYS
    return ExifCamera(
        table.optional(name, table.text) or "",
        *(table.optional(key, table.number) for key in focals_mm),
    )


def read_plumb_sd_deg(table: TomlTable) -> float | None:
    """Return how plumb the optical axis is [deg]; None where the table says nothing about it."""
    sd_deg = table.optional("plumb_sd_deg", table.number)
    with table.located():
        if sd_deg is not None:
            require_range("plumb_sd_deg", sd_deg, 0.0, 45.0, unit="deg")
    return sd_deg
