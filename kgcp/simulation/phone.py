"""Image processing of a phone: mosaic, noise reduction, local tone mapping.

In this order, in linear light: a Bayer mosaic (RGGB) with noise; white balance; demosaicing; noise
reduction; a gain that follows the surroundings' brightness. Tone curve and sharpening are those of
the `Sensor`.

Demosaicing is by Malvar, He & Cutler (ICASSP 2004, High-quality linear interpolation), or by the
mean of the nearest pixels of a colour, whose blur depends on an edge's direction. All these filters
are symmetric and so move no edge. Noise reduction is the guided filter of He, Sun & Tang (PAMI 35,
2013), with smoother colours, or the bilateral filter of Tomasi & Manduchi (ICCV 1998). The latter
makes edges steeper about their middle, which is displaced if they are skew.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from scipy.ndimage import convolve, uniform_filter

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.settings import require_range
from kgcp.simulation.imaging import Sensor

_SENSITIVITY = (0.55, 1.0, 0.7)  # of red, green, blue pixels to grey light
_MIDDLE_GREY = 0.35  # surroundings that local tone mapping leaves as they are
_DARKEST = 0.03

_GREEN_AT_COLOUR = np.array(
    [
        [0, 0, -1, 0, 0],
        [0, 0, 2, 0, 0],
        [-1, 2, 4, 2, -1],
        [0, 0, 2, 0, 0],
        [0, 0, -1, 0, 0],
    ]
) / 8.0  # fmt: skip
_COLOUR_IN_ITS_ROW = np.array(
    [
        [0, 0, 0.5, 0, 0],
        [0, -1, 0, -1, 0],
        [-1, 4, 5, 4, -1],
        [0, -1, 0, -1, 0],
        [0, 0, 0.5, 0, 0],
    ]
) / 8.0  # fmt: skip
_COLOUR_AT_OTHER = np.array(
    [
        [0, 0, -1.5, 0, 0],
        [0, 2, 0, 2, 0],
        [-1.5, 0, 6, 0, -1.5],
        [0, 2, 0, 2, 0],
        [0, 0, -1.5, 0, 0],
    ]
) / 8.0  # fmt: skip
_MEAN_OF_FOUR = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4.0
_MEAN_OF_NEAREST = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4.0


class Demosaicing(StrEnum):
    """How the colours that a pixel does not see are filled in."""

    WITH_GRADIENTS = "with_gradients"  # from its own colour, too
    NEAREST = "nearest"  # from the nearest pixels of that colour alone


@dataclass(frozen=True, slots=True)
class Phone:
    """Settings of a phone's image processing."""

    demosaicing: Demosaicing = Demosaicing.WITH_GRADIENTS
    # differences of fewer noise standard deviations than this are smoothed away; 0: none are
    noise_reduction: float = 2.0
    noise_radius_px: int = 2  # half the side of the smoothing window [px]
    # σ of a bilateral filter in values from 0 to 1, square roots of the light; 0: the guided filter
    bilateral: float = 0.0
    # share of the difference in brightness between regions, in logarithms, that is taken away
    local_tone: float = 0.3
    local_tone_px: float = 60.0  # σ of a region [px]

    def __post_init__(self) -> None:
        require_range("noise_reduction", self.noise_reduction, 0.0, 20.0)
        require_range("noise_radius_px", self.noise_radius_px, 1, 20, unit="px")
        require_range("bilateral", self.bilateral, 0.0, 1.0)
        require_range("local_tone", self.local_tone, 0.0, 1.0)
        require_range("local_tone_px", self.local_tone_px, 2.0, 1000.0, unit="px")

    def photograph(
        self, sensor: Sensor, irradiance: FloatArray, gain: float, rng: np.random.Generator
    ) -> GreyArray:
        """Return a frame (height, width, 3) of red, green and blue values (uint8) with noise."""
        sensitivity = _on_mosaic(irradiance.shape)
        raw = sensor.collect(gain * np.maximum(irradiance, 0.0) * sensitivity, rng)
        balanced = np.minimum(raw / sensitivity, 1.0)
        if self.demosaicing is Demosaicing.NEAREST:
            colours = demosaic_by_nearest(balanced)
        else:
            colours = demosaic(balanced)
        colours = self._smoothed(sensor, np.maximum(colours, 0.0))
        colours *= self._local_gain(_brightness(colours))
        return np.stack(
            [np.rint(sensor.develop(np.clip(c, 0.0, 1.0))).astype(np.uint8) for c in colours],
            axis=-1,
        )

    def _smoothed(self, sensor: Sensor, colours: FloatArray) -> FloatArray:
        size = 2 * self.noise_radius_px + 1
        if self.bilateral:
            image = np.sqrt(np.moveaxis(colours, 0, -1)).astype(np.float32)
            filtered = cv2.bilateralFilter(image, size, self.bilateral, self.noise_radius_px)
            return np.asarray(np.moveaxis(filtered.astype(float) ** 2, -1, 0))
        if not self.noise_reduction:
            return colours
        grey = _brightness(colours)
        mean = uniform_filter(grey, size)
        scatter = np.maximum(uniform_filter(grey * grey, size) - mean * mean, 0.0)
        noise = (sensor.full_well_e * mean + sensor.read_noise_e**2) / sensor.full_well_e**2
        kept = scatter / (scatter + self.noise_reduction**2 * noise)
        smooth = uniform_filter(kept, size) * grey + uniform_filter((1.0 - kept) * mean, size)
        tints = [uniform_filter(uniform_filter(c - grey, size), size) for c in colours]
        return np.asarray(np.maximum(smooth + np.stack(tints), 0.0))

    def _local_gain(self, grey: FloatArray) -> FloatArray:
        """Return the gain (height, width) that brings the surroundings nearer to middle grey."""
        size = 2 * round(self.local_tone_px) + 1
        for _ in range(3):  # boxes of 2σ, three times: nearly a Gaussian of σ
            grey = uniform_filter(grey, size)
        return np.asarray((_MIDDLE_GREY / np.maximum(grey, _DARKEST)) ** self.local_tone)


