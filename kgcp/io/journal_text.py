"""Records of one frame as text, and back without the loss of a bit.

Not by pickling: a journal lies in a folder that may come from anybody, and a pickle may run code.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from kgcp.errors import Reason
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.io.detections import FrameResult
from kgcp.io.exif import Exif
from kgcp.target.observation import (
    Alternative,
    Appearance,
    CommonUncertainty,
    Miss,
    Observation,
    Uncertainty,
)

_RECORDS: dict[str, type] = {
    each.__name__: each
    for each in (
        *(FrameResult, Exif, Observation, Miss, Pose, Ellipse),
        *(Appearance, Uncertainty, CommonUncertainty, Alternative),
    )
}
_REASONS: dict[str, Reason] = {reason.value: reason for reason in Reason}


def to_text(value: object) -> str:
    """Return records, arrays, tuples, mappings and plain values as one line of JSON.

    Floating-point numbers have as many digits as tell them from all others.
    """
    return json.dumps(value, default=_plain, separators=(",", ":"))


def from_text(text: str | bytes) -> FrameResult:
    """Return the result of a frame that `to_text` wrote; arrays are of float64, and in C order.

    Raises
    ------
    ValueError
        If it is anything else.
    """
    try:
        result = json.loads(text, object_hook=_record)
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"no record: {error}") from error
    if not isinstance(result, FrameResult):
        raise ValueError(f"a {type(result).__name__}, and not the result of a frame")
    return result


def fingerprint(*values: object) -> str:
    """Return 32 hexadecimal digits that tell such values from all others."""
    return hashlib.sha256(to_text(values).encode()).hexdigest()[:32]


def _plain(value: object) -> object:
    if is_dataclass(value):
        cells = {field.name: getattr(value, field.name) for field in fields(value)}
        return {"record": type(value).__name__, **cells}
    if isinstance(value, np.ndarray):
        return {"array": value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no text")


def _record(cells: dict[str, Any]) -> object:
    if "array" in cells:
        return np.array(cells["array"], dtype=np.float64)
    kind = _RECORDS[cells.pop("record")]
    if kind is Miss:
        cells["reason"] = _REASONS[cells["reason"]]
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in cells.items()})
