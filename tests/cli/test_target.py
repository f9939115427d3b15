from __future__ import annotations

import json
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from kgcp.cli.target import FORMATS, PAPERS
from kgcp.geometry.camera import Response
from kgcp.io.flight.field_file import read_field
from kgcp.io.flight.flight import read_printed_targets
from kgcp.io.print import write
from kgcp.measurement.discs.records import Operator
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.measurement.field_photograph import PhotoDiscs, PhotoTask, measure_field
from kgcp.targets.code_design import LEAST_DISTANCE
from kgcp.targets.fields.layout import Field
from kgcp.targets.layout import Target
from kgcp.targets.sheets import Paper

TABLES = """
[[target]]
name = "A"
outer_diameter_m = 0.15
inner_diameter_m = 0.075
code_diameter_m = 0.107
dot_diameter_m = 0.0214
code_deg = [0, 43, 78.25, 180]
sd_outer_diameter_m = 0.0001
position_m = [1.0, 2.0, 3.0]
sd_position_m = [0.01, 0.01, 0.02]

[[target]]
name = "A-inner"
replica_of = "A"
scale = 0.2
code_deg = [10, 80, 150, 250, 290]

[[target]]
name = "B b"
outer_diameter_m = 0.15
inner_diameter_m = 0.075
code_diameter_m = 0.107
dot_diameter_m = 0.0214
code_deg = [0, 60, 150, 250]
"""


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """A folder with nothing but targets: they are printed before there are frames."""
    (tmp_path / "flight.toml").write_text(TABLES, encoding="utf-8")
    return tmp_path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["target", *map(str, arguments)])


def read_back(folder: Path, path: Path) -> tuple[Target, ...]:
    folder.mkdir()
    (folder / "flight.toml").write_bytes(path.read_bytes())
    return read_printed_targets(folder)


def test_formats_and_papers_of_the_options_are_those_of_the_modules() -> None:
    assert FORMATS == write.FORMATS
    assert tuple(Paper) == PAPERS


def test_targets_of_a_flight_are_written_with_their_tables(flight: Path) -> None:
    result = run(flight, "--format", "svg", "--format", "dxf", "--json")
    assert result.exit_code == 0, result.output
    out = flight / "kgcp" / "targets"
    names = ["target_A.svg", "target_A.dxf", "target_B_b.svg", "target_B_b.dxf", "targets.toml"]
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    summary = json.loads(result.stdout)
    assert summary["files"] == [str(out / name) for name in names]
    assert [target["name"] for target in summary["targets"]] == ["A", "B b"]
    assert summary["dots_apart"] > LEAST_DISTANCE
    assert read_back(flight / "again", out / "targets.toml") == read_printed_targets(flight)


def test_a_single_target_can_be_drawn_in_tiles(flight: Path, tmp_path: Path) -> None:
    options = ("--sheet", "A4", "--tiled", "--plate", "0.4", "--round", "--holes", "6")
    out = tmp_path / "out"
    formats = ("--format", "png", "--format", "svg")
    result = run(flight, "--target", "A", *options, *formats, "--dpi", "30", "--out", out)
    assert result.exit_code == 0, result.output
    assert "A: code [0, 43, 78.25, 180], 6 sheets" in result.stderr
    assert len(list(out.glob("target_A_r?c?.png"))) == 6
    assert len(list(out.glob("target_A_r?c?.svg"))) == 6


