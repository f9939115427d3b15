from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace

import pytest

from kgcp.errors import SettingError
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.targets.artwork import MountingPlate, draw_target, margin_radius_mm
from kgcp.targets.code_design import chosen_targets, new_targets
from kgcp.targets.layout import Ring, Target
from kgcp.targets.shapes import Circle, Layer, Polyline, Primitive, Text
from kgcp.targets.sheets import Paper, lay_out

LARGE = TARGET_PLATE.target
SMALL = Target(Ring("Südtor", 0.15, 0.075, 0.107, 0.021, (0.0, 40.0, 90.0, 255.0)))


def discs_of(shapes: Sequence[Primitive]) -> list[Circle]:
    return [shape for shape in shapes if isinstance(shape, Circle) and shape.is_filled]


def lines_of(
    shapes: Sequence[Primitive], layer: Layer, *, is_filled: bool = False
) -> list[Polyline]:
    return [
        shape
        for shape in shapes
        if isinstance(shape, Polyline) and shape.layer is layer and shape.is_filled is is_filled
    ]


def points(shape: Primitive) -> list[tuple[float, float]]:
    """Points of a shape's outline; of a text, the corners of what it may take at most."""
    if isinstance(shape, Circle):
        (x, y), r = shape.centre_mm, shape.radius_mm
        angles = [math.radians(a) for a in range(0, 360, 5)]
        return [(x + r * math.cos(a), y + r * math.sin(a)) for a in angles]
    if isinstance(shape, Text):
        (x, y), size = shape.start_mm, shape.size_mm
        width = min(shape.room_mm, 0.75 * size * len(shape.words))
        steps = [x + share / 20.0 * width for share in range(21)]
        return [(step, height) for step in steps for height in (y + 0.25 * size, y - 0.8 * size)]
    ends = shape.points_mm
    return [
        (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
        for a, b in zip(ends, (*ends[1:], ends[0]), strict=True)
        for share in (0.0, 0.25, 0.5, 0.75)
    ]


@pytest.mark.parametrize("target", [LARGE, SMALL], ids=["large", "small"])
@pytest.mark.parametrize("ratio", [None, (1.26, False), (1.6, False), (1.7, True)], ids=str)
def test_nothing_touches_the_white_margin(target: Target, ratio: tuple[float, bool] | None) -> None:
    diameter_mm = 1e3 * target.ring.outer_diameter_m
    plate = None if ratio is None else MountingPlate(ratio[0] * diameter_mm, ratio[1], hole_mm=6.0)
    artwork = draw_target(target, plate)
    around = [s for s in artwork.shapes if s not in discs_of(artwork.shapes)]
    assert any(isinstance(shape, Text) and target.name in shape.words for shape in around)
    for shape in around:
        for x, y in points(shape):
            assert math.hypot(x, y) >= margin_radius_mm(target) - 1e-9, shape
            slack = 1.0 if isinstance(shape, Text) else 1e-9
            assert artwork.box.distance_to(x, y) <= slack, shape


def test_the_rings_are_those_of_flight_toml() -> None:
    discs = discs_of(draw_target(LARGE, None).shapes)
    radii = [(disc.layer, round(disc.radius_mm, 3)) for disc in discs]
    assert radii[:2] == [(Layer.INK, 450.0), (Layer.WHITE, 225.0)]
    assert radii[2:6] == [(Layer.WHITE, 64.286)] * 4
    assert radii[6:8] == [(Layer.INK, 90.0), (Layer.WHITE, 45.0)]
    first, second = discs[2].centre_mm, discs[3].centre_mm
    assert first == pytest.approx((321.429, 0.0), abs=1e-3)
    assert math.degrees(math.atan2(second[1], second[0])) == pytest.approx(
        43.0
    )  # clockwise: y down


def test_a_single_sheet_is_turned_if_it_then_fits() -> None:
    wide = draw_target(SMALL, None)
    (upright,) = lay_out(wide, "x", Paper.A4, is_tiled=False)
    assert (upright.width_mm, upright.height_mm) == (210.0, 297.0)
    left, top = upright.centre_mm
    assert left + wide.box.left == pytest.approx(210.0 - left - wide.box.right)
    assert top + wide.box.top == pytest.approx(297.0 - top - wide.box.bottom)
    flat = replace(wide, box=replace(wide.box, top=-60.0, bottom=60.0, right=180.0))
    (lying,) = lay_out(flat, "x", Paper.A4, is_tiled=False)
    assert (lying.width_mm, lying.height_mm) == (297.0, 210.0)


@pytest.mark.parametrize("paper", [Paper.A4, Paper.A3, Paper.A1])
def test_tiles_cover_everything_once(paper: Paper) -> None:
    artwork = draw_target(LARGE, None)
    sheets = lay_out(artwork, "A", paper, is_tiled=True)
    bleed_mm = 3.0
    cuts = [
        sheet.window.grown(-bleed_mm).moved(-sheet.centre_mm[0], -sheet.centre_mm[1])
        for sheet in sheets
    ]
    assert min(cut.left for cut in cuts) == pytest.approx(artwork.box.left)
    assert max(cut.bottom for cut in cuts) == pytest.approx(artwork.box.bottom)
    assert len({(round(cut.left, 6), round(cut.top, 6)) for cut in cuts}) == len(sheets)
    for shape in artwork.shapes:
        for x, y in points(shape):
            if not isinstance(shape, Text):
                assert min(cut.distance_to(x, y) for cut in cuts) < 1e-6, shape
    radius_mm = margin_radius_mm(LARGE)
    for angle in (math.radians(0.5 * step) for step in range(720)):
        x, y = 0.999 * radius_mm * math.cos(angle), 0.999 * radius_mm * math.sin(angle)
        assert min(cut.distance_to(x, y) for cut in cuts) == 0.0, "the white around the ring"
    for sheet in sheets:
        for mark in sheet.marks:
            for x, y in points(mark):
                assert 4.0 < x < sheet.width_mm - 4.0
                assert 4.0 < y < sheet.height_mm - 4.0
                assert sheet.window.distance_to(x, y) > 0.0, "marks are outside the artwork"
        assert (
            sum(isinstance(mark, Polyline) and mark.layer is Layer.CROP for mark in sheet.marks)
            == 8
        )
        assert any(
            isinstance(mark, Polyline) and mark.is_filled and mark.layer is Layer.RULER
            for mark in sheet.marks
        )


def test_blank_tiles_are_left_out() -> None:
    """On A4, the tiles beside the legend and beyond the plate show nothing."""
    artwork = draw_target(LARGE, MountingPlate(1200.0))
    sheets = lay_out(artwork, "A", Paper.A4, is_tiled=True)
    labels = [tuple(map(int, re.findall(r"\d+", sheet.label))) for sheet in sheets]
    rows, columns = (max(places) for places in zip(*labels, strict=True))
    assert len(sheets) < rows * columns
    assert (rows, columns) not in labels, "right of the legend"
    assert any("blank tiles are left out" in str(mark) for mark in sheets[0].marks)


@pytest.mark.parametrize("width_mm", [1126.0, 1150.0, 1200.0, 2000.0])
@pytest.mark.parametrize("hole_mm", [None, 8.0])
def test_the_arrow_is_on_the_plate_and_outside_the_white(
    width_mm: float, hole_mm: float | None
) -> None:
    plate = MountingPlate(width_mm, hole_mm=hole_mm)
    shapes = draw_target(LARGE, plate).shapes
    (arrow,) = (
        shape
        for shape in shapes
        if isinstance(shape, Polyline) and shape.layer is Layer.TEXT and shape.is_filled
    )
    assert len(arrow.points_mm) == 3
    for x, y in arrow.points_mm:
        assert max(abs(x), abs(y)) < 0.5 * width_mm
        assert math.hypot(x, y) > margin_radius_mm(LARGE)
        for hole in plate.holes_mm():
            assert math.dist(hole, (x, y)) > 0.7 * (hole_mm or 0.0)
    left, apex, right = arrow.points_mm
    assert apex[1] < left[1] == right[1], "it points up"
    assert left[1] - apex[1] > 10.0, "it can be seen"


def test_the_ruler_has_the_stated_length() -> None:
    shapes = draw_target(SMALL, None).shapes
    bars = [
        s for s in shapes if isinstance(s, Polyline) and not s.is_filled and s.layer is Layer.RULER
    ]
    sizes = [
        (max(x) - min(x), max(y) - min(y))
        for x, y in (zip(*b.points_mm, strict=True) for b in bars)
    ]
    wide, high = max(size[0] for size in sizes), max(size[1] for size in sizes)
    words = next(s.words for s in shapes if isinstance(s, Text) and "bars" in s.words)
    assert f"{wide:g} mm wide and {high:g} mm high" in words
    assert (wide, high) == (100.0, 50.0)


def test_impossible_sheets_are_refused_with_a_remedy() -> None:
    artwork = draw_target(LARGE, None)
    with pytest.raises(SettingError, match=r"1145 × \d+ mm, A4 is smaller; allow several sheets"):
        lay_out(artwork, "A", Paper.A4, is_tiled=False)
    with pytest.raises(SettingError, match="'fit' is one sheet"):
        lay_out(artwork, "A", Paper.FIT, is_tiled=True)
    huge = draw_target(Target(LARGE.ring.scaled("x", 0.5, (0.0, 90.0, 140.0))), None)
    assert lay_out(huge, "x", Paper.FIT, is_tiled=False)
    with pytest.raises(SettingError, match="at most 5 m"):
        lay_out(replace(artwork, box=artwork.box.grown(2000.0)), "A", Paper.FIT, is_tiled=False)
    with pytest.raises(SettingError, match="take larger sheets"):
        lay_out(replace(artwork, box=artwork.box.grown(3000.0)), "A", Paper.A4, is_tiled=True)


def test_plates_that_are_too_small_are_refused() -> None:
    with pytest.raises(SettingError, match=r"plate: 1 m .* at least 1\.125 m"):
        draw_target(LARGE, MountingPlate(1000.0))
    with pytest.raises(SettingError, match="holes: of 8 mm reach"):
        draw_target(LARGE, MountingPlate(1130.0, is_round=True, hole_mm=8.0))


def test_new_targets_have_the_proportions_of_the_first() -> None:
    targets = new_targets([LARGE], 0.45, ["0,60,150,270"], 2, 4)
    assert [target.name for target in targets] == ["T1", "T2", "T3"]
    for target in targets:
        assert target.ring.outer_diameter_m == 0.45
        assert target.ring.code_diameter_m == pytest.approx(0.45 / 1.4, abs=1e-6)
    assert targets[0].ring.code_deg == (0.0, 60.0, 150.0, 270.0)


@pytest.mark.parametrize(
    ("codes", "diameter_m", "words"),
    [
        (["0,x"], 1.0, "'0,x' is not a list of angles"),
        (["0,nan"], 1.0, "not a list of angles"),
        (["0,10"], 1.0, "overlap"),
        (["0,43,78,180"], None, "diameter: is missing"),
    ],
)
def test_impossible_new_codes_are_refused(
    codes: list[str], diameter_m: float | None, words: str
) -> None:
    with pytest.raises(SettingError, match=words):
        new_targets([], diameter_m, codes, 0, 4)


def test_targets_are_chosen_by_name() -> None:
    assert chosen_targets([LARGE, SMALL], []) == (LARGE, SMALL)
    assert chosen_targets([LARGE, SMALL], ["Südtor"]) == (SMALL,)
    with pytest.raises(SettingError, match="give one of A, Südtor"):
        chosen_targets([LARGE, SMALL], ["B"])
