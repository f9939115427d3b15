"""Whether a table of detections still belongs to its flight, and what has changed since."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.io.files.time_text import format_time
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frames import is_chosen, list_frames
from kgcp.io.images.remote import stamps_of
from kgcp.io.tables.provenance import (
    TARGET_TABLE,
    detection_inputs,
    digest,
    digested_times,
)
from kgcp.measurement.records import TimeSource
from kgcp.settings import DetectSettings

if TYPE_CHECKING:  # 0.3 s that `kgcp detect` does not need
    import pandas as pd

_SAME_TIME_S = 2e-6  # tables hold microseconds
_SAME_SHIFT_S = 1e-3  # spread of differences that are called one shift
_LONGEST_VALUE = 40  # characters of a value that is shown
_MOST_SHOWN = 6  # changes that are named one by one
_CAMERA_KEYS = {f"[camera] {field.name}" for field in fields(Camera)}  # every table has them


def refuse_to_replace_whole(path: Path) -> None:
    """Refuse to replace a table of all frames by one of some: that of all took the longer work.

    A table of some frames, and what is no table, may be replaced.

    Raises
    ------
    KgcpError
        If the table has all frames of its flight.
    """
    try:
        metadata = pq.read_schema(path).metadata or {}
    except (OSError, pa.ArrowException):  # there is none, or it is damaged
        return
    if b"kgcp.inputs" in metadata and b"kgcp.choice" not in metadata:
        raise KgcpError(
            f"{path}: has the detections of all frames, which would be lost; name another folder"
            " with --out, or delete this table",
            option="frames",
        )


def require_current(path: Path, table: pd.DataFrame, flight: Flight) -> None:
    """Refuse detections that were made from another camera, other targets, times or frames.

    What later commands read anew, as trajectory, lever arm, CRS and reference poses, may differ. A
    table that does not say what it was made from passes: kgcp has not written it.

    Parameters
    ----------
    path : Path
        The table's file, whose metadata say what it was made from.

    Raises
    ------
    KgcpError
        Naming what has changed, and the command to repeat.
    """
    metadata = pq.read_schema(path).metadata or {}
    inputs = _json(metadata, b"kgcp.inputs")
    if not inputs:
        return
    digests = _json(metadata, b"kgcp.digests")
    today = _frames_of_today(flight)
    chosen = _chosen(today, metadata)
    changes = [
        *_changed_keys(inputs, detection_inputs(flight)),
        *_changed_times(table, flight, digests, None if chosen == today else today),
        *_changed_frames(table, flight, digests, chosen),
    ]
    if changes:
        more = len(changes) - _MOST_SHOWN
        listed = ", ".join([*changes[:_MOST_SHOWN], *([f"{more} more"] if more > 0 else [])])
        raise KgcpError(
            f"{path}: does not belong to this flight any more; changed since 'kgcp detect':"
            f" {listed}; {_remedy(path, flight, _json(metadata, b'kgcp.settings'))}"
        )


def _frames_of_today(flight: Flight) -> list[str] | None:
    """Return the frames in the flight's folder; None: moved to an archive, or in a store."""
    try:
        return list_frames(flight.frames_folder)
    except KgcpError:
        return None


def _chosen(today: list[str] | None, metadata: Mapping[bytes, bytes]) -> list[str] | None:
    """Return the frames that the table would have if it were made today."""
    patterns = _json(metadata, b"kgcp.choice").get("frames")
    if today is None or not isinstance(patterns, list) or not patterns:
        return today
    return [frame for frame in today if is_chosen(frame, [*map(str, patterns)])]


def _json(metadata: Mapping[bytes, bytes], key: bytes) -> dict[str, object]:
    try:
        values = json.loads(metadata.get(key, b"{}"))
    except (ValueError, RecursionError):
        values = {}
    return values if isinstance(values, dict) else {}


def _remedy(path: Path, flight: Flight, settings: Mapping[str, object]) -> str:
    """Return the command to repeat, with the settings that were not the default ones."""
    folder = str(flight.folder)
    named = f'"{folder}"' if " " in folder else folder
    remedy = f"repeat 'kgcp detect {named}'"
    if path.parent.parent.resolve() != flight.folder.resolve():
        remedy = f"{remedy} with {path.parent} as the results folder"
    defaults = asdict(DetectSettings())
    chosen = [f"{key} = {value}" for key, value in settings.items() if defaults.get(key) != value]
    return f"{remedy} (its settings were {', '.join(chosen)})" if chosen else remedy


