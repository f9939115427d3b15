from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Response
from kgcp.io.flight.flight import read_flight

FLIGHT = """\
name = "odd angles"
crs = "EPSG:25831"

[frames]
folder = "pictures"
times = "times.csv"

[camera]
width = 1601
height = 1203
fx = 2300.0
fy = 2304
cx = 803.2
cy = 594.6
k1 = -0.06
k6 = 0.001
response = "linear"
readout_s = 0.01
sd_fx = 0.5
sd_fy = 0.25
sd_k6 = 2e-4
plumb_sd_deg = 8

[[target]]
name = "A"
outer_diameter_m = 0.9
inner_diameter_m = 0.45
code_diameter_m = 0.642857143
dot_diameter_m = 0.128571429
code_deg = [0, 43, 78, 180]
sd_outer_diameter_m = 0.0005

[[target]]
name = "A-inner"
replica_of = "A"
scale = 0.2
code_deg = [10, 80, 150, 250, 290]

[[target]]
name = "post"
outer_diameter_m = 0.5
inner_diameter_m = 0.2
code_diameter_m = 0.35
dot_diameter_m = 0.06
code_deg = [0, 90, 200]
position_m = [346937.1, 4582508.6, 122]
sd_position_m = [0.01, 0.01, 0.02]

[vehicle]
trajectory = "car.csv"
lever_arm_m = [-0.8, 0.15, -1.95]
sd_lever_arm_m = [0.005, 0.005, 0.005]
mount_deg = 12.5
sd_time_s = 0.001
time_offset_s = -0.25
level_sd_deg = 1.5

[reference]
poses = "aat.csv"
"""

DEVIATIONS = "sd_fx = 0.5\nsd_fy = 0.25\nsd_k6 = 2e-4"

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "times.csv").touch()

    def write_flight(text: str) -> Path:
        (tmp_path / "flight.toml").write_text(text, encoding="utf-8")
        return tmp_path

    return write_flight


def changed(old: str, new: str) -> str:
    assert FLIGHT.count(old) == 1
    return FLIGHT.replace(old, new)


def test_every_value_is_read_into_its_record(write: Write) -> None:
    folder = write(FLIGHT)
    flight = read_flight(folder)
    assert (flight.name, flight.crs, flight.toml_text) == ("odd angles", "EPSG:25831", FLIGHT)
    assert flight.frames_folder == folder / "pictures"
    assert flight.times_file == folder / "times.csv"
    assert flight.vehicle is not None
    assert flight.vehicle.trajectory_file == folder / "car.csv"
    assert flight.reference is not None
    assert flight.reference.file == folder / "aat.csv"
    camera = flight.camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (1601, 1203, 2300.0, 2304.0)
    assert (camera.cx, camera.cy) == (803.2, 594.6)
    assert (camera.k1, camera.k2, camera.k6) == (-0.06, 0.0, 0.001)
    assert (camera.response, camera.readout_s) == (Response.LINEAR, 0.01)
    assert flight.vehicle is not None
    assert flight.vehicle.settings.lever_arm_m == (-0.8, 0.15, -1.95)
    assert flight.vehicle.settings.mount_deg == 12.5
    assert flight.vehicle.settings.time_offset_s == -0.25
    assert (flight.plumb_sd_deg, flight.vehicle.settings.level_sd_deg) == (8.0, 1.5)
    assert flight.calibration_covariance is not None
    assert np.diag(flight.calibration_covariance.cov) == pytest.approx(
        [0.25, 0.0625, *[0] * 9, 4e-8]
    )


