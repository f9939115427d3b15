"""The ring filter against its definition in plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.measurement.search.ring_filter import find_peaks

_BORDER = 6


def peaks_of(image: GreyArray) -> FloatArray:
    """Return the peaks of the second of two images, which lie one behind the other."""
    before = np.full(40, 99, dtype=np.uint8)
    levels = np.array([(0, 40, 8, 5), (40, 40 + image.size, *image.shape)])
    peaks, ends = find_peaks(np.concatenate((before, image.ravel())), levels)
    assert ends.tolist() == [0, len(peaks)]
    return peaks


def peaks_by_definition(image: GreyArray) -> FloatArray:
    """All peaks in the order of rows: column, row, grey value between core and ring, share."""
    grey = np.pad(image.astype(np.int64), _BORDER, mode="edge")
    core, disc = (_sums(grey, size) for size in (3, 5))
    # in 225ths of a grey value, of which every term is rounded down to a quarter
    score = (25 * core >> 2) - 2 * (9 * disc >> 2) + (_sums(disc, 3) >> 2)
    extent = ndimage.maximum_filter(grey, 5) - ndimage.minimum_filter(grey, 5)
    unit = 225.0 / 4.0
    peaks = []
    for row, column in np.ndindex(image.shape):
        y, x = row + _BORDER, column + _BORDER
        top, around = score[y, x], score[y - 1 : y + 2, x - 1 : x + 2].ravel()
        is_first = (around[:4] < top).all() and (around[5:] <= top).all()
        is_clear = top >= int(5.0 * unit) and top >= int(0.2 * unit) * extent[y, x]
        if is_first and is_clear:
            left, right, up, down = around[3], around[5], around[1], around[7]
            peaks.append(
                (
                    column + 0.5 * (left - right) / min(left - 2 * top + right, -1),
                    row + 0.5 * (up - down) / min(up - 2 * top + down, -1),
                    (core[y, x] / 9 + disc[y, x] / 25) / 2,
                    top / max(extent[y, x], 1),
                )
            )
    return np.array(peaks).reshape(-1, 4)


def _sums(values: np.ndarray, size: int) -> np.ndarray:
    """Sums over squares of `size` by `size`."""
    return np.asarray(ndimage.convolve(values, np.ones((size, size), np.int64), mode="nearest"))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shape", [(97, 131), (29, 1015), (27, 1017), (23, 2050), (6, 7)])
def test_peaks_equal_those_of_a_plain_implementation(shape: tuple[int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    smooth = (0.7, 1.1, 1.4)[seed]
    image = ndimage.gaussian_filter(rng.normal(120.0, 140.0 * smooth, shape), smooth)
    image = np.clip(image, 0, 255).astype(np.uint8)
    expected = peaks_by_definition(image)
    assert len(expected) > 20 or math.prod(shape) < 100
    assert len(expected) < 1000, "all are kept"
    peaks = peaks_of(image)
    peaks, expected = (each[np.lexsort(each.T[:2].round())] for each in (peaks, expected))
    np.testing.assert_allclose(peaks, expected, rtol=0.0, atol=1e-9)


def test_the_response_by_radius_is_that_in_the_docs() -> None:
    """As a share of its contrast; sampled 20 times per pixel, blurred by 0.6 px."""
    size, fine = 31, 20
    y, x = (np.mgrid[: size * fine, : size * fine] + 0.5) / fine - 0.5 * size
    for radius, answer in ((2.0, -0.12), (2.5, 0.09), (2.8, 0.22), (3.5, 0.37), (4.2, 0.31)):
        rho = np.hypot(x, y)
        ring = ndimage.gaussian_filter(1.0 - ((rho < radius) & (rho > 0.5 * radius)), 0.6 * fine)
        image = ring.reshape(size, fine, size, fine).mean(axis=(1, 3))
        core, disc = (ndimage.uniform_filter(image, side) for side in (3, 5))
        score = core - 2.0 * disc + ndimage.uniform_filter(disc, 3)
        assert score[size // 2, size // 2] == pytest.approx(answer, abs=0.01)


def test_an_even_image_has_no_peaks() -> None:
    assert len(peaks_of(np.full((50, 70), 99, dtype=np.uint8))) == 0


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (40, 2)])
def test_the_smallest_images_can_be_searched(shape: tuple[int, int]) -> None:
    assert peaks_of(np.zeros(shape, dtype=np.uint8)).shape == (0, 4)


def test_only_the_clearest_of_too_many_peaks_are_kept() -> None:
    rng = np.random.default_rng(2)
    image = np.clip(rng.normal(120.0, 40.0, (400, 500)), 0, 255).astype(np.uint8)
    kept, upper = peaks_of(image), peaks_of(image[:150])
    assert len(kept) == 1000
    clear = upper[(upper[:, 3] > kept[:, 3].min() + 1e-9) & (upper[:, 1] < 140.0)]
    assert 100 < len(clear) < len(upper) - 100
    assert {tuple(peak) for peak in clear} <= {tuple(peak) for peak in kept}


def test_only_the_first_of_too_many_equal_peaks_are_kept() -> None:
    image = np.full((400, 2400), 60, dtype=np.uint8)
    for row, column in np.ndindex(3, 3):
        image[8 + row :: 12, 8 + column :: 12] = 200
    kept = peaks_of(image)
    assert len(kept) == 2400
    assert np.ptp(kept[:, 3]) < 1e-9
