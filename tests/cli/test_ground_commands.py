"""`kgcp export-gcp` and `kgcp bias-report` on a flight of six frames, made here."""

from __future__ import annotations

import csv
import json
import re
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from kgcp.io.tables.columns import time_cell
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.gcps import BIAS_COLUMNS, GCP_COLUMNS
from kgcp.io.tables.parquet import read_table, write_table
from kgcp.report.bias.reexposure import Reexposed
from tests.flight_toml import ON_A_VEHICLE

_TOML = f'name = "six <frames>"\n{ON_A_VEHICLE}'
_START = np.array([430606.1, 4583523.0, 120.0])
_UNIX_S = 1777887000.0
_FRAMES = tuple(f"f_{index}.jpg" for index in range(6))
_HEIGHTS_M = (20.0, 35.0, 50.0, 65.0, 80.0, 95.0)
_NULL_ROW: dict[str, object] = {column.name: None for column in DETECTION_COLUMNS}


@dataclass(frozen=True)
class FlightFolder:
    path: Path

    @property
    def out(self) -> Path:
        return self.path / "kgcp"

    def edit(self, old: str, new: str, name: str = "flight.toml") -> None:
        file = self.path / name
        text = file.read_text(encoding="utf-8")
        assert old in text
        file.write_text(text.replace(old, new), encoding="utf-8")

    def detect(self, change: Callable[[dict[str, object]], object] = lambda row: row) -> None:
        rows = [_detection(index) for index in range(len(_FRAMES))]
        for row in rows:
            change(row)
        write_table(self.out / "detections.parquet", DETECTION_COLUMNS, rows, {})

    def run(self, *arguments: str) -> Result:
        return CliRunner().invoke(main, [arguments[0], str(self.path), *arguments[1:]])

    def fails(self, *arguments: str) -> str:
        result = self.run(*arguments)
        assert result.exit_code == 1, result.output
        assert result.stderr.count("\n") == 1, result.stderr
        return result.stderr


def _detection(index: int) -> dict[str, object]:
    row = _NULL_ROW | {
        "frame": _FRAMES[index],
        "target": "A",
        "shape": "coded",
        "time": time_cell(_UNIX_S + index),
        "instance": 0,
        "status": "measured",
        "reason": "",
        "scale_used": "A",
        "x_px": 800.0,
        "y_px": 600.0,
        "sd_x_px": 0.03,
        "sd_y_px": 0.04,
        "cov_xy_px2": 0.0002,
        "distance_m": 1.001 * _HEIGHTS_M[index],
        "sd_distance_m": 0.01,
        "white": 0.5 + 0.05 * index,
    }
    if index == 4:
        row |= {"status": "not_found", "reason": "code_mismatch", "distance_m": None}
    return row


@pytest.fixture
def flight(tmp_path: Path) -> FlightFolder:
    folder = FlightFolder(tmp_path / "flight")
    (folder.path / "frames").mkdir(parents=True)
    (folder.path / "flight.toml").write_text(_TOML, encoding="utf-8")
    vehicle = ["time,x,y,z,roll_deg,pitch_deg,heading_deg,sd_x,sd_y,sd_z"]
    for step in range(61):
        x, y, z = _START + 0.1 * step * np.array([10.0, 0.0, 0.0])
        vehicle.append(f"{_UNIX_S + 0.1 * step:.1f},{x:.4f},{y:.4f},{z:.4f},0,0,90,0.02,0.02,0.03")
    (folder.path / "vehicle.csv").write_text("\n".join(vehicle), encoding="utf-8")
    _write_reference(folder.path / "reference.csv")
    folder.detect()
    return folder


def _write_reference(path: Path) -> None:
    """Write cameras straight above the target, looking down."""
    lines = ["frame,x,y,z,omega_deg,phi_deg,kappa_deg"]
    for index, height in enumerate(_HEIGHTS_M):
        x, y, z = _START + np.array([10.0 * index, 0.0, 2.0 + height])
        lines.append(f"{_FRAMES[index]},{x:.4f},{y:.4f},{z:.4f},0,0,0")
    path.write_text("\n".join(lines), encoding="utf-8")


