from __future__ import annotations

import struct
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from pyproj.datadir import get_data_dir

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.trajectory import Trajectory
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories import FORMATS, read_trajectory
from kgcp.io.formats.trajectories.records import TrajectoryFileOptions

_CRS = "EPSG:25832"
_HEADER = "time,x,y,z,roll_deg,pitch_deg,heading_deg"
_ROWS = ("2026-05-04T09:30:00Z,1,2,3,4,5,6", "2026-05-04T09:30:00.5Z,1,2,3,4,5,6")


def _write(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "vehicle.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_columns_are_found_by_name_in_any_order(tmp_path: Path) -> None:
    path = _write(
        tmp_path,
        "heading_deg, z,y,x,note,pitch_deg,roll_deg,time",
        "6,3,2,1,start,5,4,1777887000",
        "",
        "16,13,12,11,,15,14,2026-05-04T09:30:00.25Z",
    )
    trajectory = read_trajectory(path, _CRS)
    np.testing.assert_allclose(trajectory.time_s, [1777887000.0, 1777887000.25])
    np.testing.assert_allclose(trajectory.position_map, [[1, 2, 3], [11, 12, 13]])
    np.testing.assert_allclose(trajectory.attitude_deg, [[4, 5, 6], [14, 15, 16]])
    assert trajectory.sd_position_m is None
    assert trajectory.sd_attitude_deg is None


def test_standard_deviations_are_optional_by_group(tmp_path: Path) -> None:
    path = _write(
        tmp_path,
        "\ufeff" + _HEADER + ",sd_z,sd_y,sd_x",
        _ROWS[0] + ",0.3,0.2,0.1",
        _ROWS[1] + ",0.3,0.2,0.1",
    )
    trajectory = read_trajectory(path, _CRS)
    assert trajectory.sd_position_m is not None
    np.testing.assert_allclose(trajectory.sd_position_m, [[0.1, 0.2, 0.3]] * 2)
    assert trajectory.sd_attitude_deg is None


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((_HEADER, _ROWS[0], "2026-05-04T09:30:01Z,1,nan,3,4,5,6"), ("line 3", "y", "nan")),
        ((_HEADER, _ROWS[0], "2026-05-04T09:30:01Z,inf,2,3,4,5,6"), ("line 3", "x", "inf")),
        ((_HEADER, _ROWS[0], "2026-05-04T09:30:01Z,1,2,3,4,5,"), ("line 3", "heading_deg")),
        ((_HEADER, _ROWS[1], _ROWS[0]), ("line 3", "before", "line 2")),
        ((_HEADER, _ROWS[0], _ROWS[0]), ("line 3", "repeats", "line 2")),
        (
            (_HEADER, *(f"2026-05-04T09:30:0{i // 5}Z,{i},2,3,4,5,6" for i in range(10))),
            ("line 3", "8 of 10 times", "rounded", "export the file again"),
        ),
        ((_HEADER, _ROWS[0], "", "2026-05-04T09:31,1,2,3,4,5,6"), ("line 4", "time zone")),
        ((_HEADER, _ROWS[0], "2026-05-04T09:31Z,1,2,3"), ("line 3", "4 cells")),
        (("time,x,y,z", "0,1,2,3"), ("roll_deg", "heading_deg", "lacks")),
        ((_HEADER + ",x", *_ROWS), ("names x twice",)),
        ((_HEADER + ",sd_x", _ROWS[0] + ",1", _ROWS[1] + ",1"), ("sd_x but not sd_y",)),
        (
            (_HEADER + ",sd_x,sd_y,sd_z", _ROWS[0] + ",1,1,1", _ROWS[1] + ",1,-1,1"),
            ("line 3", "sd_y"),
        ),
        ((_HEADER, _ROWS[0]), ("1 epochs",)),
        ((), ("empty",)),
    ],
)
def test_wrong_files_are_a_one_line_error(
    tmp_path: Path, lines: tuple[str, ...], words: tuple[str, ...]
) -> None:
    path = _write(tmp_path, *lines)
    with pytest.raises(KgcpError) as caught:
        read_trajectory(path, _CRS)
    message = str(caught.value)
    assert "\n" not in message
    for word in ("vehicle.csv", *words):
        assert word in message


