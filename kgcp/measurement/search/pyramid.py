"""An image pyramid: a frame in 8 bits, reduced to a half, a third, a quarter, … of its size.

Successive levels differ in size by factors of 1.5 and 1.33. So every ring has a radius between 2.5
and 3.75 px in some level, to which the ring filter responds. All levels are in one array, so that a
single compiled loop can process them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import GreyArray, IndexArray
from kgcp.geometry.grey_range import brightest_level

_MIN_SIZE_PX = 6  # of the smallest reduced image

_Sums = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """A frame and its reduced images."""

    frame: GreyArray  # (height, width): contiguous
    # (n,): the reduced images, row by row, one after the other. Their pixels are 2, 3, 4, 6, 8, …
    # frame pixels wide.
    reduced: GreyArray
    levels: IndexArray  # (m, 4): start and end in `reduced`, height and width of each image


def reduction_factor(level: int) -> float:
    """Return the width of a level's pixels in frame pixels."""
    return 2.0 ** (level // 2) * (2.0, 3.0)[level % 2]


def eight_bit(grey: GreyArray) -> GreyArray:
    """Return a frame for the search: 8 bits, contiguous, scaled so that its white is 255."""
    if grey.dtype == np.uint8:
        return np.ascontiguousarray(grey)
    return cv2.convertScaleAbs(grey, alpha=255.0 / brightest_level(grey))


def build_pyramid(grey: GreyArray) -> Pyramid:
    """Return the frame in 8 bits and its reduced images, down to a few pixels."""
    levels = _levels_of(*grey.shape)
    reduced = np.empty(levels[-1, 1] if len(levels) else 0, np.uint8)
    pyramid = Pyramid(eight_bit(grey), reduced, levels)
    _reduce(pyramid.frame, reduced, levels)
    return pyramid


@lru_cache(maxsize=128)
def _levels_of(height: int, width: int) -> IndexArray:
    table: list[tuple[int, int, int, int]] = []
    end = 0
    while min(height, width) >= 2 * _MIN_SIZE_PX:
        height, width = height // 2, width // 2
        for lines, columns in ((height, width), (2 * (height // 3), 2 * (width // 3))):
            begin, end = end, end + lines * columns
            table.append((begin, end, lines, columns))
    return np.array(table, np.intp).reshape(-1, 4)


@compiled
def _reduce(frame: GreyArray, reduced: GreyArray, levels: IndexArray) -> None:
    for i in range(len(levels)):
        image = _image(reduced, levels, i)
        if i == 0:
            _halve(frame, image)
        elif i % 2 == 0:
            _halve(_image(reduced, levels, i - 2), image)
        else:
            _reduce_to_two_thirds(_image(reduced, levels, i - 1), image)


@compiled
def _image(reduced: GreyArray, levels: IndexArray, i: int) -> GreyArray:
    at = levels[i]
    return reduced[at[0] : at[1]].reshape((at[2], at[3]))


@compiled
def _halve(image: GreyArray, out: GreyArray) -> None:
    """Fill in the rounded means of 2 × 2 pixels."""
    for i in range(len(out)):
        upper, lower, line = image[2 * i], image[2 * i + 1], out[i]
        for x in range(len(line)):
            left = np.uint16(upper[2 * x]) + np.uint16(lower[2 * x])
            right = np.uint16(upper[2 * x + 1]) + np.uint16(lower[2 * x + 1])
            line[x] = np.uint16(left + right + 2) >> 2


@compiled
def _reduce_to_two_thirds(image: GreyArray, out: GreyArray) -> None:
    """Reduce three rows and columns to two, by linear interpolation between pixel centres."""
    height, width = out.shape[0] // 2, out.shape[1] // 2
    upper, lower = np.empty(3 * width, np.uint16), np.empty(3 * width, np.uint16)
    for i in range(height):
        for x in range(len(upper)):
            upper[x] = 3 * image[3 * i, x] + image[3 * i + 1, x]
        for x in range(len(lower)):
            lower[x] = image[3 * i + 1, x] + 3 * image[3 * i + 2, x]
        _fill_row(upper, out[2 * i])
        _fill_row(lower, out[2 * i + 1])


@compiled
def _fill_row(row: _Sums, out: GreyArray) -> None:
    """Reduce three columns to two; the values of `row` are four times grey values."""
    for j in range(len(out) // 2):
        left, middle, right = row[3 * j], row[3 * j + 1], row[3 * j + 2]
        out[2 * j] = np.uint16(3 * left + middle + 8) >> 4
        out[2 * j + 1] = np.uint16(middle + 3 * right + 8) >> 4
