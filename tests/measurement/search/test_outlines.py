"""The search before any code is read: peaks, seeds and outlines of drawn rings."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from scipy import ndimage

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.measurement.search.outlines import distinct, find_outlines, find_seeds
from kgcp.measurement.search.pyramid import build_pyramid, factor_of
from kgcp.measurement.search.ring_check import check_peaks
from kgcp.measurement.search.ring_filter import find_peaks

SUPER = 8  # drawn so many times as large
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


def peaks_of(image: GreyArray) -> FloatArray:
    """Return the peaks of the second of two images, which lie one behind the other."""
    before = np.full(40, 99, dtype=np.uint8)
    levels = np.array([(0, 40, 8, 5), (40, 40 + image.size, *image.shape)])
    peaks, ends = find_peaks(np.concatenate((before, image.ravel())), levels)
    assert ends.tolist() == [0, len(peaks)]
    return peaks


@pytest.mark.parametrize("shape", [(97, 131), (29, 1015), (27, 1017), (23, 2050)])
def test_peaks_are_where_their_definition_says(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    image = ndimage.gaussian_filter(rng.normal(120.0, 200.0, shape), 1.4)
    image = np.clip(image, 0, 255).astype(np.uint8)
    grey = image.astype(np.float64)
    core, disc = (ndimage.uniform_filter(grey, size, mode="nearest") for size in (3, 5))
    score = core - 2.0 * disc + ndimage.uniform_filter(disc, 3, mode="nearest")
    extent = ndimage.maximum_filter(grey, 5) - ndimage.minimum_filter(grey, 5)
    is_peak = (score >= ndimage.maximum_filter(score, 3)) & (score > 5.1) & (score > 0.21 * extent)
    rows, columns = np.nonzero(is_peak[3:-3, 3:-3])
    found = {(round(x), round(y)): middle for x, y, middle, _ in peaks_of(image)}
    expected = {(x + 3, y + 3) for x, y in zip(columns.tolist(), rows.tolist(), strict=True)}
    assert len(expected) > 20
    assert len(expected - found.keys()) <= 0.03 * len(expected)  # half a pixel rounds either way
    for x, y in expected & found.keys():
        assert found[x, y] == pytest.approx(0.5 * (core[y, x] + disc[y, x]), abs=1e-6)


def test_an_even_image_has_no_peaks() -> None:
    assert len(peaks_of(np.full((50, 70), 99, dtype=np.uint8))) == 0


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (40, 2)])
def test_the_smallest_images_can_be_searched(shape: tuple[int, int]) -> None:
    assert peaks_of(np.zeros(shape, dtype=np.uint8)).shape == (0, 4)


def test_of_too_many_peaks_the_clearest_are_kept() -> None:
    rng = np.random.default_rng(2)
    image = np.clip(rng.normal(120.0, 40.0, (400, 500)), 0, 255).astype(np.uint8)
    kept, upper = peaks_of(image), peaks_of(image[:150])
    assert len(kept) == 1000
    clear = upper[(upper[:, 3] > kept[:, 3].min() + 1e-9) & (upper[:, 1] < 140.0)]
    assert 100 < len(clear) < len(upper) - 100
    assert {tuple(peak) for peak in clear} <= {tuple(peak) for peak in kept}


def test_of_too_many_peaks_that_are_alike_the_first_are_kept() -> None:
    image = np.full((400, 2400), 60, dtype=np.uint8)
    for row, column in np.ndindex(3, 3):
        image[8 + row :: 12, 8 + column :: 12] = 200
    kept = peaks_of(image)
    assert len(kept) == 2400
    assert np.ptp(kept[:, 3]) < 1e-9


@pytest.mark.parametrize("third", [0, 1])
def test_beyond_its_border_the_image_repeats_its_last_pixels(third: int) -> None:
    coarser = 2.0 + third
    frame = ring_frame((141.3, 103.8), (2.8 * coarser, 2.8 * coarser))
    cut = np.ascontiguousarray(frame[97:, 134:])  # the ring, without its surround on two sides
    padded = cv2.copyMakeBorder(cut, 36, 36, 36, 36, borderType=cv2.BORDER_REPLICATE)
    x, y = np.meshgrid(np.arange(0.0, cut.shape[1], coarser), np.arange(0.0, 40.0, coarser))
    peaks = np.column_stack((x.ravel() / coarser, y.ravel() / coarser, np.full((x.size, 2), 115.0)))
    moved = np.array([36.0, 36.0, 0.0, 0.0])
    seen, expected = (
        check_peaks(pyramid, places, np.repeat((0, x.size), (third, len(pyramid.levels) - third)))
        for pyramid, places in (
            (build_pyramid(cut), peaks),
            (build_pyramid(padded), peaks + moved / coarser),
        )
    )
    assert len(seen) > 0
    assert np.array_equal(seen, expected - moved)


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
        column, row = (factor_of(i) * (np.arange(n) + 0.5) - 0.5 for n in (width, height))
        assert np.abs(image - (20.0 + 0.9 * column + 1.1 * row[:, None])).max() < 1.5


@pytest.mark.parametrize("radius", [6.0, 7.1, 9.3, 12.0, 16.0, 23.0, 31.0, 44.0, 60.0, 88.0])
def test_a_ring_of_any_size_is_seeded_and_followed(radius: float) -> None:
    centre = (141.3, 103.8)
    pyramid = build_pyramid(ring_frame(centre, (radius, radius)))
    seeds = find_seeds(pyramid, 6.0)
    apart = np.hypot(*(seeds.centres_px - centre).T)
    assert np.any((apart < 0.3 * radius) & (np.abs(seeds.radii_px / radius - 1.0) < 0.3))
    outlines = [one for one in find_outlines(pyramid, seeds) if one.mean_radius > 0.7 * radius]
    assert len(outlines) == 1
    assert math.hypot(outlines[0].x - centre[0], outlines[0].y - centre[1]) < 0.3
    assert outlines[0].mean_radius == pytest.approx(radius, abs=max(0.4, 0.03 * radius))


@pytest.mark.parametrize("angle_deg", [-62.0, 17.0])
def test_an_oblique_ring_with_a_hidden_quarter_keeps_its_axes(angle_deg: float) -> None:
    frame = ring_frame((120.6, 99.2), (52.0, 39.0), angle_deg)
    cv2.ellipse(frame, (121, 99), (75, 75), 0.0, 20.0, 100.0, 115.0, -1)
    pyramid = build_pyramid(frame)
    largest = max(find_outlines(pyramid, find_seeds(pyramid, 6.0)), key=lambda one: one.a)
    assert (largest.x, largest.y) == pytest.approx((120.6, 99.2), abs=1.5)
    assert (largest.a, largest.b) == pytest.approx((52.0, 39.0), rel=0.05)
    assert math.cos(largest.angle_rad - math.radians(angle_deg)) ** 2 > 0.98


def test_a_disc_on_dark_ground_is_no_ring() -> None:
    frame = ring_frame((141.3, 103.8), (20.0, 20.0))
    assert len(find_seeds(build_pyramid(255 - frame), 6.0)) == 0


@pytest.mark.parametrize("seed", range(5))
def test_of_circles_that_are_alike_the_clearest_is_kept(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centres, radii = rng.uniform(0.0, 60.0, (90, 2)), rng.uniform(5.0, 15.0, 90)
    clearness = rng.random(90)
    kept: list[int] = []
    for one in np.argsort(-clearness):
        apart = np.hypot(*(centres[kept] - centres[one]).T)
        ratio = np.abs(np.log(radii[one] / radii[kept]))
        if not np.any((apart <= 0.5 * radii[kept]) & (ratio <= 0.3)):
            kept.append(int(one))
    assert distinct(centres, radii, clearness, 0.5, 0.3).tolist() == kept
    assert len(kept) < 90