def test_a_missing_file_names_the_key_that_asked_for_it(tmp_path: Path) -> None:
    with pytest.raises(KgcpError, match=r"vehicle\.csv: does not exist.*\[vehicle\] trajectory"):
        read_trajectory(tmp_path / "vehicle.csv", _CRS)


def test_binary_rubbish_is_an_error_not_a_traceback(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.csv"
    path.write_bytes(b"\xff\xd8\xff\xe0\x00\x10JFIF")
    with pytest.raises(KgcpError, match="is not a trajectory of a known format"):
        read_trajectory(path, _CRS)


def _notation(system: TimeSystem | None = None, day: date | None = None) -> TrajectoryFileOptions:
    return TrajectoryFileOptions(time_system=system, first_day=day)


@pytest.mark.parametrize(
    ("text", "notation", "unix_s"),
    [
        ("1777887005.25", _notation(), 1777887005.25),
        ("1777887005.25", _notation(TimeSystem.UTC), 1777887005.25),
        ("1777887005.25", _notation(TimeSystem.GPS), 1777886987.25),
        ("2026-05-04T09:30:05.25", _notation(TimeSystem.UTC), 1777887005.25),
        ("2026-05-04 09:30:05.25", _notation(TimeSystem.GPS), 1777886987.25),
        ("2026-05-04T11:30:05.25+02:00", _notation(TimeSystem.UTC), 1777887005.25),
        ("120605.25", _notation(TimeSystem.GPS, date(2026, 5, 4)), 1777886987.25),
        ("120605.25", _notation(TimeSystem.UTC, date(2026, 5, 4)), 1777887005.25),
    ],
)
def test_times_are_of_the_clock_that_flight_toml_names(
    tmp_path: Path, text: str, notation: TrajectoryFileOptions, unix_s: float
) -> None:
    later = "2026-05-04T09:30:06+00:00" if "+" in text else text[:-3].replace("05", "06") + ".00"
    path = _write(tmp_path, _HEADER, f"{text},1,2,3,4,5,6", f"{later},1,2,3,4,5,6")
    trajectory = read_trajectory(path, _CRS, notation)
    assert trajectory.time_s[0] == pytest.approx(unix_s, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "notation", "words"),
    [
        ("2026-05-04T09:30:00Z", _notation(TimeSystem.GPS), "names a zone, but .* is gps"),
        ("2026-05-04", _notation(TimeSystem.GPS), "'2026-05-04' is a date without a time of day"),
        ("04.05.2026 9:30", _notation(TimeSystem.UTC), "'04.05.2026 9:30' is not a time"),
        ("2026-05-04T09:30", _notation(), "no time zone"),
        ("120605.25", _notation(day=date(2026, 5, 4)), "give time_system under"),
        ("2026-05-04T09:30:00Z", _notation(TimeSystem.UTC, date(2026, 5, 4)), "delete date"),
        ("120605", _notation(TimeSystem.GPS, date(2026, 5, 5)), "on a Monday, but .* a Tuesday"),
    ],
)
def test_times_that_contradict_their_clock_are_refused(
    tmp_path: Path, text: str, notation: TrajectoryFileOptions, words: str
) -> None:
    path = _write(tmp_path, _HEADER, f"{text},1,2,3,4,5,6", f"{text},1,2,3,4,5,6")
    with pytest.raises(KgcpError, match=rf"vehicle\.csv.*{words}") as caught:
        read_trajectory(path, _CRS, notation)
    assert "\n" not in str(caught.value)


def test_a_csv_in_degrees_is_converted_to_the_flight_s_grid(tmp_path: Path) -> None:
    # On the zone's central meridian: easting 500 000, and the meridian's arc times 0.9996. The arc
    # to 45 degrees on GRS 80 is 4 984 944.378 m.
    rows = [f"{second},9,45,100,1,2,3,0.01,0.02,0.03" for second in (0, 1)]
    path = _write(tmp_path, f"{_HEADER},sd_x,sd_y,sd_z", *rows)
    trajectory = read_trajectory(path, _CRS, TrajectoryFileOptions(crs="EPSG:4258"))
    expected = [500000.0, 0.9996 * 4984944.378, 100.0]
    np.testing.assert_allclose(trajectory.position_map[0], expected, rtol=0, atol=1e-3)
    np.testing.assert_allclose(trajectory.attitude_deg[0], [1, 2, 3])
    assert trajectory.cov_position_m2 is not None
    variances = np.diag([0.01, 0.02, 0.03]) ** 2
    np.testing.assert_allclose(trajectory.cov_position_m2[0], variances, atol=1e-12)


