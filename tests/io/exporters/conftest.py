"""Points of a frame that is not square and has distortion, one of them on its very edge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.camera_priors import CameraPrior
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import MapPoints

Factory = Callable[..., MapPoints]

CAMERA = Camera(
    width=1600,
    height=1201,
    fx=2300.0,
    fy=2310.0,
    cx=801.3,
    cy=597.2,
    k1=-0.08,
    k2=0.01,
    p1=0.001,
    p2=-0.0005,
)
# Of a user's own datum: kgcp must not take it for that of a code with the same ellipsoid.
OWN_DATUM = (
    "+proj=tmerc +lat_0=0 +lon_0=12 +x_0=4500000 +ellps=bessel"
    " +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7 +units=m +type=crs"
)
START = np.array([430606.1234567, 4583523.7654321, 122.3456789])
COV = np.array([[4.0, 1.0, -0.5], [1.0, 9.0, 0.7], [-0.5, 0.7, 16.0]]) * 1e-4
COV_PX = np.array([[9.0, 2.0], [2.0, 4.0]]) * 1e-4
PRIOR_COV = np.diag([0.3, 0.4, 0.1, 0.004, 0.005, 0.006]) ** 2 + 1e-6


def kgcp(number: int, offset: tuple[float, float, float], px: tuple[float, float]) -> Gcp:
    return Gcp(
        id=f"K{number:04d}",
        frame=f"a/IMG_{number}.JPG",
        target="A",
        time_s=1777887000.0 + number,
        position_map=START + np.array(offset),
        cov_m2=COV,
        centre_px=np.array(px),
        centre_cov_px2=COV_PX,
        distance_m=78.123456 + number,
        sd_distance_m=0.0123 + 0.001 * number,
        sd_common_distance_m=0.0123456789,
    )


def default_kgcps() -> tuple[Gcp, ...]:
    edge = kgcp(1, (0.0, 0.0, 0.0), (-0.5, 1200.5))
    other_edge = kgcp(2, (10.125, 5.5, 0.25), (1599.5, -0.5))
    inside = kgcp(3, (21.0000004, 11.0000003, 0.5000001), (812.3456789, 77.7654321))
    twin = replace(kgcp(4, (0.0, 0.0, 0.0), (300.25, 400.75)), position_map=inside.position_map)
    check = replace(kgcp(5, (40.0, 22.0, 1.0), (1000.0, 600.0)), is_checkpoint=True)
    gate = replace(
        kgcp(6, (-30.0, 12.0, -1.5), (200.5, 300.5)), id="north gate", target="north gate"
    )
    again = replace(gate, frame="a/IMG_3.JPG", centre_px=np.array([1111.0, 222.0]))
    return (edge, other_edge, inside, twin, check, gate, again)


def prior(frame: str, offset: tuple[float, float, float], rotvec: FloatArray) -> CameraPrior:
    down = np.diag([1.0, -1.0, -1.0])
    attitude = Rotation.from_rotvec(rotvec).as_matrix() @ down
    return CameraPrior(frame, START + np.array(offset), attitude, PRIOR_COV)


@pytest.fixture
def make_points() -> Factory:
    def make(
        crs: str = "EPSG:25831",
        gcps: tuple[Gcp, ...] | None = None,
        priors: tuple[CameraPrior, ...] = (),
    ) -> MapPoints:
        return MapPoints(crs, default_kgcps() if gcps is None else gcps, CAMERA, priors)

    return make


@pytest.fixture
def points(make_points: Factory) -> MapPoints:
    priors = (
        prior("a/IMG_1.JPG", (3.0, -4.0, 75.0), np.array([0.02, -0.03, 0.6])),
        prior("a/IMG_3.JPG", (23.0, 9.0, 77.0), np.array([-0.05, 0.01, -2.0])),
    )
    return make_points(priors=priors)


@pytest.fixture
def in_degrees(make_points: Factory) -> MapPoints:
    """One point by longitude and latitude."""
    one = replace(default_kgcps()[0], position_map=np.array([2.1701234567, 41.4007654321, 171.25]))
    return make_points("EPSG:4326", (one,))
