"""The pose that the image model starts from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import Observation
from kgcp.measurement.search.candidates import find_code, find_dotted, find_rings
from kgcp.measurement.search.initial_pose import start_pose
from kgcp.settings import DetectSettings, Method
from kgcp.targets.layout import Target

DrawFrame = Callable[..., GreyArray]
PlacePlate = Callable[..., Pose]


@pytest.fixture(scope="module")
def started(
    camera: Camera, target: Target, place_plate: PlacePlate, draw_frame: DrawFrame
) -> Callable[..., tuple[Observation, Pose]]:
    def start(radius_px: float, tilt_deg: float, **light: float) -> tuple[Observation, Pose]:
        pose = place_plate(
            (205.4, 160.7), radius_px, tilt_deg=tilt_deg, way_deg=200.0, turn_deg=31.0
        )
        single = Target(target.ring)
        grey = draw_frame((single, pose), **light)
        settings = DetectSettings()
        candidates = find_dotted(grey, find_rings(grey, settings), single.rings)
        matches, _ = find_code(candidates[single.ring], single.ring, settings)
        return start_pose(grey, camera, single, matches[0], Method.MODEL), pose

    return start


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
@pytest.mark.parametrize("radius_px", [14.0, 60.0])
def test_an_outline_gives_a_pose_to_a_per_cent_or_two(
    radius_px: float, tilt_deg: float, started: Callable[..., tuple[Observation, Pose]]
) -> None:
    seen, pose = started(radius_px, tilt_deg)
    assert seen.pose.distance_m == pytest.approx(pose.distance_m, rel=0.02)
    assert np.linalg.norm(seen.pose.translation_m - pose.translation_m) < 0.02 * pose.distance_m
    assert abs(seen.appearance.edge_shift_px or 0.0) < 0.3


@pytest.mark.parametrize("blur_px", [0.8, 3.0])
def test_it_sees_how_blurred_edges_are(
    blur_px: float, started: Callable[..., tuple[Observation, Pose]]
) -> None:
    seen, _ = started(50.0, 15.0, blur_px=blur_px)
    assert seen.appearance.blur_px is not None
    assert 0.8 * blur_px < seen.appearance.blur_px < 1.5 * blur_px


def test_it_sees_light_that_spills_over_the_edges(
    started: Callable[..., tuple[Observation, Pose]],
) -> None:
    seen, _ = started(40.0, 10.0, white=3.0, blur_px=1.2)
    assert 0.4 < (seen.appearance.edge_shift_px or 0.0) < 2.0


def test_no_start_is_square_to_its_ray(
    started: Callable[..., tuple[Observation, Pose]],
) -> None:
    seen, _ = started(14.0, 0.0)
    ray = seen.pose.translation_m / seen.pose.distance_m
    assert np.degrees(np.arccos(ray @ seen.pose.normal)) > 5.0