def test_new_targets_differ_from_the_known_ones(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = (flight, "--new", "2", "--format", "svg", "--out", out)
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    new = read_back(tmp_path / "again", out / "targets.toml")
    assert [target.name for target in new] == ["T1", "T2"]
    assert new[0].ring.outer_diameter_m == 0.15
    both = TABLES + (out / "targets.toml").read_text(encoding="utf-8")
    assert len(tomllib.loads(both)["target"]) == 5
    (flight / "flight.toml").write_text(both, encoding="utf-8")
    assert len(read_printed_targets(flight)) == 4, "none of them could be confused"


def test_new_targets_do_not_replace_those_of_an_earlier_run(tmp_path: Path) -> None:
    """They may have been printed, and their codes stand nowhere else."""
    arguments = ("--new", "2", "--diameter", "0.15", "--format", "svg", "--out", tmp_path)
    assert run(*arguments).exit_code == 0
    assert run(*arguments).exit_code == 0, "the same again"
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    one = run("--code", "0,40,90,255", "--diameter", "0.5", "--format", "svg", "--out", tmp_path)
    assert one.exit_code == 1
    assert "targets.toml: has T1, T2 of an earlier run" in one.stderr
    assert "or delete the file if these are not printed (--out)" in one.stderr
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_more_targets_for_a_flight_differ_from_those_of_an_earlier_run(tmp_path: Path) -> None:
    """In another folder alone, codes and names would be the same again."""
    arguments = ("--new", "1", "--format", "svg")
    first = tmp_path / "first"
    assert run(*arguments, "--diameter", "0.15", "--out", first).exit_code == 0
    refused = run(*arguments, "--diameter", "0.5", "--out", first)
    assert "copy its tables into flight.toml and name that flight" in refused.stderr
    (tmp_path / "flight.toml").write_bytes((first / "targets.toml").read_bytes())
    assert run(tmp_path, *arguments, "--diameter", "0.5").exit_code == 0
    (old,) = read_printed_targets(tmp_path)
    (new,) = read_back(tmp_path / "new", tmp_path / "kgcp" / "targets" / "targets.toml")
    assert (old.name, new.name) == ("T1", "T2")
    assert old.ring.code_deg != new.ring.code_deg


def test_targets_of_flight_toml_are_written_again_after_a_change(flight: Path) -> None:
    assert run(flight, "--new", "1", "--format", "svg").exit_code == 0
    refused = run(flight, "--target", "A", "--format", "svg")
    assert refused.exit_code == 1
    assert "has T1 of an earlier run" in refused.stderr
    (flight / "kgcp" / "targets" / "targets.toml").unlink()
    assert run(flight, "--format", "svg").exit_code == 0
    changed = TABLES.replace("_diameter_m = 0.15\n", "_diameter_m = 0.1501\n")
    (flight / "flight.toml").write_text(changed, encoding="utf-8")
    assert run(flight, "--target", "A", "--format", "svg").exit_code == 0


def test_codes_with_a_rotational_symmetry_cause_a_warning(flight: Path) -> None:
    text = TABLES.replace("[0, 60, 150, 250]", "[0, 90, 180, 270]")
    (flight / "flight.toml").write_text(text, encoding="utf-8")
    result = run(flight, "--format", "svg")
    assert result.exit_code == 0
    assert "kgcp: warning: rotated or mirrored, codes are only 0.0 dots apart" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--new", "2"], "diameter: is missing"),
        (["--code", "0,90,180,270", "--diameter", "0.2"], "away from itself, turned"),
        (["--code", "a", "--diameter", "0.2"], "'a' is not a list of angles"),
        (["FLIGHT", "--code", "10,53,88.25,190"], "rotations of each other"),
        (["FLIGHT", "--target", "C"], "'C' is not in flight.toml; give one of A, B b"),
        (["FLIGHT", "--plate", "0.16"], "give at least 0.1875 m"),
        (["FLIGHT", "--holes", "5"], "plate: is required by --round"),
        (["FLIGHT", "--sheet", "A4", "--plate", "0.25"], "A4 is smaller; allow several sheets"),
        (["FLIGHT", "--tiled"], "'fit' is one sheet"),
        (["FLIGHT", "--format", "png", "--dpi", "2400", "--plate", "0.5"], "million pixels"),
        (["FLIGHT", "--target", "A", "--new", "1"], "target: cannot be combined with --new"),
        (["FLIGHT", "--diameter", "0.3"], "diameter: applies to new targets only"),
        (["--code", "0,43,78,180", "--dots", "5"], "dots: applies to proposed codes only"),
        (["no_such_folder"], "flight.toml: does not exist"),
    ],
)
def test_impossible_inputs_are_a_one_line_error(
    flight: Path, arguments: list[str], words: str
) -> None:
    result = run(*(str(flight) if word == "FLIGHT" else word for word in arguments))
    assert result.exit_code == 1
    assert words in result.stderr
    assert result.stderr.startswith("kgcp: error: ")
    assert result.stderr.count("\n") == 1


