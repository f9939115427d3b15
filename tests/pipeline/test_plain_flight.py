"""Discs and rings on the ground, from rendered frames to ground control points and places."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from kgcp.cli import main
from kgcp.errors import KgcpError, Reason
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import rotation_about
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import read_flight
from kgcp.io.formats.marks import read_marks
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import read_table
from kgcp.measurement.plain_pose import pose_towards
from kgcp.measurement.records import ExposureSettings, FrameResult, Miss
from kgcp.pipeline.bias_report import bias_study
from kgcp.pipeline.detect import RunOptions, detect_flight
from kgcp.pipeline.export import make_gcps
from kgcp.pipeline.ground.orient import orient_flight, write_poses
from kgcp.pipeline.ground.place import PlaceOptions, place_flight
from kgcp.pipeline.guidance import (
    marks_against_reference,
    searches_by_reference,
    static_by_reference,
)
from kgcp.quality.checks.static_targets import PlainSearch
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import PlainPlate, image_plate
from kgcp.targets.layout import Target
from tests.plain_flight import (
    CAMERA,
    CODED,
    CRS,
    ORIGIN_MAP,
    TARGETS,
    PlainFlight,
    coded_ring,
    plain_target,
)
from tests.systems import share

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

FOUR = (*TARGETS, plain_target("fourth", (0.3, -3.3), 0.8))
FLIGHT = PlainFlight(targets=FOUR, moving=Target(coded_ring("car", (0, 43, 78, 180))))


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


def assert_at(rows: pd.DataFrame, centres_m: FloatArray, largest_sd_px: float = 0.01) -> None:
    """The rows of a frame agree with the targets' true centres, within their deviations."""
    for target, centre_m in zip(TARGETS, centres_m, strict=True):
        row = rows.loc[target.name]
        x, y = CAMERA.project(centre_m[None])[0]
        assert abs(row["x_px"] - x) < 4.0 * row["sd_x_px"] < 4.0 * largest_sd_px
        assert abs(row["y_px"] - y) < 4.0 * row["sd_y_px"] < 4.0 * largest_sd_px
        off_m = row["distance_m"] - float(np.linalg.norm(centre_m))
        assert abs(off_m) < 4.0 * row["sd_distance_m"] < 0.1
        assert np.isnan(row["score"])


def test_every_target_is_measured_at_its_true_centre(folder: Path) -> None:
    table = detections(folder)
    assert list(table["status"]) == ["measured"] * FLIGHT.frames * (len(FOUR) + 1)
    for frame in range(FLIGHT.frames):
        rows = table[table["frame"] == f"f_{frame}.png"].set_index("target")
        assert_at(rows, FLIGHT.centres_m(frame)[: len(TARGETS)])


@pytest.mark.usefixtures("no_place_figures")
def test_four_discs_can_orient_frames_check_a_vehicle_and_be_placed(folder: Path) -> None:
    """The steps of docs/ground.md, from detections to points."""
    flight = read_flight(folder)
    oriented = orient_flight(flight)
    assert len(oriented.oriented) == FLIGHT.frames
    write_poses(oriented, folder / "kgcp")
    poses = folder / "kgcp" / "poses.csv"
    placed = place_flight(flight, options=PlaceOptions(poses=poses)).placement.targets
    assert [each.target for each in placed] == [target.name for target in FOUR]
    for each in placed:
        # three frames side by side hardly determine the scale, and their deviations show it
        off_m, sd_m = each.check.diameter_residual_m, each.check.sd_diameter_residual_m
        assert abs(off_m) < 3.0 * sd_m < 0.15
        assert each.check.position_chi2 is not None
        assert each.check.position_chi2 < 20.0
    text = (folder / "flight.toml").read_text(encoding="utf-8")
    by_targets = text.replace('"reference.csv"', '"kgcp/poses.csv"')
    (folder / "flight.toml").write_text(by_targets, encoding="utf-8")
    try:
        bias = bias_study(read_flight(folder))
        car = bias.to_dataframe()
        assert len(car) == FLIGHT.frames
        assert set(car["target"]) == {"car"}  # the poses were computed from the others
        assert np.abs(car["residual_m"]).max() < 0.05
        assert len(bias.study.frames_with_orienting_targets) == FLIGHT.frames
        points = make_gcps(read_flight(folder)).to_dataframe()
        assert len(points) == FLIGHT.frames * (len(FOUR) + 1)
    finally:
        (folder / "flight.toml").write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Around(PlainFlight):
    """The camera looks at the targets from all sides."""

    def cameras(self) -> tuple[FloatArray, FloatArray]:
        around = np.linspace(0.0, 2.0 * np.pi, self.frames, endpoint=False) + 0.3
        centres = np.stack((9.0 * np.cos(around), 9.0 * np.sin(around), 0.0 * around + 18.0), -1)
        rotations = [pose_towards(c, -c / np.linalg.norm(c)).rotation for c in centres]
        return centres, np.array(rotations)


