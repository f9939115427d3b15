from __future__ import annotations

import csv

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.io.exporters import plain_csv
from kgcp.io.exporters.points import MapPoints


def _cov(row: dict[str, str], names: list[str], pairs: dict[tuple[int, int], str]) -> FloatArray:
    cov = np.diag([float(row[name]) ** 2 for name in names])
    for (i, j), name in pairs.items():
        cov[i, j] = cov[j, i] = float(row[name])
    return cov


def test_csv_has_every_observation_with_its_covariance(points: MapPoints) -> None:
    rows = [*csv.DictReader(plain_csv.files(points)["kgcps.csv"].splitlines())]
    assert len(rows) == len(points.gcps)
    for row, point in zip(rows, points.gcps, strict=True):
        assert (row["id"], row["frame"], row["crs"]) == (point.id, point.frame, "EPSG:25831")
        got = [float(row[name]) for name in ("x", "y", "z", "x_px", "y_px", "distance_m")]
        expected = [*point.position_map, *point.centre_px, point.distance_m]
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)
        assert row["role"] == ("check" if point.is_checkpoint else "control")
        assert point.cov_m2 is not None
        assert point.centre_cov_px2 is not None
        place = {(0, 1): "cov_xy", (0, 2): "cov_xz", (1, 2): "cov_yz"}
        cov = _cov(row, ["sd_x", "sd_y", "sd_z"], place)
        np.testing.assert_allclose(cov, point.cov_m2, rtol=1e-5)
        cov_px = _cov(row, ["sd_x_px", "sd_y_px"], {(0, 1): "cov_xy_px2"})
        np.testing.assert_allclose(cov_px, point.centre_cov_px2, rtol=1e-5)
