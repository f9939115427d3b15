"""Static targets placed by a camera that flies on while its rolling shutter reads the frames."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, ReferencePoses, opk_from_rotation
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.scene_rotation import CameraMotions, camera_motions
from kgcp.georef.sighting import Sighting
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.network.ground.point_images import CameraPose
from kgcp.network.ground.target_places import PlacedTarget, place_targets
from kgcp.targets.layout import Ring, Target
from tests.ground_flight import CAMERA as GLOBAL_CAMERA
from tests.ground_flight import GroundFlight

CAMERA = replace(GLOBAL_CAMERA, readout_s=0.03)
HEIGHT_M, FRAMES = 28.0, 19
SDS = np.array([1e-4, 1e-4, 3e-3, 2e-4, 2e-4, 1e-3])  # of poses [m] and [rad]
VIBRATION_RAD_S = math.radians(1.0)
TARGET = Target(Ring("A", 0.9, 0.45, 0.64, 0.13, (0.0, 43.0, 78.0, 180.0)))


def strip(speed_m_s: float, rng: np.random.Generator) -> tuple[GroundFlight, FloatArray]:
    """A flight along the rows of its frames, over one target, and the times of its frames [s]."""
    flight = GroundFlight(names=("A",), offsets_m=np.array([[0.4, 0.3, 0.0]]), frames=FRAMES)
    along_m = np.linspace(-6.0, 6.0, FRAMES)
    time_s = along_m / speed_m_s
    flight.centres = np.column_stack(
        (along_m, 0.5 * np.sin(0.3 * along_m), np.full(FRAMES, HEIGHT_M))
    )
    down = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    sway = 0.03 * np.sin(np.outer(1.5 * time_s, [1.0, 1.3, 0.7]) + rng.uniform(0.0, 6.0, 3))
    flight.rotations = np.array([rotation_about(each) @ down for each in sway])
    return flight, time_s


def sightings_of(
    flight: GroundFlight, time_s: FloatArray, rng: np.random.Generator
) -> list[Sighting]:
    """The target's pose in each frame at the moment of its row, between the frames' own poses."""
    made = []
    for row in range(1, FRAMES - 1):
        span_s = float(time_s[row + 1] - time_s[row - 1])
        turn = Rotation.from_matrix(flight.rotations[row + 1] @ flight.rotations[row - 1].T)
        motion = np.append(flight.centres[row + 1] - flight.centres[row - 1], turn.as_rotvec())
        motion /= span_s
        motion[3:] += VIBRATION_RAD_S * rng.standard_normal(3)
        start = CameraPose(flight.centres[row], flight.rotations[row])
        pose = flight.pose(row, 0)
        for _ in range(3):  # the row depends on the motion
            delay_s = float(CAMERA.delay_s(CAMERA.project(pose.translation_m[None]))[0])
            at_row = start.moved(delay_s * motion)
            sight_m = at_row.in_camera(flight.positions[:1])[0]
            world_from_target = start.world_from_camera @ flight.pose(row, 0).rotation
            pose = Pose(at_row.world_from_camera.T @ world_from_target, sight_m)
        pose = pose.moved(SDS * rng.standard_normal(6))
        made.append(
            Sighting(
                frame=flight.frame_names[row],
                number=row + 1,
                target="A",
                instance=0,
                time_s=float(time_s[row]),
                centre_px=CAMERA.project(pose.translation_m[None])[0],
                centre_cov_px2=np.eye(2) * 1e-4,
                distance_m=pose.distance_m,
                sd_distance_m=3e-3,
                sd_common_distance_m=None,
                pose=pose,
                pose_cov=np.diag(SDS**2),
            )
        )
    return made


def reference(flight: GroundFlight) -> ReferencePoses:
    on_map = flight.local_frame.map_from_enu(flight.centres)
    to_map = np.swapaxes(flight.local_frame.grid_rotation(flight.centres), 1, 2)
    angles = opk_from_rotation(to_map @ flight.rotations @ CAMERA_FROM_PHOTO)
    return ReferencePoses(flight.frame_names, on_map, angles, None, None)


def placed(
    flight: GroundFlight, sightings: list[Sighting], motions: CameraMotions | None
) -> PlacedTarget:
    placement = place_targets(
        sightings,
        [TARGET],
        reference(flight),
        flight.local_frame,
        CAMERA,
        None,
        min_frames=3,
        has_exact_poses=False,
        motions=motions,
    )
    (target,) = placement.targets
    return target


def motions_of(flight: GroundFlight, time_s: FloatArray) -> CameraMotions:
    exterior = ExteriorOrientations.of(reference(flight), flight.local_frame)
    return camera_motions(
        time_s,
        exterior.centre_m,
        exterior.enu_from_camera,
        [None] * FRAMES,
        SceneRotation.unknown(CAMERA),
        HEIGHT_M,
    )


def test_a_camera_that_flies_on_does_not_lift_the_targets() -> None:
    """At 8 m/s, heights would be wrong by half a metre, and many stated to a centimetre."""
    rng, z, heights_m = np.random.default_rng(4), [], []
    neglected: list[float] = []
    for _ in range(10):
        flight, time_s = strip(8.0, rng)
        sightings = sightings_of(flight, time_s, rng)
        target = placed(flight, sightings, motions_of(flight, time_s))
        error_m = target.position_map - flight.positions_map[0]
        heights_m.append(error_m[2])
        z.append(
            [*(error_m / target.sds[:3]), target.check.diameter_residual_m / target.sd_diameter_m]
        )
        if len(neglected) < 3:
            without = placed(flight, sightings, None)
            off_m = without.position_map[2] - flight.positions_map[0][2]
            neglected.append(off_m / without.sds[2])
    assert float(np.max(np.abs(neglected))) > 30.0
    assert float(np.abs(heights_m).max()) < 0.03
    assert 0.6 < float(np.sqrt(np.mean(np.square(z)))) < 1.3


def test_unknown_motion_has_a_deviation_common_to_all_frames() -> None:
    """A camera that moves with `motion_sd_deg_s` displaces heights by about one deviation."""
    rng, z = np.random.default_rng(5), []
    for _ in range(6):
        flight, time_s = strip(HEIGHT_M * math.radians(CAMERA.motion_sd_deg_s), rng)
        sightings = sightings_of(flight, time_s, rng)
        motions = motions_of(flight, np.full(FRAMES, math.nan))
        assert not motions.is_observed.any()
        target = placed(flight, sightings, motions)
        z.append((target.position_map - flight.positions_map[0])[2] / target.sds[2])
    assert 0.7 < float(np.mean(np.abs(z))) < 1.3
