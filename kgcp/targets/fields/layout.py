"""A field of targets: discs or rings on a lattice; some may be marks that show its orientation.

The field's frame is that of kgcp's targets: seen from the front, x right, y down, z into the board;
the origin is the first disc of the first row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.settings import require_range

LEAST_POINTS, MOST_POINTS = 6, 10_000
"""Numbers of discs of a field. Fewer would determine a pose, but hardly check it."""

_MAX_DISC_M = 3.0  # diameter; so millimetres given as metres are noticed from 3 mm on
_MAX_BAR_ERROR = 0.05  # relative difference of a bar from the stated distance of its discs
# Largest difference of two bars between the same discs, in its standard deviations.
_MAX_BAR_DIFFERENCE_SIGMAS = 5.0


class GridKind(StrEnum):
    """Arrangement of a field's discs."""

    SQUARE = "square"  # rows and columns
    # as in OpenCV: `columns` discs in a row, 2 `pitch` apart; rows are `pitch` apart, and every
    # second one is shifted by `pitch`
    ASYMMETRIC = "asymmetric"
    # as in BoofCV: six neighbours at equal distances; of `columns` by `rows` places, half a step
    # apart, every second one has a disc; the first place of the last row, from which BoofCV counts,
    # has one
    HEXAGONAL = "hexagonal"


class FieldPolarity(StrEnum):
    """Whether discs are darker or brighter than the board."""

    DARK = "dark"
    BRIGHT = "bright"


@dataclass(frozen=True, slots=True)
class Mark:
    """A disc that differs from the others.

    Attributes
    ----------
    column, row : int
        Its place: number of the disc in its row, and of the row, from 0.
    diameter_m : float
        Outer diameter [m].
    inner_diameter_m : float
        Diameter of its hole [m]; 0: no hole.
    is_missing : bool
        Whether the place is empty.
    """

    column: int
    row: int
    diameter_m: float
    inner_diameter_m: float = 0.0
    is_missing: bool = False


@dataclass(frozen=True, slots=True)
class FieldBar:
    """A measured distance between two discs, by their names [m]."""

    first: str
    second: str
    length_m: float
    sd_m: float


