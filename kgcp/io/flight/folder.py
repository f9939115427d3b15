"""Recognition of the files in a flight's folder before there is a flight.toml."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.csv_sniff import sniff_table
from kgcp.io.files.safe_read import is_file, is_folder, is_number
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.flight.camera_table import read_camera_file
from kgcp.io.flight.target_table import TARGETS_TOML
from kgcp.io.formats.calibrations import FORMATS as CALIBRATION_FORMATS
from kgcp.io.formats.frame_times import looks_like_marks
from kgcp.io.formats.orientations import FORMATS as POSE_FORMATS
from kgcp.io.formats.point_table import PointTable, recognised_points
from kgcp.io.formats.rtklib_pos import looks_like_solution
from kgcp.io.formats.trajectories import sbet, tum
from kgcp.io.formats.trajectories.first_epoch import TrajectoryFile
from kgcp.io.formats.trajectories.foreign_csv import recognised_table
from kgcp.io.formats.waypoint_export import looks_like_waypoint
from kgcp.io.images.frames import FLIGHT_TOML, FRAME_SUFFIXES, RESULTS_NAME, list_frames

_TABLE_SUFFIXES = frozenset({".csv", ".txt", ".pos", ".out", ".sbet", ".tum", ".dat", ".asc"})
_DATA_SUFFIXES = _TABLE_SUFFIXES | {
    *(".mrk", ".yml", ".yaml", ".xml", ".json", ".geojson", ".cam", ".opf")
}
_EVENTS = "_events.pos"  # how RTKLIB names the file of its marks
_ACCURACIES = "smrmsg"  # how POSPac's files of accuracies begin
_POSE_COLUMNS = {
    name: (name,) for name in ("frame", "x", "y", "z", "omega_deg", "phi_deg", "kappa_deg")
}
_TIME_COLUMNS = {"frame": ("frame",), "time": ("time",)}


@dataclass(frozen=True, slots=True)
class FolderContents:
    """The files of a flight's folder by what they are, each kind sorted by path."""

    folder: Path
    frames_folder: Path
    frames: tuple[str, ...]  # by their paths below that
    marks: tuple[Path, ...]  # DJI's MRK
    events: tuple[Path, ...]  # RTKLIB's
    times: tuple[Path, ...]  # CSV of frame and time
    trajectories: tuple[TrajectoryFile, ...]
    accuracies: tuple[Path, ...]  # smrmsg
    calibrations: tuple[Path, ...]
    targets: tuple[Path, ...]
    points: tuple[PointTable, ...]
    references: tuple[Path, ...]
    unknown: tuple[Path, ...]  # tables or logs by their names, but of no known content

    def relative(self, path: Path) -> str:
        """Return a path as flight.toml names it."""
        return path.relative_to(self.folder).as_posix()


def survey_folder(folder: Path) -> FolderContents:
    """Recognise the files of a flight's folder by their content.

    Hidden folders, the results of kgcp and sheets of targets are passed over.

    Raises
    ------
    KgcpError
        If it is not a folder, or has no frames.
    """
    if not is_folder(folder):
        raise KgcpError(f"{folder}: is not a folder; name one that has the frames of a flight")
    paths = _files_below(folder)
    frames_folder = _frames_folder(folder, paths)
    found: dict[str, list[Path]] = {}
    trajectories, points = [], []
    for path in paths:
        kinds = _kinds_of(path)
        if not kinds and path.suffix.lower() in _TABLE_SUFFIXES:
            found.setdefault("unknown", []).append(path)
        for kind, detail in kinds:
            found.setdefault(kind, []).append(path)
            if isinstance(detail, TrajectoryFile):
                trajectories.append(detail)
            elif detail is not None:
                points.append(detail)
    return FolderContents(
        folder,
        frames_folder,
        tuple(list_frames(frames_folder)),
        tuple(found.get("marks", ())),
        tuple(found.get("events", ())),
        tuple(found.get("times", ())),
        tuple(trajectories),
        tuple(found.get("accuracies", ())),
        tuple(found.get("calibration", ())),
        tuple(found.get("targets", ())),
        tuple(points),
        tuple(found.get("reference", ())),
        tuple(found.get("unknown", ())),
    )


def _files_below(folder: Path) -> list[Path]:
    """Return the files, sorted, without those of other flights and in folders that kgcp made."""
    paths = []
    for parent, folders, names in os.walk(folder):
        is_printed = TARGETS_TOML in names and Path(parent) != folder
        kept = [TARGETS_TOML] if is_printed else names  # the others are sheets, perhaps PNG
        folders[:] = [name for name in folders if not _is_passed_over(parent, name)]
        paths += [Path(parent) / name for name in kept if name[0] != "."]
    made = folder / RESULTS_NAME / "targets" / TARGETS_TOML
    return sorted([*filter(is_file, paths), *([made] if is_file(made) else [])])


