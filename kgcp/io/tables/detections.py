"""`detections.parquet`: rows from results of frames, and records from rows."""

from __future__ import annotations

import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError, KgcpWarning, Status
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.georef.sighting import Attempt, Exposure, Sighting
from kgcp.io.files.safe_read import is_no_file
from kgcp.io.flight.flight import Flight
from kgcp.io.tables.columns import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    TEXT,
    TIME,
    Column,
    Row,
    finite_cell,
    matrix_cell,
    row_of,
    time_cell,
)
from kgcp.io.tables.learnt_imaging import LEARNT_IMAGING, learnt_from_text
from kgcp.io.tables.parquet import read_table
from kgcp.io.tables.staleness import require_current
from kgcp.measurement.records import (
    Alternative,
    CircleImage,
    CommonUncertainty,
    FrameResult,
    Measurement,
    Miss,
    Outcome,
    Uncertainty,
)
from kgcp.quality.learnt_imaging import LearntImaging
from kgcp.settings import DetectSettings
from kgcp.targets.plain import Shape

if TYPE_CHECKING:  # 0.3 s that `kgcp detect` does not need
    import pandas as pd

_Cells = Mapping[Hashable, object]
_MEASURED = Status.MEASURED.value
_MAX_NUMBER = 1e12  # in the unit of its column; larger numbers are treated as infinite
_MAX_COORDINATE_PX = 1e6  # absolute, of a target's centre
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 1e-3, 1e6
_Part = TypeVar("_Part")
_Record = tuple[FrameResult, Outcome, Shape]
_Get = Callable[[_Record], Any]


def _frame(get: Callable[[FrameResult], object]) -> _Get:
    return lambda record: get(record[0])


def _outcome(
    of_measurement: Callable[[Measurement], object], of_miss: Callable[[Miss], object]
) -> _Get:
    def get(record: _Record) -> object:
        outcome = record[1]
        return of_miss(outcome) if isinstance(outcome, Miss) else of_measurement(outcome)

    return get


def _measured(get: Callable[[Measurement], object]) -> _Get:
    return _outcome(get, lambda _: None)


def _part(part: Callable[[Measurement], _Part | None], get: Callable[[_Part], object]) -> _Get:
    """Get from a part of a measurement; null where the method does not estimate it."""

    def of_measurement(measurement: Measurement) -> object:
        value = part(measurement)
        return None if value is None else get(value)

    return _measured(of_measurement)


def _uncertainty(get: Callable[[Uncertainty], object]) -> _Get:
    return _part(lambda measurement: measurement.uncertainty, get)


def _common(get: Callable[[CommonUncertainty], object]) -> _Get:
    return _part(lambda measurement: measurement.common, get)


def _alternative(get: Callable[[Alternative], object]) -> _Get:
    return _part(lambda measurement: measurement.alternative, get)


def _image(measurement: Measurement) -> CircleImage | None:
    return measurement.image


@lru_cache(maxsize=2)
def _quaternion(pose: Pose) -> list[float]:
    quaternion: list[float] = pose.quaternion_wxyz.tolist()
    return quaternion


