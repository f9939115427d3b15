"""Text exports of Inertial Explorer and GrafNav, in the layouts that users choose."""

from __future__ import annotations

from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from kgcp.errors import KgcpError
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories import FORMATS, waypoint
from kgcp.io.formats.trajectories.first_epoch import TrajectoryFile, first_epoch
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFileOptions

HEADER = """
Project:     corridor
Program:     Inertial Explorer Version 8.90.6611
Source:      GNSS/INS Epochs(Smoothed TC Combined)
Datum:       WGS84, (processing datum)
Master 1:    Name BASE, Status ENABLED
             Position 48 05 23.39873, 11 23 49.23157, 577.631 m (WGS84, Ellipsoidal hgt)
SD Scaling Settings:
  Position: 1.0000
  Velocity: 2.0000
  Attitude: No scaling (1-sigma)
UTC Offset:  18 s

"""
# Q and NS have no unit
TABLE = """\
  Week     GPSTime       Latitude      Longitude        H-Ell Q SDEast SDNorth SDHeight NS     Roll    Pitch   Heading  RollSD  PtchSD  HdngSD
(weeks)      (sec)          (deg)          (deg)          (m)      (m)     (m)      (m)       (deg)    (deg)     (deg)   (deg)   (deg)   (deg)
  2423  202518.000  48.1508905921  11.5491329143     545.4542 1  0.011   0.012    0.018 15   0.3865  -0.4342  359.9642  0.0200  0.0210  0.0500
  2423  202518.050  48.1508940409  11.5491329248     545.4578 1  0.011   0.012    0.018 15   0.4095  -0.4412  359.8598  0.0200  0.0210  0.0500
"""  # noqa: E501 - as wide as the program writes it
FIRST_S = datetime(2026, 6, 16, 8, 15, tzinfo=UTC).timestamp()
IN_DEGREES = (
    "GPSTime,Latitude,Longitude,H-Ell\n(sec),(deg),(deg),(m)\n"
    "202518.00,48.1,11.5,545.4\n202518.05,48.1,11.5,545.4\n"
)


def written(folder: Path, table: str, header: str = HEADER) -> Path:
    path = folder / "vehicle.txt"
    path.write_text(header + table, encoding="utf-8")
    return path


def read(path: Path, options: TrajectoryFileOptions | None = None) -> Epochs:
    file = ForeignFile(path, "[vehicle] trajectory")
    assert FORMATS.recognised(file) == "waypoint"
    return waypoint.read(file, options or TrajectoryFileOptions(), "EPSG:25832")


def test_an_export_with_attitude_and_deviations_is_read(tmp_path: Path) -> None:
    epochs = read(written(tmp_path, TABLE))
    assert_allclose(epochs.time_s, [FIRST_S, FIRST_S + 0.05], rtol=0, atol=1e-6)
    assert_allclose(epochs.position[0], [11.5491329143, 48.1508905921, 545.4542], rtol=1e-15)
    assert epochs.crs == "EPSG:4979"
    assert epochs.attitude_deg is not None
    assert epochs.sd_position_m is not None
    assert epochs.sd_attitude_deg is not None
    assert_allclose(epochs.attitude_deg[0], [0.3865, -0.4342, 359.9642])
    assert_allclose(epochs.sd_position_m[1], [0.011, 0.012, 0.018])
    assert_allclose(epochs.sd_attitude_deg[1], [0.02, 0.021, 0.05])


def test_sexagesimal_angles_and_utc_are_read_with_any_mark_between_columns(tmp_path: Path) -> None:
    """Below zero degrees, the sign stands at a zero. Lines of words may follow the epochs."""
    rows = [
        "UTCDate,UTCTime,Latitude,Longitude,H-Ell",
        "(YMD),(HMS),(+/-D M S),(+/-D M S),(m)",
        "2026/06/16,23:59:59.50,-33 07 30.000,-0 15 18.000,12.5",
        "2026/06/17,00:00:00.50,-33 07 30.000,-0 15 18.000,12.5",
    ]
    footer = "\n\nNotes\n  1 of 1 sessions\n"
    tables = ["\n".join(rows), "\n".join(row.replace(",", ";") for row in rows)]
    tables.append("\n".join(row.replace(",", "   ") for row in rows))
    midnight_s = datetime(2026, 6, 17, tzinfo=UTC).timestamp()
    for table in tables:
        epochs = read(written(tmp_path, table + footer))
        assert_allclose(epochs.time_s, [midnight_s - 0.5, midnight_s + 0.5], rtol=0, atol=1e-6)
        assert_allclose(epochs.position[0], [-0.255, -33.125, 12.5], rtol=1e-14)
        assert epochs.attitude_deg is None
        assert epochs.sd_position_m is None


