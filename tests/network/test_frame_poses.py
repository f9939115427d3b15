"""Frames oriented by rings with individual errors of their printed diameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.frame_poses import orient_frames
from kgcp.network.ground.point_images import CameraPose
from tests.ground_flight import GroundFlight

CAMERA = Camera(1600, 1200, 2300.0, 2300.0, 803.2, 596.1, k1=-0.05)
POSE = CameraPose(
    np.array([6.0, -4.0, 28.0]),
    rotation_about(np.array([0.1, 0.2, 0.3])) @ np.diag([1.0, -1.0, -1.0]),
)
SD_PX, SD_DISTANCE, SD_POSITION_M = 0.005, 1e-4, 0.002


def sightings_of(
    stated_m: FloatArray, distances_m: FloatArray, pixels: FloatArray, sd_common: float
) -> list[Sighting]:
    """Return targets with a relative deviation of their distances that all frames share."""
    return [
        Sighting(
            frame="f",
            number=1,
            target=f"T{row}",
            instance=0,
            time_s=None,
            centre_px=pixels[row],
            centre_cov_px2=SD_PX**2 * np.eye(2),
            distance_m=distance_m,
            sd_distance_m=SD_DISTANCE * distance_m,
            sd_common_distance_m=sd_common * distance_m,
        )
        for row, distance_m in enumerate(distances_m.tolist()[: len(stated_m)])
    ]


@pytest.mark.parametrize("targets", [4, 6])
@pytest.mark.parametrize(("sd_own", "sd_alike"), [(0.001, 0.0), (0.0, 0.001)])
def test_individual_and_common_errors_of_prints_scatter_as_stated(
    targets: int, sd_own: float, sd_alike: float
) -> None:
    """Poses scatter as stated, however the stated deviation of the prints is shared out."""
    rng, z, used = np.random.default_rng(3), [], 0
    names = [f"T{index}" for index in range(targets)]
    for _ in range(12):
        stated_m = rng.uniform(-6.0, 6.0, (targets, 3)) * [1.0, 1.0, 0.1]
        seen = POSE.in_camera(stated_m + SD_POSITION_M * rng.standard_normal((targets, 3)))
        pixels = CAMERA.project(seen) + SD_PX * rng.standard_normal((targets, 2))
        distances_m = np.linalg.norm(seen, axis=1)
        distances_m = distances_m * (1.0 + SD_DISTANCE * rng.standard_normal(targets))
        distances_m = distances_m * (1.0 + sd_own * rng.standard_normal(targets))
        distances_m = distances_m * (1.0 + sd_alike * rng.standard_normal())
        sightings = sightings_of(stated_m, distances_m, pixels, max(sd_own, sd_alike))
        cov_m2 = SD_POSITION_M**2 * np.eye(3)
        places = (TargetPosition(place, cov_m2) for place in stated_m)
        positions = dict(zip(names, places, strict=True))
        (found,) = orient_frames(["f"], sightings, positions, CAMERA, sd_scale=0.0)
        if found.pose is None or found.cov is None:
            continue
        used += len(found.used)
        z.append((found.pose.centre_m - POSE.centre_m) / np.sqrt(found.cov.diagonal()[:3]))
    assert used >= 0.95 * 12 * targets
    assert 0.5 < float(np.sqrt(np.mean(np.square(z)))) < 1.3


@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_diameters_off_by_half_are_reported_even_with_an_unknown_focal_length(wrong: float) -> None:
    """Positions and images determine the focal length; distances were measured with a wrong one."""
    camera = replace(CAMERA, fx=wrong * CAMERA.fx, fy=wrong * CAMERA.fy, k1=wrong**2 * CAMERA.k1)
    places_m = np.array([[-4, -3, 0], [4, -3, 2.5], [4, 3, -2], [-4, 3, 2], [0, 1, -1.5]], float)
    seen = POSE.in_camera(places_m)
    distances_m = 0.5 * wrong * np.linalg.norm(seen, axis=1)
    sightings = sightings_of(places_m, distances_m, CAMERA.project(seen), 0.0)
    cov_m2 = 0.001**2 * np.eye(3)
    positions = {f"T{row}": TargetPosition(each, cov_m2) for row, each in enumerate(places_m)}
    (found,) = orient_frames(["f"], sightings, positions, camera, has_free_focal=True)
    assert found.pose is None
    assert "the distances are 50 % shorter than the positions say" in found.reason


def test_a_print_accuracy_in_sightings_and_flight_counts_once() -> None:
    """Targets near each other: their measured distances determine the camera's distance."""
    offsets_m = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.2, 0.0]])
    seen = POSE.in_camera(offsets_m)
    distances_m = np.linalg.norm(seen, axis=1)
    sightings = sightings_of(offsets_m, distances_m, CAMERA.project(seen), 0.002)
    cov_m2 = 0.01**2 * np.eye(3)
    positions = {f"T{row}": TargetPosition(each, cov_m2) for row, each in enumerate(offsets_m)}
    found = [
        orient_frames(["f"], sightings, positions, CAMERA, sd_scale=sd_scale)[0]
        for sd_scale in (0.0, 0.002, 0.004)
    ]
    sight = POSE.centre_m / np.linalg.norm(POSE.centre_m)
    sds = [
        float(np.sqrt(sight @ each.cov[:3, :3] @ sight)) for each in found if each.cov is not None
    ]
    assert sds[0] == pytest.approx(0.002 * np.linalg.norm(POSE.centre_m), rel=0.3)
    assert sds[1] == pytest.approx(sds[0], rel=1e-9)
    assert sds[2] > 1.4 * sds[0]


