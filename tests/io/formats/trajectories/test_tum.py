from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pyproj import Proj
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.georef.trajectory import body_to_ned
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.formats.trajectories import read_trajectory
from kgcp.io.formats.trajectories.records import TrajectoryFileOptions

CRS = "EPSG:25831"
ORIGIN = (430606.1, 4583523.0, 120.0)  # 2.17 E, 41.4 N: grid north 0.55 degrees west of true north
CONVERGENCE_DEG = -0.549
HALF = np.sqrt(0.5)
# R(map ← body) = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]: forward is grid north, right east, down down;
# a half turn about the line halfway between x and y.
NORTH = (HALF, HALF, 0.0, 0.0)
EAST = (1.0, 0.0, 0.0, 0.0)  # a half turn about x: forward stays east, down is down


def write(folder: Path, *rows: str) -> Path:
    path = folder / "vehicle.tum"
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def row(time: str, quaternion: tuple[float, ...], position: tuple[float, ...] = ORIGIN) -> str:
    return " ".join((time, *(repr(float(value)) for value in (*position, *quaternion))))


@pytest.mark.parametrize(
    ("quaternion", "heading"),
    [(NORTH, 0.0), (tuple(-q for q in NORTH), 0.0), (EAST, 90.0), ((0.0, 1.0, 0.0, 0.0), 270.0)],
)
def test_grid_headings_are_converted_to_true_headings(
    tmp_path: Path, quaternion: tuple[float, ...], heading: float
) -> None:
    path = write(
        tmp_path,
        "# timestamp tx ty tz qx qy qz qw",
        row("1777887005.25", quaternion),
        "",
        row("1777887006", quaternion),
    )
    trajectory = read_trajectory(path, CRS)
    assert_allclose(trajectory.time_s, [1777887005.25, 1777887006.0])
    assert_allclose(trajectory.position_map[0], ORIGIN)
    assert_allclose(trajectory.attitude_deg[0, :2], 0.0, atol=1e-9)
    expected = (heading + CONVERGENCE_DEG) % 360.0
    assert trajectory.attitude_deg[0, 2] == pytest.approx(expected, abs=1e-3)
    assert (trajectory.sd_position_m, trajectory.sd_attitude_deg) == (None, None)


def test_quaternions_may_refer_to_earth_centred_axes(tmp_path: Path) -> None:
    # On the equator at Greenwich X is up, Y east and Z north; the vehicle heads for the east.
    body = Rotation.from_matrix(np.column_stack(([0, 1, 0], [0, 0, -1], [-1, 0, 0])))
    quaternion = " ".join(f"{value:.15f}" for value in body.as_quat())
    path = tmp_path / "vehicle.txt"
    path.write_text(f"0 6378237 0 0 {quaternion}\n1 6378237 9 0 {quaternion}\n")
    trajectory = read_trajectory(path, "EPSG:4979", TrajectoryFileOptions(crs="EPSG:4978"))
    assert_allclose(trajectory.position_map[0], [0.0, 0.0, 100.0], atol=1e-6)
    assert_allclose(trajectory.attitude_deg[0], [0.0, 0.0, 90.0], atol=1e-9)


def test_roll_is_right_side_down_and_pitch_nose_up(tmp_path: Path) -> None:
    # Heading grid east; then 10 degrees of pitch about the right side (south), then 20 of roll
    # about the nose: q = EAST · (pitch about y) · (roll about x), written out by hand.
    p, r = np.radians(10.0) / 2.0, np.radians(20.0) / 2.0
    # (w, x, y, z) of pitch · roll = (cp cr, cp sr, sp cr, -sp sr); times i from the left
    w, x, y, z = (
        np.cos(p) * np.cos(r),
        np.cos(p) * np.sin(r),
        np.sin(p) * np.cos(r),
        -np.sin(p) * np.sin(r),
    )
    quaternion = (w, -z, y, -x)  # i (w + xi + yj + zk) = -x + wi - zj + yk
    path = write(tmp_path, row("0", quaternion), row("1", quaternion))
    roll, pitch, heading = read_trajectory(path, CRS).attitude_deg[0]
    assert (roll, pitch) == pytest.approx((20.0, 10.0), abs=1e-9)
    assert heading == pytest.approx(90.0 + CONVERGENCE_DEG, abs=1e-3)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(
    roll=st.floats(-40.0, 40.0),
    pitch=st.floats(-40.0, 40.0),
    heading=st.floats(0.0, 359.0),
    easting=st.floats(300000.0, 700000.0),
)
def test_every_attitude_is_read_back_as_it_was_written(
    tmp_path: Path, roll: float, pitch: float, heading: float, easting: float
) -> None:
    longitude, latitude = Proj(CRS)(easting, 4583523.0, inverse=True)
    azimuth = np.radians(Proj(CRS).get_factors(longitude, latitude).meridian_convergence)
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    level_from_map = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    level_from_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    body = body_to_ned(np.array(roll), np.array(pitch), np.array(heading))
    quaternion = Rotation.from_matrix(level_from_map.T @ level_from_ned @ body).as_quat()
    position = (easting, 4583523.0, 50.0)
    rows = [row(time, tuple(quaternion), position) for time in ("0", "1")]
    attitude = read_trajectory(write(tmp_path, *rows), CRS).attitude_deg[1]
    assert attitude[:2] == pytest.approx([roll, pitch], abs=1e-6)
    assert (attitude[2] - heading + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-6)