def test_covariances_are_along_east_north_and_up(tmp_path: Path) -> None:
    table = (
        "Week,GPSTime,Latitude,Longitude,H-Ell,CxEE,CxNN,CxHH,CxEN,CxEH,CxNH\n"
        "(weeks),(sec),(deg),(deg),(m),(m^2),(m^2),(m^2),(m^2),(m^2),(m^2)\n"
        "2423,202518,48.1,11.5,545.4,4e-4,9e-4,16e-4,1e-4,-2e-4,3e-4\n"
        "2423,202519,48.1,11.5,545.4,4e-4,9e-4,16e-4,1e-4,-2e-4,3e-4\n"
    )
    epochs = read(written(tmp_path, table))
    assert epochs.cov_position_m2 is not None
    assert epochs.sd_position_m is not None
    expected = 1e-4 * np.array([[4.0, 1.0, -2.0], [1.0, 9.0, 3.0], [-2.0, 3.0, 16.0]])
    assert_allclose(epochs.cov_position_m2[0], expected)
    assert_allclose(epochs.sd_position_m[0], [0.02, 0.03, 0.04])


@pytest.mark.parametrize(
    ("times", "seconds"),
    [
        ("Week,GPSTime|(weeks),(sec)|2422,604799.5|2423,0.5", (0.0, 1.0)),
        ("Week,GPSTime|(weeks),(sec)|2422,604799.5|2422,0.5", (0.0, 1.0)),
        ("Date,GPSTime|(MDY),(sec)|06/13/2026,604799.5|06/13/2026,0.5", (0.0, 1.0)),
        ("GPSDate,GPSTime|(DMY),(HMS)|13/06/2026,23:59:59.5|14/06/2026,00:00:00.5", (0.0, 1.0)),
        ("Date,CorrTime|(YMD),(sec)|2026-06-13,86399.5|2026-06-14,0.5", (0.0, 1.0)),
    ],
)
def test_epochs_go_on_into_the_next_week(
    times: str, seconds: tuple[float, float], tmp_path: Path
) -> None:
    """GPS time, 18 s ahead of UTC; programs repeat week or date, or count them on."""
    places = ("Latitude,Longitude,H-Ell", "(deg),(deg),(m)", "48.1,11.5,545.4", "48.1,11.5,545.4")
    rows = [",".join(pair) for pair in zip(times.split("|"), places, strict=True)]
    epochs = read(written(tmp_path, "\n".join(rows)))
    first_s = datetime(2026, 6, 13, 23, 59, 59, 500000, UTC).timestamp() - 18.0
    assert_allclose(epochs.time_s - first_s, seconds, rtol=0, atol=1e-5)


