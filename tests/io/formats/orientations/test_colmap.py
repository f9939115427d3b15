"""Poses of COLMAP, written by its own library."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, rotation_from_opk
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.orientations.records import OrientationFileOptions

NAMES = tuple(f"DJI_{index:04d}.JPG" for index in range(7))
Truth = Mapping[str, FloatArray]
Check = Callable[[ReferencePoses, FloatArray, FloatArray], None]
Invert = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

UTM = OrientationFileOptions(crs="EPSG:32631")
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


def test_files_written_by_colmap_are_read_in_map_coordinates(
    tmp_path: Path, truth: Truth, check: Check, world_to_camera: Invert
) -> None:
    rotation, shift = world_to_camera(truth["utm"] - OFFSET, truth["utm_from_photo"])
    path = colmap_folder(tmp_path, rotation, shift)
    offset = tmp_path / "offset.xyz"
    offset.write_text("299000.000 4585000.000 0.000\n")
    poses = read_reference_poses(
        path, OrientationFileOptions(crs="EPSG:32631", offset_file=offset), crs="EPSG:32631"
    )
    assert poses.frames == NAMES
    assert (poses.sd_position_m, poses.sd_angle_deg) == (None, None)
    check(poses, truth["utm"], truth["utm_from_photo"])


def test_colmap_models_may_be_geocentric(
    tmp_path: Path, truth: Truth, check: Check, world_to_camera: Invert
) -> None:
    rotation, shift = world_to_camera(truth["ecef"], truth["ecef_from_photo"])
    path = colmap_folder(tmp_path, rotation, shift)
    poses = read_reference_poses(path, OrientationFileOptions(crs="EPSG:4978"), crs="EPSG:32631")
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


def test_images_of_a_rig_have_individual_poses(tmp_path: Path) -> None:
    rig_from_world = pycolmap.Rigid3d(
        pycolmap.Rotation3d(rotation_from_opk(np.array([[-40.0, 5.0, 60.0]]))[0]),
        np.array([1.0, 2.0, 3.0]),
    )
    second_from_rig = pycolmap.Rigid3d(
        pycolmap.Rotation3d(rotation_from_opk(np.array([[10.0, 20.0, 30.0]]))[0]),
        np.array([0.5, 0.1, -0.2]),
    )
    first, second = (pycolmap.sensor_t(pycolmap.SensorType.CAMERA, i) for i in (1, 2))
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    rig.add_ref_sensor(first)
    rig.add_sensor(second, second_from_rig)
    frame.rig_from_world = rig_from_world
    for number, sensor in ((1, first), (2, second)):
        model.add_camera(
            pycolmap.Camera(
                model="SIMPLE_PINHOLE", width=9, height=9, params=[9, 4, 4], camera_id=number
            )
        )
        frame.add_data_id(pycolmap.data_t(sensor, number))
    model.add_rig(rig)
    model.add_frame(frame)
    for number in (1, 2):
        image = pycolmap.Image(name=f"{number}.jpg", camera_id=number, image_id=number)
        image.frame_id = 1
        model.add_image(image)
    model.register_frame(1)
    model.write_text(str(tmp_path))
    poses = read_reference_poses(tmp_path / "images.txt", UTM, crs="EPSG:32631")
    centres = [np.asarray(image.projection_center()) for _, image in sorted(model.images.items())]
    assert np.linalg.norm(centres[1] - centres[0]) > 0.5
    np.testing.assert_allclose(poses.position_map, centres, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "notation", "words"),
    [
        (
            "1 1 0 0 0 1 2 3 1 a.JPG\n\n",
            None,
            "is in COLMAP's own coordinates, which are not those of a map; align",
        ),
        ("1 1 0 0 0 1 2 3 1 a.JPG\nb\nc\n", UTM, "line 3: is not IMAGE_ID QW QX QY QZ"),
        ("1 0 0 0 0 1 2 3 1 a.JPG\n\n", UTM, "line 1: has an invalid quaternion"),
        ("1 1 0 0 0 1 2 e 1 a.JPG\n\n", UTM, "line 1: holds '1 1 0 0 0 1 2 e' instead of 8"),
        (
            "1 1 0 0 0 1 2 3 1 a.JPG\n\n",
            OrientationFileOptions(crs="EPSG:4326"),
            r"\[reference\] crs 'EPSG:4326' is in degrees, but the poses are in a Cartesian",
        ),
        (
            "1 1 0 0 0 1 2 3 1 a.JPG\n\n",
            OrientationFileOptions(crs="EPSG:0"),
            r"flight.toml: \[reference\] crs 'EPSG:0' cannot be used",
        ),
        (
            "1 1 0 0 0 -4001 -2 -4900001 1 a.JPG\n\n",  # a grid's coordinates, cut by their offset
            OrientationFileOptions(crs="EPSG:4978"),
            r"pose of 'a.JPG': has a height of -\d{7}; correct \[reference\] crs",
        ),
    ],
)
def test_a_colmap_model_without_a_map_is_refused(
    tmp_path: Path, text: str, notation: OrientationFileOptions | None, words: str
) -> None:
    path = tmp_path / "images.txt"
    path.write_text(text)
    with pytest.raises(KgcpError, match=words) as caught:
        read_reference_poses(path, notation, crs="EPSG:32631")
    assert "\n" not in str(caught.value)
