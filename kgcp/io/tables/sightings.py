"""From rows of `detections.parquet` to the records that KGCPs and the bias study start from."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError, Status
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.georef.sighting import Sighting
from kgcp.io.tables.parquet import read_detections
from kgcp.quality.bias_study import Attempt, Exposure
from kgcp.settings import DetectSettings, Method
from kgcp.targets.layout import Target

_Row = Mapping[Hashable, object]


def read_attempts(path: Path, targets: Sequence[Target]) -> list[Attempt]:
    """Read the detections of a flight, without unreadable frames, in the frames' order.

    A frame is numbered by its place among all frames, unreadable ones included, so that the
    numbers do not depend on what was found.

    Raises
    ------
    KgcpError
        If the table is missing or unreadable, or names a target that flight.toml does not have.
    """
    table = read_detections(path)
    strange = sorted(set(table["target"]) - {target.name for target in targets})
    if strange:
        raise KgcpError(
            f"{path}: has target {strange[0]!r}, which flight.toml does not;"
            " run 'kgcp detect' on this flight again"
        )
    numbers = {frame: number for number, frame in enumerate(sorted(set(table["frame"])), start=1)}
    readable = table[table["status"] != Status.UNREADABLE.value]
    ordered = readable.sort_values(["frame", "target", "instance"])
    return [_attempt(row, numbers[row["frame"]]) for row in ordered.to_dict("records")]


def read_settings(path: Path) -> DetectSettings:
    """Read the settings that a table of detections was made with; the defaults for what it lacks.

    Raises
    ------
    KgcpError
        If the table does not tell them in this version's words.
    """
    text = (pq.read_schema(path).metadata or {}).get(b"kgcp.settings", b"{}")
    try:
        values = json.loads(text)
        known = {field.name for field in fields(DetectSettings)} & values.keys()
        settings = DetectSettings(**{name: values[name] for name in known})
        return replace(settings, method=Method(settings.method))
    except (AttributeError, TypeError, ValueError, RecursionError) as error:
        raise KgcpError(
            f"{path}: its settings are not of this version of kgcp ({error});"
            " run 'kgcp detect' on this flight again"
        ) from error


def _attempt(row: _Row, number: int) -> Attempt:
    time = row["time"]
    time_s = time.timestamp() if isinstance(time, pd.Timestamp) else None
    measured = row["status"] == Status.MEASURED.value
    return Attempt(
        frame=str(row["frame"]),
        target=str(row["target"]),
        time_s=time_s,
        sighting=_sighting(row, number, time_s) if measured else None,
        exposure=Exposure(**{field.name: _number(row, field.name) for field in fields(Exposure)}),
    )


def _sighting(row: _Row, number: int, time_s: float | None) -> Sighting:
    sd_x, sd_y, cov_xy = (_number(row, name) for name in ("sd_x_px", "sd_y_px", "cov_xy_px2"))
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
        centre_px=np.array([_known(row, "x_px"), _known(row, "y_px")]),
        centre_cov_px2=cov,
        distance_m=_known(row, "distance_m"),
        sd_distance_m=_number(row, "sd_distance_m"),
        sd_common_distance_m=_number(row, "sd_common_distance_m"),
        pose=_pose(row),
        pose_cov=_square(row, "pose_cov", 6),
        score=_number(row, "score"),
        ambiguity=_number(row, "ambiguity"),
        common_pose_cov=_square(row, "common_pose_cov", 6),
    )


def _pose(row: _Row) -> Pose | None:
    translation = [_number(row, name) for name in ("tx_m", "ty_m", "tz_m")]
    quaternion = [_number(row, name) for name in ("qw", "qx", "qy", "qz")]
    if None in translation or None in quaternion:
        return None
    components = np.array(quaternion, float)
    if not np.linalg.norm(components) > 0.5:  # written ones have the norm 1
        raise KgcpError(
            f"detections of {row['frame']!r}: the quaternion is none;"
            " run 'kgcp detect' on this flight again"
        )
    rotation = Rotation.from_quat(components, scalar_first=True)
    return Pose(rotation.as_matrix(), np.array(translation, float))


def _square(row: _Row, name: str, size: int) -> FloatArray | None:
    value = row[name]
    if not isinstance(value, np.ndarray) or value.size != size * size:
        return None
    return value.astype(np.float64).reshape(size, size)


def _number(row: _Row, name: str) -> float | None:
    value = row[name]
    return float(value) if isinstance(value, float) and np.isfinite(value) else None


def _known(row: _Row, name: str) -> float:
    value = _number(row, name)
    if value is None:
        raise KgcpError(
            f"detections of {row['frame']!r}: {name} is empty in a measured row;"
            " run 'kgcp detect' on this flight again"
        )
    return value
