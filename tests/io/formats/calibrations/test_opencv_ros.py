from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Response
from kgcp.io.flight.flight import read_flight
from kgcp.io.formats.calibrations import read_calibration

MATRIX = np.array([[2300.5, 0.0, 803.25], [0.0, 2304.5, 594.75], [0.0, 0.0, 1.0]])
PLUMB_BOB = [-0.06, 0.07, -0.0003, 0.0005, 0.011]
RATIONAL = [*PLUMB_BOB, 0.1, 0.02, 0.003]
SILENT = (None, None)

ROS = """\
image_width: 1600
image_height: 1200
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [2300.5, 0, 803.25, 0, 2304.5, 594.75, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.06, 0.07, -0.0003, 0.0005, 0.011]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


def opencv_file(
    path: Path,
    coefficients: list[float],
    size: tuple[str, str] | None = ("image_width", "image_height"),
    matrix: np.ndarray[tuple[int, int], np.dtype[np.float64]] = MATRIX,
    keys: tuple[str, str] = ("camera_matrix", "distortion_coefficients"),
) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if size is not None:
        storage.write(size[0], 1600)
        storage.write(size[1], 1200)
    storage.write(keys[0], matrix)
    storage.write(keys[1], np.array([coefficients]))
    storage.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
@pytest.mark.parametrize(
    "coefficients", [PLUMB_BOB[:4], PLUMB_BOB, RATIONAL, [*RATIONAL, *[0.0] * 4]]
)
def test_opencv_files_project_as_opencv_does(
    tmp_path: Path, suffix: str, coefficients: list[float]
) -> None:
    path = opencv_file(tmp_path / f"camera.{suffix}", coefficients)
    camera = read_calibration(path, SILENT)
    points = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 1.9], [0.01, 0.6, 2.2]])
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients)
    )
    assert (camera.width, camera.height) == (1600, 1200)
    np.testing.assert_allclose(camera.project(points), expected.reshape(-1, 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "keys",
    [
        ("Camera_Matrix", "Distortion_Coefficients"),
        ("cameraMatrix", "distCoeffs"),
        ("K", "D"),
        ("camera_matrix", "dist_coefs"),
    ],
)
def test_the_key_names_of_opencv_s_samples_are_accepted(
    tmp_path: Path, keys: tuple[str, str]
) -> None:
    path = opencv_file(
        tmp_path / "camera.yml", PLUMB_BOB, ("image_Width", "image_Height"), keys=keys
    )
    camera = read_calibration(path, SILENT)
    assert (camera.fx, camera.k3, camera.height) == (2300.5, 0.011, 1200)


def test_the_header_of_older_opencv_files_is_accepted(tmp_path: Path) -> None:
    path = opencv_file(tmp_path / "camera.yml", PLUMB_BOB)
    path.write_text(path.read_text().replace("%YAML 1.2", "%YAML:1.0"))
    assert read_calibration(path, SILENT).cy == 594.75


def test_ros_camera_info_is_the_same_camera(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(ROS)
    opencv = opencv_file(tmp_path / "opencv.yml", PLUMB_BOB)
    assert read_calibration(path, SILENT) == read_calibration(opencv, SILENT)


def test_the_image_size_may_be_stated_in_flight_toml_and_must_agree(tmp_path: Path) -> None:
    silent = opencv_file(tmp_path / "silent.yml", PLUMB_BOB, None)
    assert read_calibration(silent, (1601, 1201)).width == 1601
    with pytest.raises(KgcpError, match=r"silent.yml: has no image size; add width and height"):
        read_calibration(silent, (1600, None))
    sized = opencv_file(tmp_path / "sized.yml", PLUMB_BOB)
    assert read_calibration(sized, (1600, None)).height == 1200
    with pytest.raises(KgcpError, match=r"1600 x 1200 px, but \[camera\] says 1600 x 900"):
        read_calibration(sized, (None, 900))


def test_an_unknown_distortion_model_is_refused(tmp_path: Path) -> None:
    path = opencv_file(tmp_path / "camera.yml", PLUMB_BOB, keys=("camera_matrix", "kc"))
    with pytest.raises(KgcpError, match="has no distortion_coefficients; give them this name"):
        read_calibration(path, SILENT)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is not a calibration of a known format"),
        ("just words", "is not a calibration of a known format"),
        ("[1, 2]", "is not a calibration of a known format"),
        ("a: [1", "is not a calibration of a known format"),
        ("%YAML:1.0\n---\ncamera_matrix: [1,2\n", "is not an OpenCV FileStorage"),
        ("<?xml version='1.0'?><opencv_storage>", "is not an OpenCV FileStorage"),
        ("%YAML:1.0\n---\nimage_width: 3\n", "has no camera_matrix; add it"),
        ("%YAML:1.0\n---\nfisheye_model: 1\nimage_width: 3\n", "has a fisheye model"),
        (ROS.replace("plumb_bob", "equidistant"), "distortion model 'equidistant'"),
        (ROS.replace("2300.5, 0,", "2300.5, 2,"), "a skew of 2"),
        (ROS.replace("2300.5, 0,", "-2300.5, 0,"), "fx: -2300.5 px is out of range"),
        (ROS.replace("0, 0, 1]\ndist", "0, 0, 2]\ndist"), "is not of the form fx 0 cx"),
        (ROS.replace(", 594.75, 0, 0, 1]", "]"), "is not a camera_info of ROS"),
        (ROS.replace(", 0.011]", ", 0.011, 1]"), "distortion: has 6 numbers"),
        (ROS.replace("0.011]", ".nan]"), "k3: is not a finite number"),
        (ROS.replace("image_width: 1600\n", ""), "is not a camera_info of ROS \\('image_width'\\)"),
    ],
)
def test_other_files_and_models_are_refused(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(content)
    with pytest.raises(KgcpError, match=words) as caught:
        read_calibration(path, SILENT)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_thin_prism_terms_are_refused(tmp_path: Path) -> None:
    path = opencv_file(tmp_path / "camera.yml", [*RATIONAL, 0.0, 0.001, 0.0, 0.0])
    with pytest.raises(KgcpError, match="has terms of a thin prism"):
        read_calibration(path, SILENT)


def test_flight_toml_names_the_file_and_adds_what_it_lacks(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    opencv_file(tmp_path / "camera.yml", PLUMB_BOB)
    target = (
        '[[target]]\nname = "A"\nouter_diameter_m = 0.9\ninner_diameter_m = 0.45\n'
        "code_diameter_m = 0.642857143\ndot_diameter_m = 0.128571429\ncode_deg = [0, 43, 78]\n"
    )
    flight = '[camera]\nfile = "camera.yml"\nresponse = "srgb"\n'
    toml = tmp_path / "flight.toml"
    toml.write_text(flight + target)
    camera = read_flight(tmp_path).camera
    assert (camera.fx, camera.k3, camera.response) == (2300.5, 0.011, Response.SRGB)
    toml.write_text(flight + "fx = 2300\n" + target)
    with pytest.raises(
        KgcpError, match=r"\[camera\] fx: is given beside a calibration file; delete"
    ):
        read_flight(tmp_path)
    toml.write_text(flight.replace("camera.yml", "none.yml") + target)
    with pytest.raises(KgcpError, match=r"\[camera\] file: 'none.yml' does not exist; create"):
        read_flight(tmp_path)
