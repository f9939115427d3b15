"""The ring check against a plain version that samples, counts and sorts."""

from __future__ import annotations

import functools
import math

import cv2
import numpy as np
import pytest
from scipy import ndimage

from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.measurement.search.pyramid import Pyramid, build_pyramid, reduction_factor
from kgcp.measurement.search.ring_check import check_peaks

BLACK, WHITE = 40, 190
PEAK_RADIUS_PX = 2.8
RING, NEAR, FAR, CORE = 0.76, 1.15, 1.34, 0.33


@functools.cache
def circle(radius: float, count: int) -> tuple[IndexArray, IndexArray]:
    """Columns and rows of a circle's pixels, from its middle: there are few radii."""
    angles = 2.0 * np.pi / count * (np.arange(count) + 0.5)
    return (
        np.floor(radius * np.cos(angles) + 0.5).astype(np.intp),
        np.floor(radius * np.sin(angles) + 0.5).astype(np.intp),
    )


class PlainCheck:
    """One place in one image."""

    def __init__(self, image: GreyArray, x: int, y: int, dark: int, bright: int) -> None:
        self.image, self.x, self.y, self.dark, self.bright = image, x, y, dark, bright

    def samples(self, radius: float, count: int) -> np.ndarray:
        """Grey values on a circle; the image repeats its last pixels."""
        columns, rows = circle(radius, count)
        height, width = self.image.shape
        column = np.minimum(np.maximum(self.x + columns, 0), width - 1)
        row = np.minimum(np.maximum(self.y + rows, 0), height - 1)
        return np.asarray(self.image[row, column].astype(int))

    def directions(self, radius: float, count: int) -> int:
        """In how many directions a dark ring is followed by something brighter."""
        ring, near, far = (self.samples(ratio * radius, count) for ratio in (RING, NEAR, FAR))
        surround = np.maximum(near, far)
        in_even_light = (ring < self.dark) & (surround > self.bright)
        return int(np.sum(in_even_light | (surround > 2 * ring + 5)))

    def clearness(self, radius: float, clear: float) -> float:
        """Contrast, less half of the ring's spread; 0 if it is not a ring."""
        ring, core, near, far = (
            self.samples(ratio * radius, 24) for ratio in (RING, CORE, NEAR, FAR)
        )
        plate = np.maximum(near, far)
        apart, depths = np.sort(core - plate), np.sort(np.minimum(core, plate) - ring)
        are_lit_alike = min(apart[12:] - apart[:12]) - 1 < 0.6 * depths[16]
        ring, core, plate = np.sort(ring), np.sort(core), np.sort(plate)
        contrast = min(core[11], plate[14]) - ring[4]
        spread = ring[8] - ring[1]
        if contrast < 5 or spread > clear * contrast:
            return 0.0
        by_shade = core[17] - core[7], plate[19] - plate[11], abs(core[11] - plate[14])
        if max(by_shade) > (4.0 if are_lit_alike else 1.2) * contrast:
            return 0.0
        return float(max(contrast - 0.5 * spread, 1.0))

    def best(self, radius: float, clear: float) -> tuple[float, float]:
        """Clearness and radius of the clearest ring; clearness 0 without any."""
        counts = [self.directions(rough * radius, 8) for rough in (0.85, 1.1)]
        if max(counts) < 4:
            return 0.0, 0.0
        rough = (0.85, 1.1)[int(np.argmax(counts))]
        trials = [
            (self.clearness(rough * fine * radius, clear), rough * fine * radius)
            for fine in (0.9, 1.0, 1.1)
            if self.directions(rough * fine * radius, 16) >= 9
        ]
        return max(trials, key=lambda trial: trial[0], default=(0.0, 0.0))


def rings_by_definition(pyramid: Pyramid, level: int, peaks: FloatArray) -> FloatArray:
    """What `check_peaks` should return for the peaks of one level."""
    octave, coarser = level // 2, 2.0 + level % 2
    image = pyramid.frame
    if octave:
        begin, end, height, width = pyramid.levels[2 * octave - 2]
        image = pyramid.reduced[begin:end].reshape(height, width)
    factor = 2.0**octave
    rings = []
    for x, y, middle, _ in peaks:
        column, row = (math.floor(coarser * (value + 0.5)) for value in (x, y))
        place = PlainCheck(image, column, row, math.ceil(middle), math.floor(middle))
        clear = 0.8 if factor * coarser * PEAK_RADIUS_PX >= 22.0 else 0.5
        clearness, radius = place.best(coarser * PEAK_RADIUS_PX, clear)
        if clearness > 0.0:
            centre = (factor * coarser * (value + 0.5) - 0.5 for value in (x, y))
            rings.append((*centre, factor * radius, clearness))
    return np.array(rings).reshape(-1, 4)


def frame_of_rings(seed: int, typical_px: float) -> tuple[GreyArray, FloatArray]:
    """Dark rings of about a radius on texture, some partly hidden or in shade; their centres."""
    rng = np.random.default_rng(seed)
    texture = ndimage.gaussian_filter(rng.normal(size=(260, 340)), 3.0)
    frame = np.clip(120.0 + 350.0 * texture, 0, 255).astype(np.uint8)
    centres = rng.uniform((0.0, 0.0), (340.0, 260.0), (12, 2))
    for x, y in centres:
        radius = typical_px * np.exp(rng.uniform(-0.3, 0.3))
        black, white = int(rng.integers(0, 90)), int(rng.integers(110, 256))
        for factor, level in ((1.5, white), (1.0, black), (0.5, white)):
            cv2.circle(frame, (int(x), int(y)), round(factor * radius), level, -1)
    frame[:, 90:180] = frame[:, 90:180] * 0.3  # shade
    return cv2.GaussianBlur(frame, (0, 0), 0.8).astype(np.uint8), centres


@pytest.mark.parametrize("level", range(6))
@pytest.mark.parametrize("seed", range(3))
def test_rings_equal_those_of_a_plain_implementation(level: int, seed: int) -> None:
    factor = reduction_factor(level)
    frame, centres = frame_of_rings(seed, 0.9 * PEAK_RADIUS_PX * factor)
    pyramid = build_pyramid(frame)
    rng = np.random.default_rng(seed)
    places = np.concatenate((np.repeat(centres, 30, axis=0), rng.uniform(0.0, 260.0, (200, 2))))
    places += rng.normal(0.0, 0.3 * factor, places.shape)
    peaks = np.zeros((len(places), 4))
    peaks[:, :2] = (places + 0.5) / factor - 0.5
    peaks[:, 2] = rng.uniform(60.0, 160.0, len(places))
    ends = np.zeros(len(pyramid.levels), np.intp)
    ends[level:] = len(peaks)
    expected = rings_by_definition(pyramid, level, peaks)
    assert 20 < len(expected) < len(peaks) - 100
    np.testing.assert_allclose(check_peaks(pyramid, peaks, ends), expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("third", [0, 1])
def test_samples_beyond_the_border_repeat_the_last_pixels(third: int) -> None:
    coarser = 2.0 + third
    frame = np.full((210, 290), WHITE, dtype=np.uint8)
    for factor, level in ((1.0, BLACK), (0.5, WHITE)):
        cv2.circle(frame, (141, 104), round(factor * PEAK_RADIUS_PX * coarser), level, -1)
    frame = cv2.GaussianBlur(frame, (0, 0), 0.8).astype(np.uint8)
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
