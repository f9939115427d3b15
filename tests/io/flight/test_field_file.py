"""Fields from field.toml, shorthands, and the boards of other programs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.flight.field_file import field_toml, read_field
from kgcp.targets.fields.layout import Field, FieldBar, FieldPolarity, GridKind, Mark
from kgcp.targets.fields.points import CodeRing, FieldPoint, PointField


def read_grid(text: str, unit: str | None = None) -> Field:
    field = read_field(text, unit)
    assert isinstance(field, Field)
    return field


BOOFCV = """\
# Serialized boofcv.alg.fiducial.calib.ConfigCalibrationTarget
BoofCV.GIT_SHA: a9ab9041d1703a9c09c31999043382e870554729
boofcv.alg.fiducial.calib.ConfigCalibrationTarget:
  grid:
    numRows: 24
    shapeDistance: 1.2
    shapeSize: 1.0
    numCols: 28
  type: CIRCLE_HEXAGONAL
"""
DICE = """\
<?xml version="1.0" encoding="utf-8"?>
<ParameterList>
  <Parameter name="xml_file_format" type="string" value="DICe_xml_calibration_file"/>
  <Parameter name="cal_target_type" type="string" value="WHITE_ON_BLACK_W_DONUT_DOTS"/>
  <Parameter name="num_cal_fiducials_x" type="int" value="14"/>
  <Parameter name="num_cal_fiducials_y" type="int" value="10"/>
  <Parameter name="num_cal_fiducials_origin_to_x_marker" type="int" value="10"/>
  <Parameter name="num_cal_fiducials_origin_to_y_marker" type="int" value="6"/>
  <Parameter name="cal_origin_x" type="int" value="2"/>
  <Parameter name="cal_origin_y" type="int" value="2"/>
  <Parameter name="cal_target_spacing_size" type="double" value="7.0"/>
</ParameterList>
"""
ROS = """\
target_finder:
  type: ModifiedCircleGridTargetFinder
  rows: 10
  cols: 7
  spacing: 0.0254