def test_a_covariance_of_the_calibration_is_a_list_row_by_row(write: Write) -> None:
    numbers = "[4, 1.5, 0, 1.5, 1, 0.5, 0, 0.5, 9]"
    text = changed(DEVIATIONS, f'cov_of = ["cy", "fx", "fy"]\ncov = {numbers}')
    covariance = read_flight(write(text)).calibration_covariance
    assert covariance is not None
    assert covariance.cov[:4, :4].tolist() == [
        [1.0, 0.5, 0.0, 1.5],
        [0.5, 9.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
        [1.5, 0.0, 0.0, 4.0],
    ]
    assert read_flight(write(changed(DEVIATIONS, ""))).calibration_covariance is None


def test_replicas_belong_to_their_plate(write: Write) -> None:
    plate, post = read_flight(write(FLIGHT)).targets
    (replica,) = plate.replicas
    assert (plate.name, replica.name, post.name) == ("A", "A-inner", "post")
    assert replica.outer_diameter_m == pytest.approx(0.18)
    assert replica.dot_diameter_m == pytest.approx(0.0257142858)
    assert replica.code_deg == (10.0, 80.0, 150.0, 250.0, 290.0)
    assert (plate.position_m, post.position_m) == (None, (346937.1, 4582508.6, 122.0))


def test_optional_keys_have_the_defaults_of_the_folder(tmp_path: Path, write: Write) -> None:
    camera_and_target = FLIGHT[FLIGHT.index("[camera]") : FLIGHT.index('[[target]]\nname = "post')]
    folder = write(camera_and_target.replace("plumb_sd_deg = 8\n", ""))
    (tmp_path / "frames").mkdir()
    flight = read_flight(folder)
    assert flight.name == tmp_path.name
    assert flight.frames_folder == tmp_path / "frames"
    assert flight.times_file is None
    assert (flight.crs, flight.vehicle, flight.reference) == (None, None, None)
    (tmp_path / "frames.csv").touch()
    assert read_flight(folder).times_file == tmp_path / "frames.csv"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        # unknown keys
        ("[reference]", "[referense]", "referense: is not a known key; .* 'reference'"),
        ("width = 1601", "widht = 1601", r"\[camera\] widht: is not a known key; .* 'width'"),
        ("mount_deg", "mount", r"\[vehicle\] mount: .* 'mount_deg'"),
        ("scale = 0.2", "scal = 0.2", r"\[\[target\]\] A-inner scal: .* 'scale'"),
        ('folder = "pictures"', 'folders = "x"', r"\[frames\] folders: .* 'folder'"),
        ("poses =", "pose =", r"\[reference\] pose: .* 'poses'"),
        # missing keys
        ("width = 1601\n", "", r"\[camera\] width: is missing; give .* whole number"),
        ("fy = 2304\n", "", r"\[camera\] fy: is missing; give .* number"),
        ('name = "A"\n', "", r"\[\[target\]\] 1 name: is missing"),
        ('trajectory = "car.csv"\n', "", r"\[vehicle\] trajectory: is missing"),
        ("\nlever_arm_m = [-0.8, 0.15, -1.95]", "", r"\[vehicle\] lever_arm_m: is missing"),
        # wrong types
        ("1601", "1601.5", r"\[camera\] width: is a number; give a whole number"),
        ("1601", "true", r"\[camera\] width: is a boolean; give a whole number"),
        ("fx = 2300.0", 'fx = "2300"', r"\[camera\] fx: is a text; give a number"),
        ("fx = 2300.0", "fx = true", r"\[camera\] fx: is a boolean; give a number"),
        ("fx = 2300.0", "fx = 1979-05-27", r"\[camera\] fx: is a date or time; give a number"),
        ("[0, 43, 78, 180]", "0", r"\[\[target\]\] A code_deg: is a number; give a list"),
        ("[0, 43, 78, 180]", '[0, "43"]', "A code_deg: is a text; give a number"),
        ("[0, 43, 78, 180]", "[]", "A code_deg: is empty; give the direction"),
        ('"odd angles"', "3", r"flight.toml: name: is a number; give a text"),
        ('"odd angles"', '" "', r"name: is empty"),
        ("[[target]]\nname = \"post\"", '[post]\nname = "post"', "post: is not a known key"),
        ("[-0.8, 0.15, -1.95]", "[1, 2]", "lever_arm_m: has 2 numbers instead of 3"),
        # numbers that are none
        ("fx = 2300.0", "fx = inf", "fx: inf is not a finite number"),
        ("fx = 2300.0", "fx = nan", "fx: nan is not a finite number"),
        ("fx = 2300.0", f"fx = 1{400 * '0'}", "fx: is not a finite number"),
        ("122]", "nan]", "post position_m: nan is not a finite number"),
        # impossible values
        ("fx = 2300.0", "fx = -1", r"fx: -1 px is out of range; give a value above 0"),
        ("cx = 803.2", "cx = 9e6", r"cx: 9e\+06 px is far outside"),
        ('"linear"', '"film"', 'response: \'film\' is not known; give one of "linear", "srgb"'),
        ("readout_s = 0.01", "readout_s = -5", "readout_s: -5 s is out of range"),
        ("readout_s = 0.01", "motion_sd_deg_s = 3", "has no effect without readout_s; add"),
        ('name = "A"\n', 'name = "A"\nshape = "Coded"\n', "A shape: 'Coded' is not known; give"),
        ("= 0.9\n", "= -0.9\n", r"A outer_diameter_m: -0.9 m is out of range"),
        ("= 0.45\n", "= 0.9\n", r"A inner_diameter_m: 0.9 m is not below"),
        ("0.128571429", "0.4", "A dot_diameter_m: .* leave the black ring; make"),
        ("[0, 43, 78, 180]", "[0, 10, 78]", "A code_deg: the dots at 0 and 10 deg overlap; leave"),
        ("scale = 0.2", "scale = 0.6", "A-inner scale: 0.6 is out of range"),
        ("sd_time_s = 0.001", "sd_time_s = -1", r"\[vehicle\] sd_time_s: -1 s is out of range"),
        ("0.01, 0.01, 0.02", "0, 0, -1", "post sd_position_m: is negative"),
        ("position_m = [346937.1, 4582508.6, 122]\n", "", "sd_position_m: needs position_m"),
        ("sd_fx = 0.5", "sd_fx = -0.5", r"\[camera\] sd_fx: -0.5 is out of range; give"),
        ("sd_fx = 0.5\nsd_fy = 0.25", "cov = [1]", r"\[camera\] sd_k6: is given beside cov"),
        (DEVIATIONS, "cov = [1]", r"\[camera\] cov_of: is missing; give"),
        (DEVIATIONS, 'cov_of = ["fx"]', r"\[camera\] cov: is missing; give"),
        (DEVIATIONS, "cov = [1]\ncov_of = [1]", "cov_of: is a number; give a"),
        (DEVIATIONS, 'cov = [1]\ncov_of = "fx"', "cov_of: is a text; give a"),
        (DEVIATIONS, 'cov = [1, 2]\ncov_of = ["fx", "fy"]', "cov: has 2 numbers for 2"),
        (DEVIATIONS, 'cov = [-1, 0, 0, 1]\ncov_of = ["fx", "fy"]', "cov: is not a covariance"),
        ("sd_fx = 0.5\n", "", r"\[camera\] sd_fx: is missing; state how well fx and fy are known"),
        ("sd_fy = 0.25\n", "", r"\[camera\] sd_fy: is missing; state"),
        (DEVIATIONS, "sd_cx = 0.5", r"\[camera\] sd_fx: is missing; state"),
        (DEVIATIONS, 'cov = [1]\ncov_of = ["fy"]', "cov_of: lacks fx or fy; state"),
        ("plumb_sd_deg = 8", "plumb_sd_deg = 80", r"\[camera\] plumb_sd_deg: 80 deg is out of"),
        ("level_sd_deg = 1.5", "level_sd_deg = 0", r"\[vehicle\] level_sd_deg: 0 deg is out of"),
        ("level_sd_deg = 1.5\n", "", r"plumb_sd_deg: needs \[vehicle\] level_sd_deg;"),
        # targets that do not go together
        ("[10, 80, 150, 250, 290]", "[30, 73, 108, 210]", "'A' and 'A-inner' are rotations"),
        ('name = "post"', 'name = "A"', "name: 'A' is the name of two targets"),
        ('replica_of = "A"', 'replica_of = "B"', "replica_of: 'B' is not .*; name one of A, post"),
        ('replica_of = "A"', 'replica_of = "A-inner"', "'A-inner' is not the name of a plate"),
        # files
        ('"pictures"', '"photos"', r"\[frames\] folder: 'photos' is not a folder; create"),
        ('"times.csv"', '"time.csv"', r"\[frames\] times: 'time.csv' does not exist; create"),
        ('"times.csv"', '"pictures"', r"times: 'pictures' is not a regular file; name a file"),
        # syntax
        ("[reference]", "[reference", r"is not TOML: .*line 58.*; correct that line"),
        ("fy = 2304\n", "fy = 2304\nfx = 1\n", "is not TOML: .*line 13"),
        ("fy = 2304\n", "fy = 2304,0\n", "is not TOML: line 12, .*; decimals take a point"),
        ("[reference]", "[vehicle]\n[reference]", r"line \d+: \[vehicle\] is given twice; put all"),
        ('"car.csv"', r'"data\car.csv"', "is not TOML: .*; write / instead of"),
    ],
)  # fmt: skip
def test_a_bad_value_is_a_one_line_error_with_file_key_and_remedy(
    write: Write, old: str, new: str, message: str
) -> None:
    folder = write(changed(old, new))
    with pytest.raises(KgcpError, match=message) as caught:
        read_flight(folder)
    text = str(caught.value)
    assert text.startswith(f"{folder / 'flight.toml'}: ")
    assert "\n" not in text
    assert ";" in text, "the remedy follows a semicolon"


