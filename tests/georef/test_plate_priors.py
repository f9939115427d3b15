"""Where the normal of a vehicle's plate points, by attitudes of camera and vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, ReferencePoses, rotation_from_opk
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.plate_priors import CameraAttitudes, normal_priors
from kgcp.georef.target_positions import Vehicle
from kgcp.georef.trajectory import Trajectory, body_to_ned
from kgcp.settings import VehicleSettings

DOWN = np.array([0.0, 0.0, 1.0])
CRS, ORIGIN = "EPSG:25832", np.array([690000.0, 5335000.0, 500.0])
OPK_DEG = np.array([[4.0, -7.0, 130.0], [-20.0, 10.0, 3.0]])
POSES = ReferencePoses(("a", "b"), ORIGIN + np.zeros((2, 3)), OPK_DEG, None, np.array([0.5, 1.2]))
ATTITUDE_DEG = (3.0, -6.0, 200.0)


def vehicle(time_offset_s: float = 0.0) -> Vehicle:
    time_s = np.arange(10.0)
    position = ORIGIN + np.outer(time_s, [1.0, 2.0, 0.0])
    attitude = np.tile(ATTITUDE_DEG, (10, 1))
    sd_deg = np.tile([0.4, 0.3, 2.0], (10, 1))
    trajectory = Trajectory(time_s, position, attitude, None, sd_deg)
    settings = VehicleSettings(time_offset_s=time_offset_s)
    return Vehicle.on(trajectory, settings, LocalFrame.at(CRS, ORIGIN))


def test_the_normal_of_a_level_plate_follows_from_poses_or_from_the_plumb_camera() -> None:
    attitudes = CameraAttitudes(POSES, 4.0)
    a, c, b = normal_priors(["a", "c", "b"], [None] * 3, attitudes, None, 0.9)
    assert a is not None
    assert b is not None
    assert c is not None
    assert b.sd_deg == pytest.approx(1.5)
    assert c.sd_deg == pytest.approx(4.1)
    assert np.array_equal(c.direction_camera, DOWN)
    camera_from_map = CAMERA_FROM_PHOTO @ rotation_from_opk(OPK_DEG[0]).T
    assert np.allclose(a.direction_camera, camera_from_map @ -DOWN)
    assert normal_priors(["c"], [None], CameraAttitudes(POSES, None), None, 0.9) == [None]
    unsure = ReferencePoses(("a",), np.zeros((1, 3)), OPK_DEG[:1], None, None)
    (exact,) = normal_priors(["a"], [None], CameraAttitudes(unsure, None), None, 0.9)
    assert exact is not None
    assert exact.sd_deg == 0.9


def test_a_plate_not_stated_to_be_level_has_no_prior() -> None:
    assert normal_priors(["a"], [4.0], CameraAttitudes(POSES, None), None, None) == [None]
    without_poses = CameraAttitudes(None, None)
    assert normal_priors(["a"], [4.0], without_poses, vehicle(), None) == [None]


@pytest.mark.parametrize(("level_sd_deg", "mounted_sd_deg"), [(None, 3.0), (1.0, 1.0)])
def test_a_plate_on_a_vehicle_has_the_normal_of_the_vehicle(
    level_sd_deg: float | None, mounted_sd_deg: float
) -> None:
    attitudes = CameraAttitudes(POSES, None)
    outside, inside = normal_priors(
        ["a", "b"], [40.0, 4.0], attitudes, vehicle(time_offset_s=1.0), level_sd_deg
    )
    assert inside is not None
    # near its central meridian the grid's axes are those of the local level, to half a degree
    enu_from_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    roll, pitch, heading = (np.array(angle) for angle in ATTITUDE_DEG)
    down = enu_from_ned @ body_to_ned(roll, pitch, heading)[:, 2]
    camera_from_map = CAMERA_FROM_PHOTO @ rotation_from_opk(OPK_DEG[1]).T
    assert inside.direction_camera @ (camera_from_map @ down) > np.cos(np.radians(0.5))
    assert inside.sd_deg == pytest.approx(np.hypot(np.hypot(mounted_sd_deg, 1.2), 0.4))
    if level_sd_deg is None:
        assert outside is None
    else:
        assert outside is not None
        assert outside.sd_deg == pytest.approx(np.hypot(1.0, 0.5))