"""
TOML = """\
name = "panel"
diameter_m = 0.015
[grid]
kind = "square"
columns = 10
rows = 8
pitch_m = 0.025
[[mark]]
at = [2, 2]
inner_diameter_m = 0.006
"""


def write(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_a_field_toml_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    field = Field(
        'a "name"',
        GridKind.HEXAGONAL,
        12,
        8,
        0.025,
        0.0151,
        0.004,
        FieldPolarity.BRIGHT,
        (Mark(2, 3, 0.01, 0.003), Mark(0, 0, 0.0151, is_missing=True)),
        (1e-5, 2e-5, 3e-4),
        (FieldBar("r0c1", "r7c5", 0.176, 1e-5),),
    )
    assert read_field(write(tmp_path, "field.toml", field_toml(field))) == field


def test_marks_have_the_common_diameter_by_default(tmp_path: Path) -> None:
    field = read_grid(write(tmp_path, "field.toml", TOML))
    assert field.marks == (Mark(2, 2, 0.015, 0.006),)
    assert field.flat_sd_m == (0.00005, 0.00005, 0.0003)


def test_shorthands_describe_a_grid() -> None:
    grid = read_grid("grid:10x8:25mm:15mm")
    assert (grid.kind, grid.columns, grid.rows) == (GridKind.SQUARE, 10, 8)
    assert [grid.pitch_m, grid.diameter_m] == pytest.approx([0.025, 0.015])
    bright = read_grid("asymmetric:4x11:2cm:bright")
    assert (bright.kind, bright.polarity) == (GridKind.ASYMMETRIC, FieldPolarity.BRIGHT)
    assert grid.is_diameter_stated
    assert not bright.is_diameter_stated


def test_a_boofcv_file_needs_a_stated_unit(tmp_path: Path) -> None:
    path = write(tmp_path, "calibration_target.yaml", BOOFCV)
    with pytest.raises(KgcpError, match="does not state its unit") as caught:
        read_field(path)
    assert caught.value.option == "unit"
    field = read_grid(path, "cm")
    assert (field.kind, field.columns, field.rows) == (GridKind.HEXAGONAL, 28, 24)
    assert [field.pitch_m, field.diameter_m] == pytest.approx([0.012, 0.01])


def test_dice_counts_from_below_and_both_ends(tmp_path: Path) -> None:
    field = read_grid(write(tmp_path, "input.xml", DICE))
    assert field.polarity is FieldPolarity.BRIGHT
    assert {(mark.column, mark.row) for mark in field.marks} == {(2, 7), (11, 7), (2, 2)}
    assert not field.is_diameter_stated


def test_ros_has_one_larger_dot(tmp_path: Path) -> None:
    field = read_grid(write(tmp_path, "cal_data.yaml", ROS))
    assert (field.columns, field.rows, field.pitch_m) == (7, 10, 0.0254)
    (mark,) = field.marks
    assert (mark.column, mark.row) == (0, 9)
    assert mark.diameter_m > field.diameter_m


def ringgrid(**changes: object) -> str:
    """A target.json of schema v4."""
    values = {
        "schema": "ringgrid.target.v4",
        "name": "rings",
        "pitch_mm": 8.0,
        "rows": 15,
        "long_row_cols": 14,
        "marker_outer_radius_mm": 4.8,
        "marker_inner_radius_mm": 3.2,
        "marker_ring_width_mm": 1.152,
    }
    return json.dumps({**values, **changes})


@pytest.mark.parametrize(("rows", "longest"), [(15, 14), (15, 13), (4, 5), (4, 4), (7, 5)])
def test_rings_lie_as_ringgrid_prints_them(tmp_path: Path, rows: int, longest: int) -> None:
    board = ringgrid(rows=rows, long_row_cols=longest)
    field = read_grid(write(tmp_path, "target.json", board))
    assert (field.diameter_m, field.inner_diameter_m) == pytest.approx((0.010752, 0.008448))
    counts = [sum(name.startswith(f"r{row}c") for name in field.names()) for row in range(rows)]
    # ringgrid's rule: the middle row, rows // 2, is a long one if `longest` is odd
    parity = (rows // 2 + longest + 1) % 2
    assert counts == [longest - (row + parity) % 2 for row in range(rows)]
    points_mm = 1e3 * field.points_m()
    rows_mm = [points_mm[np.array([n.startswith(f"r{r}c") for n in field.names()])] for r in (0, 1)]
    first, second = rows_mm
    assert first[1] - first[0] == pytest.approx([8.0 * math.sqrt(3.0), 0.0, 0.0])
    assert second[0, 1] - first[0, 1] == pytest.approx(12.0)
    assert first[:, 0].mean() == pytest.approx(second[:, 0].mean())  # both about the middle


@pytest.mark.parametrize(
    ("name", "called"),
    [
        ("", "target"),
        ("a\nb", "target"),
        ("a b", "a b"),
        ("\N{GRINNING FACE}", "\N{GRINNING FACE}"),
    ],
)
def test_names_of_rings_can_be_written(tmp_path: Path, name: str, called: str) -> None:
    field = read_grid(write(tmp_path, "target.json", ringgrid(name=name)))
    assert field.name == called
    assert read_grid(write(tmp_path, "field.toml", field_toml(field))).name == called


def test_plain_rings_on_a_square_lattice(tmp_path: Path) -> None:
    board = {
        "schema": "ringgrid.target.v5",
        "name": "plain",
        "lattice": {"kind": "rect", "rows": 4, "cols": 5, "pitch_mm": 14.0},
        "marker": {"outer_radius_mm": 5.6, "inner_radius_mm": 2.8},
        "coding": {"kind": "plain"},
        "fiducials": {"dot_radius_mm": 1.4, "dots_mm": [[21.0, 21.0]]},
    }
    field = read_grid(write(tmp_path, "target_spec.json", json.dumps(board)))
    assert (field.kind, field.columns, field.rows) == (GridKind.SQUARE, 5, 4)
    sizes = [field.pitch_m, field.diameter_m, field.inner_diameter_m]
    assert sizes == pytest.approx([0.014, 0.0112, 0.0056])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": "ringgrid.target.v9"}, "has schema 'ringgrid.target.v9'"),
        ({"rows": 1}, "'rows' is 1; print a board with 2 to 1000"),
        ({"rows": "many"}, "'rows' is 'many', not a finite number"),
        ({"pitch_mm": -8.0}, "pitch_m: -0.0138"),
        ({"marker_inner_radius_mm": None, "marker_outer_radius_mm": 9.0}, "is None, not a finite"),
        ({"marker_outer_radius_mm": 9.0}, "overlap at 13.8"),
    ],
)
def test_wrong_rings_are_a_one_line_error(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(KgcpError, match=message):
        read_field(write(tmp_path, "target.json", ringgrid(**changes)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("grid:10x8:25:15mm", "'25' is not a length with a unit"),
        ("grid:10x8:25mm:30mm", "discs of 30 mm overlap"),
        ("grid:1x8:25mm:5mm", "columns: 1 is"),
        ("nothing.toml", "is neither a field's file nor a shorthand"),
    ],
)
def test_wrong_shorthands_are_refused(text: str, message: str) -> None:
    with pytest.raises(KgcpError, match=message):
        read_field(text)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kind = "square"', 'kind = "round"', "'round' is not known"),
        ("pitch_m = 0.025", "pitch = 0.025", "nearest known key is 'pitch_m'"),
        ("pitch_m = 0.025", "pitch_m = 0.01", "overlap"),
        ("at = [2, 2]", "at = [2.5, 2]", "is not column and row"),
        ("at = [2, 2]", "at = [20, 2]", "is not a disc of the grid"),
        ("diameter_m = 0.015\n", "", "diameter_m: is missing"),
        ("[grid]", "[code]\nbits = 14\n[grid]", "code: is given beside a grid"),
    ],
)
def test_a_wrong_field_toml_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write(tmp_path, "field.toml", TOML.replace(old, new, 1))
    with pytest.raises(KgcpError, match=message) as caught:
        read_field(path)
    assert "field.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "old", "new"),
    [
        (BOOFCV, "CIRCLE_HEXAGONAL", "CHESSBOARD"),
        (BOOFCV, "numRows: 24", "numRows: many"),
        (BOOFCV, "numRows: 24", "numRows: .inf"),
        (BOOFCV, "numRows: 24", "numRows: 24.7"),
        (BOOFCV, "1.2", "1e999"),
        (DICE, 'value="7.0"', 'value="nan"'),
        (DICE, "WHITE_ON_BLACK_W_DONUT_DOTS", "CHECKER_BOARD"),
        (DICE, "cal_origin_x", "origin"),
        (ROS, "spacing: 0.0254", "spacing: []"),
        (ROS, "rows: 10", "rows: 1e300"),
        (ROS, "rows: 10", "rows: 10.5"),
        (
            DICE,
            'num_cal_fiducials_x" type="int" value="14"',
            'num_cal_fiducials_x" type="int" value="14.7"',
        ),
        (ROS, "rows: 10", "rows: -3"),
    ],
)
def test_damaged_board_files_are_a_one_line_error(
    tmp_path: Path, text: str, old: str, new: str
) -> None:
    unit = "mm" if text == BOOFCV else None
    with pytest.raises(KgcpError, match="board"):
        read_field(write(tmp_path, "board", text.replace(old, new, 1)), unit)


@pytest.mark.parametrize("text", [DICE, ROS, TOML, "grid:10x8:25mm:15mm"])
def test_a_unit_is_refused_where_it_would_be_ignored(tmp_path: Path, text: str) -> None:
    name = "field.toml" if text == TOML else "board"
    field = text if text.startswith("grid:") else write(tmp_path, name, text)
    read_field(field)
    with pytest.raises(KgcpError, match="leave it out") as caught:
        read_field(field, "in")
    assert caught.value.option == "unit"


POINTS_TOML = """\
name = "posts"
diameter_m = 0.02
flat_sd_m = [0.0001, 0.0001, 0.0002]
[points]
file = "field.csv"
[code]
kind = "ring"
bits = 14
ring = [2.1, 3.1]
[[bar]]
from = "B"
to = "C"
length_m = 0.112
sd_m = 0.00001
"""
POINTS_CSV = """\
name,x,y,z,sd_x,sd_y,sd_z,normal_x,normal_y,normal_z,code
A,0,0,0,1e-5,1e-5,2e-5,0,0,1,3
B,0.1,0,0,1e-5,1e-5,2e-5,0,0,1,5
C,0.2,0,0.05,1e-5,1e-5,2e-5,0,0.6,0.8,7
D,0,0.1,0,1e-5,1e-5,2e-5,0,0,1,-1
E,0.1,0.1,0,1e-5,1e-5,2e-5,0,0,1,9
F,0.2,0.1,0,1e-5,1e-5,2e-5,0,0,1,11
G,0.3,0.1,0,1e-5,1e-5,2e-5,0,0,1,13
"""


def test_points_may_have_individual_coordinates(tmp_path: Path) -> None:
    write(tmp_path, "field.csv", POINTS_CSV)
    field = read_field(write(tmp_path, "field.toml", POINTS_TOML))
    assert isinstance(field, PointField)
    third, fourth = field.points[2:4]
    assert third == FieldPoint(
        "C",
        (0.2, 0.0, 0.05),
        0.02,
        normal=(0.0, 0.6, 0.8),
        sd_m=(1e-5, 1e-5, 2e-5),
        code=7,
    )
    assert fourth.code is None
    assert field.code == CodeRing(14, 2.1, 3.1)
    assert field.bars == (FieldBar("B", "C", 0.112, 0.00001),)
    copy = write(tmp_path, "copy.toml", field_toml(field))
    assert read_field(copy) == field


@pytest.mark.parametrize(
    ("toml", "rows", "message"),
    [
        (("[points]", "[grid]\n[points]"), ("", ""), "grid: is given beside points"),
        (("diameter_m = 0.02\n", ""), ("", ""), "has no column diameter_m"),
        (("ring = [2.1, 3.1]", "ring = [2.1]"), ("", ""), "has 1 numbers instead of 2"),
        (("bits = 14", "bits = 60"), ("", ""), r"\[code\] bits: 60 is out of range"),
        (("[code]", "[[code]]"), ("", ""), r"code: is a list; give a table \[code\]"),
        (("field.csv", "no.csv"), ("", ""), "'no.csv' does not exist"),
        (("", ""), ("sd_z,", "sd_w,"), "lacks sd_z; give all of sd_x, sd_y, sd_z"),
        (("", ""), ("A,0,0,0", "A,0,0,much"), "line 2: z is 'much'"),
        (("", ""), ("A,0", ",0"), "line 2: '' is not a name"),
        (("", ""), ("1,3\n", "1,3.5\n"), "line 2: code 3.5 is not a whole number"),
        (("", ""), ("B,0.1", "A,0.1"), "A stands 2 times"),
        (("", ""), ("0,1,5\n", "0,1,3\n"), "code: 3 stands 2 times"),
    ],
)
def test_wrong_points_are_a_one_line_error(
    tmp_path: Path, toml: tuple[str, str], rows: tuple[str, str], message: str
) -> None:
    write(tmp_path, "field.csv", POINTS_CSV.replace(*rows, 1))
    with pytest.raises(KgcpError, match=message):
        read_field(write(tmp_path, "field.toml", POINTS_TOML.replace(*toml, 1)))


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ('name = "B"\nposition_m = [0, 0]', "B position_m: has 2 numbers"),
        ("position_m = [0, 0, 0]", "2 name: is missing"),
        ('name = "B"\nplace = [0, 0, 0]', "B place: is not a known key"),
    ],
)
def test_wrong_points_of_a_field_toml_are_named(tmp_path: Path, point: str, message: str) -> None:
    first = '[[point]]\nname = "A"\nposition_m = [0, 0, 0]\n'
    text = f'name = "f"\ndiameter_m = 0.02\n{first}[[point]]\n{point}\n'
    with pytest.raises(KgcpError, match=rf"field.toml: \[\[point\]\] {message}"):
        read_field(write(tmp_path, "field.toml", text))


NXYZ = """\
% name x y z sd
1 0 0 0 0.01 0.01 0.02
2 100 0 0 0.01 0.01 0.02
3 200 0 50 0.01 0.01 0.02
4\t0\t100\t0\t0.01\t0.01\t0.02
5,100,100,0,0.01,0.01,0.02
6;200;100;0;0;0;0
"""


@pytest.mark.parametrize("head", ["", "Name X Y Z\n"])
def test_lists_of_points_need_a_stated_unit(tmp_path: Path, head: str) -> None:
    path = write(tmp_path, "points.txt", head + NXYZ)
    with pytest.raises(KgcpError, match="does not state its unit") as caught:
        read_field(path)
    assert caught.value.option == "unit"
    field = read_field(path, "mm")
    assert isinstance(field, PointField)
    assert field.points[2].position_m == pytest.approx((0.2, 0.0, 0.05))
    assert field.points[2].sd_m == pytest.approx((1e-5, 1e-5, 2e-5))
    assert field.points[5].sd_m is None
    assert not field.is_diameter_stated


def test_points_of_a_list_may_lie_close_together(tmp_path: Path) -> None:
    close = "7 210 100 0 0.01 0.01 0.02\n"
    field = read_field(write(tmp_path, "points.txt", NXYZ + close), "mm")
    assert field.radii_m() == pytest.approx(np.full(7, 0.0025))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("5,100,100,0", "5,100,100", "is not a field of targets of a known format"),
        ("2 100 0 0", "2 0 0 0", "1 and 2 overlap"),
        ("2 100 0 0", "1 100 0 0", "1 stands 2 times"),
        ("2 100 0 0", "2 nan 0 0", "is not a field of targets of a known format"),
        ("1 0 0 0", "P1 0 O 0", "is not a field of targets of a known format"),
        ("100 0 0 0.01 0.01", "100 0 0 0 0.01", "sd of 2: 0 m is out of range"),
        ("100 0 0 0.01 0.01", "100 0 0 -0.01 0.01", "sd of 2: -1e-05 m is out of range"),
    ],
)
def test_wrong_lists_are_a_one_line_error(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(KgcpError, match=message):
        read_field(write(tmp_path, "points.txt", NXYZ.replace(old, new)), "mm")