def test_a_field_is_drawn_with_its_field_toml(tmp_path: Path) -> None:
    arguments = ["target", "--field", "grid:9x6:25mm:14mm", "--sheet", "A4", "--format", "png"]
    options = ["--dpi", "100", "--out", str(tmp_path), "--json"]
    result = CliRunner().invoke(main, [*arguments, *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "looks the same when it is rotated" in result.stderr
    assert json.loads(result.stdout)["discs"] == 54
    field = read_field(str(tmp_path / "field.toml"))
    assert isinstance(field, Field)
    assert (field.columns, field.rows) == (9, 6)
    grey = cv2.imread(str(tmp_path / "target_field.png"), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    naming = measure_field(
        grey, PhotoTask(field, Response.LINEAR, Operator.CENTROID), "p", ExifCamera()
    )
    assert isinstance(naming, PhotoDiscs)
    assert len(naming.point) == 54
    steps = np.linalg.norm(np.diff(naming.vectors[:9, :2], axis=0), axis=1)
    assert steps == pytest.approx(25.0 / 25.4 * 100.0, abs=0.3)


def test_a_field_on_joined_sheets_is_stated_less_accurately(tmp_path: Path) -> None:
    arguments = ["target", "--field", "grid:9x6:25mm:14mm", "--sheet", "A4", "--format", "svg"]
    assert CliRunner().invoke(main, [*arguments, "--out", str(tmp_path / "one")]).exit_code == 0
    arguments[2] = "grid:9x8:30mm:14mm"
    arguments += ["--tiled", "--out", str(tmp_path / "tiles")]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    stated = [read_field(str(tmp_path / name / "field.toml")) for name in ("one", "tiles")]
    assert [field.flat_sd_m for field in stated] == [(5e-5, 5e-5, 3e-4), (5e-4, 5e-4, 3e-4)]


_POINTS = """
name = "panel"
diameter_m = 0.012
[code]
kind = "ring"
bits = 10
ring = [1.8, 2.6]
"""
_CODES = (5, 11, 13, 37, 63, 85, 343, 127)


def _field_of_points(folder: Path, depth_m: float) -> str:
    """Write a field with codes, one of its discs raised."""
    places = [(0.06 * (k % 4), 0.07 * (k // 4) + 0.004 * k, 0.0) for k in range(len(_CODES))]
    places[3] = (*places[3][:2], depth_m)
    tables = [
        f'[[point]]\nname = "p{k}"\nposition_m = {list(place)}\ncode = {code}\n'
        for k, (place, code) in enumerate(zip(places, _CODES, strict=True))
    ]
    path = folder / "points.toml"
    path.write_text(_POINTS + "\n".join(tables), encoding="utf-8")
    return str(path)


def test_a_field_of_points_is_drawn_with_its_codes(tmp_path: Path) -> None:
    arguments = ["target", "--field", _field_of_points(tmp_path, 0.0), "--sheet", "A4"]
    options = ["--format", "png", "--dpi", "100", "--out", str(tmp_path)]
    result = CliRunner().invoke(main, [*arguments, *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    field = read_field(str(tmp_path / "field.toml"))
    grey = cv2.imread(str(tmp_path / "target_field.png"), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    naming = measure_field(
        grey, PhotoTask(field, Response.LINEAR, Operator.CENTROID), "p", ExifCamera()
    )
    assert isinstance(naming, PhotoDiscs)
    assert naming.point.tolist() == list(range(len(_CODES)))
    off_px = naming.vectors[:, :2] - 100.0 / 0.0254 * field.points_m()[:, :2]
    assert np.ptp(off_px, axis=0) == pytest.approx(0.0, abs=0.3)


def test_a_field_with_depth_is_not_drawn(tmp_path: Path) -> None:
    arguments = ["target", "--field", _field_of_points(tmp_path, 0.02), "--out", str(tmp_path)]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 1
    assert "points: do not lie in one plane of equal z" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "options",
    [("--new", "2"), ("--diameter", "0.2"), ("--dots", "4"), ("--round",), ("--holes", "8")],
)
def test_a_field_is_drawn_alone(tmp_path: Path, options: tuple[str, ...]) -> None:
    field = ["target", "--field", "grid:9x6:25mm:14mm", "--out", str(tmp_path)]
    result = CliRunner().invoke(main, [*field, *options], catch_exceptions=False)
    assert result.exit_code == 1
    assert f"field: is drawn alone; leave out {options[0]}" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_field_toml_is_not_written_over_itself(tmp_path: Path) -> None:
    path = tmp_path / "field.toml"
    Path(_field_of_points(tmp_path, 0.0)).rename(path)
    content = path.read_bytes()
    arguments = ["target", "--field", str(path), "--out", str(tmp_path)]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 1
    assert "field.toml: describes the field and would be overwritten; write to" in result.stderr
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_a_field_toml_with_measured_lengths_is_not_replaced(tmp_path: Path) -> None:
    arguments = ["target", "--field", "grid:9x6:25mm:14mm", "--format", "svg", "--out"]
    for _ in range(2):
        assert CliRunner().invoke(main, [*arguments, str(tmp_path)]).exit_code == 0
    path = tmp_path / "field.toml"
    measured = path.read_text(encoding="utf-8").replace("pitch_m = 0.025", "pitch_m = 0.02503")
    path.write_text(measured, encoding="utf-8")
    result = CliRunner().invoke(main, [*arguments, str(tmp_path)], catch_exceptions=False)
    assert result.exit_code == 1
    assert "field.toml: describes another field, or this one with measured len" in result.stderr
    assert path.read_text(encoding="utf-8") == measured


def test_a_board_without_a_unit_is_drawn_with_the_one_given(tmp_path: Path) -> None:
    board = tmp_path / "calibration_target.yaml"
    key = "boofcv.alg.fiducial.calib.ConfigCalibrationTarget"
    grid = "{numRows: 4, numCols: 5, shapeDistance: 3.0, shapeSize: 1.6}"
    board.write_text(f"# BoofCV\n{key}:\n  grid: {grid}\n  type: CIRCLE_GRID\n")
    arguments = ["target", "--field", str(board), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 1
    assert "does not state its unit" in result.stderr
    result = CliRunner().invoke(main, [*arguments, "--unit", "cm"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    field = read_field(str(tmp_path / "out" / "field.toml"))
    assert isinstance(field, Field)
    assert field.pitch_m == pytest.approx(0.03)
    result = CliRunner().invoke(main, ["target", "--new", "2", "--unit", "cm"])
    assert "unit: is that of a field's board file; give --field, too" in result.stderr
