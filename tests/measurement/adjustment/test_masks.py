"""The masks' loops over pixels against plain versions, one pixel at a time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import norm

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.masks import (
    _fill_ellipse,
    _mark_foreign,
    _mark_hidden,
    _median_levels,
    occluded_mask,
    see_plate,
)
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.photometry import light_of_levels
from kgcp.targets.layout import Target

PIXELS = 4000
BLACK, WHITE, RADIUS_M, SD_M, SLACK_M = 0.1, 0.8, 0.45, 0.02, 0.004


@pytest.mark.parametrize(("white", "brightest"), [(0.8, 1.0), (1.3, 1.0), (1.3, 0.9)])
@pytest.mark.parametrize("seed", range(3))
def test_pixels_are_foreign_if_neither_plate_nor_ring_edge_explains_them(
    seed: int, white: float, brightest: float
) -> None:
    rng = np.random.default_rng(seed)
    points_m = rng.uniform(-0.65, 0.65, (2, PIXELS))
    rho_m, smooth = np.hypot(*points_m), rng.uniform(0.0, 1.0, PIXELS)
    spread = np.array([1.0, 0.2, 0.5])
    foreign = np.empty(PIXELS, dtype=bool)
    levels = BLACK, white, brightest
    count = _mark_foreign(smooth, points_m, rho_m, spread, levels, RADIUS_M, SD_M, SLACK_M, foreign)
    expected = np.zeros(PIXELS, dtype=bool)
    for i in range(PIXELS):
        beyond_m = rho_m[i] - RADIUS_M
        if beyond_m > 2.6 * SD_M:
            expected[i] = abs(smooth[i] - min(white, brightest)) > 0.15 * (white - BLACK)
        elif beyond_m > SLACK_M:
            direction = points_m[:, i] / rho_m[i]
            covariance = np.array([[spread[0], spread[1]], [spread[1], spread[2]]])
            sd_m = SD_M * math.sqrt(direction @ covariance @ direction)
            sigmas = (beyond_m - SLACK_M) / sd_m
            darkest = BLACK + (white - BLACK) * (norm.cdf(sigmas) - 0.15)
            expected[i] = sigmas > 0.85 and smooth[i] < min(darkest, brightest)
    np.testing.assert_array_equal(foreign, expected)
    assert count == expected.sum()
    assert 100 < count < PIXELS - 100


@pytest.mark.parametrize("seed", range(3))
def test_pixels_off_their_level_or_beyond_a_missing_edge_are_hidden(seed: int) -> None:
    rng = np.random.default_rng(seed)
    smooth, rho_m = rng.uniform(0.0, 1.0, PIXELS), rng.uniform(0.0, 0.6, PIXELS)
    share = rng.integers(0, 2, PIXELS).astype(np.float64)
    edge_distance_m = rng.uniform(0.0, 0.1, PIXELS)
    contrast = WHITE - BLACK
    hidden = np.zeros(PIXELS, dtype=bool)
    counts = _mark_hidden(
        smooth, share, edge_distance_m, rho_m, BLACK, contrast, RADIUS_M, SLACK_M, SD_M, hidden
    )
    expected, tested = np.zeros(PIXELS, dtype=bool), 0
    for i in range(PIXELS):
        off_m, beyond_m = edge_distance_m[i] - SLACK_M, rho_m[i] - RADIUS_M - SLACK_M
        off_level = abs(smooth[i] - (BLACK + contrast * share[i])) / contrast
        limits = [math.inf]
        if off_m > 2.6 * SD_M and beyond_m < 0.0:
            limits.append(0.25)
        if off_m > 1.2 * SD_M and beyond_m < 1.9 * SD_M:
            limits.append(0.5)
        expected[i] = off_level > min(limits)
        tested += len(limits) > 1
    np.testing.assert_array_equal(hidden, expected)
    assert counts == (expected.sum(), tested)
    assert 100 < counts[0] < tested - 100


@pytest.mark.parametrize("seed", range(3))
def test_levels_are_medians_of_the_third_of_pixels_farthest_from_edges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    levels, rho_m = rng.uniform(0.0, 1.0, PIXELS), rng.uniform(0.0, 0.6, PIXELS)
    share, edge_distance_m = rng.uniform(0.0, 1.0, PIXELS), rng.uniform(0.0, 0.1, PIXELS)
    expected = []
    for is_kind in (share < 0.5, share >= 0.5):
        chosen = is_kind & (rho_m < RADIUS_M)
        clearest = np.argsort(edge_distance_m[chosen])[int(0.7 * chosen.sum()) :]
        expected.append(float(np.median(levels[chosen][clearest])))
    assert _median_levels(levels, rho_m, share, edge_distance_m, RADIUS_M) == pytest.approx(
        tuple(expected)
    )


def test_the_level_of_ink_is_unknown_without_ink_pixels() -> None:
    one = np.ones(10)
    black, white = _median_levels(0.7 * one, 0.1 * one, one, one, RADIUS_M)
    assert math.isnan(black)
    assert white == pytest.approx(0.7)


@pytest.mark.parametrize("blur", [(1.0, 1.0, 0.0), (2.3, 0.8, 0.5), (0.7, 3.1, -1.2)])
def test_the_reach_of_a_blur_is_its_ellipse(blur: tuple[float, float, float]) -> None:
    xx, yy, xy = blur
    kernel = np.empty((9, 9), dtype=np.uint8)
    _fill_ellipse(xx, yy, xy, 2.0, kernel)
    inverse = np.linalg.inv([[xx, xy], [xy, yy]])
    for row, column in np.ndindex(9, 9):
        offset = np.array([column - 4, row - 4])
        assert kernel[row, column] == (offset @ inverse @ offset <= 4.0 + 1e-9)


@pytest.mark.parametrize(
    ("black", "white", "share"),
    [
        (0.08, 0.75, 0.0),
        (0.08, 0.33, 0.4),  # plate and surroundings are off the plate's level
        (0.45, 0.75, 0.0),  # all ink, which is most of the ring: the light is wrong
    ],
)
def test_a_mask_of_most_of_the_plate_is_dropped(
    target: Target,
    camera: Camera,
    place_plate: Callable[..., Pose],
    draw_frame: Callable[..., GreyArray],
    imaging_of: Callable[..., FitProblem],
    black: float,
    white: float,
    share: float,
) -> None:
    pose = place_plate((205.0, 190.0), 40.0)
    problem = imaging_of(draw_frame((target, pose), noise=0.003), camera, target, pose)
    seen = see_plate(problem, pose, Blur(0.6, 0.6, 0.0))
    occluded = occluded_mask(seen, light_of_levels(black, white, problem.tone), slack_px=0.5)
    within = seen.unblurred.rho_m < 0.45
    assert np.mean(occluded[within]) == pytest.approx(share, abs=0.1)
