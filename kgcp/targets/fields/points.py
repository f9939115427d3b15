"""Fields without a lattice: discs anywhere, each in its own plane, with or without codes.

Their frame is that of the survey.
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
"""Largest number of discs of a field of points."""

_MIN_WIDTH = 0.02  # of a field, relative to its length; a narrower one counts as a line
_MIN_COSINE = 0.9  # of the angle between normals of discs that face the same way
_UNIT_TOLERANCE = 1e-3  # of a normal's length
_MAX_COORDINATE_M = 1e6
_BITS_RANGE = (6, 24)
_MAX_RING_RATIO = 10.0  # diameter of a code ring, relative to that of the disc


@dataclass(frozen=True, slots=True)
class CodeRing:
    """A ring of sectors around each disc that carries its code.

    Attributes
    ----------
    bits : int
        Number of equal sectors; a sector as bright as the disc is a 1.
    inner, outer : float
        Diameters of the ring, relative to that of the disc.

    Raises
    ------
    SettingError
        On construction, if the ring could not be read.
    """

    bits: int
    inner: float
    outer: float

    def __post_init__(self) -> None:
        require_range("bits", self.bits, *_BITS_RANGE)
        require_range("ring", self.inner, 1.2, _MAX_RING_RATIO)
        require_range("ring", self.outer, 1.1 * self.inner, _MAX_RING_RATIO)

    def canonical(self, code: int) -> int:
        """Return the smallest number that a code becomes by rotating the ring."""
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
        Position of its centre in the field's frame [m].
    diameter_m, inner_diameter_m : float
        Diameters of the disc and of its hole [m]; 0: no hole.
    normal : (3,) tuple of float
        Unit normal, towards either side.
    sd_m : (3,) tuple of float or None
        Standard deviations of its coordinates [m]; None: those of the field.
    code : int or None
        Number in the ring of sectors, read clockwise from the front, beginning with any sector;
        None: no code.
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
    """A field of discs with individual coordinates.

    Attributes
    ----------
    name : str
        For reports.
    points : tuple of FieldPoint
    polarity : FieldPolarity
    flat_sd_m : tuple of float
        Standard deviations of the discs' stated coordinates along x, y, z [m].
    bars : tuple of FieldBar
        Measured distances.
    code : CodeRing or None
        Layout of the codes; None: no disc has one.
    is_diameter_stated : bool
        Whether the diameters are known; otherwise only their ratios count.

    Raises
    ------
    SettingError
        On construction, if the field is impossible.
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
        if widths[1] < _MIN_WIDTH * widths[0]:
            raise SettingError(
                "points", "lie in one row, which does not determine a camera", "add some beside it"
            )

    def _reaches_m(self) -> FloatArray:
        """Return the least distances (m, m) of centres [m].

        Codes count only between discs that face the same way. On both sides of an edge, discs may
        be closer to each other.
        """
        radii, codes = self.radii_m(), self.radii_m()
        if self.code is not None:
            codes[[point.code is not None for point in self.points]] *= self.code.outer
        normals = self.normals()
        is_alike = np.abs(normals @ normals.T) > _MIN_COSINE
        return np.where(is_alike, codes[:, None] + codes, radii[:, None] + radii)

    @property
    def named_by(self) -> str:
        """How discs are identified."""
        return "places" if self.code is None else "code"

    @property
    def starts_from_homographies(self) -> bool:
        """Whether start values come from homographies of the plane z = 0: never for points."""
        return False

    @property
    def pitch_m(self) -> float:
        """Median distance of nearest neighbours [m]."""
        return float(np.median(gaps_between(self.points_m()).min(axis=1)))

    def names(self) -> tuple[str, ...]:
        """Return the names of all discs."""
        return tuple(point.name for point in self.points)

    def points_m(self) -> FloatArray:
        """Return the stated positions (m, 3) of the discs, in the field's frame [m]."""
        return np.array([point.position_m for point in self.points])

    def point_sds_m(self) -> FloatArray:
        """Return the standard deviations (m, 3) of the stated positions [m]."""
        return np.array([point.sd_m or self.flat_sd_m for point in self.points])

    def normals(self) -> FloatArray:
        """Return the unit normals (m, 3) of the discs."""
        return np.array([point.normal for point in self.points])

    def radii_m(self) -> FloatArray:
        """Return the outer radii (m,) of the discs [m]."""
        return np.array([0.5 * point.diameter_m for point in self.points])

    def inner_radii_m(self) -> FloatArray:
        """Return the radii (m,) of the discs' holes, 0 where there is none [m]."""
        return np.array([0.5 * point.inner_diameter_m for point in self.points])

    def symmetries(self) -> list[IndexArray]:
        """Return no symmetries: discs that are identified one by one have only one orientation."""
        return []

    def with_diameters(self, scale: float) -> PointField:
        """Return the field with all diameters multiplied by a factor."""
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
"""A field with or without a lattice."""


def gaps_between(points: FloatArray) -> FloatArray:
    """Return the distances (m, m) between points (m, d); infinite on the diagonal."""
    squares = np.zeros((len(points), len(points)))
    for axis in points.T:
        squares += (axis[:, None] - axis) ** 2
    np.fill_diagonal(squares, np.inf)
    return np.asarray(np.sqrt(squares))


def _check_point(point: FieldPoint) -> None:
    where = f"of {point.name}"
    if not all(abs(value) <= _MAX_COORDINATE_M for value in point.position_m):
        raise SettingError("position_m", f"{where} is out of range", "give it in metres")
    require_diameter(f"diameter_m {where}", point.diameter_m)
    require_hole(f"inner_diameter_m {where}", point.inner_diameter_m, point.diameter_m)
    if abs(math.hypot(*point.normal) - 1.0) > _UNIT_TOLERANCE:
        raise SettingError(f"normal {where}", "is not of length 1", "divide it by its length")
    for sd in point.sd_m or ():
        require_range(f"sd {where}", sd, 0.0, 1.0, unit="m", open_low=True)


def _require_once(key: str, values: list[str]) -> None:
    value, count = Counter(values).most_common(1)[0]
    if count > 1:
        raise SettingError(key, f"{value} stands {count} times", "keep one of them")
