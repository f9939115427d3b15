from __future__ import annotations

import tomllib
from datetime import date
from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.flight.toml_table import TomlTable
from kgcp.io.flight.vehicle_table import VehicleTable, read_vehicle
from kgcp.io.formats.trajectories.records import TrajectoryFileOptions, Wander

NEEDED = 'trajectory = "v.out"\nlever_arm_m = [1, 2, 3]\n'


def read(folder: Path, lines: str) -> VehicleTable | None:
    values = tomllib.loads(f"[vehicle]\n{NEEDED}{lines}")
    return read_vehicle(TomlTable("flight.toml:", values, ("vehicle",)), folder)


def test_without_keys_all_options_of_the_trajectory_have_defaults(tmp_path: Path) -> None:
    vehicle = read(tmp_path, "")
    assert vehicle is not None
    assert vehicle.trajectory_file == tmp_path / "v.out"
    assert vehicle.options == TrajectoryFileOptions()
    assert read_vehicle(TomlTable("flight.toml:", {}, ("vehicle",)), tmp_path) is None


@pytest.mark.parametrize("day", ['"2026-05-04"', "2026-05-04"])
def test_every_key_is_read_into_its_record(tmp_path: Path, day: str) -> None:
    vehicle = read(
        tmp_path,
        'format = "sbet"\ncrs = "EPSG:7912"\ntime_system = "gps"\naccuracies = "smrmsg.out"\n'
        f'wander = "subtract"\nattitude = "course"\nsd_attitude_deg = [2, 1.5, 3]\ndate = {day}\n',
    )
    assert vehicle is not None
    assert vehicle.options == TrajectoryFileOptions(
        format="sbet",
        crs="EPSG:7912",
        time_system=TimeSystem.GPS,
        first_day=date(2026, 5, 4),
        accuracies_file=tmp_path / "smrmsg.out",
        wander=Wander.SUBTRACT,
        course_sd_deg=(2.0, 1.5, 3.0),
    )


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('format = "SBET"', 'format: \'SBET\' is not known; give one of "sbet", "rtklib"'),
        ('time_system = "local"', 'give one of "gps", "utc"'),
        ('date = "4.5.2026"', "date: '4.5.2026' is not a date; give it as 2026-05-04"),
        ("date = 2026-05-04T09:30:00Z", "is not a date"),
        ("date = 20260504", "is not a date"),
        ('attitude = "course"', "sd_attitude_deg: is missing"),
        ("sd_attitude_deg = [2, 2, 3]", "attitude: is missing"),
        ('attitude = "level"\nsd_attitude_deg = [2, 2, 3]', "attitude: 'level' is not known"),
        ('attitude = "course"\nsd_attitude_deg = [2, -2, 3]', "is out of range"),
        ('trajectorie = "x"', "nearest known key is 'trajectory'"),
    ],
)
def test_a_wrong_value_is_named_by_its_key(tmp_path: Path, lines: str, words: str) -> None:
    with pytest.raises(KgcpError) as caught:
        read(tmp_path, lines)
    message = str(caught.value)
    assert message.startswith("flight.toml: [vehicle] ")
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize("line", ["", "lever_arm_m = 3", "lever_arm_m = [1, 2]"])
def test_the_error_of_a_wrong_lever_arm_names_its_axes(line: str) -> None:
    values = tomllib.loads(f'[vehicle]\ntrajectory = "v.out"\n{line}')
    with pytest.raises(KgcpError, match=r"lever_arm_m: .*; give .*\[forward, right, down\]"):
        read_vehicle(TomlTable("flight.toml:", values, ("vehicle",)), Path())