def test_a_folder_is_no_calibration_file(write: Write) -> None:
    inline = FLIGHT[FLIGHT.index("[camera]") : FLIGHT.index("[[target]]")]
    folder = write(FLIGHT.replace(inline, '[camera]\nfile = "pictures"\n\n', 1))
    with pytest.raises(KgcpError, match=r"\[camera\] file: 'pictures' is not a regular file; name"):
        read_flight(folder)


def test_a_flight_needs_a_target(write: Write) -> None:
    without = FLIGHT[: FLIGHT.index("[[target]]")] + FLIGHT[FLIGHT.index("[vehicle]") :]
    with pytest.raises(KgcpError, match=r"target: is missing; write at least one .*\[\[target\]\]"):
        read_flight(write(without))
    with pytest.raises(KgcpError, match=r"target: is a table; give tables, each .*\[\[target\]\]"):
        read_flight(write(without + "[target]\nname = 'A'\n"))


def test_a_folder_without_flight_toml_is_refused_with_what_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(KgcpError, match=r"flight.toml: does not exist; name a flight folder"):
        read_flight(tmp_path)


def test_an_extension_that_notepad_added_is_named(tmp_path: Path) -> None:
    (tmp_path / "flight.toml.txt").touch()
    with pytest.raises(KgcpError, match=r"flight\.toml: does not exist; rename flight\.toml\.txt,"):
        read_flight(tmp_path)
    (tmp_path / "flight.toml").write_text('[frames]\ntimes = "times.csv"\n', encoding="utf-8")
    (tmp_path / "frames").mkdir()
    (tmp_path / "times.csv.txt").touch()
    with pytest.raises(KgcpError, match=r"'times\.csv' does not exist; rename times\.csv\.txt,"):
        read_flight(tmp_path)


