from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose
from pyproj import Proj

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories import read_trajectory, rtklib
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFileOptions

COURSE = TrajectoryFileOptions(course_sd_deg=(2.0, 2.0, 3.0))
KIND = "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp)\n"
PROGRAM = (
    "% program   : RTKLIB ver.2.4.3 b34\n% obs start : 2015/06/01 00:00:00.0 GPST (week1847)\n"
)
NAMES = (
    "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)"
    "  sdeu(m)  sdun(m) age(s)  ratio"
)
# The first row is that of the format's description; the second has negative covariances.
CELLS = tuple(
    " ".join(cells)
    for cells in (
        (
            "47.480954411   19.056534073   181.7826   5   9   2.1245   1.9103   3.7333",
            "0.1328",
            "0.9211   1.1049   0.00    0.0",
        ),
        (
            "47.480964411   19.056534073   181.8826   1   9   0.0130   0.0110   0.0250",
            "-0.0050",
            "0.0070  -0.0090   0.00    9.9",
        ),
    )
)
FIRST_S = datetime(2015, 6, 1, tzinfo=UTC).timestamp() - 16.0  # 16 s until the end of June 2015


def read_rtklib(path: Path, options: TrajectoryFileOptions) -> Epochs:
    return rtklib.read(ForeignFile(path, "[vehicle] trajectory"), options, "EPSG:4979")


def write(folder: Path, rows: tuple[str, ...], names: str = NAMES, clock: str = "GPST") -> Path:
    path = folder / "vehicle.pos"
    header = f"{PROGRAM}{KIND}%\n%  {clock}                  {names}\n"
    path.write_text(header + "".join(f"{row}\n" for row in rows), encoding="utf-8")
    return path


def calendar_rows() -> tuple[str, ...]:
    return (f"2015/06/01 00:00:00.000   {CELLS[0]}", f"2015/06/01 00:00:00.200   {CELLS[1]}")


def test_a_literal_rtklib_sample_is_read(tmp_path: Path) -> None:
    epochs = read_rtklib(write(tmp_path, calendar_rows()), COURSE)
    assert_allclose(epochs.time_s, [FIRST_S, FIRST_S + 0.2], atol=1e-6)
    assert_allclose(epochs.position[0], [19.056534073, 47.480954411, 181.7826], rtol=0, atol=1e-12)
    assert epochs.crs == "EPSG:4979"
    assert epochs.attitude_deg is None
    assert epochs.cov_position_m2 is not None
    # east, north, up; each covariance is its root squared, with the root's sign
    expected = [
        [0.0110**2, -(0.0050**2), 0.0070**2],
        [-(0.0050**2), 0.0130**2, -(0.0090**2)],
        [0.0070**2, -(0.0090**2), 0.0250**2],
    ]
    assert_allclose(epochs.cov_position_m2[1], expected, rtol=1e-12)
    assert epochs.sd_position_m is not None
    assert_allclose(epochs.sd_position_m[0], [1.9103, 2.1245, 3.7333], rtol=1e-12)


@pytest.mark.parametrize(
    ("clock", "row_clock", "unix_s"),
    [
        ("GPST", "2017/01/01 00:00:16.000", datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC)),
        ("GPST", "2017/01/01 00:00:18.000", datetime(2017, 1, 1, tzinfo=UTC)),
        ("UTC", "2019/08/05 23:59:59.500", datetime(2019, 8, 5, 23, 59, 59, 500000, tzinfo=UTC)),
        ("JST", "2019/08/06 00:00:00.000", datetime(2019, 8, 5, 15, tzinfo=UTC)),
        ("GPST", "1847  86400.000", datetime(2015, 5, 31, 23, 59, 44, tzinfo=UTC)),
        ("UTC", "1847  86400.000", datetime(2015, 6, 1, tzinfo=UTC)),
        ("JST", "1847  86400.000", datetime(2015, 5, 31, 15, tzinfo=UTC)),
    ],
)
def test_times_of_all_time_systems_are_converted(
    tmp_path: Path, clock: str, row_clock: str, unix_s: datetime
) -> None:
    later = "2030" if row_clock.startswith("1847") else "2026/06/01"
    second = f"{later} 0.0" if later == "2030" else f"{later} 00:00:00.000"
    rows = (f"{row_clock}  {CELLS[0]}", f"{second}  {CELLS[1]}")
    epochs = read_rtklib(write(tmp_path, rows, clock=clock), COURSE)
    assert epochs.time_s[0] == pytest.approx(unix_s.timestamp(), abs=1e-6)