def test_export_writes_the_contracts_table_and_the_formats(flight: FlightFolder) -> None:
    result = flight.run("export-gcp", "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["kgcps"] == 5
    assert [Path(path).name for path in summary["files"]] == [
        "kgcps.parquet",
        "kgcps.csv",
        "gcp_list.txt",
        "HOWTO.txt",
    ]
    table = read_table(flight.out / "kgcps.parquet", GCP_COLUMNS)
    assert list(table["id"]) == ["K0001", "K0002", "K0003", "K0004", "K0006"]  # by frame number
    expected = _START + np.outer([0, 1, 2, 3, 5], [10.0, 0.0, 0.0]) + [0.0, 0.0, 2.0]
    np.testing.assert_allclose(table[["x", "y", "z"]].to_numpy(), expected, atol=2e-4)
    np.testing.assert_allclose(table[["sd_x", "sd_y", "sd_z"]].to_numpy()[0], [0.02, 0.02, 0.03])
    assert len(table["cov"][0]) == 9
    assert table["time"][1] == pd.Timestamp(_UNIX_S + 1.0, unit="s", tz="UTC")


def test_plain_csv_agrees_with_the_table(flight: FlightFolder) -> None:
    flight.run("export-gcp", "--format", "csv")
    assert not (flight.out / "odm/gcp_list.txt").exists()
    with (flight.out / "kgcps.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    table = read_table(flight.out / "kgcps.parquet", GCP_COLUMNS)
    for name in ("x", "y", "z", "sd_x", "distance_m", "x_px", "sd_y_px"):
        np.testing.assert_allclose([float(row[name]) for row in rows], table[name], rtol=1e-4)
    assert float(rows[0]["x"]) == pytest.approx(table["x"][0], abs=1e-5)
    assert float(rows[0]["cov_xy_px2"]) == pytest.approx(0.0002)
    assert {row["crs"] for row in rows} == {"EPSG:25831"}
    assert rows[1]["time"] == "2026-05-04T09:30:01.000000Z"


def test_odm_list_follows_its_grammar(flight: FlightFolder) -> None:
    flight.run("export-gcp", "--format", "odm")
    lines = (flight.out / "odm/gcp_list.txt").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "EPSG:25831"
    points = [line.split() for line in lines[1:] if not line.startswith("#")]
    assert len(points) == 5
    assert all(len(cells) == 7 for cells in points)
    assert len({tuple(cells[:3]) for cells in points}) == 5  # ODM merges equal coordinates
    assert points[0][5:] == ["f_0.jpg", "K0001"]
    assert [float(cell) for cell in points[0][3:5]] == [800.0, 600.0]  # centre of first pixel: 0
    assert all(len(cell.partition(".")[2]) >= 3 for cell in points[0][:3])


def test_wgs84_utm_gets_an_unambiguous_odm_header(flight: FlightFolder) -> None:
    flight.edit("EPSG:25831", "EPSG:32631")
    flight.run("export-gcp")
    text = (flight.out / "odm/gcp_list.txt").read_text(encoding="utf-8")
    assert text.startswith("WGS84 UTM 31N\n")


def test_odm_refuses_names_it_cannot_read_but_the_rest_is_written(flight: FlightFolder) -> None:
    flight.detect(lambda row: row.update(frame=f"my {row['frame']}"))
    result = flight.run("export-gcp")
    assert result.exit_code == 0, result.output
    assert "left out odm: gcp_list.txt: frame 'my " in result.stderr
    assert (flight.out / "kgcps.parquet").exists()
    assert (flight.out / "kgcps.csv").exists()
    assert "white space" in flight.fails("export-gcp", "--format", "odm")
    flight.detect(lambda row: row.update(frame=f"{str(row['frame'])[2]}/same.jpg"))
    assert "'0/same.jpg' and '1/same.jpg'" in flight.fails("export-gcp", "--format", "odm")


def test_a_static_target_is_one_point_with_many_rays(flight: FlightFolder) -> None:
    flight.edit('name = "A"\n', 'name = "A"\nposition_m = [430606.1, 4583523.0, 122.0]\n')
    flight.edit("[vehicle]\n", "[reference]\n#")
    toml = (flight.path / "flight.toml").read_text(encoding="utf-8")
    without = re.sub(r"\[reference\]\n#trajectory.*?\n\n", "", toml, flags=re.DOTALL)
    (flight.path / "flight.toml").write_text(without, encoding="utf-8")
    result = flight.run("export-gcp")
    assert result.exit_code == 0, result.output
    text = (flight.out / "odm/gcp_list.txt").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines()[1:] if not line.startswith("#")]
    assert {tuple(line.split()[:3]) for line in lines} == {
        ("430606.1000000", "4583523.0000000", "122.0000000")
    }
    assert {line.split()[6] for line in lines} == {"A"}


def test_all_formats_skips_formats_that_cannot_hold_the_points(flight: FlightFolder) -> None:
    result = flight.run("export-gcp", "--format", "all")
    assert result.exit_code == 0, result.output
    assert "left out colmap: there is no camera position" in result.stderr
    for name in ("kgcps.csv", "odm/gcp_list.txt", "opf/project.opf", "mmvii/kgcp.obs"):
        assert (flight.out / name).is_file()
    assert "camera position" in flight.fails("export-gcp", "--format", "colmap")
    flight.detect(lambda row: row.update(frame=f"my {row['frame']}"))
    result = flight.run("export-gcp", "--format", "all")
    assert "left out odm: gcp_list.txt" in result.stderr
    assert '"my%20f_0.jpg"' in (flight.out / "opf/camera_list.json").read_text(encoding="utf-8")


def test_names_of_images_may_lack_their_extension(flight: FlightFolder) -> None:
    for option, name in (("with-extension", "f_0.jpg"), ("without-extension", "f_0")):
        options = ("--format", "realityscan", "--format", "odm", "--image-names", option)
        assert flight.run("export-gcp", *options).exit_code == 0
        marks = (flight.out / "realityscan/measurements.csv").read_text(encoding="utf-8")
        assert f"\n{name},K0001," in marks
        points = (flight.out / "odm/gcp_list.txt").read_text(encoding="utf-8")
        assert " f_0.jpg K0001" in points, "ODM knows files"


def test_image_accuracies_have_a_minimum_in_packages_but_not_in_the_table(
    flight: FlightFolder,
) -> None:
    for options, accuracy in ((), 0.1), (("--mark-floor-px", "0.3"), 0.3):
        assert flight.run("export-gcp", "--format", "pix4d", *options).exit_code == 0
        with (flight.out / "pix4d/marks.csv").open(encoding="utf-8") as stream:
            assert {float(row[4]) for row in csv.reader(stream)} == {accuracy}
    table = read_table(flight.out / "kgcps.parquet", GCP_COLUMNS)
    assert set(table["sd_x_px"]) == {0.03}
    assert set(table["sd_distance_m"]) == {0.01}
    assert flight.run("export-gcp", "--mark-floor-px", "-1").exit_code == 2


def test_files_of_an_earlier_export_are_mentioned(flight: FlightFolder) -> None:
    flight.run("export-gcp", "--format", "odm", "--format", "micmac")
    result = flight.run("export-gcp", "--format", "csv", "--min-spacing", "30", "--json")
    assert json.loads(result.stdout)["not_renewed"] == ["odm", "micmac"]
    assert "not updated, from an earlier export: odm, micmac" in result.stderr
    result = flight.run("export-gcp", "--format", "odm", "--format", "micmac", "--format", "csv")
    assert "earlier export" not in result.stderr


def test_formats_are_listed_with_their_files() -> None:
    result = CliRunner().invoke(main, ["export-gcp", "--list-formats"])
    assert result.exit_code == 0
    assert "metashape      Agisoft Metashape" in result.stdout
    assert "metashape/scale_bars.csv" in result.stdout


def test_frames_outside_the_trajectory_are_counted(flight: FlightFolder) -> None:
    flight.edit("lever_arm_m", "time_offset_s = -0.5\nlever_arm_m")
    result = flight.run("export-gcp", "--json")
    assert json.loads(result.stdout)["skipped"] == {"before_trajectory": 1}
    assert "1 before_trajectory" in result.stderr


def test_bad_input_is_a_one_line_error_with_a_remedy(flight: FlightFolder) -> None:
    flight.edit("EPSG:25831", "EPSG:99999")
    assert "EPSG:99999" in flight.fails("export-gcp")
    flight.edit("EPSG:99999", "EPSG:25831")
    flight.edit("lever_arm_m", "time_offset_s = 3600.0\nlever_arm_m")
    message = flight.fails("export-gcp")
    for part in ("09:30:00", "09:30:05", "09:30:06", "3600"):
        assert part in message
    (flight.path / "vehicle.csv").unlink()
    assert "[vehicle] trajectory" in flight.fails("export-gcp")
    flight.detect(lambda row: row.update(status="not_found", reason="no_candidate"))
    assert "no target was measured" in flight.fails("export-gcp")
    flight.detect(lambda row: row.update(target="Z"))
    assert "'Z'" in flight.fails("export-gcp")
    (flight.out / "detections.parquet").unlink()
    assert "kgcp detect" in flight.fails("export-gcp")
    assert "kgcp detect" in flight.fails("bias-report")


def test_a_flight_without_crs_or_times_is_reported(flight: FlightFolder) -> None:
    flight.detect(lambda row: row.update(time=None))
    assert "no frame has a time" in flight.fails("export-gcp")
    flight.edit('crs = "EPSG:25831"\n', "")
    assert "has no crs" in flight.fails("export-gcp")


def test_bias_report_writes_table_figures_and_page(flight: FlightFolder) -> None:
    result = flight.run("bias-report", "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert (summary["compared"], summary["detected"], summary["frames_with_target"]) == (5, 5, 6)
    table = read_table(flight.out / "bias.parquet", BIAS_COLUMNS)
    heights = [height for index, height in enumerate(_HEIGHTS_M) if index != 4]
    np.testing.assert_allclose(table["reference_distance_m"], heights, atol=1e-4)
    np.testing.assert_allclose(table["residual_percent"], 0.1, atol=1e-3)
    assert list(table["white"]) == pytest.approx([0.5, 0.55, 0.6, 0.65, 0.75])
    page = (flight.out / "bias_report.html").read_text(encoding="utf-8")
    assert "six &lt;frames&gt;" in page
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)  # self-contained
    assert "too long" in page
    figures = sorted(flight.out.glob("bias_*.png"))
    assert page.count("data:image/png;base64,") == len(figures) == 7
    for figure in figures:
        assert figure.read_bytes().startswith(b"\x89PNG")
    numbers = json.loads((flight.out / "bias_summary.json").read_text(encoding="utf-8"))
    assert numbers == {key: value for key, value in summary.items() if key != "files"}
    assert numbers["verdict"] == "look"  # five frames are too few


def test_a_flight_without_reference_poses_is_reported(flight: FlightFolder) -> None:
    flight.edit('[reference]\nposes = "reference.csv"\n', "")
    assert "[reference]" in flight.fails("bias-report")


def test_a_missing_reference_names_its_key(flight: FlightFolder) -> None:
    (flight.path / "reference.csv").unlink()
    assert "[reference] poses" in flight.fails("bias-report")


@pytest.mark.usefixtures("sigint_raises")
def test_a_signal_waits_for_the_end_of_a_measurement_for_the_report(
    flight: FlightFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in _FRAMES:
        cv2.imwrite(str(flight.path / "frames" / name), np.zeros((1200, 1600), np.uint8))
    steps: list[str] = []

    def stop(*_: object) -> list[Reexposed]:
        signal.raise_signal(signal.SIGINT)
        steps.append("ended")
        return []

    monkeypatch.setattr("kgcp.pipeline.bias_report.measure_again", stop)
    result = flight.run("bias-report", "--reexpose", "3")
    assert result.exit_code == 130, result.output
    assert steps == ["ended"]
    assert not (flight.out / "bias_report.html").exists()
