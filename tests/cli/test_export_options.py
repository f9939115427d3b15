"""`kgcp export-gcp` on a flight in bends, whose frames' clock is 25 ms late."""

from __future__ import annotations

import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from kgcp.errors import KgcpWarning
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.selection import Selection
from kgcp.io.files.locks import sole_writer
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.columns import time_cell
from kgcp.io.tables.consistency import CONSISTENCY_COLUMNS
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.gcps import GCP_COLUMNS
from kgcp.io.tables.parquet import read_table, write_table
from kgcp.pipeline.export import export_gcps, make_gcps
from kgcp.quality.checks.doubt import Cause, mild
from kgcp.report.bias.origin import agreement
from tests.flight_toml import ON_A_VEHICLE

_ORIGIN = np.array([430606.1, 4583523.0, 120.0])
_LOCAL_FRAME = LocalFrame.at("EPSG:25831", _ORIGIN)
_UNIX_S, _LATE_S, _FRAMES = 1777887000.0, 0.025, 40
_NULL_ROW: dict[str, object] = {column.name: None for column in DETECTION_COLUMNS}


def _drive(time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 3) in the map and headings [deg], with some 12 m/s."""
    angle = (12.0 * time_s + 10.0 * np.sin(0.3 * time_s)) / 60.0
    enu = 60.0 * np.column_stack((np.cos(angle), np.sin(angle), 0.0 * angle))
    return _LOCAL_FRAME.map_from_enu(enu), -np.degrees(angle)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the flight, which nobody changes."""
    folder = tmp_path_factory.mktemp("written") / "flight"
    (folder / "frames").mkdir(parents=True)
    (folder / "flight.toml").write_text(ON_A_VEHICLE, encoding="utf-8")
    rng = np.random.default_rng(4)
    times = np.arange(0.0, 1.5 * _FRAMES + 4.0, 0.1)
    lines = ["time,x,y,z,roll_deg,pitch_deg,heading_deg,sd_x,sd_y,sd_z"]
    for t, xyz, heading in zip(times, *_drive(times), strict=True):
        place = ",".join(f"{value:.5f}" for value in xyz)
        lines.append(f"{_UNIX_S + t:.1f},{place},0,0,{heading:.6f},0.01,0.01,0.01")
    (folder / "vehicle.csv").write_text("\n".join(lines), encoding="utf-8")
    rows, reference = [], ["frame,x,y,z,omega_deg,phi_deg,kappa_deg,sd_x,sd_y,sd_z,sd_angle_deg"]
    for index in range(_FRAMES):
        t = 2.0 + 1.5 * index
        target = _drive(np.array([t]))[0][0] + [0.0, 0.0, 2.0]
        camera = target + np.array([3.0, -2.0, 50.0 + 5.0 * math.sin(0.1 * t)])
        place = ",".join(f"{value:.5f}" for value in camera + 0.01 * rng.standard_normal(3))
        reference.append(f"f_{index:02d}.jpg,{place},0,0,0,0.01,0.01,0.01,0.002")
        rows.append(_detection(index, t - _LATE_S, _in_camera(camera, target)))
    (folder / "reference.csv").write_text("\n".join(reference), encoding="utf-8")
    rows[20] |= {"distance_m": float(str(rows[20]["distance_m"])) + 2.0}
    rows[5] |= {"score": 0.88}
    rows[7] |= {"ambiguity": 3.0}
    write_table(folder / "kgcp" / "detections.parquet", DETECTION_COLUMNS, rows, {})
    return folder


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A copy of the flight."""
    return Path(shutil.copytree(written, tmp_path, dirs_exist_ok=True))


def _in_camera(camera: FloatArray, target: FloatArray) -> FloatArray:
    """The target in a camera that looks down with the grid's north up."""
    ends = _LOCAL_FRAME.enu_from_map(np.array([camera, target]))
    grid = _LOCAL_FRAME.grid_rotation(ends[0])
    sight: FloatArray = np.diag([1.0, -1.0, -1.0]) @ grid.T @ (ends[1] - ends[0])
    return sight


