"""Files spoiled by spreadsheets, editors and cameras: one line with the cause and the remedy."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import pytest

from tests.cli.conftest import SampleFlight

_GPS_EPOCH_S, _LEAP_S, _WEEK_S = 315_964_800, 18, 604_800
TABLES = {"frames.csv": "detect", "vehicle.csv": "export-gcp", "reference.csv": "bias-report"}


def lines_of(change: Callable[[str], str], *, with_head: bool = True) -> Callable[[str], str]:
    def rewrite(text: str) -> str:
        head, *rows = text.splitlines()
        return "\n".join([change(head) if with_head else head, *map(change, rows), ""])

    return rewrite


def quoted_commas(line: str) -> str:
    first, *numbers = line.split(",")
    return ",".join([first, *(f'"{number.replace(".", ",")}"' for number in numbers)])


SEPARATORS = {";": "';'", "\t": "tabs", " ": "spaces"}


@pytest.mark.parametrize("separator", SEPARATORS)
@pytest.mark.parametrize("name", TABLES)
def test_other_separators_are_named(measured: SampleFlight, name: str, separator: str) -> None:
    path = measured.path / name
    path.write_text(path.read_text(encoding="utf-8").replace(",", separator), encoding="utf-8")
    line = measured.fails(TABLES[name])
    remedy = "declare separator, decimal" if name == "vehicle.csv" else "save it with commas"
    assert f"its cells are separated by {SEPARATORS[separator]}; {remedy}" in line
    assert str(path) in line


@pytest.mark.parametrize("name", TABLES)
def test_other_encodings_are_named(measured: SampleFlight, name: str) -> None:
    path = measured.path / name
    text = path.read_text(encoding="utf-8")
    path.write_bytes(text.encode("utf-16"))
    assert re.search("(is|but) UTF-16.*; save it as UTF-8", measured.fails(TABLES[name]))
    path.write_bytes(f"{text}# Überführung\n".encode("latin-1"))
    line = measured.fails(TABLES[name])
    assert "but of another encoding (Latin-1 or Windows-1252?); save it as UTF-8" in line
    path.write_bytes(b"PK\x03\x04\x14\0\x06\0\x08\0!\0\xb5\xff")
    line = measured.fails(TABLES[name])
    assert re.search("(is|but) a spreadsheet or archive.*; export a spreadsheet as CSV", line)


@pytest.mark.parametrize("name", ["vehicle.csv", "reference.csv"])
def test_decimal_commas_are_named(measured: SampleFlight, name: str) -> None:
    path = measured.path / name
    text = path.read_text(encoding="utf-8")
    change = lines_of(lambda line: line.replace(".", ","), with_head=False)
    path.write_text(change(text), encoding="utf-8")
    line = measured.fails(TABLES[name])
    assert re.search(r"line 2: has \d+ cells, .*; write decimal points, not commas", line)
    path.write_text(lines_of(quoted_commas, with_head=False)(text), encoding="utf-8")
    line = measured.fails(TABLES[name])
    assert re.search(r"line 2: x is '68958?9?\d+,\d+', with a decimal comma; write a point", line)


TOMLS = {
    "decimal comma": ("fx = 1903.0", "fx = 1903,0", "'fx = 1903,0' has a decimal comma; "),
    "commas in a list": (
        "[-0.8, 0.15, -1.95]",
        "[-0,8, 0,15, -1,95]",
        "lever_arm_m: has 6 numbers instead of 3; .*; decimals take a point",
    ),
    "[target] twice": (
        "[[target]]",
        "[target]",
        r"\[target\] is given twice; head every target \[\[",
    ),
    "[camera] twice": ("[frames]", "[camera]\n[frames]", r"\[camera\] is given twice; put all its"),
    "key twice": (
        "fx = 1903.0",
        "fx = 1.0\nfx = 2.0",
        "'fx = 2.0': its key or table is given twice",
    ),
    "backslash": ("vehicle.csv", r"data\vehicle.csv", "has a backslash in a text; write / instead"),
    "drive": ("vehicle.csv", r"C:\Users\vehicle.csv", "has a backslash in a text; write / instead"),
    "tab": ("vehicle.csv", r"data\track.csv", r"trajectory: 'data.track.csv' has a backslash; wri"),
    "tab in times": ("frames.csv", r"data\times.csv", r"times: 'data.times.csv' has a backslash; "),
    "no quotes": ('"linear"', "linear", "'response = linear' has a text without quotes; put it in"),
    "curly quotes": ('"linear"', "“linear”", "has curly quotes; write straight ones"),
    "colon": ("fx = 1903.0", "fx: 1903.0", "'fx: 1903.0' has : after the key; write = between"),
    "unit": ("fx = 1903.0", "fx = 1903.0 px", "has a unit after the number; give the number alone"),
    "no value": ("fx = 1903.0", "fx =", "'fx =' has no value; give the key a value"),
    "no bracket": ("180]", "180", "a list before it has no end; close the list with ]"),
    "True": (
        "[vehicle]",
        "[frames.x]\ny = True\n[vehicle]",
        "has true or false in capitals; write",
    ),
    "no lever arm": (
        "lever_arm_m = [-0.8, 0.15, -1.95]\nsd_",
        "sd_",
        r"lever_arm_m: is missing; .*\[forward, right, down\] in metres from the trajectory point",
    ),
}


@pytest.mark.parametrize("name", TOMLS)
def test_mistakes_in_toml_are_named(unmeasured: SampleFlight, name: str) -> None:
    old, new, words = TOMLS[name]
    path = unmeasured.path / "flight.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    line = unmeasured.fails("detect")
    assert re.search(words, line), line
    assert str(path) in line


@pytest.mark.parametrize(("encoding", "words"), [("utf-16", "UTF-16"), ("latin-1", "Latin-1 or")])
def test_a_flight_toml_of_another_encoding_is_refused(
    unmeasured: SampleFlight, encoding: str, words: str
) -> None:
    unmeasured.edit(('name = "sample"', 'name = "Straße"'))
    path = unmeasured.path / "flight.toml"
    path.write_bytes(path.read_text(encoding="utf-8").encode(encoding))
    assert re.search(
        f"is not UTF-8 but .*{words}.*; save it as plain text in UTF-8", unmeasured.fails("detect")
    )


def test_a_folder_in_place_of_a_calibration_file_is_named(unmeasured: SampleFlight) -> None:
    path = unmeasured.path / "flight.toml"
    text = re.sub(
        r"width = 1200.*p2 = 0.0005", 'file = "frames"', path.read_text(), flags=re.DOTALL
    )
    path.write_text(text, encoding="utf-8")
    line = unmeasured.fails("detect")
    assert "[camera] file: 'frames' is not a regular file; name a file" in line


@pytest.mark.parametrize(
    ("suffix", "words"),
    [
        (".DNG", "5 .dng raw files; develop them to JPEG, PNG or TIFF without lens correction"),
        (".MP4", "5 .mp4 videos; extract the key frames with the time of each"),
        (".heic", "5 .heic files of a phone; convert them to JPEG or PNG of the same size"),
        (".pdf", "5 .pdf files; convert them to JPEG, PNG or TIFF, or correct [frames] folder"),
    ],
)
def test_frames_that_are_no_images_are_named(
    unmeasured: SampleFlight, suffix: str, words: str
) -> None:
    for frame in (unmeasured.path / "frames").iterdir():
        frame.rename(frame.with_suffix(suffix))
    assert f"holds no images that kgcp reads, but {words}" in unmeasured.fails("detect")


def gps_s(time: str) -> float:
    return datetime.fromisoformat(time).timestamp() - _GPS_EPOCH_S + _LEAP_S


def rewrite_times(path: Path, clock: Callable[[float], str]) -> None:
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    column = head.split(",").index("time")
    lines = []
    for row in rows:
        cells = row.split(",")
        cells[column] = clock(gps_s(cells[column]))
        lines.append(",".join(cells))
    path.write_text("\n".join([head, *lines]), encoding="utf-8")


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (
            lambda gps: f"{gps % _WEEK_S:.6f}",
            "seconds of a GPS week: give [vehicle] date = 2026-06-16, the day of its first epoch",
        ),
        (
            lambda gps: f"{gps:.6f}",
            "the trajectory's times count from 1980-01-06, as GPS does: to make",
        ),
        (
            lambda gps: f"{gps // _WEEK_S:.0f} {gps % _WEEK_S:.6f}",
            "line 2: time: '2423 202518.000000' is a GPS week with seconds; give UTC",
        ),
    ],
)
def test_gps_times_of_a_trajectory_are_named(
    measured: SampleFlight, clock: Callable[[float], str], words: str
) -> None:
    rewrite_times(measured.path / "vehicle.csv", clock)
    assert words in measured.fails("export-gcp")


def test_frames_timed_by_seconds_of_a_gps_week_are_told_what_to_subtract(
    unmeasured: SampleFlight,
) -> None:
    rewrite_times(unmeasured.path / "frames.csv", lambda gps: f"{gps % _WEEK_S:.6f}")
    result = unmeasured.run("check")
    assert result.exit_code == 1
    said = " ".join(result.stdout.split())
    assert "the frames' times are seconds of a GPS week: subtract the leap seconds (18" in said


def test_the_keys_that_are_named_for_a_gps_week_are_right(measured: SampleFlight) -> None:
    assert measured.run("export-gcp").exit_code == 0
    before = (measured.out / "kgcps.csv").read_bytes()
    rewrite_times(measured.path / "vehicle.csv", lambda gps: f"{gps % _WEEK_S:.6f}")
    measured.edit(("[vehicle]\n", '[vehicle]\ndate = 2026-06-16\ntime_system = "gps"\n'))
    assert measured.run("export-gcp").exit_code == 0
    assert (measured.out / "kgcps.csv").read_bytes() == before


def test_a_selection_that_rejects_all_points_reports_the_best_one(measured: SampleFlight) -> None:
    line = measured.fails("export-gcp", "--max-sd", "0.001")
    assert re.search(
        r"no points left after selection: 4 uncertain of 4; the best standard deviation is"
        r" 0\.01\d+ m; relax the limits",
        line,
    )
    assert "the best score is 0.9" in measured.fails("export-gcp", "--min-score", "1.0")
    assert not (measured.out / "kgcps.parquet").exists()
