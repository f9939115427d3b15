"""The flight folder: flight.toml into validated records."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.io.files.safe_read import is_file, is_folder, is_no_file, remedy_for_missing
from kgcp.io.flight.camera_table import (
    CAMERA_KEYS,
    read_camera,
    read_plumb_sd_deg,
)
from kgcp.io.flight.target_table import TARGETS_TOML, read_plain_targets, read_targets
from kgcp.io.flight.toml_file import read_toml
from kgcp.io.flight.toml_table import TomlTable
from kgcp.io.flight.vehicle_table import VehicleTable, read_vehicle
from kgcp.io.formats.frame_times import FORMATS as TIMES_FORMATS
from kgcp.io.formats.orientations import FORMATS as POSE_FORMATS
from kgcp.io.formats.orientations.records import OrientationFileOptions
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.quality.checks.calibration import CalibrationGrade
from kgcp.settings import require_kind
from kgcp.targets.layout import Target
from kgcp.targets.plain import AnyTarget, PlainTarget

REFERENCE_KEYS = ("poses", "format", "crs", "offset")

FLIGHT_KEYS = ("name", "crs", "frames", "camera", "target", "vehicle", "reference")
FRAMES_KEYS = ("folder", "times", "times_format", "exif_fallback")


@dataclass(frozen=True, slots=True)
class Reference:
    """The camera's poses from an adjustment."""

    file: Path  # it is not looked for until a command needs it
    options: OrientationFileOptions


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight folder.

    Attributes
    ----------
    name : str
        Of the flight; the folder's where flight.toml gives none.
    crs : str or None
        Coordinate reference system of vehicle, reference and static targets, for pyproj.
    times_file : Path or None
        Frame times; None: EXIF gives them.
    times_format : str or None
        Of that file; None: its content tells.
    may_use_exif_times : bool
        Whether EXIF gives the time of a frame that the times file, if there is one, does not name.
    calibration_covariance : CalibrationCovariance or None
        How well the camera is calibrated; None: flight.toml does not say.
    exif_camera : ExifCamera
        The camera by EXIF of the photographs that it was calibrated from.
    calibration_grade : CalibrationGrade or None
        The verdict of `kgcp calibrate` on the camera; None: it is not by `kgcp calibrate`.
    is_camera_guessed : bool
        Whether the camera is only a guess, as `kgcp init` makes it from EXIF.
    plumb_sd_deg : float or None
        Standard deviation of the camera's optical axis against the vertical, about either
        horizontal axis, in frames without reference attitude [deg]; None: not known.
    targets : tuple of Target
        With a code, in the order of the file.
    plain_targets : tuple of PlainTarget
        Without one, in the order of the file.
    """

    folder: Path
    name: str
    crs: str | None
    frames_folder: Path
    times_file: Path | None
    times_format: str | None
    may_use_exif_times: bool
    camera: Camera
    calibration_covariance: CalibrationCovariance | None
    exif_camera: ExifCamera
    calibration_grade: CalibrationGrade | None
    is_camera_guessed: bool
    plumb_sd_deg: float | None
    targets: tuple[Target, ...]
    plain_targets: tuple[PlainTarget, ...]
    vehicle: VehicleTable | None
    reference: Reference | None
    toml_text: str

    @property
    def all_targets(self) -> tuple[AnyTarget, ...]:
        """Those with a code, then those without."""
        return (*self.targets, *self.plain_targets)

    @property
    def static_targets(self) -> tuple[AnyTarget, ...]:
        """Those with stated positions."""
        return tuple(target for target in self.all_targets if target.position_m is not None)


def read_flight(folder: Path | str) -> Flight:
    """Read and validate the flight.toml of a flight folder.

    Raises
    ------
    KgcpError
        In one line with file, table, key and remedy: if the file is missing or not TOML, a key
        is unknown, missing or of the wrong type, a value impossible, or the frames' folder, the
        times file or the calibration file does not exist.
    """
    folder = Path(folder)
    table, text = _read_flight_toml(folder)
    frames_folder, times_file, times_format = _read_frames(table, folder)
    exif_fallback = table.table("frames", FRAMES_KEYS, required=False).boolean(
        "exif_fallback", default=False
    )
    camera = table.table("camera", CAMERA_KEYS)
    vehicle = read_vehicle(table, folder)
    targets = read_targets(table, folder)
    plain_targets = read_plain_targets(table, _names_of(targets))
    plumb_sd_deg = read_plumb_sd_deg(camera)
    if plumb_sd_deg is not None and (vehicle is None or vehicle.settings.level_sd_deg is None):
        raise camera.error("plumb_sd_deg", "needs [vehicle] level_sd_deg", "give both or none")
    stated = read_camera(camera, folder)
    return Flight(
        folder=folder,
        name=table.optional("name", table.name) or _name_of(folder),
        crs=table.optional("crs", table.text),
        frames_folder=frames_folder,
        times_file=times_file,
        times_format=times_format,
        may_use_exif_times=times_file is None or exif_fallback,
        camera=stated.camera,
        calibration_covariance=stated.covariance,
        exif_camera=stated.by_exif,
        calibration_grade=stated.grade,
        is_camera_guessed=camera.boolean("guessed", default=False),
        plumb_sd_deg=plumb_sd_deg,
        targets=targets,
        plain_targets=plain_targets,
        vehicle=vehicle,
        reference=_read_reference(table, folder),
        toml_text=text,
    )


def require_flight(flight: object) -> None:
    """Refuse what is no flight; programs give its folder instead.

    Raises
    ------
    SettingError
    """
    require_kind("flight", flight, Flight, "give kgcp.read_flight(folder)")


def read_printed_targets(folder: Path) -> tuple[Target, ...]:
    """Read the targets alone: of a flight that has no frames yet, nor perhaps a camera.

    Raises
    ------
    KgcpError
        As `read_flight`, for what is wrong with the targets.
    """
    table, _ = _read_flight_toml(folder)
    targets = read_targets(table, folder)
    if not targets:
        raise table.error("target", "has no code in any table", "describe the target to be drawn")
    return targets


def read_target_tables(path: Path) -> tuple[Target, ...]:
    """Read the targets of a file: a flight.toml, or the targets.toml of `kgcp target`.

    Raises
    ------
    KgcpError
        As `read_flight`, for what is wrong with the targets.
    """
    return read_targets(read_toml(path, FLIGHT_KEYS, "the targets")[0], path.parent)


def refuse_to_lose_targets(
    targets: Sequence[Target], known: Sequence[Target], folder: Path
) -> None:
    """Refuse to write targets over a targets.toml that has others, which may have been printed.

    Parameters
    ----------
    targets : sequence of Target
        Those to be written.
    known : sequence of Target
        Those of the flight.toml, which has them in any case.
    folder : Path
        That of the targets.toml.

    Raises
    ------
    KgcpError
        Naming the file and the targets; also if the file cannot be read.
    """
    path = folder / TARGETS_TOML
    if not is_file(path):
        return
    kept = {target.name for target in known}
    lost = [
        target.name
        for target in read_target_tables(path)
        if target.name not in kept and target not in targets
    ]
    if lost:
        raise KgcpError(
            f"{path}: has {', '.join(lost)} of an earlier run, whose codes and lengths would be"
            " lost; to draw more for the same flight, copy its tables into flight.toml and name"
            " that flight, so that codes differ; otherwise write to another folder, or delete the"
            " file if these are not printed",
            option="out",
        )


def read_camera_and_targets(
    folder: Path,
) -> tuple[Camera, CalibrationCovariance | None, tuple[AnyTarget, ...]]:
    """Read the camera, how well it is known, and the targets of a flight without frames yet.

    Raises
    ------
    KgcpError
        As `read_flight`, for what is wrong with them.
    """
    table, _ = _read_flight_toml(folder)
    stated = read_camera(table.table("camera", CAMERA_KEYS), folder)
    targets = read_targets(table, folder)
    return (
        stated.camera,
        stated.covariance,
        (*targets, *read_plain_targets(table, _names_of(targets))),
    )


def _names_of(targets: Sequence[Target]) -> set[str]:
    return {ring.name for target in targets for ring in target.rings}


def _name_of(folder: Path) -> str:
    """Return a folder's own name, as far as it is text."""
    return os.fsencode(folder.resolve().name).decode(errors="replace")