@dataclass(frozen=True, slots=True)
class Field:
    """A planar field of discs or rings on a lattice.

    Attributes
    ----------
    name : str
        For reports.
    kind : GridKind
    columns, rows : int
        As `kind` counts them.
    pitch_m : float
        Distance of neighbours [m]; for asymmetric grids, of rows.
    diameter_m, inner_diameter_m : float
        Diameters of all discs but marks [m]; an inner diameter above 0 makes them rings.
    polarity : FieldPolarity
    marks : tuple of Mark
        Discs that differ.
    flat_sd_m : tuple of float
        Standard deviations of the discs' stated coordinates along x, y, z [m].
    bars : tuple of FieldBar
        Measured distances.
    is_diameter_stated : bool
        Whether the diameters are known; otherwise only their ratios count.

    Raises
    ------
    SettingError
        On construction, if the field is impossible.
    """

    name: str
    kind: GridKind
    columns: int
    rows: int
    pitch_m: float
    diameter_m: float
    inner_diameter_m: float = 0.0
    polarity: FieldPolarity = FieldPolarity.DARK
    marks: tuple[Mark, ...] = ()
    flat_sd_m: tuple[float, float, float] = (0.00005, 0.00005, 0.0003)
    bars: tuple[FieldBar, ...] = ()
    is_diameter_stated: bool = True

    def __post_init__(self) -> None:
        require_range("pitch_m", self.pitch_m, 0.0, 100.0, unit="m", open_low=True)
        require_diameter("diameter_m", self.diameter_m)
        for key, count in (("columns", self.columns), ("rows", self.rows)):
            require_range(key, count, 2, 1000)
        require_hole("inner_diameter_m", self.inner_diameter_m, self.diameter_m)
        for sd in self.flat_sd_m:
            require_range("flat_sd_m", sd, 0.0, 1.0, unit="m", open_low=True)
        if not LEAST_POINTS <= len(self._places()) <= MOST_POINTS:
            raise SettingError(
                "columns",
                f"{self.columns} x {self.rows} is not a field of {LEAST_POINTS} to {MOST_POINTS}"
                " discs",
                "correct columns and rows",
            )
        self._check_marks()
        widest = max([self.diameter_m, *(m.diameter_m for m in self.marks if not m.is_missing)])
        if self.neighbour_m <= 0.5 * (widest + self.diameter_m):
            raise SettingError(
                "pitch_m",
                f"discs of {1e3 * widest:g} mm overlap at {1e3 * self.neighbour_m:g} mm",
                "give the distance of neighbouring centres, and diameters",
            )
        if len(self.names()) < LEAST_POINTS:
            raise SettingError("mark", "leaves fewer than 6 discs", "delete marks")
        check_bars(self.bars, self.names(), self.points_m())

    def _check_marks(self) -> None:
        places = {(mark.column, mark.row) for mark in self.marks}
        if len(places) < len(self.marks):
            raise SettingError("at", "two marks are at one place", "delete one of them")
        discs = set(self._places())
        for mark in self.marks:
            if (mark.column, mark.row) not in discs:
                raise SettingError(
                    "at",
                    f"[{mark.column}, {mark.row}] is not a disc of the grid",
                    "count column and row from 0",
                )
            if not mark.is_missing:
                require_diameter("diameter_m", mark.diameter_m)
                require_hole("inner_diameter_m", mark.inner_diameter_m, mark.diameter_m)

    def _places(self) -> list[tuple[int, int]]:
        """Return column and row of all places that the grid has, row by row."""
        if self.kind is GridKind.HEXAGONAL:
            return [
                (column, row)
                for row in range(self.rows)
                for column in range((self.columns - self._shift(row) + 1) // 2)
            ]
        return [(column, row) for row in range(self.rows) for column in range(self.columns)]

    def _shift(self, row: int | IndexArray) -> int | IndexArray:
        """Return by how many half-steps a row of a hexagonal grid is shifted: 0 or 1."""
        return (self.rows - 1 - row) % 2

    def discs(self) -> list[tuple[int, int]]:
        """Return column and row of all discs, row by row."""
        missing = {(mark.column, mark.row) for mark in self.marks if mark.is_missing}
        return [place for place in self._places() if place not in missing]

    def names(self) -> tuple[str, ...]:
        """Return the names of all discs: r2c3 is the fourth disc of the third row."""
        return tuple(f"r{row}c{column}" for column, row in self.discs())

    @property
    def neighbour_m(self) -> float:
        """Distance of the nearest neighbours' centres [m]."""
        return self.pitch_m * (math.sqrt(2.0) if self.kind is GridKind.ASYMMETRIC else 1.0)

    @property
    def turns(self) -> int:
        """Number of rotations under which the lattice looks the same: 4 or 6."""
        return 6 if self.kind is GridKind.HEXAGONAL else 4

    def basis_m(self) -> FloatArray:
        """Return the lattice's two basis vectors as columns (2, 2), the second clockwise [m]."""
        pitch = self.pitch_m
        if self.kind is GridKind.ASYMMETRIC:
            return np.array([[pitch, -pitch], [pitch, pitch]])
        if self.kind is GridKind.HEXAGONAL:
            return np.array([[pitch, 0.5 * pitch], [0.0, math.sqrt(0.75) * pitch]])
        return np.array([[pitch, 0.0], [0.0, pitch]])

    def nodes(self) -> IndexArray:
        """Return the lattice coordinates (m, 2) of all discs, in multiples of the basis."""
        column, row = np.array(self.discs()).T
        if self.kind is GridKind.SQUARE:
            return np.stack((column, row), axis=1)
        if self.kind is GridKind.ASYMMETRIC:
            # x = 2 column + row % 2 and y = row, in steps of pitch, are u - v and u + v
            across = 2 * column + row % 2
            return np.stack(((across + row) // 2, (row - across) // 2), axis=1)
        # x = column + shift / 2 and y = row, in steps of pitch and row, are u + v / 2 and v, up to
        # half a step if the first row is shifted
        return np.stack((column + (self._shift(row) - row) // 2, row), axis=1)

    def points_m(self) -> FloatArray:
        """Return the stated positions (m, 3) of the discs, in the field's frame [m]."""
        flat = self.nodes() @ self.basis_m().T
        return np.column_stack((flat, np.zeros(len(flat))))

    def point_sds_m(self) -> FloatArray:
        """Return the standard deviations (m, 3) of the stated positions [m]."""
        return np.tile(self.flat_sd_m, (len(self.discs()), 1))

    def normals(self) -> FloatArray:
        """Return the unit normals (m, 3) of the discs: the field's z axis."""
        return np.tile([0.0, 0.0, 1.0], (len(self.discs()), 1))

    @property
    def named_by(self) -> str:
        """How discs are identified."""
        return "lattice"

    @property
    def starts_from_homographies(self) -> bool:
        """Whether start values come from homographies of the plane z = 0."""
        return True

    def radii_m(self) -> FloatArray:
        """Return the outer radii (m,) of the discs [m]."""
        return self._by_disc(self.diameter_m, {m: m.diameter_m for m in self.marks}) / 2.0

    def inner_radii_m(self) -> FloatArray:
        """Return the radii (m,) of the discs' holes, 0 where there is none [m]."""
        return self._by_disc(self.inner_diameter_m, {m: m.inner_diameter_m for m in self.marks}) / 2

    def symmetries(self) -> list[IndexArray]:
        """Return the rotations under which the field looks the same, without the identity.

        Each is a permutation `order` (m,): disc i moves to the place of disc `order[i]`.
        """
        points, radii, holes = self.points_m()[:, :2], self.radii_m(), self.inner_radii_m()
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        permutations = []
        for step in range(1, self.turns):
            angle = 2.0 * math.pi * step / self.turns
            cosine, sine = math.cos(angle), math.sin(angle)
            turned = (points - middle) @ np.array([[cosine, sine], [-sine, cosine]]) + middle
            gaps = np.linalg.norm(turned[:, None] - points, axis=2)
            order = gaps.argmin(axis=1)
            is_onto = gaps.min(axis=1).max() < 0.01 * self.pitch_m
            if is_onto and np.all(radii[order] == radii) and np.all(holes[order] == holes):
                permutations.append(order)
        return permutations

    def with_diameters(self, scale: float) -> Field:
        """Return the field with all diameters multiplied by a factor."""
        marks = tuple(
            replace(
                mark,
                diameter_m=scale * mark.diameter_m,
                inner_diameter_m=scale * mark.inner_diameter_m,
            )
            for mark in self.marks
        )
        diameter_m, inner_m = scale * self.diameter_m, scale * self.inner_diameter_m
        return replace(self, diameter_m=diameter_m, inner_diameter_m=inner_m, marks=marks)

    def _by_disc(self, usual: float, marks: dict[Mark, float]) -> FloatArray:
        special = {(mark.column, mark.row): value for mark, value in marks.items()}
        return np.array([special.get(place, usual) for place in self.discs()])


def check_bars(bars: tuple[FieldBar, ...], names: tuple[str, ...], points_m: FloatArray) -> None:
    """Raise `SettingError` for bars that do not fit two discs with these names and places.

    The scale of a print may be wrong by a few per cent. A bar that differs by more connects other
    discs or is a typing error, and would deform the field.
    """
    for bar in bars:
        for key, name in (("from", bar.first), ("to", bar.second)):
            if name not in names:
                raise SettingError(
                    key,
                    f"{name!r} is not a disc of the field",
                    f"give the name of one, as {names[0]}",
                )
        if bar.first == bar.second:
            raise SettingError("to", "is where the bar begins", "name its other end")
        require_range("length_m", bar.length_m, 0.0, 1000.0, unit="m", open_low=True)
        require_range("sd_m", bar.sd_m, 0.0, 1.0, unit="m", open_low=True)
        ends_m = points_m[[names.index(bar.first), names.index(bar.second)]]
        stated_m = float(np.linalg.norm(ends_m[1] - ends_m[0]))
        if abs(bar.length_m - stated_m) > _MAX_BAR_ERROR * stated_m:
            raise SettingError(
                "length_m",
                f"{bar.length_m:g} m, but {bar.first} and {bar.second} are {stated_m:g} m apart",
                "correct the bar, or the field",
            )
    _check_repeated_bars(bars)


def _check_repeated_bars(bars: tuple[FieldBar, ...]) -> None:
    """Raise `SettingError` for two bars between the same discs with contradictory lengths."""
    first_of: dict[frozenset[str], FieldBar] = {}
    for bar in bars:
        first = first_of.setdefault(frozenset((bar.first, bar.second)), bar)
        most_m = _MAX_BAR_DIFFERENCE_SIGMAS * math.hypot(bar.sd_m, first.sd_m)
        if abs(bar.length_m - first.length_m) > most_m:
            raise SettingError(
                "length_m",
                f"{first.length_m:g} m and {bar.length_m:g} m, both between {bar.first} and"
                f" {bar.second}, contradict each other",
                "correct one of them, or their sd_m",
            )


def require_diameter(key: str, diameter_m: float) -> None:
    """Raise `SettingError` unless a disc's diameter is plausible [m]."""
    if diameter_m > _MAX_DISC_M:
        raise SettingError(
            key,
            f"{diameter_m:g} m is out of range",
            f"give metres: {diameter_m:g} mm are {1e-3 * diameter_m:g}",
        )
    require_range(key, diameter_m, 0.0, _MAX_DISC_M, unit="m", open_low=True)


def require_hole(key: str, inner_m: float, outer_m: float) -> None:
    """Raise `SettingError` unless a hole is inside its disc."""
    if not 0.0 <= inner_m < outer_m:
        raise SettingError(
            key, f"{inner_m:g} m is not inside a disc of {outer_m:g} m", "give a smaller diameter"
        )