def _detection(index: int, time_s: float, sight: FloatArray) -> dict[str, object]:
    pixel = 2300.0 * sight[:2] / sight[2] + [800.0, 600.0]
    text = dict.fromkeys(("reason", "detail"), "")
    return (
        _NULL_ROW
        | text
        | {
            "frame": f"f_{index:02d}.jpg",
            "target": "A",
            "shape": "coded",
            "time": time_cell(_UNIX_S + time_s),
            "instance": 0,
            "status": "measured",
            "candidates": 0,
            "guided": False,
            "scale_used": "A",
            "x_px": pixel[0],
            "y_px": pixel[1],
            "sd_x_px": 0.05,
            "sd_y_px": 0.05,
            "cov_xy_px2": 0.0,
            "distance_m": float(np.linalg.norm(sight)),
            "sd_distance_m": 0.01,
            **dict(zip(("tx_m", "ty_m", "tz_m"), sight.tolist(), strict=True)),
            **dict(zip(("qw", "qx", "qy", "qz"), (1.0, 0.0, 0.0, 0.0), strict=True)),
            "pose_cov": np.diag([1e-6, 1e-6, 1e-4, 1e-6, 1e-6, 1e-6]).ravel().tolist(),
            "ambiguity": 30.0,
            "score": 0.97,
        }
    )


def _export(folder: Path, *options: str) -> Result:
    result = CliRunner().invoke(main, ["export-gcp", str(folder), "--format", "csv", *options])
    assert result.exit_code == 0, result.output
    return result


def test_advice_of_the_summary_disappears_once_it_is_followed(folder: Path) -> None:
    result = _export(folder, "--json")
    (line,) = json.loads(result.stdout)["advice"]
    assert "kgcp: doubt: vehicle and camera differ by 0.303 m along, " in result.stderr
    assert f"; {line}\n" in result.stderr
    value = float(line.split()[1])
    assert line.startswith("add 0.02")
    assert "to [vehicle] time_offset_s in flight.toml" in line
    summary = json.loads((folder / "kgcp" / "consistency.json").read_text(encoding="utf-8"))
    offset = summary["corrections"][0]
    assert offset["name"] == "time_offset_s"
    assert abs(offset["value"] - _LATE_S) < 4.0 * offset["sd"]
    assert offset["is_significant"]
    table = read_table(folder / "kgcp" / "consistency.parquet", CONSISTENCY_COLUMNS)
    assert len(table) == _FRAMES
    assert np.median(table["along_m"]) == pytest.approx(-12.0 * _LATE_S, abs=0.08)
    toml = (folder / "flight.toml").read_text(encoding="utf-8")
    heeded = toml.replace("lever_arm_m", f"time_offset_s = {value}\nlever_arm_m")
    (folder / "flight.toml").write_text(heeded, encoding="utf-8")
    assert json.loads(_export(folder, "--json").stdout)["advice"] == []


def test_corrections_that_a_doubt_withholds_are_not_advised(folder: Path) -> None:
    """Corrections would compensate for diameters that are not those of the print."""
    table = folder / "kgcp" / "detections.parquet"
    rows = pq.read_table(table).to_pylist()
    write_table(table, DETECTION_COLUMNS, ({**row, "inner_growth": 0.02} for row in rows), {})
    printed = json.loads(_export(folder, "--json").stdout)
    saved = json.loads((folder / "kgcp" / "consistency.json").read_text(encoding="utf-8"))
    assert "diameters" in {doubt["code"] for doubt in saved["doubts"]}
    assert printed["doubts"] == [doubt | {"flight": folder.name} for doubt in saved["doubts"]]
    (line,) = printed["advice"]
    assert saved["advice"] == [line]
    assert line.endswith("no correction is offered, because a doubt names a likelier cause")
    assert saved["corrections"][0]["is_significant"]