def test_feet_of_the_grid_are_not_those_of_heights(tmp_path: Path) -> None:
    # California zone 5: 33.5 N 118 W has the false easting 2 000 000 m and northing 500 000 m, in
    # US survey feet of 1200/3937 m; ellipsoidal heights are metres.
    foot_m = 1200.0 / 3937.0
    rows = [f"{second},{2e6 / foot_m},{5e5 / foot_m},100,1,2,3" for second in (0, 1)]
    path = _write(tmp_path, _HEADER, *rows)
    trajectory = read_trajectory(path, "EPSG:4269", TrajectoryFileOptions(crs="EPSG:2229"))
    expected = [-118.0, 33.5, 100.0]
    np.testing.assert_allclose(trajectory.position_map[0], expected, rtol=0, atol=1e-8)


def test_a_csv_may_be_earth_centred(tmp_path: Path) -> None:
    # On the equator at Greenwich, 100 m above the ellipsoid: X is up, Y east and Z north.
    rows = [f"{second},6378237,{9 * second},0,1,2,3,0.03,0.01,0.02" for second in (0, 1)]
    path = _write(tmp_path, f"{_HEADER},sd_x,sd_y,sd_z", *rows)
    trajectory = read_trajectory(path, "EPSG:4979", TrajectoryFileOptions(crs="EPSG:4978"))
    np.testing.assert_allclose(trajectory.position_map[0], [0.0, 0.0, 100.0], atol=1e-6)
    np.testing.assert_allclose(trajectory.position_map[1, 0], np.degrees(9.0 / 6378237), rtol=1e-9)
    assert trajectory.sd_position_m is not None
    np.testing.assert_allclose(trajectory.sd_position_m[0], [0.01, 0.02, 0.03], rtol=1e-6)
    np.testing.assert_allclose(trajectory.attitude_deg[0], [1, 2, 3])  # of the level there


def test_a_crs_without_a_datum_is_refused(tmp_path: Path) -> None:
    path = _write(tmp_path, _HEADER, "0,5e5,5e6,100,1,2,3", "1,5e5,5e6,100,1,2,3")
    local = "+proj=utm +zone=32 +ellps=GRS80 +type=crs"
    with pytest.raises(KgcpError, match="is not known exactly; give a CRS of the flight's datum"):
        read_trajectory(path, _CRS, TrajectoryFileOptions(crs=local))


def test_a_grid_that_is_not_installed_is_named(tmp_path: Path) -> None:
    rows = [f"{second},-1.5,52,100,1,2,3" for second in (0, 1)]
    path = _write(tmp_path, _HEADER, *rows)
    with pytest.raises(
        KgcpError, match=r"vehicle.csv: the transformation .*EPSG:27700.* needs the grid"
    ) as e:
        read_trajectory(path, "EPSG:27700", TrajectoryFileOptions(crs="EPSG:4258"))
    assert "\n" not in str(e.value)
    with pytest.raises(KgcpError, match=r"\[vehicle\] crs 'EPSG:0' cannot be used"):
        read_trajectory(path, _CRS, TrajectoryFileOptions(crs="EPSG:0"))


def test_heights_above_a_geoid_need_its_grid(tmp_path: Path) -> None:
    # 4979 → 4326+5773 with a ballpark would leave 100 m at Barcelona as they are, 49 m off.
    if (Path(get_data_dir()) / "us_nga_egm96_15.tif").exists():
        pytest.skip("the grid of EGM96 is installed")
    path = _write(tmp_path, _HEADER, "0,2.17,41.4,100,1,2,3", "1,2.17,41.4,100,1,2,3")
    with pytest.raises(KgcpError, match="needs the grid us_nga_egm96"):
        read_trajectory(path, "EPSG:4326+5773", TrajectoryFileOptions(crs="EPSG:4979"))


