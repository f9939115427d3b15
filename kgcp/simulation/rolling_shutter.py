"""A rolling shutter: rows are exposed one after the other while the image moves.

A row shows the image at its own moment, shifted as a whole and not sheared. So the blurred image is
evaluated, in the frequency domain, at pixels that are shifted row by row. This is exact if the
sub-pixels resolve the blur; nothing is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from kgcp.geometry.arrays import ComplexArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.settings import require_range


@dataclass(frozen=True, slots=True)
class ImageMotion:
    """Motion of the image, relative to the camera, while the rows of a frame are exposed."""

    mean_px_s: tuple[float, float] = (0.0, 0.0)  # in all frames, x and y [px/s]
    sd_px_s: float = 150.0  # standard deviation from frame to frame, per axis [px/s]

    def __post_init__(self) -> None:
        for value in self.mean_px_s:
            require_range("motion", value, -1e5, 1e5, unit="px/s")
        require_range("sd_px_s", self.sd_px_s, 0.0, 1e5, unit="px/s")

    def drawn(self, camera: Camera, still_row: float, rng: np.random.Generator) -> RowMotion:
        """Draw the motion of one frame about `still_row`, to whose moment the pose refers."""
        motion_px_s = self.mean_px_s + self.sd_px_s * rng.standard_normal(2)
        x, y = motion_px_s * camera.readout_s / (camera.height - 1)
        return RowMotion((float(x), float(y)), still_row, camera.height)


@dataclass(frozen=True, slots=True)
class RowMotion:
    """Motion of the image of one frame from row to row."""

    px_per_row: tuple[float, float]  # x and y [px]
    still_row: float  # row whose moment of exposure all poses refer to
    rows: int  # of the frame

    @property
    def reach_px(self) -> float:
        """Largest motion of the image in the frame [px]."""
        farthest = max(abs(self.still_row), abs(self.rows - 1 - self.still_row))
        return farthest * float(np.hypot(*self.px_per_row))

    def shift_px(self, rows: FloatArray) -> FloatArray:
        """Return how far the image has moved (n, 2) when rows (n,) are exposed [px]."""
        return np.asarray((rows - self.still_row)[:, None] * np.array(self.px_per_row))

    def integrate(
        self,
        spectrum: ComplexArray,
        padded_shape: list[int],
        margin: int,
        oversampling: int,
        rows: FloatArray,
        columns: int,
    ) -> FloatArray:
        """Integrate a blurred image over pixels (n, columns), each row at its own moment.

        Parameters
        ----------
        spectrum : array
            `rfft2` of the image on sub-pixels.
        padded_shape : list of int
            Of that image.
        margin : int
            Sub-pixels before the first pixel, on both axes.
        oversampling : int
            Sub-pixels per pixel and axis.
        rows : (n,) array
            Rows of the frame: the first is the first pixel's.
        columns : int
            Pixels per row.
        """
        height, width = padded_shape
        shift = self.shift_px(rows) * oversampling
        middle = margin + 0.5 * (oversampling - 1)  # of the first pixel, in sub-pixels
        centre_y = middle + oversampling * np.arange(len(rows)) - shift[:, 1]
        fy, fx = scipy.fft.fftfreq(height), scipy.fft.rfftfreq(width)  # cycles per sub-pixel
        wave = np.exp(2j * np.pi * np.multiply.outer(centre_y, fy))
        if height % 2 == 0:
            wave[:, height // 2] = wave[:, height // 2].real  # shared by both signs
        wave *= _mean_of_neighbours(fy, oversampling) / height
        row_spectra = wave @ spectrum
        row_spectra *= np.exp(2j * np.pi * np.multiply.outer(middle - shift[:, 0], fx))
        row_spectra *= _mean_of_neighbours(fx, oversampling)
        pixels: FloatArray = scipy.fft.irfft(row_spectra, n=width, axis=1)
        return pixels[:, : columns * oversampling : oversampling]


def _mean_of_neighbours(frequency: FloatArray, count: int) -> FloatArray:
    """Return the transfer of a mean over `count` samples, at cycles per sample."""
    angle = np.pi * np.where(frequency == 0.0, 0.5, frequency)
    transfer: FloatArray = np.sin(count * angle) / (count * np.sin(angle))
    transfer[frequency == 0.0] = 1.0
    return transfer
