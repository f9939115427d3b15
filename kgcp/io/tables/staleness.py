"""Whether a table of detections still belongs to its flight, and what has changed since."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from kgcp.errors import KgcpError, KgcpWarning
from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.io.files.safe_read import unreadable
from kgcp.io.files.time_text import format_time
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.io.formats.frame_times import FrameTimes
from kgcp.io.images.frame_patterns import is_chosen
from kgcp.io.images.frames import RESULTS_NAME, list_frames
from kgcp.io.images.remote import stamps_of
from kgcp.io.tables.provenance import (
    TARGET_TABLE,
    content_digest,
    content_sample,
    detection_inputs,
    digest,
    digested_times,
    orientation_inputs,
)
from kgcp.measurement.records import TimeSource
from kgcp.quality.number_text import counted, listed
from kgcp.settings import DetectSettings

if TYPE_CHECKING:  # 0.3 s that `kgcp detect` does not need
    import pandas as pd

POSES_TABLE = "poses.parquet"
"""File name of the table that `kgcp orient` writes beside `poses.csv`."""

_TIME_TOLERANCE_S = 2e-6  # as tables hold microseconds
_SHIFT_TOLERANCE_S = 1e-3  # range of time changes that are reported as one shift
_MAX_VALUE_LENGTH = 40  # characters; longer values are not shown
_MAX_CHANGES_SHOWN = 6  # the others are only counted
# A table that lacks one of them is older than that key.
_CAMERA_KEYS = {f"[camera] {field.name}" for field in fields(Camera)}


def refuse_to_replace_whole(path: Path) -> None:
    """Refuse to replace a table of all frames by one of some, which would waste longer work.

    A table of some frames may be replaced, and so may a file that is no table.

    Raises
    ------
    KgcpError
        If the table has all frames of its flight, or is protected.
    """
    try:
        metadata = pq.read_schema(path).metadata or {}
    except PermissionError as error:
        raise unreadable(path, error, "make it readable") from error
    except (OSError, pa.ArrowException):  # no table, or a damaged one
        return
    if b"kgcp.inputs" in metadata and b"kgcp.choice" not in metadata:
        raise KgcpError(
            f"{path}: has the detections of all frames, which would be lost; name another folder"
            " with --out, or delete this table",
            option="frames",
        )


def require_current(path: Path, table: pd.DataFrame, flight: Flight) -> None:
    """Refuse detections that were made from another camera, other targets, times or frames.

    Inputs that later commands read anew may differ: trajectory, lever arm, CRS, reference poses. A
    table that does not state its inputs passes: kgcp did not write it. If pandas wrote it, its
    times are compared with those of the flight, and a warning says that nothing else is.

    Parameters
    ----------
    path : Path
        File of the table, whose metadata state its inputs.

    Raises
    ------
    KgcpError
        Naming what has changed, and the command to repeat.
    """
    metadata = pq.read_schema(path).metadata or {}
    inputs = _json(metadata, b"kgcp.inputs")
    if not inputs:
        if b"pandas" in metadata:
            _check_times_alone(path, table, flight)
        return
    digests = _json(metadata, b"kgcp.digests")
    frames_now = _frames_now(flight)
    chosen = _chosen_frames(frames_now, metadata)
    changes = [
        *_changed_keys(inputs, detection_inputs(flight)),
        *_changed_times(table, flight, digests, None if chosen == frames_now else frames_now),
        *_changed_frames(table, flight, metadata, chosen),
    ]
    if changes:
        raise _outdated(path, flight, changes, _json(metadata, b"kgcp.settings"))


def changed_since_orient(poses: Path, flight: Flight) -> list[str]:
    """Return what has changed in flight.toml since `kgcp orient` wrote reference poses.

    Poses that another program wrote depend on nothing in flight.toml.

    Parameters
    ----------
    poses : Path
        File of the reference poses.
    """
    table = _orientation_table(poses, flight)
    if table is None:
        return []
    metadata = pq.read_schema(table).metadata
    then = _json(metadata, b"kgcp.orientation_inputs")
    return [*_changed_keys(then, orientation_inputs(flight))]


def are_by_orient(poses: Path, flight: Flight) -> bool:
    """Tell whether `kgcp orient` computed reference poses, from the flight's static targets."""
    return _orientation_table(poses, flight) is not None


def frames_of_other_poses(poses: Path, flight: Flight) -> list[str]:
    """Return the frames that `kgcp orient` has oriented by files other than the flight's.

    Two flights mostly have frames of the same names. Frames that are gone do not count.
    """
    table, frames_now = _orientation_table(poses, flight), _frames_now(flight)
    if table is None or frames_now is None:
        return []
    frames = pq.read_table(table, columns=["frame"])["frame"].to_pylist()
    detections = _json(pq.read_schema(table).metadata, b"kgcp.detections")
    then = {f"kgcp.{key}".encode(): str(value).encode() for key, value in detections.items()}
    count = len(_values(then, b"kgcp.frame_bytes"))
    known = sorted(frames) if len(frames) == count else []  # the sizes are those of all frames
    return _changed_files([*set(frames) & set(frames_now)], known, flight, then)


