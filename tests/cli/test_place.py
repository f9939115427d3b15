"""`kgcp place` on a flight over four static targets, made here."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from kgcp.geometry.arrays import FloatArray
from tests.ground_flight import CAMERA, GroundFlight


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["place", *map(str, arguments)], catch_exceptions=False)


def test_targets_are_placed_and_their_diameters_measured(tmp_path: Path) -> None:
    flight = GroundFlight(diameter_m=0.8993, stated_diameter_m=0.9)
    folder = flight.write(tmp_path / "flight")
    result = run(folder, "--eo", "fixed", "--json", "--format", "csv", "--format", "metashape")
    assert result.exit_code == 0, result.stderr
    table = pd.read_parquet(folder / "kgcp" / "places.parquet").set_index("target")
    assert list(table.index) == ["A", "B", "C", "D"]
    off = table[["x", "y", "z"]].to_numpy() - flight.positions_map
    z = off / table[["sd_x", "sd_y", "sd_z"]].to_numpy()
    assert np.abs(off).max() < 0.002
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.8
    diameters = (table["diameter_m"] - 0.8993) / table["sd_diameter_m"]
    assert 0.2 < np.sqrt(np.mean(diameters**2)) < 2.0
    assert (table["tilt_deg"] < 4.0 * table["sd_normal_deg"]).all()
    assert (table["ambiguity"] > 100.0).all()
    assert "the diameter of 0.9 m measures 0.899" in result.stderr
    assert "‰, " in result.stderr
    assert "which is not what flight.toml says" in result.stderr
    summary = json.loads(result.stdout)
    assert summary["targets"][0]["frames_used"] == 12
    assert (folder / "kgcp" / "places" / "kgcps.csv").exists()
    page = (folder / "kgcp" / "places.html").read_text(encoding="utf-8")
    assert "Targets on the ground" in page
    assert summary["sentences"][0] in page
    assert 'class="verdict look"' in page
    assert page.count('<li class="look">') == 5, "the diameters, that they agree, and no place"


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize(
    ("sd_position_m", "off_m", "words"),
    [
        (0.01, 0.0, None),
        (0.01, 0.2, r"B: lies [+−]?0.0\d+, \+0.20\d+, .* from its position in .*, more than"),
        (0.0, 0.2, None),  # a rough position
        (0.0, 20.0, "B: lies .* which states no sd_position_m; check position_m and crs"),
    ],
)
def test_positions_that_contradict_the_images_are_doubts(
    tmp_path: Path, sd_position_m: float, off_m: float, words: str | None
) -> None:
    flight = GroundFlight(frames=6)
    folder = flight.write(tmp_path / "flight", sd_position_m=sd_position_m)
    toml = folder / "flight.toml"
    x, y, z = flight.positions_map[1].tolist()
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace(str([x, y, z]), str([x, y - off_m, z])), encoding="utf-8")
    result = run(folder, "--json")
    doubts = json.loads(result.stdout)["doubts"]
    if words is None:
        assert doubts == []
    else:
        (doubt,) = doubts
        assert re.search(words, doubt)
        assert result.stderr.count(doubt) == 1


@pytest.mark.usefixtures("no_place_figures")
def test_a_rolling_shutter_needs_times(tmp_path: Path) -> None:
    """The camera's motion during the readout is unknown, and the deviations contain it."""
    folder = GroundFlight().write(tmp_path / "flight")
    alone = ("--targets", "A", "--json")
    still = json.loads(run(folder, *alone).stdout)["targets"][0]
    settings = folder / "flight.toml"
    text = settings.read_text(encoding="utf-8")
    settings.write_text(text.replace("[camera]", "[camera]\nreadout_s = 0.03"), encoding="utf-8")
    result = run(folder, *alone)
    assert result.exit_code == 0, result.stderr
    assert (
        "the standard deviations assume 5°/s (motion_sd_deg_s); give the frames' times"
        in result.stderr
    )
    target = json.loads(result.stdout)["targets"][0]
    assert target["sd_position_m"][2] > 5.0 * still["sd_position_m"][2]
    assert target["frames_used"] == 12


