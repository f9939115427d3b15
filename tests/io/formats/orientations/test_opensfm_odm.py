"""Poses of OpenSfM and OpenDroneMap, in worlds over a point and in UTM."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, rotation_from_opk
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.orientations.records import OrientationFileOptions

NAMES = tuple(f"DJI_{index:04d}.JPG" for index in range(7))
Truth = Mapping[str, FloatArray]
Check = Callable[[ReferencePoses, FloatArray, FloatArray], None]
Invert = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
Part = dict[str, Any]

UTM = OrientationFileOptions(crs="EPSG:32631")
OFFSET = np.array([299_000.0, 4_585_000.0, 0.0])


def reconstruction(rotation: FloatArray, shift: FloatArray, lla: FloatArray) -> Part:
    rotvec = Rotation.from_matrix(rotation).as_rotvec()
    shots = {
        name: {"rotation": list(r), "translation": list(t), "camera": "c", "gps_dop": 5.0}
        for name, r, t in zip(NAMES, rotvec, shift, strict=True)
    }
    reference = {"longitude": lla[0], "latitude": lla[1], "altitude": lla[2]}
    return {"cameras": {}, "shots": shots, "points": {}, "reference_lla": reference}


@pytest.fixture
def topocentric(truth: Truth, world_to_camera: Invert) -> Part:
    """East, north, up over a point 2 km from the flight."""
    from_ecef = Rotation.from_euler("ZX", [90 + 0.645, 90 - 41.4], degrees=True).as_matrix().T
    origin = np.array([0.645, 41.4, 300.0])
    centre = (truth["ecef"] - np.array(geocentric(*origin))) @ from_ecef.T
    rotation, shift = world_to_camera(centre, from_ecef @ truth["ecef_from_photo"])
    return reconstruction(rotation, shift, origin)


def geocentric(lon_deg: float, lat_deg: float, height: float) -> tuple[float, float, float]:
    """The textbook's formula, on WGS 84."""
    lon, lat, e2 = np.radians(lon_deg), np.radians(lat_deg), 0.0066943799901413165
    normal = 6378137.0 / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    level = (normal + height) * np.cos(lat)
    return level * np.cos(lon), level * np.sin(lon), (normal * (1 - e2) + height) * np.sin(lat)


def test_opensfm_coordinates_are_a_level_frame_at_the_reference(
    tmp_path: Path, truth: Truth, check: Check, topocentric: Part
) -> None:
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps([topocentric]))
    poses = read_reference_poses(path, crs="EPSG:32631")
    assert poses.frames == NAMES
    check(poses, truth["utm"], truth["utm_from_photo"])
    degrees = read_reference_poses(path, crs="EPSG:4326")
    np.testing.assert_allclose(degrees.position_map, truth["geodetic"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        rotation_from_opk(degrees.opk_deg), truth["enu_from_photo"], rtol=0, atol=1e-9
    )


def test_the_reference_may_be_in_a_file_beside_and_must_be_common(
    tmp_path: Path, truth: Truth, check: Check, topocentric: Part
) -> None:
    path = tmp_path / "reconstruction.json"
    reference = topocentric.pop("reference_lla")
    path.write_text(json.dumps([topocentric]))
    with pytest.raises(KgcpError, match=r"has no reference_lla, nor has reference_lla.json beside"):
        read_reference_poses(path, crs="EPSG:32631")
    (tmp_path / "reference_lla.json").write_text(json.dumps(reference))
    check(read_reference_poses(path, crs="EPSG:32631"), truth["utm"], truth["utm_from_photo"])
    other = {"shots": {}, "reference_lla": {**reference, "altitude": 1.0}}
    path.write_text(json.dumps([{**topocentric, "reference_lla": reference}, other]))
    with pytest.raises(KgcpError, match="reconstructions of different reference_lla"):
        read_reference_poses(path, crs="EPSG:32631")


def test_opendronemap_s_overwritten_file_is_read_as_utm_minus_an_offset(
    tmp_path: Path, truth: Truth, check: Check, world_to_camera: Invert, topocentric: Part
) -> None:
    rotation, shift = world_to_camera(truth["utm"] - OFFSET, truth["utm_from_photo"])
    written = reconstruction(rotation, shift, truth["geodetic"][0])
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps([written]))
    original = tmp_path / "reconstruction.topocentric.json"
    original.write_text(json.dumps([topocentric]))
    with pytest.raises(KgcpError, match="may hold OpenDroneMap's UTM coordinates: reconstr"):
        read_reference_poses(path, crs="EPSG:32631")
    check(read_reference_poses(original, crs="EPSG:32631"), truth["utm"], truth["utm_from_photo"])
    offset = tmp_path / "coords.txt"
    offset.write_text("WGS84 UTM 31N\n299000.0 4585000.0\n12.5 7.5 512.25\n")
    options = OrientationFileOptions("opensfm", "EPSG:32631", offset)
    check(
        read_reference_poses(path, options, crs="EPSG:32631"),
        truth["utm"],
        truth["utm_from_photo"],
    )


