"""`kgcp export-gcp`: excluded frames, and points of several flights."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from kgcp.io.exporters.formats import FORMATS
from kgcp.pipeline.merge import OF_ONE_CAMERA
from tests.cli.conftest import FRAMES, SampleFlight


def export(*arguments: object) -> Result:
    words = ["export-gcp", *map(str, arguments)]
    return CliRunner().invoke(main, words, catch_exceptions=False)


def error_of(*arguments: object) -> str:
    result = export(*arguments)
    assert result.exit_code == 1, result.stderr
    return result.stderr.splitlines()[-1]


def listed(folder: Path, text: str) -> Path:
    path = folder / "unwanted.csv"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def two(measured: SampleFlight, tmp_path: Path) -> tuple[SampleFlight, SampleFlight]:
    """Two measured flights, north and south, with the same frames."""
    south = SampleFlight(shutil.copytree(measured.path, tmp_path / "south"))
    measured.edit(('name = "sample"', 'name = "north"'))
    south.edit(('name = "sample"', 'name = "south bank"'))
    return measured, south


@pytest.mark.parametrize(
    "text",
    [
        f"{FRAMES[0]}\n# a comment\n\n{FRAMES[1]},A\n",
        f"\ufeffframe;target;\r\n{FRAMES[0]};A;;\r\n{FRAMES[1]};\r\n;;\r\n",
        f"target,frame,flight\nA,{FRAMES[0]},sample\n,{FRAMES[1]},\n",
    ],
)
def test_excluded_frames_are_counted_with_their_own_reason(
    measured: SampleFlight, text: str
) -> None:
    file = listed(measured.path, text)
    result = measured.run("export-gcp", "--exclude", str(file), "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert (summary["kgcps"], summary["skipped"]["excluded"]) == (2, 2)
    assert "2 excluded" in result.stderr
    points = pd.read_parquet(measured.out / "kgcps.parquet")
    assert list(points["frame"]) == [FRAMES[2], FRAMES[4]]  # the fourth does not show the target
    assert list(points["id"]) == ["K0003", "K0005"]


def test_excluded_names_without_a_row_cause_a_warning(measured: SampleFlight) -> None:
    file = listed(measured.path, f"{FRAMES[0].upper()}\n{FRAMES[1]},B\n{FRAMES[2]}\n")
    result = measured.run("export-gcp", "--exclude", str(file), "--json")
    assert "kgcp: warning: 2 exclusions without a row in the detections" in result.stderr
    assert "JPG; frame_0002.jpg, B); write" in result.stderr
    assert json.loads(result.stdout)["skipped"] == {"excluded": 1}
    everything = "\n".join(FRAMES)
    assert "all 4 sightings are excluded" in measured.fails(
        "export-gcp", "--exclude", str(listed(measured.path, everything))
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b,c\n", "line 1: has 3 cells"),
        (",A\n", "line 1: names no frame"),
        ("frame,flight\n,x\n", "line 2: names no frame"),
        ("x" * 200_000, "line 1: field larger than field limit"),
    ],
)
def test_malformed_exclusion_lists_are_errors(
    measured: SampleFlight, text: str, words: str
) -> None:
    file = listed(measured.path, text)
    assert words in measured.fails("export-gcp", "--exclude", str(file))
    assert "does not exist" in measured.fails("export-gcp", "--exclude", "nowhere.csv")


def test_ids_may_begin_with_the_flights_name(measured: SampleFlight) -> None:
    assert measured.run("export-gcp", "--flight-ids").exit_code == 0
    points = pd.read_parquet(measured.out / "kgcps.parquet")
    assert list(points["id"]) == [f"sample-K000{number}" for number in (1, 2, 3, 5)]
    assert "sample-K0001" in (measured.out / "odm" / "gcp_list.txt").read_text(encoding="utf-8")


def test_two_flights_are_merged_into_one_set(
    two: tuple[SampleFlight, SampleFlight], tmp_path: Path
) -> None:
    north, south = two
    south.edit(("[-0.8, 0.15, -1.95]", "[-0.8, 0.65, -1.95]"))
    (south.path / "frames" / FRAMES[0]).unlink()
    out = tmp_path / "block"
    result = export(north.path, south.path, "--out", out, "--format", "csv", "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["kgcps"] == 8
    assert [(each["flight"], each["code"]) for each in summary["doubts"]] == [
        ("south bank", "unreadable")
    ]
    assert "north: 4 KGCPs" in result.stderr
    assert "all 2 flights: 8 KGCPs, 0 sightings left out" in result.stderr
    points = pd.read_parquet(out / "kgcps.parquet")
    assert points["id"].is_unique
    assert list(points["id"][[0, 4]]) == ["north-K0001", "south_bank-K0001"]
    assert list(points["frame"][[0, 4]]) == [f"north/{FRAMES[0]}", f"south_bank/{FRAMES[0]}"]
    shift = points[["x", "y"]].to_numpy()[4:] - points[["x", "y"]].to_numpy()[:4]
    assert np.linalg.norm(shift, axis=1) == pytest.approx(0.5, abs=0.002)  # each its own lever arm
    again = export(north.path, south.path, "--out", tmp_path / "again", "--format", "csv")
    assert again.exit_code == 0
    for name in ("kgcps.parquet", "kgcps.csv"):
        assert (out / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_excluding_a_frame_affects_one_flight_only(
    two: tuple[SampleFlight, SampleFlight], tmp_path: Path
) -> None:
    places = [flight.path for flight in two]
    file = listed(tmp_path, f"{FRAMES[0]}\n")
    line = error_of(*places, "--out", tmp_path / "block", "--exclude", file)
    assert f"{FRAMES[0]} is a frame of north and south bank; name the flight" in line
    file = listed(tmp_path, f"flight,frame\nsouth bank,{FRAMES[0]}\n")
    result = export(
        *places, "--out", tmp_path / "block", "--exclude", file, "--format", "csv", "--json"
    )
    assert json.loads(result.stdout)["skipped"] == {"excluded": 1}
    ids = set(pd.read_parquet(tmp_path / "block" / "kgcps.parquet")["id"])
    assert "north-K0001" in ids
    assert "south_bank-K0001" not in ids


def test_flights_that_cannot_be_merged_are_refused(
    two: tuple[SampleFlight, SampleFlight], tmp_path: Path
) -> None:
    north, south = two
    places, block = (north.path, south.path), ("--out", tmp_path / "block")
    assert export(*places).exit_code == 2
    assert export(*places, *block, "--detections", "x.parquet").exit_code == 2
    line = error_of(*places, *block, "--format", "pix4d")
    assert f"'north/{FRAMES[0]}' and 'south_bank/{FRAMES[0]}' have the same file name" in line
    south.edit(('crs = "EPSG:25832"', 'crs = "EPSG:25833"'))
    line = error_of(*places, *block)
    assert "'north' and 'south bank' have different CRS (EPSG:25832 and EPSG:25833); " in line
    assert line.endswith("(--crs)")
    south.edit(('crs = "EPSG:25833"', 'crs = "EPSG:25832"'), ("south bank", "north"))
    assert "are both named 'north'; give each" in error_of(*places, *block)
    south.edit(('name = "north"', 'name = "x"'), ("outer_diameter_m = 0.9", "outer_diameter_m = 1"))
    assert "does not belong to this flight any more" in error_of(*places, *block)


def test_a_static_target_of_two_flights_is_one_point(
    two: tuple[SampleFlight, SampleFlight], tmp_path: Path
) -> None:
    code, place = "code_deg = [0, 43, 78, 180]", "position_m = [689500.0, 5336200.0, 547.0]"
    for flight in two:
        flight.edit((code, f"{code}\n{place}\nsd_position_m = [0.01, 0.01, 0.02]"))
    arguments = (two[0].path, two[1].path, "--out", tmp_path / "block", "--format", "micmac")
    line = error_of(*arguments)
    assert "have the same file name" in line  # not their ids
    result = export(*arguments[:-1], "csv")
    assert result.exit_code == 0, result.stderr
    points = pd.read_parquet(tmp_path / "block" / "kgcps.parquet")
    assert set(points["id"]) == {"A"}
    assert points["frame"].is_unique
    two[1].edit(("689500.0", "689501.0"))
    line = error_of(*arguments)
    assert f"static target 'A' has different positions in north/{FRAMES[0]} and south_bank/" in line


def test_flights_of_two_cameras_merge_in_formats_without_cameras(
    two: tuple[SampleFlight, SampleFlight], tmp_path: Path
) -> None:
    north, south = two
    places, block = (north.path, south.path), tmp_path / "block"
    toml = (south.path / "flight.toml").read_text(encoding="utf-8")
    (south.path / "flight.toml").write_text(toml.replace("fx = 1903.0", "fx = 1903.5"), "utf-8")
    assert south.run("detect", "--jobs", "0").exit_code == 0
    line = error_of(*places, "--out", block, "--format", "opensfm")
    assert "opensfm: holds one camera, and the flights have several; " in line
    result = export(*places, "--out", block, "--format", "metashape")
    assert result.exit_code == 0, result.stderr
    assert (block / "metashape" / "marks.csv").exists()
    assert not (block / "metashape" / "markers.xml").exists()


def test_formats_limited_to_one_camera_are_known(
    two: tuple[SampleFlight, SampleFlight], tmp_path: Path
) -> None:
    """Every format but those named writes the same, whatever the camera is."""
    from dataclasses import replace

    from kgcp.io.exporters.points import MapPoints
    from kgcp.io.exporters.write import export as export_points
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.export import make_gcps

    made = make_gcps(read_flight(two[0].path))
    camera = made.flight.camera
    other = replace(camera, width=camera.width + 8, height=camera.height + 8, fx=2 * camera.fx)
    for name in FORMATS:
        written = []
        for number, each in enumerate((camera, other)):
            points = MapPoints(made.crs, made.gcps, each, made.camera_priors, is_one_camera=False)
            files = export_points(points, name, tmp_path / str(number))
            written.append([path.read_bytes() for path in files])
        assert (written[0] != written[1]) == (name in OF_ONE_CAMERA), name
