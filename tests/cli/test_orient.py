"""`kgcp orient` on a flight over four static targets, made here, and what follows from it."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from benchmarks.ground.orient import DEVICE_M
from kgcp.cli import main
from kgcp.cli.orient import what_to_check
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.flight.field_file import field_toml
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.detections import DETECTION_COLUMNS, read_detections
from kgcp.io.tables.parquet import write_table
from kgcp.network.ground.position_check import FastCamera
from kgcp.network.ground.target_moves import MovedTarget
from kgcp.pipeline.calibration.simulation import FieldSimulation
from kgcp.pipeline.flight_inputs import outdated_poses
from kgcp.pipeline.ground.orient import FlightPoses
from kgcp.quality.checks.doubt import Cause
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, photograph
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.presets import preset
from kgcp.targets.fields.layout import Field, GridKind, Mark
from tests.ground_flight import CAMERA as TRUE_CAMERA
from tests.ground_flight import GroundFlight

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")


def run(command: str, *arguments: object) -> Result:
    return CliRunner().invoke(main, [command, *map(str, arguments)], catch_exceptions=False)


def write_rows(path: Path, table: pd.DataFrame) -> None:
    records = table.astype(object).where(table.notna(), None).to_dict("records")
    rows = ({str(name): cell for name, cell in record.items()} for record in records)
    write_table(path, DETECTION_COLUMNS, rows, {})


def keep_only(folder: Path, frame: str, target: str) -> None:
    """Let a frame have one target alone."""
    path = folder / "kgcp" / "detections.parquet"
    table = read_detections(path)
    kept = table[(table["frame"] != frame) | (table["target"] == target)]
    write_rows(path, kept)


@pytest.mark.usefixtures("no_place_figures")
def test_frames_are_oriented_and_their_poses_place_targets(tmp_path: Path) -> None:
    flight = GroundFlight(frames=8)
    folder = flight.write(tmp_path / "flight", sd_position_m=0.002)
    keep_only(folder, "f_004.png", "C")
    result = run("orient", folder, "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["oriented"] == 8
    assert summary["by_one_ring"] == 1
    poses = pd.read_parquet(folder / "kgcp" / "poses.parquet").set_index("frame")
    off = poses[["x", "y", "z"]].to_numpy() - flight.local_frame.map_from_enu(flight.centres)
    sds = poses[["sd_x", "sd_y", "sd_z"]].to_numpy()
    assert poses.loc["f_004.png", "method"] == "ring"
    assert sds[4].max() > 1.2 * np.delete(sds, 4, axis=0).max()
    # the places of the targets are exact here: their deviations are not used up
    assert 0.05 < float(np.sqrt(np.mean((off / sds) ** 2))) < 1.3
    assert np.abs(np.delete(off, 4, axis=0)).max() < 0.03
    placed = run("place", folder, "--poses", folder / "kgcp" / "poses.csv", "--json")
    assert placed.exit_code == 0, placed.stderr
    for target in json.loads(placed.stdout)["targets"]:
        assert np.abs(target["residual_m"]).max() < 0.02
        assert (np.abs(target["residual_m"]) < 3.0 * np.array(target["sd_residual_m"])).all()
        assert abs(target["diameter_residual_permille"]) < 1.0


@pytest.mark.usefixtures("no_place_figures")
def test_a_target_is_placed_as_accurately_as_those_that_orient_the_frames(tmp_path: Path) -> None:
    """A pose's errors of position and rotation nearly cancel where the targets are."""
    corners = GroundFlight().offsets_m
    flight = GroundFlight(tuple("ABCDE"), np.vstack((corners, [1.0, 0.5, 0.1])), frames=6)
    folder = flight.write(tmp_path / "flight")
    rough = np.array([[0.0] * 3] * 4 + [[0.3, -0.2, 0.3]])
    misplace(folder, flight, rough + np.random.default_rng(2).normal(0.0, 0.01, (5, 3)))
    toml = folder / "flight.toml"
    others, last = toml.read_text("utf-8").rsplit("sd_position_m", 1)
    last = last.replace("[0.01, 0.01, 0.01]", "[0.5, 0.5, 0.5]")
    toml.write_text(f"{others}sd_position_m{last}", encoding="utf-8")
    assert run("orient", folder).exit_code == 0
    poses = pd.read_csv(folder / "kgcp" / "poses.csv")
    assert poses["sd_x"].min() > 0.03
    placed = run("place", folder, "--poses", folder / "kgcp" / "poses.csv", "--json")
    summary = json.loads(placed.stdout)
    assert summary["doubts"] == []
    for each in summary["targets"]:
        assert abs(each["diameter_m"] - 0.9) < 3.0 * each["sd_diameter_m"] < 4.5e-3
        # wrong heights tilt all frames alike: more frames do not show the normals better
        assert each["tilt_deg"] < 3.0 * each["sd_normal_deg"]
        assert 0.08 < each["sd_normal_deg"] < 0.15
    target = summary["targets"][4]
    off_m = np.array(target["position"]) - flight.positions_map[4]
    assert target["target"] == "E"
    assert (np.array(target["sd_position_m"]) < [0.007, 0.007, 0.02]).all()
    assert (np.abs(off_m) < 3.0 * np.array(target["sd_position_m"])).all()


