"""Plans of simulated flights, checked by formulas that share nothing with the simulator."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.simulation.flight import (
    CRS,
    DECOY_PLATE,
    TARGET_PLATE,
    FlightPlan,
    grow_ground,
    plan_flight,
    render_frame,
)
from kgcp.simulation.presets import PRESETS, preset

EXACT = replace(preset("clean").without_survey_errors(), frames=60)
GEODETIC = Transformer.from_crs(CRS, "EPSG:4258", always_xy=True)
ECEF = Transformer.from_crs("EPSG:4937", "EPSG:4936", always_xy=True)


@pytest.fixture(scope="module")
def exact() -> FlightPlan:
    return plan_flight(EXACT, 4)


@pytest.fixture(scope="module", params=list(PRESETS))
def long_plan(request: pytest.FixtureRequest) -> FlightPlan:
    return plan_flight(replace(preset(request.param), frames=96), 4)


def ecef(xyz_map: FloatArray) -> FloatArray:
    longitude, latitude = GEODETIC.transform(xyz_map[:, 0], xyz_map[:, 1])
    return np.column_stack(ECEF.transform(longitude, latitude, xyz_map[:, 2]))


def level_axes(xyz_map: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """East, north, up in ECEF at one map point, from the ellipsoid's normal."""
    longitude, latitude = np.radians(GEODETIC.transform(xyz_map[0], xyz_map[1]))
    up = np.array(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    return east, np.cross(up, east), up


def body_to_ecef(xyz_map: FloatArray, roll: float, pitch: float, heading: float) -> FloatArray:
    east, north, up = level_axes(xyz_map)
    r, p, h = np.radians([roll, pitch, heading])
    forward = np.cos(p) * (np.cos(h) * north + np.sin(h) * east) + np.sin(p) * up
    level_right = np.cos(h) * east - np.sin(h) * north
    right = np.cos(r) * level_right - np.sin(r) * np.cross(level_right, forward)
    return np.column_stack((forward, right, np.cross(forward, right)))


def projected(plan: FlightPlan, pose: Pose, points: FloatArray) -> FloatArray:
    camera = plan.settings.camera
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    distortion = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    turn = Rotation.from_matrix(pose.rotation).as_rotvec()
    pixels = cv2.projectPoints(points, turn, pose.translation_m, matrix, distortion)[0]
    return np.asarray(pixels[:, 0])


def test_trajectory_lever_arm_and_attitude_lead_to_the_target(exact: FlightPlan) -> None:
    trajectory = exact.trajectory
    target = ecef(exact.target_map)
    for frame, expected in zip(exact.frames, target, strict=True):
        epoch = int(np.argmin(np.abs(trajectory.time_s - frame.time_s)))
        assert abs(trajectory.time_s[epoch] - frame.time_s) < 1e-6
        position = trajectory.position_map[epoch]
        attitude = body_to_ecef(position, *trajectory.attitude_deg[epoch])
        reached = ecef(position[None])[0] + attitude @ np.array(exact.vehicle.lever_arm_m)
        assert np.linalg.norm(reached - expected) < 0.001


def test_reference_poses_see_the_target_where_the_truth_says(exact: FlightPlan) -> None:
    reference = exact.reference
    camera_ecef, target_ecef = ecef(reference.position_map), ecef(exact.target_map)
    for index, frame in enumerate(exact.frames):
        ray = target_ecef[index] - camera_ecef[index]
        assert np.linalg.norm(ray) == pytest.approx(frame.target.distance_m, abs=2e-4)
        # Grid axes in ECEF, from small steps on the grid.
        position = reference.position_map[index]
        x, y = (
            ecef((position + 5.0 * step)[None])[0] - ecef((position - 5.0 * step)[None])[0]
            for step in np.eye(3)[:2]
        )
        grid = np.column_stack((x, y, np.cross(x, y)))
        grid /= np.linalg.norm(grid, axis=0)
        omega, phi, kappa = np.radians(reference.opk_deg[index])
        sin, cos = np.sin, np.cos
        rx = np.array([[1, 0, 0], [0, cos(omega), -sin(omega)], [0, sin(omega), cos(omega)]])
        ry = np.array([[cos(phi), 0, sin(phi)], [0, 1, 0], [-sin(phi), 0, cos(phi)]])
        rz = np.array([[cos(kappa), -sin(kappa), 0], [sin(kappa), cos(kappa), 0], [0, 0, 1]])
        seen = (grid @ rx @ ry @ rz).T @ ray
        in_camera = np.array([seen[0], -seen[1], -seen[2]])
        assert_allclose(in_camera, frame.target.translation_m, atol=2e-3)


def test_present_targets_are_in_the_frame_and_absent_ones_are_not(long_plan: FlightPlan) -> None:
    settings = long_plan.settings
    size = np.array([settings.camera.width, settings.camera.height])
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    ring = 0.45 * np.column_stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)))
    for frame in long_plan.frames:
        radius = TARGET_PLATE.outline.reach_m / 0.45
        pixels = projected(long_plan, frame.target, ring if frame.present else radius * ring)
        inside = np.all((pixels > 0.0) & (pixels < size - 1.0), axis=1)
        assert inside.all() if frame.present else not inside.any()
        for decoy in frame.decoys:
            around = projected(long_plan, decoy, DECOY_PLATE.outline.reach_m / 0.45 * ring)
            assert np.all((around > 0.0) & (around < size - 1.0))
    absent = sum(not frame.present for frame in long_plan.frames)
    assert absent == round(settings.absent_share * settings.frames)
    assert any(frame.decoys for frame in long_plan.frames)


