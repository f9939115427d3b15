from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse, ellipse_from_conic
from kgcp.geometry.pose import Pose
from kgcp.measurement.closed_form.edges import edge_points, fit_edge, spline_patch_around
from kgcp.measurement.search.code_signal import clear_of_dots
from kgcp.targets.layout import Target

AROUND = np.linspace(0.0, 2.0 * math.pi, 200, endpoint=False)

PlacePlate = Callable[..., Pose]
DrawFrame = Callable[..., GreyArray]


def test_edge_points_lie_on_a_blurred_edge() -> None:
    """An edge with a symmetric blur and a slight curve has its inflection at its place."""
    rows, columns = np.indices((240, 260))
    radius = np.hypot(columns - 130.3, rows - 118.8)
    frame = (40.0 + 150.0 / (1.0 + np.exp(-(radius - 90.25) / 0.6))).astype(np.float64)
    start = Ellipse(130.4, 118.75, 90.35, 90.2, 0.2)
    patch = spline_patch_around(frame, start)
    points = edge_points(patch, start, AROUND, dark_inside=True)
    distance = np.hypot(points[:, 0] - 130.3, points[:, 1] - 118.8) - 90.25
    assert len(points) == 200
    assert np.abs(distance).max() < 0.08
    assert abs(distance.mean()) < 0.02
    assert len(edge_points(patch, start, AROUND, dark_inside=False)) == 0


def test_edges_much_fainter_than_the_rest_are_left_out() -> None:
    """Two sectors of an eighth each, of which one has 0.4 of the contrast and one 0.2."""
    rows, columns = np.indices((240, 260))
    radius = np.hypot(columns - 130.0, rows - 120.0)
    sector = np.degrees(np.arctan2(rows - 120.0, columns - 130.0)) // 45.0
    contrast = 150.0 * np.select([sector == 1.0, sector == -3.0], [0.4, 0.2], 1.0)
    frame = 40.0 + contrast / (1.0 + np.exp(-(radius - 90.25) / 0.6))
    start = Ellipse(130.0, 120.0, 90.3, 90.3, 0.0)
    points = edge_points(spline_patch_around(frame, start), start, AROUND, dark_inside=True)
    seen = np.degrees(np.arctan2(points[:, 1] - 120.0, points[:, 0] - 130.0)) // 45.0
    kept = [int(np.sum(seen == each)) for each in (1.0, -3.0)]
    assert kept[0] == pytest.approx(25, abs=2)
    assert kept[1] <= 2
    assert len(points) == pytest.approx(175, abs=4)


def test_edges_outside_the_frame_are_left_out() -> None:
    rows, columns = np.indices((120, 100))
    frame = np.where(np.hypot(columns - 90.0, rows - 60.0) < 30.0, 20.0, 200.0)
    start = Ellipse(90.0, 60.0, 30.0, 30.0, 0.0)
    points = edge_points(spline_patch_around(frame, start), start, AROUND, dark_inside=True)
    assert 80 < len(points) < 140
    assert points[:, 0].max() <= 99.0


@pytest.mark.parametrize("px_per_m", [25.0, 40.0])
def test_angles_near_dots_are_not_clear_on_small_rings(target: Target, px_per_m: float) -> None:
    clear = clear_of_dots(AROUND, target.ring, 0.9, 30.0, px_per_m)
    degrees = np.degrees(AROUND)
    for dot in target.ring.code_deg:
        assert not clear[np.abs((degrees - dot - 30.0 + 180.0) % 360.0 - 180.0) < 8.0].any()
    assert 0.5 <= clear.mean() < 0.85
    assert clear_of_dots(AROUND, target.ring, 0.9, 30.0, 200.0).all()


@pytest.mark.parametrize(
    ("radius_px", "outer_px", "inner_px"),
    [(11.0, 0.06, 0.25), (25.0, 0.03, 0.05), (80.0, 0.02, 0.02)],  # small discs: dots are near
)
def test_both_edges_are_measured(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    radius_px: float,
    outer_px: float,
    inner_px: float,
) -> None:
    pose = place_plate((250.3, 171.6), radius_px, turn_deg=70.0)
    frame = draw_frame((target, pose), noise=0.003)
    x, y = camera.project(pose.translation_m)
    start = Ellipse(x + 0.4, y - 0.3, 1.04 * radius_px, 1.02 * radius_px, 0.0)
    patch = spline_patch_around(frame, start)
    for diameter_m, scale, tolerance_px in ((0.9, 1.0, outer_px), (0.45, 0.5, inner_px)):
        fit = fit_edge(
            patch,
            camera,
            start.scaled(scale),
            ring=target.ring,
            edge_diameter_m=diameter_m,
            lag_deg=70.0,
        )
        wanted = 0.5 * diameter_m / pose.translation_m[2]
        difference_px = (ellipse_from_conic(fit.conic).mean_radius - wanted) * camera.mean_focal_px
        assert abs(difference_px) < 2.0 * tolerance_px
        np.testing.assert_allclose(fit.ellipse.centre, [x, y], atol=tolerance_px)


def test_a_plain_frame_has_no_edge(camera: Camera, target: Target) -> None:
    frame = np.full((360, 480), 90, dtype=np.uint8)
    start = Ellipse(200.0, 150.0, 30.0, 30.0, 0.0)
    with pytest.raises(Rejection) as caught:
        fit_edge(
            spline_patch_around(frame, start),
            camera,
            start,
            ring=target.ring,
            edge_diameter_m=0.9,
            lag_deg=0.0,
        )
    assert caught.value.reason is Reason.EDGES_LOST
