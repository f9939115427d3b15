"""Uneven light on a plate: shade, dirt, stains, a highlight.

A place of the plate that was printed with radiance L has the radiance

    L · (share of the light that reaches it) · (reflectance relative to a clean print) + highlight,

in linear light, before point spread and exposure. Shade and dirt act on ink and white alike, and a
highlight is added to both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.plane_raster import PlaneRaster

_REACH_M = 0.9  # largest distance of the plate's corners from its centre
_EDGE_REACH_M = 0.45  # largest distance of shadow edges from the centre: they cross the ring
_STRIPE_REACH_M = 0.4
_HIGHLIGHT_REACH_M = 0.45
_FAR_M = 100.0  # width of a shade with a single edge
# Cells of the dirt's lattice per correlation length. Cubic interpolation is then accurate to 1 %.
_CELLS_PER_LENGTH = 3.0
_MIN_REFLECTANCE = 0.05
_STAIN_SOFTNESS = 0.3  # width of the transition on either side of the outline, over the radius
_GAUSS_POINTS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(4)  # per side of a sub-pixel


@dataclass(frozen=True, slots=True)
class Shade:
    """A straight strip of shade between two parallel edges."""

    normal: tuple[float, float]  # unit vector across the strip
    # position of its middle line along `normal`, and its width at half shade [m]
    middle_m: float
    width_m: float
    penumbra_m: float  # width of either edge [m]

    def sunlight(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return the share of the sun's disc that is visible from places on the plate."""
        across_m = self.normal[0] * x_m + self.normal[1] * y_m - self.middle_m
        half_m = 0.5 * self.width_m
        hidden = self._risen(across_m + half_m) - self._risen(across_m - half_m)
        return 1.0 - hidden

    def _risen(self, distance_m: FloatArray) -> FloatArray:
        """Return the share of a uniform disc above a straight horizon."""
        height = distance_m * (2.0 / self.penumbra_m)
        share = (height > 0.0).astype(np.float64)
        soft = np.nonzero(np.abs(height) < 1.0)
        height = height[soft]
        segment = height * np.sqrt(1.0 - height * height) + np.arcsin(height)
        share[soft] = 0.5 + segment / math.pi
        return share


