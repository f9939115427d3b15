"""A target and what belongs around it: white margin, plate, holes, legend and ruler."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from kgcp.errors import SettingError
from kgcp.targets.layout import Ring, Target
from kgcp.targets.rulers import across, down, ruler_mm
from kgcp.targets.shapes import Artwork, Box, Circle, Layer, Point, Polyline, Primitive, Text

MARGIN = 0.125
"""Width of the white margin around the ring, relative to its diameter. The search samples it at
0.08; the rest allows for blur and tilt."""
_CROP_START, _CROP_END = 3.0, 10.0  # distances of crop marks from the plate, in legend units
# Distance of a hole from the plate's edge: of its centre, relative to the hole's diameter, or of
# its rim, whichever puts it farther inside.
_HOLE_INSET = 1.5
_HOLE_RIM_MM = 6.0
_HOLE_CROSS = 0.7  # half the size of a hole's cross, relative to its diameter
_MIN_ARROW_ROOM = 4.0  # above the ring, for an arrow on the plate, in legend units
_MIN_LEGEND_MM = 130.0  # width
_LEGEND_FROM_MM, _LEGEND_TO_MM = 190.0, 800.0  # widths between which the legend grows


@dataclass(frozen=True, slots=True)
class MountingPlate:
    """The plate that the target is mounted on."""

    width_mm: float  # side of the square, or diameter
    is_round: bool = False
    hole_mm: float | None = None  # diameter of four mounting holes; None: no holes

    @property
    def box(self) -> Box:
        """The plate's bounds."""
        return Box(0.0, 0.0, 0.0, 0.0).grown(0.5 * self.width_mm)

    @property
    def inset_mm(self) -> float:
        """Distance of the holes' centres from the plate's edges [mm]."""
        hole_mm = self.hole_mm or 0.0
        return max(_HOLE_INSET * hole_mm, 0.5 * hole_mm + _HOLE_RIM_MM)

    def holes_mm(self) -> tuple[Point, ...]:
        """Return the holes' centres [mm]."""
        if self.hole_mm is None:
            return ()
        reach = 0.5 * self.width_mm - self.inset_mm
        if self.is_round:
            reach /= math.sqrt(2.0)
        return ((-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach))


def margin_radius_mm(target: Target) -> float:
    """Return the radius of the white that a target needs around its centre [mm]."""
    return 1e3 * target.ring.outer_diameter_m * (0.5 + MARGIN)


def draw_target(target: Target, plate: MountingPlate | None) -> Artwork:
    """Return a target with its legend, on its plate if there is one.

    Raises
    ------
    SettingError
        If the plate or its holes leave too little white.
    """
    radius_mm = margin_radius_mm(target)
    shapes: list[Primitive] = []
    if plate is None:
        box = Box(0.0, 0.0, 0.0, 0.0).grown(radius_mm)
    else:
        _check_plate(plate, radius_mm)
        shapes += _draw_plate(plate)
        box = plate.box.grown(_CROP_END * _unit(plate.width_mm))
        shapes += _plate_name(target, plate, radius_mm)
    for ring in target.rings:
        shapes += _draw_ring(ring)
    widen = max(0.0, 0.5 * (_MIN_LEGEND_MM - box.width))
    box = Box(box.left - widen, box.top, box.right + widen, box.bottom)
    legend, bottom = _legend(target, box, radius_mm, is_beside=plate is None)
    up = _up_mark(box, radius_mm) if plate is None else _up_mark_on(plate, radius_mm)
    shapes += [up, *legend]
    return Artwork(tuple(shapes), Box(box.left, box.top, box.right, bottom), radius_mm)


