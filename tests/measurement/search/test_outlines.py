"""The search before any code is read: seeds and outlines of drawn rings."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from kgcp.geometry.arrays import GreyArray
from kgcp.measurement.search.outlines import find_seeds, non_max_suppression, track_outlines
from kgcp.measurement.search.pyramid import build_pyramid, reduction_factor

SUPER = 8  # factor by which the drawing is larger
BLACK, WHITE = 40.0, 190.0


def ring_frame(
    centre: tuple[float, float], axes: tuple[float, float], angle_deg: float = 0.0
) -> GreyArray:
    """Return a frame (210, 290) with a dark elliptic ring of half its radius on white."""
    big = np.full((210 * SUPER, 290 * SUPER), WHITE, dtype=np.float32)
    x, y = (round(SUPER * (value + 0.5) - 0.5) for value in centre)
    for factor, level in ((1.0, BLACK), (0.5, WHITE)):
        a, b = (round(SUPER * factor * axis) for axis in axes)
        cv2.ellipse(big, (x, y), (a, b), angle_deg, 0.0, 360.0, level, -1)
    frame = cv2.resize(big, (290, 210), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(4).normal(0.0, 2.0, frame.shape)
    seen = np.rint(cv2.GaussianBlur(frame, (0, 0), 0.7) + noise)
    return np.asarray(np.clip(seen, 0, 255), dtype=np.uint8)


@pytest.mark.parametrize(
    ("shape", "sizes"),
    [((11, 90), []), ((97, 131), [(48, 65), (32, 42), (24, 32), (16, 20), (12, 16)])],
)
def test_reduced_images_show_what_the_frame_shows(
    shape: tuple[int, int], sizes: list[tuple[int, int]]
) -> None:
    x, y = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    frame = np.rint(20.0 + 0.9 * x + 1.1 * y).astype(np.uint8)
    pyramid = build_pyramid(frame)
    assert [tuple(size) for size in pyramid.levels[:, 2:]][:5] == sizes
    for i, (begin, end, height, width) in enumerate(pyramid.levels):
        image = pyramid.reduced[begin:end].reshape(height, width)
        column, row = (reduction_factor(i) * (np.arange(n) + 0.5) - 0.5 for n in (width, height))
        assert np.abs(image - (20.0 + 0.9 * column + 1.1 * row[:, None])).max() < 1.5


@pytest.mark.parametrize("radius", [6.0, 7.1, 9.3, 12.0, 16.0, 23.0, 31.0, 44.0, 60.0, 88.0])
def test_rings_of_any_size_are_found_and_tracked(radius: float) -> None:
    centre = (141.3, 103.8)
    pyramid = build_pyramid(ring_frame(centre, (radius, radius)))
    seeds = find_seeds(pyramid, 6.0)
    apart = np.hypot(*(seeds.centres_px - centre).T)
    assert np.any((apart < 0.3 * radius) & (np.abs(seeds.radii_px / radius - 1.0) < 0.3))
    outlines = [
        outline for outline in track_outlines(pyramid, seeds) if outline.mean_radius > 0.7 * radius
    ]
    assert len(outlines) == 1
    assert math.hypot(outlines[0].x - centre[0], outlines[0].y - centre[1]) < 0.3
    assert outlines[0].mean_radius == pytest.approx(radius, abs=max(0.4, 0.03 * radius))


@pytest.mark.parametrize("angle_deg", [-62.0, 17.0])
def test_an_oblique_ring_with_a_hidden_quarter_keeps_its_axes(angle_deg: float) -> None:
    frame = ring_frame((120.6, 99.2), (52.0, 39.0), angle_deg)
    cv2.ellipse(frame, (121, 99), (75, 75), 0.0, 20.0, 100.0, 115.0, -1)
    pyramid = build_pyramid(frame)
    largest = max(track_outlines(pyramid, find_seeds(pyramid, 6.0)), key=lambda outline: outline.a)
    assert (largest.x, largest.y) == pytest.approx((120.6, 99.2), abs=1.5)
    assert (largest.a, largest.b) == pytest.approx((52.0, 39.0), rel=0.05)
    assert math.cos(largest.angle_rad - math.radians(angle_deg)) ** 2 > 0.98


def test_a_disc_on_dark_ground_is_no_ring() -> None:
    frame = ring_frame((141.3, 103.8), (20.0, 20.0))
    assert len(find_seeds(build_pyramid(255 - frame), 6.0)) == 0


@pytest.mark.parametrize("seed", range(5))
def test_only_the_clearest_of_similar_circles_is_kept(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centres, radii = rng.uniform(0.0, 60.0, (90, 2)), rng.uniform(5.0, 15.0, 90)
    clearness = rng.random(90)
    kept: list[int] = []
    for i in np.argsort(-clearness):
        apart = np.hypot(*(centres[kept] - centres[i]).T)
        ratio = np.abs(np.log(radii[i] / radii[kept]))
        if not np.any((apart <= 0.5 * radii[kept]) & (ratio <= 0.3)):
            kept.append(int(i))
    assert non_max_suppression(centres, radii, clearness, 0.5, 0.3).tolist() == kept
    assert len(kept) < 90
