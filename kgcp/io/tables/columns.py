"""The tables kgcp writes: every column's name, type and meaning, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum

Row = Mapping[str, object]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

SCHEMA_VERSION = "2"


def time_cell(time_s: float | None) -> datetime | None:
    """Return Unix seconds as a table cell: UTC, rounded to the microsecond."""
    return None if time_s is None else _EPOCH + timedelta(microseconds=round(time_s * 1e6))


class ColumnType(StrEnum):
    """Storage types of table columns; `TEXT`, `INTEGER` and `BOOLEAN` are never null."""

    TEXT = "text"
    INTEGER = "integer"
    BOOLEAN = "boolean"
    NUMBER = "number"
    TIME = "time"
    NUMBERS = "numbers"


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table."""

    name: str
    type: ColumnType
    meaning: str


_TEXT, _INTEGER, _NUMBER = ColumnType.TEXT, ColumnType.INTEGER, ColumnType.NUMBER
_BOOLEAN = ColumnType.BOOLEAN
_TIME, _NUMBERS = ColumnType.TIME, ColumnType.NUMBERS

_COMMON = "share of calibration and diameter: one error in all frames, not in {}"

_EXPOSURE = (
    Column("radius_px", _NUMBER, "semi-major axis of the main ring's outer ellipse [px]"),
    Column("blur_px", _NUMBER, "edge spread σ [px]"),
    Column("edge_shift_px", _NUMBER, "δ: displacement of the edges towards the dark side [px]"),
    Column("black", _NUMBER, "level of the ink, 0…1"),
    Column("white", _NUMBER, "level of the plate, 0…1"),
    Column("saturated", _NUMBER, "share of clipped pixels within the outer ellipse, 0…1"),
    Column("exposure_time_s", _NUMBER, "from EXIF [s]"),
    Column("iso", _NUMBER, "from EXIF"),
    Column("f_number", _NUMBER, "from EXIF"),
)

DETECTION_COLUMNS = (
    Column("frame", _TEXT, "path relative to the frames folder, with /"),
    Column("target", _TEXT, "name in flight.toml"),
    Column("time", _TIME, "mid-exposure, UTC; null where unknown"),
    Column("instance", _INTEGER, "0, 1, … among plates of one code in a frame, by score"),
    Column("status", _TEXT, "measured, not_found, rejected or unreadable"),
    Column("reason", _TEXT, "empty when measured, else a word of the registry"),
    Column("detail", _TEXT, "the numbers behind the reason; empty when measured"),
    Column("candidates", _INTEGER, "rings compared with a target that was not measured; else 0"),
    Column("guided", _BOOLEAN, "found only where other frames or the reference said it must be"),
    Column("scale_used", _TEXT, "the target's name, or the replica that was measured"),
    Column("x_px", _NUMBER, "projected circle centre in the raw image [px]"),
    Column("y_px", _NUMBER, "projected circle centre in the raw image [px]"),
    Column("sd_x_px", _NUMBER, "its standard deviation [px]"),
    Column("sd_y_px", _NUMBER, "its standard deviation [px]"),
    Column("cov_xy_px2", _NUMBER, "covariance of x_px and y_px [px²]"),
    Column("distance_m", _NUMBER, "camera centre to target centre [m]"),
    Column("sd_distance_m", _NUMBER, "its standard deviation [m]"),
    Column("tx_m", _NUMBER, "target centre in the camera frame [m]"),
    Column("ty_m", _NUMBER, "target centre in the camera frame [m]"),
    Column("tz_m", _NUMBER, "target centre in the camera frame [m]"),
    Column("qw", _NUMBER, "rotation target → camera, unit quaternion, qw ≥ 0"),
    Column("qx", _NUMBER, "rotation target → camera"),
    Column("qy", _NUMBER, "rotation target → camera"),
    Column("qz", _NUMBER, "rotation target → camera"),
    Column("roll_deg", _NUMBER, "φ: tilt of the plate's diameter in the camera's yz plane [deg]"),
    Column("pitch_deg", _NUMBER, "θ: tilt of the plate's diameter in the camera's xz plane [deg]"),
    Column("heading_deg", _NUMBER, "in-image direction of the target's +x, clockwise from x [deg]"),
    Column("sd_roll_deg", _NUMBER, "standard deviation of roll_deg [deg]"),
    Column("sd_pitch_deg", _NUMBER, "standard deviation of pitch_deg [deg]"),
    Column("sd_heading_deg", _NUMBER, "standard deviation of heading_deg [deg]"),
    Column("pose_cov", _NUMBERS, "36 numbers, row-major: t [m], rotation vector [rad]"),
    Column("alt_qw", _NUMBER, "rotation of the circle's other pose"),
    Column("alt_qx", _NUMBER, "rotation of the circle's other pose"),
    Column("alt_qy", _NUMBER, "rotation of the circle's other pose"),
    Column("alt_qz", _NUMBER, "rotation of the circle's other pose"),
    Column(
        "ambiguity",
        _NUMBER,
        "Δχ² by which the other pose is worse, prior included",
    ),
    Column("sd_common_distance_m", _NUMBER, _COMMON.format("sd_distance_m") + " [m]"),
    Column("sd_common_direction_mrad", _NUMBER, _COMMON.format("sd_x_px") + ", worst axis [mrad]"),
    Column("common_pose_cov", _NUMBERS, _COMMON.format("pose_cov") + "; 36 numbers as there"),
    Column("score", _NUMBER, "normalised cross-correlation of the code"),
    *_EXPOSURE,
)

