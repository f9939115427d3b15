"""The pose that the image model starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import InitialPose
from kgcp.measurement.search.candidates import find_code, find_dotted_rings, find_rings
from kgcp.measurement.search.initial_pose import initial_pose
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Target

DrawFrame = Callable[..., GreyArray]
PlacePlate = Callable[..., Pose]


@pytest.fixture(scope="module")
def started(
    camera: Camera, target: Target, place_plate: PlacePlate, draw_frame: DrawFrame
) -> Callable[..., tuple[InitialPose, Pose]]:
    def start(radius_px: float, tilt_deg: float, **light: float) -> tuple[InitialPose, Pose]:
        pose = place_plate(
            (205.4, 160.7), radius_px, tilt_deg=tilt_deg, way_deg=200.0, turn_deg=31.0
        )
        single = Target(target.ring)
        grey = draw_frame((single, pose), **light)
        settings = DetectSettings()
        candidates = find_dotted_rings(grey, find_rings(grey, settings), single.rings)
        matches, _ = find_code(candidates[single.ring], single.ring, settings)
        return initial_pose(grey, camera, single, matches[0]), pose

    return start


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
@pytest.mark.parametrize("radius_px", [14.0, 60.0])
def test_the_pose_from_an_outline_is_right_to_two_percent(
    radius_px: float, tilt_deg: float, started: Callable[..., tuple[InitialPose, Pose]]
) -> None:
    seen, pose = started(radius_px, tilt_deg)
    assert seen.pose.distance_m == pytest.approx(pose.distance_m, rel=0.02)
    assert np.linalg.norm(seen.pose.translation_m - pose.translation_m) < 0.02 * pose.distance_m
    assert abs(seen.edge_shift_px) < 0.3


@pytest.mark.parametrize("off_px", [(1.5, -1.0, 0.0, 0.0), (-0.5, 0.5, 2.0, -1.0)])
def test_a_large_outline_is_refined_in_the_frame(
    off_px: tuple[float, float, float, float],
    camera: Camera,
    target: Target,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
) -> None:
    """Without it, outlines of 100 px were off by up to 2 px, and starts tilted by 15° too much."""
    pose = place_plate((205.4, 160.7), 90.0, tilt_deg=12.0, way_deg=200.0, turn_deg=31.0)
    single = Target(target.ring)
    grey = draw_frame((single, pose))
    grey[: int(pose_row(camera, pose)) - 40, :205] = 90  # hides a part of the edge
    settings = DetectSettings()
    candidates = find_dotted_rings(grey, find_rings(grey, settings), single.rings)
    matches, _ = find_code(candidates[single.ring], single.ring, settings)
    outer = matches[0].outer
    x, y, a, b = np.add((outer.x, outer.y, outer.a, outer.b), off_px)
    displaced = replace(matches[0], outer=Ellipse(x, y, a, b, outer.angle_rad + 0.3))
    seen = initial_pose(grey, camera, single, displaced).pose
    assert seen.distance_m == pytest.approx(pose.distance_m, rel=0.01)
    assert np.degrees(np.arccos(seen.normal @ pose.normal)) < 3.0


def pose_row(camera: Camera, pose: Pose) -> float:
    return float(camera.project(pose.translation_m[None])[0, 1])


@pytest.mark.parametrize("blur_px", [0.8, 3.0])
def test_initial_blur_follows_the_image(
    blur_px: float, started: Callable[..., tuple[InitialPose, Pose]]
) -> None:
    seen, _ = started(50.0, 15.0, blur_px=blur_px)
    assert 0.8 * blur_px < seen.blur_px < 1.5 * blur_px


def test_initial_edge_shift_follows_the_image(
    started: Callable[..., tuple[InitialPose, Pose]],
) -> None:
    seen, _ = started(40.0, 10.0, white=3.0, blur_px=1.2)
    assert 0.4 < (seen.edge_shift_px) < 2.0


def test_no_start_is_frontal(
    started: Callable[..., tuple[InitialPose, Pose]],
) -> None:
    seen, _ = started(14.0, 0.0)
    ray = seen.pose.translation_m / seen.pose.distance_m
    assert np.degrees(np.arccos(ray @ seen.pose.normal)) > 5.0
