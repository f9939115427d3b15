"""The sample flight with its trajectory in other formats: the same positions, up to rounding."""

from __future__ import annotations

import csv
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.target_positions import TargetPosition
from kgcp.io.files.time_text import parse_time
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import read_flight
from kgcp.io.formats.frame_times import read_times

SAMPLE = Path(__file__).resolve().parents[3] / "sample_flight"
COURSE = 'attitude = "course"\nsd_attitude_deg = [2, 2, 3]'
WEEK_S = 604800.0
GPS_AHEAD_S = 18.0
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@pytest.fixture(scope="module")
def vehicle() -> dict[str, FloatArray]:
    """The columns of vehicle.csv, longitude and latitude added."""
    with (SAMPLE / "vehicle.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    columns = {
        name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "time"
    }
    columns["time"] = np.array([parse_time(row["time"]) for row in rows])
    geographic = Transformer.from_crs(CRS("EPSG:25832").to_3d(), "EPSG:4979", always_xy=True)
    columns["lon"], columns["lat"], columns["h"] = geographic.transform(
        columns["x"], columns["y"], columns["z"]
    )
    return columns


def places(folder: Path, keys: str) -> tuple[FloatArray, FloatArray]:
    """Positions in the map and covariances of the target at all frame times of the sample."""
    text = (SAMPLE / "flight.toml").read_text().replace('trajectory = "vehicle.csv"', keys)
    (folder / "flight.toml").write_text(text)
    (folder / "frames").mkdir(exist_ok=True)
    shutil.copy(SAMPLE / "frames.csv", folder)
    shutil.copy(SAMPLE / "vehicle.csv", folder)
    target_positions = FlightData(read_flight(folder), ()).target_positions
    times = list(read_times(SAMPLE / "frames.csv", []).time_s.values())
    found = [
        p
        for p in target_positions.positions(["A"] * len(times), times)
        if isinstance(p, TargetPosition)
    ]
    assert len(found) == len(times)
    enu = np.array([position.position_m for position in found])
    return target_positions.local_frame.map_from_enu(enu), np.array(
        [position.cov_m2 for position in found]
    )


def test_an_sbet_is_read_with_its_accuracies(
    tmp_path: Path, vehicle: dict[str, FloatArray]
) -> None:
    gps = vehicle["time"] + GPS_AHEAD_S - datetime(1980, 1, 6, tzinfo=UTC).timestamp()
    zeros = np.zeros_like(gps)
    angles = [np.radians(vehicle[name]) for name in ("lat", "lon")]
    attitude = [np.radians(vehicle[f"{name}_deg"]) for name in ("roll", "pitch", "heading")]
    columns = [gps % WEEK_S, *angles, vehicle["h"], *[zeros] * 3, *attitude, *[zeros] * 7]
    np.column_stack(columns).astype("<f8").tofile(tmp_path / "sbet.out")
    sds = [vehicle[f"sd_{name}"] for name in ("y", "x", "z")]
    minutes = [60.0 * vehicle[f"sd_{name}_deg"] for name in ("roll", "pitch", "heading")]
    accuracies = np.column_stack([gps % WEEK_S, *sds, *[zeros] * 3, *minutes])
    accuracies.astype("<f8").tofile(tmp_path / "smrmsg.out")
    found = places(
        tmp_path,
        'trajectory = "sbet.out"\naccuracies = "smrmsg.out"\ntime_system = "gps"\n'
        "date = 2026-06-16",
    )
    expected = places(tmp_path, 'trajectory = "vehicle.csv"')
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=2e-6)
    # the same horizontal deviations in x and y: turning by the convergence changes nothing
    np.testing.assert_allclose(found[1], expected[1], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("clock", "ahead_s"), [("GPST", 18.0), ("UTC", 0.0), ("JST", 32400.0)])
def test_rtklib_positions_are_read_with_the_course_as_heading(
    tmp_path: Path, vehicle: dict[str, FloatArray], clock: str, ahead_s: float
) -> None:
    lines = [
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)",
        f"%  {clock}  latitude(deg) longitude(deg) height(m) Q ns sdn sde sdu sdne sdeu sdun",
    ]
    for index, time_s in enumerate(vehicle["time"]):
        moment = _EPOCH + timedelta(microseconds=round(1e6 * (time_s + ahead_s)))
        row = {name: column[index] for name, column in vehicle.items()}
        lines.append(
            f"{moment:%Y/%m/%d %H:%M:%S.%f} {row['lat']:.11f} {row['lon']:.11f} {row['h']:.5f}"
            f" 1 9 {row['sd_y']:.4f} {row['sd_x']:.4f} {row['sd_z']:.4f} 0 0 0"
        )
    (tmp_path / "rover.pos").write_text("\n".join(lines) + "\n")
    found = places(tmp_path, f'trajectory = "rover.pos"\n{COURSE}')
    expected = places(tmp_path, f'trajectory = "vehicle.csv"\n{COURSE}')
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=2e-5)  # 1e-5 m, 1e-11 deg
    np.testing.assert_allclose(found[1], expected[1], rtol=0, atol=1e-7)
    exact, _ = places(tmp_path, 'trajectory = "vehicle.csv"')
    off = np.abs(found[0] - exact)
    sd = np.sqrt(np.diagonal(found[1], axis1=1, axis2=2))
    assert 0.001 < np.abs(off[:, :2]).max() < 0.1  # the error of assuming roll and pitch of 0
    assert (off[:, :2] < 3.0 * sd[:, :2]).all()