KGCP_COLUMNS = (
    Column("id", _TEXT, "name of the point, unique in the flight"),
    Column("frame", _TEXT, "path relative to the frames folder, with /"),
    Column("target", _TEXT, "name in flight.toml"),
    Column("time", _TIME, "when the target was seen, UTC"),
    Column("x", _NUMBER, "easting or longitude, flight CRS"),
    Column("y", _NUMBER, "northing or latitude, flight CRS"),
    Column("z", _NUMBER, "height, flight CRS"),
    Column("sd_x", _NUMBER, "standard deviation along map x [m]"),
    Column("sd_y", _NUMBER, "standard deviation along map y [m]"),
    Column("sd_z", _NUMBER, "standard deviation along map z [m]"),
    Column("cov", _NUMBERS, "9 numbers, row-major, in map axes [m²]"),
    Column("cov_common", _NUMBERS, "share of lever arm and synchronisation in cov [m²]"),
    Column("common_effects", _NUMBERS, "3 × 4, row-major: factor of cov_common [m]"),
    Column("x_px", _NUMBER, "image point in the raw image [px]"),
    Column("y_px", _NUMBER, "image point in the raw image [px]"),
    Column("sd_x_px", _NUMBER, "its standard deviation [px]"),
    Column("sd_y_px", _NUMBER, "its standard deviation [px]"),
    Column("distance_m", _NUMBER, "camera centre to point [m]"),
    Column("sd_distance_m", _NUMBER, "its standard deviation [m]"),
    Column("sd_common_distance_m", _NUMBER, _COMMON.format("sd_distance_m") + " [m]"),
    Column("role", _TEXT, "control or check"),
    Column("flag", _TEXT, "empty, or what does not fit a smooth flight"),
)

BIAS_COLUMNS = (
    Column("frame", _TEXT, "path relative to the frames folder, with /"),
    Column("target", _TEXT, "name in flight.toml"),
    Column("time", _TIME, "mid-exposure, UTC"),
    Column("distance_m", _NUMBER, "measured in the image [m]"),
    Column("sd_distance_m", _NUMBER, "its standard deviation [m]"),
    Column(
        "one_edge_distance_m", _NUMBER, "as the outer edge alone gives it, exposure and all [m]"
    ),
    Column("two_edge_distance_m", _NUMBER, "without the displacement of the edges [m]"),
    Column("reference_distance_m", _NUMBER, "between reference camera position and target [m]"),
    Column("sd_reference_distance_m", _NUMBER, "its standard deviation [m]"),
    Column("residual_m", _NUMBER, "distance_m − reference_distance_m [m]"),
    Column("residual_percent", _NUMBER, "residual in percent of the reference distance"),
    *_EXPOSURE,
)

CONSISTENCY_COLUMNS = (
    Column("frame", _TEXT, "path relative to the frames folder, with /"),
    Column("target", _TEXT, "name in flight.toml"),
    Column("time", _TIME, "when the target was seen, by the trajectory's clock, UTC"),
    *(
        Column(f"{axis}_m", _NUMBER, f"place by the vehicle minus by the camera, {axis} [m]")
        for axis in ("along", "across", "up")
    ),
    *(
        Column(f"sd_{axis}_m", _NUMBER, "its standard deviation [m]")
        for axis in ("along", "across", "up")
    ),
    *(
        Column(f"residual_{axis}_m", _NUMBER, "what the corrections leave of it [m]")
        for axis in ("along", "across", "up")
    ),
    Column("outlier", _BOOLEAN, "whether it fits no correction and had no part in them"),
)