DETECTION_COLUMNS: tuple[Column[_Record], ...] = (
    Column("frame", TEXT, _frame(lambda result: result.frame)),
    Column("target", TEXT, lambda record: record[1].target),
    Column("shape", TEXT, lambda record: record[2].value),
    Column("time", TIME, _frame(lambda result: time_cell(result.time_s))),
    Column("time_source", TEXT, _frame(lambda result: result.time_source.value)),
    Column("instance", INTEGER, _outcome(lambda measurement: measurement.instance, lambda _: 0)),
    Column("status", TEXT, _outcome(lambda _: _MEASURED, lambda miss: miss.reason.status.value)),
    Column("reason", TEXT, _outcome(lambda _: "", lambda miss: miss.reason.value)),
    Column("detail", TEXT, _outcome(lambda _: "", lambda miss: miss.detail)),
    Column("candidates", INTEGER, _outcome(lambda _: 0, lambda miss: miss.candidates)),
    Column("guided", BOOLEAN, _outcome(lambda measurement: measurement.is_guided, lambda _: False)),
    Column("scale_used", TEXT, _outcome(lambda measurement: measurement.ring, lambda _: "")),
    *Column[_Record].of_vector(
        ("x_px", "y_px"), _measured(lambda measurement: measurement.centre_px)
    ),
    *Column[_Record].of_sds(("sd_x_px", "sd_y_px"), _uncertainty(lambda sds: sds.centre_cov_px2)),
    Column("cov_xy_px2", NUMBER, _uncertainty(lambda sds: float(sds.centre_cov_px2[0, 1]))),
    Column("distance_m", NUMBER, _measured(lambda measurement: measurement.pose.distance_m)),
    Column("sd_distance_m", NUMBER, _uncertainty(lambda sds: sds.sd_distance_m)),
    *Column[_Record].of_vector(
        ("tx_m", "ty_m", "tz_m"), _measured(lambda measurement: measurement.pose.translation_m)
    ),
    *Column[_Record].of_vector(
        ("qw", "qx", "qy", "qz"), _measured(lambda measurement: _quaternion(measurement.pose))
    ),
    Column("roll_deg", NUMBER, _measured(lambda measurement: measurement.pose.roll_deg)),
    Column("pitch_deg", NUMBER, _measured(lambda measurement: measurement.pose.pitch_deg)),
    Column("heading_deg", NUMBER, _measured(lambda measurement: measurement.heading_deg)),
    Column("sd_roll_deg", NUMBER, _uncertainty(lambda sds: sds.sd_roll_deg)),
    Column("sd_pitch_deg", NUMBER, _uncertainty(lambda sds: sds.sd_pitch_deg)),
    Column("sd_heading_deg", NUMBER, _uncertainty(lambda sds: sds.sd_heading_deg)),
    Column("pose_cov", NUMBERS, _uncertainty(lambda sds: matrix_cell(sds.pose_cov))),
    *Column[_Record].of_vector(
        ("alt_qw", "alt_qx", "alt_qy", "alt_qz"),
        _alternative(lambda other: _quaternion(other.pose)),
    ),
    Column("ambiguity", NUMBER, _alternative(lambda other: other.ambiguity)),
    Column("sd_common_distance_m", NUMBER, _common(lambda common: common.sd_distance_m)),
    Column("sd_common_direction_mrad", NUMBER, _common(lambda common: common.sd_direction_mrad)),
    Column("common_pose_cov", NUMBERS, _common(lambda common: matrix_cell(common.pose_cov))),
    *Column[_Record].of_vector(
        ("ecc_x_px", "ecc_y_px"), _measured(lambda measurement: measurement.eccentricity_px)
    ),
    Column("moments", NUMBERS, _part(_image, lambda image: matrix_cell(image.moments))),
    Column("moments_cov", NUMBERS, _part(_image, lambda image: matrix_cell(image.cov))),
    Column(
        "score",
        NUMBER,
        _outcome(lambda measurement: finite_cell(measurement.score), lambda miss: miss.score),
    ),
    Column("radius_px", NUMBER, _measured(lambda measurement: measurement.appearance.radius_px)),
    Column("blur_px", NUMBER, _measured(lambda measurement: measurement.appearance.blur_px)),
    Column(
        "edge_shift_px", NUMBER, _measured(lambda measurement: measurement.appearance.edge_shift_px)
    ),
    Column(
        "inner_growth",
        NUMBER,
        _measured(lambda measurement: measurement.appearance.inner_growth),
        is_later=True,
    ),
    Column(
        "dots_growth",
        NUMBER,
        _measured(lambda measurement: measurement.appearance.dots_growth),
        is_later=True,
    ),
    Column("black", NUMBER, _measured(lambda measurement: measurement.appearance.black)),
    Column("white", NUMBER, _measured(lambda measurement: measurement.appearance.white)),
    Column("saturated", NUMBER, _measured(lambda measurement: measurement.appearance.saturated)),
    Column("exposure_time_s", NUMBER, _frame(lambda result: result.exposure.exposure_time_s)),
    Column("iso", NUMBER, _frame(lambda result: result.exposure.iso)),
    Column("f_number", NUMBER, _frame(lambda result: result.exposure.f_number)),
)


def detection_rows(result: FrameResult, shapes: Mapping[str, Shape]) -> list[Row]:
    """Return the rows of one frame, one per target and instance, sorted by both.

    Parameters
    ----------
    shapes : mapping of str to Shape
        Of all targets, by their names.
    """

    def sort_key(outcome: Outcome) -> tuple[str, int]:
        return outcome.target, 0 if isinstance(outcome, Miss) else outcome.instance

    outcomes = sorted(result.outcomes, key=sort_key)
    return [
        row_of(DETECTION_COLUMNS, (result, outcome, shapes[outcome.target])) for outcome in outcomes
    ]


