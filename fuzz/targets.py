"""What is fuzzed: each target takes the bytes of one file and hands them to its readers.

A reader may return or raise `KgcpError` or `Rejection`. Whatever else it raises is a finding, and
so are warnings that are none of kgcp's.

Each input is read as a flight would have it, its content telling the format, and once more with
keys of flight.toml that its checksum chooses.
"""

from __future__ import annotations

import tempfile
import warnings
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from kgcp.errors import KgcpError, KgcpWarning, Rejection
from kgcp.geometry.camera import Camera, Response
from kgcp.georef.crs import parse_crs
from kgcp.io.files.csv_columns import CsvLayout
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.flight.device_file import read_device
from kgcp.io.flight.field_file import read_field
from kgcp.io.flight.flight import read_camera_and_targets, read_flight, read_printed_targets
from kgcp.io.formats.calibrations import FORMATS as CALIBRATION_FORMATS
from kgcp.io.formats.calibrations import read_calibration
from kgcp.io.formats.exclusions import read_exclusions
from kgcp.io.formats.fields import FORMATS as FIELD_FORMATS
from kgcp.io.formats.frame_times import FORMATS as TIMES_FORMATS
from kgcp.io.formats.frame_times import read_times
from kgcp.io.formats.marks import read_marks
from kgcp.io.formats.orientations import FORMATS as POSE_FORMATS
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.orientations.records import OrientationFileOptions
from kgcp.io.formats.trajectories import FORMATS as TRAJECTORY_FORMATS
from kgcp.io.formats.trajectories import read_trajectory
from kgcp.io.formats.trajectories.records import TrajectoryFileOptions, Wander
from kgcp.io.formats.visiona_target import read_visiona_ring
from kgcp.io.images.exif import read_exif
from kgcp.io.images.frames import read_grey
from kgcp.measurement.discs.measure import measure_discs
from kgcp.measurement.discs.outlines import find_outlines, follow_outlines
from kgcp.measurement.discs.records import Operator
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plain_target import measure_plain
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.measurement.records import FrameResult
from kgcp.pipeline.execution.journal import from_text
from kgcp.pipeline.init import draft_flight
from kgcp.pipeline.init_records import InitOptions
from kgcp.targets.plain import PlainPolarity, PlainTarget

CRS = "EPSG:25832"
FRAME_WIDTH, FRAME_HEIGHT = 40, 30
FRAMES = ("DJI_0001.JPG", "DJI_0002.JPG", "a/frame 1.jpg", "a/frame 2.jpg", "b/frame 1.jpg")

OPF_PARTS = {
    "calibrated-cameras": """{"format": "application/opf-calibrated-cameras+json",
"version": "1.0", "sensors": [], "cameras": [{"id": 1, "sensor_id": 3,
"orientation_deg": [1.5, -2.5, 30.0], "position": [12.5, -7.25, 101.5]}, {"id": "2",
"sensor_id": 3, "orientation_deg": [0, 0, -150.0], "position": [32.5, -7.25, 99.0]}]}
""",
    "camera-list": """{"format": "application/opf-camera-list+json", "version": "1.0",
"cameras": [{"id": 1, "uri": "../image%20files/DJI_0001.JPG#page=0"},
{"id": 2, "uri": "DJI_0002.JPG"}]}
""",
    "scene-reference-frame": """{"format": "application/opf-scene-reference-frame+json",
"version": "1.0", "crs": {"definition": "EPSG:25832", "geoid_height": 47.5},
"base_to_canonical": {"shift": [689500.0, 5336200.0, 500.0], "scale": [1.0, 1.0, 1.0],
"swap_xy": false}}
""",
}

LATE_MODULES = (
    *(f"PIL.{name}ImagePlugin" for name in ("Bmp", "Jpeg", "Jpeg2K", "Mpo")),
    *(f"PIL.{name}ImagePlugin" for name in ("Png", "Ppm", "Tiff", "WebP")),
)
"""What readers import when they are called."""

