"""The [vehicle] table of flight.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from kgcp.io.files.csv_columns import DECIMALS, SEPARATORS, CsvLayout
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.flight.toml_table import TomlTable
from kgcp.io.formats.trajectories import FORMATS
from kgcp.io.formats.trajectories.csv import COLUMNS
from kgcp.io.formats.trajectories.records import TrajectoryFileOptions, Wander
from kgcp.settings import VehicleSettings

VEHICLE_KEYS = (
    *("trajectory", "format", "separator", "decimal", "columns"),
    *("crs", "time_system", "date", "accuracies", "wander"),
    *("attitude", "sd_attitude_deg", "lever_arm_m", "sd_lever_arm_m", "mount_deg"),
    *("sd_time_s", "time_offset_s", "level_sd_deg", "correlation_s"),
)
_COURSE = "course"
_LEVER_ARM = "[forward, right, down] in metres from the trajectory point to the target's centre"


@dataclass(frozen=True, slots=True)
class VehicleTable:
    """The [vehicle] table of flight.toml."""

    settings: VehicleSettings
    trajectory_file: Path  # it is not looked for until a command needs it
    options: TrajectoryFileOptions


def read_vehicle(flight: TomlTable, folder: Path) -> VehicleTable | None:
    """Read the table of the vehicle, if the flight has one.

    Raises
    ------
    KgcpError
        If a key is unknown, missing, of the wrong type or without its companion, or a value
        impossible.
    """
    if "vehicle" not in flight:
        return None
    table = flight.table("vehicle", VEHICLE_KEYS)
    with table.located():
        settings = VehicleSettings(
            # Without a default: of a forgotten one the points would be off by metres.
            lever_arm_m=table.vector("lever_arm_m", example=_LEVER_ARM),
            sd_lever_arm_m=table.vector("sd_lever_arm_m", (0.0, 0.0, 0.0)),
            mount_deg=table.number("mount_deg", 0.0),
            sd_time_s=table.number("sd_time_s", 0.0),
            time_offset_s=table.number("time_offset_s", 0.0),
            level_sd_deg=table.optional("level_sd_deg", table.number),
            correlation_s=table.number("correlation_s", 60.0),
        )
    accuracies = table.optional("accuracies", lambda key: table.path(key, folder))
    options = TrajectoryFileOptions(
        format=table.optional("format", lambda key: table.choice(key, FORMATS.names)),
        crs=table.optional("crs", table.text),
        time_system=table.optional("time_system", lambda key: table.choice(key, TimeSystem)),
        first_day=table.optional("date", table.day),
        accuracies_file=None if accuracies is None else folder / accuracies,
        wander=table.optional("wander", lambda key: table.choice(key, Wander)),
        course_sd_deg=_read_course(table),
        layout=_read_layout(table),
    )
    return VehicleTable(settings, folder / table.path("trajectory", folder), options)


def _read_course(table: TomlTable) -> tuple[float, float, float] | None:
    """Return the deviations of an attitude that is taken from the course, if it is."""
    if ("attitude" in table) != ("sd_attitude_deg" in table):
        absent = "sd_attitude_deg" if "attitude" in table else "attitude"
        raise table.error(
            absent,
            "is missing",
            'attitude = "course" and sd_attitude_deg = [roll, pitch, heading] are needed together',
        )
    if "attitude" not in table:
        return None
    table.choice("attitude", [_COURSE])
    deviations = table.vector("sd_attitude_deg", example="[roll, pitch, heading]")
    if min(deviations) < 0.0 or max(deviations) > 180.0:
        raise table.error(
            "sd_attitude_deg", f"{list(deviations)} is out of range", "give values of 0 to 180 deg"
        )
    return deviations


def _read_layout(table: TomlTable) -> CsvLayout:
    """Return how a CSV file is written; by default as docs/foreign_files.md says."""
    separator = table.optional("separator", lambda key: table.mark(key, SEPARATORS)) or ","
    decimal = table.optional("decimal", lambda key: table.mark(key, DECIMALS)) or "."
    if separator == decimal:
        raise table.error(
            "separator", "is the decimal mark, too", 'give decimal = "," with separator = ";"'
        )
    columns = table.table("columns", COLUMNS, required=False)
    return CsvLayout(separator, decimal, {key: columns.text(key) for key in columns.values})