def _is_passed_over(parent: str, name: str) -> bool:
    """Whether a folder is hidden, has results or a contact sheet, or is another flight."""
    path = Path(parent) / name
    is_made = name == RESULTS_NAME or is_folder(path / "thumbnails")
    return name[0] == "." or is_made or is_file(path / FLIGHT_TOML)


def _frames_folder(folder: Path, paths: Sequence[Path]) -> Path:
    """Return `frames`, if it has images, or the innermost folder that has all images."""
    images = [path for path in paths if path.suffix.lower() in FRAME_SUFFIXES]
    usual = folder / "frames"
    if any(path.is_relative_to(usual) for path in images):
        return usual
    if not images:
        return usual if is_folder(usual) else folder  # whose listing says what it has instead
    return Path(os.path.commonpath([path.parent for path in images]))


_Kinds = tuple[tuple[str, TrajectoryFile | PointTable | None], ...]  # and what the content tells


def _kinds_of(path: Path) -> _Kinds:
    """Return what a file is: nothing of use, one thing, or calibration and poses at once."""
    if path.name == TARGETS_TOML:
        return (("targets", None),)
    if path.suffix == ".toml":
        return (("calibration", None),) if _is_own_camera(path) else ()
    if path.suffix.lower() not in _DATA_SUFFIXES:
        return ()
    file = ForeignFile(path, "")
    recognisers = (_kinds_of_log, _kinds_of_table, _kinds_of_adjustment)
    try:
        return next((kinds for recognise in recognisers if (kinds := recognise(file))), ())
    except (KgcpError, RecursionError):  # unreadable or damaged: its reader will report it
        return ()


def _is_own_camera(path: Path) -> bool:
    """Whether this is a camera.toml, as `kgcp calibrate` writes it."""
    try:
        read_camera_file(path)
    except KgcpError:
        return False
    return True


def _kinds_of_log(file: ForeignFile) -> _Kinds:
    """Recognise files of a receiver or its program."""
    path, name = file.path, file.path.name.lower()
    if looks_like_marks(file):
        return (("marks", None),)
    if name.startswith(_ACCURACIES):
        return (("accuracies", None),)
    if sbet.matches(file):
        return (("trajectory", TrajectoryFile(path, "sbet")),)
    if b"\0" not in file.head and file.head.strip() and looks_like_solution(file):
        is_events = name.endswith(_EVENTS)
        return (("events", None) if is_events else ("trajectory", TrajectoryFile(path, "rtklib")),)
    if looks_like_waypoint(file):
        return (("trajectory", TrajectoryFile(path, "waypoint")),)
    return ()


def _kinds_of_table(file: ForeignFile) -> _Kinds:
    poses = sniff_table(file, _POSE_COLUMNS)
    if poses is not None and poses.cells.keys() == _POSE_COLUMNS.keys():
        return (("reference", None),)
    times = sniff_table(file, _TIME_COLUMNS)
    if times is not None and times.cells.keys() == _TIME_COLUMNS.keys():
        return (("times", None),)
    trajectory = recognised_table(file)
    if trajectory is not None:
        return (("trajectory", TrajectoryFile(file.path, "csv", trajectory)),)
    points = recognised_points(file)
    return () if points is None else (("points", points),)


def _kinds_of_adjustment(file: ForeignFile) -> _Kinds:
    """Return what programs that calibrate and adjust have written, and TUM, which has no mark."""
    if b"\0" in file.head or not file.head.strip():
        return ()
    if tum.matches(file) and all(map(is_number, file.first_line.split())):
        return (("trajectory", TrajectoryFile(file.path, "tum")),)
    is_poses = any(
        matches(file) for name, (matches, _) in POSE_FORMATS.formats.items() if name != "csv"
    )
    return (
        *((("calibration", None),) if _is_calibration(file) else ()),
        *((("reference", None),) if is_poses else ()),
    )


def _is_calibration(file: ForeignFile) -> bool:
    """Whether a file has cameras: any JSON begins like one of OpenCV's."""
    if not any(matches(file) for matches, _ in CALIBRATION_FORMATS.formats.values()):
        return False
    try:
        return bool(CALIBRATION_FORMATS.reader(file)(file))
    except KgcpError:
        return False
