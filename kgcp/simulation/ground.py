"""The ground: multi-octave texture in fixed places, fields, a ring road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from kgcp.geometry.arrays import FloatArray
from kgcp.simulation.plane_raster import PlaneRaster

_TILE = 1024  # texels per side of the periodic noise
_SPECTRUM_EXPONENT = 1.2  # amplitude ~ 1/frequency^e: between pink noise and natural images
_LEVELS = 8
_LOWEST_FREQUENCY = 4.0 / _TILE  # larger structures would show that the tile repeats
_STEP = 2  # texture is looked up at every second sub-pixel and interpolated: a quarter of the time
_ROAD_HALF_WIDTH_M = 3.6
_MARKING_M = 0.12
_DASH_M = 6.0


@dataclass(frozen=True, slots=True)
class TextureLayer:
    """One appearance of the noise tile on the ground: its period [m] and its turn (cos, sin)."""

    period_m: float
    cos: float
    sin: float


_FIELDS = TextureLayer(period_m=530.0, cos=0.8, sin=0.6)
_PLANTS = TextureLayer(period_m=41.0, cos=0.28, sin=-0.96)
_GRAINS = TextureLayer(period_m=11.3, cos=-0.6, sin=0.8)


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A textured plane with fields and a ring road."""

    # a periodic noise tile of zero mean and unit variance, and its reductions by two
    pyramid: tuple[FloatArray, ...]
    road_radius_m: float  # radius of the road's middle line about the origin [m]

    @classmethod
    def grown(cls, rng: np.random.Generator, road_radius_m: float) -> Ground:
        """Grow the noise tile: white noise filtered to a power-law spectrum."""
        fy = scipy.fft.fftfreq(_TILE)[:, None]
        fx = scipy.fft.rfftfreq(_TILE)[None, :]
        frequency = np.sqrt(fx * fx + fy * fy)
        frequency[frequency < _LOWEST_FREQUENCY] = np.inf
        spectrum = scipy.fft.rfft2(rng.standard_normal((_TILE, _TILE)))
        tile = scipy.fft.irfft2(spectrum * frequency**-_SPECTRUM_EXPONENT)
        pyramid = [tile / tile.std()]
        for _ in range(_LEVELS - 1):
            size = len(pyramid[-1]) // 2
            pyramid.append(pyramid[-1].reshape(size, 2, size, 2).mean(axis=(1, 3)))
        return cls(tuple(pyramid), road_radius_m)

    def radiance(self, patch: PlaneRaster) -> FloatArray:
        """Return what the ground plane sends to each sub-pixel of a patch, without clutter."""
        x, y = patch.x_m[::_STEP, ::_STEP], patch.y_m[::_STEP, ::_STEP]
        gsd_m = float(np.hypot(x[0, -1] - x[0, 0], y[0, -1] - y[0, 0])) / patch.x_m.shape[1]
        soil = np.clip(0.5 + 1.2 * self._sample(_FIELDS, x, y, gsd_m), 0.0, 1.0)
        texture = 0.30 * self._sample(_PLANTS, x, y, gsd_m)
        texture += 0.25 * self._sample(_GRAINS, x, y, gsd_m)
        texture *= 1.2 - 0.7 * soil
        fields = (0.14 + 0.18 * soil) * _lifted(texture)
        light = _enlarged(fields, patch.x_m.shape)
        self._pave(light, patch, _enlarged(0.20 * _lifted(0.4 * texture), light.shape), gsd_m)
        return light

    def _sample(
        self, layer: TextureLayer, x: FloatArray, y: FloatArray, gsd_m: float
    ) -> FloatArray:
        """Sample the noise bilinearly, on the level whose texels match the pixels."""
        texel_m = layer.period_m / _TILE
        level = int(np.clip(np.round(np.log2(max(gsd_m / texel_m, 1.0))), 0, _LEVELS - 1))
        tile = self.pyramid[level]
        scale = len(tile) / layer.period_m
        u = (layer.cos * scale) * x + (layer.sin * scale) * y
        v = (-layer.sin * scale) * x + (layer.cos * scale) * y
        return _bilinear(tile, u, v)

    def _pave(
        self, light: FloatArray, patch: PlaneRaster, asphalt: FloatArray, gsd_m: float
    ) -> None:
        """Lay the road over the ground, with edge lines and a dashed middle line, in place."""
        offset = np.sqrt(patch.x_m * patch.x_m + patch.y_m * patch.y_m) - self.road_radius_m
        on_road = np.nonzero(np.abs(offset) < _ROAD_HALF_WIDTH_M)
        x, y, offset = patch.x_m[on_road], patch.y_m[on_road], offset[on_road]
        along = np.arctan2(y, x) * self.road_radius_m
        to_edge_line = np.abs(np.abs(offset) - 0.92 * _ROAD_HALF_WIDTH_M)
        dashed = np.mod(along, 2.0 * _DASH_M) < _DASH_M
        to_line = np.where(dashed, np.minimum(to_edge_line, np.abs(offset)), to_edge_line)
        paint = np.clip(0.5 + (0.5 * _MARKING_M - to_line) / gsd_m, 0.0, 1.0)
        paint *= min(1.0, _MARKING_M / gsd_m)
        surface = asphalt[on_road]
        light[on_road] = surface + paint * (0.6 - surface)


def _lifted(texture: FloatArray) -> FloatArray:
    """Return about exp(texture), never negative, the same to the last bit on every processor."""
    lifted: FloatArray = np.square(1.0 + 0.25 * texture)
    return np.square(lifted, out=lifted)


def _bilinear(tile: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Interpolate a periodic tile (its side a power of two) at texel coordinates."""
    size = len(tile)
    u0, v0 = np.floor(u), np.floor(v)
    u -= u0
    v -= v0
    left = u0.astype(np.int32) & (size - 1)
    right = (left + 1) & (size - 1)
    top = (v0.astype(np.int32) & (size - 1)) * size
    bottom = (top + size) & (size * size - 1)
    flat = tile.ravel()
    upper = flat.take(top + left)
    upper += u * (flat.take(top + right) - upper)
    lower = flat.take(bottom + left)
    lower += u * (flat.take(bottom + right) - lower)
    lower -= upper
    lower *= v
    upper += lower
    return upper


def _enlarged(coarse: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Interpolate linearly between every `_STEP`-th sample; beyond the last it is flat."""
    rows, columns = (
        np.minimum(np.arange(size) / _STEP, samples - 1.0)
        for size, samples in zip(shape, coarse.shape, strict=True)
    )
    top = np.minimum(rows.astype(int), coarse.shape[0] - 2)
    left = np.minimum(columns.astype(int), coarse.shape[1] - 2)
    down, right = (rows - top)[:, None], columns - left
    tall = coarse[top] * (1.0 - down) + coarse[top + 1] * down
    return np.asarray(tall[:, left] * (1.0 - right) + tall[:, left + 1] * right)