def test_a_point_that_cannot_be_transformed_is_named(tmp_path: Path) -> None:
    rows = ("0,9,45,100,1,2,3", "1,9,450,100,1,2,3")
    with pytest.raises(KgcpError, match=r"vehicle.csv: the point \(9, 450, 100\) of epoch 2"):
        read_trajectory(
            _write(tmp_path, _HEADER, *rows), _CRS, TrajectoryFileOptions(crs="EPSG:4258")
        )
    # easting and northing taken for Earth-centred coordinates lie a thousand kilometres deep
    grid = _write(tmp_path, _HEADER, "0,689586,5336250,547,1,2,3", "1,689587,5336250,547,1,2,3")
    with pytest.raises(KgcpError, match=r"epoch 1 cannot be transformed .* \(now 'EPSG:4978'\)"):
        read_trajectory(grid, _CRS, TrajectoryFileOptions(crs="EPSG:4978"))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("\ufefftime,x\n", "csv"),
        ("% program : RTKLIB\n", "rtklib"),
        ("\n%  GPST  latitude(deg)\n", "rtklib"),
        ("2015/06/01 00:00:00.000   47.48 19.05\n", "rtklib"),
        ("# x\n\n1 2 3 4 5 6 7 8\n", "tum"),
        ("Project: x\nProgram:     GrafNav Version 9.00\n", "waypoint"),
        (struct.pack("<17d", 5.0, 0.7, 0.03, 99.0, *[0.0] * 13), "sbet"),
    ],
)
def test_formats_are_recognised_by_content(
    tmp_path: Path, content: str | bytes, expected: str
) -> None:
    path = tmp_path / "vehicle"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert FORMATS.recognised(ForeignFile(path, "")) == expected


def test_the_format_may_be_named_instead(tmp_path: Path) -> None:
    path = _write(tmp_path, "1 2 3", "4 5 6")
    with pytest.raises(KgcpError, match="is not a trajectory of a known format"):
        read_trajectory(path, _CRS)
    for kind, words in (
        ("csv", "lacks the columns"),
        ("tum", "line 1: is not the eight numbers"),
        ("rtklib", "lacks the header line"),
        ("waypoint", "lacks the lines with the names of its columns"),
        ("sbet", f"{path.stat().st_size} bytes, not a multiple of 136"),
    ):
        with pytest.raises(KgcpError, match=words):
            read_trajectory(path, _CRS, TrajectoryFileOptions(format=kind))
        with pytest.raises(KgcpError, match=r"does not exist; .*\[vehicle\] trajectory"):
            read_trajectory(tmp_path / "gone", _CRS, TrajectoryFileOptions(format=kind))


# Two epochs on the meridian of zone 32, 0.5 s and 1e-5 degrees apart, heading north.
_SAME_PLACES: dict[str, tuple[bytes, TrajectoryFileOptions]] = {
    "csv": (
        f"{_HEADER}\n1777887000,9,45,100,0,0,0\n1777887000.5,9,45.00001,100,0,0,0\n".encode(),
        TrajectoryFileOptions(crs="EPSG:4979"),
    ),
    "sbet": (
        b"".join(
            struct.pack("<17d", second, np.radians(lat), np.radians(9.0), 100.0, *[0.0] * 13)
            for second, lat in ((120618.0, 45.0), (120618.5, 45.00001))
        ),
        TrajectoryFileOptions(time_system=TimeSystem.GPS, first_day=date(2026, 5, 4)),
    ),
    "rtklib": (
        (
            b"% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix)\n%  GPST latitude(deg) longitude(deg)"
            b" height(m) Q\n2417 120618.0 45.0 9.0 100.0 1\n2417 120618.5 45.00001 9.0 100.0 1\n"
        ),
        TrajectoryFileOptions(course_sd_deg=(2.0, 2.0, 3.0)),
    ),
    "waypoint": (
        (
            b"Program:     Inertial Explorer Version 8.90\nDatum: WGS84, (processing datum)\n\n"
            b"   Week  GPSTime Latitude Longitude H-Ell  Roll Pitch Heading\n"
            b"(weeks)    (sec)    (deg)     (deg)   (m) (deg) (deg)   (deg)\n"
            b"   2417 120618.0     45.0       9.0 100.0     0     0       0\n"
            b"   2417 120618.5 45.00001       9.0 100.0     0     0       0\n"
        ),
        TrajectoryFileOptions(),
    ),
    "tum": (
        "".join(
            f"{time} 9 {lat} 100 {np.sqrt(0.5)} {np.sqrt(0.5)} 0 0\n"
            for time, lat in ((1777887000.0, 45.0), (1777887000.5, 45.00001))
        ).encode(),
        TrajectoryFileOptions(crs="EPSG:4979"),
    ),
}


