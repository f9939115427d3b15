from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.conic import Ellipse
from kgcp.measurement.search.sampling import sample_ellipses, sample_grey
from kgcp.measurement.search.templates import CIRCLE

ROWS, COLUMNS = np.indices((90, 130))
RAMP = (300 + 70 * COLUMNS - 3 * ROWS).astype(np.uint16)


def ramp_at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(300.0 + 70.0 * x - 3.0 * y)


def test_grey_values_between_pixels_are_bilinear_to_a_thirty_second_of_a_pixel() -> None:
    points = np.random.default_rng(1).uniform((0.0, 0.0), (129.0, 89.0), (7, 11, 2))
    expected = ramp_at(points[..., 0], points[..., 1])
    assert np.abs(sample_grey(RAMP, points) - expected).max() < (70.0 + 3.0) / 64.0 + 0.6


def test_samples_beyond_the_border_repeat_the_last_pixels() -> None:
    points = np.array([[[-9.0, 40.0], [500.0, 40.0], [60.0, -1.0], [60.0, 95.0]]])
    within = np.clip(points, 0.0, (129.0, 89.0))
    assert sample_grey(RAMP, points) == pytest.approx(sample_grey(RAMP, within))


def test_ellipses_are_sampled_where_their_points_are() -> None:
    outlines = (Ellipse(60.2, 41.7, 30.0, 22.0, 0.7), Ellipse(30.0, 50.0, 9.0, 8.5, -1.2))
    factors = np.array([0.4, 1.0, 1.15])
    values = sample_ellipses(RAMP, outlines, factors, CIRCLE)
    assert values.shape == (2, 3, len(CIRCLE))
    angles = np.arctan2(CIRCLE[:, 1], CIRCLE[:, 0])
    for outline, seen in zip(outlines, values, strict=True):
        points = np.stack([outline.points(angles, factor) for factor in factors])
        assert np.abs(seen - sample_grey(RAMP, points)).max() <= 73.0 / 32.0 + 1.0


def test_sampling_no_ellipses_gives_no_values() -> None:
    assert sample_ellipses(RAMP, (), np.ones(2), CIRCLE).shape == (0, 2, len(CIRCLE))
