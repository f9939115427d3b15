"""Settings of uneven light on the plates of a flight, with ranges."""

from __future__ import annotations

from dataclasses import dataclass

from kgcp.settings import require_range


@dataclass(frozen=True, slots=True)
class Shadow:
    """Shadows of straight things on a plate. Pairs are ranges."""

    # share of the light in full shade, which the sky sends; the sun sends the rest
    light_left: float = 0.45
    edges: int = 1  # shadows with one edge, as of a wall
    stripes: int = 0  # shadows with two edges, as of an antenna
    # width on the plate from full light to full shade, uniform in the logarithm [m]. The sun is 9.3
    # mrad wide: a thing 10 m away casts a penumbra of 0.09 m.
    penumbra_m: tuple[float, float] = (0.03, 0.25)
    stripe_m: tuple[float, float] = (0.02, 0.08)  # width of a stripe, uniform [m]

    def __post_init__(self) -> None:
        require_range("light_left", self.light_left, 0.0, 1.0)
        require_range("edges", self.edges, 0, 4)
        require_range("stripes", self.stripes, 0, 10)
        _require_pair("penumbra_m", self.penumbra_m, 1e-4, 2.0)
        _require_pair("stripe_m", self.stripe_m, 1e-3, 1.0)


@dataclass(frozen=True, slots=True)
class Dirt:
    """Reflectance that varies over a plate, and stains. Pairs are ranges, uniform."""

    sd: float = 0.05  # standard deviation of the reflectance, relative
    correlation_m: float = 0.1  # σ of the Gaussian autocorrelation on the plate [m]
    stains: int = 8  # number of round stains on the plate
    stain_radius_m: tuple[float, float] = (0.006, 0.016)  # radius at half their darkness [m]
    darkness: tuple[float, float] = (0.3, 0.9)  # share of the light that a stain takes

    def __post_init__(self) -> None:
        require_range("sd", self.sd, 0.0, 0.5)
        require_range("correlation_m", self.correlation_m, 0.01, 2.0, unit="m")
        require_range("stains", self.stains, 0, 1000)
        _require_pair("stain_radius_m", self.stain_radius_m, 0.001, 0.5)
        _require_pair("darkness", self.darkness, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Glare:
    """A highlight on a plate. Pairs are ranges, uniform."""

    # what it adds at its middle, as a share of the exposure that fills the well
    peak: tuple[float, float] = (0.2, 0.6)
    radius_m: tuple[float, float] = (0.12, 0.3)  # σ of its Gaussian on the plate [m]

    def __post_init__(self) -> None:
        _require_pair("peak", self.peak, 0.0, 10.0)
        _require_pair("radius_m", self.radius_m, 0.01, 10.0)


def _require_pair(key: str, pair: tuple[float, float], low: float, high: float) -> None:
    require_range(key, pair[0], low, high)
    require_range(key, pair[1], pair[0], high)