def _orientation_table(poses: Path, flight: Flight) -> Path | None:
    """Return the table that `kgcp orient` wrote with reference poses.

    The table lies beside them, or in the flight's results, and states their digest. None: the poses
    are by another program.
    """
    try:
        found = content_digest(poses.read_bytes()).encode()
    except OSError:  # reported where the poses are read
        return None
    for folder in (poses.parent, flight.folder / RESULTS_NAME):
        try:
            metadata = pq.read_schema(folder / POSES_TABLE).metadata or {}
        except (OSError, pa.ArrowException):  # no table, or a damaged one
            continue
        if metadata.get(b"kgcp.poses_csv") == found:
            return folder / POSES_TABLE
    return None


def listed_changes(changes: Sequence[str]) -> str:
    """Return changes in words; if there are many, some are only counted."""
    return listed(changes, _MAX_CHANGES_SHOWN)


def _check_times_alone(path: Path, table: pd.DataFrame, flight: Flight) -> None:
    """Refuse a table of pandas with times other than the flight's, and warn of what is unknown."""
    frames = table.drop_duplicates("frame")
    times = FlightData(flight, _frames_now(flight) or frames["frame"].to_list()).frame_times
    then_s, now_s = _times_then_and_now(frames, flight, times)
    # frames without a time, then or now, may be those of another flight
    is_changed = np.abs(now_s - then_s) > _TIME_TOLERANCE_S
    if is_changed.any():
        raise _outdated(path, flight, [_time_change(frames, then_s, now_s, is_changed)], {})
    warnings.warn(
        f"{path}: pandas wrote it, without what it was made from; a camera or targets changed since"
        " 'kgcp detect' would go unnoticed: leave rows out with --exclude, and give 'kgcp"
        " export-gcp' several flights instead of joining their tables",
        KgcpWarning,
        stacklevel=2,
    )


def _outdated(
    path: Path, flight: Flight, changes: Sequence[str], settings: Mapping[str, object]
) -> KgcpError:
    return KgcpError(
        f"{path}: does not belong to this flight any more; changed since 'kgcp detect':"
        f" {listed_changes(changes)}; {_remedy(path, flight, settings)}"
    )


def _frames_now(flight: Flight) -> list[str] | None:
    """Return the frames in the flight's folder; None: they are in an archive or a store."""
    try:
        return list_frames(flight.frames_folder)
    except KgcpError:
        return None


def _chosen_frames(
    frames_now: list[str] | None, metadata: Mapping[bytes, bytes]
) -> list[str] | None:
    """Return the frames that the table would have if it were made now."""
    patterns = _json(metadata, b"kgcp.choice").get("frames")
    if frames_now is None or not isinstance(patterns, list) or not patterns:
        return frames_now
    return [frame for frame in frames_now if is_chosen(frame, [*map(str, patterns)])]


def _json(metadata: Mapping[bytes, bytes], key: bytes) -> dict[str, object]:
    values = _parsed(metadata, key)
    return values if isinstance(values, dict) else {}


def _values(metadata: Mapping[bytes, bytes], key: bytes) -> list[object]:
    values = _parsed(metadata, key)
    return values if isinstance(values, list) else []


def _parsed(metadata: Mapping[bytes, bytes], key: bytes) -> object:
    try:
        return json.loads(metadata.get(key, b"null"))
    except (ValueError, RecursionError):
        return None


def _remedy(path: Path, flight: Flight, settings: Mapping[str, object]) -> str:
    """Return the command to repeat, with the settings that were not the default ones."""
    folder = str(flight.folder)
    quoted = f'"{folder}"' if " " in folder else folder
    remedy = f"repeat 'kgcp detect {quoted}'"
    if path.parent.parent.resolve() != flight.folder.resolve():
        remedy = f"{remedy} with {path.parent} as the results folder"
    defaults = asdict(DetectSettings())
    chosen = [f"{key} = {value}" for key, value in settings.items() if defaults.get(key) != value]
    return f"{remedy} (its settings were {', '.join(chosen)})" if chosen else remedy


def _changed_keys(then: Mapping[str, object], now: Mapping[str, object]) -> Iterator[str]:
    """Yield the keys of flight.toml whose values have changed; short values are shown."""
    now = json.loads(json.dumps(now))
    targets_then, targets_now = _targets(then), _targets(now)
    yield from (f"{target} is new" for target in targets_now if target not in targets_then)
    yield from (f"{target} is gone" for target in targets_then if target not in targets_now)
    common = {target for target in targets_then if target in targets_now}
    for key in (*now, *(key for key in then if key not in now)):
        is_of_both = not key.startswith(TARGET_TABLE) or _target(key) in common
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
    shown = [_value_text(then), _value_text(now)]
    return f" ({' → '.join(shown)})" if max(map(len, shown)) <= _MAX_VALUE_LENGTH else ""


