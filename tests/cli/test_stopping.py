"""`kgcp detect` stopped by a signal, and what it says as it works."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from tests.flight_toml import RING_A
from tests.systems import not_on_windows

FRAMES, FEW = 100, 4
TELLING_ALL = """\
from kgcp.cli import detect_log, main
detect_log._JSON_PROGRESS_S = 0.0
main(prog_name="kgcp")
"""
FLIGHT = f"""\
[camera]
width = 640
height = 480
fx = 800.0
fy = 800.0
cx = 320.0
cy = 240.0
{RING_A}"""


def rough_ground(folder: Path, frames: int) -> Path:
    (folder / "frames").mkdir()
    (folder / "flight.toml").write_text(FLIGHT, encoding="utf-8")
    rng = np.random.default_rng(3)
    kinds = []
    for blur_px in (1.0, 2.0, 3.0):
        noise = cv2.GaussianBlur(rng.uniform(0, 255, (480, 640)), (0, 0), blur_px)
        is_written, coded = cv2.imencode(".jpg", noise.astype(np.uint8))
        assert is_written
        kinds.append(coded.tobytes())
    for number in range(frames):
        (folder / "frames" / f"{number:03d}.jpg").write_bytes(kinds[number % len(kinds)])
    return folder


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Many frames, so that a run can be stopped in their midst."""
    return rough_ground(tmp_path_factory.mktemp("stopping"), FRAMES)


@pytest.fixture(scope="module")
def short_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rough_ground(tmp_path_factory.mktemp("short"), FEW)


def run(flight: Path, out: Path, *options: str) -> Result:
    arguments = ["detect", str(flight), "--out", str(out), "--jobs", "0", *options]
    return CliRunner().invoke(main, arguments, catch_exceptions=False)


@not_on_windows("sends processes no signals")
@pytest.mark.usefixtures("sigint_raises")
@pytest.mark.parametrize(
    ("number", "code", "jobs"), [(signal.SIGINT, 130, "2"), (signal.SIGTERM, 143, "0")]
)
def test_a_signal_stops_the_run_and_the_same_command_goes_on(
    number: signal.Signals, code: int, jobs: str, flight: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "-c", TELLING_ALL, "detect", str(flight), "--out", str(tmp_path)]
    with subprocess.Popen(
        [*command, "--jobs", jobs, "--log-json"], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if json.loads(line).get("done", 0) >= 1:
                break
        process.send_signal(number)
        lines += process.stderr
        assert process.wait() == code
    events = [json.loads(line) for line in lines]
    assert {event["event"] for event in events[:-1]} == {"progress"}
    assert (events[-1]["event"], events[-1]["total"]) == ("stopped", FRAMES)
    done = events[-1]["done"]
    assert 1 <= done < FRAMES
    result = run(flight, tmp_path)
    assert result.exit_code == 1, "there is no target to measure"
    kept = re.search(rf"results of (\d+) of {FRAMES} frames are kept, 0 have", result.stderr)
    assert kept is not None
    # a signal may come when a result is kept and not counted yet
    assert done <= int(kept[1]) <= done + 1
    assert f"{FRAMES} frames in" in result.stderr


@not_on_windows("sends processes no signals")
@pytest.mark.usefixtures("sigint_raises")
@pytest.mark.parametrize("jobs", ["0", "2"])
def test_a_run_started_with_sigint_ignored_stops_at_sigterm_alone(
    jobs: str, flight: Path, tmp_path: Path
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for `kgcp detect &`
    command = [sys.executable, "-c", TELLING_ALL, "detect", str(flight), "--out", str(tmp_path)]
    with subprocess.Popen(
        [*command, "--jobs", jobs, "--log-json"], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        progress = (json.loads(line)["done"] for line in process.stderr)
        for number in (signal.SIGINT, signal.SIGTERM):
            assert any(done >= 1 for done in progress)  # it goes on after the first one
            process.send_signal(number)
        rest = process.stderr.read()
        assert process.wait() == 143
    assert json.loads(rest.splitlines()[-1])["event"] == "stopped"


def test_what_is_said_can_be_chosen(short_flight: Path, tmp_path: Path) -> None:
    quiet = run(short_flight, tmp_path / "a", "--quiet")
    assert quiet.exit_code == 1
    assert quiet.output.startswith("kgcp: error: no target was measured in any of 4 frames: ")
    assert quiet.output.count("\n") == 1
    told = run(short_flight, tmp_path / "b", "--log-json", "--restart", "--json", "--profile")
    events = [json.loads(line) for line in told.stderr.splitlines()[:-1]]
    assert [event["event"] for event in events[-3:]] == ["progress", "summary", "stages"]
    assert events[-1]["stages_s"]["in all"] > events[-1]["stages_s"]["first look"] > 0.0
    assert events[-2]["reasons"] == json.loads(told.stdout)["reasons"]
    profiled = run(short_flight, tmp_path / "c", "--profile")
    for stage in ("first look", "table", "workers: io.images.frames.read_grey"):
        assert f" s  {stage}\n" in profiled.stderr
    tables = {(tmp_path / name / "detections.parquet").read_bytes() for name in "abc"}
    assert len(tables) == 1


def test_the_run_is_recorded_beside_the_table(short_flight: Path, tmp_path: Path) -> None:
    run(short_flight, tmp_path, "--min-radius", "8")
    record = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert record["frames"] == sum(record["status"].values()) == FEW
    assert record["settings"]["min_radius_px"] == 8.0
    assert record["versions"].keys() >= {"kgcp", "python", "numpy", "opencv"}
    assert record["host"]["cores"] >= 1
    if os.name != "nt":  # which does not say
        assert 50.0 < record["peak_memory_mb"]["parent"] < 5000.0
    assert record["stages_s"]["first look"] > 0.0
