"""`kgcp detect` on a smooth passage with one frame in haze, predicted by its neighbours."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import image_plate
from tests.flight_toml import REPLICA_OF_A, RING_A, camera_table

CAMERA = Camera(480, 360, 900.0, 904.0, 236.3, 184.2)
HAZY, FRAMES = 4, 9
FLIGHT = camera_table(CAMERA) + RING_A + REPLICA_OF_A


def pose_of(number: int) -> Pose:
    """Some 20 px and 0.3 m farther with every frame, with a slight bend."""
    x, y = -2.6 + 0.6 * number, -1.0 + 0.2 * number + 0.01 * number**2
    return Pose(np.eye(3), np.array([x, y, 27.0 + 0.3 * number]))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("haze")
    (folder / "frames").mkdir()
    (folder / "flight.toml").write_text(FLIGHT, encoding="utf-8")
    rng = np.random.default_rng(9)
    lines = ["frame,time"]
    for number in range(FRAMES):
        irradiance = np.full((CAMERA.height, CAMERA.width), 0.3)
        image_plate(CAMERA, TARGET_PLATE, pose_of(number), Optics(0.7)).paste(irradiance)
        grey = Sensor().expose(irradiance, 0.9, rng)
        if number == HAZY:
            grey = np.rint(120.0 + 0.05 * (grey.astype(np.float64) - 120.0)).astype(np.uint8)
        assert cv2.imwrite(str(folder / "frames" / f"f_{number}.png"), grey)
        lines.append(f"f_{number}.png,2026-06-16T08:15:{number:02d}Z")
    (folder / "frames.csv").write_text("\n".join(lines), encoding="utf-8")
    return folder


def detect(flight: Path, out: Path, *options: str) -> Result:
    arguments = ["detect", str(flight), "--out", str(out), "--jobs", "0", "--json", *options]
    return CliRunner().invoke(main, arguments, catch_exceptions=False)


def test_neighbouring_frames_lead_to_a_target_in_haze(flight: Path, tmp_path: Path) -> None:
    result = detect(flight, tmp_path, "--overlay", str(tmp_path / "sheet"), "--all-candidates")
    assert json.loads(result.stdout)["guided"] == 1
    assert "1 of them measured in the second pass" in result.stderr
    rows = pd.read_parquet(tmp_path / "detections.parquet").set_index("frame")
    assert rows["status"].eq("measured").all()
    assert rows.index[rows["guided"]].to_list() == [f"f_{HAZY}.png"]
    truth = pose_of(HAZY)
    seen = rows.loc[f"f_{HAZY}.png"]
    assert np.hypot(*(seen[["x_px", "y_px"]] - CAMERA.project(truth.translation_m))) < 0.1
    assert seen["distance_m"] == pytest.approx(truth.distance_m, rel=5e-3)
    page = (tmp_path / "sheet" / "index.html").read_text(encoding="utf-8")
    assert "second look" in page
    assert page.count('class="measured"') == FRAMES


def test_without_the_second_look_the_hazy_target_is_a_miss_with_a_reason(
    flight: Path, tmp_path: Path
) -> None:
    result = detect(flight, tmp_path, "--no-guided")
    assert json.loads(result.stdout)["guided"] == 0
    rows = pd.read_parquet(tmp_path / "detections.parquet").set_index("frame")
    assert rows.index[rows["status"] != "measured"].to_list() == [f"f_{HAZY}.png"]
    assert rows.loc[f"f_{HAZY}.png", "reason"] == "no_candidate"
    assert not rows["guided"].any()


def test_an_extremely_small_false_alarm_limit_rejects_every_target(
    flight: Path, tmp_path: Path
) -> None:
    detect(flight, tmp_path, "--false-alarm", "1e-60")
    rows = pd.read_parquet(tmp_path / "detections.parquet")
    assert (rows["status"] != "measured").all()
    assert rows["detail"].str.contains("occurs by chance").sum() == FRAMES - 1


def test_an_impossible_false_alarm_limit_is_refused_in_one_line(
    flight: Path, tmp_path: Path
) -> None:
    result = detect(flight, tmp_path, "--false-alarm", "0")
    assert result.exit_code == 1
    assert "--false-alarm: 0 is out of range; give a value above 0 and at most 1" in result.stderr


def test_the_smallest_radius_reaches_the_search(flight: Path, tmp_path: Path) -> None:
    detect(flight, tmp_path, "--min-radius", "40", "--no-guided")
    rows = pd.read_parquet(tmp_path / "detections.parquet")
    assert (rows["status"] != "measured").all()
