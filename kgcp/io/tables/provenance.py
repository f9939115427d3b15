"""Provenance of tables, in their metadata, and of runs, in `run.json`.

The metadata of a table hold a digest of each input that it depends on, so that two tables, or a
table and a flight, can be compared. The table of detections also holds the values of the keys of
flight.toml that it depends on, so that a change can be named. Tables made from it repeat them.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, fields
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import PIL
import pyarrow as pa
import pyarrow.parquet as pq

from kgcp import __version__
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.io.files.atomic import write_bytes
from kgcp.io.files.portable import peak_memory_mb
from kgcp.io.files.safe_read import is_file
from kgcp.io.flight.flight import Flight
from kgcp.io.formats.frame_times import FrameTimes
from kgcp.io.images.remote import StoredFolder
from kgcp.io.tables.columns import SCHEMA_VERSION
from kgcp.io.tables.learnt_imaging import LEARNT_IMAGING, learnt_text
from kgcp.measurement.records import TimeSource
from kgcp.quality.learnt_imaging import LearntImaging
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import PlainTarget

TARGET_TABLE = "[[target]]"
"""Prefix of the keys of targets among the inputs of detections."""

_CAMERA_ACCURACIES = ("[camera] sd_", "[camera] cov", "[camera] plumb_sd_deg")
_SCALE_DIGITS = 12  # significant; the scale of a replica is computed from diameters
_DIGITS = 32  # of a digest: 128 bits
_PREFIX = b"kgcp."  # of the keys of Parquet's metadata
_MAX_SAMPLED = 100  # frames whose contents are sampled
_SAMPLE_BYTES, _SAMPLE_PLACES = 4096, 3  # of a file


def frame_samples(
    folder: Path | StoredFolder, frame_sizes: Mapping[str, int | None]
) -> dict[str, str]:
    """Return digests of frames by samples of their contents, at most 100 frames, evenly spaced.

    Only of frames whose files are as long as others: uncompressed ones, which show by nothing else
    that they are those of another flight. Files that cannot be read are left out.

    Parameters
    ----------
    folder : Path or StoredFolder
        Objects of a store are not read.
    frame_sizes : mapping of str to int
        Bytes of the file of every frame; None: missing.
    """
    if not isinstance(folder, Path):
        return {}
    counts = Counter(frame_sizes.values())
    alike = [frame for frame, size in frame_sizes.items() if size and counts[size] > 1]
    step = -(-len(alike) // _MAX_SAMPLED) or 1
    samples = {
        frame: content_sample(folder / frame, frame_sizes[frame] or 0) for frame in alike[::step]
    }
    return {frame: sample for frame, sample in samples.items() if sample is not None}


def content_sample(path: Path, size: int) -> str | None:
    """Return a digest of some bytes between head and end of a file; None: it cannot be read.

    Parameters
    ----------
    size : int
        Bytes of the file.
    """
    content = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            for place in range(1, _SAMPLE_PLACES + 1):
                stream.seek(place * size // (_SAMPLE_PLACES + 1))
                content.update(stream.read(_SAMPLE_BYTES))
    except OSError:
        return None
    return content.hexdigest()[:_DIGITS]


def detections_provenance(
    flight: Flight,
    settings: DetectSettings,
    frame_sizes: Mapping[str, int | None],
    samples: Mapping[str, str],
    times: FrameTimes,
    learnt: LearntImaging | None,
    frame_patterns: Sequence[str] = (),
    places: Path | None = None,
) -> dict[str, str]:
    """Return the metadata of a table of detections.

    Parameters
    ----------
    frame_sizes : mapping of str to int
        Bytes of the file of every frame, in the order of the table; None: missing.
    samples : mapping of str to str
        As by `frame_samples`.
    times : FrameTimes
        Entries that belong to no frame are ignored.
    frame_patterns : sequence of str
        They select the frames of the table; empty: all.
    places : Path, optional
        File of static targets that were marked by hand.
    """
    values = detection_inputs(flight)
    by_part: dict[str, dict[str, object]] = defaultdict(dict)
    for key, value in values.items():
        by_part["targets" if key.startswith(TARGET_TABLE) else "camera"][key] = value
    parts = {
        **by_part,
        "times": digested_times(flight, frame_sizes, times),
        "frames": frame_sizes,
        "settings": asdict(settings),
        "version": __version__,
        **({} if places is None else {"places": _digest_of_file(places)}),
    }
    return {
        **_program_and_flight(flight),
        "settings": json.dumps(asdict(settings), sort_keys=True),
        "inputs": json.dumps(values),
        "frame_bytes": json.dumps([*frame_sizes.values()]),
        "digests": _digests(parts),
        **({"frame_samples": json.dumps(samples)} if samples else {}),
        **({} if learnt is None else {LEARNT_IMAGING: learnt_text(learnt)}),
        **({"choice": json.dumps({"frames": frame_patterns})} if frame_patterns else {}),
    }


def derived_provenance(
    flight: Flight,
    detections: Path,
    choices: Mapping[str, object],
    *,
    has_reference: bool,
) -> dict[str, str]:
    """Return the metadata of a table that is made from detections.

    Parameters
    ----------
    detections : Path
        Their table, whose own metadata are repeated under `detections`.
    choices : mapping
        Further choices of the user, by name.
    has_reference : bool
        Whether reference poses were used.
    """
    vehicle, reference = flight.vehicle, flight.reference
    parts: dict[str, object] = {
        "detections": _digest_of_file(detections),
        "targets": [
            (each.name, each.position_m, each.sd_position_m) for each in flight.all_targets
        ],
        "camera": asdict(flight.camera),
        "crs": flight.crs,
        "choices": choices,
        "version": __version__,
    }
    if vehicle is not None:
        options = asdict(vehicle.options)
        accuracies_file = options.pop("accuracies_file")
        parts["vehicle"] = (asdict(vehicle.settings), options)
        parts["trajectory"] = [
            _digest_of_file(path)
            for path in (vehicle.trajectory_file, accuracies_file)
            if path is not None
        ]
    if reference is not None and has_reference:
        parts["reference"] = _digest_of_file(reference.file)
    metadata = pq.read_schema(detections).metadata or {}
    return {
        **_program_and_flight(flight),
        "digests": _digests(parts),
        "detections": json.dumps(
            {
                key.removeprefix(_PREFIX).decode(): value.decode()
                for key, value in sorted(metadata.items())
                if key.startswith(_PREFIX)
            }
        ),
    }


def detection_inputs(flight: Flight) -> dict[str, object]:
    """Return the values in flight.toml and its calibration file that detections depend on.

    Returns
    -------
    dict
        Table and key, as in "[camera] fx", to a number, a text, a list of numbers or None.
    """
    camera, vehicle = flight.camera, flight.vehicle
    values: dict[str, object] = {
        f"[camera] {field.name}": getattr(camera, field.name) for field in fields(Camera)
    }
    if flight.calibration_covariance is not None:
        cov = flight.calibration_covariance.cov
        for name, variance in zip(CALIBRATION_PARAMETERS, np.diag(cov), strict=True):
            if variance:
                values[f"[camera] sd_{name}"] = float(np.sqrt(variance))
        if np.count_nonzero(cov) > np.count_nonzero(np.diag(cov)):
            values["[camera] cov"] = cov.ravel().tolist()
    values["[camera] plumb_sd_deg"] = flight.plumb_sd_deg
    values["[vehicle] level_sd_deg"] = None if vehicle is None else vehicle.settings.level_sd_deg
    tables = {
        ring.name: _target_table(target, ring) for target in flight.targets for ring in target.rings
    }
    tables |= {target.name: _plain_table(target) for target in flight.plain_targets}
    for name, table in tables.items():
        values |= {f"{TARGET_TABLE} {name} {key}": value for key, value in table.items()}
    return values


def orientation_provenance(flight: Flight, poses: bytes) -> dict[str, str]:
    """Return the metadata of `poses.parquet` by which `poses.csv` is recognised as outdated.

    Parameters
    ----------
    poses : bytes
        The content of `poses.csv`.
    """
    return {
        "poses_csv": content_digest(poses),
        "orientation_inputs": json.dumps(orientation_inputs(flight)),
    }


def orientation_inputs(flight: Flight) -> dict[str, object]:
    """Return the values in flight.toml on which poses by static targets depend, by key."""
    static = flight.static_targets
    rings = {ring.name for target in static if isinstance(target, Target) for ring in target.rings}
    names = rings | {target.name for target in static}
    values: dict[str, object] = {"crs": flight.crs}
    for key, value in detection_inputs(flight).items():
        of_camera = key.startswith("[camera]") and not key.startswith(_CAMERA_ACCURACIES)
        if of_camera or key.removeprefix(f"{TARGET_TABLE} ").rpartition(" ")[0] in names:
            values[key] = value
    for target in static:
        values[f"{TARGET_TABLE} {target.name} position_m"] = target.position_m
        values[f"{TARGET_TABLE} {target.name} sd_position_m"] = target.sd_position_m
    return values


def _plain_table(target: PlainTarget) -> dict[str, object]:
    """Return the keys of a target without a code, which its position distinguishes from others."""
    outer_m, *inner_m = target.diameters_m
    return {
        "shape": target.shape.value,
        "polarity": target.polarity.value,
        "diameter_m": outer_m,
        "inner_diameter_m": inner_m,
        "sd_diameter_m": target.sd_diameter_m,
        "position_m": target.position_m,
        "normal": "free" if target.normal_enu is None else target.normal_enu,
        "level_sd_deg": target.sd_normal_deg,
        "border_m": target.border_m,
        "thickness_m": target.thickness_m,
    }


def _target_table(target: Target, ring: Ring) -> dict[str, object]:
    """Return the keys of a plate, or of a replica on it."""
    if ring is target.ring:
        table = {field.name: getattr(ring, field.name) for field in fields(Ring)}
        del table["name"]
        return table
    scale = ring.outer_diameter_m / target.ring.outer_diameter_m
    return {
        "replica_of": target.name,
        "scale": float(f"{scale:.{_SCALE_DIGITS}g}"),
        "code_deg": ring.code_deg,
    }


def digested_times(
    flight: Flight, frames: Iterable[str], times: FrameTimes
) -> list[tuple[object, ...]]:
    """Return each frame's time as known before the frame is read: microseconds, or the source.

    With a rolling shutter, the rotation at that time is added where it is known.
    """
    fallback = TimeSource.EXIF if flight.may_use_exif_times else TimeSource.NONE
    rotations = times.rotation if flight.camera.readout_s else {}
    digested: list[tuple[object, ...]] = []
    for frame in frames:
        time_s, rotation = times.time_s.get(frame), rotations.get(frame)
        entry = (frame, fallback if time_s is None else round(1e6 * time_s))
        digested.append(entry if rotation is None else (*entry, astuple(rotation)))
    return digested


def _program_and_flight(flight: Flight) -> dict[str, str]:
    return {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "flight_toml": flight.toml_text,
    }


def _digests(parts: Mapping[str, object]) -> str:
    """Return the digest of each part, as JSON."""
    return json.dumps({name: digest(value) for name, value in sorted(parts.items())})


def digest(value: object) -> str:
    """Return a digest of plain values: 32 hexadecimal digits."""
    text = json.dumps(value, sort_keys=True, default=str)  # `str` is for dates
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def content_digest(content: bytes) -> str:
    """Return a digest of a file's content: 32 hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()[:_DIGITS]


def _digest_of_file(path: Path) -> str | None:
    """Return a digest of a file's content; None where there is no such file."""
    if not is_file(path):
        return None
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:_DIGITS]


def versions() -> dict[str, str]:
    """Return the versions of kgcp, of Python, and of the libraries that results depend on."""
    return {
        "kgcp": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": version("scipy"),  # from the metadata: not every process imports scipy
        "opencv": cv2.__version__,
        "simplejpeg": version("simplejpeg"),
        "numba": version("numba"),
        "pillow": PIL.__version__,
        "pyarrow": pa.__version__,
    }


def write_run_record(path: Path, record: Mapping[str, object]) -> None:
    """Write a run's record, with versions, the machine and the peak of memory, as JSON.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    full_record = {
        **record,
        "versions": versions(),
        "host": {"cores": os.cpu_count(), "system": platform.platform()},
        "peak_memory_mb": peak_memory_mb(),
    }
    write_bytes(path, f"{json.dumps(full_record, indent=1)}\n".encode())
