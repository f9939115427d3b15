"""Fields without a lattice: discs that lie anywhere, on planes of their own, with or without codes.

Their frame is that of whoever surveyed them.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.settings import require_range
from kgcp.targets.fields.layout import (
    LEAST_POINTS,
    Field,
    FieldBar,
    FieldPolarity,
    check_bars,
    require_diameter,
    require_hole,
)

MOST_DISCS = 2000
"""Of a field of points."""

_LEAST_WIDTH = 0.02  # of its length, of a field that is no line
_ALIKE = 0.9  # cosine of the angle between normals of discs that face the same way
_UNIT_OFF = 1e-3  # of a normal's length
_FARTHEST_M = 1e6
_BITS = (6, 24)
_MOST_RING = 10.0  # diameters of the disc


@dataclass(frozen=True, slots=True)
class CodeRing:
    """A ring of sectors around each disc, which is its code.

    Attributes
    ----------
    bits : int
        Sectors of equal size; a sector that has the disc's own brightness is a 1.
    inner, outer : float
        Diameters of the ring over that of the disc.

    Raises
    ------
    SettingError
        On making one, for what cannot be read.
    """

    bits: int
    inner: float
    outer: float

    def __post_init__(self) -> None:
        require_range("bits", self.bits, *_BITS)
        require_range("ring", self.inner, 1.2, _MOST_RING)
        require_range("ring", self.outer, 1.1 * self.inner, _MOST_RING)

    def canonical(self, code: int) -> int:
        """Return the least number that a turn of the ring makes of a code."""
        mask = (1 << self.bits) - 1
        return min(
            ((code >> turn) | (code << (self.bits - turn))) & mask for turn in range(self.bits)
        )


@dataclass(frozen=True, slots=True)
class FieldPoint:
    """One disc, or ring, of a field.

    Attributes
    ----------
    name : str
    position_m : (3,) tuple of float
        Of its centre, in the field's frame [m].
    diameter_m, inner_diameter_m : float
        Of the disc, and of its hole; 0: none [m].
    normal : (3,) tuple of float
        Unit vector square to it, to either side.
    sd_m : (3,) tuple of float or None
        Standard deviations of its coordinates [m]; None: those of the field.
    code : int or None
        Any of the numbers that the turns of its ring of sectors make, read clockwise from the
        front; None: it has none.
    """

    name: str
    position_m: tuple[float, float, float]
    diameter_m: float
    inner_diameter_m: float = 0.0
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    sd_m: tuple[float, float, float] | None = None
    code: int | None = None


@dataclass(frozen=True, slots=True)
class PointField:
    """A field of discs with coordinates of their own.

    Attributes
    ----------
    name : str
        For reports.
    points : tuple of FieldPoint
    polarity : FieldPolarity
    flat_sd_m : tuple of float
        How far discs may be from where they are said to be, along x, y, z: standard deviations [m].
    bars : tuple of FieldBar
        Measured distances.
    code : CodeRing or None
        How codes are written; None: no disc has one.
    is_diameter_stated : bool
        Whether the diameters are known; otherwise only their ratios are meant.

    Raises
    ------
    SettingError
        On making one, for what cannot be a field.
    """

    name: str
    points: tuple[FieldPoint, ...]
    polarity: FieldPolarity = FieldPolarity.DARK
    flat_sd_m: tuple[float, float, float] = (0.00005, 0.00005, 0.00005)
    bars: tuple[FieldBar, ...] = ()
    code: CodeRing | None = None
    is_diameter_stated: bool = True

    def __post_init__(self) -> None:
        if not LEAST_POINTS <= len(self.points) <= MOST_DISCS:
            raise SettingError(
                "points",
                f"{len(self.points)} is not a field of {LEAST_POINTS} to {MOST_DISCS} discs",
                "list all discs",
            )
        for sd in self.flat_sd_m:
            require_range("flat_sd_m", sd, 0.0, 1.0, unit="m", open_low=True)
        for point in self.points:
            _check_point(point)
        _require_once("name", [point.name for point in self.points])
        self._check_codes()
        self._check_places()
        check_bars(self.bars, self.names(), self.points_m())

    def _check_codes(self) -> None:
        codes = [point.code for point in self.points if point.code is not None]
        if self.code is None:
            if codes:
                raise SettingError("code", "is missing, and discs have codes", "add a table [code]")
            return
        for code in codes:
            if not 0 < code < (1 << self.code.bits) - 1:
                raise SettingError(
                    "code",
                    f"{code} is not of {self.code.bits} bits, some of them 1 and some 0",
                    "correct it or bits",
                )
        if len(codes) < LEAST_POINTS:
            raise SettingError(
                "code",
                f"{len(codes)} of the discs have one, and names need {LEAST_POINTS}",
                "give the codes of the others, or delete [code] and all codes",
            )
        _require_once("code", [str(self.code.canonical(code)) for code in codes])

    def _check_places(self) -> None:
        centres = self.points_m()
        free_m = gaps_between(centres) - self._reaches_m()
        first, second = np.unravel_index(int(free_m.argmin()), free_m.shape)
        if free_m[first, second] <= 0.0:
            names = (self.points[int(first)].name, self.points[int(second)].name)
            raise SettingError(
                "points", f"{names[0]} and {names[1]} overlap", "correct their places or diameters"
            )
        widths = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
        if widths[1] < _LEAST_WIDTH * widths[0]:
            raise SettingError(
                "points", "lie in one row, which does not determine a camera", "add some beside it"
            )

    def _reaches_m(self) -> FloatArray:
        """Return how far (m, m) centres must be apart [m].

        Codes count where two discs face the same way: across an edge they may come closer.
        """
        radii, codes = self.radii_m(), self.radii_m()
        if self.code is not None:
            codes[[point.code is not None for point in self.points]] *= self.code.outer
        normals = self.normals()
        is_alike = np.abs(normals @ normals.T) > _ALIKE
        return np.where(is_alike, codes[:, None] + codes, radii[:, None] + radii)

    @property
    def named_by(self) -> str:
        """What gives the discs of a photograph their names."""
        return "places" if self.code is None else "code"

    @property
    def starts_from_homographies(self) -> bool:
        """Whether photographs are first taken for those of the plane z = 0: never, of points."""
        return False

    @property
    def pitch_m(self) -> float:
        """Distance of neighbours: the median [m]."""
        return float(np.median(gaps_between(self.points_m()).min(axis=1)))

    def names(self) -> tuple[str, ...]:
        """Return the names of all discs."""
        return tuple(point.name for point in self.points)

    def points_m(self) -> FloatArray:
        """Return where the discs are meant to be (m, 3), in the field's frame [m]."""
        return np.array([point.position_m for point in self.points])

    def point_sds_m(self) -> FloatArray:
        """Return how far they may be from there (m, 3): standard deviations [m]."""
        return np.array([point.sd_m or self.flat_sd_m for point in self.points])

    def normals(self) -> FloatArray:
        """Return unit vectors (m, 3) square to the discs."""
        return np.array([point.normal for point in self.points])

    def radii_m(self) -> FloatArray:
        """Return the outer radii (m,) of the discs [m]."""
        return np.array([0.5 * point.diameter_m for point in self.points])

    def inner_radii_m(self) -> FloatArray:
        """Return the radii (m,) of the discs' holes, 0 where there is none [m]."""
        return np.array([0.5 * point.inner_diameter_m for point in self.points])

    def symmetries(self) -> list[IndexArray]:
        """Return no turns: discs that are named one by one have one way up."""
        return []

    def with_diameters(self, scale: float) -> PointField:
        """Return the field with all diameters multiplied, as they were measured."""
        points = tuple(
            replace(
                point,
                diameter_m=scale * point.diameter_m,
                inner_diameter_m=scale * point.inner_diameter_m,
            )
            for point in self.points
        )
        return replace(self, points=points)