def test_a_table_of_an_older_kgcp_can_be_used_and_is_named(folder: Path) -> None:
    table = folder / "kgcp" / "detections.parquet"
    _export(folder)
    points = (folder / "kgcp" / "kgcps.csv").read_bytes()
    pq.write_table(pq.read_table(table).drop_columns(["inner_growth"]), table)
    result = _export(folder)
    assert (folder / "kgcp" / "kgcps.csv").read_bytes() == points
    assert result.stderr.count("an older kgcp wrote it, without inner_growth") == 1


def test_programs_are_warned_of_exclusions_that_match_nothing(folder: Path) -> None:
    selection = Selection(excluded=(("f_00.jpg", ""), ("f_99.jpg", "A")))
    with pytest.warns(KgcpWarning, match=r"1 exclusion without a row .*\(f_99.jpg, A\)"):
        made = make_gcps(read_flight(folder), selection=selection)
    assert {each.frame for each in made.skipped} >= {"f_00.jpg"}
    written = export_gcps(made, (name for name in ["csv"]), folder / "other")  # type: ignore[arg-type]
    assert [path.name for path in written] == ["kgcps.csv"]


def test_programs_are_warned_of_a_table_of_other_points(folder: Path) -> None:
    _export(folder)
    results, flight = folder / "kgcp", read_flight(folder)
    export_gcps(make_gcps(flight), ["csv"], results)  # the same points: warnings are errors here
    with pytest.warns(KgcpWarning, match=r"kgcps.parquet: is of an earlier export") as warned:
        export_gcps(make_gcps(flight, crs="EPSG:4258"), ["csv"], results)
    assert Path(warned[0].filename).name == "test_export_options.py"


def test_no_page_says_that_a_doubted_flight_needs_no_correction(folder: Path) -> None:
    toml = (folder / "flight.toml").read_text(encoding="utf-8")
    right = toml.replace("lever_arm_m", f"time_offset_s = {_LATE_S}\nlever_arm_m")
    (folder / "flight.toml").write_text(right, encoding="utf-8")
    made = make_gcps(read_flight(folder))
    assert agreement(made.consistency, ()).endswith("flight.toml needs no correction.")
    doubt = mild(Cause.MOUNT, "the plate is turned", "set [vehicle] mount_deg = 0")
    assert agreement(made.consistency, [doubt]).endswith("(RMS of 40 frames, 0 outliers).")


def test_a_quiet_export_prints_grave_doubts_only(folder: Path) -> None:
    toml = (folder / "flight.toml").read_text(encoding="utf-8")
    wrong = toml.replace('crs = "EPSG:25831"', 'crs = "EPSG:31468"')
    assert wrong != toml
    (folder / "flight.toml").write_text(wrong, encoding="utf-8")
    result = _export(folder, "--quiet", "--json")
    graves = [each for each in json.loads(result.stdout)["doubts"] if each["severity"] == "grave"]
    assert graves
    assert result.stderr.count("kgcp: grave doubt: ") == len(graves) == result.stderr.count("\n")


def test_the_summary_says_how_well_the_points_are_known(folder: Path) -> None:
    stderr = _export(folder).stderr
    with (folder / "kgcp" / "kgcps.csv").open(encoding="utf-8") as stream:
        cells = [*csv.DictReader(stream)]
    sds_cm = 100.0 * np.array([[float(row[f"sd_{axis}"]) for axis in "xyz"] for row in cells])
    usual = "/".join(f"{value:.2g}" for value in np.median(sds_cm, axis=0))
    worst = f"{sds_cm.max():.2g}"
    line = f"standard deviations of x/y/z: {usual} cm (median), at worst {worst} cm\n"
    assert line in stderr


def test_a_file_that_cannot_be_written_is_an_error_with_all_formats(folder: Path) -> None:
    (folder / "kgcp" / "odm").write_text("a file, where a folder must be")
    result = CliRunner().invoke(main, ["export-gcp", str(folder), "--format", "all"])
    assert result.exit_code == 1
    assert f"{folder / 'kgcp' / 'odm' / 'gcp_list.txt'}: cannot be written" in result.stderr