@pytest.mark.parametrize("separator", ["   ", ",", ";", "\t", ", "])
@pytest.mark.parametrize("clock", ["2015/06/01 00:00:00.{}00", "1847{sep}86400.{}"])
def test_all_separators_of_rtklib_are_read(tmp_path: Path, separator: str, clock: str) -> None:
    def row(tenths: int, cells: str) -> str:
        time = clock.format(tenths, sep=separator)
        return separator.join((time, *cells.split()))

    rows = (row(0, CELLS[0]), row(2, CELLS[1]))
    names = separator.join(NAMES.split())
    epochs = read_rtklib(write(tmp_path, rows, names), COURSE)
    assert_allclose(epochs.time_s, [FIRST_S, FIRST_S + 0.2], atol=1e-6)
    assert_allclose(epochs.position[1], [19.056534073, 47.480964411, 181.8826], rtol=0, atol=1e-12)


def test_gps_weeks_may_change_within_the_file(tmp_path: Path) -> None:
    rows = tuple(f"{clock} {CELLS[0]}" for clock in ("1846 604799.8", "1847 0.0", "1847 0.2"))
    epochs = read_rtklib(write(tmp_path, rows), COURSE)
    assert_allclose(np.diff(epochs.time_s), 0.2, atol=1e-6)
    stale = tuple(f"{clock} {CELLS[0]}" for clock in ("1846 604799.8", "1846 0.0", "1846 0.2"))
    assert_allclose(read_rtklib(write(tmp_path, stale), COURSE).time_s, epochs.time_s)


def test_degrees_minutes_seconds_and_velocity_columns_are_read(tmp_path: Path) -> None:
    names = NAMES.replace("latitude(deg)", "latitude(d'\")").replace(
        "longitude(deg)", "longitude(d'\")"
    )
    tail = " ".join(CELLS[0].split()[2:])
    velocities = " vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
    more = " 1.0 2.0 0.1 0.01 0.01 0.02 0.0 0.0 0.0"
    rows = tuple(
        f"2015/06/01 00:00:0{second}.000  -0 30 36.00000   -3 45 18.00000  {tail}{more}"
        for second in (0, 1)
    )
    epochs = read_rtklib(write(tmp_path, rows, names + velocities), COURSE)
    # a latitude of -0 degrees is south of the equator
    assert_allclose(epochs.position[0], [-3.755, -0.51, 181.7826], rtol=0, atol=1e-12)
    assert epochs.sd_position_m is not None
    assert_allclose(epochs.sd_position_m[0], [1.9103, 2.1245, 3.7333])


def test_ecef_has_its_own_axes(tmp_path: Path) -> None:
    names = NAMES.replace(
        "latitude(deg) longitude(deg)  height(m)", "x-ecef(m) y-ecef(m) z-ecef(m)"
    )
    for old, new in (("sdne", "sdxy"), ("sdeu", "sdyz"), ("sdun", "sdzx")):
        names = names.replace(old, new)
    for old, new in (("sdn(", "sdx("), ("sde(", "sdy("), ("sdu(", "sdz(")):
        names = names.replace(old, new)
    # On the equator at 90 degrees east: X is west, Y is up, Z is north.
    tail = "1 9 0.010 0.020 0.030 0.004 -0.005 -0.006 0 0"
    rows = tuple(
        f"2015/06/01 00:00:0{second}.0 0.0 6378237.0 {north} {tail}"
        for second, north in ((0, 0.0), (1, 9.0))
    )
    trajectory = read_trajectory(write(tmp_path, rows, names), "EPSG:4979", COURSE)
    assert_allclose(trajectory.position_map[0], [90.0, 0.0, 100.0], atol=1e-6)
    assert trajectory.cov_position_m2 is not None
    xy, yz, zx = 0.004**2, -(0.005**2), -(0.006**2)
    expected = [
        [0.010**2, -zx, -xy],  # east = -X
        [-zx, 0.030**2, yz],  # north = Z
        [-xy, yz, 0.020**2],  # up = Y
    ]
    assert_allclose(trajectory.cov_position_m2[0], expected, atol=1e-12)