AnyField = Field | PointField
"""What photographs are taken of."""


def gaps_between(points: FloatArray) -> FloatArray:
    """Return the distances (m, m) of points (m, d) from each other, infinite from themselves."""
    squares = np.zeros((len(points), len(points)))
    for axis in points.T:
        squares += (axis[:, None] - axis) ** 2
    np.fill_diagonal(squares, np.inf)
    return np.asarray(np.sqrt(squares))


def _check_point(point: FieldPoint) -> None:
    where = f"of {point.name}"
    if not all(abs(value) <= _FARTHEST_M for value in point.position_m):
        raise SettingError("position_m", f"{where} is out of range", "give it in metres")
    require_diameter(f"diameter_m {where}", point.diameter_m)
    require_hole(f"inner_diameter_m {where}", point.inner_diameter_m, point.diameter_m)
    if abs(math.hypot(*point.normal) - 1.0) > _UNIT_OFF:
        raise SettingError(f"normal {where}", "is not of length 1", "divide it by its length")
    for sd in point.sd_m or ():
        require_range(f"sd {where}", sd, 0.0, 1.0, unit="m", open_low=True)


def _require_once(key: str, values: list[str]) -> None:
    value, count = Counter(values).most_common(1)[0]
    if count > 1:
        raise SettingError(key, f"{value} stands {count} times", "keep one of them")