def demosaic(raw: FloatArray) -> FloatArray:
    """Return red, green and blue (3, height, width) of a mosaic whose first pixel is red."""
    green = raw.copy()
    at_colour = convolve(raw, _GREEN_AT_COLOUR, mode="mirror")
    for parity in (0, 1):
        green[parity::2, parity::2] = at_colour[parity::2, parity::2]
    in_row = convolve(raw, _COLOUR_IN_ITS_ROW, mode="mirror")
    in_column = convolve(raw, _COLOUR_IN_ITS_ROW.T, mode="mirror")
    at_other = convolve(raw, _COLOUR_AT_OTHER, mode="mirror")
    planes = []
    for parity in (0, 1):  # red, blue
        other = 1 - parity
        plane = raw.copy()
        plane[parity::2, other::2] = in_row[parity::2, other::2]
        plane[other::2, parity::2] = in_column[other::2, parity::2]
        plane[other::2, other::2] = at_other[other::2, other::2]
        planes.append(plane)
    return np.stack((planes[0], green, planes[1]))


def demosaic_by_nearest(raw: FloatArray) -> FloatArray:
    """Return the same as `demosaic`, from the nearest pixels of each colour alone."""
    planes = np.zeros((3, *raw.shape))
    planes[0, ::2, ::2], planes[2, 1::2, 1::2] = raw[::2, ::2], raw[1::2, 1::2]
    planes[1, ::2, 1::2], planes[1, 1::2, ::2] = raw[::2, 1::2], raw[1::2, ::2]
    kernels = _MEAN_OF_NEAREST, _MEAN_OF_FOUR, _MEAN_OF_NEAREST
    return np.stack(
        [convolve(plane, of, mode="mirror") for plane, of in zip(planes, kernels, strict=True)]
    )


def _on_mosaic(shape: tuple[int, ...]) -> FloatArray:
    """Return the sensitivity of each pixel."""
    red, green, blue = _SENSITIVITY
    sensitivity = np.full(shape, green)
    sensitivity[::2, ::2] = red
    sensitivity[1::2, 1::2] = blue
    return sensitivity


def _brightness(colours: FloatArray) -> FloatArray:
    return np.asarray(0.25 * (colours[0] + colours[2]) + 0.5 * colours[1])
