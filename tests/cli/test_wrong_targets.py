"""Runs that measure nothing report the cause: another or mirrored code, black and white swapped."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import pandas as pd
import pytest

from tests.cli.conftest import FRAMES, SAMPLE, SampleFlight

FAST = ("--jobs", "0", "--json")
SEEN = FRAMES[:3]  # that show the target


@pytest.fixture
def flight(unmeasured: SampleFlight) -> SampleFlight:
    for name in FRAMES[3:]:
        (unmeasured.path / "frames" / name).unlink()
    return unmeasured


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("[0, 50, 78, 180]", "dots at 0, 43, 78, 180 deg, flight.toml has 0, 50, 78, 180 for A"),
        ("[0, 43, 180]", "dots at 0, 43, 78, 180 deg, flight.toml has 0, 43, 180 for A"),
        ("[0, 180, 282, 317]", "0, 180, 282, 317 for A: these are its mirror image"),
    ],
)
def test_a_wrong_code_is_reported_with_the_dots_that_were_read(
    flight: SampleFlight, code: str, words: str
) -> None:
    flight.edit(("[0, 43, 78, 180]", code))
    sheet = flight.path / "sheet"
    result = flight.run("detect", *FAST, "--overlay", str(sheet))
    assert result.exit_code == 1
    line = result.stderr.splitlines()[-1]
    assert line.startswith("kgcp: error: no target was measured in any of 3 frames: 3 other_code (")
    assert words in line
    assert line.endswith("; correct code_deg in flight.toml, or clean the dots")
    assert "3 other_code: mostly dots at " in result.stderr
    numbers = json.loads(result.stdout)
    assert words in numbers["details"]["other_code"]
    table = pd.read_parquet(flight.out / "detections.parquet")
    assert table["detail"].str.contains(words, regex=False).all()
    assert words in (sheet / "index.html").read_text(encoding="utf-8")
    assert len([*(sheet / "pictures").iterdir()]) == len(SEEN)


def test_negatives_are_recognised(flight: SampleFlight) -> None:
    for name in SEEN:
        path = flight.path / "frames" / name
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        assert cv2.imwrite(str(path), 255 - grey, [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert "black and white are swapped in the frames or on the plate; " in (
        flight.fails("detect", "--jobs", "0")
    )


def test_a_target_outside_the_frame_is_out_of_view(measured_sample: SampleFlight) -> None:
    table = pd.read_parquet(measured_sample.out / "detections.parquet").set_index("frame")
    row = table.loc["frame_0011.jpg"]
    assert (row["status"], row["reason"]) == ("not_found", "out_of_view")
    assert row["detail"].startswith("expected by ")
    assert row["detail"].endswith(", outside the frame")
    assert (table["status"] == "measured").sum() == len(FRAMES) - 1


def test_a_quiet_run_without_a_measurement_reports_it_too(
    flight: SampleFlight, tmp_path: Path
) -> None:
    result = flight.run("detect", "--jobs", "0", "--quiet", "--min-radius", "200")
    assert result.exit_code == 1
    assert result.stderr.startswith("kgcp: error: no target was measured in any of 3 frames: ")
    assert not (tmp_path / "kgcp").exists()


def test_a_print_that_is_not_as_stated_is_reported_with_the_measurements(
    unmeasured: SampleFlight,
) -> None:
    """Distances are a result in themselves: nobody need export points to learn that they err."""
    for number in (1, 3, 4, 5):
        shutil.copy(SAMPLE / "frames" / f"frame_{number:04d}.jpg", unmeasured.path / "frames")
    unmeasured.edit(("code_diameter_m = 0.6428571428571429", "code_diameter_m = 0.6493"))
    result = unmeasured.run("detect", *FAST)
    last = json.loads(result.stdout)["doubts"][-1]
    assert last["code"] == "diameters"
    assert re.search(r"the dots of 'A' are (0\.[89]|1\.0)\d* ± 0\.\d+ % too far in", result.stderr)