def test_seconds_of_the_week_alone_need_the_day(tmp_path: Path) -> None:
    path = written(tmp_path, IN_DEGREES)
    with pytest.raises(KgcpError, match="its times are seconds of a week; give date"):
        read(path)
    dated = TrajectoryFileOptions(first_day=date(2026, 6, 16), time_system=TimeSystem.GPS)
    assert_allclose(read(path, dated).time_s[0], FIRST_S, rtol=0, atol=1e-6)
    start = first_epoch(TrajectoryFile(path, "waypoint"))
    assert start is not None
    assert (start.x, start.y, start.time) == (11.5, 48.1, "202518.00")
    assert not start.has_attitude
    start = first_epoch(TrajectoryFile(written(tmp_path, TABLE), "waypoint"))
    assert start is not None
    assert start.time == ""
    assert start.has_attitude


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Smoothed TC Combined", "PPP Combined", "was computed by precise point positioning"),
        ("WGS84, (processing datum)", "NAD83 (2011)", r"the datum as NAD83 \(2011\)"),
        ("WGS84, (processing datum)", "WGS84 (2025.690)", "the datum as WGS84"),
        ("Position: 1.0000", "Position: 2.0000", r"scaled its standard deviations \(Position: 2"),
        ("No scaling (1-sigma)", "2-sigma", r"scaled its standard deviations \(Attitude"),
        (" H-Ell", " H-MSL", "lacks H-Ell"),
        ("48.1508940409", "48.15089404O9", "line 17: Latitude '48.15089404O9' is not a number"),
        ("  0.4095", "", "line 17: does not have one cell for each column"),
        ("(weeks)", "       ", "gives Week in no unit"),
        ("0.0210  0.0500", "-0.021  0.0500", "line 16: a standard deviation is negative"),
        ("    (sec)", "(min sec)", "gives GPSTime in min sec; export it in sec"),
        ("  Week     GPSTime", "  Epoch    TimeOfDay", "no column of times"),
    ],
)
def test_what_is_not_certain_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = HEADER + TABLE
    assert old in text
    with pytest.raises(KgcpError, match=message):
        read(written(tmp_path, text.replace(old, new), header=""))


def test_of_two_columns_with_one_name_the_first_counts(tmp_path: Path) -> None:
    """GPSTime may be there twice, in seconds of the week and of the day."""
    table = TABLE.replace("   Pitch ", " GPSTime ").replace("-0.4342", "29718.0")
    epochs = read(
        written(tmp_path, table.replace("(deg)     (deg)   (deg)", "(sec)     (deg)   (deg)"))
    )
    assert_allclose(epochs.time_s, [FIRST_S, FIRST_S + 0.05], rtol=0, atol=1e-6)
    assert epochs.attitude_deg is None


def test_a_time_that_is_none_is_refused(tmp_path: Path) -> None:
    table = "UTCDate,UTCTime,Latitude,Longitude,H-Ell\n(MDY),(HMS),(deg),(deg),(m)\n"
    for time, words in (
        ("06/16/2026,nan:00:01", "UTCTime 'nan:00:01' is not hh:mm:ss"),
        ("16/06/2026,08:00:01", "UTCDate '16/06/2026' is not a date"),
        ("06/16/26,08:00:01", "UTCDate '06/16/26' is not a date"),
    ):
        row = "06/16/2026,08:00:00,48,11,500\n"
        with pytest.raises(KgcpError, match=f"line 17: {words}"):
            read(written(tmp_path, f"{table}{row}{time},48,11,500\n"))


def test_keys_that_contradict_the_file_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, TABLE)
    with pytest.raises(KgcpError, match="delete date"):
        read(path, TrajectoryFileOptions(first_day=date(2026, 6, 16)))
    with pytest.raises(KgcpError, match="has GPS times in its column GPSTime"):
        read(path, TrajectoryFileOptions(time_system=TimeSystem.UTC))


def test_a_table_that_goes_on_below_words_is_refused(tmp_path: Path) -> None:
    rows = TABLE.splitlines()
    broken = "\n".join([*rows[:3], "Gap of 2 s", rows[3]])
    with pytest.raises(KgcpError, match="line 18: is an epoch that follows lines that are not"):
        read(written(tmp_path, broken))
    with pytest.raises(KgcpError, match="lacks the lines with the names"):
        read(written(tmp_path, "\n".join(rows[2:])))
    with pytest.raises(KgcpError, match="lacks the lines with the names"):
        read(written(tmp_path, "\n".join(["", *rows[1:]])))


def test_two_units_for_one_column_are_refused(tmp_path: Path) -> None:
    """Where names and units do not end at the same places, units might be exchanged."""
    table = TABLE.replace("  Week     GPSTime       Lat", "       Week GPSTime       Lat")
    with pytest.raises(KgcpError, match="export it with commas"):
        read(written(tmp_path, table.replace("(weeks)      (sec)", "(weeks)(sec)      ")))


def test_another_datum_and_itrf_are_read_with_a_crs(tmp_path: Path) -> None:
    header = HEADER.replace("Smoothed TC", "PPP").replace("WGS84, (proc", "ITRF2020 (proc")
    path = written(tmp_path, TABLE, header)
    assert read(path, TrajectoryFileOptions(crs="EPSG:9989")).crs == "EPSG:9989"