def test_frames_keep_to_the_settings(long_plan: FlightPlan) -> None:
    settings = long_plan.settings
    for frame in long_plan.frames:
        assert settings.distance_m[0] <= frame.target.distance_m <= settings.distance_m[1] + 1e-9
        assert settings.gain[0] <= frame.gain <= settings.gain[1]
        assert settings.psf_px[0] <= frame.optics.psf_px <= settings.psf_px[1]
        assert np.hypot(*frame.optics.streak_px) <= settings.streak_px[1] + 1e-9
        tilt = np.degrees(np.arccos(-frame.camera.enu_from_camera[2, 2]))
        assert settings.tilt_deg[0] - 1e-6 <= tilt <= settings.tilt_deg[1] + 1e-6


def test_target_faces_the_camera(exact: FlightPlan) -> None:
    for frame in exact.frames:
        assert frame.target.normal @ frame.target.translation_m > 0.0


def test_errors_scatter_as_declared() -> None:
    settings = replace(preset("clean"), frames=600)
    noisy = plan_flight(settings, 8)
    truth = plan_flight(settings.without_survey_errors(), 8)
    position = noisy.trajectory.position_map - truth.trajectory.position_map
    # 4 s of correlation leave about 110 independent samples: 7 % for a standard deviation.
    assert_allclose(position.std(axis=0), settings.sd_position_m, rtol=0.25)
    attitude = noisy.trajectory.attitude_deg - truth.trajectory.attitude_deg
    attitude = (attitude + 180.0) % 360.0 - 180.0
    assert_allclose(attitude.std(axis=0), settings.sd_attitude_deg, rtol=0.25)
    times = noisy.recorded_times_s - truth.recorded_times_s
    assert times.std() == pytest.approx(settings.sd_time_s, rel=0.12)
    cameras = np.array([frame.camera.position_enu_m for frame in noisy.frames])
    exact = np.array([frame.camera.position_enu_m for frame in truth.frames])
    lever_arm_error = cameras - exact  # the camera follows the target
    assert np.linalg.norm(lever_arm_error, axis=1).max() < 5.0 * settings.sd_lever_arm_m


def test_rendering_repeats_and_depends_on_the_seed() -> None:
    small = replace(
        preset("sample"),
        camera=replace(
            preset("sample").camera, width=330, height=250, fx=520.0, fy=519.0, cx=163.2, cy=127.9
        ),
        frames=3,
    )
    plan, again, other = plan_flight(small, 5), plan_flight(small, 5), plan_flight(small, 6)
    first = render_frame(plan, grow_ground(5), 1)
    assert first.shape == (250, 330)
    assert_array_equal(first, render_frame(again, grow_ground(5), 1))
    assert not np.array_equal(first, render_frame(other, grow_ground(6), 1))


def test_a_frame_shows_its_target_and_levels(exact: FlightPlan) -> None:
    index = next(index for index in range(5, 60) if exact.frames[index].present)
    frame = exact.frames[index]
    grey = render_frame(exact, grow_ground(4), index).astype(float)
    ring = TARGET_PLATE.target.ring
    dots = np.column_stack((ring.dot_centres_m(), np.zeros(len(ring.code_deg))))
    for x, y in projected(exact, frame.target, dots):
        assert grey[round(y), round(x)] == pytest.approx(
            255.0 * frame.gain * TARGET_PLATE.white, abs=12.0
        )
    opposite = np.array([[0.0, -0.5 * ring.code_diameter_m, 0.0]])  # 270°: no dot
    x, y = projected(exact, frame.target, opposite)[0]
    assert grey[round(y), round(x)] == pytest.approx(
        255.0 * frame.gain * TARGET_PLATE.black, abs=8.0
    )


def test_unknown_presets_and_impossible_settings_are_refused() -> None:
    with pytest.raises(SettingError, match="give one of clean"):
        preset("moon")
    with pytest.raises(SettingError, match="distance_m"):
        replace(preset("clean"), distance_m=(50.0, 20.0))