def _check_plate(plate: MountingPlate, radius_mm: float) -> None:
    if 0.5 * plate.width_mm < radius_mm:
        raise SettingError(
            "plate",
            f"{plate.width_mm / 1e3:g} m leaves too little white around the ring",
            f"give at least {2.0 * radius_mm / 1e3:g} m",
        )
    for x, y in plate.holes_mm():
        free = math.hypot(x, y) - _HOLE_CROSS * (plate.hole_mm or 0.0) - radius_mm
        if free < 0.0:
            raise SettingError(
                "holes",
                f"of {plate.hole_mm:g} mm reach {-free:.0f} mm into the white around the ring",
                "make them smaller or the plate larger",
            )


def _draw_ring(ring: Ring) -> Iterator[Primitive]:
    yield _disc(Layer.INK, (0.0, 0.0), ring.outer_diameter_m)
    yield _disc(Layer.WHITE, (0.0, 0.0), ring.inner_diameter_m)
    for x, y in 1e3 * ring.dot_centres_m():
        yield _disc(Layer.WHITE, (float(x), float(y)), ring.dot_diameter_m)


def _disc(layer: Layer, centre_mm: Point, diameter_m: float) -> Circle:
    return Circle(layer, centre_mm, 500.0 * diameter_m, is_filled=True)


def _draw_plate(plate: MountingPlate) -> Iterator[Primitive]:
    if plate.is_round:
        yield Circle(Layer.PLATE, (0.0, 0.0), 0.5 * plate.width_mm)
    else:
        corners = plate.box.corners
        yield Polyline(Layer.PLATE, (*corners, corners[0]))
        unit = _unit(plate.width_mm)
        yield from crop_marks(plate.box, _CROP_START * unit, (_CROP_END - _CROP_START) * unit)
    for x, y in plate.holes_mm():
        hole_mm = plate.hole_mm or 0.0
        reach = _HOLE_CROSS * hole_mm
        yield Circle(Layer.HOLES, (x, y), 0.5 * hole_mm)
        yield Polyline(Layer.HOLES, ((x - reach, y), (x + reach, y)))
        yield Polyline(Layer.HOLES, ((x, y - reach), (x, y + reach)))
    yield from _axes(plate)


def _plate_name(target: Target, plate: MountingPlate, radius_mm: float) -> Iterator[Text]:
    """Yield the label that stays on a square plate once it is cut, if there is room for it."""
    unit, half = _unit(plate.width_mm), 0.5 * plate.width_mm
    aside = 2.0 * plate.inset_mm if plate.hole_mm else 4.0 * unit
    size, baseline = 3.5 * unit, half - 4.0 * unit
    above = min(baseline - size, radius_mm)
    end = -math.sqrt(radius_mm**2 - above**2) if above < radius_mm else half - aside
    room = end - (aside - half)
    if not plate.is_round and room > 25.0 * unit:
        words = f"{target.name}   Ø {_mm(target.ring.outer_diameter_m)} mm"
        yield Text(words, (aside - half, baseline), size, room)


def _axes(plate: MountingPlate) -> Iterator[Polyline]:
    """Yield short lines outside the plate that point at its centre."""
    near = 0.5 * plate.width_mm + _CROP_START * _unit(plate.width_mm)
    far = 0.5 * plate.width_mm + _CROP_END * _unit(plate.width_mm)
    for x, y in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
        yield Polyline(Layer.CROP, ((x * near, y * near), (x * far, y * far)))


def crop_marks(box: Box, gap_mm: float, length_mm: float) -> Iterator[Polyline]:
    """Yield two lines at each corner of a box that show where to cut."""
    for x, outward_x in ((box.left, -1.0), (box.right, 1.0)):
        for y, outward_y in ((box.top, -1.0), (box.bottom, 1.0)):
            near, far = gap_mm, gap_mm + length_mm
            yield Polyline(Layer.CROP, ((x + outward_x * near, y), (x + outward_x * far, y)))
            yield Polyline(Layer.CROP, ((x, y + outward_y * near), (x, y + outward_y * far)))


def _up_mark(box: Box, radius_mm: float) -> Polyline:
    """Return an arrow in the top left corner, as large as the circle of white allows."""
    room = math.hypot(box.left, box.top) - radius_mm
    height = min(8.0, 0.4 * room)
    return _arrow(box.left + 0.5 * height, box.top, height)


