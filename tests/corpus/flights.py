"""What a flight's folder says beside the frames: flight.toml, tables, calibrations, poses."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from tests.corpus.frames import png
from tests.corpus.ground import REFERENCE, SEEN, TIMES, TOML, VEHICLE, Case, encoded, sparse

_EXPORT = ("export-gcp", "--format", "csv")
_REPORT = ("bias-report",)
_SPACES = " " * (1 << 20)
_LAUGHS = (
    '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "'
    + 1000 * "ha"
    + '">'
    + "".join(f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in ("ab", "bc", "cd", "de", "ef", "fg"))
    + "]>"
)
_READS_FILES = '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY g SYSTEM "file:///etc/passwd">]>'


def _with(name: str, content: str | bytes) -> Callable[[Path], object]:
    data = content if isinstance(content, bytes) else content.encode()
    return lambda flight: (flight / name).write_bytes(data)


def _toml(old: str, new: str) -> Callable[[Path], object]:
    assert old in TOML
    return _with("flight.toml", TOML.replace(old, new))


def _camera(content: str | bytes, keys: str = "") -> Callable[[Path], object]:
    """Let the camera come from a file."""
    start, end = TOML.index("[camera]"), TOML.index("[[target]]")
    text = f'{TOML[:start]}[camera]\nfile = "camera"\n{keys}\n{TOML[end:]}'

    def plant(flight: Path) -> None:
        (flight / "flight.toml").write_text(text)
        _with("camera", content)(flight)

    return plant


def _instead(name: str, make: Callable[[Path], object]) -> Callable[[Path], object]:
    def plant(flight: Path) -> None:
        (flight / name).unlink()
        make(flight / name)

    return plant


def _many_targets(count: int) -> str:
    start, end = TOML.index("[[target]]"), TOML.index("[vehicle]")
    table = TOML[start:end]
    tables = "".join(table.replace('"A"', f'"A{number}"') for number in range(count))
    return TOML[:start] + tables + TOML[end:]


def _crs_of_a_pipe(flight: Path) -> None:
    os.mkfifo(flight / "pipe")
    _toml("EPSG:25832", f"+init={flight}/pipe:a")(flight)


def _elsewhere(flight: Path) -> None:
    _toml('folder = "frames"', 'folder = "../elsewhere"')(flight)
    shutil.copy(flight / "frames" / "sound.png", flight.parent / "elsewhere" / "sound.png")


_DEEP = 100_000
# name: what flight.toml is, words of the one line (none: the flight is read)
TOMLS: Mapping[str, tuple[str | bytes, str]] = {
    "no TOML": ("frames = [", "is not TOML: "),
    "an empty flight.toml": ("", "camera: is missing"),
    "a flight.toml of noise": (bytes(range(256)) * 9, "is not UTF-8"),
    "a flight.toml in UTF-16": (TOML.encode("utf-16"), "is not UTF-8"),
    "a flight.toml with a mark of order": ("\ufeff" + TOML, ""),
    "a flight.toml with ends of DOS": (TOML.replace("\n", "\r\n"), ""),
    "a flight.toml with NUL": (TOML + "\0", "is not TOML: "),
    "a flight.toml of half a megabyte": ("#\n" * (1 << 18), "more than the 262144 allowed"),
    "lists in lists": (f"a = {'[' * 8000}{']' * 8000}", "is not readable TOML"),
    "tables in tables": ("a = " + "{a=" * 4000 + "1" + "}" * 4000, "is not readable TOML"),
    "a key of many parts": (".".join("a" * 8000) + " = 1", "has a key of very many parts"),
    "a key without end": (f"{'k' * 200_000} = 1", "is not a known key"),
    "a key that clears the screen": ('"\\u001b[2J\\nkgcp: all is well" = 1', "\\x1b[2J kgcp: all"),
    "5 000 digits": (TOML.replace("= 64", f"= {'6' * 5000}"), "is not readable TOML"),
    "5 000 hexadecimal digits": (TOML.replace("= 64", f"= 0x{'f' * 5000}"), "width: is too large"),
    "a focal length of many digits": (TOML.replace("fx = 100.0", f"fx = 0x{'f' * 5000}"), "fx: is"),
    "infinity": (TOML.replace("fx = 100.0", "fx = inf"), "fx: inf is not a finite number"),
    "no number": (TOML.replace("cx = 31.0", "cx = nan"), "cx: nan is not a finite number"),
    "a date for a number": (TOML.replace("fx = 100.0", "fx = 1979-05-27"), "fx: is a date or time"),
    "a day that is none": (TOML.replace("fx = 100.0", "fx = 2026-13-41"), "is not TOML: "),
    "truth for a number": (TOML.replace("fx = 100.0", "fx = true"), "fx: is a boolean"),
    "a frame of 1e9 pixels": (TOML.replace("width = 64", "width = 1000000000"), "out of range"),
    "a text for frames": (
        TOML.replace('[frames]\nfolder = "frames"', 'frames = "../../.."'),
        "tabl",
    ),
    "no folder of frames": (TOML.replace('"frames"', '"gone"'), "'gone' is not a folder"),
    "a folder without end": (TOML.replace('"frames"', f'"{"f" * 5000}"'), "is not a folder"),
    "a folder with NUL": (TOML.replace('"frames"', '"a\\u0000b"'), "is not a folder"),
    "a file for frames": (TOML.replace('"frames"', '"vehicle.csv"'), "is not a folder"),
    "times of a device": (TOML.replace("[camera]", 'times = "/dev/zero"\n[camera]'), "a regular"),
    "times of a folder": (TOML.replace("[camera]", 'times = "frames"\n[camera]'), "a regular"),
    "a name of two lines": (TOML.replace('"lies"', '"a\\nb"'), r"name: 'a\nb' is not a name"),
    "a target's name of control": (TOML.replace('"A"', '"\\u0085"'), "name: "),
    "a target's name without end": (TOML.replace('"A"', f'"{"A" * 9000}"'), "is not a name"),
    "no target": (TOML.replace("[[target]]", "[target]"), "target: is a table"),
    "1 000 targets": (_many_targets(1000), "target: has 1000 tables"),
    "200 targets of one code": (_many_targets(200), "are rotations of each other"),
    "50 000 dots": (TOML.replace("[0, 43, 78, 180]", str([0] * 50_000)), "has 50000 dots"),
}
# name: content of frames.csv, words of the one line
TIMES_FILES: Mapping[str, tuple[str | bytes, str]] = {
    "empty times": ("", "is empty; its first line must name frame, time"),
    "times without rows": ("frame,time\n", "names no frame; give a line with name and time"),
    "times with a mark of order": ("\ufeff" + TIMES, ""),
    "times with ends of DOS": (TIMES.replace("\n", "\r\n"), ""),
    "times in UTF-16": (TIMES.encode("utf-16"), "is not text in UTF-8"),
    "times of NUL": (TIMES + "\0\0\0\n", "is not a valid text line"),
    "times of a PNG": (encoded(".png"), "is not text in UTF-8"),
    "times without a column": ("frame\na.png\n", "lacks the columns time"),
    "a time that is no number": ("frame,time\na.png,nan\n", "'nan' is not a time"),
    "a time of 1e999": ("frame,time\na.png,1e999\n", "is out of range"),
    "a time twice": (TIMES + TIMES.splitlines()[1], "is also in line 2"),
    "a time of nowhere": ("frame,time\na.png,2026-06-16T08:15:01\n", "names no time zone"),
    "a time after the calendar": (
        "frame,time\na.png,9999-12-31T23:59:59-23:59\n",
        "is out of range",
    ),
    "a time of very many digits": (f"frame,time\na.png,{'1' * 130_000}x\n", "is not a time"),
    "a cell without end": (f'frame,time\na.png,"{"x" * 200_000}', "field larger"),
    "a line without end": (f"frame,time\n{'x' * (2 << 20)}", "is not a valid text line"),
    "a quote without end": ('frame,time\n"a.png,1\n' + "b.png,2\n" * 50_000, "field larger"),
    "marks of very many digits": (f"1 {'9' * 9000} [2400]\n", "lacks the columns frame, time"),
    "marks of a week that never comes": ("1 1.0 [999999999]\n", "none of its 1 numbers"),
    "one mark twice": ("1 1.0 [2400]\n1 2.0 [2400]\n", "number 1 is also in line 1"),
    "events of an endless header": ("%" + " a(" * 300_000 + "\n", "lacks the header line"),
    "events of an infinite week": ("%  GPST x(m)\n1e400 1 2\n", "is not a time and numbers"),
    "events of a week of 9s": (f"%  GPST x(m)\n{'9' * 400} 1 2\n", "is not a time and numbers"),
}
# name: content of vehicle.csv, words of the one line
TRAJECTORIES: Mapping[str, tuple[str | bytes, str]] = {
    "an empty trajectory": ("", "is empty"),
    "a trajectory without rows": (VEHICLE.splitlines()[0] + "\n", "has 0 epochs"),
    "a trajectory of one row": ("\n".join(VEHICLE.splitlines()[:2]), "has 1 epochs"),
    "a trajectory with a NaN": (VEHICLE.replace("545.0", "nan", 1), "line 2: z is 'nan'"),
    "a trajectory with infinity": (VEHICLE.replace("545.0", "-inf", 1), "line 2: z is '-inf'"),
    "a trajectory with 1e308": (VEHICLE.replace("5336213.0", "1e308", 1), "y is '1e308'"),
    "a trajectory with a word": (VEHICLE.replace("5336213.0", "north", 1), "y is 'north'"),
    "a trajectory to the centre": (VEHICLE.replace("545.0", "-6378000"), "; "),
    "a trajectory far off the map": (
        VEHICLE.replace("689591.0", "1e14", 1),
        "does not cover the point",
    ),
    "a trajectory unsorted": (VEHICLE.replace(":02Z", ":00.5Z"), "lies before"),
    "a trajectory with a time twice": (VEHICLE.replace(":02Z", ":01Z"), "repeats"),
    "a trajectory without a column": (VEHICLE.replace("pitch_deg", "p"), "lacks the columns"),
    "a trajectory with a column twice": (VEHICLE.replace("pitch_deg", "x"), "lacks the columns"),
    "a trajectory with semicolons": (
        VEHICLE.replace(",", ";"),
        "is not a trajectory of a known format",
    ),
    "a trajectory with a short row": (VEHICLE.replace(",0.2,12.0", ""), "has 5 cells"),
    "a trajectory in UTF-16": (VEHICLE.encode("utf-16"), "is UTF-16, not a trajectory; save"),
    "a trajectory of zeros": (bytes(17 * 8 * 9), "is not a trajectory of a known"),
    "records cut": (b"\x40" * (17 * 8 + 1), "is not a trajectory of a known"),
}
_IMAGES = "1 1e-200 0 0 0 1 2 3 1 sound.png\n\n"
_SHOT = {"rotation": [0, 0, 0], "translation": [0, 0, 0]}
# name: content of reference.csv, words of the one line
POSES: Mapping[str, tuple[str | bytes, str]] = {
    "empty poses": ("", "is not a file of reference poses of a known format"),
    "poses with a NaN": (REFERENCE.replace("560.0", "nan"), "line 2: z is 'nan'"),
    "poses with a frame twice": (REFERENCE + REFERENCE.splitlines()[1], "is also in line 2"),
    "poses that are a picture": (encoded(".png"), "of a known format"),
    "a billion laughs": (
        _LAUGHS + "<document><chunk><cameras>&g;</cameras></chunk></document>",
        "kn",
    ),
    "an entity that reads files": (
        _READS_FILES + "<document><chunk><cameras>&g;</cameras></chunk></document>",
        "of a known format",
    ),
    "elements in elements": ("<document>" * _DEEP, "of a known format"),
    "closed elements in elements": (f"{'<a>' * _DEEP}{'</a>' * _DEEP}", "of a known format"),
    "lists in lists of JSON": ("[" * _DEEP, "of a known format"),
    "JSON of 1e999": (
        json.dumps([{"shots": {"a": _SHOT}}]).replace("0, 0, 0", "1e999, 0, 0"),
        "fini",
    ),
    "JSON of 400 digits": (
        json.dumps([{"shots": {"a": {**_SHOT, "rotation": [10**400, 0, 0]}}}]),
        "f",
    ),
    "JSON of 5 000 digits": (f'[{{"shots": {{"a": {"9" * 5000}}}}}]', "of a known format"),
    "a quaternion of next to nothing": (_IMAGES, "; "),
    "a name of very many spaces": (f"1 1 0 0 0 1 2 3 1 a{_SPACES}b\n", "; "),
    "a project that names other folders": (
        json.dumps(
            {
                "format": "application/opf-project+json",
                "items": [
                    {
                        "resources": [
                            {
                                "format": "application/opf-calibrated-cameras+json",
                                "uri": f"{'../' * 20}etc/passwd",
                            }
                        ]
                    }
                ],
            }
        ),
        "is not a calibrated-cameras of OPF",
    ),
}
_SIZE = "width = 64\nheight = 48"
_MATRIX = "camera_matrix:\n  data: [100, 0, 31, 0, 100, 24, 0, 0, 1]\n"
_ROS = f"{_MATRIX}distortion_coefficients:\n  data: [0, 0, 0, 0, 0]\nimage_width: 64\n"
_ANCHORS = "".join(f"a{n}: &a{n} [{9 * f'*a{n - 1},'}1]\n" for n in range(1, 10))
# name: content of the calibration, further keys, words of the one line
CALIBRATIONS: Mapping[str, tuple[str | bytes, str, str]] = {
    "an empty calibration": ("", "", "is not a calibration of a known format"),
    "a calibration of noise": (bytes(range(256)) * 99, "", "of a known format"),
    "a calibration of laughs": (_LAUGHS + "<calibration>&g;</calibration>", "", "; "),
    "aliases that multiply": (
        f"a0: &a0 [1]\n{_ANCHORS}{_ROS}image_height: 48\ndistortion_model: *a9\n",
        "",
        "the distortion model [[[[",
    ),
    "YAML in YAML": (f"{_ROS}image_height: {'[' * _DEEP}\n", "", "is not a camera_info of ROS"),
    "YAML of infinity": (f"{_ROS}image_height: .inf\n", "", "is not a camera_info of ROS"),
    "YAML of a program": (
        f"{_ROS}image_height: !!python/object/apply:os.system [id]\n",
        "",
        "is not a camera_info",
    ),
    "OpenCV in OpenCV": ('{"a":' * 5000 + "1" + "}" * 5000, "", "; "),
    "OpenCV of deep lists": ('{"a":' + "[" * _DEEP, "", "; "),
    "OpenCV of deep XML": ("<?xml version='1.0'?><opencv_storage>" + "<a>" * _DEEP, "", "; "),
    "OpenCV of deep YAML": ("%YAML:1.0\n---\na: " + "[" * _DEEP, "", "; "),
    "OpenCV of a huge matrix": (
        "%YAML:1.0\n---\nK: !!opencv-matrix\n rows: 100000\n cols: 100000\n dt: d\n data: [ 1. ]\n",
        "",
        "; ",
    ),
    "DewarpData of spaces": (f"{_SPACES}x", _SIZE, "of a known format"),
    "DewarpData of digits": ("1," * 8 + "1" * 500_000 + "x", _SIZE, "of a known format"),
    "DewarpData in a bomb": (
        png(200_000, 65_000) + b'DewarpData="d;1,1,1,1,0,0,0,0,0"',
        "",
        "is out of range",
    ),
    "a sensor of no width": (
        "Pix4D camera calibration file 0\n# sensor width of 0x0mm\nF 1\nPx 1\nPy 1\n",
        _SIZE,
        "; ",
    ),
    "a camera file of empty lines": (
        "Pix4D camera calibration file 0\n# sensor width of 1x1mm\n" + "\n" * 500_000 + "F",
        _SIZE,
        "; ",
    ),
    "a camera of very many digits": (f"1 PINHOLE {'6' * 5000} 48 1 1 1 1\n", "", "known format"),
    "a camera of 1e308 pixels": (
        "<calibration><width>1e308</width><height>2</height><f>1</f></calibration>",
        "",
        "; ",
    ),
    "a camera of no size": (
        '{"a": {"projection_type": "brown", "width": -1, "height": 0.5, "focal_x": 1}}',
        _SIZE,
        "; ",
    ),
}


def _huge(name: str) -> Callable[[Path], object]:
    return lambda flight: sparse(flight / name)


CASES = (
    *(
        Case(name, _with("flight.toml", text), words, is_huge="many" in name)
        for name, (text, words) in TOMLS.items()
    ),
    *(Case(name, _with("frames.csv", text), words) for name, (text, words) in TIMES_FILES.items()),
    *(
        Case(name, _with("vehicle.csv", text), words, command=_EXPORT)
        for name, (text, words) in TRAJECTORIES.items()
    ),
    *(
        Case(name, _with("reference.csv", text), words, command=_REPORT)
        for name, (text, words) in POSES.items()
    ),
    *(
        Case(name, _camera(content, keys), words, is_huge=True)
        for name, (content, keys, words) in CALIBRATIONS.items()
    ),
    Case("frames of another folder", _elsewhere, rows={"other.png": SEEN}),
    Case(
        "no flight.toml", lambda flight: (flight / "flight.toml").unlink(), "does not exist; name"
    ),
    Case(
        "a flight.toml that is a pipe", _instead("flight.toml", os.mkfifo), "does not exist; name"
    ),
    Case("a flight.toml that is a folder", _instead("flight.toml", Path.mkdir), "does not exist"),
    Case("a CRS of a pipe", _crs_of_a_pipe, "'init=' is no longer in use", command=_EXPORT),
    Case("times that are a pipe", _instead("frames.csv", os.mkfifo)),
    Case(
        "a pipe for a trajectory",
        _instead("vehicle.csv", os.mkfifo),
        "not a regular",
        command=_EXPORT,
    ),
    Case(
        "a pipe for poses", _instead("reference.csv", os.mkfifo), "not a regular", command=_REPORT
    ),
    Case("a gigabyte of flight.toml", _huge("flight.toml"), "has at least", is_huge=True),
    Case("a gigabyte of times", _huge("frames.csv"), "is not a valid text line", is_huge=True),
    Case("a gigabyte of trajectory", _huge("vehicle.csv"), "known", command=_EXPORT, is_huge=True),
    Case("a gigabyte of poses", _huge("reference.csv"), "bytes", command=_REPORT, is_huge=True),
)
