"""Camera orientations as CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.georef.camera_priors import opk_covs, opk_deg
from kgcp.io.exporters import camera_priors
from kgcp.io.exporters.points import MapPoints

Factory = Callable[..., MapPoints]


def _text(points: MapPoints) -> str:
    return camera_priors.files(points)["camera_priors/camera_priors.csv"]


def test_camera_priors_have_position_angles_and_covariance(points: MapPoints) -> None:
    rows = [*csv.DictReader(_text(points).splitlines())]
    assert [row["frame"] for row in rows] == ["a/IMG_1.JPG", "a/IMG_3.JPG"]
    names = ("x", "y", "z", "omega_deg", "phi_deg", "kappa_deg")
    for row, prior in zip(rows, points.priors, strict=True):
        xyz = [float(row[name]) for name in "xyz"]
        np.testing.assert_allclose(xyz, prior.position_map, atol=1e-6, rtol=0)
        angles = [float(row[name]) for name in names[3:]]
        np.testing.assert_allclose(angles, opk_deg([prior])[0], atol=1e-6)
        cov = np.diag([float(row[f"sd_{name}"]) ** 2 for name in names])
        for i, first in enumerate(names):
            for j, second in enumerate(names[i + 1 :], start=i + 1):
                cov[i, j] = cov[j, i] = float(row[f"cov_{first}_{second}"])
        (expected,) = opk_covs([prior])
        assert expected is not None
        np.testing.assert_allclose(cov, expected, rtol=1e-7, atol=1e-12)
        assert row["crs"] == "EPSG:25831"


def test_exporting_camera_priors_without_any_is_an_error(make_points: Factory) -> None:
    with pytest.raises(KgcpError, match="no camera can be oriented"):
        camera_priors.files(make_points())