def test_a_file_is_no_flight_folder(write: Write) -> None:
    path = write(FLIGHT) / "flight.toml"
    with pytest.raises(KgcpError, match=r"flight.toml: is a file; name the flight folder"):
        read_flight(path)


def test_other_encodings_are_refused_and_a_byte_order_mark_is_not(write: Write) -> None:
    folder = write("\ufeff" + FLIGHT)
    assert read_flight(folder).toml_text == FLIGHT
    (folder / "flight.toml").write_bytes('name = "Füße"'.encode("latin-1"))
    with pytest.raises(KgcpError, match="not UTF-8"):
        read_flight(folder)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(
    fx=st.floats(1.0, 1e6),
    k1=st.floats(-10.0, 10.0),
    lever_m=st.tuples(*[st.floats(-100.0, 100.0)] * 3),
    start_deg=st.floats(0.0, 100.0),
    gaps_deg=st.lists(st.floats(24.0, 60.0), min_size=1, max_size=3),
)
def test_numbers_are_read_back_as_they_were_written(
    write: Write,
    fx: float,
    k1: float,
    lever_m: tuple[float, float, float],
    start_deg: float,
    gaps_deg: list[float],
) -> None:
    code = [start_deg]
    for gap in gaps_deg:
        code.append(code[-1] + gap)
    text = (
        FLIGHT.replace("fx = 2300.0", f"fx = {fx!r}")
        .replace("k1 = -0.06", f"k1 = {k1!r}")
        .replace("[-0.8, 0.15, -1.95]", str(list(lever_m)))
        .replace("[0, 43, 78, 180]", str(code))
    )
    flight = read_flight(write(text))
    assert flight.vehicle is not None
    assert (flight.camera.fx, flight.camera.k1) == (fx, k1)
    assert flight.vehicle.settings.lever_arm_m == lever_m
    assert flight.targets[0].ring.code_deg == tuple(code)
