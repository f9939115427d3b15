"""Where plain targets must be, against the poses that their flight was rendered with."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.errors import Reason
from kgcp.geometry.attitude import cross_matrix
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.plain_prediction import (
    MarkedPlace,
    predict_marked,
    predict_places,
    predict_plain,
    reference_orientations,
)
from kgcp.georef.target_positions import static_position
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import read_flight
from kgcp.measurement.plain_target import measure_plain
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.measurement.records import Miss
from tests.plain_flight import CAMERA, CRS, ORIGIN_MAP, TARGETS, PlainFlight


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return PlainFlight(frames=1).write(tmp_path_factory.mktemp("predicted"))


def test_deviations_cover_the_errors_of_the_poses(made: Path) -> None:
    flight = read_flight(made)
    data = FlightData(flight, ["f_0.png"])
    positions = data.static_positions
    orientations = reference_orientations(data.reference_poses, positions.local_frame)
    assert [*orientations] == ["f_0.png"]
    named = predict_plain(flight.plain_targets, orientations["f_0.png"], positions, CAMERA, {})
    centres_m = PlainFlight(frames=1).centres_m(0)
    for target, centre_m in zip(TARGETS, centres_m, strict=True):
        one = named[target.name]
        off_px = one.centre_px - CAMERA.project(centre_m[None])[0]
        assert np.abs(off_px).max() < 4.0 * one.sd_px
        # 2 cm at 25 m and 0.02° make 0.6 px, besides 1 px at least
        assert 1.0 < one.sd_px < 1.5
        assert one.normal is not None
        assert one.normal.direction_camera @ centre_m > 0.9 * np.linalg.norm(centre_m)
        assert np.linalg.norm(one.position_m - centre_m) < 0.1
        assert "the reference" in str(one)


@pytest.mark.parametrize(
    ("turned_deg", "where"), [(180.0, "behind the camera"), (75.0, "far aside")]
)
def test_targets_that_a_known_pose_has_out_of_sight_are_not_unpredicted(
    made: Path, turned_deg: float, where: str
) -> None:
    flight = read_flight(made)
    data = FlightData(flight, ["f_0.png"])
    positions, camera = data.static_positions, replace(CAMERA, k1=-0.3, readout_s=0.02)
    pose = reference_orientations(data.reference_poses, positions.local_frame)["f_0.png"]
    turn = Rotation.from_euler("x", turned_deg, degrees=True).as_matrix()
    away = replace(pose, enu_from_camera=pose.enu_from_camera @ turn)
    grey = np.full((camera.height, camera.width), 90, np.uint8)
    (target, *_) = flight.plain_targets
    prediction = predict_plain([target], away, positions, camera, {})[target.name]
    outcome = measure_plain(grey, camera, target, prediction)
    assert isinstance(outcome, Miss)
    assert outcome.reason is Reason.OUT_OF_VIEW
    assert outcome.detail == f"expected by the reference {where}, outside the frame"
    place = predict_places([target], away, positions, camera, {})[target.name]
    assert place.contradiction_px(np.array([100.0, 100.0])) == math.inf
    assert pose.cov is not None
    vague = replace(away, cov=pose.cov + np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
    prediction = predict_plain([target], vague, positions, camera, {})[target.name]
    outcome = measure_plain(grey, camera, target, prediction)
    assert isinstance(outcome, Miss)
    assert outcome.reason is Reason.NO_PREDICTION
    place = predict_places([target], vague, positions, camera, {})[target.name]
    assert place.contradiction_px(np.array([100.0, 100.0])) is None


@pytest.mark.parametrize("stated", [(), ("sd_position_m",), ("sd_angle_deg",)])
def test_poses_without_both_deviations_are_trusted_less(
    made: Path, stated: tuple[str, ...]
) -> None:
    flight = read_flight(made)
    data = FlightData(flight, ["f_0.png"])
    positions = data.static_positions
    poses = data.reference_poses
    bare = replace(
        poses,
        sd_position_m=poses.sd_position_m if "sd_position_m" in stated else None,
        sd_angle_deg=poses.sd_angle_deg if "sd_angle_deg" in stated else None,
    )
    orientation = reference_orientations(bare, positions.local_frame)["f_0.png"]
    named = predict_plain(flight.plain_targets, orientation, positions, CAMERA, {})
    assert all(4.0 < one.sd_px < 6.0 for one in named.values())


def test_a_rolling_shutter_widens_predictions_away_from_the_middle_row(made: Path) -> None:
    flight = read_flight(made)
    positions = FlightData(flight, ["f_0.png"]).static_positions
    poses = FlightData(flight, ["f_0.png"]).reference_poses
    orientation = reference_orientations(poses, positions.local_frame)["f_0.png"]
    still = predict_plain(flight.plain_targets, orientation, positions, CAMERA, {})
    rolling = replace(CAMERA, readout_s=0.1)
    moving = predict_plain(flight.plain_targets, orientation, positions, rolling, {})
    for name, one in still.items():
        # 5°/s until the row is exposed
        share = one.centre_px[1] / (CAMERA.height - 1) - 0.5
        turn_px = CAMERA.fx * np.radians(5.0) * 0.1 * share
        assert moving[name].sd_px == pytest.approx(np.hypot(one.sd_px, turn_px), rel=0.06)


def test_known_motion_moves_predictions_to_their_rows(made: Path) -> None:
    """At 16 m/s and 28 m, the scene turns by 33°/s: 12 px in 15 ms, and many targets were lost."""
    flight = read_flight(made)
    data = FlightData(flight, ["f_0.png"])
    positions = data.static_positions
    orientation = reference_orientations(data.reference_poses, positions.local_frame)["f_0.png"]
    rolling = replace(CAMERA, readout_s=0.1)
    rotation = SceneRotation((np.radians(33.0), 0.0, np.radians(10.0)), np.radians(0.5))
    known = dict.fromkeys((each.name for each in flight.plain_targets), rotation)
    named = predict_plain(flight.plain_targets, orientation, positions, rolling, known)
    places = predict_places(flight.plain_targets, orientation, positions, rolling, known)
    for name, still in predict_plain(
        flight.plain_targets, orientation, positions, CAMERA, {}
    ).items():
        one = named[name]
        delay_s = float(rolling.delay_s(one.centre_px[None])[0])
        turn = Rotation.from_rotvec(delay_s * np.array(rotation.velocity_rad_s))
        at_row = CAMERA.project(turn.apply(still.position_m)[None])[0]
        assert np.linalg.norm(one.centre_px - at_row) < 0.05
        assert np.linalg.norm(one.centre_px - still.centre_px) > 3.0
        assert one.sd_px < 1.5
        np.testing.assert_array_equal(places[name].centre_px, one.centre_px)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_a_face_lies_above_its_position(normal: tuple[float, float, float]) -> None:
    frame = LocalFrame.at(CRS, ORIGIN_MAP)
    low = replace(TARGETS[0], normal_enu=normal)
    thick = replace(low, thickness_m=0.1)
    ground, face = (static_position(each.position_m, each, frame) for each in (low, thick))
    np.testing.assert_allclose(
        face.position_m - ground.position_m, 0.1 * np.array(normal), atol=1e-6
    )
    assert ground.cov_m2 is not None
    assert face.cov_m2 is not None
    # the face tilts by 3° at 0.1 m: 5.2 mm aside, nothing along the normal
    more = face.cov_m2 - ground.cov_m2
    assert np.trace(more) == pytest.approx(2.0 * 0.00524**2, rel=0.01)
    assert np.array(normal) @ more @ normal == pytest.approx(0.0, abs=1e-9)


def test_correlated_errors_of_a_pose_cancel_in_the_prediction(made: Path) -> None:
    """A turn about the target, as resections are unsure of, moves it little in the image."""
    flight = read_flight(made)
    data = FlightData(flight, ["f_0.png"])
    positions = data.static_positions
    orientation = reference_orientations(data.reference_poses, positions.local_frame)["f_0.png"]
    arm_m = positions.static["white"].position_m - orientation.centre_m
    # the camera moves round the target by δC = −ω × arm while it turns by ω
    about = np.vstack((cross_matrix(arm_m), np.eye(3)))
    cov = 1e-4 * about @ about.T
    made_of = [
        predict_plain(flight.plain_targets, replace(orientation, cov=one), positions, CAMERA, {})
        for one in (cov, np.diag(np.diag(cov)))
    ]
    correlated, not_correlated = (named["white"].sd_px for named in made_of)
    assert correlated == pytest.approx(1.0, abs=0.1)
    assert not_correlated > 5.0


def test_a_free_normal_is_that_of_no_plane(made: Path) -> None:
    flight = read_flight(made)
    data = FlightData(flight, ["f_0.png"])
    positions = data.static_positions
    orientation = reference_orientations(data.reference_poses, positions.local_frame)["f_0.png"]
    free = [replace(target, normal_enu=None) for target in flight.plain_targets]
    for target in free:
        one = predict_plain(free, orientation, positions, CAMERA, {})[target.name]
        assert one.normal is None
        assert not one.is_from_behind()
        along = one.position_m / np.linalg.norm(one.position_m)
        assert one.prior.direction_camera == pytest.approx(along)
        assert one.prior.sd_deg > 45.0
    pixels = CAMERA.project(PlainFlight(frames=1).centres_m(0)).tolist()
    marks = {
        target.name: MarkedPlace(x, y, 2.0) for target, (x, y) in zip(free, pixels, strict=True)
    }
    tilted = replace(free[0], normal_enu=(0.6, 0.0, 0.8))
    marked = predict_marked([tilted, *free[1:]], marks, positions, CAMERA)
    assert [*marked] == [target.name for target in free[1:]]
    assert all(one.normal is None for one in marked.values())