def poses_of(folder: Path, flight: GroundFlight) -> tuple[np.ndarray, np.ndarray]:
    """Errors and standard deviations (n, 3) of the frames' places [m]."""
    poses = pd.read_parquet(folder / "kgcp" / "poses.parquet")
    off = poses[["x", "y", "z"]].to_numpy() - flight.local_frame.map_from_enu(flight.centres)
    return off, poses[["sd_x", "sd_y", "sd_z"]].to_numpy()


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize(
    ("stated_m", "words"), [(0.9, ""), (0.899, "1.1 ‰"), (0.897, "3.4 ‰"), (0.906, "6.6 ‰")]
)
def test_a_common_error_of_all_diameters_displaces_no_pose(
    tmp_path: Path, stated_m: float, words: str
) -> None:
    """The accuracy of these prints is not stated: 'place' measures it with such poses."""
    flight = GroundFlight(stated_diameter_m=stated_m, frames=6)
    folder = flight.write(tmp_path / "flight", sd_position_m=0.002)
    result = run("orient", folder, "--json")
    assert result.exit_code == 0, result.stderr
    off, sds = poses_of(folder, flight)
    assert 0.3 < float(np.sqrt(np.mean((off / sds) ** 2))) < 1.2
    assert np.abs(off[:, 2]).max() < 0.015
    doubts = json.loads(result.stdout)["doubts"]
    assert len(doubts) == bool(words)
    assert (f"the distances are {words}" in result.stderr) == bool(words)
    placed = run("place", folder, "--poses", folder / "kgcp" / "poses.csv", "--json")
    for target in json.loads(placed.stdout)["targets"]:
        assert abs(target["diameter_m"] - 0.9) < 3.0 * target["sd_diameter_m"] < 0.003


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (replace(TRUE_CAMERA, cx=823.2), r"\(they fit cx = 803\.\d+ ± 0\.\d+ instead of 823\.2"),
        (replace(TRUE_CAMERA, k1=0.0), r"k1 = -0\.05\d* ± 0\.00\d+ instead of 0\)"),
        (replace(TRUE_CAMERA, fx=2335.0, fy=2335.0), r"fx = 2299\.\d ± \d\.\d instead of 2335"),
    ],
)
def test_the_calibration_of_another_camera_is_reported(
    tmp_path: Path, camera: Camera, words: str
) -> None:
    """Frame by frame, poses take up its error: they were off by 0.3 m, without a word."""
    flight = GroundFlight(stated_camera=camera)
    folder = flight.write(tmp_path / "flight")
    result = run("orient", folder)
    assert result.exit_code == 0, result.stderr
    off = np.linalg.norm(poses_of(folder, flight)[0], axis=1)
    (doubt,) = re.findall(f"contradict the camera's calibration .*{words}.*", result.stderr)
    said_m = float(re.findall(r"off by about ([\d.]+) m", doubt)[0])
    assert said_m == pytest.approx(np.median(off), rel=0.3)


def test_exchanged_names_are_among_the_reasons(tmp_path: Path) -> None:
    exchanged = {(0, "A"): "B", (0, "B"): "A"}
    result = run("orient", GroundFlight(frames=1, renamed=exchanged).write(tmp_path / "flight"))
    assert result.exit_code == 1
    assert "no pose explains three of the points; look at their names" in result.stderr


def misplace(folder: Path, flight: GroundFlight, off_m: FloatArray) -> None:
    """State positions that are off by so much (n, 3)."""
    toml = folder / "flight.toml"
    text = toml.read_text("utf-8")
    for true, wrong in zip(flight.positions_map, flight.positions_map + off_m, strict=True):
        assert str(true.tolist()) in text
        text = text.replace(str(true.tolist()), str(wrong.tolist()))
    toml.write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    ("sd_position_m", "off_m", "frames", "words"),
    [
        (0.01, 0.1, 6, "contradict each other: that of"),
        (0.002, 0.1, 12, "contradict each other: that of B is off by 0.1"),
        (0.01, 0.2, 4, "that of"),
        (0.002, 0.5, 6, "B left out in 6 of 6"),
    ],
)
def test_a_wrong_height_is_reported(
    tmp_path: Path, sd_position_m: float, off_m: float, frames: int, words: str
) -> None:
    """Of four targets nearly in a plane: the poses take up most of it, frame by frame."""
    flight = GroundFlight(frames=frames)
    folder = flight.write(tmp_path / "flight", sd_position_m=sd_position_m)
    misplace(folder, flight, np.array([[0, 0, 0], [0, 0, off_m], [0, 0, 0], [0, 0, 0]]))
    result = run("orient", folder, "--json")
    if result.exit_code:
        assert f"no frame can be oriented; of {frames} frames" in result.stderr
        return
    assert words in result.stderr
    if "contradict" in words:
        (doubt,) = json.loads(result.stdout)["doubts"]
        assert "B" in doubt
        assert "or a diameter is wrong" in doubt


