"""Poses of frames from points of known position: wrong names, planes, points behind the camera."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.ground.orient import Setup, measure
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.resection import CameraPose, NoPoseError, PointImages, orient

CAMERA = Camera(1600, 1200, 2300.0, 2300.0, 803.2, 596.1, k1=-0.05)
POSE = CameraPose(
    np.array([6.0, -4.0, 28.0]),
    rotation_about(np.array([0.1, 0.2, 0.3]))
    @ rotation_about(np.array([0.0, 0.0, 0.7]))
    @ np.diag([1.0, -1.0, -1.0]),
)


def images_of(points: FloatArray, seen: FloatArray | None = None) -> PointImages:
    """Exact images without distances; `seen` are the points that are seen under these names."""
    count = len(points)
    pixels = CAMERA.project(POSE.in_camera(points if seen is None else seen))
    unknown = np.full(count, np.nan)
    return PointImages(
        points,
        np.zeros((count, 3, 3)),
        pixels,
        np.repeat(0.02**2 * np.eye(2)[None], count, axis=0),
        unknown,
        unknown,
    )


def test_most_poses_are_right_though_a_third_of_the_names_is_wrong() -> None:
    outcome = measure(Setup(points=8, has_distance=False, frames=6, seed=3))
    assert outcome.wrong == 0
    assert outcome.refused <= 1
    assert 0.6 < float(np.sqrt(np.mean(outcome.z**2))) < 1.4


def test_flat_points_with_posts_are_never_behind_the_camera() -> None:
    rng = np.random.default_rng(5)
    flat = np.column_stack((rng.uniform(-6.0, 6.0, (12, 2)), np.zeros(12)))
    posts = np.array([[-5.0, 4.0, 3.0], [5.0, 4.0, 2.5], [0.0, -4.0, 3.5]])
    found = orient(CAMERA, images_of(np.vstack((flat, posts))))
    assert found.is_used.all()
    np.testing.assert_allclose(found.pose.centre_m, POSE.centre_m, atol=1e-6)
    assert (found.pose.in_camera(np.vstack((flat, posts)))[:, 2] > 0.0).all()
    np.testing.assert_allclose(found.residuals[:, :2], 0.0, atol=1e-6)


def test_moved_points_are_left_out_with_their_residuals() -> None:
    points = np.random.default_rng(6).uniform(-6.0, 6.0, (7, 3)) * [1.0, 1.0, 0.2]
    seen = points.copy()
    seen[2] += [0.3, 0.0, 0.0]
    found = orient(CAMERA, images_of(points, seen))
    assert np.flatnonzero(~found.is_used).tolist() == [2]
    assert 10.0 < float(np.linalg.norm(found.residuals[2, :2])) < 40.0


def test_four_points_alone_must_fit_well() -> None:
    points = np.array(
        [[-5.0, -4.0, 0.0], [5.0, -4.0, 0.8], [5.0, 4.0, 0.0], [-5.0, 4.0, 3.0], [1.0, 0.5, 0.4]]
    )
    seen = points.copy()
    seen[2] += [0.0, 0.0015, 0.0]  # 0.12 px: within the limit of a point
    assert orient(CAMERA, images_of(points, seen)).is_used.all()
    assert orient(CAMERA, images_of(points[:4])).is_used.all()
    with pytest.raises(NoPoseError, match=r"must agree better \(χ² \d+ of 2\)"):
        orient(CAMERA, images_of(points[:4], seen[:4]))


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]), "2 known points"),
        (np.array([[-4.0, 0.0, 0.0], [4.0, 1.0, 0.0], [0.0, 3.0, 0.0]]), "3 of 3 points agree; 4"),
        (np.arange(5.0)[:, None] * [1.5, 0.5, 0.0], "no triple|hardly determine|fit alike"),
    ],
)
def test_too_little_is_no_pose(points: FloatArray, problem: str) -> None:
    with pytest.raises(NoPoseError, match=problem):
        orient(CAMERA, images_of(points))
