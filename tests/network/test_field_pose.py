"""Photographs of fields, in the fields' own frame: against the poses they were projected by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_images, plane_axes
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.field_pose import FieldPose, orient_by_field
from kgcp.network.ground.point_images import CameraPose
from kgcp.network.ground.resection import NoPoseError
from kgcp.targets.fields.layout import Field, GridKind, Mark
from kgcp.targets.fields.points import AnyField, FieldPoint, PointField

CAMERA = Camera(1200, 900, 1500.0, 1500.0, 603.0, 447.0, k1=-0.1)
BOARD = Field(
    "board",
    GridKind.SQUARE,
    columns=7,
    rows=5,
    pitch_m=0.03,
    diameter_m=0.018,
    marks=(Mark(1, 1, 0.018, 0.007),),
    flat_sd_m=(1e-6, 1e-6, 1e-6),
)
POSTS = PointField(
    "posts",
    tuple(
        FieldPoint(f"p{i}", (0.05 * (i % 4), 0.06 * (i // 4), 0.03 * (i % 3)), 0.02)
        for i in range(12)
    ),
    flat_sd_m=(1e-6, 1e-6, 1e-6),
)
SD_PX = 0.02


def images(
    field: AnyField, pose: CameraPose, rng: np.random.Generator, beyond_px: float = 0.0
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """Moments of all discs, with noise, which may exceed their covariances."""
    focal = pose.focal_scale
    camera = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)
    camera = replace(camera, k1=CAMERA.k1 * focal**2)  # the lens is that of the image
    axes = pose.world_from_camera.T @ plane_axes(field.normals())
    circles = Circles3D(pose.in_camera(field.points_m()), axes, field.radii_m())
    moments = circle_images(camera, circles).moments
    sd_px = np.hypot(SD_PX, beyond_px)
    moments[:, :2] += sd_px * rng.standard_normal((len(moments), 2))
    covs = np.repeat(SD_PX**2 * np.eye(5)[None], len(moments), axis=0)
    return np.arange(len(moments)), moments, covs


def drawn_pose(rng: np.random.Generator, focal_scale: float = 1.0) -> CameraPose:
    """A view from half a metre, tilted by 35°."""
    azimuth, turn = rng.uniform(0.0, 2.0 * np.pi, 2)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    rotation = rotation_about(0.6 * axis) @ rotation_about(np.array([0.0, 0.0, turn]))
    middle = np.array([0.08, 0.06, 0.0])
    return CameraPose(middle - 0.45 * rotation[:, 2], rotation, focal_scale)


def error_of(found: FieldPose, pose: CameraPose) -> FloatArray:
    """The six errors over their deviations."""
    turn = found.pose.world_from_camera @ pose.world_from_camera.T
    odd = 0.5 * (turn - turn.T)
    error = np.array([*(found.pose.centre_m - pose.centre_m), odd[2, 1], odd[0, 2], odd[1, 0]])
    return np.asarray(error / np.sqrt(np.diag(found.cov)[:6]))


@pytest.mark.parametrize(
    ("field", "beyond_px"),
    [(BOARD, 0.0), (POSTS, 0.0), (POSTS, 0.1)],
    ids=["board", "posts", "posts beyond"],
)
def test_poses_are_as_accurate_as_stated(field: AnyField, beyond_px: float) -> None:
    rng = np.random.default_rng(3)
    z = []
    for _ in range(4):
        pose = drawn_pose(rng)
        found = orient_by_field(CAMERA, field, *images(field, pose, rng, beyond_px))
        z.append(error_of(found, pose))
        assert found.discs_used >= found.discs - 1
        assert found.rms_px == pytest.approx(np.hypot(SD_PX, beyond_px), rel=0.5)
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_the_focal_length_may_be_unknown() -> None:
    rng = np.random.default_rng(4)
    pose = drawn_pose(rng, 0.7)
    found = orient_by_field(CAMERA, BOARD, *images(BOARD, pose, rng), has_free_focal=True)
    sd = np.sqrt(found.cov[6, 6])
    assert abs(np.log(found.pose.focal_scale / 0.7)) < 4.0 * sd < 0.02
    assert np.abs(error_of(found, pose)).max() < 5.0


def test_a_disc_of_another_place_is_left_out() -> None:
    rng = np.random.default_rng(5)
    pose = drawn_pose(rng)
    point, moments, covs = images(BOARD, pose, rng)
    moments[7, 0] += 5.0
    found = orient_by_field(CAMERA, BOARD, point, moments, covs)
    assert found.discs_used == found.discs - 1
    assert np.abs(error_of(found, pose)).max() < 5.0


def test_another_board_gives_no_pose() -> None:
    rng = np.random.default_rng(6)
    point, moments, covs = images(BOARD, drawn_pose(rng), rng)
    with pytest.raises(NoPoseError):
        orient_by_field(CAMERA, BOARD, rng.permutation(point), moments, covs)