def _value_text(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, list):
        return f"[{', '.join(map(_value_text, value))}]"
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _changed_times(
    table: pd.DataFrame,
    flight: Flight,
    digests: Mapping[str, object],
    all_frames: list[str] | None,
) -> Iterator[str]:
    """Yield a change if frames have other times now, or no longer have one.

    A times file without names can only be assigned to `all_frames`; a table of chosen frames does
    not have them.
    """
    frames = table.drop_duplicates("frame")
    names = frames["frame"].to_list()
    times = FlightData(flight, all_frames or names).frame_times
    if digest(digested_times(flight, names, times)) == digests.get("times"):
        return
    then_s, now_s = _times_then_and_now(frames, flight, times)
    is_same = (np.abs(now_s - then_s) <= _TIME_TOLERANCE_S) | (np.isnan(now_s) & np.isnan(then_s))
    if is_same.all():
        yield "[frames] times"
    else:
        yield _time_change(frames, then_s, now_s, ~is_same)


def _times_then_and_now(
    frames: pd.DataFrame, flight: Flight, times: FrameTimes
) -> tuple[FloatArray, FloatArray]:
    """Return the times of frames in a table, and in the flight now, each (n,); NaN: none [s]."""
    then_s = _unix_s(frames["time"])
    now_s = np.array([times.time_s.get(name, np.nan) for name in frames["frame"]])
    now_s += _to_middle_s(frames, flight)
    if flight.may_use_exif_times:
        is_exif = (frames["time_source"] == TimeSource.EXIF.value).to_numpy()
        now_s = np.where(np.isnan(now_s) & is_exif, then_s, now_s)
    return then_s, now_s


def _time_change(
    frames: pd.DataFrame, then_s: FloatArray, now_s: FloatArray, is_changed: BoolArray
) -> str:
    """Say which frames have other times now: all shifted alike, or the first of them."""
    changed = np.flatnonzero(is_changed)
    changed_times = f"[frames] times of {len(changed)} of {len(frames)} frames"
    shifts_s = (now_s - then_s)[changed]
    if np.ptp(shifts_s) <= _SHIFT_TOLERANCE_S:
        return f"{changed_times} (by {np.median(shifts_s):+.6g} s)"
    first = changed[0]
    was, now = (_time_text(float(time_s[first])) for time_s in (then_s, now_s))
    return f"{changed_times} ({frames['frame'].iloc[first]}: {was} → {now})"


def _time_text(time_s: float) -> str:
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
    """Return the differences of mid-exposure minus the times in the file [s]."""
    exposures_s = frames["exposure_time_s"].to_numpy(dtype=np.float64, na_value=np.nan)
    shift_s = flight.camera.time_reference.to_middle_s(1.0)
    return shift_s * exposures_s if shift_s else np.zeros(len(frames))


def _changed_frames(
    table: pd.DataFrame,
    flight: Flight,
    metadata: Mapping[bytes, bytes],
    frames_now: list[str] | None,
) -> Iterator[str]:
    """Yield new or changed files of frames; missing frames do not count as a change."""
    if frames_now is None:
        return
    known = table["frame"].drop_duplicates().to_list()
    new = sorted(set(frames_now).difference(known))
    if new:
        yield f"{len(new)} new frames ({new[0]}, …)" if len(new) > 1 else f"a new frame ({new[0]})"
        return
    changed = _changed_files(frames_now, known, flight, metadata)
    if changed:
        more = ", …" if len(changed) > 1 else ""
        yield f"files of {counted(len(changed), 'frame')} ({changed[0]}{more})"


def _changed_files(
    frames_now: Sequence[str],
    known: Sequence[str],
    flight: Flight,
    metadata: Mapping[bytes, bytes],
) -> list[str]:
    """Return the frames whose files have another size or content than detections state.

    Parameters
    ----------
    known : sequence of str
        Frames of the detections, in the order of their sizes.
    metadata : mapping
        Of the detections.
    """
    sizes_then = dict(zip(known, _values(metadata, b"kgcp.frame_bytes"), strict=False))
    stamps = zip(frames_now, stamps_of(flight.frames_folder, frames_now), strict=True)
    sizes_now = {frame: None if stamp is None else stamp[0] for frame, stamp in stamps}
    changed = [frame for frame, size in sizes_now.items() if sizes_then.get(frame, size) != size]
    if not changed:  # uncompressed frames of another flight are as long
        samples_then = _json(metadata, b"kgcp.frame_samples")
        changed = [
            frame
            for frame, size in sizes_now.items()
            if size
            and frame in samples_then
            and content_sample(flight.frames_folder / frame, size)
            not in {samples_then[frame], None}
        ]
    return sorted(changed)