@pytest.mark.usefixtures("no_place_figures")
def test_a_wrong_frame_is_left_out_and_named(tmp_path: Path) -> None:
    flight = GroundFlight(wrong={(3, "B"): np.array([0.4, 0.0, 0.0])})
    folder = flight.write(tmp_path / "flight")
    result = run(folder, "--targets", "B", "--json")
    assert result.exit_code == 0, result.stderr
    (target,) = json.loads(result.stdout)["targets"]
    assert target["rejected"] == ["f_003.png"]
    assert "1 of 12 frames does not fit the others" in result.stderr
    residuals = pd.read_parquet(folder / "kgcp" / "place_residuals.parquet")
    worst = residuals.set_index("frame").loc["f_003.png"]
    assert not worst["used"]
    assert abs(worst["residual_x_px"]) + abs(worst["residual_y_px"]) > 5.0


def of_names(
    names: str, wrong: Mapping[tuple[int, str], FloatArray] = MappingProxyType({})
) -> GroundFlight:
    """A flight over some of the four targets."""
    offsets_m = GroundFlight().offsets_m[: len(names)]
    return GroundFlight(names=tuple(names), offsets_m=offsets_m, wrong=dict(wrong))


def moved(frames: int, off_m: float, *, names: str = "ABCD") -> GroundFlight:
    """A flight in whose first frames B lies elsewhere, to the east."""
    rotations = GroundFlight().rotations
    east = np.array([off_m, 0.0, 0.0])
    wrong = {(frame, "B"): rotations[frame].T @ east for frame in range(frames)}
    return of_names(names, wrong)


def places_of(folder: Path) -> dict[str, np.ndarray]:
    """Places, their deviations, diameters and their deviations by target: x y z, and so on."""
    table = pd.read_parquet(folder / "kgcp" / "places.parquet")
    columns = ["x", "y", "z", "sd_x", "sd_y", "sd_z", "diameter_m", "sd_diameter_m"]
    return dict(zip(table["target"].tolist(), table[columns].to_numpy(), strict=True))


@pytest.mark.usefixtures("no_place_figures")
def test_a_wrong_focal_length_is_a_doubt_about_all_diameters(tmp_path: Path) -> None:
    """It places all targets wrongly, by 26 of their standard deviations."""
    flight = GroundFlight(stated_camera=replace(CAMERA, fx=2316.0, fy=2316.0), frames=6)
    result = run(flight.write(tmp_path / "flight"))
    assert "doubt: all 4 targets measure 6.6 ‰ smaller than stated: unless" in result.stderr
    assert (
        "px in the places (by the reference poses, the calibration or a wrong readout_s)"
        in result.stderr
    )
    assert "but no error that all frames share" in result.stderr


@cache
def undisturbed_places(names: str) -> dict[str, np.ndarray]:
    """As `places_of`, where nothing was moved."""
    with tempfile.TemporaryDirectory() as folder:
        flight = of_names(names).write(Path(folder) / "flight")
        assert run(flight).exit_code == 0
        return places_of(flight)


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize(
    ("names", "frames", "off_m"),
    [
        ("ABCD", 6, 0.05),
        ("ABCD", 3, 0.0005),
        ("ABCD", 4, 1.0),
        ("AB", 5, 0.02),
        ("AB", 8, 1.0),
    ],
)
def test_a_target_that_was_moved_is_placed_by_most_frames_or_not_at_all(
    tmp_path: Path, names: str, frames: int, off_m: float
) -> None:
    flight = moved(frames, off_m, names=names)
    folder = flight.write(tmp_path / "flight")
    result = run(folder, "--json")
    assert result.exit_code == 0, result.stderr
    found, expected = places_of(folder), undisturbed_places(names)
    for name in names.replace("B", ""):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-6)
    assert "the images deviate" not in result.stderr
    assert "B: was moved by about" in result.stderr
    assert f"from f_{frames:03d}.png on" in result.stderr
    page = (folder / "kgcp" / "places.html").read_text(encoding="utf-8")
    assert 'class="verdict look"' in page
    if frames == 6:
        assert "no more than half of its frames agree" in page
        assert "B" not in found
        return
    shown = flight.positions_map[1]
    if frames > 6:
        (shown,) = flight.local_frame.map_from_enu(
            flight.positions[1:2] + np.array([off_m, 0.0, 0.0])
        )
    z = (found["B"][:3] - shown) / found["B"][3:6]
    assert np.abs(z).max() < 3.0
    assert (found["B"][3:6] < 4.0 * expected["B"][3:6]).all()
    (summary,) = (each for each in json.loads(result.stdout)["targets"] if each["target"] == "B")
    assert summary["moved"]["frame"] == f"f_{frames:03d}.png"
    assert summary["moved"]["distance_m"] == pytest.approx(off_m, rel=0.3)
    assert summary["frames_used"] == max(frames, 12 - frames)


