"""Results' folders that lie, and names that would be more than names in a page."""

from __future__ import annotations

import os
import pickle
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from tests.corpus.ground import (
    REFERENCE,
    SEEN,
    TOML,
    VEHICLE,
    Case,
    encoded,
    sparse,
    write_detections,
)

_EXPORT = ("export-gcp", "--format", "csv")
_ALL = ("export-gcp", "--format", "all")
_REPORT = ("bias-report", "--reexpose", "0")
_SHEET = ("detect", "--jobs", "0", "--no-guided", "--overlay", "{flight}/kgcp/sheet")
_DRAW = ("target", "--format", "svg", "--format", "pdf", "--format", "dxf")
_REMEASURE = ("bias-report", "--reexpose", "9")
_TABLE = "kgcp/detections.parquet"
_JOURNAL = "kgcp/.detections.journal"
_DEEP = b"made-by " + b"[" * 100_000 + b"\n"
_SCRIPT = "<script>alert(1)<"
_FRAME = f"{_SCRIPT}img src=x onerror=alert(2)>.png"


class _Trap:
    """What a pickle of it would do."""

    def __reduce__(self) -> tuple[Callable[..., object], tuple[Path]]:
        return Path.touch, (Path("/nowhere/kgcp-was-here"),)


def _link(name: str, leads_to: str) -> Callable[[Path], object]:
    def plant(flight: Path) -> None:
        path = flight / name
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.parent.mkdir(exist_ok=True)
        path.symlink_to(leads_to)

    return plant


def _in_place_of_results(flight: Path) -> None:
    shutil.rmtree(flight / "kgcp")
    (flight / "kgcp").write_text("a file\n")


def _table(settings: str = "{}", **cells: object) -> Callable[[Path], object]:
    return lambda flight: write_detections(flight / _TABLE, settings, **cells)


def _retyped(column: str, values: pa.Array) -> Callable[[Path], object]:
    def plant(flight: Path) -> None:
        table = pq.read_table(flight / _TABLE)
        place = table.column_names.index(column)
        pq.write_table(table.set_column(place, column, values), flight / _TABLE)

    return plant


def _bytes(name: str, data: bytes) -> Callable[[Path], object]:
    def plant(flight: Path) -> None:
        (flight / name).parent.mkdir(exist_ok=True)
        (flight / name).write_bytes(data)

    return plant


def _fifo(name: str) -> Callable[[Path], object]:
    def plant(flight: Path) -> None:
        (flight / name).parent.mkdir(exist_ok=True)
        (flight / name).unlink(missing_ok=True)
        os.mkfifo(flight / name)

    return plant


def _huge(name: str) -> Callable[[Path], object]:
    def plant(flight: Path) -> None:
        (flight / name).parent.mkdir(exist_ok=True)
        sparse(flight / name)

    return plant


def _names(flight: Path) -> None:
    """Let the flight, its target and its frame be called like programs."""
    toml = TOML.replace('"lies"', f'"{_SCRIPT}\'&"').replace('"A"', f'"{_SCRIPT}"')
    (flight / "flight.toml").write_text(toml)
    (flight / "frames" / _FRAME).write_bytes(encoded(".png"))
    (flight / "reference.csv").write_text(REFERENCE.replace("sound.png", _FRAME))
    write_detections(flight / _TABLE, frame=_FRAME, target=_SCRIPT, scale_used=_SCRIPT)


def _called_like_a_path(flight: Path) -> None:
    toml = TOML.replace('"A"', '"../../../elsewhere/precious.txt"')
    (flight / "flight.toml").write_text(toml)


def _separating_names(flight: Path) -> None:
    """Let names break the lines of whatever is exported."""
    frame = 'a\nb,"c"; 1 2 3.png'
    (flight / "frames" / frame).write_bytes(encoded(".png"))
    deviations = "0.01,0.01,0.02,0.02,0.02,0.05"
    head = "sd_x,sd_y,sd_z,sd_roll_deg,sd_pitch_deg,sd_heading_deg"
    first, *rows = VEHICLE.splitlines()
    lines = [f"{first},{head}", *(f"{row},{deviations}" for row in rows)]
    (flight / "vehicle.csv").write_text("\n".join(lines) + "\n")
    write_detections(flight / _TABLE, frame=frame, sd_x_px=0.1, sd_y_px=0.1)


