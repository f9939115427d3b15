"""Common errors compared with brute force: the pose solved again with another calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import circle_planes, pose_on_plane
from kgcp.geometry.conic import fit_ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.systematic_errors import common_uncertainty, pose_by_calibration
from kgcp.targets.layout import Ring

CAMERA = Camera(1600, 1100, 2306.0, 2302.0, 792.6, 543.9, -0.072, 0.055, 4e-4, -3e-4)
RING = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
RADIUS_M = 0.45
# Steps as large as good calibrations are unsure.
STEPS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy"), 0.2),
    **dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6"), 1e-3),
    **dict.fromkeys(("p1", "p2"), 1e-4),
}


def pose_at(x_px: float, y_px: float, distance_m: float, tilts_deg: tuple[float, float]) -> Pose:
    ray = np.append(CAMERA.undistort(np.array([[x_px, y_px]]))[0], 1.0)
    turn = Rotation.from_euler("xyz", [*tilts_deg, 70.0], degrees=True)
    return Pose(turn.as_matrix(), ray * distance_m / float(np.linalg.norm(ray)))


POSES = [
    pose_at(800.0, 540.0, 40.0, (25.0, -8.0)),
    pose_at(250.0, 850.0, 12.0, (-30.0, 15.0)),
    pose_at(1450.0, 130.0, 60.0, (10.0, 30.0)),
]


def solve_again(camera: Camera, pose: Pose) -> Pose:
    """Normal and centre of the pose that another camera gives for the image taken by CAMERA."""
    angles = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
    circle = RADIUS_M * np.column_stack((np.cos(angles), np.sin(angles)))
    seen = camera.undistort(CAMERA.project(pose.transform(circle)))
    planes = circle_planes(fit_ellipse(seen))
    poses = [pose_on_plane(plane, RADIUS_M, seen[0]) for plane in planes]
    return max(poses, key=lambda one: float(one.normal @ pose.normal))


def changes(name: str, pose: Pose) -> tuple[FloatArray, FloatArray]:
    """Changes of centre [m] and normal per unit of one parameter, by brute force."""
    step = STEPS[name]
    high, low = (
        solve_again(replace(CAMERA, **{name: getattr(CAMERA, name) + sign * step}), pose)
        for sign in (1.0, -1.0)
    )
    return (
        (high.translation_m - low.translation_m) / (2.0 * step),
        (high.normal - low.normal) / (2.0 * step),
    )


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", CALIBRATION_PARAMETERS)
def test_derivatives_of_the_pose_by_every_parameter_are_right(name: str, pose: Pose) -> None:
    column = CALIBRATION_PARAMETERS.index(name)
    follows = pose_by_calibration(CAMERA, RADIUS_M, pose)[:, column]
    by_centre, by_normal = changes(name, pose)
    # Changes below a hundredth of a pixel's effect are compared with that limit.
    least = 1e-2 * pose.distance_m / CAMERA.fx / STEPS[name]
    assert np.allclose(follows[:3], by_centre, rtol=0.01, atol=0.01 * least)
    turned = np.cross(follows[3:], pose.normal)
    tolerance = 0.02 * float(np.linalg.norm(by_normal)) + 1e-5 / STEPS[name]
    assert np.linalg.norm(turned - by_normal) < tolerance


def test_the_scatter_of_many_calibrations_is_the_common_deviation() -> None:
    pose = POSES[2]
    sd = {"fx": 0.5, "fy": 0.5, "cx": 0.8, "cy": 0.6, "k1": 5e-4, "p2": 5e-5}
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((400, len(sd))) * list(sd.values())
    noise[:, 1] = noise[:, 0] + 0.1 * noise[:, 1]  # fx and fy go together
    solved = [
        solve_again(
            replace(CAMERA, **{n: getattr(CAMERA, n) + e for n, e in zip(sd, errors, strict=True)}),
            pose,
        )
        for errors in noise
    ]
    mixing = np.eye(len(sd))
    mixing[1, :2] = 1.0, 0.1
    covariance = mixing @ np.diag(np.square(list(sd.values()))) @ mixing.T
    common = common_uncertainty(CAMERA, CalibrationCovariance.of(tuple(sd), covariance), RING, pose)
    assert common is not None
    distances = np.array([one.distance_m for one in solved])
    assert 0.9 < distances.std() / common.sd_distance_m < 1.1
    rays = np.array([one.translation_m / one.distance_m for one in solved])
    widest = np.sqrt(np.linalg.eigvalsh(np.cov(rays.T))[-1])
    assert 0.9 < 1e3 * widest / common.sd_direction_mrad < 1.1


def test_a_focal_error_is_the_same_share_of_the_distance() -> None:
    straight = Camera(1600, 1100, 2300.0, 2300.0, 800.0, 540.0)
    cov = CalibrationCovariance.of(("fx", "fy"), np.full((2, 2), 2.3**2))
    for tilts_deg in ((0.5, 0.0), (20.0, -5.0), (40.0, 10.0)):
        turn = Rotation.from_euler("xyz", [*tilts_deg, 20.0], degrees=True).as_matrix()
        common = common_uncertainty(straight, cov, RING, Pose(turn, np.array([0.0, 0.0, 50.0])))
        assert common is not None
        assert common.sd_distance_m == pytest.approx(0.050, rel=1e-3)
        assert common.sd_direction_mrad < 1e-3


def test_a_shifted_principal_point_turns_the_direction() -> None:
    cov = CalibrationCovariance.of(("cx",), np.array([[1.5**2]]))
    common = common_uncertainty(CAMERA, cov, RING, POSES[0])
    assert common is not None
    assert common.sd_direction_mrad == pytest.approx(1e3 * 1.5 / CAMERA.fx, rel=0.01)
    assert common.sd_distance_m < 1e-3 * 0.05 * POSES[0].distance_m


def test_a_wrong_diameter_moves_the_target_along_its_ray() -> None:
    pose = POSES[1]
    common = common_uncertainty(CAMERA, None, replace(RING, sd_outer_diameter_m=0.0018), pose)
    assert common is not None
    assert common.sd_distance_m == pytest.approx(0.002 * pose.distance_m)
    assert common.sd_direction_mrad == pytest.approx(0.0, abs=1e-6)
    assert np.allclose(common.pose_cov[3:], 0.0)


def test_both_effects_add_up_and_are_none_if_nothing_is_stated() -> None:
    pose = POSES[2]
    cov = CalibrationCovariance.of(("fx", "fy"), np.diag([1.0, 1.0]))
    ring = replace(RING, sd_outer_diameter_m=0.0005)
    parts = [
        common_uncertainty(CAMERA, cov, RING, pose),
        common_uncertainty(CAMERA, None, ring, pose),
    ]
    both = common_uncertainty(CAMERA, cov, ring, pose)
    assert both is not None
    assert np.allclose(both.pose_cov, sum(one.pose_cov for one in parts if one is not None))
    assert common_uncertainty(CAMERA, None, RING, pose) is None
