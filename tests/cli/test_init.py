"""`kgcp init`: what it makes of folders as they come from card and rover, read back."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image
from PIL.ExifTags import IFD, Base

from benchmarks.first_flight.bare_folders import (
    LEVER_ARM,
    plan,
    write_dji_folder,
    write_sbet_folder,
    write_static_folder,
)
from kgcp.cli import main
from kgcp.cli.init import quoted
from kgcp.errors import KgcpWarning
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.io.flight.camera_file import camera_toml
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight, read_flight
from kgcp.io.flight.folder import survey_folder
from kgcp.io.images.exif import read_frame_header
from kgcp.io.images.frames import list_frames
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.simulation.flight import FlightPlan
from tests.systems import not_on_windows

PLAN = plan(3, seed=1)
TARGET = ("--diameter", "0.9", "--code", "0,43,78,180")
PLACE: dict[int, object] = {1: "N", 2: (48, 8, 0.0), 3: "E", 4: (11, 33, 0.0)}  # by EXIF
ARM = ("--lever-arm", *map(str, LEVER_ARM))
TARGETS_TOML = """
[[target]]
name = "A"
outer_diameter_m = 0.9
inner_diameter_m = 0.45
code_diameter_m = 0.642857
dot_diameter_m = 0.128571
code_deg = [0, 43, 78, 180]

[[target]]
name = "A-inner"
replica_of = "A"
scale = 0.2
code_deg = [10, 80, 150, 250, 290]
"""


def blank(flight: FlightPlan, _index: int) -> GreyArray:
    camera = flight.settings.camera
    return np.full((camera.height, camera.width), 90, dtype=np.uint8)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of every kind, with blank frames; nobody changes it."""
    root = tmp_path_factory.mktemp("bare")
    write_dji_folder(root / "dji", PLAN, render=blank)
    write_sbet_folder(root / "sbet", PLAN, render=blank)
    write_static_folder(root / "static", PLAN, render=blank)
    return root


def copied(bare: Path, kind: str, to: Path) -> Path:
    return shutil.copytree(bare / kind, to / kind)


def init(folder: Path, *options: str) -> Result:
    return CliRunner().invoke(main, ["init", str(folder), *options], catch_exceptions=False)


def made(folder: Path, *options: str) -> tuple[Flight, FlightData, str]:
    """The flight that init has made, what it names, and what init has said."""
    result = init(folder, *options)
    assert result.exit_code == 0, result.stderr
    flight = read_flight(folder)
    data = FlightData(flight, list_frames(flight.frames_folder))
    return flight, data, " ".join(result.stderr.split())


def uncomment(folder: Path, key: str, value: str | None = None) -> None:
    """Fill in one line, as a user does; without a value, with its example."""
    path = folder / "flight.toml"
    lines = path.read_text(encoding="utf-8").splitlines()
    (row,) = [row for row, line in enumerate(lines) if line.startswith(f"# {key} = ")]
    lines[row] = lines[row].removeprefix("# ") if value is None else f"{key} = {value}"
    path.write_text("\n".join(lines), encoding="utf-8")


def place_errors_m(data: FlightData) -> float:
    """Largest distance of the trajectory's points from those of the plan."""
    trajectory = data.trajectory
    assert trajectory is not None
    gaps = trajectory.position_map - PLAN.trajectory.position_map
    return float(np.abs(gaps).max())


