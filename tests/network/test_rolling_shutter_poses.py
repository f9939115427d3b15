"""Poses of frames with a rolling shutter, whose rows are exposed at different camera positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.network.ground.field_pose import orient_by_field
from kgcp.network.ground.frame_motions import orient_moving
from kgcp.network.ground.frame_poses import UNSTATED_SCALE_SD, FramePose, orient_frames
from kgcp.network.ground.point_images import CameraMotion, CameraPose
from kgcp.network.ground.position_check import FastCamera, WrongPosition, wrong_input
from kgcp.targets.fields.points import AnyField
from tests.ground_flight import CAMERA as GLOBAL_CAMERA
from tests.ground_flight import GroundFlight
from tests.network import test_field_pose as fields

READOUT_S = 0.03
CAMERA = replace(GLOBAL_CAMERA, readout_s=READOUT_S)
SD_PX, SD_DISTANCE, SD_POSITION_M = 0.01, 2e-4, 0.002
SD_RAD_S = float(np.radians(CAMERA.motion_sd_deg_s))
NAMES = tuple("ABCDEF")
OFFSETS_M = np.array(
    [[-7, -5, 0], [7, -4.5, 0.5], [6.5, 5, -0.3], [-6, 5, 0.2], [0, -1.5, 0.4], [1, 2, 0]], float
)


def poses_at_rows(pose: CameraPose, motion: FloatArray, points_m: FloatArray) -> list[CameraPose]:
    """Where the camera is when each point is exposed: shift [m/s] and turn [rad/s] after `pose`."""
    poses = [pose] * len(points_m)
    for _ in range(3):  # the row depends on the motion
        seen = np.vstack(
            [each.in_camera(point[None]) for each, point in zip(poses, points_m, strict=True)]
        )
        delays_s = READOUT_S * (CAMERA.project(seen)[:, 1] / (CAMERA.height - 1) - 0.5)
        poses = [pose.moved(delay_s * motion) for delay_s in delays_s.tolist()]
    return poses


def sightings_of(
    flight: GroundFlight,
    row: int,
    motion: FloatArray,
    rng: np.random.Generator,
    names: Sequence[str] = NAMES,
) -> list[Sighting]:
    """The targets of one frame, each with its pose at the moment of its row."""
    start = CameraPose(flight.centres[row], flight.rotations[row])
    made = []
    for column, at_row in enumerate(poses_at_rows(start, motion, flight.positions)):
        if flight.names[column] not in names:
            continue
        sight_m = at_row.in_camera(flight.positions[column][None])
        pixel = CAMERA.project(sight_m)[0] + SD_PX * rng.standard_normal(2)
        distance_m = float(np.linalg.norm(sight_m)) * (1.0 + SD_DISTANCE * rng.standard_normal())
        turned = (
            at_row.world_from_camera.T @ flight.rotations[row] @ flight.pose(row, column).rotation
        )
        ray = np.append(CAMERA.undistort(pixel[None])[0], 1.0)
        made.append(
            Sighting(
                frame=flight.frame_names[row],
                number=row + 1,
                target=flight.names[column],
                instance=0,
                time_s=None,
                centre_px=pixel,
                centre_cov_px2=SD_PX**2 * np.eye(2),
                distance_m=distance_m,
                sd_distance_m=SD_DISTANCE * distance_m,
                sd_common_distance_m=None,
                pose=Pose(turned, distance_m * ray / np.linalg.norm(ray)),
                pose_cov=np.diag([1e-4, 1e-4, SD_DISTANCE * distance_m, *[2e-5] * 3]) ** 2,
            )
        )
    return made


def drawn_motion(rng: np.random.Generator) -> FloatArray:
    """Shift and rotation, each as fast as the camera's setting for the line of sight."""
    sds = np.repeat([29.0 * SD_RAD_S, SD_RAD_S], 3)
    return np.asarray(sds * rng.standard_normal(6))


def motion_by_rates(
    flight: GroundFlight, row: int, turn_rad_s: FloatArray, sd_rad_s: float
) -> CameraMotion:
    """What the camera's rates show where the camera turns in the world."""
    x, y, z = (-flight.rotations[row].T @ turn_rad_s).tolist()
    return CameraMotion(SceneRotation((x, y, z), sd_rad_s))


def error_of(found: FramePose, pose: CameraPose) -> FloatArray:
    """The six errors over their deviations."""
    assert found.pose is not None
    assert found.cov is not None
    turn = found.pose.world_from_camera @ pose.world_from_camera.T
    odd = 0.5 * (turn - turn.T)
    error = np.array([*(found.pose.centre_m - pose.centre_m), odd[2, 1], odd[0, 2], odd[1, 0]])
    return np.asarray(error / np.sqrt(np.diag(found.cov)))


