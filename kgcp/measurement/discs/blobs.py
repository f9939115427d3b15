"""Places that may be discs: closed contours midway between the local dark and bright.

A pixel is dark or bright compared with the midrange of a small window around it, and neither if
that window is even. So every edge has a dark band and a bright band on its sides, whose common
border is the edge, whatever the size of the disc and however the light falls off. The outer border
of a dark component is the outline of a dark disc, that of a bright component the outline of a
bright disc. Rings and hollow marks are found by both of their edges, and discs that nearly touch
stay apart.

Edges that are blurred over more than the window are seen in reduced images.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.measurement.discs.records import Polarity

# Tuning. `benchmarks.calibrate.sets` counts the discs found in photographs of fields, and
# `benchmarks.ground.plain_targets` those found in rendered frames.
_WINDOW = 11  # pixels: sees both sides of an edge blurred by σ = 2 px
_LEAST_RANGE = 12  # grey values of 255: fainter edges are ignored
_RANGE_SIGMAS = 12.0  # of the noise: a window of 121 even pixels has a range of 5 σ
_FEWEST_POINTS = 8  # of a contour: R = 1.5 px
# Least ratio of a contour's area to that of the ellipse with its moments; a square has 0.955
_LEAST_FILL = 0.88
_MOST_ASPECT = 4.5  # ratio of the axes: tilts to 77°
_LEAST_RADIUS_REDUCED_PX = 5.0  # smaller discs are better seen in the less reduced image
_SMALLEST_SIDE, _SMALLEST_FRAME = 48, 8  # pixels of a reduced image, and of any


def find_blobs(grey: GreyArray) -> tuple[FloatArray, list[Polarity]]:
    """Return approximate ellipses of what may be discs, and their polarities.

    Parameters
    ----------
    grey : (height, width) array
        Of any depth.

    Returns
    -------
    blobs : (n, 5) array
        Centre x, y [px] and symmetric stretch xx, xy, yy [px]: the matrix that makes the ellipse of
        the unit circle.
    polarities : list of Polarity
    """
    octave = 0
    image = stretched_to_bytes(grey) if min(grey.shape) >= _SMALLEST_FRAME else grey
    blobs: list[tuple[float, ...]] = []
    polarities: list[Polarity] = []
    while min(image.shape) >= (_SMALLEST_SIDE if octave else _SMALLEST_FRAME):
        for polarity, mask in zip(Polarity, _sides(image), strict=True):
            contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            for contour, links in zip(contours, _links(hierarchy), strict=True):
                if len(contour) < _FEWEST_POINTS or links[3] >= 0:
                    continue
                blob = _blob(contour, octave)
                if blob is not None:
                    blobs.append(blob)
                    polarities.append(polarity)
        image, octave = cv2.pyrDown(image), octave + 1
    return np.array(blobs, dtype=np.float64).reshape(-1, 5), polarities


def stretched_to_bytes(grey: GreyArray) -> GreyArray:
    """Return an image as 0…255; if it is deeper, the middle 99.8 % of its grey values fill that."""
    if grey.dtype == np.uint8:
        return grey
    low, high = np.quantile(grey[::4, ::4], [0.001, 0.999])
    scale = 255.0 / max(float(high - low), 1e-9)
    return np.asarray(np.clip((grey - low) * scale, 0.0, 255.0).astype(np.uint8))


def _sides(image: GreyArray) -> tuple[GreyArray, GreyArray]:
    """Return the masks of pixels that are dark, and bright, beside an edge."""
    box = np.ones((_WINDOW, _WINDOW), np.uint8)
    low, high = cv2.erode(image, box), cv2.dilate(image, box)
    least = math.ceil(max(_LEAST_RANGE, _RANGE_SIGMAS * _noise(image)))
    _, is_edge = cv2.threshold(cv2.subtract(high, low), least - 1.0, 255.0, cv2.THRESH_BINARY)
    middle = cv2.addWeighted(low, 0.5, high, 0.5, 0.0)
    dark = cv2.bitwise_and(cv2.compare(image, middle, cv2.CMP_LT), is_edge)
    return dark, cv2.bitwise_and(cv2.compare(image, middle, cv2.CMP_GE), is_edge)


def _noise(image: GreyArray) -> float:
    """Return the noise in grey values, by the median of second differences along rows."""
    rows = image[::7].astype(np.int16)
    second = np.abs(rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2])
    return float(np.median(second)) / (0.6745 * math.sqrt(6.0))


def _links(hierarchy: GreyArray | None) -> list[list[int]]:
    return [] if hierarchy is None else hierarchy[0].tolist()


def _blob(contour: GreyArray, octave: int) -> tuple[float, ...] | None:
    """Return the ellipse with the moments of a contour, in the frame's pixels; None: it is none."""
    _, _, width, height = cv2.boundingRect(contour)
    if max(width, height) > 2.0 * _MOST_ASPECT * min(width, height):
        return None
    moments = cv2.moments(contour)
    area = moments["m00"]
    if area < 2.0:
        return None
    x, y = moments["m10"] / area, moments["m01"] / area
    xx, xy, yy = (moments[key] / area for key in ("mu20", "mu11", "mu02"))
    determinant = xx * yy - xy * xy
    if determinant <= 0.0 or area < _LEAST_FILL * 4.0 * math.pi * math.sqrt(determinant):
        return None
    # contours run through the centres of the outermost pixels, half a pixel inside the edge
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    a = 2.0 * math.sqrt(mean + half) + 0.5
    b = 2.0 * math.sqrt(max(mean - half, 0.0)) + 0.5
    if a > _MOST_ASPECT * b or (octave and b < _LEAST_RADIUS_REDUCED_PX):
        return None
    cosine, sine = _half_angle(xx - yy, 2.0 * xy)
    scale = 2.0**octave
    return (
        scale * (x + 0.5) - 0.5,
        scale * (y + 0.5) - 0.5,
        scale * (a * cosine * cosine + b * sine * sine),
        scale * (a - b) * cosine * sine,
        scale * (a * sine * sine + b * cosine * cosine),
    )


def _half_angle(x: float, y: float) -> tuple[float, float]:
    """Return cosine and sine of half the angle of a direction."""
    half_rad = 0.5 * math.atan2(y, x)
    return math.cos(half_rad), math.sin(half_rad)
