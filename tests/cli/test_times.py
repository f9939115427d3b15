"""Where a frame's time comes from: beside a times file, EXIF's is never used unasked."""

from __future__ import annotations

import json
import re
from collections.abc import Callable

import pandas as pd
import pytest

from tests.cli.conftest import FRAMES, SampleFlight

FAST = ("--jobs", "0", "--no-guided", "--min-radius", "60", "--json")  # times are at stake alone


def rewrite(flight: SampleFlight, change: Callable[[str], str]) -> None:
    """Change every name in frames.csv."""
    path = flight.path / "frames.csv"
    head, *lines = path.read_text(encoding="utf-8").splitlines()
    cells = [line.split(",") for line in lines]
    rows = [f"{change(name)},{time}" for name, time in cells]
    path.write_text("\n".join([head, *rows]), encoding="utf-8")


@pytest.mark.parametrize(
    ("change", "name", "why"),
    [
        (lambda name: name.removesuffix(".jpg"), "frame_0000", "the extension is missing"),
        (str.upper, "FRAME_0000.JPG", "upper and lower case differ"),
        (lambda name: name.replace("jpg", "JPG"), "frame_0000.JPG", "upper and lower case differ"),
        (lambda name: name.replace("jpg", "png"), "frame_0000.png", "the extension differs"),
        (lambda name: f"frames/{name}", "frames/frame_0000.jpg", "the folder differs"),
        (lambda name: f"C:\\DCIM\\{name}", "C:/DCIM/frame_0000.jpg", "the folder differs"),
        (lambda name: f"east/{name[:-4]}", "east/frame_0000", "folder and extension differ"),
        (lambda name: f"E/{name[:-4].upper()}", "E/FRAME_0000", "folder, extension or letter case"),
    ],
)
def test_names_that_are_no_frames_are_an_error(
    unmeasured: SampleFlight, change: Callable[[str], str], name: str, why: str
) -> None:
    rewrite(unmeasured, change)
    line = unmeasured.fails("detect", *FAST)
    assert f"frames.csv: none of its 5 names is a frame's: it has '{name}'," in line
    assert f"the frames folder has 'frame_0000.jpg' ({why}" in line
    assert not unmeasured.out.exists()


def test_names_of_another_flight_are_an_error(unmeasured: SampleFlight) -> None:
    rewrite(unmeasured, lambda name: name.replace("frame", "other"))
    assert "it has 'other_0000.jpg', the frames folder has 'frame_0000.jpg'; write" in (
        unmeasured.fails("detect", *FAST)
    )


def test_a_times_file_without_lines_is_an_error(unmeasured: SampleFlight) -> None:
    (unmeasured.path / "frames.csv").write_text("frame,time\n", encoding="utf-8")
    line = unmeasured.fails("detect", *FAST)
    assert "frames.csv: names no frame; give a line with name and time for every frame" in line
    assert not unmeasured.out.exists()


def test_frames_without_a_line_have_no_time(unmeasured: SampleFlight) -> None:
    rewrite(unmeasured, lambda name: name.replace(".", "_x.") if name in FRAMES[:2] else name)
    result = unmeasured.run("detect", *FAST)
    assert "frames that the times file does not name: 2; 2 of them have no time" in result.stderr
    assert "times without a frame of that name: 2\n" in result.stderr
    numbers = json.loads(result.stdout)
    assert (numbers["frames_not_in_times_file"], numbers["frames_without_time"]) == (2, 2)
    table = pd.read_parquet(unmeasured.out / "detections.parquet")
    assert table["time"].isna().to_list() == [True, True, False, False, False]
    assert table["time_source"].to_list() == ["", "", *["times_file"] * 3]


@pytest.mark.parametrize(
    ("fallback", "words"), [(False, "it has no time: complete"), (True, "it has EXIF's time:")]
)
def test_a_single_frame_without_a_line_has_no_time(
    unmeasured: SampleFlight, *, fallback: bool, words: str
) -> None:
    rewrite(unmeasured, lambda name: "other.jpg" if name == FRAMES[0] else name)
    if fallback:
        unmeasured.edit(('times = "frames.csv"', 'times = "frames.csv"\nexif_fallback = true'))
    stderr = unmeasured.run("detect", *FAST).stderr
    assert f"frames that the times file does not name: 1; {words}" in stderr
    assert fallback != ("1 of 5 frames has no time, such as frame_0000.jpg" in stderr)


def test_exif_times_are_used_if_exif_fallback_is_set(unmeasured: SampleFlight) -> None:
    rewrite(unmeasured, lambda name: name.upper() if name in FRAMES[:2] else name)
    unmeasured.edit(('times = "frames.csv"', 'times = "frames.csv"\nexif_fallback = true'))
    result = unmeasured.run("detect", *FAST)
    assert "frames that the times file does not name: 2; they have EXIF's time" in result.stderr
    assert (
        "times without a frame of that name: 2 ('FRAME_0000.JPG' for 'frame_0000.jpg': upper and"
        " lower case differ)"
    ) in result.stderr
    table = pd.read_parquet(unmeasured.out / "detections.parquet")
    assert table["time"].notna().all()
    assert table["time_source"].to_list() == ["exif", "exif", *["times_file"] * 3]
    unmeasured.edit(("exif_fallback = true", "exif_fallback = false"))
    assert (
        "[frames] times of 2 of 5 frames (frame_0000.jpg: 2026-06-16T08:15:05.000336Z → none)"
    ) in unmeasured.fails("export-gcp")


def test_without_a_times_file_all_times_are_of_exif(unmeasured: SampleFlight) -> None:
    unmeasured.edit(('times = "frames.csv"\n', ""))
    (unmeasured.path / "frames.csv").rename(unmeasured.path / "times.csv")
    assert unmeasured.run("detect", *FAST).exit_code == 0
    table = pd.read_parquet(unmeasured.out / "detections.parquet")
    assert set(table["time_source"]) == {"exif"}
    unmeasured.edit(('folder = "frames"', 'folder = "frames"\ntimes = "times.csv"'))
    assert "changed since 'kgcp detect': [frames] times" in unmeasured.fails("export-gcp")


def test_the_key_is_true_or_false(unmeasured: SampleFlight) -> None:
    unmeasured.edit(('times = "frames.csv"', 'times = "frames.csv"\nexif_fallback = "yes"'))
    assert "[frames] exif_fallback: is a text; give true or false" in unmeasured.fails("detect")


def test_times_truncated_by_a_spreadsheet_are_reported(unmeasured: SampleFlight) -> None:
    path = unmeasured.path / "frames.csv"
    assert "whole seconds" not in unmeasured.run("check").stdout
    path.write_text(re.sub(r"\.\d+Z", "Z", path.read_text(encoding="utf-8")), encoding="utf-8")
    assert "all 5 frame times are whole seconds" in unmeasured.run("check").stdout
