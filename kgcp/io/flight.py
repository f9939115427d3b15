"""The flight folder: flight.toml into validated records."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera, Response
from kgcp.io.flight_targets import read_targets
from kgcp.io.toml_values import TomlTable
from kgcp.settings import VehicleSettings
from kgcp.target.layout import Target

FLIGHT_KEYS = ("name", "crs", "frames", "camera", "target", "vehicle", "reference")
FRAMES_KEYS = ("folder", "times")
FOCAL_KEYS = ("fx", "fy", "cx", "cy")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
CAMERA_KEYS = (
    "file",
    "width",
    "height",
    *FOCAL_KEYS,
    *DISTORTION_KEYS,
    "response",
    "readout_s",
)
VEHICLE_KEYS = (
    "trajectory",
    "lever_arm_m",
    "sd_lever_arm_m",
    "mount_deg",
    "sd_time_s",
    "time_offset_s",
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
    vehicle, trajectory_file = _read_vehicle(table, folder)
    return Flight(
        folder=folder,
        name=table.text("name") if "name" in table else folder.resolve().name,
        crs=table.text("crs") if "crs" in table else None,
        frames_folder=frames_folder,
        times_file=times_file,
        camera=_read_camera(table.table("camera", CAMERA_KEYS), folder),
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
        return folder / name, _existing_file(table, "times", folder)
    default = folder / "frames.csv"
    return folder / name, default if default.is_file() else None


def _existing_file(table: TomlTable, key: str, folder: Path) -> Path:
    path = folder / table.text(key)
    if not path.is_file():
        raise table.error(key, f"{table.text(key)!r} does not exist", "create or correct it")
    return path


def _read_camera(table: TomlTable, folder: Path) -> Camera:
    response = table.choice("response", tuple(Response)) if "response" in table else "unknown"
    readout_s = table.number("readout_s", 0.0)
    camera = _file_camera(table, folder) if "file" in table else _inline_camera(table)
    with table.located():
        return replace(camera, response=Response(response), readout_s=readout_s)


def _inline_camera(table: TomlTable) -> Camera:
    with table.located():
        return Camera(
            width=table.integer("width"),
            height=table.integer("height"),
            fx=table.number("fx"),
            fy=table.number("fy"),
            cx=table.number("cx"),
            cy=table.number("cy"),
            k1=table.number("k1", 0.0),
            k2=table.number("k2", 0.0),
            p1=table.number("p1", 0.0),
            p2=table.number("p2", 0.0),
            k3=table.number("k3", 0.0),
            k4=table.number("k4", 0.0),
            k5=table.number("k5", 0.0),
            k6=table.number("k6", 0.0),
        )


def _file_camera(table: TomlTable, folder: Path) -> Camera:
    from kgcp.io.calibrations import read_calibration

    for key in (*FOCAL_KEYS, *DISTORTION_KEYS):
        if key in table:
            raise table.error(key, "stands beside a calibration file", "delete one of the two")
    width = table.integer("width") if "width" in table else None
    height = table.integer("height") if "height" in table else None
    return read_calibration(_existing_file(table, "file", folder), (width, height))


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
        )
    return settings, folder / table.text("trajectory")


def _read_reference(flight: TomlTable, folder: Path) -> Path | None:
    if "reference" not in flight:
        return None
    return folder / flight.table("reference", REFERENCE_KEYS).text("poses")
