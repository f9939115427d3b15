"""Poses of frames from points of known position: wrong names, planes, points behind the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.ground.orient import Setup, measure
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.point_images import CameraPose, PointImages
from kgcp.network.ground.resection import NoPoseError, orient

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


def test_most_poses_are_right_with_a_third_of_wrong_names() -> None:
    outcome = measure(Setup(points=8, has_distance=False, frames=6, seed=3))
    assert outcome.wrong == 0
    assert outcome.refused.total() <= 1
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


def test_a_common_scale_of_distances_is_found_beside_a_wrong_name() -> None:
    points = np.random.default_rng(6).uniform(-6.0, 6.0, (6, 3)) * [1.0, 1.0, 0.2]
    seen = points.copy()
    seen[[1, 4]] = seen[[4, 1]]
    images = images_of(points, seen)
    distances_m = 1.004 * np.linalg.norm(POSE.in_camera(seen), axis=1)
    images = replace(images, distances_m=distances_m, sd_distances_m=5e-5 * distances_m)
    found = orient(CAMERA, replace(images, sd_scale=0.005))
    assert np.flatnonzero(~found.is_used).tolist() == [1, 4]
    assert found.distance_scale == pytest.approx(np.log(1.004), abs=2e-4)
    off = found.pose.centre_m - POSE.centre_m
    z = off / np.sqrt(found.cov.diagonal()[:3])
    assert np.abs(z).max() < 0.5  # the prior draws the scale slightly towards 0
    known = orient(CAMERA, replace(images, distances_m=distances_m / 1.004))
    assert np.linalg.norm(known.pose.centre_m - POSE.centre_m) < 1e-6
    assert known.distance_scale == 0.0
    assert known.cov[2, 2] < 0.5 * found.cov[2, 2]


ROUGH = np.array(
    [[-5.0, -4.0, 0.0], [5.0, -4.0, 0.8], [5.0, 4.0, 0.0], [-5.0, 4.0, 3.0], [1.0, 0.5, 0.4]]
)


def misfitting(images: PointImages, chi2: float) -> PointImages:
    """The same points, the third so far off that all together have this χ²."""

    def displaced(off_px: float) -> PointImages:
        pixels = images.pixels.copy()
        pixels[2, 1] += off_px
        return replace(images, pixels=pixels)

    off_px = 0.002
    for wanted in (2.0, 6.0, chi2):  # it is nearly a square
        now = float(np.sum(orient(CAMERA, displaced(off_px)).chi2))
        off_px *= np.sqrt(wanted / now)
    return displaced(off_px)


@pytest.mark.parametrize(
    ("count", "distances", "most_chi2"),
    [
        (4, 0, 9.21),  # two numbers check the pose: 1 % of right ones have more
        (5, 0, None),  # from three on, the limit is that of single points
        (4, 1, None),
    ],
)
def test_the_limit_of_chi2_is_stricter_with_few_redundant_observations(
    count: int, distances: int, most_chi2: float | None
) -> None:
    images = images_of(ROUGH[:count])
    known = np.where(np.arange(count) < distances, 1.0, np.nan)
    distances_m = known * np.linalg.norm(POSE.in_camera(ROUGH[:count]), axis=1)
    images = replace(images, distances_m=distances_m, sd_distances_m=5e-4 * distances_m)
    for chi2 in (8.8, 9.6):
        wrong = misfitting(images, chi2)
        if most_chi2 is None or chi2 < most_chi2:
            found = orient(CAMERA, wrong)
            assert found.is_used.all()
            assert float(np.sum(found.chi2)) == pytest.approx(chi2, rel=0.03)
        else:
            with pytest.raises(NoPoseError, match=r"χ² \d+ of 2"):
                orient(CAMERA, wrong)


def test_deviations_are_right_for_points_nearly_in_a_line() -> None:
    """The rotation about the line is known to some degrees, which moves the camera along an arc."""
    rng = np.random.default_rng(8)
    squares = []
    for _ in range(60):
        along = rng.uniform(-7.0, 7.0, 3)[:, None] * [0.8, 0.6, 0.0]
        points = along + rng.normal(0.0, 0.3, 3)[:, None] * [-0.6, 0.8, 0.0]
        exact = images_of(points)
        distances_m = np.linalg.norm(POSE.in_camera(points), axis=1)
        images = replace(
            exact,
            pixels=exact.pixels + 0.1 * rng.standard_normal((3, 2)),
            pixel_cov=25.0 * exact.pixel_cov,
            distances_m=distances_m * (1.0 + 5e-4 * rng.standard_normal(3)),
            sd_distances_m=5e-4 * distances_m,
        )
        try:
            found = orient(CAMERA, images, min_points=3)
        except NoPoseError:
            continue
        turn = found.pose.world_from_camera @ POSE.world_from_camera.T
        odd = 0.5 * (turn - turn.T)
        error = np.array([*(found.pose.centre_m - POSE.centre_m), odd[2, 1], odd[0, 2], odd[1, 0]])
        if np.linalg.eigvalsh(found.cov[3:, 3:])[-1] > 0.02**2:
            squares.append(float(error @ np.linalg.solve(found.cov, error)))
    assert len(squares) > 12
    assert 3.0 < np.mean(squares) < 9.0
    assert max(squares) < 30.0


def test_a_plane_seen_from_the_front_has_two_possible_tilts() -> None:
    """In the 36th frame the mirrored pose is no solution of its own, but nearly as likely."""
    outcome = measure(Setup(points=5, has_distance=False, frames=36, seed=0))
    assert outcome.wrong == 0
    assert outcome.refused["the points hardly determine the pose"] >= 1
    assert len(outcome.z) > 28


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]), "2 known points"),
        (np.array([[-4.0, 0.0, 0.0], [4.0, 1.0, 0.0], [0.0, 3.0, 0.0]]), "3 of 3 points agree; 4"),
        (np.arange(5.0)[:, None] * [1.5, 0.5, 0.0], "no triple|hardly determine|fit alike"),
    ],
)
def test_too_few_points_give_no_pose(points: FloatArray, problem: str) -> None:
    with pytest.raises(NoPoseError, match=problem):
        orient(CAMERA, images_of(points))