_CAMERA = Camera(FRAME_WIDTH, FRAME_HEIGHT, 50.0, 50.0, 20.0, 15.0)
_ROW = 64  # grey values
_LISTING = """diameter_m = 0.01
[points]
file = "field.csv"
[code]
kind = "ring"
bits = 14
ring = [2.1, 3.1]
"""
_FRAME = (  # a PNG of 1 x 1 px
    b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x01\0\0\0\x01\x08\0\0\0\0:~\x9bU\0\0\0\nIDATx\x9cc`\0"
    b"\0\0\x02\0\x01H\xaf\xa4q\0\0\0\0IEND\xaeB`\x82"
)
_COURSE = TrajectoryFileOptions(course_sd_deg=(2.0, 2.0, 3.0))
_DATED = replace(_COURSE, first_day=date(2026, 6, 16), time_system=TimeSystem.GPS)
_NOTATIONS = (
    *(TrajectoryFileOptions(format=kind) for kind in TRAJECTORY_FORMATS.names),
    *(replace(_DATED, format=kind) for kind in ("csv", "tum")),
    replace(_DATED, format="sbet", course_sd_deg=None, wander=Wander.SUBTRACT),
    replace(_COURSE, format="rtklib"),
    replace(_COURSE, time_system=TimeSystem.UTC, crs="EPSG:4258"),
    replace(_COURSE, time_system=TimeSystem.GPS),
    replace(_COURSE, layout=CsvLayout(";", ",", {"time": "GPST", "x": "E", "y": "N"})),
    replace(_COURSE, layout=CsvLayout(" ", ".", {"time": "GPST", "x": "E", "y": "N"})),
)

_One = TypeVar("_One")


def flight_toml(data: bytes, folder: Path) -> None:
    """Read a flight, its targets alone, and its CRS."""
    (folder / "frames").mkdir(exist_ok=True)
    (folder / "flight.toml").write_bytes(data)
    _allow(lambda: read_printed_targets(folder))
    _allow(lambda: read_camera_and_targets(folder))
    flight = read_flight(folder)
    if flight.crs is not None:
        parse_crs(flight.crs)


def times(data: bytes, folder: Path) -> None:
    """Read times of frames."""
    path = _written(folder, data)
    _allow(lambda: read_times(path, FRAMES))
    read_times(path, FRAMES, _chosen(data, tuple(TIMES_FORMATS.names)))


def trajectories(data: bytes, folder: Path) -> None:
    """Read a vehicle's trajectory."""
    path = _written(folder, data)
    _allow(lambda: read_trajectory(path, CRS))
    read_trajectory(path, CRS, _chosen(data, _NOTATIONS))


def bare_folder(data: bytes, folder: Path) -> None:
    """Tell what a file beside frames is, and draft a flight.toml."""
    (folder / "frames").mkdir(exist_ok=True)
    (folder / "frames" / "1781597705.5.png").write_bytes(_FRAME)
    (folder / "data.csv").write_bytes(data)
    draft = draft_flight(folder, InitOptions(codes=("0,43,78,180",), diameter_m=0.9))
    (folder / "flight.toml").write_text(draft.toml_text, encoding="utf-8")
    (folder / "frames.csv").write_text(draft.frames_csv or "frame,time\n", encoding="utf-8")
    try:
        _allow(lambda: read_flight(folder))
    finally:
        (folder / "flight.toml").unlink()


def exclusions(data: bytes, folder: Path) -> None:
    """Read a list of frames to leave out."""
    path = _written(folder, data)
    for exclusion in read_exclusions(path):
        str(exclusion)


def poses(data: bytes, folder: Path) -> None:
    """Read reference poses."""
    path = _written_among_parts(folder, data)
    _allow(lambda: read_reference_poses(path, crs=CRS, frames=FRAMES))
    stated = _chosen(data, (None, CRS, "EPSG:4978"))
    options = OrientationFileOptions(_chosen(data, tuple(POSE_FORMATS.names)), stated)
    read_reference_poses(path, options, crs=CRS, frames=FRAMES)


def calibrations(data: bytes, folder: Path) -> None:
    """Read a camera's calibration."""
    path = _written(folder, data)
    _allow(lambda: read_calibration(path, (None, None)))
    read_calibration(path, (1600, 1200), _chosen(data, tuple(CALIBRATION_FORMATS.names)))


def visiona(data: bytes, folder: Path) -> None:
    """Read a target of visiona's configuration files."""
    read_visiona_ring(
        ForeignFile(_written(folder, data), "the target"), "A", _chosen(data, (None, 7))
    )


def fields(data: bytes, folder: Path) -> None:
    """Read a field of targets: a field.toml, or another program's board."""
    path = _written(folder, data)
    _allow(lambda: read_field(str(path), _chosen(data, (None, "mm", "in"))))
    for form in FIELD_FORMATS.names:
        file = ForeignFile(path, "the field")
        _allow(partial(FIELD_FORMATS.reader(file, form), file, 0.001))
    (folder / "field.csv").write_bytes(data)
    listing = folder / "listing.toml"
    listing.write_text(_LISTING, encoding="utf-8")
    _allow(lambda: read_field(str(listing)))
    toml = folder / "field.toml"
    toml.write_bytes(data)
    field = read_field(str(toml))
    field.symmetries()


