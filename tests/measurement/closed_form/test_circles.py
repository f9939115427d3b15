from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.measurement.closed_form.circles import concentric_clusters, near_circular, paper_outlines
from kgcp.measurement.closed_form.contours import find_contours
from kgcp.measurement.search.pyramid import eight_bit
from kgcp.settings import DetectSettings

SETTINGS = DetectSettings()


def drawn(*ellipses: Ellipse, shape: tuple[int, int] = (200, 300)) -> GreyArray:
    """Dark ellipses on white, each inside the one before in the other colour."""
    rows, columns = np.indices((shape[0] * 4, shape[1] * 4))
    pixels = np.stack((columns, rows), axis=-1) / 4.0 - 0.375
    fine = np.full(rows.shape, 200.0)
    for index, ellipse in enumerate(ellipses):
        unit = (pixels - ellipse.centre) @ np.linalg.inv(ellipse.stretch)
        fine[np.linalg.norm(unit, axis=-1) < 1.0] = 30.0 if index % 2 == 0 else 200.0
    return cv2.resize(fine, shape[::-1], interpolation=cv2.INTER_AREA).round().astype(np.uint8)


def test_a_ring_becomes_one_cluster_of_two_circles_largest_first() -> None:
    outer, inner = Ellipse(140.0, 95.0, 40.0, 36.0, 0.4), Ellipse(140.2, 95.1, 20.0, 18.0, 0.4)
    circles = near_circular(find_contours(drawn(outer, inner), SETTINGS), SETTINGS)
    (cluster,) = concentric_clusters(circles)
    found_outer, found_inner = cluster
    for found, true in ((found_outer, outer), (found_inner, inner)):
        np.testing.assert_allclose(
            [found.x, found.y, found.a, found.b], [true.x, true.y, true.a, true.b], atol=1.0
        )
    assert set(paper_outlines(drawn(outer, inner), SETTINGS)) == {found_outer, found_inner}


@pytest.mark.parametrize(("tilt_deg", "passes"), [(0.0, True), (25.0, True), (65.0, False)])
def test_the_circle_test_admits_moderate_tilts(tilt_deg: float, *, passes: bool) -> None:
    ellipse = Ellipse(150.0, 100.0, 50.0, 50.0 * math.cos(math.radians(tilt_deg)), 1.1)
    circles = near_circular(find_contours(drawn(ellipse), SETTINGS), SETTINGS)
    assert bool(circles) is passes


def test_circles_below_the_smallest_radius_are_left_out() -> None:
    frame = drawn(Ellipse(150.0, 100.0, 8.0, 8.0, 0.0))
    assert near_circular(find_contours(frame, SETTINGS), SETTINGS)
    strict = DetectSettings(min_radius_px=12.0)
    assert near_circular(find_contours(frame, strict), strict) == ()


def test_a_line_is_no_circle_and_an_empty_frame_has_none() -> None:
    frame = np.full((100, 160), 128, dtype=np.uint8)
    assert near_circular(find_contours(frame, SETTINGS), SETTINGS) == ()
    frame[40:60, 10:150] = 20
    assert near_circular(find_contours(frame, SETTINGS), SETTINGS) == ()


def test_a_circle_with_a_notch_is_found_by_its_convex_hull() -> None:
    frame = drawn(Ellipse(150.0, 100.0, 30.0, 30.0, 0.0))
    frame[96:105, 150:190] = 200
    frame[60:100, 146:155] = 200
    circles = near_circular(find_contours(frame, SETTINGS), SETTINGS)
    assert any(
        np.allclose([c.x, c.y, c.a, c.b], [150.0, 100.0, 30.0, 30.0], atol=1.5) for c in circles
    )


def test_distant_circles_are_not_clustered() -> None:
    ellipses = (Ellipse(50.0, 50.0, 20.0, 20.0, 0.0), Ellipse(90.0, 50.0, 10.0, 10.0, 0.0))
    assert len(concentric_clusters(ellipses)) == 2
    assert concentric_clusters(()) == ()


def test_twelve_bits_in_sixteen_make_the_same_edges_as_eight() -> None:
    frame = drawn(Ellipse(150.0, 100.0, 30.0, 27.0, 0.3))
    deep = frame.astype(np.uint16) * 16
    assert eight_bit(frame) is frame
    assert eight_bit(deep).max() == 255
    (shallow_circle,) = near_circular(find_contours(frame, SETTINGS), SETTINGS)
    (deep_circle,) = near_circular(find_contours(deep, SETTINGS), SETTINGS)
    assert deep_circle.a == pytest.approx(shallow_circle.a, abs=0.3)