def stepped(names: str, steps_m: FloatArray, *, seed: int = 1) -> GroundFlight:
    """A flight whose reference poses, and so all targets alike, are off by (12, 3) metres."""
    offsets_m = GroundFlight().offsets_m[: len(names)]
    rotations = GroundFlight(seed=seed).rotations
    wrong = {
        (frame, name): rotations[frame].T @ step
        for frame, step in enumerate(steps_m)
        for name in names
    }
    return GroundFlight(names=tuple(names), offsets_m=offsets_m, seed=seed, wrong=wrong)


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize(
    ("names", "size_m", "frames"),
    [
        ("A", 0.01, 5),
        ("A", 0.03, 6),
        ("AB", 0.01, 6),
        ("AB", 0.03, 8),
        ("ABC", 0.03, 6),
        ("ABC", 0.01, 8),
    ],
)
def test_a_step_in_the_poses_is_not_taken_for_a_moved_target(
    tmp_path: Path, names: str, size_m: float, frames: int
) -> None:
    steps_m = np.outer(np.arange(12) >= frames, [size_m, 0.0, 0.0])
    flight = stepped(names, steps_m)
    folder = flight.write(tmp_path / "flight")
    result = run(folder, "--json")
    assert result.exit_code == 0, result.stderr
    assert "was moved by" not in result.stderr
    assert "the reference poses step or drift" in result.stderr
    assert f"from f_{frames:03d}.png on" in result.stderr
    assert ("or the target was moved" in result.stderr) == (len(names) == 1)
    found = places_of(folder)
    for name, true in zip(names, flight.positions_map, strict=True):
        z = (found[name][:3] - true - [0.5 * size_m, 0.0, 0.0]) / found[name][3:6]
        assert np.abs(z).max() < 1.0
        assert 0.4 * size_m < found[name][3] < 1.5 * size_m
    for target in json.loads(result.stdout)["targets"]:
        assert target["frames_used"] == 12
        assert target["moved"] is None
        assert target["poses_step"]["frame"] == f"f_{frames:03d}.png"
        assert target["poses_step"]["distance_m"] == pytest.approx(size_m, rel=0.5)


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize(("names", "flights"), [("A", 4), ("AB", 2)])
def test_standard_deviations_cover_drifting_poses(tmp_path: Path, names: str, flights: int) -> None:
    ratios = []
    for seed in range(flights):
        rng = np.random.default_rng(seed)
        drift_m = 0.006 * np.cumsum(rng.standard_normal((12, 3)), axis=0)
        flight = stepped(names, drift_m - drift_m.mean(axis=0), seed=seed)
        folder = flight.write(tmp_path / str(seed))
        result = run(folder)
        assert result.exit_code == 0, result.stderr
        assert "was moved by" not in result.stderr
        found = places_of(folder)
        for name, true in zip(names, flight.positions_map, strict=True):
            ratios.append((found[name][:3] - true) / found[name][3:6])
    assert np.abs(ratios).max() < 3.0
    assert float(np.sqrt(np.mean(np.square(ratios)))) > 0.3