_ESCAPED = (b"<script>alert(1)", b"<img src=x")
CASES = (
    # where results go
    Case("results that are a link", _link("kgcp", "../elsewhere"), "kgcp: is a link; delete it"),
    Case("results that lead nowhere", _link("kgcp", "/nowhere"), "kgcp: is a link; delete it"),
    Case("results that are a file", _in_place_of_results, "; "),
    Case(
        "a folder of results that is a link",
        _link("kgcp/odm", "../../elsewhere"),
        "odm: is a link to a folder; delete it",
        command=("export-gcp", "--format", "odm"),
    ),
    Case("a table that is a link", _link(_TABLE, "../../elsewhere/precious.txt")),
    Case("half a table that is a link", _link(f"{_TABLE}.part", "../../elsewhere/precious.txt")),
    Case(
        "a temporary name that is a link",
        _link("kgcp/.detections.parquet.part", "../../elsewhere/precious.txt"),
    ),
    Case("a record that is a link", _link("kgcp/run.json", "../../elsewhere/precious.txt")),
    Case("a journal that is a link", _link(_JOURNAL, "../../elsewhere"), "is a link"),
    # what an interrupted run seems to have left
    Case("a journal of noise", _bytes(_JOURNAL, b"\xff\0{[")),
    Case("a journal that is a pickle", _bytes(_JOURNAL, pickle.dumps(_Trap()))),
    Case("a journal in depth", _bytes(_JOURNAL, b"%08x " % zlib.crc32(_DEEP) + _DEEP)),
    Case("a journal that is a pipe", _fifo(_JOURNAL), "is not a file"),
    Case("a gigabyte of journal", _huge(_JOURNAL), is_huge=True),
    # the table that others made
    Case(
        "no table", lambda flight: (flight / _TABLE).unlink(), "run 'kgcp detect'", command=_EXPORT
    ),
    Case("an empty table", _bytes(_TABLE, b""), "is not a readable Parquet", command=_EXPORT),
    Case(
        "a table of noise", _bytes(_TABLE, b"PAR1" + b"\xff" * 99 + b"PAR1"), "; ", command=_EXPORT
    ),
    Case("a table that is a pipe", _fifo(_TABLE), "run 'kgcp detect'", command=_EXPORT),
    Case("a gigabyte of table", _huge(_TABLE), "is not a re", command=_EXPORT, is_huge=True),
    Case(
        "frames that are numbers",
        _retyped("frame", pa.array([7])),
        "the column frame has the type int64, not string",
        command=_EXPORT,
    ),
    Case(
        "a frame that is nothing",
        _retyped("frame", pa.array([None], pa.string())),
        "the column frame has empty cells",
        command=_EXPORT,
    ),
    Case(
        "instances that are lists",
        _retyped("instance", pa.array([[1]])),
        "the column instance has the type list",
        command=_EXPORT,
    ),
    Case("a table of another target", _table(target="B"), "has target 'B'", command=_EXPORT),
    Case("a rotation of zeros", _table(qw=0.0), "; ", command=_EXPORT),
    Case("a measurement that is none", _table(x_px=float("nan")), "is empty;", command=_EXPORT),
    Case("a point out of all frames", _table(x_px=1e300), "x_px of a m", command=_EXPORT),
    Case("a point at no distance", _table(distance_m=1e-300), "distance_m of", command=_EXPORT),
    Case("a sure error of none", _table(sd_x_px=0.0), "sd_x_px of a meas", command=_EXPORT),
    Case("a status of its own", _table(status="splendid"), "no target was meas", command=_EXPORT),
    Case("settings in depth", _table(settings="[" * 100_000), "its settings", command=_REPORT),
    Case("settings of words", _table(settings='{"min_score": "x"}'), "its set", command=_REPORT),
    Case("a frame of another folder", _table(frame="/etc/passwd"), "; ", command=_REMEASURE),
    Case("a frame that no file is called", _table(frame="a\0b.png"), "; ", command=_REMEASURE),
    # names that would be more than names
    Case("names that are scripts, in the report", _names, command=_REPORT, absent=_ESCAPED),
    Case(
        "names that are scripts, in the contact sheet",
        _names,
        rows={_FRAME: SEEN},
        command=_SHEET,
        absent=_ESCAPED,
    ),
    Case("names that are scripts, in all exports", _names, command=_ALL, absent=_ESCAPED),
    Case("names that are scripts, in drawings", _names, command=_DRAW, absent=_ESCAPED),
    Case("a target called like a path", _called_like_a_path, command=_DRAW),
    Case(
        "targets that are a link", _link("kgcp/targets", "../../elsewhere"), "link", command=_DRAW
    ),
    Case("names that break lines, in all exports", _separating_names, command=_ALL),
)
