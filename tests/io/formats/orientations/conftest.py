"""A flight whose poses are known on the Earth, to be written in every format."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from pyproj import Proj, Transformer
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, rotation_from_opk

COUNT = 7
CAMERA_FROM_PHOTO = np.diag([1.0, -1.0, -1.0])


def transformed(source: str, target: str, points: FloatArray) -> FloatArray:
    way = Transformer.from_crs(source, target, always_xy=True)
    return np.column_stack(way.transform(*points.T))


def ecef_from_enu(geodetic: FloatArray) -> FloatArray:
    """East, north, up (n, 3, 3) as columns."""
    lon, lat = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    east = np.column_stack((-np.sin(lon), np.cos(lon), 0 * lon))
    up = np.column_stack((np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)))
    return np.stack((east, np.cross(up, east), up), axis=-1)


@pytest.fixture(scope="session")
def truth() -> Mapping[str, FloatArray]:
    """Positions (n, 3) and rotations ← photo (n, 3, 3) in three frames, none of them by kgcp.

    WGS 84 (longitude, latitude, height, axes of each point), UTM zone 31N far from its meridian,
    whose convergence is PROJ's closed formula, and Earth-centred.
    """
    random = np.random.default_rng(5)
    scatter = random.normal(0, 1, (COUNT, 3)) * [3e-3, 2e-3, 20.0]
    geodetic = np.array([0.62, 41.4, 512.0]) + scatter
    enu_from_photo = rotation_from_opk(random.normal(0, 1, (COUNT, 3)) * [6.0, 6.0, 100.0])
    factors = Proj("EPSG:32631").get_factors(geodetic[:, 0], geodetic[:, 1])
    convergence = np.reshape(factors.meridian_convergence, (-1, 1))  # of grid north, to the east
    utm_from_enu = Rotation.from_euler("z", convergence, degrees=True).as_matrix()
    return {
        "geodetic": geodetic,
        "enu_from_photo": enu_from_photo,
        "utm": transformed("EPSG:4979", "EPSG:32631", geodetic),
        "utm_from_photo": utm_from_enu @ enu_from_photo,
        "ecef": transformed("EPSG:4979", "EPSG:4978", geodetic),
        "ecef_from_photo": ecef_from_enu(geodetic) @ enu_from_photo,
    }


@pytest.fixture(scope="session")
def check() -> Callable[[ReferencePoses, FloatArray, FloatArray], None]:
    """Compare poses with positions [m] and rotations map ← photo."""

    def compare(poses: ReferencePoses, position: FloatArray, rotation: FloatArray) -> None:
        np.testing.assert_allclose(poses.position_map, position, rtol=0, atol=1e-6)
        np.testing.assert_allclose(rotation_from_opk(poses.opk_deg), rotation, rtol=0, atol=1e-9)

    return compare


@pytest.fixture(scope="session")
def world_to_camera() -> Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return R and t with p_camera = R p_world + t, of centres and rotations world ← photo."""

    def invert(centre: FloatArray, world_from_photo: FloatArray) -> tuple[FloatArray, FloatArray]:
        rotation = CAMERA_FROM_PHOTO @ np.swapaxes(world_from_photo, 1, 2)
        return rotation, -np.einsum("nij,nj->ni", rotation, centre)

    return invert