@pytest.mark.usefixtures("no_place_figures")
def test_a_step_within_the_stated_deviations_raises_no_doubt(tmp_path: Path) -> None:
    flight = stepped("A", np.outer(np.arange(12) >= 6, [0.02, 0.0, 0.0]))
    folder = flight.write(tmp_path / "flight")
    path = folder / "reference.csv"
    head, *lines = path.read_text(encoding="utf-8").splitlines()
    lines = [f"{line},0.02,0.02,0.03" for line in lines]
    path.write_text("\n".join((f"{head},sd_x,sd_y,sd_z", *lines)), encoding="utf-8")
    result = run(folder)
    assert result.exit_code == 0, result.stderr
    assert "another place" not in result.stderr


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize(("frames", "off_m"), [(4, 0.5), (6, 1.0)])
def test_a_step_of_a_single_target_is_taken_for_a_moved_target(
    tmp_path: Path, frames: int, off_m: float
) -> None:
    flight = stepped("A", np.outer(np.arange(12) >= frames, [off_m, 0.0, 0.0]))
    folder = flight.write(tmp_path / "flight")
    result = run(folder)
    assert result.exit_code == (frames == 6)
    assert "was moved by about" in result.stderr
    assert "reference poses step" not in result.stderr


@pytest.mark.usefixtures("no_place_figures")
@pytest.mark.parametrize("frames", [4, 6])
def test_a_target_at_two_distant_places_is_placed_by_most_frames_or_not_at_all(
    tmp_path: Path, frames: int
) -> None:
    """Half a frame's width apart."""
    flight = moved(frames, 6.0)
    folder = flight.write(tmp_path / "flight")
    result = run(folder)
    assert result.exit_code == 0
    found = places_of(folder)
    if frames == 4:
        assert "B: 4 of 12 frames do not fit the others and took no part" in result.stderr
        assert np.abs(found["B"][:3] - flight.positions_map[1]).max() < 0.001
    else:
        assert "not placed: B: was moved by about 6." in result.stderr
        assert list(found) == ["A", "C", "D"]


@pytest.mark.usefixtures("no_place_figures")
def test_contradictions_that_frames_share_are_not_reduced_by_more_frames(tmp_path: Path) -> None:
    """Another target is taken for B in every second frame: no time at which it was moved."""
    frames, east = 8, np.array([1.0, 0.0, 0.0])
    rotations = GroundFlight(seed=4, frames=frames).rotations
    wrong = {(frame, "B"): rotations[frame].T @ east for frame in range(0, frames, 2)}
    offsets_m = GroundFlight().offsets_m[:2]
    flight = GroundFlight(("A", "B"), offsets_m, frames=frames, seed=4, wrong=wrong)
    folder = flight.write(tmp_path / "flight")
    result = run(folder)
    assert result.exit_code == 0, result.stderr
    assert "B: its images contradict each other by" in result.stderr
    found = places_of(folder)
    z = (found["B"][:3] - flight.positions_map[1]) / found["B"][3:6]
    assert 0.3 < abs(z[0]) < 2.0
    z = (found["A"][:3] - flight.positions_map[0]) / found["A"][3:6]
    assert np.abs(z).max() < 3.0


@pytest.mark.usefixtures("no_place_figures")
def test_stated_deviations_of_poses_are_used(tmp_path: Path) -> None:
    folder = GroundFlight().write(tmp_path / "flight")
    path = folder / "reference.csv"
    head, *lines = path.read_text(encoding="utf-8").splitlines()
    lines = [f"{line},0.02,0.02,0.03,0.01" for line in lines]
    text = "\n".join((f"{head},sd_x,sd_y,sd_z,sd_angle_deg", *lines))
    path.write_text(f"{text}\n", encoding="utf-8")
    alone = ("--targets", "A", "--json")
    exact = json.loads(run(folder, "--eo", "fixed", *alone).stdout)["targets"][0]
    page = (folder / "kgcp" / "places.html").read_text(encoding="utf-8")
    assert 'class="verdict good"' in page
    free = json.loads(run(folder, *alone).stdout)["targets"][0]
    assert free["sd_position_m"][0] > 0.02 > 10.0 * exact["sd_position_m"][0]