@pytest.mark.parametrize("seed", range(6))
def test_positions_as_good_as_stated_contradict_nothing(tmp_path: Path, seed: int) -> None:
    flight, rng = GroundFlight(seed=seed, frames=4), np.random.default_rng(seed)
    folder = flight.write(tmp_path / "flight", sd_position_m=0.01)
    misplace(folder, flight, 0.01 * rng.standard_normal((4, 3)))
    result = run("orient", folder, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["doubts"] == []
    off, sds = poses_of(folder, flight)
    assert 0.2 < float(np.sqrt(np.mean((off / sds) ** 2))) < 1.7


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize("is_copied", [False, True])
def test_poses_from_before_a_change_of_flight_toml_are_doubted(
    tmp_path: Path, *, is_copied: bool
) -> None:
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    toml = folder / "flight.toml"
    written = toml.read_text("utf-8")
    assert run("orient", folder).exit_code == 0
    poses = folder / "kgcp" / "poses.csv"
    poses = Path(shutil.copy(poses, folder / "by_targets.csv")) if is_copied else poses
    flight = read_flight(folder)
    assert not outdated_poses(poses, flight)
    assert not outdated_poses(folder / "reference.csv", flight)
    accuracy = written.replace("fx = ", "sd_fx = 0.5\nsd_fy = 0.5\nfx = ")
    toml.write_text(accuracy, encoding="utf-8")
    assert not outdated_poses(poses, read_flight(folder))  # poses do not depend on it
    toml.write_text(written.replace("5336205.0, 545.5", "5336205.0, 545.6"), encoding="utf-8")
    (moved,) = outdated_poses(poses, read_flight(folder))
    assert (moved.code, moved.is_grave) == (Cause.REFERENCE, False)
    assert "[[target]] B position_m ([689416, 5336205, 545.5] → [" in moved.sentence
    toml.write_text(written.replace("fx = 2300.0", "fx = 2320.0"), encoding="utf-8")
    (camera,) = outdated_poses(poses, read_flight(folder))
    assert camera.is_grave
    assert camera.sentence.endswith("flight.toml was changed: [camera] fx (2300 → 2320)")
    # the detections, written here, do not state their camera
    placed = run("place", folder, "--poses", poses, "--json")
    assert json.loads(placed.stdout)["doubts"][0] == str(camera)
    toml.write_text(
        toml.read_text("utf-8").replace('"reference.csv"', f'"{poses.as_posix()}"'),
        encoding="utf-8",
    )
    assert str(camera) in run("export-gcp", folder).stderr


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize("frames", [None, "f_00[01].png"])
def test_poses_of_another_flight_with_the_same_names_are_doubted(
    tmp_path: Path, frames: str | None
) -> None:
    """They would keep static targets, which seem to have given them, from being compared."""
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    assert run("orient", folder, *(() if frames is None else ("--frames", frames))).exit_code == 0
    other = GroundFlight(frames=3, seed=2).write(tmp_path / "other")
    poses = folder / "kgcp" / "poses.csv"
    assert not outdated_poses(poses, read_flight(folder))
    for frame in (other / "frames").iterdir():
        cv2.imwrite(str(frame), np.full((5, 5), 7, np.uint8))
    (folder / "frames" / "f_002.png").unlink()  # frames that are gone do not matter
    assert not outdated_poses(poses, read_flight(folder))
    doubts = outdated_poses(poses, read_flight(other))
    if frames is not None:  # it is not known which sizes are those of the chosen frames
        assert not doubts
        return
    (doubt,) = doubts
    assert (doubt.code, doubt.is_grave) == (Cause.REFERENCE, True)
    assert "from other files than 3 frames of this flight (f_000.png, …)" in doubt.sentence


def test_positions_without_stated_accuracy_are_named(tmp_path: Path) -> None:
    """Their errors are not part of the poses' standard deviations."""
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    assert "doubt" not in run("orient", folder).stderr
    path = folder / "flight.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("sd_position_m", "# sd_position_m"), encoding="utf-8")
    result = run("orient", folder, "--json")
    (doubt,) = json.loads(result.stdout)["doubts"]
    assert doubt.startswith("sd_position_m is not stated for A, B, C and 1 more: ")
    assert doubt in result.stderr


def test_a_target_with_another_diameter_than_stated_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flat ground from above, far away: the pose depends on the distances."""
    monkeypatch.setattr("tests.ground_flight.OUTLINE_PX", 0.02)
    offsets_m = np.array([[-1.8, 1.8, 0.0], [1.8, 0.6, 0.0], [0.0, -2.8, 0.0], [-2.6, -1.6, 0.0]])
    flight, rng = GroundFlight(offsets_m=offsets_m, frames=6), np.random.default_rng(1)
    for frame in range(flight.frames):
        flight.centres[frame] = [*rng.uniform(-1.0, 1.0, 2), 60.0]
        z = np.append(rng.uniform(-0.15, 0.15, 2), -1.0)
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 1.0, 0.2])
        x /= np.linalg.norm(x)
        flight.rotations[frame] = np.column_stack((x, np.cross(z, x), z))
        flight.wrong[frame, "D"] = -0.05 * flight.pose(frame, 3).translation_m
    result = run("orient", flight.write(tmp_path / "flight", sd_position_m=0.002))
    assert "1 the distance of D contradicts the others; look at the diameter" in result.stderr
    assert "D left out in " in result.stderr


def test_a_failure_to_orient_most_frames_is_reported(tmp_path: Path) -> None:
    exchanged = {
        (frame, name): other for frame in range(4) for name, other in (("A", "B"), ("B", "A"))
    }
    flight = GroundFlight(renamed=exchanged, frames=6)
    folder = flight.write(tmp_path / "flight")
    result = run("orient", folder)
    assert result.exit_code == 0, result.stderr
    assert "only 2 of 6 frames with 4 targets or more could be oriented" in result.stderr
    off, sds = poses_of(folder, flight)
    assert np.isfinite(off).all(axis=1).sum() == 2
    assert np.nanmax(np.abs(off / sds)) < 3.0


@pytest.mark.parametrize("options", [(), ("--free-focal",)])
@pytest.mark.parametrize("pair", ["AB", "AC"])
def test_frames_with_two_of_four_names_exchanged_are_not_oriented(
    tmp_path: Path, pair: str, options: tuple[str, ...]
) -> None:
    """These frames are refused, because four names do not show which two of them are right."""
    one, other = tuple(pair)
    renamed = {(frame, a): b for frame in (0, 3) for a, b in ((one, other), (other, one))}
    flight = GroundFlight(renamed=renamed, frames=5)
    folder = flight.write(tmp_path / "flight")
    result = run("orient", folder, *options)
    assert result.exit_code == 0, result.stderr
    assert "3 of 5 frames oriented" in result.stderr
    off, sds = poses_of(folder, flight)
    assert np.isnan(off[[0, 3]]).all()
    assert 0.1 < np.nanmax(np.abs(off / sds)) < 3.0


def test_distances_that_contradict_the_estimated_focal_length_are_reported(tmp_path: Path) -> None:
    """Positions and images determine the focal length; half the diameter contradicts them."""
    flight = GroundFlight(stated_diameter_m=0.45, frames=4)
    folder = flight.write(tmp_path / "flight", sd_position_m=0.002)
    result = run("orient", folder, "--free-focal")
    assert result.exit_code == 1
    assert "the distances are 50 % shorter than the positions say" in result.stderr


def vouch(folder: Path, sd_diameter_m: float) -> None:
    """State how well all rings are printed, after they were measured."""
    toml = folder / "flight.toml"
    words = f"\nsd_outer_diameter_m = {sd_diameter_m}\nposition_m"
    toml.write_text(toml.read_text("utf-8").replace("\nposition_m", words), encoding="utf-8")


def test_a_diameter_accuracy_added_after_detection_is_used(tmp_path: Path) -> None:
    flight = GroundFlight(stated_diameter_m=0.897, frames=6)
    folder = flight.write(tmp_path / "flight")
    vouch(folder, 0.003)
    assert run("orient", folder).exit_code == 0
    off, sds = poses_of(folder, flight)
    assert 0.2 < float(np.sqrt(np.mean((off[:, 2] / sds[:, 2]) ** 2))) < 1.5


def test_contradictions_of_accurate_diameters_are_reported_in_permille(tmp_path: Path) -> None:
    flight = GroundFlight(stated_diameter_m=0.897, frames=3)
    folder = flight.write(tmp_path / "flight", sd_position_m=0.002)
    vouch(folder, 0.0001)
    result = run("orient", folder)
    assert result.exit_code == 1
    assert "the distances are 3 ‰ shorter than the positions say" in result.stderr


def test_accurate_diameters_determine_the_distance_of_a_frame(tmp_path: Path) -> None:
    flight, found = GroundFlight(frames=4), []
    for name in ("open", "stated"):
        folder = flight.write(tmp_path / name, sd_position_m=0.002)
        if name == "stated":
            vouch(folder, 0.0001)
        assert run("orient", folder).exit_code == 0
        found.append(float(np.median(poses_of(folder, flight)[1][:, 2])))
    assert found[1] < 0.7 * found[0]


def test_radii_entered_as_diameters_are_reported(tmp_path: Path) -> None:
    folder = GroundFlight(stated_diameter_m=0.45, frames=3).write(tmp_path / "flight")
    result = run("orient", folder)
    assert result.exit_code == 1
    assert "the distances are 50 % shorter than the positions say; look at the targets'" in (
        result.stderr
    )
    assert result.stderr.count("\n") == 1


def test_a_target_with_a_wrong_name_is_left_out(tmp_path: Path) -> None:
    wrong = {(2, "B"): np.array([0.5, 0.3, 0.0])}
    folder = GroundFlight(wrong=wrong).write(tmp_path / "flight")
    result = run("orient", folder, "--frames", "f_00[1-3].png", "--min-points", "3", "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["rejected_targets"] == {"f_002.png": ["B"]}
    assert "B left out in f_002.png" in result.stderr
    table = pd.read_parquet(folder / "kgcp" / "pose_residuals.parquet")
    assert sorted(set(table["frame"])) == ["f_001.png", "f_002.png", "f_003.png"]
    assert list(zip(table["frame"], table["target"], strict=True)) == [
        (frame, name) for frame in sorted(set(table["frame"])) for name in "ABCD"
    ]
    left_out = table[~table["used"]]
    assert list(zip(left_out["frame"], left_out["target"], strict=True)) == [("f_002.png", "B")]
    off_px = np.hypot(table["residual_x_px"], table["residual_y_px"])
    assert (off_px[table["used"]] < 0.5).all()
    assert (off_px[~table["used"]] > 5.0).all()
    assert (table["chi2"][table["used"]] < 25.0).all()
    assert (table["chi2"][~table["used"]] > 100.0).all()
    assert (table["residual_distance_percent"][table["used"]].abs() < 0.5).all()


@pytest.mark.parametrize(
    ("suspects", "words"),
    [
        (("B", "C"), "its position is wrong, or that of B"),
        (("C",), "check its position_m"),
        ((), "check its position_m"),
    ],
)
def test_a_left_out_target_is_not_blamed_for_what_another_may_be(
    suspects: tuple[str, ...], words: str
) -> None:
    assert words in what_to_check("C", suspects)


def test_a_misplaced_target_is_reported_once_for_all_frames(tmp_path: Path) -> None:
    wrong = {(frame, "B"): np.array([0.5, 0.3, 0.0]) for frame in range(4)}
    folder = GroundFlight(wrong=wrong, frames=9).write(tmp_path / "flight")
    result = run("orient", folder)
    assert result.exit_code == 0, result.stderr
    message = "B left out in 4 of 9 frames, first in f_000.png\n"
    assert message in result.stderr
    assert result.stderr.count("left out") == 1


def test_a_frame_with_two_exchanged_names_is_not_oriented_by_a_single_ring(tmp_path: Path) -> None:
    folder = GroundFlight(frames=6).write(tmp_path / "flight", sd_position_m=0.002)
    path = folder / "kgcp" / "detections.parquet"
    table = read_detections(path)
    in_frame = table["frame"] == "f_002.png"
    exchanged = table.loc[in_frame, "target"].map({"A": "B", "B": "A", "C": "C", "D": "D"})
    table.loc[in_frame, "target"] = exchanged
    write_rows(path, table)
    result = run("orient", folder, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["oriented"] == 5


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda table: table.iloc[:0], "has no readable frame"),
        (lambda table: pd.concat((table, table)), "has target 'A' of 'f_000.png' twice"),
        (lambda table: table.assign(distance_m=0.0), "distance_m of a measured row is 0.0"),
        (lambda table: table.assign(distance_m=1e-300), "distance_m of a measured row is 1e-300"),
        (lambda table: table.assign(x_px=1e11), "x_px of a measured row is 100000000000.0"),
        (lambda table: table.assign(sd_y_px=0.0), "sd_y_px of a measured row is 0.0"),
        (lambda table: table.assign(sd_distance_m=-1.0), "sd_distance_m of a measured row is -1"),
        (lambda table: table.assign(x_px=1e300), "x_px of a measured row"),
    ],
)
def test_impossible_detections_are_a_one_line_error(
    tmp_path: Path, change: Callable[[pd.DataFrame], pd.DataFrame], problem: str
) -> None:
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    path = folder / "kgcp" / "detections.parquet"
    write_rows(path, change(read_detections(path)))
    result = run("orient", folder)
    assert result.exit_code == 1
    assert problem in result.stderr
    assert result.stderr.count("\n") == 1


def test_an_unknown_focal_length_is_found_where_the_ground_is_not_flat(tmp_path: Path) -> None:
    offsets = np.array([[-4.0, -3.0, 0.0], [4.0, -3.0, 2.5], [4.0, 3.0, -2.0], [-4.0, 3.0, 2.0]])
    folder = GroundFlight(offsets_m=offsets, frames=6).write(
        tmp_path / "flight", sd_position_m=0.001
    )
    wrong = 1900.0 / 2300.0  # distances are measured with the focal length of flight.toml
    toml = folder / "flight.toml"
    text = toml.read_text(encoding="utf-8").replace("2300.0", "1900.0")
    toml.write_text(text.replace("-0.05", str(-0.05 * wrong**2)), encoding="utf-8")
    path = folder / "kgcp" / "detections.parquet"
    table = read_detections(path)
    for column in ("distance_m", "sd_distance_m", "tx_m", "ty_m", "tz_m"):
        table[column] *= wrong
    write_rows(path, table)
    result = run("orient", folder, "--free-focal", "--json")
    assert result.exit_code == 0, result.stderr
    focal = json.loads(result.stdout)["focal_px"]
    assert abs(focal["value"] - 2300.0) < 4.0 * focal["sd"]
    assert focal["sd"] < 20.0


def test_a_lack_of_frames_or_static_targets_is_a_one_line_error(tmp_path: Path) -> None:
    folder = GroundFlight(frames=4).write(tmp_path / "flight")
    result = run("orient", folder, "--frames", "x*")
    assert result.exit_code == 1
    assert "'x*' matches none of 4 frames" in result.stderr
    toml = folder / "flight.toml"
    lines = toml.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if "position_m" not in line]
    toml.write_text("\n".join(kept), encoding="utf-8")
    result = run("orient", folder)
    assert result.exit_code == 1
    assert "no target is static" in result.stderr


def device_flight(folder: Path) -> Path:
    """A device of five dark discs on a bright plate on dark ground, seen once, and its file."""
    camera = Camera(640, 480, 900.0, 900.0, 319.5, 239.5, response=Response.LINEAR)
    pose = Pose(rotation_about(np.array([0.35, -0.2, 0.4])), np.array([-0.12, -0.12, 1.05]))
    discs = tuple(SimulatedDisc((x, y, z), 0.03) for x, y, z in DEVICE_M.tolist())
    scene = FieldScene(
        discs, ground=0.8, ink=0.08, board_m=(-0.06, -0.06, 0.36, 0.28), surround=0.15
    )
    grey = photograph(camera, pose, scene, Optics(0.6), Sensor(), np.random.default_rng(1))
    (folder / "frames").mkdir(parents=True)
    cv2.imwrite(str(folder / "frames" / "one.png"), grey)
    cv2.imwrite(str(folder / "frames" / "two.png"), np.full_like(grey, 90))
    camera_lines = [f"{key} = {getattr(camera, key)!r}" for key in ("width", "height", "cx", "cy")]
    lines = ["[camera]", *camera_lines, "fx = 1000.0", "fy = 1000.0", 'response = "linear"']
    ring = "outer_diameter_m = 0.9\ninner_diameter_m = 0.45\ncode_diameter_m = 0.64"
    lines += ["[[target]]", 'name = "A"', ring, "dot_diameter_m = 0.12", "code_deg = [0, 43, 78]"]
    (folder / "flight.toml").write_text("\n".join(lines), encoding="utf-8")
    points = [
        f'[[point]]\nname = "{name}"\nposition_m = {place}'
        for name, place in zip("abcde", DEVICE_M.tolist(), strict=True)
    ]
    device = folder / "device.toml"
    device.write_text("\n".join(points), encoding="utf-8")
    return device


def test_a_device_orients_a_frame_whatever_the_focal_length(tmp_path: Path) -> None:
    device = device_flight(tmp_path / "flight")
    result = run("orient", tmp_path / "flight", "--device", device, "--free-focal", "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert (summary["frames"], summary["oriented"]) == (2, 1)
    assert list(summary["not_oriented"]) == ["two.png"]
    assert "two.png: not oriented: no closed region with 5 discs" in result.stderr
    table = pd.read_csv(tmp_path / "flight" / "kgcp" / "device_poses.csv")
    assert table["frame"].tolist() == ["one.png"]
    assert table["margin"][0] > 3.0
    assert abs(table["focal_scale"][0] - 0.9) < 0.02
    rotation = rotation_about(np.array([0.35, -0.2, 0.4]))
    centre = -rotation.T @ np.array([-0.12, -0.12, 1.05])
    assert np.abs(table[["x", "y", "z"]].to_numpy()[0] - centre).max() < 0.02


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--device", "device.toml", "--min-points", "5"), "--device takes no --min-points;"),
        (("--field", "grid:5x4:30mm", "--detections", "d"), "--field takes no --detections;"),
        (("--device", "device.toml", "--field", "grid:5x4:30mm"), "--device takes no --field;"),
        (("--unit", "mm"), "--unit applies to --field only;"),
    ],
)
def test_conflicting_options_are_usage_errors(
    tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    result = run("orient", tmp_path, *options)
    assert result.exit_code == 2
    assert message in result.stderr


@pytest.fixture(scope="module")
def rendered_field(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Pose]]:
    """A board in two frames, and one without; its file; the poses, field → camera.

    Tests change copies of it.
    """
    folder = tmp_path_factory.mktemp("field") / "flight"
    camera = Camera(320, 240, 330.0, 330.0, 163.0, 117.5, -0.08, response=Response.LINEAR)
    board = Field(
        "board",
        GridKind.SQUARE,
        columns=5,
        rows=4,
        pitch_m=0.03,
        diameter_m=0.016,
        marks=(Mark(1, 1, 0.016, 0.007),),
        flat_sd_m=(1e-5, 1e-5, 3e-5),
    )
    simulation = FieldSimulation(board, replace(preset("clean"), camera=camera, frames=2), 4)
    (folder / "frames").mkdir(parents=True)
    poses = [simulation.take(folder / "frames", number) for number in range(2)]
    cv2.imwrite(str(folder / "frames" / "void.png"), np.full((240, 320), 90, np.uint8))
    names = ("width", "height", "fx", "fy", "cx", "cy", "k1")
    camera_lines = [f"{key} = {getattr(camera, key)!r}" for key in names]
    ring = "outer_diameter_m = 0.9\ninner_diameter_m = 0.45\ncode_diameter_m = 0.64"
    lines = ["[camera]", *camera_lines, 'response = "linear"', "[[target]]", 'name = "A"', ring]
    lines += ["dot_diameter_m = 0.12", "code_deg = [0, 43, 78]"]
    (folder / "flight.toml").write_text("\n".join(lines), encoding="utf-8")
    (folder / "field.toml").write_text(field_toml(board), encoding="utf-8")
    return folder, poses


@pytest.fixture
def field_flight(rendered_field: tuple[Path, list[Pose]], tmp_path: Path) -> Path:
    """A copy of the rendered flight over a board."""
    return Path(shutil.copytree(rendered_field[0], tmp_path / "flight"))


@pytest.mark.parametrize("response", ["linear", "unknown"])
def test_a_field_gives_poses_in_its_own_coordinate_frame(
    field_flight: Path, rendered_field: tuple[Path, list[Pose]], response: str
) -> None:
    folder, (_, poses) = field_flight, rendered_field
    toml = folder / "flight.toml"
    toml.write_text(toml.read_text(encoding="utf-8").replace('"linear"', f'"{response}"'))
    result = run("orient", folder, "--field", folder / "field.toml", "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert (summary["field"], summary["frames"], summary["oriented"]) == ("board", 3, 2)
    assert list(summary["not_oriented"]) == ["void.png"]
    assert "void.png: not oriented: fewer than six discs like the field's" in result.stderr
    table = pd.read_csv(folder / "kgcp" / "field_poses.csv")
    assert "of 20 discs" in result.stderr
    assert (table["discs_used"] >= 18).all()
    for row, pose in zip(table.to_dict("records"), poses, strict=True):
        centre = -pose.rotation.T @ pose.translation_m
        off = (np.array([row[axis] for axis in "xyz"]) - centre) / [row[f"sd_{a}"] for a in "xyz"]
        assert np.abs(off).max() < 4.0
        assert max(row[f"sd_{axis}"] for axis in "xyz") < 0.002
        assert row["rms_px"] < 0.3
        assert row["focal_scale"] == 1.0
    result = run("orient", folder, "--field", folder / "field.toml", "--frames", "void*")
    assert result.exit_code == 1
    assert "no frame can be oriented by the field 'board': fewer than six discs" in result.stderr


def test_the_usual_reason_is_named_if_no_frame_can_be_oriented(field_flight: Path) -> None:
    frames = field_flight / "frames"
    (frames / "a_void.png").write_bytes(b"no image")
    shutil.copy(frames / "void.png", frames / "void_2.png")
    result = run(
        "orient", field_flight, "--field", field_flight / "field.toml", "--frames", "*void*"
    )
    assert result.exit_code == 1
    assert "; of 3 frames 2 have this reason: fewer than six discs" in result.stderr


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ("pitch_m = 0.03", ""),
        ("pitch_m = 30.0", "the discs are 1000 times as large as the field says"),
        ("pitch_m = 0.027", "the discs are 0.9 times as large as the field says"),
    ],
)
def test_a_field_whose_discs_have_another_size_than_stated_is_doubted(
    field_flight: Path, stated: str, words: str
) -> None:
    """Distances that are right, in millimetres, and 10 % too short."""
    toml = field_flight / "field.toml"
    text = toml.read_text(encoding="utf-8")
    assert "pitch_m = 0.03" in text
    toml.write_text(text.replace("pitch_m = 0.03", stated), encoding="utf-8")
    result = run("orient", field_flight, "--field", toml, "--frames", "*1.*", "--json")
    assert result.exit_code == 0, result.stderr
    doubts = json.loads(result.stdout)["doubts"]
    assert len(doubts) == (1 if words else 0)
    assert result.stderr.count("kgcp: doubt: ") == len(doubts)
    assert words in result.stderr


def test_a_field_without_a_mark_does_not_determine_its_orientation(field_flight: Path) -> None:
    result = run("orient", field_flight, "--field", "grid:5x4:30mm:16mm")
    assert result.exit_code == 1
    assert "the field looks the same turned, and nothing tells how it lies" in result.stderr


def test_a_symmetric_device_is_refused(tmp_path: Path) -> None:
    device = device_flight(tmp_path / "flight")
    text = device.read_text(encoding="utf-8").replace("[0.14, 0.08, 0.12]", "[0.15, 0.11, 0.1]")
    text = text.replace("[0.05, 0.22, 0.0]", "[0.0, 0.22, 0.0]")
    device.write_text(text.replace("[0.26, 0.19, 0.0]", "[0.3, 0.22, 0.0]"), encoding="utf-8")
    result = run("orient", tmp_path / "flight", "--device", device)
    assert result.exit_code == 1
    assert "looks the same with its points 1, 2, 3, 4 exchanged" in result.stderr


def test_the_example_in_the_documentation_runs(tmp_path: Path) -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "ground.md"
    example = page.read_text(encoding="utf-8").partition("## From end to end")[2]
    text = example.partition("##")[0]
    lines = [line.split()[1:] for line in text.splitlines() if line.startswith("    kgcp")]
    assert [line[0] for line in lines] == ["detect", "orient", "place", "export-gcp"]
    folder = GroundFlight(frames=5, stated_diameter_m=0.9, diameter_m=0.9005).write(
        tmp_path / "flight"
    )
    for name, *arguments in lines[1:]:  # detections are made already
        result = run(name, *(word.replace("FLIGHT", str(folder)) for word in arguments))
        assert result.exit_code == 0, result.stderr
    places = pd.read_parquet(folder / "kgcp" / "places.parquet")
    off = (places["diameter_m"] - 0.9005) / places["sd_diameter_m"]
    assert (off.abs() < 4.0).all()
    assert (folder / "kgcp" / "places" / "kgcps.csv").exists()
    points = pd.read_parquet(folder / "kgcp" / "kgcps.parquet")
    assert sorted(set(points["id"])) == ["A", "B", "C", "D"]


def test_a_target_on_a_vehicle_is_compared_with_its_trajectory(tmp_path: Path) -> None:
    """D stands on a vehicle that does not move; its trajectory is 0.2 m off."""
    flight = GroundFlight(frames=6)
    folder = flight.write(tmp_path / "flight", sd_position_m=0.005)
    toml = folder / "flight.toml"
    lines = toml.read_text(encoding="utf-8").splitlines()[:-2]  # without D's position
    lines += ["[vehicle]", 'trajectory = "vehicle.csv"', "lever_arm_m = [0.0, 0.0, -2.0]"]
    toml.write_text("\n".join(lines), encoding="utf-8")
    east, north, up = (flight.positions_map[3] + [0.2, 0.0, -2.0]).tolist()
    rest = f"{east},{north},{up},0,0,0,0.01,0.01,0.01"
    names = "time,x,y,z,roll_deg,pitch_deg,heading_deg,sd_x,sd_y,sd_z"
    epochs = [f"2026-06-16T08:15:{second:02d}Z,{rest}" for second in range(30)]
    (folder / "vehicle.csv").write_text("\n".join((names, *epochs)), encoding="utf-8")
    table = read_detections(folder / "kgcp" / "detections.parquet")
    seconds = table["frame"].str.slice(2, 5).astype(int)
    table["time"] = pd.Timestamp("2026-06-16T08:15:05Z") + pd.to_timedelta(seconds, unit="s")
    write_rows(folder / "kgcp" / "detections.parquet", table)
    result = run("orient", folder)
    assert result.exit_code == 0, result.stderr
    assert re.search(r"doubt: D on the vehicle is 0\.2\d? m beside .* of 6\)", result.stderr)


def test_the_doubt_about_a_fast_camera_is_one_sentence() -> None:
    """Unlike the others it had two, of which the second looked like the end of the line."""
    flight = read_flight(Path(__file__).parents[2] / "sample_flight")
    local_frame = LocalFrame.at("EPSG:25832", np.array([689400.0, 5336200.0, 545.0]))
    fast = FastCamera(MovedTarget("C", "7.jpg", 0.02, 40.0))
    (doubt,) = FlightPoses(flight, (), local_frame, {}, fast).doubts
    assert "or C was moved" in doubt
    assert ". " not in doubt
