"""From light to grey values: point spread, streak, sensor noise, tone curve, sharpening.

The image model, in this order, with electrons as the unit in which physics is done:

1. irradiance of a pixel = scene radiance ∗ Gaussian(σ), or a lens's aberrations, ∗ box along the
   streak ∗ pixel square, at the moment of the pixel's row;
2. electrons = full well × gain × irradiance (irradiance 1: a perfectly white plate);
3. noise: Gaussian with variance = electrons (the limit of Poisson's) + read noise²;
4. clipped to 0 … full well and divided by it; tone curve, 0…1 → 0…1;
5. unsharp mask y + amount · (y − y ∗ Gaussian), clipped to 0…1; times 255, rounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import scipy.fft

from kgcp.geometry.arrays import ComplexArray, FloatArray, GreyArray
from kgcp.settings import require_range
from kgcp.simulation.point_spread import Aberration
from kgcp.simulation.rolling_shutter import RowMotion

_WHITE_LEVEL = 255.0
_FILM_CONTRAST = 0.7


class ToneCurve(StrEnum):
    """Response of the camera: relative exposure 0…1 to relative grey value 0…1.

    `film` is the sRGB curve followed by an S-shaped increase of contrast, y − a·sin(2πy)/2π: a
    toe that crushes shadows and a shoulder that compresses highlights, as cameras' "standard"
    picture styles do.
    """

    LINEAR = "linear"
    SRGB = "srgb"
    FILM = "film"

    def apply(self, exposure: FloatArray) -> FloatArray:
        """Return the grey value 0…1 of a relative exposure 0…1."""
        if self is ToneCurve.LINEAR:
            return exposure
        encoded: FloatArray = np.where(
            exposure <= 0.0031308,  # IEC 61966-2-1
            12.92 * exposure,
            1.055 * np.maximum(exposure, 0.0031308) ** (1.0 / 2.4) - 0.055,
        )
        if self is ToneCurve.SRGB:
            return encoded
        return encoded - _FILM_CONTRAST * np.sin(2.0 * np.pi * encoded) / (2.0 * np.pi)

    def slope(self, exposure: FloatArray) -> FloatArray:
        """Return the derivative of `apply`."""
        if self is ToneCurve.LINEAR:
            return np.ones_like(exposure)
        slope: FloatArray = np.where(
            exposure <= 0.0031308,
            12.92,
            1.055 / 2.4 * np.maximum(exposure, 0.0031308) ** (1.0 / 2.4 - 1.0),
        )
        if self is ToneCurve.SRGB:
            return slope
        encoded = ToneCurve.SRGB.apply(exposure)
        return slope * (1.0 - _FILM_CONTRAST * np.cos(2.0 * np.pi * encoded))


@dataclass(frozen=True, slots=True)
class Optics:
    """Blur of one frame: point spread, streak and motion during the readout."""

    # σ of the Gaussian point spread; with an aberration, the root of the product of the largest and
    # the smallest [px]
    psf_px: float
    # motion of the image during the exposure, x and y [px]; symmetric about mid-exposure
    streak_px: tuple[float, float] = (0.0, 0.0)
    aberration: Aberration | None = None  # None: the point spread is a round Gaussian
    # motion of the image from row to row; None: all rows are exposed at once
    motion: RowMotion | None = None

    @property
    def reach_px(self) -> int:
        """Farthest distance that light is spread or moved [px]."""
        lens = self.aberration
        spread = 5.0 * self.psf_px if lens is None else lens.reach_px(self.psf_px)
        moved = 0.0 if self.motion is None else self.motion.reach_px
        return math.ceil(spread + moved + 0.5 * math.hypot(*self.streak_px)) + 1

    def spread(self, scene: FloatArray, oversampling: int, first_row: int = 0) -> FloatArray:
        """Blur a scene given on sub-pixels and integrate it over pixels.

        The transfer functions of point spread and streak are applied exactly, in the frequency
        domain. Beyond its border, the scene continues with the values at the border.

        Parameters
        ----------
        scene : (height · oversampling, width · oversampling) array
            Radiance averaged over each sub-pixel.
        oversampling : int
            Sub-pixels per pixel and axis.
        first_row : int
            Row of the frame in which the scene begins, for a rolling shutter.

        Returns
        -------
        (height, width) array
            Irradiance of the pixels.
        """
        margin = self.reach_px * oversampling
        padded_shape = [
            scipy.fft.next_fast_len(size + 2 * margin, real=True) for size in scene.shape
        ]
        padding = [
            (margin, total - size - margin)
            for total, size in zip(padded_shape, scene.shape, strict=True)
        ]
        spectrum = scipy.fft.rfft2(np.pad(scene, padding, mode="edge"))
        spectrum *= self._transfer(padded_shape, oversampling)
        height, width = scene.shape
        if self.motion is not None:
            rows = first_row + np.arange(height // oversampling, dtype=np.float64)
            return self.motion.integrate(
                spectrum, padded_shape, margin, oversampling, rows, width // oversampling
            )
        blurred = scipy.fft.irfft2(spectrum, s=padded_shape, overwrite_x=True)
        blurred = blurred[margin : margin + height, margin : margin + width]
        blocks = blurred.reshape(height // oversampling, oversampling, -1, oversampling)
        return np.asarray(blocks.mean(axis=(1, 3)))

    def _transfer(self, shape: list[int], oversampling: int) -> FloatArray | ComplexArray:
        fy = scipy.fft.fftfreq(shape[0])[:, None] * oversampling  # cycles per pixel
        fx = scipy.fft.rfftfreq(shape[1])[None, :] * oversampling
        transfer: FloatArray | ComplexArray
        if self.aberration is None:
            fall = -2.0 * (math.pi * self.psf_px) ** 2
            transfer = np.exp(fall * fy * fy) * np.exp(fall * fx * fx)
        else:
            transfer = self.aberration.transfer(self.psf_px, fx, fy)
        if any(self.streak_px):
            transfer *= np.sinc(self.streak_px[0] * fx + self.streak_px[1] * fy)
        return transfer


@dataclass(frozen=True, slots=True)
class Sensor:
    """Conversion of light to grey values."""

    full_well_e: float = 10_000.0  # electrons at which a pixel clips
    read_noise_e: float = 8.0  # standard deviation of the read noise [e⁻]
    tone: ToneCurve = ToneCurve.LINEAR
    sharpening: float = 0.0  # amount of the unsharp mask; 0: none
    sharpening_px: float = 1.0  # σ of its Gaussian [px]

    def __post_init__(self) -> None:
        require_range("full_well_e", self.full_well_e, 100.0, 1e7, unit="e⁻")
        require_range("read_noise_e", self.read_noise_e, 0.0, 1e4, unit="e⁻")
        require_range("sharpening", self.sharpening, 0.0, 10.0)
        require_range("sharpening_px", self.sharpening_px, 0.1, 10.0, unit="px")

    def expose(self, irradiance: FloatArray, gain: float, rng: np.random.Generator) -> GreyArray:
        """Return a frame of grey values (uint8) with noise."""
        exposure = self.collect(gain * np.maximum(irradiance, 0.0), rng)
        return np.rint(self.develop(exposure)).astype(np.uint8)

    def collect(self, exposure: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return exposures ≥ 0 as the pixels record them: with noise, clipped to 0…1."""
        deviation = np.sqrt(self.full_well_e * exposure + self.read_noise_e**2) / self.full_well_e
        noisy = exposure + deviation * rng.standard_normal(exposure.shape)
        return np.clip(noisy, 0.0, 1.0, out=noisy)

    def develop(self, exposure: FloatArray) -> FloatArray:
        """Return the grey values 0…255, not rounded, of an exposure 0…1."""
        grey = self.tone.apply(exposure)
        if self.sharpening > 0.0:
            from scipy.ndimage import gaussian_filter  # 0.05 s that outlooks do not need

            grey = grey + self.sharpening * (grey - gaussian_filter(grey, self.sharpening_px))
            grey = np.clip(grey, 0.0, 1.0)
        return grey * _WHITE_LEVEL