@pytest.mark.usefixtures("no_place_figures")
def test_placed_normals_do_not_depend_on_the_stated_ones(tmp_path: Path) -> None:
    """One on a roof, one wrongly stated to be level: the result does not contain the prior."""
    roof, tilted = (0.5, -0.2, 1.0), (-0.1, 0.05, 1.0)
    free = replace(plain_target("roof", (2.0, 2.0), 0.8), normal_enu=None)
    targets = (free, plain_target("tilted", (-2.5, -1.0), 0.7, polarity="dark"))
    made = Around(
        targets=targets,
        frames=6,
        sd_position_m=0.0002,
        sd_angle_deg=0.0005,
        true_normals={"roof": roof, "tilted": tilted},
    )
    made.write(tmp_path)
    run("detect", tmp_path, "--jobs", "0")
    rows = detections(tmp_path)
    assert set(rows["status"]) == {"measured"}
    assert set(rows["shape"]) == {"disc"}
    run("place", tmp_path)
    table = pd.read_parquet(tmp_path / "kgcp" / "places.parquet").set_index("target")
    for target, normal in zip(targets, (roof, tilted), strict=True):
        row = table.loc[target.name]
        on_map = row[["normal_x", "normal_y", "normal_z"]].to_numpy(np.float64)
        found = LocalFrame.at(CRS, ORIGIN_MAP).grid_rotation(np.zeros(3)) @ on_map
        off_deg = np.degrees(np.arccos(found @ normal / np.linalg.norm(normal)))
        assert off_deg < 4.0 * row["sd_normal_deg"] < 0.5
        off_m = row[["x", "y", "z"]].to_numpy(np.float64) - target.position_m
        sd_m = row[["sd_x", "sd_y", "sd_z"]].to_numpy(np.float64)
        assert np.all(np.abs(off_m) < 4.0 * sd_m)
        assert sd_m.max() < 0.0006
        assert abs(row["diameter_residual_m"]) < 4.0 * row["sd_diameter_residual_m"] < 0.005
        assert row["frames_used"] == made.frames
        assert row["shape"] == "disc"


def test_check_lists_plain_targets(folder: Path) -> None:
    assert "0.8 m, bright disc (static)" in run("check", folder)


def test_a_changed_position_makes_detections_stale(folder: Path, tmp_path: Path) -> None:
    """Plain targets differ only by their positions, so that points would be mixed up."""
    text = (folder / "flight.toml").read_text(encoding="utf-8")
    places = [line for line in text.splitlines() if line.startswith("position_m")]
    swapped = text.replace(places[0], "@").replace(places[1], places[0]).replace("@", places[1])
    assert swapped != text
    for name in ("frames", "vehicle.csv", "reference.csv"):
        share(folder / name, tmp_path / name)
    (tmp_path / "flight.toml").write_text(swapped, encoding="utf-8")
    with pytest.raises(KgcpError, match=r"changed since 'kgcp detect': .* position_m"):
        make_gcps(read_flight(tmp_path), folder / "kgcp" / "detections.parquet")


def test_plain_targets_are_not_searched_without_poses(folder: Path, tmp_path: Path) -> None:
    text = (folder / "flight.toml").read_text(encoding="utf-8")
    share(folder / "frames", tmp_path / "frames")
    bare = text.replace('[reference]\nposes = "reference.csv"\n', "")
    (tmp_path / "flight.toml").write_text(bare, encoding="utf-8")
    share(folder / "vehicle.csv", tmp_path / "vehicle.csv")
    words = run("detect", tmp_path, "--jobs", "0")
    assert "12 no_prediction: give precise [reference] poses" in words
    table = detections(tmp_path)
    assert set(table["target"][table["status"] == "measured"]) == {"car"}


def test_coded_targets_in_the_frame_predict_plain_targets(tmp_path: Path) -> None:
    """Instead of a reference pose that puts the coded ones elsewhere, too."""
    made = PlainFlight(frames=1, coded=CODED)
    made.write(tmp_path)
    turn_reference(tmp_path, 7.0)
    run("detect", tmp_path, "--jobs", "0")
    table = detections(tmp_path)
    assert set(table["status"]) == {"measured"}
    rows = table.set_index("target")
    assert rows["guided"].sum() == len(TARGETS)
    assert_at(rows, made.centres_m(0))