def test_axes_of_robotics_are_refused_with_a_remedy(tmp_path: Path) -> None:
    # x forward, y left, z up, heading east: the identity
    path = write(tmp_path, row("0", (0.0, 0.0, 0.0, 1.0)), row("1", (0.0, 0.0, 0.0, 1.0)))
    with pytest.raises(KgcpError, match=r"on its roof.*\(qw, qz, -qy, -qx\)"):
        read_trajectory(path, CRS)
    x, y, z, w = 0.1, -0.2, 0.3, np.sqrt(1.0 - 0.14)  # nose and left side of any attitude
    turned = write(tmp_path, *(row(time, (w, z, -y, -x)) for time in ("0", "1")))
    heading = read_trajectory(turned, CRS).attitude_deg[0, 2]
    nose = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w))  # east, north of R's first column
    expected = np.degrees(np.arctan2(*nose)) + CONVERGENCE_DEG
    assert heading == pytest.approx(expected % 360.0, abs=1e-3)


def test_other_clocks_and_the_course_can_be_stated(tmp_path: Path) -> None:
    positions = [(ORIGIN[0] + 5.0 * k, ORIGIN[1], ORIGIN[2]) for k in range(4)]
    rows = [row(f"{123400 + k}.5", NORTH, position) for k, position in enumerate(positions)]
    options = TrajectoryFileOptions(
        format="tum",
        time_system=TimeSystem.GPS,
        first_day=date(2026, 5, 4),
        course_sd_deg=(2.0, 2.0, 3.0),
    )
    trajectory = read_trajectory(write(tmp_path, *rows), CRS, options)
    monday_s = 1777887000.0 - 9.5 * 3600.0
    assert trajectory.time_s[0] == pytest.approx(monday_s - 86400.0 + 123400.5 - 18.0)
    assert_allclose(trajectory.attitude_deg[:, 2], 90.0 + CONVERGENCE_DEG, atol=1e-3)
    assert trajectory.sd_attitude_deg is not None
    assert_allclose(trajectory.sd_attitude_deg, [[2.0, 2.0, 3.0]] * 4)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ((row("0", NORTH), row("1", (0.5, 0.5, 0.0, 0.0))), ("line 2", "norm 0.707107")),
        ((row("0", NORTH), "1 2 3"), ("line 2", "eight numbers")),
        ((row("0", NORTH), row("x", NORTH)), ("line 2", "eight numbers")),
        ((row("0", NORTH), row("1", (np.nan, 0.0, 0.0, 1.0))), ("line 2", "eight numbers")),
        ((row("1", NORTH), "# turned", row("0", NORTH)), ("line 3", "before", "line 1")),
        ((row("1777887005250", NORTH), row("1777887005251", NORTH)), ("line 1", "out of range")),
    ],
)
def test_wrong_files_are_a_one_line_error(
    tmp_path: Path, rows: tuple[str, ...], words: tuple[str, ...]
) -> None:
    with pytest.raises(KgcpError) as caught:
        read_trajectory(write(tmp_path, *rows), CRS)
    message = str(caught.value)
    assert "\n" not in message
    for word in ("vehicle.tum", *words):
        assert word in message
