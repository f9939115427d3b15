"""Discs and rings on the ground, from rendered frames to ground control points and places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from kgcp.cli import main
from kgcp.geometry.arrays import FloatArray
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import read_table
from tests.plain_flight import CAMERA, CODED, TARGETS, PlainFlight

FLIGHT = PlainFlight()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = FLIGHT.write(tmp_path_factory.mktemp("plain"))
    run("detect", folder, "--jobs", "0", "--overlay", str(folder / "sheet"))
    return folder


def run(command: str, folder: Path, *options: str, exit_code: int = 0) -> str:
    result = CliRunner().invoke(main, [command, str(folder), *options], catch_exceptions=False)
    assert result.exit_code == exit_code, result.output
    return result.output


def detections(folder: Path) -> pd.DataFrame:
    return read_table(folder / "kgcp" / "detections.parquet", DETECTION_COLUMNS)


def assert_at(rows: pd.DataFrame, centres_m: FloatArray) -> None:
    """The rows of a frame agree with the targets' true centres, within their deviations."""
    for target, centre_m in zip(TARGETS, centres_m, strict=True):
        row = rows.loc[target.name]
        x, y = CAMERA.project(centre_m[None])[0]
        assert abs(row["x_px"] - x) < 4.0 * row["sd_x_px"] < 0.04
        assert abs(row["y_px"] - y) < 4.0 * row["sd_y_px"] < 0.04
        off_m = row["distance_m"] - float(np.linalg.norm(centre_m))
        assert abs(off_m) < 4.0 * row["sd_distance_m"] < 0.1
        assert np.isnan(row["score"])


def test_every_target_is_measured_at_its_true_centre(folder: Path) -> None:
    table = detections(folder)
    assert list(table["status"]) == ["measured"] * FLIGHT.frames * len(TARGETS)
    for frame in range(FLIGHT.frames):
        rows = table[table["frame"] == f"f_{frame}.png"].set_index("target")
        assert_at(rows, FLIGHT.centres_m(frame))


def test_they_become_ground_control_points(folder: Path) -> None:
    run("export-gcp", folder, "--format", "csv", "--format", "metashape")
    points = pd.read_csv(folder / "kgcp" / "kgcps.csv")
    assert len(points) == FLIGHT.frames * len(TARGETS)


def test_frames_are_oriented_by_them(folder: Path) -> None:
    assert "3 of 3 frames oriented" in run("orient", folder)


def test_they_are_placed_and_their_diameters_checked(folder: Path) -> None:
    text = run("place", folder)
    assert text.count("as flight.toml says") == len(TARGETS)


def test_other_commands_know_them(folder: Path) -> None:
    assert "0.8 m, bright disc (static)" in run("check", folder)
    assert "over 9 frames" in run("bias-report", folder)


def test_without_poses_nothing_is_looked_for(folder: Path, tmp_path: Path) -> None:
    text = (folder / "flight.toml").read_text(encoding="utf-8")
    (tmp_path / "frames").symlink_to(folder / "frames")
    bare = text.replace('[reference]\nposes = "reference.csv"\n', "")
    (tmp_path / "flight.toml").write_text(bare, encoding="utf-8")
    assert "9 no_prediction: give [reference] poses" in run(
        "detect", tmp_path, "--jobs", "0", exit_code=1
    )
    assert set(detections(tmp_path)["reason"]) == {"no_prediction"}


def test_coded_targets_of_the_frame_tell_where_they_are(tmp_path: Path) -> None:
    made = PlainFlight(frames=1, coded=CODED)
    made.write(tmp_path)
    (tmp_path / "reference.csv").unlink()
    run("detect", tmp_path, "--jobs", "0")
    table = detections(tmp_path)
    assert set(table["status"]) == {"measured"}
    rows = table.set_index("target")
    assert rows["guided"].sum() == len(TARGETS)
    assert_at(rows, made.centres_m(0))