@pytest.mark.parametrize(
    ("is_shifted", "problem"),
    [
        (True, "the poses do not fit the images, by 100 px or more"),
        (False, "all rays start at one place"),
    ],
)
def test_poses_assigned_to_other_frames_are_refused(
    tmp_path: Path, problem: str, *, is_shifted: bool
) -> None:
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    path = folder / "reference.csv"
    head, *lines = path.read_text(encoding="utf-8").splitlines()
    frames, poses = zip(*(line.split(",", 1) for line in lines), strict=True)
    others = [*poses[1:], poses[0]] if is_shifted else [poses[0]] * len(poses)
    lines = [f"{frame},{pose}" for frame, pose in zip(frames, others, strict=True)]
    path.write_text("\n".join((head, *lines)), encoding="utf-8")
    result = run(folder, "--targets", "A")
    assert result.exit_code == 1
    assert problem in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("--targets", "A,Z"), "'Z': is not in flight.toml"),
        (("--min-frames", "40"), "reference pose; 40 are needed); check that enough frames show"),
        (("--poses", "none.csv"), "none.csv: does not exist; name a file of poses (--poses)"),
        (("--poses", "."), ".: is no file; name a file of poses (--poses)"),
    ],
)
def test_targets_that_cannot_be_placed_are_a_one_line_error(
    tmp_path: Path, arguments: tuple[str, ...], problem: str
) -> None:
    folder = GroundFlight(frames=12).write(tmp_path / "flight")
    result = run(folder, *arguments)
    assert result.exit_code == 1
    assert problem in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("option", [("--targets", " ,"), ("--format", "colmap")])
def test_options_that_name_nothing_to_place_are_usage_errors(
    tmp_path: Path, option: tuple[str, str]
) -> None:
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    assert run(folder, *option).exit_code == 2


def test_target_names_cannot_become_spreadsheet_formulas(tmp_path: Path) -> None:
    folder = GroundFlight(names=("P$^$", "B", "C", "D"), frames=3).write(tmp_path / "flight")
    result = run(folder)
    assert result.exit_code == 0, result.stderr
    assert "P$^$" in (folder / "kgcp" / "places.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("no_place_figures")
def test_files_of_an_earlier_run_are_named(tmp_path: Path) -> None:
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    assert "earlier run" not in run(folder, "--format", "odm").stderr
    result = run(folder, "--format", "csv", "--json")
    assert "not updated, from an earlier run: odm\n" in result.stderr
    assert json.loads(result.stdout)["not_renewed"] == ["odm"]


def test_a_flight_without_a_readable_frame_is_reported(tmp_path: Path) -> None:
    folder = GroundFlight(frames=3).write(tmp_path / "flight")
    path = folder / "kgcp" / "detections.parquet"
    table = pq.read_table(path)
    status = table.column_names.index("status")
    unreadable = pa.array(["unreadable"] * table.num_rows)
    pq.write_table(table.set_column(status, "status", unreadable), path)
    result = run(folder)
    assert result.exit_code == 1
    assert "has no readable frame" in result.stderr
    assert result.stderr.count("\n") == 1


def test_heights_of_another_kind_are_a_grave_doubt_of_the_export(tmp_path: Path) -> None:
    def export(folder: Path) -> Result:
        arguments = ["export-gcp", str(folder), "--format", "csv"]
        return CliRunner().invoke(main, arguments, catch_exceptions=False)

    flight = GroundFlight(frames=4)
    folder = flight.write(tmp_path / "flight")
    size = (CAMERA.height, CAMERA.width)
    for name in flight.frame_names:
        cv2.imwrite(str(folder / "frames" / name), np.zeros(size, np.uint8))
    result = export(folder)
    assert "doubt" not in result.stderr
    path = folder / "flight.toml"
    text = path.read_text(encoding="utf-8")
    for position in flight.positions_map.tolist():
        text = text.replace(str(position), str([*position[:2], position[2] + 12.0]))
    path.write_text(text, encoding="utf-8")
    result = export(folder)
    assert "grave doubt: static targets: by the reference poses, all 4 lie alike 12 m down" in (
        result.stderr
    )