def test_covariances_are_rotated_from_true_to_grid_north(tmp_path: Path) -> None:
    # 7.6 degrees east of the zone's meridian, to have a convergence worth the name
    rows = tuple(
        f"2015/06/01 00:00:0{second}.0 60.0 {16.6 + second * 1e-5} 100.0 1 9"
        " 0.010 0.050 0.020 0.0 0.0 0.0 0 0"
        for second in (0, 1)
    )
    trajectory = read_trajectory(write(tmp_path, rows), "EPSG:25832", COURSE)
    angle = np.radians(Proj("EPSG:25832").get_factors(16.6, 60.0).meridian_convergence)
    assert np.degrees(angle) == pytest.approx(6.6, abs=0.1)  # 7.6 · sin 60
    assert trajectory.cov_position_m2 is not None
    # grid north lies east of true north by the convergence
    grid = np.array(
        [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    expected = grid.T @ np.diag([0.05**2, 0.01**2, 0.02**2]) @ grid
    assert_allclose(trajectory.cov_position_m2[0], expected, atol=1e-9)
    assert trajectory.sd_position_m is not None
    assert_allclose(trajectory.sd_position_m[0] ** 2, np.diag(expected), atol=1e-9)


def _printed_root(value: float) -> str:
    return f"{np.copysign(np.sqrt(abs(value)), value):.4f}"


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(
    root=arrays(np.float64, (3, 3), elements=st.floats(-0.2, 0.2)),
    longitude=st.floats(-180.0, 180.0),
    latitude=st.floats(-89.0, 89.0),
)
def test_covariances_survive_the_rounding_to_tenths_of_a_millimetre(
    tmp_path: Path, root: FloatArray, longitude: float, latitude: float
) -> None:
    cov = root @ root.T  # of east, north, up; often close to singular
    cells = " ".join(
        _printed_root(cov[place]) for place in ((1, 1), (0, 0), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    rows = tuple(
        f"2015/06/01 00:00:0{second}.0 {latitude:.9f} {longitude:.9f} 1.5 2 9 {cells} 0 0"
        for second in (0, 1)
    )
    epochs = read_rtklib(write(tmp_path, rows), COURSE)
    assert_allclose(epochs.position[1], [longitude, latitude, 1.5], rtol=0, atol=1e-9)
    assert epochs.cov_position_m2 is not None
    assert np.linalg.eigvalsh(epochs.cov_position_m2[0]).min() >= -1e-15
    # c = r², so that rounding r by 0.05 mm moves c by 2 r · 0.05 mm, and the repair by as much
    assert_allclose(epochs.cov_position_m2[0], cov, atol=6 * 0.35 * 1e-4)


@pytest.mark.parametrize(
    ("rows", "names", "words"),
    [
        ((calendar_rows()[0], "2015/06/01 00:00:01.000 47.4 19.0"), NAMES, ("line 7", "2 cells")),
        ((calendar_rows()[0], f"2015-06-01 00:00:01 {CELLS[0]}"), NAMES, ("line 7", "not a time")),
        ((calendar_rows()[0], calendar_rows()[0]), NAMES, ("line 7", "repeats", "line 6")),
        (calendar_rows()[::-1], NAMES, ("line 7", "before", "line 6")),
        (calendar_rows()[:1], NAMES, ("1 epochs",)),
        ((), NAMES, ("0 epochs",)),
        (
            (calendar_rows()[0], calendar_rows()[1].replace("181.8826", "nan")),
            NAMES,
            ("line 7", "not finite"),
        ),
        (
            calendar_rows(),
            NAMES.replace(
                "latitude(deg) longitude(deg)  height(m)",
                "e-baseline(m) n-baseline(m) u-baseline(m)",
            ),
            ("vectors from a base", "out-solformat = llh"),
        ),
        (calendar_rows(), NAMES.replace("height(m)", "alt(m)"), ("lacks height",)),
    ],
)
def test_wrong_files_are_a_one_line_error(
    tmp_path: Path, rows: tuple[str, ...], names: str, words: tuple[str, ...]
) -> None:
    with pytest.raises(KgcpError) as caught:
        read_rtklib(write(tmp_path, rows, names), COURSE)
    message = str(caught.value)
    assert "\n" not in message
    for word in ("vehicle.pos", *words):
        assert word in message


def test_a_file_without_its_header_is_recognised_and_refused(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.pos"
    path.write_text("\n".join(calendar_rows()) + "\n", encoding="utf-8")
    with pytest.raises(
        KgcpError, match=r"lacks the header line .*out-outhead.* put that of another"
    ):
        read_trajectory(path, "EPSG:25832", COURSE)


@pytest.mark.parametrize("kind", ["WGS84/geodetic", "Tokyo/ellipsoidal"])
def test_heights_of_an_unknown_geoid_and_other_datums_are_refused(
    tmp_path: Path, kind: str
) -> None:
    path = write(tmp_path, calendar_rows())
    path.write_text(path.read_text().replace("WGS84/ellipsoidal", kind))
    with pytest.raises(
        KgcpError, match=f"as {kind}, .*out-height = ellipsoidal.*\\[vehicle\\] crs"
    ):
        read_rtklib(path, COURSE)
    named = TrajectoryFileOptions(crs="EPSG:4301", course_sd_deg=(1.0, 1.0, 1.0))
    assert read_rtklib(path, named).crs == "EPSG:4301"


def test_a_file_without_attitude_is_refused_unless_the_course_is_to_be_used(tmp_path: Path) -> None:
    path = write(tmp_path, calendar_rows())
    with pytest.raises(KgcpError, match=r'no attitude.*attitude = "course" and sd_attitude_deg'):
        read_trajectory(path, "EPSG:25834", TrajectoryFileOptions(format="rtklib"))
    with pytest.raises(KgcpError, match=r"\[vehicle\] time_system: has no meaning .* rtklib"):
        read_trajectory(path, "EPSG:25834", TrajectoryFileOptions(time_system=TimeSystem.GPS))
