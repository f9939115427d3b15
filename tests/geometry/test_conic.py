from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.conic import (
    Ellipse,
    chord,
    ellipse_from_conic,
    fit_ellipse,
    sampson_distance,
    transform_conic,
)

ellipses = st.builds(
    Ellipse,
    x=st.floats(-2000.0, 2000.0),
    y=st.floats(-2000.0, 2000.0),
    a=st.floats(10.0, 500.0),
    b=st.floats(4.0, 9.5),
    angle_rad=st.floats(-1.5, 1.5),
)
AROUND = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)


@given(ellipses)
def test_conic_matrix_gives_the_ellipse_back(ellipse: Ellipse) -> None:
    back = ellipse_from_conic(ellipse.conic)
    np.testing.assert_allclose([back.a, back.b], [ellipse.a, ellipse.b], rtol=1e-5)
    np.testing.assert_allclose(back.centre, ellipse.centre, atol=1e-4)
    assert math.sin(back.angle_rad - ellipse.angle_rad) == pytest.approx(0.0, abs=1e-5)


@given(ellipses)
def test_exact_points_give_the_ellipse_back(ellipse: Ellipse) -> None:
    fitted = ellipse_from_conic(fit_ellipse(ellipse.points(AROUND)))
    np.testing.assert_allclose(fitted.points(AROUND), ellipse.points(AROUND), atol=1e-4)


def test_points_lie_where_the_matrix_vanishes_and_the_inside_is_negative() -> None:
    ellipse = Ellipse(310.0, 95.0, 40.0, 22.0, 0.7)
    points = np.column_stack((ellipse.points(AROUND), np.ones(40)))
    np.testing.assert_allclose(
        np.einsum("ni,ij,nj->n", points, ellipse.conic, points), 0.0, atol=1e-9
    )
    assert sampson_distance(ellipse.conic, ellipse.centre[None] + [[1.0, 0.0]])[0] < 0.0


def test_point_angles_are_directions_for_a_circle() -> None:
    circle = Ellipse(5.0, 6.0, 10.0, 10.0, 1.2)  # a circle has no direction of its own
    np.testing.assert_allclose(circle.points(np.array([0.5 * math.pi])), [[5.0, 16.0]])
    around = (circle.points(AROUND, 0.3) - circle.centre) @ [1.0, 1.0j]
    np.testing.assert_allclose(around, 3.0 * np.exp(1j * AROUND), atol=1e-12)


def test_sampson_distance_is_the_distance_near_the_curve() -> None:
    circle = Ellipse(100.0, 50.0, 20.0, 20.0, 0.0)
    for step in (-0.1, 0.1):
        distance = sampson_distance(circle.conic, circle.points(AROUND, 1.0 + step / 20.0))
        np.testing.assert_allclose(distance, step, atol=3e-4)


def test_a_homography_carries_the_conic_with_its_points() -> None:
    homography = np.array([[1.1, 0.2, 5.0], [-0.1, 0.9, 3.0], [1e-4, -2e-4, 1.0]])
    ellipse = Ellipse(30.0, 20.0, 12.0, 8.0, -0.4)
    moved = np.column_stack((ellipse.points(AROUND), np.ones(40))) @ homography.T
    moved_conic = transform_conic(ellipse.conic, homography)
    assert np.abs(sampson_distance(moved_conic, moved[:, :2] / moved[:, 2:])).max() < 1e-9


def test_the_ends_of_a_chord_are_on_the_ellipse_and_on_the_line() -> None:
    ellipse = Ellipse(3.0, -2.0, 2.0, 1.0, 0.3)
    point, angles = np.array([3.2, -1.8]), np.array([0.0, 1.0, 2.5])
    behind, ahead = chord(ellipse.conic, point, angles)
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    assert np.abs(sampson_distance(ellipse.conic, np.vstack((behind, ahead)))).max() < 1e-12
    assert np.all(np.sum((ahead - point) * directions, axis=1) > 0.0)
    assert np.all(np.sum((behind - point) * directions, axis=1) < 0.0)


def test_noisy_points_give_an_unbiased_centre() -> None:
    rng = np.random.default_rng(3)
    ellipse = Ellipse(1500.0, 1100.0, 13.3, 12.9, 0.5)
    angles = np.linspace(0.0, 2.0 * math.pi, 75, endpoint=False)
    fits = [
        ellipse_from_conic(fit_ellipse(ellipse.points(angles) + rng.normal(0.0, 0.05, (75, 2))))
        for _ in range(200)
    ]
    centres = np.array([fit.centre for fit in fits])
    expected_sd = 0.05 * math.sqrt(2.0 / 75.0)
    np.testing.assert_allclose(centres.std(axis=0), expected_sd, rtol=0.25)
    assert np.abs(centres.mean(axis=0) - ellipse.centre).max() < 4.0 * expected_sd / math.sqrt(200)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((5, 2)),
        np.zeros((20, 2)),
        np.column_stack((np.arange(20.0), 2.0 * np.arange(20.0))),
    ],
    ids=["too few", "one place", "a line"],
)
def test_points_without_an_ellipse_are_refused(points: FloatArray) -> None:
    with pytest.raises(Rejection) as caught:
        ellipse_from_conic(fit_ellipse(points))
    assert caught.value.reason is Reason.POOR_ELLIPSE


def test_a_hyperbola_is_no_ellipse() -> None:
    with pytest.raises(Rejection):
        ellipse_from_conic(np.diag([1.0, -1.0, -1.0]))
