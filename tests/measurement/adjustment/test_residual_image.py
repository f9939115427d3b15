"""Residual images: noise if the pose is right, a pattern if it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.residual_image import contours_px, residual_image_of
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.targets.layout import Target

CONTRAST = 0.75 - 0.08  # of the fixture's frames
NOISE = 0.01

DrawFrame = Callable[..., GreyArray]
PlacePlate = Callable[..., Pose]


@pytest.fixture(scope="module")
def pose(place_plate: PlacePlate) -> Pose:
    return place_plate((170.0, 210.0), 48.0, tilt_deg=24.0, way_deg=70.0, turn_deg=131.0)


@pytest.mark.parametrize("response", [Response.LINEAR, Response.UNKNOWN])
def test_the_right_pose_leaves_only_noise(
    camera: Camera, target: Target, draw_frame: DrawFrame, pose: Pose, response: Response
) -> None:
    grey = draw_frame((target, pose), noise=NOISE)
    left = residual_image_of(grey, replace(camera, response=response), target, pose, None)
    seen = left.share[np.isfinite(left.share)]
    assert 0.5 < np.isfinite(left.share).mean() < 0.8, "an ellipse in its box"
    scatter = 1.4826 * np.median(np.abs(seen))
    assert scatter == pytest.approx(NOISE / CONTRAST, rel=0.15)
    assert np.abs(seen).max() < 0.2
    assert left.edge_noise < 0.05


def test_residuals_show_where_a_pose_is_too_near_or_beside(
    camera: Camera, target: Target, draw_frame: DrawFrame, pose: Pose
) -> None:
    """Model less frame: a plate taken for too far left has ink where the frame is white."""
    grey = draw_frame((target, pose), noise=NOISE)
    px_m = pose.distance_m / camera.mean_focal_px
    beside = Pose(pose.rotation, pose.translation_m - np.array([2.0 * px_m, 0.0, 0.0]))
    left = residual_image_of(grey, camera, target, beside, 0.8)
    x, y = np.rint(camera.project(beside.translation_m)).astype(int) - (left.x0, left.y0)
    row = left.share[y, :]
    edge = int(np.flatnonzero(np.isfinite(row)).max() - x)
    reach = np.abs(np.arange(len(row)) - x) / edge
    west, east = (
        row[(reach > 0.75) & (reach < 0.95) & (side * (np.arange(len(row)) - x) > 0)]
        for side in (-1, 1)
    )
    assert west.min() < -0.4, "ink of the model on the frame's white"
    assert east.max() > 0.4
    assert left.edge_noise > 0.1


@pytest.mark.parametrize(
    ("radius_px", "way_deg", "turn_deg"), [(9.0, 0.0, 0.0), (11.0, 40.0, 30.0)]
)
def test_slight_shade_on_a_small_ring_shows_in_the_residuals(
    camera: Camera,
    photograph: DrawFrame,
    place_plate: PlacePlate,
    radius_px: float,
    way_deg: float,
    turn_deg: float,
) -> None:
    """On small rings, the covariance of the pose shows it, even without an adjustment."""
    rng = np.random.default_rng(round(turn_deg / 30.0))
    centre_px = (200.0 + rng.uniform(), 170.0)
    pose = place_plate(centre_px, radius_px, tilt_deg=20.0, way_deg=way_deg, turn_deg=turn_deg)

    def shade(x: FloatArray, y: FloatArray) -> FloatArray:
        across_px = 0.8 * (x - centre_px[0]) + 0.6 * (y - centre_px[1])
        return np.asarray(1.0 - 0.08 / (1.0 + np.exp(-across_px / 2.0)))

    grey = photograph(camera, pose, rng, shade=shade)
    left = residual_image_of(grey, camera, TARGET_PLATE.target, pose, 0.8)
    assert left.white is not None
    assert 0.8 < np.nanmin(left.white) < 0.97
    assert not left.may_be_hidden
    assert left.edge_noise < 0.02


def test_what_hides_a_part_of_the_plate_is_not_taken_for_light(
    camera: Camera, target: Target, draw_frame: DrawFrame, pose: Pose
) -> None:
    """The fit explains black by light that takes grey values away, which does not exist."""
    grey = draw_frame((target, pose), noise=NOISE)
    x_px = camera.project(pose.translation_m)[0]
    grey[:, round(x_px) + 22 :] = 0
    left = residual_image_of(grey, camera, target, pose, 0.8)
    assert left.white is not None
    assert np.nanmin(left.white) >= 0.1
    assert np.nanmax(left.white) == 1.0
    assert left.may_be_hidden


def test_contours_are_closed_and_distorted_as_the_camera_does(
    camera: Camera, target: Target, pose: Pose
) -> None:
    contours = contours_px(camera, target, pose)
    rings = len(target.rings)
    assert len(contours) == 2 * rings + sum(len(ring.code_deg) for ring in target.rings)
    np.testing.assert_allclose(contours[:, 0], contours[:, -1], atol=1e-9)
    on_plate = pose.transform(np.array([[0.45, 0.0], [0.0, 0.45], [-0.45, 0.0], [0.0, -0.45]]))
    np.testing.assert_allclose(contours[0, :96:24], camera.project(on_plate), atol=1e-9)
    plain = contours_px(replace(camera, k1=0.0, k2=0.0, p1=0.0, p2=0.0), target, pose)
    assert np.abs(plain - contours).max() > 0.1, "distortion is there to be seen"
