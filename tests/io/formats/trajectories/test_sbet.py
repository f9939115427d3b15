from __future__ import annotations

import struct
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories import read_trajectory, sbet
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFileOptions, Wander

SATURDAY = TrajectoryFileOptions(time_system=TimeSystem.GPS, first_day=date(2026, 5, 9))
SUNDAY_S = datetime(2026, 5, 10, tzinfo=UTC).timestamp()


def read_sbet(path: Path, options: TrajectoryFileOptions) -> Epochs:
    return sbet.read(ForeignFile(path, "[vehicle] trajectory"), options, "EPSG:4979")


def record(
    seconds: float,
    latitude: float = 0.7226,
    longitude: float = 0.0379,
    attitude: tuple[float, float, float] = (0.01, -0.02, 1.5),
    wander: float = 0.0,
) -> bytes:
    """17 little-endian doubles; velocities, accelerations and rates are of no interest."""
    tail = (-0.1, 0.2, -9.8, 0.001, 0.002, 0.003)
    position = (latitude, longitude, 123.456)
    return struct.pack("<17d", seconds, *position, 10.0, 0.5, -0.1, *attitude, wander, *tail)


def write(folder: Path, *records: bytes, name: str = "sbet.out") -> Path:
    path = folder / name
    path.write_bytes(b"".join(records))
    return path


def test_a_literal_sample_over_saturday_midnight(tmp_path: Path) -> None:
    path = write(tmp_path, record(604799.5), record(0.0, longitude=-0.0379), record(0.5))
    epochs = read_sbet(path, SATURDAY)
    assert_allclose(epochs.time_s, SUNDAY_S - 18.0 + np.array([-0.5, 0.0, 0.5]), atol=1e-6)
    assert epochs.crs == "EPSG:4979"
    # degrees, longitude first
    longitude, latitude = 0.0379 * 180.0 / np.pi, 0.7226 * 180.0 / np.pi
    assert_allclose(epochs.position[0], [longitude, latitude, 123.456], rtol=1e-15)
    assert epochs.position[1, 0] < 0.0
    assert epochs.attitude_deg is not None
    assert_allclose(epochs.attitude_deg[0], np.degrees([0.01, -0.02, 1.5]), rtol=1e-15)
    assert epochs.sd_position_m is None


def test_utc_needs_no_leap_seconds(tmp_path: Path) -> None:
    path = write(tmp_path, record(604799.5), record(604800.0), record(604800.5))
    options = TrajectoryFileOptions(time_system=TimeSystem.UTC, first_day=date(2026, 5, 9))
    times = read_sbet(path, options).time_s
    assert_allclose(times, SUNDAY_S + np.array([-0.5, 0.0, 0.5]), atol=1e-6)


@pytest.mark.parametrize(
    ("notation", "words"),
    [
        (TrajectoryFileOptions(), ("give date and time_system under [vehicle]", '"gps" or "utc"')),
        (TrajectoryFileOptions(time_system=TimeSystem.GPS), ("give date under [vehicle]",)),
        (TrajectoryFileOptions(first_day=date(2026, 5, 9)), ("give time_system under [vehicle]",)),
        (
            TrajectoryFileOptions(time_system=TimeSystem.GPS, first_day=date(2026, 5, 10)),
            ("on a Saturday", "2026-05-10 is a Sunday", "[vehicle] date"),
        ),
    ],
)
def test_information_that_sbet_lacks_has_to_be_stated(
    tmp_path: Path, notation: TrajectoryFileOptions, words: tuple[str, ...]
) -> None:
    path = write(tmp_path, record(604799.5), record(0.0))
    with pytest.raises(KgcpError) as caught:
        read_trajectory(path, "EPSG:25831", notation)  # recognised by its content
    for word in ("sbet.out", *words):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("wander", "heading"),
    [(Wander.IGNORE, 0.3), (Wander.SUBTRACT, 0.3 - 0.4 + 2.0 * np.pi), (Wander.ADD, 0.7)],
)
def test_the_meaning_of_the_wander_angle_has_to_be_stated(
    tmp_path: Path, wander: Wander, heading: float
) -> None:
    attitude = (0.0, 0.0, 0.3)
    rows = [record(time, attitude=attitude, wander=0.4) for time in (604799.0, 604799.1)]
    path = write(tmp_path, *rows)
    with pytest.raises(KgcpError, match=r"wander angles up to 22\.9183 deg.*\"subtract\""):
        read_sbet(path, SATURDAY)
    options = TrajectoryFileOptions(
        time_system=TimeSystem.GPS, first_day=date(2026, 5, 9), wander=wander
    )
    epochs = read_sbet(path, options)
    assert epochs.attitude_deg is not None
    assert_allclose(epochs.attitude_deg[:, 2], np.degrees(heading), rtol=1e-12)


def _with_accuracies(path: Path) -> TrajectoryFileOptions:
    return TrajectoryFileOptions(
        time_system=TimeSystem.GPS, first_day=date(2026, 5, 9), accuracies_file=path
    )


def accuracy(seconds: float, factor: float = 1.0) -> bytes:
    sds = (0.01, 0.02, 0.03, 9.0, 9.0, 9.0, 0.6, 1.2, 3.0)  # north, east, down; arc minutes
    return struct.pack("<10d", seconds, *(factor * sd for sd in sds))