@pytest.mark.parametrize("command", ["export-gcp", "bias-report", "place", "orient"])
def test_another_results_folder_needs_the_table_of_detections(folder: Path, command: str) -> None:
    out, table = folder / "other", folder / "kgcp" / "detections.parquet"
    result = CliRunner().invoke(main, [command, str(folder), "--out", str(out)])
    assert result.exit_code == 1
    assert result.stderr == (
        f"kgcp: error: {out / 'detections.parquet'}: does not exist; name the table that lies in"
        f" the flight's folder (--detections {table})\n"
    )


def test_without_any_table_the_error_advises_to_run_detect(folder: Path) -> None:
    table = folder / "kgcp" / "detections.parquet"
    _export(folder, "--out", str(folder / "other"), "--detections", str(table))
    table.unlink()
    arguments = ["export-gcp", str(folder), "--out", str(folder / "other")]
    result = CliRunner().invoke(main, arguments)
    assert "does not exist; run 'kgcp detect' on this flight first" in result.stderr


@pytest.mark.parametrize("flights", [1, 2])
def test_the_consistency_file_of_an_earlier_export_is_removed(
    folder: Path, tmp_path: Path, flights: int
) -> None:
    _export(folder)
    files = [folder / "kgcp" / f"consistency.{suffix}" for suffix in ("json", "parquet")]
    assert all(file.exists() for file in files)
    (folder / "reference.csv").unlink()
    others = []
    if flights == 2:
        others = [str(shutil.copytree(folder, tmp_path / "north")), "--out", str(folder / "kgcp")]
        toml = tmp_path / "north" / "flight.toml"
        toml.write_text('name = "north"\n' + toml.read_text(encoding="utf-8"), encoding="utf-8")
    _export(folder, *others)
    assert not any(file.exists() for file in files)


