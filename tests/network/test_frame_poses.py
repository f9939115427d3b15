"""Frames oriented by rings each of which is printed larger or smaller by itself."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.frame_poses import orient_frames
from kgcp.network.ground.point_images import CameraPose

CAMERA = Camera(1600, 1200, 2300.0, 2300.0, 803.2, 596.1, k1=-0.05)
POSE = CameraPose(
    np.array([6.0, -4.0, 28.0]),
    rotation_about(np.array([0.1, 0.2, 0.3])) @ np.diag([1.0, -1.0, -1.0]),
)
SD_PX, SD_DISTANCE, SD_POSITION_M = 0.005, 1e-4, 0.002


@pytest.mark.parametrize("targets", [4, 6])
@pytest.mark.parametrize(("sd_own", "sd_alike"), [(0.001, 0.0), (0.0, 0.001)])
def test_prints_are_off_one_by_one_or_alike(targets: int, sd_own: float, sd_alike: float) -> None:
    """Poses scatter as stated, however the stated deviation of the prints is shared out."""
    rng, z, used = np.random.default_rng(3), [], 0
    names = [f"T{index}" for index in range(targets)]
    for _ in range(40):
        stated_m = rng.uniform(-6.0, 6.0, (targets, 3)) * [1.0, 1.0, 0.1]
        seen = POSE.in_camera(stated_m + SD_POSITION_M * rng.standard_normal((targets, 3)))
        pixels = CAMERA.project(seen) + SD_PX * rng.standard_normal((targets, 2))
        distances_m = np.linalg.norm(seen, axis=1)
        distances_m = distances_m * (1.0 + SD_DISTANCE * rng.standard_normal(targets))
        distances_m = distances_m * (1.0 + sd_own * rng.standard_normal(targets))
        distances_m = distances_m * (1.0 + sd_alike * rng.standard_normal())
        sightings = [
            Sighting(
                frame="f",
                number=1,
                target=name,
                instance=0,
                time_s=None,
                centre_px=pixel,
                centre_cov_px2=SD_PX**2 * np.eye(2),
                distance_m=distance_m,
                sd_distance_m=SD_DISTANCE * distance_m,
                sd_common_distance_m=max(sd_own, sd_alike) * distance_m,
            )
            for name, pixel, distance_m in zip(names, pixels, distances_m.tolist(), strict=True)
        ]
        cov_m2 = SD_POSITION_M**2 * np.eye(3)
        places = (TargetPosition(place, cov_m2) for place in stated_m)
        positions = dict(zip(names, places, strict=True))
        (found,) = orient_frames(["f"], sightings, positions, CAMERA, sd_scale=0.0)
        if found.pose is None or found.cov is None:
            continue
        used += len(found.used)
        z.append((found.pose.centre_m - POSE.centre_m) / np.sqrt(found.cov.diagonal()[:3]))
    assert used >= 0.95 * 40 * targets
    assert 0.5 < float(np.sqrt(np.mean(np.square(z)))) < 1.3