def turn_reference(folder: Path, degrees: float) -> None:
    """Turn all reference poses about the vertical."""
    poses = pd.read_csv(folder / "reference.csv")
    poses["kappa_deg"] += degrees
    poses.to_csv(folder / "reference.csv", index=False)


def test_searches_by_reference_poses_are_told_from_others(tmp_path: Path) -> None:
    PlainFlight(frames=1).write(tmp_path)
    flight = read_flight(tmp_path)
    data = FlightData(flight, ["f_0.png"])
    (known,) = static_by_reference(flight, data, ["f_0.png"], [{}])
    misses = Miss("white", Reason.NO_CANDIDATE), Miss("black", Reason.NO_PREDICTION)
    result = FrameResult("f_0.png", None, ExposureSettings(), misses)
    searches = searches_by_reference(result, known.plain, CAMERA)
    assert [*searches] == [PlainSearch("f_0.png", "white", None)]


def test_marks_that_contradict_reference_poses_are_refused(tmp_path: Path) -> None:
    """They would be ignored, because a reference pose is preferred."""
    made = PlainFlight(frames=1)
    made.write(tmp_path)
    lines = ["frame,target,x_px,y_px"]
    for target, (x, y) in zip(made.targets, CAMERA.project(made.centres_m(0)), strict=True):
        lines.append(f"f_0.png,{target.name},{x + 6.0:.0f},{y - 6.0:.0f}")  # still on the target
    path = tmp_path / "places.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    flight = read_flight(tmp_path)
    marks = read_marks(path, ["f_0.png"], [each.name for each in TARGETS], CAMERA)
    data = FlightData(flight, ["f_0.png"])
    assert marks_against_reference(flight, data, marks, {"f_0.png": {}}) is None
    turn_reference(tmp_path, 40.0)
    with pytest.raises(KgcpError, match=r"3 of 3 marks are not where .* give rough \[reference\]"):
        detect_flight(flight, options=RunOptions(jobs=0, places=path))


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frame without a pose."""
    folder = PlainFlight(frames=1).write(tmp_path_factory.mktemp("bare"))
    (folder / "reference.csv").unlink()
    return folder


def test_manual_marks_predict_plain_targets(bare: Path) -> None:
    centres_m = PlainFlight(frames=1).centres_m(0)
    lines = ["frame,target,x_px,y_px"]
    for target, place in zip(TARGETS, CAMERA.project(centres_m), strict=True):
        x, y = np.rint(place + np.array([1.2, -0.8]))
        lines.append(f"f_0.png,{target.name},{x},{y}")
    (bare / "places.csv").write_text("\n".join(lines), encoding="utf-8")
    run("detect", bare, "--jobs", "0", "--places", str(bare / "places.csv"))
    rows = detections(bare).set_index("target")
    assert set(rows["status"]) == {"measured"}
    assert_at(rows, centres_m, largest_sd_px=0.04)  # the attitude of the frame is hardly known


def test_a_poor_mark_does_not_keep_a_target_from_being_found(tmp_path: Path) -> None:
    """Four good marks orient the frame, whose pose predicts the fifth target."""
    fifth = plain_target("fifth", (-1.2, 0.6), 0.8)
    made = PlainFlight(targets=(*FOUR, fifth), frames=1)
    made.write(tmp_path)
    (tmp_path / "reference.csv").unlink()
    lines = ["frame,target,x_px,y_px,sd_px"]
    for target, (x, y) in zip(made.targets, CAMERA.project(made.centres_m(0)), strict=True):
        lines.append(f"f_0.png,{target.name},{x:.0f},{y:.0f},{80 if target is fifth else 2}")
    (tmp_path / "places.csv").write_text("\n".join(lines), encoding="utf-8")
    run("detect", tmp_path, "--jobs", "0", "--places", str(tmp_path / "places.csv"))
    rows = detections(tmp_path).set_index("target")
    assert set(rows["status"]) == {"measured"}
    assert_at(rows, made.centres_m(0)[: len(TARGETS)], largest_sd_px=0.04)


def test_exchanged_marks_are_refused(bare: Path) -> None:
    """Two marks alone can be exchanged, three not."""
    places = CAMERA.project(PlainFlight(frames=1).centres_m(0))
    names = [target.name for target in TARGETS]
    path = bare / "exchanged.csv"
    for first, second in combinations(range(3), 2):
        exchanged = [*names]
        exchanged[first], exchanged[second] = names[second], names[first]
        marks = [f"f_0.png,{name},{x},{y}" for name, (x, y) in zip(exchanged, places, strict=True)]
        path.write_text("\n".join(("frame,target,x_px,y_px", *marks)), encoding="utf-8")
        with pytest.raises(KgcpError, match="seem to be exchanged") as caught:
            detect_flight(read_flight(bare), options=RunOptions(jobs=0, places=path))
        assert names[first] in str(caught.value)
        assert names[second] in str(caught.value)


@dataclass(frozen=True)
class Passage(PlainFlight):
    """The camera passes over targets on even ground, ever faster, and turns a little."""

    def cameras(self) -> tuple[FloatArray, FloatArray]:
        after_s = np.arange(float(self.frames))
        centres = np.stack((0.3 * after_s + 0.01 * after_s**2 - 2.0, 0.1 * after_s, 25.0 + after_s))
        down = np.diag((1.0, -1.0, -1.0))
        turns = [rotation_about(np.array([0.0, 0.02, 0.03]) * after) for after in after_s]
        return centres.T, np.array([down @ turn for turn in turns])

    def _write_frames(self, folder: Path, rng: np.random.Generator) -> None:
        _, rotations = self.cameras()
        for frame, enu_from_camera in enumerate(rotations):
            light: FloatArray = np.full((CAMERA.height, CAMERA.width), 0.3)
            for target, centre_m in zip(self.targets, self.centres_m(frame), strict=True):
                pose = pose_towards(centre_m, -enu_from_camera[2])
                image_plate(CAMERA, PlainPlate(target), pose, Optics(0.6)).paste(light)
            cv2.imwrite(str(folder / f"f_{frame}.png"), Sensor().expose(light, 1.0, rng))


def test_neighbouring_frames_predict_plain_targets(tmp_path: Path) -> None:
    targets = (plain_target("white", (-2.0, -1.5), 0.8), plain_target("black", (2.0, 1.5), 0.9))
    made = Passage(targets=targets, frames=6)
    made.write(tmp_path)
    (tmp_path / "reference.csv").unlink()
    missing = {2}
    marks = ["frame,target,x_px,y_px"]
    for frame in set(range(made.frames)) - missing:
        places = CAMERA.project(made.centres_m(frame))
        marks += [
            f"f_{frame}.png,{target.name},{x:.0f},{y:.0f}"
            for target, (x, y) in zip(targets, places, strict=True)
        ]
    (tmp_path / "places.csv").write_text("\n".join(marks), encoding="utf-8")
    run("detect", tmp_path, "--jobs", "0", "--places", str(tmp_path / "places.csv"))
    table = detections(tmp_path)
    assert set(table["status"]) == {"measured"}
    for frame in missing:
        rows = table[table["frame"] == f"f_{frame}.png"].set_index("target")
        assert rows["guided"].all()
        rows = rows.loc[[target.name for target in targets]]
        off_px = rows[["x_px", "y_px"]].to_numpy() - CAMERA.project(made.centres_m(frame))
        assert np.abs(off_px / rows[["sd_x_px", "sd_y_px"]].to_numpy()).max() < 4.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,target,x_px\nf_0.png,white,1", "lacks the columns y_px"),
        ("frame,target,x_px,y_px\nf_9.png,white,1,2", "line 2: 'f_9.png' is not a frame"),
        ("frame,target,x_px,y_px\nf_0.png,red,1,2", "line 2: 'red' is not a static target"),
        ("frame,target,x_px,y_px,sd_px\nf_0.png,white,1,2,0", "line 2: sd_px is 0"),
        ("frame,target,x_px,y_px" + 2 * "\nf_0.png,white,1,2", "line 3: 'white' is marked twice"),
        ("frame,target,x_px,y_px\nf_0.png,white,-1,2", "line 2: (-1, 2) is outside the frame"),
        ("frame,target,x_px,y_px\nf_0.png,white,1,2", "f_0.png has one mark"),
        (
            "frame,target,x_px,y_px\nf_0.png,white,1,2\nf_0.png,black,1,2",
            "f_0.png has two marks at one place",
        ),
    ],
)
def test_wrong_marks_are_a_one_line_error(bare: Path, text: str, message: str) -> None:
    path = bare / "wrong.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(KgcpError) as caught:
        detect_flight(read_flight(bare), options=RunOptions(jobs=0, places=path))
    assert message in str(caught.value)
    assert "; " in str(caught.value)
