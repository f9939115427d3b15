"""Poses that lead from the world to the camera: COLMAP, OpenSfM, OpenDroneMap."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.reference import ReferencePoses, rotation_from_opk
from kgcp.io.poses import read_reference_poses
from kgcp.io.poses.notation import PoseNotation

NAMES = tuple(f"DJI_{index:04d}.JPG" for index in range(7))
Truth = Mapping[str, FloatArray]
Check = Callable[[ReferencePoses, FloatArray, FloatArray], None]
Invert = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
Part = dict[str, Any]

UTM = PoseNotation(crs="EPSG:32631")
OFFSET = np.array([299_000.0, 4_585_000.0, 0.0])


def colmap_folder(folder: Path, rotation: FloatArray, shift: FloatArray) -> Path:
    """Write a model with pycolmap, whose writer is COLMAP's own."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="PINHOLE", width=1600, height=1100, params=[1700, 1700, 800, 550], camera_id=1
        )
    )
    for number, (name, matrix, vector) in enumerate(zip(NAMES, rotation, shift, strict=True), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(matrix), vector)
        model.add_image_with_trivial_frame(image, pose)
    model.write_text(str(folder))
    return folder / "images.txt"


def test_colmap_s_own_files_in_map_coordinates(
    tmp_path: Path, truth: Truth, check: Check, world_to_camera: Invert
) -> None:
    rotation, shift = world_to_camera(truth["utm"] - OFFSET, truth["utm_from_photo"])
    path = colmap_folder(tmp_path, rotation, shift)
    offset = tmp_path / "offset.xyz"
    offset.write_text("299000.000 4585000.000 0.000\n")
    poses = read_reference_poses(
        path, PoseNotation(crs="EPSG:32631", offset_file=offset), crs="EPSG:32631"
    )
    assert poses.frames == NAMES
    assert (poses.sd_position_m, poses.sd_angle_deg) == (None, None)
    check(poses, truth["utm"], truth["utm_from_photo"])


def test_colmap_in_geocentric_coordinates(
    tmp_path: Path, truth: Truth, check: Check, world_to_camera: Invert
) -> None:
    rotation, shift = world_to_camera(truth["ecef"], truth["ecef_from_photo"])
    path = colmap_folder(tmp_path, rotation, shift)
    poses = read_reference_poses(path, PoseNotation(crs="EPSG:4978"), crs="EPSG:32631")
    check(poses, truth["utm"], truth["utm_from_photo"])


def test_the_quaternion_has_w_first_and_the_points_line_may_be_empty(tmp_path: Path) -> None:
    # A quarter turn about z: the camera's x is the world's −y, its centre −Rᵀ t.
    half = 0.7071067811865476
    path = tmp_path / "images.txt"
    path.write_text(
        "# Image list with two lines of data per image:\n"
        f"4 {half} 0 0 {half} 1 2 3 1 sub dir/a b.JPG\n"
        "\n"
        f"9 {half} 0 0 {half} 1 2 3 1 c.JPG\n"
        "612.5 80.25 -1 70 80 5\n"
    )
    poses = read_reference_poses(path, UTM, crs="EPSG:32631")
    assert poses.frames == ("sub dir/a b.JPG", "c.JPG")
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(poses.position_map[0], -rotation.T @ [1, 2, 3], atol=1e-12)
    expected = rotation.T @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(rotation_from_opk(poses.opk_deg)[0], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "notation", "words"),
    [
        ("1 1 0 0 0 1 2 3 1 a.JPG\n\n", None, "is in a world of COLMAP's, which is no map; align"),
        ("1 1 0 0 0 1 2 3 1 a.JPG\nb\nc\n", UTM, "line 3: is not IMAGE_ID QW QX QY QZ"),
        ("1 0 0 0 0 1 2 3 1 a.JPG\n\n", UTM, "line 1: has a quaternion of zeros"),
        ("1 1 0 0 0 1 2 e 1 a.JPG\n\n", UTM, "line 1: holds '1 1 0 0 0 1 2 e' instead of 8"),
        (
            "1 1 0 0 0 1 2 3 1 a.JPG\n\n",
            PoseNotation(crs="EPSG:4326"),
            r"\[reference\] crs 'EPSG:4326' counts degrees, but the poses are in a Cartesian",
        ),
        (
            "1 1 0 0 0 1 2 3 1 a.JPG\n\n",
            PoseNotation(crs="EPSG:0"),
            r"flight.toml: \[reference\] crs 'EPSG:0' cannot be used",
        ),
    ],
)
def test_a_colmap_model_without_a_map_is_refused(
    tmp_path: Path, text: str, notation: PoseNotation | None, words: str
) -> None:
    path = tmp_path / "images.txt"
    path.write_text(text)
    with pytest.raises(KgcpError, match=words) as caught:
        read_reference_poses(path, notation, crs="EPSG:32631")
    assert "\n" not in str(caught.value)


# --- OpenSfM


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


def test_opensfm_s_world_is_level_over_its_reference(
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


def test_the_reference_may_stand_beside_and_reconstructions_must_share_it(
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


def test_opendronemap_s_overwritten_file_is_utm_less_an_offset(
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
    notation = PoseNotation("opensfm", "EPSG:32631", offset)
    check(
        read_reference_poses(path, notation, crs="EPSG:32631"),
        truth["utm"],
        truth["utm_from_photo"],
    )


@pytest.mark.parametrize(
    ("shot", "words"),
    [
        ({"rotation": [0, 0, 0]}, r"\[0\] shots a.JPG: has no 'translation'"),
        ({"rotation": [0, 0], "translation": [1, 2, 3]}, "'rotation' is no list of 3 numbers"),
        ({"rotation": [0, 0, "1"], "translation": [1, 2, 3]}, "'rotation' is '1', no finite"),
    ],
)
def test_an_incomplete_shot_is_named(tmp_path: Path, shot: Part, words: str) -> None:
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps([{"shots": {"a.JPG": shot}}]))
    with pytest.raises(KgcpError, match=words):
        read_reference_poses(path, UTM, crs="EPSG:32631")


# --- OpenDroneMap's shots.geojson


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


def test_shots_are_centres_in_the_utm_zone_that_fits(
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
    with pytest.raises(KgcpError, match=r"has translations of no UTM zone about 0\.6"):
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
