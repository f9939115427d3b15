"""The plate without blur against a plain version over all circles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.plate import circles_of
from kgcp.measurement.image_model.unblurred import unblurred_plate
from kgcp.targets.layout import Target


@pytest.mark.parametrize("measured", ["all", "main ring"])
@pytest.mark.parametrize("seed", range(3))
def test_levels_and_distances_are_those_of_the_circles(
    target: Target, seed: int, measured: str
) -> None:
    rng = np.random.default_rng(seed)
    circles = circles_of(target.rings)
    count = len(circles.radii_m) if measured == "all" else 2 + len(target.ring.code_deg)
    turn = Rotation.from_rotvec([*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.0, 6.0)])
    pose = Pose(turn.as_matrix(), np.array([0.4, -0.3, 8.0]))
    rays = np.zeros((6, 3000))
    rays[:2] = np.array([[0.05], [-0.0375]]) + rng.uniform(-0.1, 0.1, (2, 3000))
    small_radius_m, spread = 0.03, np.array([0.9, 0.1, 0.4])
    unblurred = unblurred_plate(
        circles, count, pose, rays, small_radius_m=small_radius_m, spread=spread
    )

    ray = np.vstack((rays[:2], np.ones(3000)))
    depth = (pose.normal @ pose.translation_m) / (pose.normal @ ray)
    points = ((ray * depth).T - pose.translation_m) @ pose.rotation[:, :2]
    np.testing.assert_allclose(unblurred.points_m.T, points, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(unblurred.rho_m, np.hypot(*points.T), rtol=0.0, atol=1e-12)
    covariance = np.array([[spread[0], spread[1]], [spread[1], spread[2]]])
    for i, point in enumerate(points):
        share, edge_distance_m, in_small_disc = 1.0, math.inf, False
        for centre, radius, sign in zip(
            circles.centres_m.T, circles.radii_m, circles.signs, strict=True
        ):
            distance = float(np.linalg.norm(point - centre))
            share += sign * (distance < radius)
            edge_distance_m = min(edge_distance_m, abs(distance - radius))
            in_small_disc |= distance < radius < small_radius_m
        assert unblurred.share[i] == pytest.approx(share)
        assert unblurred.edge_distance_m[i] == pytest.approx(
            0.0 if in_small_disc else edge_distance_m, abs=1e-12
        )
    # In units of the blur across the edge; of equal dots, the edge of the nearest alone counts.
    for i, point in enumerate(points[:500]):
        felt_m = math.inf
        for centre, radius in zip(
            circles.centres_m.T[:count], circles.radii_m[:count], strict=True
        ):
            offset = point - centre
            distance = float(np.linalg.norm(offset))
            stretch = distance / math.sqrt(offset @ covariance @ offset)
            felt_m = min(felt_m, abs(distance - radius) * stretch)
        nearest_only = 1e-12 + 0.35 * felt_m
        assert felt_m - 1e-12 <= unblurred.measured_edge_distance_m[i] <= felt_m + nearest_only
