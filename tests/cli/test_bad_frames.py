"""Unreadable frames become rows with a reason; unusable folders are one-line errors."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from tests.flight_toml import RING_A

WIDTH, HEIGHT = 320, 200
FLIGHT = f"""\
[camera]
width = {WIDTH}
height = {HEIGHT}
fx = 400.0
fy = 400.0
cx = 160.0
cy = 100.0
{RING_A}"""


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, arguments, catch_exceptions=False)


def one_line_of_error(result: Result) -> str:
    """The last line on stderr, after the checks that hold for every known error."""
    assert result.exit_code == 1
    assert result.stdout == ""
    errors = [line for line in result.stderr.splitlines() if "kgcp: error: " in line]
    assert len(errors) == 1
    assert errors[0] == result.stderr.splitlines()[-1]
    assert "; " in errors[0], "the remedy follows a semicolon"
    return errors[0]


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """A flight of three frames of empty ground."""
    frames = tmp_path / "frames"
    frames.mkdir()
    (tmp_path / "flight.toml").write_text(FLIGHT)
    rng = np.random.default_rng(3)
    for number in range(3):
        noise = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, WIDTH)), (0, 0), 2.0)
        assert cv2.imwrite(str(frames / f"good_{number}.jpg"), noise.astype(np.uint8))
    return tmp_path


def test_unreadable_frames_become_rows_beside_the_measured_ones(flight: Path) -> None:
    frames = flight / "frames"
    whole = (frames / "good_0.jpg").read_bytes()
    (frames / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (frames / "text.jpg").write_text("not an image\n")
    (frames / "zero.png").touch()
    assert cv2.imwrite(str(frames / "tiny.png"), np.zeros((1, 1), np.uint8))
    result = run("detect", str(flight), "--jobs", "0", "--json")
    assert result.exit_code == 1, "nothing was measured"
    assert "no target was measured in any of 7 frames: 3 " in result.stderr.splitlines()[-1]
    summary = json.loads(result.stdout)
    assert summary["frames"] == 7
    printed = [line for line in result.stderr.splitlines() if "doubt: " in line]
    for doubt, line in zip(summary["doubts"], printed, strict=True):
        assert doubt["sentence"] in line
    assert [doubt["code"] for doubt in summary["doubts"]] == ["frame_size"]
    status = summary["status"]
    assert (status["measured"], status["unreadable"]) == (0, 4)
    assert status["not_found"] + status["rejected"] == 3  # noise may have a ring or not
    table = pq.read_table(flight / "kgcp" / "detections.parquet").to_pydict()
    reasons = dict(zip(table["frame"], table["reason"], strict=True))
    assert {frame: reasons[frame] for frame in sorted(reasons)[:1] + sorted(reasons)[4:]} == {
        "cut.jpg": "decode_failed",
        "text.jpg": "decode_failed",
        "tiny.png": "wrong_size",
        "zero.png": "decode_failed",
    }
    assert "4 unreadable" in result.stderr


def test_an_empty_frames_folder_is_a_one_line_error(flight: Path) -> None:
    for frame in (flight / "frames").iterdir():
        frame.unlink()
    line = one_line_of_error(run("detect", str(flight)))
    assert f"{flight / 'frames'}: holds no images" in line
    assert not (flight / "kgcp").exists()


def test_images_that_are_not_read_are_named_once(flight: Path) -> None:
    """Unless the camera wrote a JPEG beside each of them, as it does with raw files."""
    frames = flight / "frames"
    first = next(frames.iterdir())
    (frames / f"{first.stem}.DNG").write_bytes(b"raw")
    result = run("detect", str(flight), "--jobs", "0", "--quiet")
    assert "leaves out" not in result.stderr
    (frames / "IMG_0001.HEIC").write_bytes(b"heic")
    result = run("detect", str(flight), "--jobs", "0", "--quiet")
    assert result.stderr.count("does not read .heic files of a phone and leaves out 1; ") == 1


@pytest.mark.parametrize("command", ["export-gcp", "bias-report"])
def test_commands_that_need_detections_fail_in_one_line_before_detect(
    flight: Path, command: str
) -> None:
    assert "run 'kgcp detect'" in one_line_of_error(run(command, str(flight)))


def sized(flight: Path, count: int, *sizes: tuple[int, int]) -> None:
    """Let the flight have this many frames, of sizes that take turns."""
    for frame in (flight / "frames").iterdir():
        frame.unlink()
    for number in range(count):
        width, height = sizes[number % len(sizes)]
        image = np.full((height, width), 90, np.uint8)
        assert cv2.imwrite(str(flight / "frames" / f"{number:03d}.png"), image)


def test_frames_of_another_size_end_the_run_early(flight: Path) -> None:
    sized(flight, 30, (640, 400))
    line = one_line_of_error(run("detect", str(flight), "--jobs", "0"))
    assert (
        "frames: the first 20 frames looked at are all 640 x 400 px, the camera has 320 x 200; give"
        " flight.toml the size and calibration of these frames"
    ) in line
    assert not (flight / "kgcp" / "detections.parquet").exists()
    toml = (flight / "flight.toml").read_text("utf-8")
    wider = toml.replace(f"width = {WIDTH}", f"width = {WIDTH + 1}")
    (flight / "flight.toml").write_text(wider, "utf-8")
    line = one_line_of_error(run("detect", str(flight), "--jobs", "0"))
    assert "are all 640 x 400 px, the camera has 321 x 200" in line, "no --restart is needed"


@pytest.mark.parametrize(
    ("count", "sizes", "rows"),
    [
        (12, [(640, 400)], 12),
        (30, [(640, 400), (400, 640)], 30),
        (30, [(WIDTH, HEIGHT), (9, 9)], 15),
    ],
)
def test_a_run_continues_if_some_frames_have_the_stated_size(
    flight: Path, count: int, sizes: list[tuple[int, int]], rows: int
) -> None:
    sized(flight, count, *sizes)
    result = run("detect", str(flight), "--jobs", "0")
    assert f"no target was measured in any of {count} frames: {rows} " in one_line_of_error(result)
    assert f"{rows} wrong_size: mostly " in result.stderr
    table = pq.read_table(flight / "kgcp" / "detections.parquet").to_pydict()
    assert table["reason"].count("wrong_size") == rows