@pytest.mark.parametrize("kind", FORMATS.names)
def test_formats_give_the_same_result_whether_recognised_or_named(
    tmp_path: Path, kind: str
) -> None:
    content, options = _SAME_PLACES[kind]
    path = tmp_path / "vehicle"
    path.write_bytes(content)
    for stated in (options, replace(options, format=kind)):
        trajectory = read_trajectory(path, _CRS, stated)
        assert trajectory.format == kind
        np.testing.assert_allclose(trajectory.time_s, 1777887000.0 + np.array([0.0, 0.5]))
        arc_m = 0.9996 * 4984944.378  # to 45 degrees, on the zone's meridian
        np.testing.assert_allclose(trajectory.position_map[0], [5e5, arc_m, 100.0], atol=1e-3)
        step_m = np.diff(trajectory.position_map[:, 1])
        np.testing.assert_allclose(step_m, 0.9996 * 1.11131777, rtol=1e-6)  # 6 367 381.8 m · 1e-5°
        np.testing.assert_allclose(trajectory.attitude_deg, 0.0, atol=1e-6)


_COURSE = TrajectoryFileOptions(course_sd_deg=(2.0, 1.5, 3.0))


def _drive(tmp_path: Path, time_s: FloatArray, east: FloatArray, north: FloatArray) -> Trajectory:
    """Read positions in metres from a point on the central meridian, without attitude."""
    rows = [
        f"{t:.3f},{500000.0 + 0.9996 * e:.4f},{5000000.0 + 0.9996 * n:.4f},50"
        for t, e, n in zip(time_s, east, north, strict=True)
    ]
    return read_trajectory(_write(tmp_path, "time,x,y,z", *rows), _CRS, _COURSE)


def test_the_course_of_a_curve_is_its_tangent(tmp_path: Path) -> None:
    time_s = np.arange(0.0, 30.0, 0.1)
    angle = 8.0 / 25.0 * time_s  # 8 m/s on a circle of 25 m, clockwise from north
    trajectory = _drive(tmp_path, time_s, 25.0 * (1.0 - np.cos(angle)), 25.0 * np.sin(angle))
    error = (trajectory.attitude_deg[:, 2] - np.degrees(angle) + 180.0) % 360.0 - 180.0
    assert np.abs(error[3:-3]).max() < 0.01  # at either end the chord begins or ends there
    assert np.abs(error).max() < 3.0
    np.testing.assert_array_equal(trajectory.attitude_deg[:, :2], 0.0)
    assert trajectory.sd_attitude_deg is not None
    np.testing.assert_array_equal(trajectory.sd_attitude_deg, [[2.0, 1.5, 3.0]] * len(time_s))


def test_a_vehicle_that_stands_keeps_its_heading(tmp_path: Path) -> None:
    time_s = np.arange(0.0, 12.0, 0.2)
    rng = np.random.default_rng(3)
    run = np.clip(time_s - 3.0, 0.0, 4.0) * 5.0  # stands, drives 20 m to the south-west, stands
    noise = rng.normal(0.0, 0.01, (2, len(time_s)))
    diagonal = -run / np.sqrt(2.0)
    heading = _drive(tmp_path, time_s, diagonal + noise[0], diagonal + noise[1]).attitude_deg[:, 2]
    assert np.abs(heading - 225.0).max() < 3.0


def test_a_vehicle_that_never_moves_has_no_course(tmp_path: Path) -> None:
    time_s = np.arange(0.0, 5.0, 0.2)
    with pytest.raises(KgcpError, match="vehicle never moves"):
        _drive(tmp_path, time_s, 0.0 * time_s, 0.0 * time_s)