@pytest.mark.parametrize(
    ("shot", "words"),
    [
        ({"rotation": [0, 0, 0]}, r"\[0\] shots a.JPG: has no 'translation'"),
        ({"rotation": [0, 0], "translation": [1, 2, 3]}, "'rotation' is not a list of 3 numbers"),
        ({"rotation": [0, 0, "1"], "translation": [1, 2, 3]}, "'rotation' is '1', not a finite"),
    ],
)
def test_an_incomplete_shot_is_named(tmp_path: Path, shot: Part, words: str) -> None:
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps([{"shots": {"a.JPG": shot}}]))
    with pytest.raises(KgcpError, match=words):
        read_reference_poses(path, UTM, crs="EPSG:32631")


def geojson(truth: Truth, world_to_camera: Invert) -> Part:
    """As opendm/shots.py writes it; `translation` is the projection centre."""
    rotation, _ = world_to_camera(truth["utm"], truth["utm_from_photo"])
    rotvec = Rotation.from_matrix(rotation).as_rotvec()
    features = [
        {
            "type": "Feature",
            "properties": {
                "filename": name,
                "camera": "c",
                "focal": 0.85,
                "translation": list(utm),
                "rotation": list(turn),
            },
            "geometry": {"type": "Point", "coordinates": list(point)},
        }
        for name, utm, turn, point in zip(
            NAMES, truth["utm"], rotvec, truth["geodetic"], strict=True
        )
    ]
    return {"type": "FeatureCollection", "features": features}


def test_shots_are_read_as_centres_in_the_matching_utm_zone(
    tmp_path: Path, truth: Truth, check: Check, world_to_camera: Invert
) -> None:
    path = tmp_path / "shots.geojson"
    collection = geojson(truth, world_to_camera)
    path.write_text(json.dumps(collection))
    check(read_reference_poses(path, crs="EPSG:32631"), truth["utm"], truth["utm_from_photo"])
    degrees = read_reference_poses(path, crs="EPSG:4326")
    np.testing.assert_allclose(degrees.position_map, truth["geodetic"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        rotation_from_opk(degrees.opk_deg), truth["enu_from_photo"], rtol=0, atol=1e-9
    )
    collection["features"][3]["properties"]["translation"][0] += 0.2
    path.write_text(json.dumps(collection))
    with pytest.raises(KgcpError, match=r"has translations that fit no UTM zone near 0\.6"):
        read_reference_poses(path, crs="EPSG:32631")


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude"),
    [
        ("EPSG:32731", 2.5, -23.4),  # south
        ("EPSG:32631", 6.01, 41.4),  # the zone of most frames, though not of this one
        ("EPSG:32660", -179.99, 10.0),  # across the date line
        ("EPSG:32632", 5.3, 60.4),  # Bergen's zone is wider
    ],
)
def test_the_zone_of_shots_is_found(
    tmp_path: Path, crs: str, longitude: float, latitude: float
) -> None:
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    path = tmp_path / "shots.geojson"
    properties = {"filename": "a.jpg", "rotation": [0, 0, 0], "translation": [x, y, 70.0]}
    geometry = {"type": "Point", "coordinates": [longitude, latitude, 70.0]}
    features = [{"type": "Feature", "properties": properties, "geometry": geometry}]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    np.testing.assert_array_equal(read_reference_poses(path, crs=crs).position_map, [[x, y, 70.0]])
