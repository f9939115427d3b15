"""From one map to another: positions, and what is given along the map's axes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Self

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.mapframe import MapFrame, missing_grids, parse_crs

COMMAND_LINE = "--crs"


@dataclass(frozen=True, slots=True, eq=False)
class MapChange:
    """The way from the flight's map to another one, datum and geoid included.

    Attributes
    ----------
    source : MapFrame
        The flight's.
    target : MapFrame
        Of the other CRS.
    """

    source: MapFrame
    target: MapFrame
    _between: Transformer
    _where: str = COMMAND_LINE

    @classmethod
    def to(
        cls, crs: str, source: MapFrame, near_map: FloatArray, where: str = COMMAND_LINE
    ) -> Self:
        """Prepare the way to `crs` (anything pyproj reads) about the point (3,) of the source map.

        `where` is what an error names as the place that the CRS was given in.

        Raises
        ------
        KgcpError
            If the CRS is unknown or unusable, no exact operation leads to it, or one that PROJ
            knows needs a grid that is not installed.
        """
        between = best_transformer(
            parse_crs(source.crs),
            parse_crs(crs, where),
            f"{where} {crs!r}: the way from {source.crs!r}",
        )
        draft = cls(source, source, between, where)
        target = MapFrame.at(crs, draft.positions(np.reshape(near_map, (1, 3)))[0], where)
        return cls(source, target, between, where)

    def positions(self, xyz: FloatArray) -> FloatArray:
        """Bring points (n, 3) of the source map into the other one (n, 3)."""
        x, y, z = np.asarray(xyz, dtype=np.float64).T
        try:
            moved = np.column_stack(self._between.transform(x, y, z, errcheck=True))
        except ProjError as error:
            text = " ".join(str(error).split())
            raise KgcpError(
                f"{self._where}: {self.source.crs!r} does not lead to the CRS asked for here"
                f" ({text}); give one that covers the flight"
            ) from error
        return moved

    def axes(self, xyz: FloatArray) -> FloatArray:
        """Return the rotations (..., 3, 3) from the source map's axes to the other's at (..., 3).

        Both maps are compared with east, north and up of the same place: what datums differ
        from each other in direction is some 1e-5, which no standard deviation feels.
        """
        points = np.reshape(np.asarray(xyz, dtype=np.float64), (-1, 3))
        here = _level_from_grid(self.source, points)
        there = _level_from_grid(self.target, self.positions(points))
        turned: FloatArray = np.swapaxes(there, 1, 2) @ here
        return turned.reshape(*np.shape(xyz), 3)


def _level_from_grid(frame: MapFrame, xyz: FloatArray) -> FloatArray:
    enu = frame.enu_from_map(xyz)
    rotations: FloatArray = np.swapaxes(frame.level_rotations(enu), 1, 2) @ frame.grid_rotation(enu)
    return rotations


def best_transformer(source: CRS, target: CRS, where: str) -> Transformer:
    """Return the best operation between two CRS, or say which grid it lacks.

    A second-best one would be metres off and look the same, above all where the heights of a
    geoid are taken as ellipsoidal.

    Raises
    ------
    KgcpError
        Beginning with `where`, which names both, if no exact operation is known, or one that PROJ
        knows needs a grid that is not installed.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a missing grid is an error below
        known = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
    if known.best_available and known.transformers:
        return Transformer.from_crs(
            source, target, always_xy=True, only_best=True, allow_ballpark=False
        )
    missing = missing_grids(known)
    if missing:
        raise KgcpError(
            f"{where} needs the grid {', '.join(missing)}, which is not installed; install it with"
            f" 'pyproj sync --file {missing[0]}', or give a CRS of the flight's datum and heights"
        )
    raise KgcpError(f"{where} is not known exactly; give a CRS of the flight's datum and heights")