def read_detections(path: Path | str, *, status: str | None = None) -> pd.DataFrame:
    """Read a table of detections, whose columns docs/tables.md explains.

    Parameters
    ----------
    path : Path
        `detections.parquet`.
    status : str, optional
        Only rows with this status, for example "measured"; by default all.

    Raises
    ------
    KgcpError
        If the table is missing, unreadable or damaged, or the status is unknown.
    """
    path = Path(path)
    if is_no_file(path):
        raise KgcpError(f"{path}: does not exist; run 'kgcp detect' on this flight first")
    if status is not None and status not in set(Status):
        raise KgcpError(f"status {status!r}: is unknown; give one of {', '.join(Status)}")
    table = read_table(path, DETECTION_COLUMNS)
    return table if status is None else table[table["status"] == status].reset_index(drop=True)


def read_attempts(path: Path, flight: Flight) -> list[Attempt]:
    """Read the detections of a flight, without unreadable frames, in the order of the frames.

    Frames are numbered by their place among all frames, including unreadable ones, so that the
    numbers do not depend on what was detected.

    Raises
    ------
    KgcpError
        If the table is missing or unreadable, was made from another flight.toml or times file,
        names a target that flight.toml does not have, or has no readable frame.
    """
    table = read_detections(path)
    require_current(path, table, flight)
    names = pq.read_schema(path).names
    absent = [column.name for column in DETECTION_COLUMNS if column.name not in names]
    if absent:
        warnings.warn(
            f"{path}: an older kgcp wrote it, without {', '.join(absent)}: doubts that need this"
            " are not raised; repeat 'kgcp detect' to have them",
            KgcpWarning,
            stacklevel=2,
        )
    unknown = sorted(set(table["target"]) - {target.name for target in flight.all_targets})
    if unknown:
        raise KgcpError(
            f"{path}: has target {unknown[0]!r}, which flight.toml does not have;"
            " run 'kgcp detect' on this flight again"
        )
    duplicates = table[table.duplicated(["frame", "target", "instance"])]
    if len(duplicates):
        frame, target = duplicates.iloc[0][["frame", "target"]]
        raise KgcpError(
            f"{path}: has target {target!r} of {frame!r} twice; run 'kgcp detect' on this flight"
            " again"
        )
    numbers = {frame: number for number, frame in enumerate(sorted(set(table["frame"])), start=1)}
    readable = table[table["status"] != Status.UNREADABLE.value]
    if readable.empty:
        raise KgcpError(f"{path}: has no readable frame; run 'kgcp detect' on this flight again")
    ordered = readable.sort_values(["frame", "target", "instance"])
    return [_attempt(row, numbers[row["frame"]]) for row in ordered.to_dict("records")]


@dataclass(frozen=True, slots=True)
class Outcomes:
    """Summary of a table of detections."""

    frames: int
    rows: int  # frames times targets, plus further plates
    measured: int
    reasons: tuple[tuple[str, int], ...]  # why rows were not measured, the commonest first
    # times of the first and the last frame, Unix UTC [s]; None: no frame has one
    first_s: float | None
    last_s: float | None
    # median and largest distance between the centroid of a target's image and the image of its
    # centre [px]; None: no target was measured
    eccentricity_px: tuple[float, float] | None = None


def read_outcomes(path: Path) -> Outcomes:
    """Summarise a table of detections.

    Raises
    ------
    KgcpError
        As `read_detections`.
    """
    table = read_detections(path)
    reasons = Counter(table["reason"][table["status"] != Status.MEASURED.value])
    times = table["time"].dropna()
    eccentricities_px = table[["ecc_x_px", "ecc_y_px"]].dropna().to_numpy(np.float64)
    lengths_px = np.hypot(*eccentricities_px.T)
    return Outcomes(
        frames=table["frame"].nunique(),
        rows=len(table),
        measured=int((table["status"] == Status.MEASURED.value).sum()),
        reasons=tuple(reasons.most_common()),
        first_s=None if times.empty else times.min().timestamp(),
        last_s=None if times.empty else times.max().timestamp(),
        eccentricity_px=(
            (float(np.median(lengths_px)), float(lengths_px.max())) if len(lengths_px) else None
        ),
    )


def read_settings(path: Path) -> DetectSettings:
    """Read the settings of a table of detections; those that it lacks have their defaults.

    Raises
    ------
    KgcpError
        If they are not valid in this version of kgcp.
    """
    text = (pq.read_schema(path).metadata or {}).get(b"kgcp.settings", b"{}")
    try:
        values = json.loads(text)
        names = {field.name for field in fields(DetectSettings)} & values.keys()
        return DetectSettings(**{name: values[name] for name in names})
    except (AttributeError, KgcpError, TypeError, ValueError, RecursionError) as error:
        raise KgcpError(
            f"{path}: its settings are not valid in this version of kgcp ({error});"
            " run 'kgcp detect' on this flight again"
        ) from error