def test_a_dji_folder_with_marks_and_a_rtklib_solution(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    (folder / "targets").mkdir()
    (folder / "targets" / "targets.toml").write_text(TARGETS_TOML, encoding="utf-8")
    flight, data, said = made(folder, *ARM)
    camera = PLAN.settings.camera
    assert (flight.camera.width, flight.camera.height) == (camera.width, camera.height)
    for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"):
        assert getattr(flight.camera, name) == pytest.approx(getattr(camera, name), abs=1e-6)
    assert not flight.is_camera_guessed
    assert [ring.name for ring in flight.targets[0].rings] == ["A", "A-inner"]
    times = data.frame_times.time_s
    expected = PLAN.recorded_times_s.tolist()
    assert [times[name] for name in sorted(times)] == pytest.approx(expected, abs=2e-6)
    assert flight.crs == "EPSG:32632"
    assert 0.0 < place_errors_m(data) < 3e-4  # 0.1 mm each by the file and by the other ellipsoid
    assert flight.vehicle is not None
    assert flight.vehicle.options.course_sd_deg == (2.0, 2.0, 3.0)
    assert flight.vehicle.settings.lever_arm_m == LEVER_ARM
    for words in ("from the DewarpData of DJI_", "Timestamp.MRK", "rover.pos: RTKLIB", "A (0.9 m)"):
        assert words in said
    assert "missing" not in said


def test_the_same_folder_gives_the_same_bytes(bare: Path, tmp_path: Path) -> None:
    texts = []
    for name in ("one", "two"):
        folder = copied(bare, "dji", tmp_path / name)
        assert init(folder).exit_code == 0
        texts.append((folder / "flight.toml").read_bytes())
    assert texts[0] == texts[1]
    assert b"\r" not in texts[0]


def test_what_is_missing_is_named_by_init_and_by_the_next_command(
    bare: Path, tmp_path: Path
) -> None:
    folder = copied(bare, "dji", tmp_path)
    said = init(folder).stderr
    assert "missing: lever arm" in said
    assert "missing: targets" in said
    assert f"next: fill in what is MISSING there, then kgcp check {folder}" in said
    fails = [("lever_arm_m", None), ("[[target]]", TARGETS_TOML)]
    for key, text in fails:
        result = CliRunner().invoke(main, ["check", str(folder)])
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1
        assert key in result.stderr
        if text is None:
            uncomment(folder, "lever_arm_m")
        else:
            with (folder / "flight.toml").open("a", encoding="utf-8") as stream:
                stream.write(text)
    assert CliRunner().invoke(main, ["check", str(folder)]).exit_code == 0


def test_frames_named_by_time_with_calibration_and_sbet(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "sbet", tmp_path)
    flight, data, said = made(folder, *TARGET, *ARM)
    assert flight.frames_folder == folder / "cam0"
    assert flight.camera.k2 == PLAN.settings.camera.k2
    times = data.frame_times.time_s
    assert sorted(times.values()) == pytest.approx(PLAN.recorded_times_s.tolist(), abs=1e-6)
    assert flight.vehicle is not None
    assert 0.0 < place_errors_m(data) < 2e-4  # 0.1 mm by the other ellipsoid
    trajectory = data.trajectory
    assert trajectory is not None
    assert trajectory.time_s == pytest.approx(PLAN.trajectory.time_s, abs=1e-6)
    assert trajectory.sd_attitude_deg is not None
    assert trajectory.attitude_deg == pytest.approx(PLAN.trajectory.attitude_deg, abs=1e-9)
    assert "from the frames' names, as frames.csv" in said
    assert "assumed: trajectory its times are GPS time" in said


def test_a_camera_of_kgcp_calibrate_is_taken_with_its_covariance(
    bare: Path, tmp_path: Path
) -> None:
    folder = copied(bare, "static", tmp_path)
    camera = PLAN.settings.camera
    covariance = CalibrationCovariance.of(("fx", "fy"), np.array([[4.0, 3.0], [3.0, 4.0]]))
    (folder / "camera.toml").write_text(camera_toml(camera, covariance), encoding="utf-8")
    matrix = f"{camera.fx} {camera.fy} {camera.cx + 0.5} {camera.cy + 0.5}"
    (folder / "a.txt").write_text(f"1 PINHOLE {camera.width} {camera.height} {matrix}\n")
    flight, _, said = made(folder, *TARGET)
    assert flight.camera.k1 == camera.k1
    assert flight.calibration_covariance is not None
    assert flight.calibration_covariance.cov == pytest.approx(covariance.cov)
    assert "from camera.toml (not used: a.txt)" in said


def test_calibrations_of_another_size_are_named(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "static", tmp_path)
    camera = replace(PLAN.settings.camera, width=700, height=500, cx=350.0, cy=250.0)
    (folder / "camera.toml").write_text(camera_toml(camera, None), encoding="utf-8")
    (folder / "a.txt").write_text("1 PINHOLE 700 500 900 900 350 250\n", encoding="utf-8")
    flight, _, said = made(folder, *TARGET)
    assert flight.is_camera_guessed
    said = " ".join(said.split())
    for name in ("a.txt", "camera.toml"):
        assert f"{name} is not used: it is for 700 x 500 px, but the frames have" in said


def test_the_calibration_of_the_frames_zoom_is_taken(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "static", tmp_path)
    first = list_frames(folder)[0]
    focal_35_mm = read_frame_header(folder / first, first).focal_35_mm
    assert focal_35_mm is not None
    camera = PLAN.settings.camera
    for name, factor in (("a", 2.0), ("b", 1.0)):
        text = camera_toml(
            replace(camera, k1=factor), None, ExifCamera("", None, factor * focal_35_mm)
        )
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    flight, _, said = made(folder, *TARGET)
    assert flight.camera.k1 == 1.0
    assert "from b.toml (not used: a.toml)" in said


@pytest.mark.parametrize("height", ["Höhe", "U"])
def test_exif_alone_gives_a_guess_that_check_keeps_naming(
    bare: Path, tmp_path: Path, height: str
) -> None:
    folder = copied(bare, "static", tmp_path)
    rows = f"Punkt;Rechtswert;Hochwert;{height}\nT1;689432,0;5336173,0;545,6\n"
    (folder / "points.csv").write_text(rows, encoding="utf-8")
    flight, _, said = made(folder, *TARGET)
    assert flight.is_camera_guessed
    assert 0.97 < flight.camera.fx / PLAN.settings.camera.fx < 1.03
    assert flight.calibration_covariance is not None
    assert flight.targets[0].position_m == (689432.0, 5336173.0, 545.6)
    assert flight.vehicle is None
    assert "it may be EPSG:25832 or EPSG:" in said
    uncomment(folder, "crs")
    check = CliRunner().invoke(main, ["check", str(folder)])
    assert check.exit_code == 0, check.output
    assert "doubt: the camera is a guess from EXIF" in check.stdout
    text = (folder / "flight.toml").read_text(encoding="utf-8")
    (folder / "flight.toml").write_text(text.replace("guessed = true", ""), encoding="utf-8")
    assert "guess" not in CliRunner().invoke(main, ["check", str(folder)]).stdout


def test_surveyed_points_may_be_named_p_but_have_one_place(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "static", tmp_path)
    row = "T1,689432.0,5336173.0,545.6\n"
    (folder / "points.csv").write_text("P,E,N,H\n" + 2 * row, encoding="utf-8")
    flight, _, _ = made(folder, *TARGET)
    assert flight.targets[0].position_m == (689432.0, 5336173.0, 545.6)
    other = row.replace("432.0", "432.4")
    for name, text in (("points.csv", row + other), ("again.csv", other)):
        (folder / "flight.toml").unlink()
        (folder / "points.csv").write_text("P,E,N,H\n" + row, encoding="utf-8")
        (folder / name).write_text("P,E,N,H\n" + text, encoding="utf-8")
        result = CliRunner().invoke(main, ["init", str(folder), *TARGET])
        assert result.exit_code == 1
        assert "the point 'T1' has two places: " in result.stderr
        assert "689432.4, 5336173, 545.6" in result.stderr
        (folder / "flight.toml").touch()


def test_surveyed_points_with_other_names_are_said_not_to_be_used(
    bare: Path, tmp_path: Path
) -> None:
    folder = copied(bare, "static", tmp_path)
    rows = "".join(f"t{n},689432.0,5336173.0,545.6\n" for n in range(1, 7))
    (folder / "points.csv").write_text(f"name,x,y,z\n{rows}", encoding="utf-8")
    flight, _, said = made(folder, *TARGET)
    assert flight.targets[0].position_m is None
    assert "points.csv: no target has its names, t1, t2, t3, t4 …" in " ".join(said.split())


def csv_rows(separator: str, decimal: str, kind: str) -> str:
    """The plan's trajectory as tables of other programs."""
    trajectory = PLAN.trajectory
    heads = {
        "grid": ["UTC-Time", "Easting [m]", "Northing [m]", "Ell. Height [m]", "Sats"],
        "attitude": ["GPS TOW (s)", "E", "N", "H", "Roll (deg)", "Pitch (deg)", "Yaw (deg)", "Q"],
    }
    lines = [separator.join(heads[kind])]
    for time_s, place, angles in zip(
        trajectory.time_s.tolist(),
        trajectory.position_map.tolist(),
        trajectory.attitude_deg.tolist(),
        strict=True,
    ):
        moment = datetime.fromtimestamp(time_s, UTC)
        clock = f"{moment:%Y-%m-%dT%H:%M:%S.%f}"
        if kind == "attitude":
            clock = f"{(time_s + 18.0 - 315964800.0) % 604800.0:.3f}"
        cells = [f"{value:.5f}" for value in (*place, *(angles if kind == "attitude" else ()))]
        row = [clock, *(cell.replace(".", decimal) for cell in cells), "12"]
        row[0] = row[0].replace(".", decimal) if kind == "attitude" else row[0]
        lines.append(separator.join(row))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("separator", "decimal", "kind"),
    [(";", ",", "grid"), ("\t", ".", "attitude"), (";", ",", "attitude"), (",", ".", "grid")],
)
def test_foreign_tables_are_recognised_shown_and_readable(
    bare: Path, tmp_path: Path, separator: str, decimal: str, kind: str
) -> None:
    folder = copied(bare, "dji", tmp_path)
    (folder / "rover.pos").unlink()
    (folder / "track.csv").write_text(csv_rows(separator, decimal, kind), encoding="utf-8")
    flight, data, said = made(folder, *TARGET, *ARM, "--crs", "EPSG:25832")
    assert place_errors_m(data) < 1e-5
    trajectory = data.trajectory
    assert trajectory is not None
    assert trajectory.time_s == pytest.approx(PLAN.trajectory.time_s, abs=1e-3)
    assert flight.vehicle is not None
    layout = flight.vehicle.options.layout
    assert (layout.separator, layout.decimal) == (separator, decimal)
    assert "not used: " in said
    if kind == "attitude":
        assert trajectory.attitude_deg == pytest.approx(PLAN.trajectory.attitude_deg, abs=1e-5)
        assert "heading_deg = 'Yaw (deg)'" in said
        assert flight.vehicle.options.time_system == "gps"
    else:
        assert "x = 'Easting [m]'" in said
        assert flight.vehicle.options.course_sd_deg is not None
        assert flight.vehicle.options.time_system == "utc"