@dataclass(frozen=True, slots=True)
class Stain:
    """A round stain: centre and radius [m], share of the light that it absorbs."""

    centre_m: tuple[float, float]
    radius_m: float
    darkness: float

    def absorb(self, reflectance: FloatArray, x_m: FloatArray, y_m: FloatArray) -> None:
        """Darken the reflectance of places (n,) on the plate, in place."""
        dx, dy = x_m - self.centre_m[0], y_m - self.centre_m[1]
        reach = self.radius_m * (1.0 + _STAIN_SOFTNESS)
        near = np.nonzero(dx * dx + dy * dy < reach * reach)
        radius = np.hypot(dx[near], dy[near]) / self.radius_m
        inwards = np.clip((1.0 - radius) / _STAIN_SOFTNESS, -1.0, 1.0)
        reflectance[near] *= 1.0 - self.darkness * (0.5 + 0.5 * np.sin(0.5 * np.pi * inwards))


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Reflectance on a square lattice about the plate's centre; `cell_m` is its spacing [m]."""

    lattice: FloatArray
    cell_m: float

    @classmethod
    def drawn(cls, dirt: Dirt, rng: np.random.Generator) -> Cloud:
        """Draw a Gaussian random field of mean 1."""
        cell_m = dirt.correlation_m / _CELLS_PER_LENGTH
        size = 2 * math.ceil(_REACH_M / cell_m) + 5
        # Noise smoothed by σ is correlated by √2 σ, and its deviation falls by 1 / (2 √π σ).
        smoothing = _CELLS_PER_LENGTH / math.sqrt(2.0)
        noise = gaussian_filter(rng.standard_normal((size, size)), smoothing, mode="wrap")
        noise *= dirt.sd * 2.0 * math.sqrt(math.pi) * smoothing
        return cls(1.0 + noise, cell_m)

    def reflectance(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return the reflectance at places on the plate, relative to a clean one."""
        middle = 0.5 * (len(self.lattice) - 1)
        places = np.stack((y_m / self.cell_m + middle, x_m / self.cell_m + middle))
        interpolated = map_coordinates(self.lattice, places, order=3, mode="nearest")
        return np.asarray(np.maximum(interpolated, _MIN_REFLECTANCE))


@dataclass(frozen=True, slots=True)
class Highlight:
    """A Gaussian highlight: centre and σ [m], and the radiance that it adds at its centre."""

    centre_m: tuple[float, float]
    radius_m: float
    radiance: float

    def added(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return the added radiance at places on the plate."""
        dx, dy = x_m - self.centre_m[0], y_m - self.centre_m[1]
        added: FloatArray = np.exp((dx * dx + dy * dy) * (-0.5 / self.radius_m**2))
        return self.radiance * added


@dataclass(frozen=True, slots=True, eq=False)
class PlateLight:
    """The light on one plate in one frame, in the plate's axes."""

    light_left: float = 1.0  # share of the light in full shade
    shades: tuple[Shade, ...] = ()
    stains: tuple[Stain, ...] = ()
    cloud: Cloud | None = None
    highlight: Highlight | None = None

    @classmethod
    def drawn(
        cls,
        shadow: Shadow | None,
        dirt: Dirt | None,
        glare: Glare | None,
        gain: float,
        rng: np.random.Generator,
    ) -> PlateLight:
        """Draw the light of one frame; `gain` is its exposure, to which highlights are relative."""
        return cls(
            1.0 if shadow is None else shadow.light_left,
            () if shadow is None else _cast_shades(shadow, rng),
            () if dirt is None else _drop_stains(dirt, rng),
            Cloud.drawn(dirt, rng) if dirt is not None and dirt.sd else None,
            None if glare is None else _draw_highlight(glare, gain, rng),
        )

    def shine_on(self, patch: PlaneRaster, painted: FloatArray, opacity: FloatArray) -> FloatArray:
        """Return the radiance of sub-pixels under this light.

        Parameters
        ----------
        patch : PlaneRaster
            Of the plate.
        painted : array
            Mean radiance of the sub-pixels under uniform light.
        opacity : array
            Share of the plate in the sub-pixels.
        """
        light = self.share(patch)
        light = painted * light + _share_of_edges(painted, light)
        if self.highlight is not None:
            light += opacity * self.highlight.added(patch.x_m, patch.y_m)
        return light

    def share(self, patch: PlaneRaster) -> FloatArray:
        """Return the light from the sub-pixels of a patch, relative to a clean and fully lit print.

        These are means over the sub-pixels, integrated where shade or a stain begins.
        """
        x_m, y_m = patch.x_m, patch.y_m
        share = self._sharp_share(x_m, y_m)
        if np.ptp(share) > 0.0:
            self._integrate(share, x_m, y_m)
        if self.cloud is not None:
            share *= self.cloud.reflectance(x_m, y_m)
        return share

    def _integrate(self, share: FloatArray, x_m: FloatArray, y_m: FloatArray) -> None:
        """Replace shares at the sub-pixels' centres by means, in place, where they vary."""
        down, across = np.gradient(share)
        varies = np.nonzero((down != 0.0) | (across != 0.0))
        (x_down, x_across), (y_down, y_across) = (
            [0.5 * step for step in _steps_at(places, *varies)] for places in (x_m, y_m)
        )
        x_m, y_m = x_m[varies], y_m[varies]
        mean = np.zeros_like(x_m)
        for a, weight_a in zip(_GAUSS_POINTS, 0.5 * _GAUSS_WEIGHTS, strict=True):
            for b, weight_b in zip(_GAUSS_POINTS, 0.5 * _GAUSS_WEIGHTS, strict=True):
                x_at, y_at = x_m + a * x_across + b * x_down, y_m + a * y_across + b * y_down
                mean += weight_a * weight_b * self._sharp_share(x_at, y_at)
        share[varies] = mean

    def _sharp_share(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return the share of light at places on the plate, by shade and stains."""
        share = np.ones_like(x_m)
        for shade in self.shades:
            share *= shade.sunlight(x_m, y_m)
        share = self.light_left + (1.0 - self.light_left) * share if self.shades else share
        for stain in self.stains:
            stain.absorb(share, x_m, y_m)
        return share


def _share_of_edges(painted: FloatArray, light: FloatArray) -> FloatArray:
    """Return the mean of painted · light minus the product of their means.

    The difference matters in sub-pixels with an edge of the print in which the light varies. Let S
    be the share beyond a straight edge with unit normal n. The first moment of that side in a unit
    square is about S (1 − S) n / 2: exact if the edge is parallel to a side, 6 % too large at 45°.
    The levels on both sides are taken from the neighbouring sub-pixels.
    """
    excess = np.zeros_like(painted)
    if np.ptp(light) == 0.0:
        return excess
    low, high = minimum_filter(painted, 3), maximum_filter(painted, 3)
    edge = np.nonzero(high > low)
    down, across = _steps_at(painted, *edge)
    slope = np.hypot(down, across)
    is_sloped = slope > 0.0
    edge = edge[0][is_sloped], edge[1][is_sloped]
    down, across, slope = down[is_sloped], across[is_sloped], slope[is_sloped]
    light_down, light_across = _steps_at(light, *edge)
    moment = (painted[edge] - low[edge]) * (high[edge] - painted[edge])
    moment /= 2.0 * (high[edge] - low[edge]) * slope
    excess[edge] = moment * (down * light_down + across * light_across)
    return excess


def _steps_at(
    values: FloatArray, rows: IndexArray, columns: IndexArray
) -> tuple[FloatArray, FloatArray]:
    """Return the change per sub-pixel (n,), downwards and rightwards, as by `numpy.gradient`."""
    last_row, last_column = np.array(values.shape) - 1
    above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, last_row)
    left, right = np.maximum(columns - 1, 0), np.minimum(columns + 1, last_column)
    down = (values[below, columns] - values[above, columns]) / (below - above)
    across = (values[rows, right] - values[rows, left]) / (right - left)
    return down, across


def _cast_shades(shadow: Shadow, rng: np.random.Generator) -> tuple[Shade, ...]:
    shades = []
    for index in range(shadow.edges + shadow.stripes):
        direction = rng.uniform(0.0, 2.0 * math.pi)
        penumbra_m = float(np.exp(rng.uniform(*np.log(shadow.penumbra_m))))
        if index < shadow.edges:
            width_m = _FAR_M
            middle_m = 0.5 * _FAR_M + rng.uniform(-_EDGE_REACH_M, _EDGE_REACH_M)
        else:
            width_m = rng.uniform(*shadow.stripe_m)
            middle_m = rng.uniform(-_STRIPE_REACH_M, _STRIPE_REACH_M)
        normal = (math.cos(direction), math.sin(direction))
        shades.append(Shade(normal, middle_m, width_m, penumbra_m))
    return tuple(shades)


def _drop_stains(dirt: Dirt, rng: np.random.Generator) -> tuple[Stain, ...]:
    return tuple(
        Stain(
            _place_within(_REACH_M / math.sqrt(2.0), rng),
            rng.uniform(*dirt.stain_radius_m),
            rng.uniform(*dirt.darkness),
        )
        for _ in range(dirt.stains)
    )


def _draw_highlight(glare: Glare, gain: float, rng: np.random.Generator) -> Highlight:
    return Highlight(
        _place_within(_HIGHLIGHT_REACH_M, rng),
        rng.uniform(*glare.radius_m),
        rng.uniform(*glare.peak) / gain,
    )


def _place_within(radius_m: float, rng: np.random.Generator) -> tuple[float, float]:
    """Return a random place within a circle about the plate's centre."""
    radius, angle = radius_m * math.sqrt(rng.random()), rng.uniform(0.0, 2.0 * math.pi)
    return radius * math.cos(angle), radius * math.sin(angle)
