"""The flight folder: flight.toml into validated records."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.io.flight_camera import (
    CAMERA_KEYS,
    read_calibration_covariance,
    read_camera,
    read_plumb_sd_deg,
)
from kgcp.io.flight_targets import read_targets
from kgcp.io.toml_values import TomlTable
from kgcp.settings import VehicleSettings
from kgcp.target.layout import Target

FLIGHT_KEYS = ("name", "crs", "frames", "camera", "target", "vehicle", "reference")
FRAMES_KEYS = ("folder", "times")
VEHICLE_KEYS = (
    "trajectory",
    "lever_arm_m",
    "sd_lever_arm_m",
    "mount_deg",
    "sd_time_s",
    "time_offset_s",
    "level_sd_deg",
    "correlation_s",
)
REFERENCE_KEYS = ("poses",)


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight folder.

    Attributes
    ----------
    folder : Path
        Where flight.toml lies.
    name : str
        Of the flight; the folder's where flight.toml gives none.
    crs : str or None
        Coordinate reference system of vehicle, reference and static targets, for pyproj.
    frames_folder : Path
        Where the images lie.
    times_file : Path or None
        CSV of frame times; None: EXIF says when.
    camera : Camera
    calibration_covariance : CalibrationCovariance or None
        How well the camera is calibrated; None: flight.toml does not say.
    plumb_sd_deg : float or None
        Standard deviation of the camera's optical axis against the vertical, about either
        horizontal axis, in frames without reference attitude [deg]; None: not known.
    targets : tuple of Target
        In the order of the file.
    vehicle : VehicleSettings or None
    trajectory_file : Path or None
        Of the vehicle; it is not looked for until a command needs it.
    reference_file : Path or None
        Reference poses of the camera; it is not looked for until a command needs it.
    toml_text : str
        flight.toml as it was read.
    """

    folder: Path
    name: str
    crs: str | None
    frames_folder: Path
    times_file: Path | None
    camera: Camera
    calibration_covariance: CalibrationCovariance | None
    plumb_sd_deg: float | None
    targets: tuple[Target, ...]
    vehicle: VehicleSettings | None
    trajectory_file: Path | None
    reference_file: Path | None
    toml_text: str


def read_flight(folder: Path) -> Flight:
    """Read and validate the flight.toml of a flight folder.

    Raises
    ------
    KgcpError
        In one line with file, table, key and remedy: if the file is missing or not TOML, a key
        is unknown, missing or of the wrong type, a value impossible, or the frames' folder, the
        times file or the calibration file does not exist.
    """
    path = folder / "flight.toml"
    text = _read_text(path)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise KgcpError(f"{path}: is not TOML: {error}; correct that line") from error
    table = TomlTable(f"{path}:", values, FLIGHT_KEYS)
    frames_folder, times_file = _read_frames(table, folder)
    camera = table.table("camera", CAMERA_KEYS)
    vehicle, trajectory_file = _read_vehicle(table, folder)
    plumb_sd_deg = read_plumb_sd_deg(camera)
    if plumb_sd_deg is not None and (vehicle is None or vehicle.level_sd_deg is None):
        raise camera.error(
            "plumb_sd_deg", "stands without [vehicle] level_sd_deg", "give both or none"
        )
    return Flight(
        folder=folder,
        name=table.text("name") if "name" in table else folder.resolve().name,
        crs=table.text("crs") if "crs" in table else None,
        frames_folder=frames_folder,
        times_file=times_file,
        camera=read_camera(camera, folder),
        calibration_covariance=read_calibration_covariance(camera),
        plumb_sd_deg=plumb_sd_deg,
        targets=read_targets(table),
        vehicle=vehicle,
        trajectory_file=trajectory_file,
        reference_file=_read_reference(table, folder),
        toml_text=text,
    )


def _read_text(path: Path) -> str:
    if not path.is_file():
        raise KgcpError(f"{path}: does not exist; name a flight folder, which has a flight.toml")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise KgcpError(f"{path}: is not UTF-8 ({error}); save it as UTF-8") from error


def _read_frames(flight: TomlTable, folder: Path) -> tuple[Path, Path | None]:
    """Return the frames' folder and the times file; both have defaults by the folder's layout."""
    table = flight.table("frames", FRAMES_KEYS, required=False)
    name = table.text("folder") if "folder" in table else "frames"
    if not (folder / name).is_dir():
        raise table.error("folder", f"{name!r} is not a folder", "create or correct it")
    if "times" in table:
        return folder / name, table.existing_file("times", folder)
    default = folder / "frames.csv"
    return folder / name, default if default.is_file() else None


def _read_vehicle(flight: TomlTable, folder: Path) -> tuple[VehicleSettings | None, Path | None]:
    if "vehicle" not in flight:
        return None, None
    table = flight.table("vehicle", VEHICLE_KEYS)
    with table.located():
        settings = VehicleSettings(
            lever_arm_m=table.vector("lever_arm_m"),  # a forgotten one would be metres
            sd_lever_arm_m=table.vector("sd_lever_arm_m", (0.0, 0.0, 0.0)),
            mount_deg=table.number("mount_deg", 0.0),
            sd_time_s=table.number("sd_time_s", 0.0),
            time_offset_s=table.number("time_offset_s", 0.0),
            level_sd_deg=table.number("level_sd_deg") if "level_sd_deg" in table else None,
            correlation_s=table.number("correlation_s", 60.0),
        )
    return settings, folder / table.text("trajectory")


def _read_reference(flight: TomlTable, folder: Path) -> Path | None:
    if "reference" not in flight:
        return None
    return folder / flight.table("reference", REFERENCE_KEYS).text("poses")