def with_track(bare: Path, tmp_path: Path, head: str, ahead_s: float = 0.0) -> Path:
    """A folder whose only trajectory is a table of time and place, with a clock that is ahead."""
    folder = copied(bare, "dji", tmp_path)
    (folder / "rover.pos").unlink()
    track = PLAN.trajectory
    rows = [
        f"{time_s + ahead_s:.6f},{x},{y},{z}"
        for time_s, (x, y, z) in zip(
            track.time_s.tolist(), track.position_map.tolist(), strict=True
        )
    ]
    (folder / "track.csv").write_text("\n".join((head, *rows)), encoding="utf-8")
    return folder


def test_seconds_in_a_column_of_gps_time_are_assumed_to_be_gps_time(
    bare: Path, tmp_path: Path
) -> None:
    folder = with_track(bare, tmp_path, "gps_time,E,N,H", ahead_s=18.0)
    _, data, said = made(folder, *TARGET, *ARM, "--crs", "EPSG:25832")
    assert data.trajectory is not None
    assert data.trajectory.time_s == pytest.approx(PLAN.trajectory.time_s, abs=1e-3)
    assert "assumed: trajectory its times are GPS time, 18 s ahead of UTC" in said
    assert 'or write time_system = "utc"' in said


@pytest.mark.parametrize(
    ("head", "cells", "words"),
    [
        ("Datum;Uhrzeit", "2026-06-16;08:15:00.5", "'2026-06-16' is a date without a time of day"),
        ("Datum;Uhrzeit", "16.06.2026;08:15:00", "'16.06.2026' is a date without a time of day"),
        ("Date;Time", "2026-06-16;08:15:00.5", "'08:15:00.5' is a time of day without a date"),
    ],
)
def test_date_and_time_in_two_columns_are_to_be_joined(
    bare: Path, tmp_path: Path, head: str, cells: str, words: str
) -> None:
    folder = copied(bare, "dji", tmp_path)
    (folder / "rover.pos").unlink()
    rows = f"{head};E;N;H\n{cells};689432.0;5336173.0;545.6\n"
    (folder / "track.csv").write_text(rows, encoding="utf-8")
    said = " ".join(init(folder, *TARGET, *ARM, "--crs", "EPSG:25832").stderr.split())
    assert f"{words}: date and time seem to stand in two columns" in said
    assert "join date and time in one column, as 2026-05-04T09:30:05.25Z" in said
    assert "time_system" not in said