def places_of(flight: GroundFlight, rng: np.random.Generator) -> dict[str, TargetPosition]:
    stated_m = flight.positions + SD_POSITION_M * rng.standard_normal(flight.positions.shape)
    cov_m2 = SD_POSITION_M**2 * np.eye(3)
    pairs = zip(flight.names, stated_m, strict=True)
    return {name: TargetPosition(place, cov_m2) for name, place in pairs}


@pytest.mark.parametrize("targets", [4, 6])
def test_deviations_cover_unknown_motion(targets: int) -> None:
    """Poses are those of the middle row; all targets agree and none is thought misplaced."""
    rng, z, off_px = np.random.default_rng(5), [], []
    for seed in range(2):
        flight = GroundFlight(NAMES[:targets], OFFSETS_M[:targets], frames=8, seed=seed)
        places = places_of(flight, rng)
        sightings = []
        for row in range(flight.frames):
            sightings += sightings_of(flight, row, drawn_motion(rng), rng)
        poses = orient_frames(flight.frame_names, sightings, places, CAMERA, sd_scale=0.0)
        for row, found in enumerate(poses):
            if found.pose is None:  # four points hardly determine some poses
                continue
            assert found.used == NAMES[:targets]
            z.append(error_of(found, CameraPose(flight.centres[row], flight.rotations[row])))
            assert found.residuals is not None
            off_px.append(np.abs(found.residuals[:, :2]).max())
        assert wrong_input(poses, sightings, places, CAMERA, UNSTATED_SCALE_SD) is None
    assert len(z) >= 14  # of six errors, of which about three are independent
    assert 0.74 < float(np.sqrt(np.mean(np.square(z)))) < 1.27  # 99 % of 48 values
    assert float(np.max(off_px)) < 1.0  # three pixels without the motion


def test_the_rates_of_a_hovering_camera_make_poses_more_certain() -> None:
    hovering = replace(CAMERA, motion_sd_deg_s=0.02 * CAMERA.motion_sd_deg_s)
    rng, z = np.random.default_rng(6), []
    with_rates: list[float] = []
    without_rates: list[float] = []
    for seed in range(4):  # the errors of positions are those of all frames
        flight = GroundFlight(NAMES[:5], OFFSETS_M[:5], frames=3, seed=seed)
        places = places_of(flight, rng)
        sightings, motions = [], {}
        for row, frame in enumerate(flight.frame_names):
            turn = 2.0 * SD_RAD_S * rng.standard_normal(3)
            sightings += sightings_of(flight, row, np.append(np.zeros(3), turn), rng)
            motions[frame] = motion_by_rates(flight, row, turn, 0.02 * SD_RAD_S)
        # without rates, half of the flights are enough: their deviations are nearly the same
        for known in ({}, motions) if seed < 2 else (motions,):
            camera = hovering if known else CAMERA
            poses = orient_frames(
                flight.frame_names, sightings, places, camera, sd_scale=0.0, motions=known
            )
            assert all(found.cov is not None for found in poses)
            sds = with_rates if known else without_rates
            sds += [np.sqrt(found.cov[4, 4]) for found in poses if found.cov is not None]
        z += [
            error_of(found, CameraPose(flight.centres[row], flight.rotations[row]))
            for row, found in enumerate(poses)
        ]
    assert float(np.median(with_rates)) < 0.7 * float(np.median(without_rates))
    assert 0.7 < float(np.sqrt(np.mean(np.square(z)))) < 1.3


def test_rates_do_not_show_how_the_camera_shifts() -> None:
    """With them, poses of a camera that flew on were off by six standard deviations in height."""
    rng, z = np.random.default_rng(11), []
    for seed in range(4):
        flight = GroundFlight(NAMES[:5], OFFSETS_M[:5], frames=3, seed=seed)
        places = places_of(flight, rng)
        sightings, motions = [], {}
        for row, frame in enumerate(flight.frame_names):
            motion = SD_RAD_S * np.repeat([29.0, 2.0], 3) * rng.standard_normal(6)
            sightings += sightings_of(flight, row, motion, rng)
            motions[frame] = motion_by_rates(flight, row, motion[3:], 0.02 * SD_RAD_S)
        poses = orient_frames(
            flight.frame_names, sightings, places, CAMERA, sd_scale=0.0, motions=motions
        )
        z += [
            error_of(found, CameraPose(flight.centres[row], flight.rotations[row]))
            for row, found in enumerate(poses)
        ]
    assert 0.7 < float(np.sqrt(np.mean(np.square(z)))) < 1.3