def _up_mark_on(plate: MountingPlate, radius_mm: float) -> Polyline:
    """Return an arrow on the plate, outside the ring's white margin.

    It is above the ring or, if a square plate has too little room there, beside the hole in the top
    left corner. If a round plate has too little room, the arrow is outside, and will be cut off.
    """
    unit, half = _unit(plate.width_mm), 0.5 * plate.width_mm
    room = half - radius_mm
    if room > _MIN_ARROW_ROOM * unit:
        height = min(6.0 * unit, 0.6 * room)
        return _arrow(0.0, 0.5 * (room - height) - half, height)
    if plate.is_round:
        return _arrow(4.0 * unit, -half - _CROP_END * unit, 6.0 * unit)
    aside = 2.0 * plate.inset_mm if plate.hole_mm else 2.0 * unit
    height = min(6.0 * unit, 0.4 * (math.hypot(half - aside, half) - radius_mm))
    return _arrow(aside - half + 0.4 * height, unit - half, height)


def _arrow(x: float, top: float, height: float) -> Polyline:
    half = 0.4 * height
    points = (x - half, top + height), (x, top), (x + half, top + height)
    return Polyline(Layer.TEXT, points, is_filled=True)


def _legend(
    target: Target, box: Box, radius_mm: float, *, is_beside: bool
) -> tuple[list[Primitive], float]:
    """Return rulers and text below the target, and their lower end [mm]."""
    unit = _unit(box.width)
    lines = _words(target)
    top = box.bottom + 3.0 * unit
    corner = (box.left, top + (9.0 + 4.4 * (len(lines) - 1) + 5.0) * unit)
    long_mm = ruler_mm(lambda length: length <= 0.62 * box.width)

    def is_clear(length: float) -> bool:
        """Whether an upright ruler stays below, or beside the target but out of its white."""
        bar = Box(corner[0], corner[1] - length, corner[0] + 10.0 * unit, corner[1])
        is_apart = bar.distance_to(0.0, 0.0) > radius_mm and length <= long_mm
        return bar.top >= top or (is_beside and is_apart)

    high_mm = ruler_mm(is_clear)
    shapes = [*across(corner, long_mm, unit), *down(corner, high_mm, unit)]
    lines[-1] += f" The bars are {long_mm:g} mm wide and {high_mm:g} mm high."
    left, y = box.left + 14.0 * unit, top + 6.0 * unit
    room = box.right - left
    shapes.append(Text(lines[0], (left, y), 7.0 * unit, room, is_bold=True))
    for number, words in enumerate(lines[1:], start=1):
        shapes.append(Text(words, (left, y + (2.0 + 4.4 * number) * unit), 3.0 * unit, room))
    return shapes, corner[1] + 5.0 * unit


def _unit(width_mm: float) -> float:
    """Return the legend unit, the size of type and marks; it is 1 on a sheet of A4."""
    return min(max(width_mm, _LEGEND_FROM_MM), _LEGEND_TO_MM) / _LEGEND_FROM_MM


def _words(target: Target) -> list[str]:
    ring = target.ring
    return [
        ring.name,
        (
            f"outer Ø {_mm(ring.outer_diameter_m)} mm   inner Ø {_mm(ring.inner_diameter_m)} mm   "
            f"dots Ø {_mm(ring.dot_diameter_m)} mm on Ø {_mm(ring.code_diameter_m)} mm"
        ),
        f"code {_code(ring)}, clockwise from the right; the arrow points up",
        *(
            f"{replica.name}: outer Ø {_mm(replica.outer_diameter_m)} mm, code {_code(replica)}"
            for replica in target.replicas
        ),
        "Print at 100 %.",
    ]


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.2f}".rstrip("0").rstrip(".")


def _code(ring: Ring) -> str:
    return " ".join(f"{angle:g}°" for angle in ring.code_deg)