def test_east_north_up_are_a_place(bare: Path, tmp_path: Path) -> None:
    folder = with_track(bare, tmp_path, "time,E,N,U")
    _, data, said = made(folder, *TARGET, *ARM, "--crs", "EPSG:25832")
    assert place_errors_m(data) < 1e-5
    assert "z = 'U'" in said


def test_files_that_are_not_recognised_are_named(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    notes = folder / "notes.txt"
    notes.write_text("Sunny, little wind\n", encoding="utf-8")
    assert "not recognised" not in init(folder, *TARGET, *ARM).stderr
    (folder / "flight.toml").unlink()
    (folder / "rover.pos").unlink()
    (folder / "track.csv").write_text("time,E(ft),N(ft),U(ft)\n1,2,3,4\n", encoding="utf-8")
    said = " ".join(init(folder, *TARGET, *ARM).stderr.split())
    assert "not recognised notes.txt, track.csv; a table is recognised as a trajectory if " in said
    assert "nothing says where T1 is: no trajectory is recognised, and no table" in said


def test_longitude_and_latitude_in_a_table(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    (folder / "rover.pos").unlink()
    rows = ["time,lat,lon,alt"]
    rows += [
        f"{time_s:.3f},48.15,{11.54 + 1e-6 * row},545"
        for row, time_s in enumerate(PLAN.trajectory.time_s.tolist())
    ]
    (folder / "track.csv").write_text("\n".join(rows), encoding="utf-8")
    flight, data, _ = made(folder, *TARGET, *ARM)
    assert flight.crs == "EPSG:32632"
    assert data.trajectory is not None
    assert data.trajectory.position_map[0] == pytest.approx([688947.0, 5336084.0, 545.0], abs=600)


def test_an_existing_flight_toml_is_never_replaced(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    (folder / "flight.toml").write_text("mine", encoding="utf-8")
    result = init(folder)
    assert result.exit_code == 1
    assert "flight.toml: exists and is not replaced; " in result.stderr
    assert (folder / "flight.toml").read_text(encoding="utf-8") == "mine"


def test_several_trajectories_are_named_and_none_is_taken(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    shutil.copy(folder / "rover.pos", folder / "base.pos")
    result = init(folder, "--json")
    page = json.loads(result.stdout)
    (gap,) = [gap for gap in page["missing"] if gap["heading"] == "trajectory"]
    assert "base.pos, rover.pos" in gap["text"]
    assert {"heading", "text"} == page["found"][0].keys()


def test_folders_without_frames_and_wrong_options(bare: Path, tmp_path: Path) -> None:
    result = init(tmp_path)
    assert result.exit_code == 1
    assert "holds no images" in result.stderr
    assert "is not a folder" in init(tmp_path / "nowhere").stderr
    folder = copied(bare, "dji", tmp_path)
    assert init(folder, "--diameter", "0.9").exit_code == 2
    assert init(folder, "--target", "x.toml", *TARGET).exit_code == 2
    assert "does not exist" in init(folder, "--target", str(tmp_path / "x.toml")).stderr
    assert "crs 'EPSG:1' cannot be used" in init(folder, "--crs", "EPSG:1").stderr
    assert not (folder / "flight.toml").exists()


def test_a_trajectory_that_cannot_be_read_is_named(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    path = folder / "rover.pos"
    lines = path.read_text(encoding="ascii").splitlines()
    path.write_text("\n".join([*lines[:5], "2026/06/16 08:15:20 48.1"]), encoding="ascii")
    said = init(folder, *TARGET, *ARM).stderr
    assert "rover.pos cannot be read" in said
    assert "missing: crs" in said
    uncomment(folder, "crs")
    check = CliRunner().invoke(main, ["check", str(folder)])
    assert check.exit_code == 1
    assert "line 6: has 1 cells after the time" in " ".join(check.stdout.split())


def test_files_of_a_flight_within_the_folder_are_not_surveyed(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    before = survey_folder(folder)
    inner = shutil.copytree(folder, folder / "second")
    (inner / "flight.toml").touch()
    with pytest.warns(KgcpWarning, match="in second, which is another flight"):
        assert survey_folder(folder) == before


def test_results_in_the_frames_own_folder_are_no_frames(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    made(folder, *TARGET, *ARM)
    before = list_frames(folder)
    (folder / "kgcp" / "sheet").mkdir(parents=True)
    shutil.copy(folder / before[0], folder / "kgcp" / "sheet" / "x.jpg")
    assert list_frames(folder) == before
    (folder / "flight.toml").unlink()
    assert "kgcp/sheet/x.jpg" in list_frames(folder)


@not_on_windows("forbids such names")
def test_names_of_files_are_no_lines_of_the_file(bare: Path, tmp_path: Path) -> None:
    folder = copied(bare, "dji", tmp_path)
    first = min(folder.glob("*.JPG"))
    first.rename(folder / 'DJI\n[vehicle]\x1b]0;#"_0001_V.JPG')
    result = init(folder, *TARGET, *ARM)
    assert "\x1b" not in result.stderr
    text = (folder / "flight.toml").read_text(encoding="utf-8")
    assert text.count("\n[vehicle]") == 1
    assert "\x1b" not in text
    assert read_flight(folder).camera.fx == pytest.approx(PLAN.settings.camera.fx)


@pytest.mark.parametrize("folder", ["north & south", "a&b", "flight(2)"])
def test_folders_are_quoted_where_shells_need_it(folder: str) -> None:
    assert quoted(Path(folder)) == f'"{folder}"'
    plain = str(Path("/flights/Höhe_7.1~a"))
    assert quoted(Path(plain)) == plain


@pytest.mark.parametrize(
    ("subsec", "zoned", "lines"),
    [
        ("25", 3, ("assumed: times", "rarely good to a millisecond", "from EXIF (3 frames)")),
        ("", 3, ("assumed: times", "in whole seconds", "from EXIF (3 frames)")),
        (
            "25",
            2,
            ("missing: times", "no time with a zone in 1 of 3 frames", "from EXIF (2 of 3 frames)"),
        ),
    ],
)
def test_exif_times_that_are_coarse_or_missing_are_named(
    tmp_path: Path, subsec: str, zoned: int, lines: tuple[str, ...]
) -> None:
    (tmp_path / "frames").mkdir()
    for number in range(3):
        exif = Image.Exif()
        tags = exif.get_ifd(IFD.Exif)
        tags[Base.DateTimeOriginal] = f"2026:05:04 11:30:0{number}"
        tags[Base.SubsecTimeOriginal] = subsec
        if number < zoned:
            tags[Base.OffsetTimeOriginal] = "+02:00"
        Image.new("L", (64, 48)).save(tmp_path / "frames" / f"{number}.jpg", exif=exif)
    header = "time,x,y,z,roll_deg,pitch_deg,heading_deg"
    rows = [f"2026-05-04T09:30:0{second}Z,689000,5336000,545,0,0,0" for second in range(5)]
    (tmp_path / "vehicle.csv").write_text("\n".join([header, *rows]))
    text = " ".join(init(tmp_path, "--crs", "EPSG:25832", *TARGET).stderr.split())
    for line in lines:
        assert line in text


@pytest.mark.parametrize(
    ("place", "file", "text", "crs", "said"),
    [
        (PLACE, "points.csv", "name,x,y,z\nA,11.551,48.134,545", "EPSG:4979", "is near the place"),
        (
            PLACE,
            "points.csv",
            "name,x,y,z\nA,1285740,6129060,545",
            "EPSG:3857",
            "is near the place",
        ),
        (PLACE, "points.csv", "name,x,y,z\nA,10.5,22.25,1.2", None, "in no CRS of EPSG"),
        ({}, "points.csv", "name,x,y,z\nA,10.5,22.25,1.2", None, "points.csv does not say"),
        ({}, "points.csv", "name,Lon,Lat,h\nA,11.551,48.134,545", "EPSG:4979", "in points.csv"),
        ({}, "track.csv", "time,x,y,z\n1760000000,10.5,22.25,1", None, "track.csv does not say"),
        ({}, "track.csv", "time,e,n,h\n1760000000,10.5,22.25,1", None, "track.csv does not say"),
    ],
)
def test_small_numbers_are_degrees_only_if_named_so_or_near_the_frames(
    tmp_path: Path, place: dict[int, object], file: str, text: str, crs: str | None, said: str
) -> None:
    exif = Image.Exif()
    exif.get_ifd(IFD.GPSInfo).update(place)
    Image.new("L", (64, 48)).save(tmp_path / "0.jpg", exif=exif)
    (tmp_path / "targets.toml").write_text(TARGETS_TOML, encoding="utf-8")
    (tmp_path / file).write_text(f"{text}\n", encoding="utf-8")
    assert said in " ".join(init(tmp_path).stderr.split())
    made = tomllib.loads((tmp_path / "flight.toml").read_text(encoding="utf-8"))
    assert (made.get("crs"), made.get("vehicle", {}).get("crs")) == (crs, None)


def test_poses_of_the_camera_are_taken_from_the_only_file_that_has_them(tmp_path: Path) -> None:
    Image.new("L", (64, 48)).save(tmp_path / "0.jpg")
    poses = "frame,x,y,z,omega_deg,phi_deg,kappa_deg\n0.jpg,689000,5336000,600,0,0,0\n"
    (tmp_path / "reference.csv").write_text(poses, encoding="utf-8")
    assert "reference poses of the camera, from reference.csv" in (
        " ".join(init(tmp_path).stderr.split())
    )
    (tmp_path / "flight.toml").unlink()
    (tmp_path / "second.csv").write_text(poses, encoding="utf-8")
    said = " ".join(init(tmp_path).stderr.split())
    assert "several files have poses of the camera: reference.csv, second.csv" in said
    made = tomllib.loads((tmp_path / "flight.toml").read_text(encoding="utf-8"))
    assert "reference" not in made