@pytest.mark.parametrize("has_rates", [False, True])
def test_a_single_ring_is_exposed_at_its_own_row(*, has_rates: bool) -> None:
    """Its pose is converted to the middle row if the camera's rates are known."""
    shift_sd_m_s = 29.0 * SD_RAD_S
    rng, z = np.random.default_rng(7), []
    for seed in range(8):
        flight = GroundFlight(NAMES[:4], OFFSETS_M[:4], frames=4, seed=seed)
        drawn = np.repeat([shift_sd_m_s, SD_RAD_S], 3) * rng.standard_normal((4, 6))
        motions = {
            frame: motion_by_rates(flight, row, drawn[row, 3:], 1e-4)
            for row, frame in enumerate(flight.frame_names)
        }
        sightings = []
        for row in range(4):
            names = NAMES[:1] if row == 3 else NAMES[:4]
            sightings += sightings_of(flight, row, drawn[row], rng, names)
        places = places_of(flight, rng)
        found = orient_frames(
            flight.frame_names,
            sightings,
            places,
            CAMERA,
            sd_scale=0.0,
            motions=motions if has_rates else {},
        )[3]
        assert found.is_by_one_ring
        z.append(error_of(found, CameraPose(flight.centres[3], flight.rotations[3])))
    assert 0.4 < float(np.sqrt(np.mean(np.square(z)))) < 1.2


def flown_on(
    seed: int, speed_m_s: float, *, has_times: bool
) -> tuple[GroundFlight, list[Sighting], dict[str, TargetPosition]]:
    """Frames of a camera that flies on steadily, and stated positions."""
    rng = np.random.default_rng(seed)
    flight = GroundFlight(NAMES, OFFSETS_M, frames=8, seed=seed)
    sightings = []
    for row in range(flight.frames):
        flight.centres[row] = [0.0, 0.8 * (row - 3.5), 28.0]
        tilt = rotation_about(0.03 * rng.standard_normal(3))
        flight.rotations[row] = tilt @ np.diag([1.0, -1.0, -1.0])  # rows are read along the flight
        motion = np.array([0.0, speed_m_s, 0.0, 0.0, 0.0, 0.0])
        time_s = 0.8 / speed_m_s * row if has_times else None
        sightings += [
            replace(each, time_s=time_s) for each in sightings_of(flight, row, motion, rng)
        ]
    return flight, sightings, places_of(flight, rng)


def test_poses_and_times_show_a_camera_that_flies_on() -> None:
    """Without that, the height was off, and a position or the focal length seemed wrong."""
    flight, sightings, places = flown_on(2, 16.0, has_times=True)
    poses, motions = orient_moving(flight.frame_names, sightings, places, CAMERA)
    assert wrong_input(poses, sightings, places, CAMERA, UNSTATED_SCALE_SD, motions) is None
    z = [
        error_of(found, CameraPose(flight.centres[row], flight.rotations[row]))
        for row, found in enumerate(poses)
    ]
    assert 0.4 < float(np.sqrt(np.mean(np.square(z)))) < 1.3


def test_poses_far_apart_do_not_show_the_motion() -> None:
    rng = np.random.default_rng(4)
    flight = GroundFlight(NAMES[:5], OFFSETS_M[:5], frames=8, seed=4)
    sightings = [
        replace(each, time_s=1.0 * row)
        for row in range(flight.frames)
        for each in sightings_of(flight, row, drawn_motion(rng), rng)
    ]
    _, motions = orient_moving(flight.frame_names, sightings, places_of(flight, rng), CAMERA)
    assert not motions


def test_unknown_motion_may_explain_what_contradicts_a_position() -> None:
    flight, sightings, places = flown_on(2, 16.0, has_times=False)
    poses, motions = orient_moving(flight.frame_names, sightings, places, CAMERA)
    assert not motions
    found = wrong_input(poses, sightings, places, CAMERA, UNSTATED_SCALE_SD, motions)
    assert isinstance(found, FastCamera)
    off_m = places["C"].position_m + np.array([0.0, 0.0, 0.3])
    places["C"] = replace(places["C"], position_m=off_m)
    off = wrong_input(poses, sightings, places, CAMERA, UNSTATED_SCALE_SD, motions)
    assert isinstance(off, WrongPosition)


@pytest.mark.parametrize("field", [fields.BOARD, fields.POSTS], ids=["board", "posts"])
def test_poses_from_fields_allow_for_a_moving_camera(field: AnyField) -> None:
    rng, z = np.random.default_rng(8), []
    rolling = replace(fields.CAMERA, readout_s=READOUT_S)
    for _ in range(5):
        pose = fields.drawn_pose(rng)
        which, moments, covs = fields.images(field, pose, rng)
        motion = np.repeat([0.45 * SD_RAD_S, SD_RAD_S], 3) * rng.standard_normal(6)
        delays_s = READOUT_S * (moments[:, 1] / (rolling.height - 1) - 0.5)
        still = fields.CAMERA.project(pose.in_camera(field.points_m()))
        for index, point in enumerate(field.points_m()):
            moved = pose.moved(delays_s[index] * motion).in_camera(point[None])
            moments[index, :2] += fields.CAMERA.project(moved)[0] - still[index]
        z.append(fields.error_of(orient_by_field(rolling, field, which, moments, covs), pose))
    assert 0.6 < float(np.sqrt(np.mean(np.square(z)))) < 1.3
