"""Displacement of poses by rotations during the readout: single ones, and their mean square."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.plate import circles_of
from kgcp.measurement.image_model.rotation_displacement import (
    mean_square_displacement,
    pose_displacements,
)
from kgcp.simulation.flight import TARGET_PLATE

CIRCLES = circles_of((TARGET_PLATE.target.ring,))
DELAY_S = 0.03 * 2300.0 / 1199.0  # a readout of 30 ms: per unit of a ray's y
SD_RAD_S = math.radians(5.0)


def facing(tilt_deg: float, direction_deg: float = 40.0, distance_m: float = 10.0) -> Pose:
    """Return a pose in an odd place, tilted against the ray to it."""
    centre_m = distance_m * np.array((0.12, -0.07, 1.0))
    to_centre = Rotation.align_vectors(centre_m[None], [(0.0, 0.0, 1.0)])[0]
    tilt = Rotation.from_rotvec(
        math.radians(tilt_deg)
        * np.array(
            (math.cos(math.radians(direction_deg)), math.sin(math.radians(direction_deg)), 0)
        )
    )
    turn = Rotation.from_euler("z", 27.0, degrees=True)
    return Pose((to_centre * tilt * turn).as_matrix(), centre_m)


def displaced(pose: Pose, off: FloatArray) -> Pose:
    return Pose(
        Rotation.from_rotvec(off[3:]).as_matrix() @ pose.rotation, pose.translation_m + off[:3]
    )


def drawn(pose: Pose, count: int) -> FloatArray:
    rotations = np.random.default_rng(4).normal(0.0, SD_RAD_S, (count, 3))
    return pose_displacements(pose, CIRCLES, DELAY_S, rotations)


def test_without_rotation_the_pose_is_unchanged() -> None:
    off = pose_displacements(facing(12.0), CIRCLES, DELAY_S, np.zeros((2, 3)))
    assert_allclose(off, 0.0, atol=1e-9)


def test_an_image_stretched_along_the_foreshortened_axis_seems_less_tilted() -> None:
    """A rotation about x stretches columns by ε: cos θ grows by that share, the distance stays."""
    tilt = math.radians(30.0)
    turn = Rotation.from_rotvec([tilt, 0.0, 0.0])
    pose = Pose(turn.as_matrix(), np.array((0.0, 0.0, 200.0)))
    rate_rad_s = 1e-3
    (off,) = pose_displacements(pose, CIRCLES, DELAY_S, np.array([[rate_rad_s, 0.0, 0.0]]))
    stretch = rate_rad_s * DELAY_S
    assert_allclose(off[3:], (-stretch / math.tan(tilt), 0.0, 0.0), rtol=0.02, atol=0.02 * stretch)
    assert abs(off[2]) < 0.02 * stretch * 200.0


@pytest.mark.parametrize("tilt_deg", [8.0, 15.0, 30.0])
def test_correcting_a_known_rotation_restores_the_true_pose(tilt_deg: float) -> None:
    """From the pose measured without the rotation to the true one."""
    pose = facing(tilt_deg)
    rotation = np.array([[0.08, -0.06, 0.05]])
    measured = displaced(pose, pose_displacements(pose, CIRCLES, DELAY_S, -rotation)[0])
    (back,) = pose_displacements(measured, CIRCLES, DELAY_S, rotation)
    returned = displaced(measured, back)
    apart_m = float(np.linalg.norm(measured.translation_m - pose.translation_m))
    left_m = float(np.linalg.norm(returned.translation_m - pose.translation_m))
    tilted = np.linalg.norm(measured.rotation[:, 2] - pose.rotation[:, 2])
    left_tilted = np.linalg.norm(returned.rotation[:, 2] - pose.rotation[:, 2])
    assert left_m < 0.05 * apart_m
    assert left_tilted < 0.05 * tilted


@pytest.mark.parametrize("tilt_deg", [4.0, 9.0, 30.0])
def test_the_mean_square_is_that_of_many_rotations(tilt_deg: float) -> None:
    pose = facing(tilt_deg)
    off = drawn(pose, 1500)  # which know a deviation to 2 to 3 %
    expected = off.T @ off / len(off)
    stated = mean_square_displacement(pose, CIRCLES, DELAY_S, SD_RAD_S)
    sd = np.sqrt(np.diag(expected))
    assert_allclose(np.sqrt(np.diag(stated)), sd, rtol=0.12)
    assert_allclose(stated / np.outer(sd, sd), expected / np.outer(sd, sd), atol=0.25)


def test_first_derivatives_alone_understate_the_covariance() -> None:
    """The median of Mahalanobis distances shows it, for a plate that nearly faces the camera."""
    pose = facing(6.0)
    off = drawn(pose, 800)
    slopes = pose_displacements(pose, CIRCLES, DELAY_S, 1e-4 * np.eye(3)) / 1e-4
    noise = np.diag(np.array((1e-5, 1e-5, 2e-4, 4e-4, 4e-4, 1e-4)) ** 2)
    linear = SD_RAD_S**2 * slopes.T @ slopes + noise
    stated = mean_square_displacement(pose, CIRCLES, DELAY_S, SD_RAD_S) + noise
    by_slopes, by_squares = (
        float(np.median(np.sum(off * np.linalg.solve(cov, off.T).T, axis=1)))
        for cov in (linear, stated)
    )
    assert by_slopes > 10.0
    assert 1.0 < by_squares < 6.0


@pytest.mark.parametrize("tilt_deg", [0.0, 0.05, 1.0, 70.0])
@pytest.mark.parametrize("distance_m", [2.0, 300.0])
@pytest.mark.parametrize("sd_deg_s", [0.1, 5.0, 1000.0])
def test_any_plate_and_any_motion_have_a_covariance(
    tilt_deg: float, distance_m: float, sd_deg_s: float
) -> None:
    pose = facing(tilt_deg, distance_m=distance_m)
    stated = mean_square_displacement(pose, CIRCLES, DELAY_S, math.radians(sd_deg_s))
    assert np.isfinite(stated).all()
    assert np.sqrt(np.diag(stated)[3:]).max() < math.pi
    assert np.sqrt(np.diag(stated)[:3]).max() < distance_m