@pytest.mark.parametrize(
    ("sd_scale", "sd_common"), [(0.002, 0.0), (0.002, 0.002), (0.002, 0.001), (0.001, 0.002)]
)
def test_a_single_ring_uses_the_larger_of_both_stated_deviations(
    sd_scale: float, sd_common: float
) -> None:
    """The accuracy of a print counts once, even if sighting and flight both state it."""
    flight = GroundFlight(frames=5)
    sd = max(sd_scale, sd_common)
    sightings = []
    for row, frame in enumerate(flight.frame_names):
        for column, name in enumerate(flight.names[: 1 if row == 4 else 4]):
            pose = flight.pose(row, column)
            scale = 1.0 + sd if row == 4 else 1.0  # off by one deviation
            pose = Pose(pose.rotation, scale * pose.translation_m)
            common = np.zeros((6, 6))
            common[:3, :3] = sd_common**2 * np.outer(pose.translation_m, pose.translation_m)
            sightings.append(
                Sighting(
                    frame=frame,
                    number=row + 1,
                    target=name,
                    instance=0,
                    time_s=None,
                    centre_px=CAMERA.project(pose.translation_m[None])[0],
                    centre_cov_px2=SD_PX**2 * np.eye(2),
                    distance_m=pose.distance_m,
                    sd_distance_m=SD_DISTANCE * pose.distance_m,
                    sd_common_distance_m=sd_common * pose.distance_m,
                    pose=pose,
                    pose_cov=np.diag([1e-4**2] * 3 + [1e-5**2] * 3),
                    common_pose_cov=common,
                )
            )
    places = {
        name: TargetPosition(place, None)
        for name, place in zip(flight.names, flight.positions, strict=True)
    }
    poses = orient_frames(flight.frame_names, sightings, places, CAMERA, sd_scale=sd_scale)
    found = poses[4]
    assert found.is_by_one_ring
    assert found.pose is not None
    assert found.cov is not None
    sight = flight.positions[0] - flight.centres[4]
    sight /= np.linalg.norm(sight)
    off_m = -sight @ (found.pose.centre_m - flight.centres[4])
    assert off_m / np.sqrt(sight @ found.cov[:3, :3] @ sight) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("frames", "flights"), [(5, 7), (9, 8)])
def test_a_single_ring_has_the_position_errors_common_to_all_frames(
    frames: int, flights: int
) -> None:
    """More frames do not reduce the error of its position due to other misplaced targets."""
    rng, z = np.random.default_rng(9), []
    for seed in range(flights):
        flight = GroundFlight(frames=frames, seed=seed)
        sightings = [
            measured_ring(flight, row, column, rng)
            for row in range(frames)
            for column in range(1 if row == frames - 1 else 4)
        ]
        stated_m = flight.positions + SD_POSITION_M * rng.standard_normal((4, 3))
        cov_m2 = SD_POSITION_M**2 * np.eye(3)
        places = {
            name: TargetPosition(place, cov_m2)
            for name, place in zip(flight.names, stated_m, strict=True)
        }
        found = orient_frames(flight.frame_names, sightings, places, CAMERA, sd_scale=0.0)[-1]
        assert found.pose is not None
        assert found.cov is not None
        assert found.is_by_one_ring
        turn = found.pose.world_from_camera @ flight.rotations[-1].T
        odd = 0.5 * (turn - turn.T)
        error = [*(found.pose.centre_m - flight.centres[-1]), odd[2, 1], odd[0, 2], odd[1, 0]]
        z.append(np.array(error) / np.sqrt(np.diag(found.cov)))
    # 95 % of 21 values: of the six errors of 7 flights, about three are independent
    assert 0.7 < float(np.sqrt(np.mean(np.square(z)))) < 1.3


def measured_ring(
    flight: GroundFlight, row: int, column: int, rng: np.random.Generator
) -> Sighting:
    """A ring's pose with noise of its covariance."""
    true = flight.pose(row, column)
    sds = np.array([*[2e-4] * 2, SD_DISTANCE * true.distance_m, *[2e-5] * 3])
    pose = true.moved(sds * rng.standard_normal(6))
    return Sighting(
        frame=flight.frame_names[row],
        number=row + 1,
        target=flight.names[column],
        instance=0,
        time_s=None,
        centre_px=CAMERA.project(pose.translation_m[None])[0],
        centre_cov_px2=(CAMERA.fx * 2e-4 / true.distance_m) ** 2 * np.eye(2),
        distance_m=pose.distance_m,
        sd_distance_m=SD_DISTANCE * true.distance_m,
        sd_common_distance_m=None,
        pose=pose,
        pose_cov=np.diag(sds**2),
    )