def read_learnt_imaging(path: Path) -> LearntImaging | None:
    """Read what was learnt about a flight's camera; None if nothing, or written by another version.

    It is only displayed and changes no result.
    """
    text = (pq.read_schema(path).metadata or {}).get(f"kgcp.{LEARNT_IMAGING}".encode())
    try:
        return None if text is None else learnt_from_text(text.decode())
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
        return None


def _attempt(row: _Cells, number: int) -> Attempt:
    import pandas as pd  # loaded already, by reading the row

    time = row["time"]
    time_s = time.timestamp() if isinstance(time, pd.Timestamp) else None
    measured = row["status"] == _MEASURED
    return Attempt(
        frame=str(row["frame"]),
        target=str(row["target"]),
        time_s=time_s,
        sighting=_sighting(row, number, time_s) if measured else None,
        exposure=Exposure(**{field.name: _number(row, field.name) for field in fields(Exposure)}),
    )


def _sighting(row: _Cells, number: int, time_s: float | None) -> Sighting:
    sd_x, sd_y = (_sd(row, name) for name in ("sd_x_px", "sd_y_px"))
    cov_xy = _number(row, "cov_xy_px2")
    cov = None
    if sd_x is not None and sd_y is not None:
        cov_xy = cov_xy or 0.0
        cov = np.array([[sd_x**2, cov_xy], [cov_xy, sd_y**2]])
    return Sighting(
        frame=str(row["frame"]),
        number=number,
        target=str(row["target"]),
        instance=int(str(row["instance"])),
        time_s=time_s,
        centre_px=np.array(
            [
                _required(row, name, -_MAX_COORDINATE_PX, _MAX_COORDINATE_PX)
                for name in ("x_px", "y_px")
            ]
        ),
        centre_cov_px2=cov,
        distance_m=_required(row, "distance_m", _MIN_DISTANCE_M, _MAX_DISTANCE_M),
        sd_distance_m=_sd(row, "sd_distance_m"),
        sd_common_distance_m=_number(row, "sd_common_distance_m"),
        pose=_pose(row),
        pose_cov=_matrix(row, "pose_cov", 6),
        score=_number(row, "score"),
        ambiguity=_number(row, "ambiguity"),
        common_pose_cov=_matrix(row, "common_pose_cov", 6),
        image=_circle_image(row),
        inner_growth=_number(row, "inner_growth"),
        dots_growth=_number(row, "dots_growth"),
    )


def _pose(row: _Cells) -> Pose | None:
    translation = [_number(row, name) for name in ("tx_m", "ty_m", "tz_m")]
    quaternion = [_number(row, name) for name in ("qw", "qx", "qy", "qz")]
    if None in translation or None in quaternion:
        return None
    components = np.array(quaternion, float)
    if not np.linalg.norm(components) > 0.5:  # kgcp writes unit quaternions
        raise KgcpError(
            f"detections of {row['frame']!r}: invalid quaternion (norm ≈ 0);"
            " run 'kgcp detect' on this flight again"
        )
    rotation = Rotation.from_quat(components, scalar_first=True)
    return Pose(rotation.as_matrix(), np.array(translation, float))


def _circle_image(row: _Cells) -> CircleImage | None:
    moments, cov = row["moments"], _matrix(row, "moments_cov", 5)
    if cov is None or not isinstance(moments, np.ndarray) or moments.size != 5:
        return None
    return CircleImage(moments.astype(np.float64), cov)


def _matrix(row: _Cells, name: str, size: int) -> FloatArray | None:
    value = row[name]
    if not isinstance(value, np.ndarray) or value.size != size * size:
        return None
    return value.astype(np.float64).reshape(size, size)


def _number(row: _Cells, name: str) -> float | None:
    value = row[name]
    return float(value) if isinstance(value, float) and abs(value) < _MAX_NUMBER else None


def _cell_text(value: object) -> str:
    """Describe a cell that is not a number."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "empty"
    return f"{value!r}" if isinstance(value, float) else "not a number"


def _required(row: _Cells, name: str, minimum: float, maximum: float) -> float:
    value = _number(row, name)
    if value is None or not minimum <= value <= maximum:
        raise _invalid_cell(row, name)
    return value


def _sd(row: _Cells, name: str) -> float | None:
    """Return a standard deviation; None: the method does not estimate it."""
    value = _number(row, name)
    if value is not None and not value > 0.0:
        raise _invalid_cell(row, name)
    return value


def _invalid_cell(row: _Cells, name: str) -> KgcpError:
    return KgcpError(
        f"detections of {row['frame']!r}: {name} of a measured row is {_cell_text(row[name])};"
        " run 'kgcp detect' on this flight again"
    )
