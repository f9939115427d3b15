"""What every exporter starts from: the points, and how their map is written down."""

from __future__ import annotations

from dataclasses import dataclass

from pyproj import CRS

from kgcp.kgcps import Kgcp

_METRE_DECIMALS = 5  # 0.01 mm: points that differ never look the same
_DEGREE_DECIMALS = 10


@dataclass(frozen=True, slots=True)
class MapPoints:
    """KGCPs and the map of their coordinates.

    Attributes
    ----------
    crs : str
        As in flight.toml.
    kgcps : tuple of Kgcp
    """

    crs: str
    kgcps: tuple[Kgcp, ...]

    @property
    def parsed_crs(self) -> CRS:
        """The CRS of the coordinates."""
        return CRS.from_user_input(self.crs)

    def coordinates(self, point: Kgcp, *, height_factor: float = 1.0) -> tuple[str, str, str]:
        """Return x, y, z of a point as text, to 0.01 mm; z times `height_factor`."""
        decimals = _DEGREE_DECIMALS if self.parsed_crs.is_geographic else _METRE_DECIMALS
        x, y, z = point.position_map
        return f"{x:.{decimals}f}", f"{y:.{decimals}f}", f"{z * height_factor:.{_METRE_DECIMALS}f}"