def _read_flight_toml(folder: Path) -> tuple[TomlTable, str]:
    path = folder / "flight.toml"
    if is_file(folder):
        raise KgcpError(f"{folder}: is a file; name the flight folder, which has a flight.toml")
    if is_no_file(path):
        remedy = "name a flight folder, which has a flight.toml ('kgcp init' writes one)"
        raise KgcpError(f"{path}: does not exist; {remedy_for_missing(path, remedy)}")
    return read_toml(path, FLIGHT_KEYS, "FLIGHT")


def _read_frames(flight: TomlTable, folder: Path) -> tuple[Path, Path | None, str | None]:
    """Return the frames' folder, the times file and its format, all but the last by default."""
    table = flight.table("frames", FRAMES_KEYS, required=False)
    name = table.optional("folder", lambda key: table.path(key, folder)) or "frames"
    if not is_folder(folder / name):
        raise table.error("folder", f"{name!r} is not a folder", "create or correct it")
    default = folder / "frames.csv"
    times = default if is_file(default) else None
    if "times" in table:
        times = table.existing_file("times", folder)
    times_format = table.optional(
        "times_format", lambda key: table.choice(key, TIMES_FORMATS.names)
    )
    if times_format is not None and times is None:
        raise table.error("times_format", "needs a file", "give times as well")
    return folder / name, times, times_format


def _read_reference(flight: TomlTable, folder: Path) -> Reference | None:
    if "reference" not in flight:
        return None
    table = flight.table("reference", REFERENCE_KEYS)
    options = OrientationFileOptions(
        form=table.optional("format", lambda key: table.choice(key, POSE_FORMATS.names)),
        crs=table.optional("crs", table.text),
        offset_file=table.optional("offset", lambda key: table.existing_file(key, folder)),
    )
    return Reference(folder / table.path("poses", folder), options)