def test_jumps_are_excluded_and_counted_unless_they_are_to_be_kept(folder: Path) -> None:
    summary = json.loads(_export(folder, "--json").stdout)
    assert summary["skipped"] == {"distance_jump": 1}
    assert summary["kgcps"] == _FRAMES - 1
    result = _export(folder, "--keep-flagged")
    assert f"{_FRAMES} KGCPs, 0 sightings left out" in result.stderr
    table = read_table(folder / "kgcp" / "kgcps.parquet", GCP_COLUMNS)
    assert list(table.loc[table["flag"] != "", "frame"]) == ["f_20.jpg"]
    with (folder / "kgcp" / "kgcps.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["frame"] for row in rows if row["flag"]] == ["f_20.jpg"]
    assert {row["role"] for row in rows} == {"control"}
    assert {float(row["sd_common_x"]) for row in rows} == {0.0}  # neither arm nor clock has any


def test_gates_spacing_and_check_points_select_points(folder: Path) -> None:
    options = ("--min-score", "0.9", "--min-spacing", "30", "--checkpoints", "0.25", "--json")
    summary = json.loads(_export(folder, *options).stdout)
    assert summary["skipped"]["low_score"] == 1
    assert summary["skipped"]["too_close"] > 10
    table = read_table(folder / "kgcp" / "kgcps.parquet", GCP_COLUMNS)
    assert len(table) == summary["kgcps"]
    assert (table["role"] == "check").sum() == round(0.25 * len(table)) == summary["checkpoints"]
    steps = np.linalg.norm(np.diff(table[["x", "y"]].to_numpy(), axis=0), axis=1)
    assert steps.min() > 25.0  # chords of 30 m and more on a circle of 60 m
    summary = json.loads(_export(folder, "--max-sd", "0.011", "--json").stdout)
    assert "uncertain" not in summary["skipped"]
    summary = json.loads(_export(folder, "--min-ambiguity", "9", "--json").stdout)
    assert summary["skipped"]["ambiguous"] == 1
    strict = CliRunner().invoke(main, ["export-gcp", str(folder), "--max-sd", "0.009"])
    assert strict.exit_code == 1
    assert "no points left" in strict.stderr


def test_two_plates_of_one_code_in_every_frame_are_named(folder: Path) -> None:
    table = folder / "kgcp" / "detections.parquet"
    rows = pq.read_table(table).to_pylist()
    both = [{**row, "instance": instance} for row in rows for instance in (0, 1)]
    write_table(table, DETECTION_COLUMNS, both, {})
    result = CliRunner().invoke(main, ["export-gcp", str(folder)])
    assert result.exit_code == 1
    assert f"{table}: every frame with a target shows several plates" in result.stderr


def test_points_exported_in_another_crs_are_the_same_places(folder: Path) -> None:
    _export(folder)
    path = folder / "kgcp" / "kgcps.parquet"
    here = read_table(path, GCP_COLUMNS)
    _export(folder, "--crs", "EPSG:4326")
    there = read_table(path, GCP_COLUMNS)
    assert pq.read_schema(path).metadata[b"kgcp.crs"] == b"EPSG:4326"
    assert there["x"].between(2.16, 2.18).all()  # longitude first
    degrees = there[["x", "y", "z"]].to_numpy()
    world = LocalFrame.at("EPSG:4326", degrees[0])
    local = LocalFrame.at("EPSG:25831", here[["x", "y", "z"]].to_numpy()[0])
    np.testing.assert_allclose(
        world.enu_from_map(degrees),
        local.enu_from_map(here[["x", "y", "z"]].to_numpy()),
        atol=1e-5,
    )
    np.testing.assert_allclose(there[["sd_x", "sd_y", "sd_z"]], 0.01, rtol=1e-6)
    with (folder / "kgcp" / "kgcps.csv").open(encoding="utf-8") as stream:
        assert stream.read().count("EPSG:4326") == _FRAMES - 1


def test_a_crs_whose_map_is_not_to_scale_is_doubted(folder: Path) -> None:
    assert "kgcp: doubt: EPSG:3857 stretches" in _export(folder, "--crs", "EPSG:3857").stderr


def test_an_unusable_crs_is_a_one_line_error(folder: Path) -> None:
    for crs in ("nonsense", "EPSG:2263", "EPSG:4978"):
        result = CliRunner().invoke(main, ["export-gcp", str(folder), "--crs", crs])
        assert result.exit_code == 1
        assert f"crs '{crs}'" in result.stderr
        assert result.stderr.count("\n") == 1


def test_without_the_reference_file_there_is_no_comparison(folder: Path) -> None:
    (folder / "reference.csv").unlink()
    assert json.loads(_export(folder, "--json").stdout)["advice"] == []
    assert not (folder / "kgcp" / "consistency.json").exists()


def test_two_exports_do_not_write_to_one_folder(folder: Path) -> None:
    with sole_writer(folder / "kgcp", "export-gcp"):
        result = CliRunner().invoke(main, ["export-gcp", str(folder)])
    assert result.exit_code == 1
    assert "another kgcp is writing here; wait until it ends" in result.stderr
    assert not (folder / "kgcp" / "kgcps.parquet").exists()
    assert _export(folder).exit_code == 0
    assert not [*(folder / "kgcp").glob(".*")]


@pytest.mark.usefixtures("no_bias_figures")
def test_a_bias_report_leaves_out_what_an_export_does(folder: Path) -> None:
    """A ring of which a person has seen that it is not the target counts in neither."""
    unwanted = folder / "exclude.csv"
    unwanted.write_text("f_20.jpg\nf_3.jpg\n", encoding="utf-8")
    arguments = ["bias-report", str(folder), "--reexpose", "0", "--exclude", str(unwanted)]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert "1 exclusion without a row in the detections (f_3.jpg)" in result.stderr
    assert result.exit_code == 0, result.output
    assert "1 measurement left out (--exclude)" in result.stderr
    frames = pq.read_table(folder / "kgcp" / "bias.parquet")["frame"].to_pylist()
    assert len(frames) == _FRAMES - 1
    assert "f_20.jpg" not in frames
    assert "Left out by hand" in (folder / "kgcp" / "bias_report.html").read_text(encoding="utf-8")