def test_accuracies_are_interpolated_also_over_the_week_s_end(tmp_path: Path) -> None:
    path = write(tmp_path, *(record(time) for time in (604799.5, 604799.75, 0.25)))
    smrmsg = write(tmp_path, accuracy(604799.5), accuracy(0.5, 3.0), name="smrmsg.out")
    epochs = read_sbet(path, _with_accuracies(smrmsg))
    factors = np.array([1.0, 1.5, 2.5])[:, None]
    assert epochs.sd_position_m is not None
    assert epochs.sd_attitude_deg is not None
    assert_allclose(epochs.sd_position_m, factors * [0.02, 0.01, 0.03], rtol=1e-9)
    assert_allclose(epochs.sd_attitude_deg, factors * [0.01, 0.02, 0.05], rtol=1e-9)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (accuracy(0.0) + accuracy(1.0), "covers the seconds 0 to 1, the trajectory 604799"),
        (accuracy(604799.0)[:-8], "has 72 bytes, not a multiple of 80 bytes"),
        (accuracy(604799.0) * 2, "times do not ascend"),
        (accuracy(604799.0, -1.0) + accuracy(604799.5), "negative or not finite"),
    ],
)
def test_an_accuracy_file_that_does_not_fit_is_refused(
    tmp_path: Path, content: bytes, words: str
) -> None:
    path = write(tmp_path, record(604799.0), record(604799.5))
    smrmsg = write(tmp_path, content, name="smrmsg.out")
    with pytest.raises(KgcpError, match=f"smrmsg.out: .*{words}"):
        read_sbet(path, _with_accuracies(smrmsg))
    with pytest.raises(
        KgcpError, match=r"gone\.out: does not exist; flight.toml names it under \[vehicle\] acc"
    ):
        read_sbet(path, _with_accuracies(tmp_path / "gone.out"))


@pytest.mark.parametrize(
    ("records", "words"),
    [
        ([record(604799.0), record(604799.0)], ("record 2", "repeats", "record 1")),
        ([record(604799.5), record(604799.0)], ("record 2", "before", "record 1")),
        ([record(604799.0), record(604799.5, latitude=41.4)], ("record 2", "41.4 rad")),
        ([record(604799.0), record(float("nan"))], ("record 2", "time nan")),
        ([record(604799.0)], ("1 epochs",)),
        ([record(604799.0), record(604799.5)[:-8]], ("264 bytes", "136 bytes")),
    ],
)
def test_wrong_files_are_a_one_line_error(
    tmp_path: Path, records: list[bytes], words: tuple[str, ...]
) -> None:
    with pytest.raises(KgcpError) as caught:
        read_sbet(write(tmp_path, *records), SATURDAY)
    message = str(caught.value)
    assert "\n" not in message
    for word in ("sbet.out", *words):
        assert word in message


def test_other_files_of_the_same_size_are_not_taken_for_sbet(tmp_path: Path) -> None:
    for name, content in (("zeros", bytes(272)), ("big", struct.pack(">17d", *range(1, 18)) * 2)):
        path = write(tmp_path, content, name=name)
        with pytest.raises(KgcpError, match="is not a trajectory of a known format"):
            read_trajectory(path, "EPSG:25831", SATURDAY)


def test_keys_of_sbet_are_refused_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "v.csv"
    path.write_text("time,x,y,z\n")
    options = TrajectoryFileOptions(format="csv", wander=Wander.ADD)
    with pytest.raises(KgcpError, match=r"\[vehicle\] wander: has no meaning .* format csv"):
        read_trajectory(path, "EPSG:25831", options)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(
    start=st.floats(0.0, 604800.0, exclude_max=True),
    steps=st.lists(st.floats(0.005, 1.0), min_size=1, max_size=20),
    latitude=st.floats(-80.0, 84.0),
    height=st.floats(-400.0, 9000.0),
    heading=st.floats(0.0, 359.0),
)
def test_a_written_trajectory_reads_back(
    tmp_path: Path, start: float, steps: list[float], latitude: float, height: float, heading: float
) -> None:
    seconds: FloatArray = start + np.cumsum([0.0, *steps])
    longitude = 9.0 + np.arange(len(seconds)) * 1e-6
    records = np.zeros((len(seconds), 17))
    records[:, 0] = seconds % 604800.0
    records[:, 1], records[:, 2], records[:, 3] = (
        np.radians(latitude),
        np.radians(longitude),
        height,
    )
    records[:, 9] = np.radians(heading)
    path = write(tmp_path, records.astype("<f8").tobytes())
    sunday = date(2026, 5, 3)
    day = date.fromordinal(sunday.toordinal() + int(start // 86400.0))
    options = TrajectoryFileOptions(time_system=TimeSystem.GPS, first_day=day, format="sbet")
    trajectory = read_trajectory(path, "EPSG:4979", options)
    week_s = datetime(2026, 5, 3, tzinfo=UTC).timestamp() - 18.0
    assert_allclose(trajectory.time_s, week_s + seconds, rtol=0, atol=1e-6)
    assert_allclose(trajectory.position_map[:, 0], longitude, rtol=0, atol=1e-12)
    assert_allclose(trajectory.position_map[:, 1], latitude, rtol=0, atol=1e-12)
    assert_allclose(trajectory.position_map[:, 2], height, rtol=0, atol=1e-6)
    assert_allclose(trajectory.attitude_deg[:, 2], heading, atol=1e-9)