def devices(data: bytes, folder: Path) -> None:
    """Read the points of an EO device."""
    read_device(_written(folder, data))


def frames(data: bytes, folder: Path) -> None:
    """Read a frame's EXIF and its pixels."""
    path = _written(folder, data)
    read_exif(path)
    read_grey(path, _CAMERA)


def discs(data: bytes, folder: Path) -> None:  # noqa: ARG001 - as all targets
    """Find and measure discs in the bytes as grey values, 64 in a row."""
    grey = np.frombuffer(data[: len(data) // _ROW * _ROW], np.uint8).reshape(-1, _ROW)
    outlines = find_outlines(grey)
    follow_outlines(grey, outlines)
    operator = _chosen(data[::-1], tuple(Operator))
    measure_discs(grey, outlines, response=_chosen(data, tuple(Response)), operator=operator)
    for form in (grey.reshape(1, -1), grey.reshape(-1, 1), grey.view(np.uint16)):
        measure_discs(form, find_outlines(form), response=_chosen(data, tuple(Response)))


def plain_targets(data: bytes, folder: Path) -> None:  # noqa: ARG001 - as all targets
    """Look for plain discs and rings in the bytes as grey values, 64 in a row."""
    grey = np.frombuffer(data[: len(data) // _ROW * _ROW], np.uint8).reshape(-1, _ROW)
    if len(grey) < 2:
        return  # no camera has such frames
    camera = Camera(_ROW, len(grey), 100.0, 100.0, 31.5, 0.5 * len(grey))
    for place, diameters_m in ((32.0, (0.2,)), (3.0, (0.3, 0.1))):
        target = PlainTarget(
            "P", diameters_m, _chosen(data, tuple(PlainPolarity)), (0.0, 0.0, 0.0), border_m=0.1
        )
        centre_px = np.array([place, 0.5 * len(grey)])
        position_m = np.append(camera.undistort(centre_px[None])[0], 1.0)
        normal = NormalPrior(np.array([0.0, 0.0, 1.0]), 10.0)
        prediction = PlainPrediction(
            centre_px, 9.0 * np.eye(2), position_m, 0.1, normal, 50.0 * diameters_m[0], "fuzzing"
        )
        measure_plain(grey, camera, target, prediction)


def marks(data: bytes, folder: Path) -> None:
    """Read marks made by hand."""
    read_marks(_written(folder, data), {"f_0.png", "f_1.png"}, {"white", "black"}, _CAMERA)


def journal(data: bytes, folder: Path) -> None:  # noqa: ARG001 - as all targets
    """Read the result of a frame that an interrupted run has left in the flight's folder."""
    try:
        from_text(data, (FrameResult,))
    except ValueError as error:  # what `Journal.read` makes a `KgcpError` of
        raise KgcpError(" ".join(str(error).split())) from error


TARGETS: Mapping[str, Callable[[bytes, Path], None]] = {
    target.__name__: target
    for target in (
        *(flight_toml, bare_folder, times, trajectories, exclusions, poses, calibrations),
        *(visiona, fields, devices, frames, discs, plain_targets, marks, journal),
    )
}


def feed(target: str, data: bytes, folder: Path) -> None:
    """Hand the bytes of a file to a target, with a folder to write it to.

    Raises
    ------
    Exception
        Whatever is a finding.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", KgcpWarning)
        _allow(lambda: TARGETS[target](data, folder))


def feed_in_new_folder(target: str, data: bytes) -> None:
    """Hand the bytes of a file to a target, which leaves nothing behind."""
    with tempfile.TemporaryDirectory() as folder:
        feed(target, data, Path(folder))


def _allow(read: Callable[[], object]) -> None:
    """Call a reader, which may raise known errors: those of files say what is wrong in one line."""
    try:
        read()
    except KgcpError as error:
        if len(str(error).splitlines()) != 1:
            raise AssertionError(f"{error!r} is not one line") from error
    except Rejection:
        pass


def _written(folder: Path, data: bytes) -> Path:
    path = folder / "input"
    path.write_bytes(data)
    return path


def _written_among_parts(folder: Path, data: bytes) -> Path:
    """Write a part of an OPF project in the place of its sound one, and name the project."""
    kind = next((kind for kind in OPF_PARTS if f"opf-{kind}+json".encode() in data), None)
    if kind is None:
        return _written(folder, data)
    for name, part in OPF_PARTS.items():
        content = data if name == kind else part.encode()
        (folder / f"{name.replace('-', '_')}.json").write_bytes(content)
    return folder / "calibrated_cameras.json"


def _chosen(data: bytes, choices: tuple[_One, ...]) -> _One:
    return choices[zlib.crc32(data) % len(choices)]