def _changed_keys(then: Mapping[str, object], now: Mapping[str, object]) -> Iterator[str]:
    """Yield the keys of flight.toml that have other values now, with both where they are short."""
    now = json.loads(json.dumps(now))
    targets_then, targets_now = _targets(then), _targets(now)
    yield from (f"{target} is new" for target in targets_now if target not in targets_then)
    yield from (f"{target} is gone" for target in targets_then if target not in targets_now)
    kept = {target for target in targets_then if target in targets_now}
    for key in (*now, *(key for key in then if key not in now)):
        is_of_both = not key.startswith(TARGET_TABLE) or _target(key) in kept
        is_of_later_version = key in _CAMERA_KEYS and key not in then
        if is_of_both and not is_of_later_version and then.get(key) != now.get(key):
            yield f"{key}{_from_to(then.get(key), now.get(key))}"


def _targets(values: Mapping[str, object]) -> list[str]:
    keys = (key for key in values if key.startswith(TARGET_TABLE))
    return [*dict.fromkeys(map(_target, keys))]


def _target(key: str) -> str:
    """Return the table that a key of a target belongs to."""
    return key.rpartition(" ")[0]


def _from_to(then: object, now: object) -> str:
    shown = [_shown(then), _shown(now)]
    return f" ({' → '.join(shown)})" if max(map(len, shown)) <= _LONGEST_VALUE else ""


def _shown(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _changed_times(
    table: pd.DataFrame,
    flight: Flight,
    digests: Mapping[str, object],
    all_frames: list[str] | None,
) -> Iterator[str]:
    """Yield that frames have other times now, or none, if so.

    A table of chosen frames has not `all_frames`, by which a times file without names tells them.
    """
    frames = table.drop_duplicates("frame")
    names = frames["frame"].to_list()
    times = FlightData(flight, all_frames or names).frame_times
    if digest(digested_times(flight, names, times)) == digests.get("times"):
        return
    then_s = _unix_s(frames["time"])
    now_s = np.array([times.time_s.get(name, np.nan) for name in names]) + _to_middle_s(
        frames, flight
    )
    if flight.may_use_exif_times:
        is_exif = (frames["time_source"] == TimeSource.EXIF.value).to_numpy()
        now_s = np.where(np.isnan(now_s) & is_exif, then_s, now_s)
    is_same = (np.abs(now_s - then_s) <= _SAME_TIME_S) | (np.isnan(now_s) & np.isnan(then_s))
    changed = np.flatnonzero(~is_same)
    if not changed.size:
        yield "[frames] times"
        return
    of_all = f"[frames] times of {len(changed)} of {len(frames)} frames"
    shifts_s = (now_s - then_s)[changed]
    if np.ptp(shifts_s) <= _SAME_SHIFT_S:
        yield f"{of_all} (by {np.median(shifts_s):+.6g} s)"
    else:
        first = changed[0]
        was, now = (_shown_time(float(time_s[first])) for time_s in (then_s, now_s))
        yield f"{of_all} ({names[first]}: {was} → {now})"


def _shown_time(time_s: float) -> str:
    return "none" if np.isnan(time_s) else format_time(time_s)


def _unix_s(times: pd.Series) -> FloatArray:
    """Return timestamps as Unix seconds, NaN for null."""
    return np.array(
        [
            np.nan if isna else time.timestamp()
            for time, isna in zip(times, times.isna(), strict=True)
        ]
    )


def _to_middle_s(frames: pd.DataFrame, flight: Flight) -> FloatArray:
    """Return what leads from the times of the file to mid-exposure [s]."""
    exposures_s = frames["exposure_time_s"].to_numpy(dtype=np.float64, na_value=np.nan)
    shift_s = flight.camera.time_reference.to_middle_s(1.0)
    return shift_s * exposures_s if shift_s else np.zeros(len(frames))


def _changed_frames(
    table: pd.DataFrame,
    flight: Flight,
    digests: Mapping[str, object],
    today: list[str] | None,
) -> Iterator[str]:
    """Yield what is new in the frames' folder; frames that are gone do not count as a change."""
    if today is None:
        return
    known = set(table["frame"])
    new = [frame for frame in today if frame not in known]
    if new:
        yield f"{len(new)} new frames ({new[0]}, …)" if len(new) > 1 else f"a new frame ({new[0]})"
    elif "frames" in digests and len(today) == len(known):
        stamps = zip(today, stamps_of(flight.frames_folder, today), strict=True)
        sizes = {frame: None if stamp is None else stamp[0] for frame, stamp in stamps}
        if digest(sizes) != digests["frames"]:
            yield "files of frames"
