"""The figure of the eccentricity is drawn, the same each time."""

from __future__ import annotations

from kgcp.geometry.camera import Camera
from kgcp.report.calibration.figures import draw_eccentricity


def test_figure_is_drawn_the_same_each_time() -> None:
    camera = Camera(640, 480, 700.0, 700.0, 320.0, 240.0, -0.2)
    first = draw_eccentricity(camera, (5.0, 12.0))
    assert first.png.startswith(b"\x89PNG")
    assert first.png == draw_eccentricity(camera, (5.0, 12.0)).png
    assert first.png != draw_eccentricity(camera, (5.0, 13.0)).png
