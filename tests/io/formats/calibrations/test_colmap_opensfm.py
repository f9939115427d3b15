"""COLMAP's cameras against pycolmap, OpenSfM's against its documentation."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.formats.calibrations import read_calibration
from tests.io.formats.calibrations.one_camera import (
    HEIGHT,
    K1,
    K2,
    K3,
    P1,
    P2,
    SILENT,
    WIDTH,
    Brown,
    Check,
    write,
)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [1710.5, 812.25, 541.5]),
        ("PINHOLE", [1710.5, 1702.25, 812.25, 541.5]),
        ("SIMPLE_RADIAL", [1710.5, 812.25, 541.5, K1]),
        ("RADIAL", [1710.5, 812.25, 541.5, K1, K2]),
        ("OPENCV", [1710.5, 1702.25, 812.25, 541.5, K1, K2, P1, P2]),
        (
            "FULL_OPENCV",
            [1710.5, 1702.25, 812.25, 541.5, K1, K2, P1, P2, K3, 0.021, -0.013, 0.004],
        ),
    ],
)
def test_colmap_cameras_project_as_pycolmap_does(
    tmp_path: Path, model: str, params: list[float], check: Check
) -> None:
    reconstruction = pycolmap.Reconstruction()
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=7)
    reconstruction.add_camera(theirs)
    reconstruction.write_text(str(tmp_path))
    camera = read_calibration(tmp_path / "cameras.txt", SILENT)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)

    def expected(points: FloatArray) -> FloatArray:
        return np.asarray(theirs.img_from_cam(points)) - 0.5  # theirs: the corner is (0, 0)

    check(camera, expected)


@pytest.mark.parametrize(
    ("model", "count"),
    [("OPENCV_FISHEYE", 8), ("SIMPLE_RADIAL_FISHEYE", 4), ("FOV", 5), ("THIN_PRISM_FISHEYE", 12)],
)
def test_colmap_s_other_models_are_refused_by_name(tmp_path: Path, model: str, count: int) -> None:
    path = write(tmp_path, "cameras.txt", f"1 {model} 1600 1100 {' '.join(['800'] * count)}\n")
    with pytest.raises(
        KgcpError, match=rf"line 1: has the model {model}, which kgcp does not support"
    ):
        read_calibration(path, SILENT)


def test_a_colmap_camera_with_the_wrong_number_of_parameters_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "cameras.txt", "# comment\n1 OPENCV 1600 1100 1700 1700 800 550\n")
    with pytest.raises(KgcpError, match="line 2: holds '1700 1700 800 550' instead of 8 finite"):
        read_calibration(path, SILENT)


BROWN = {
    "projection_type": "brown",
    "width": WIDTH,
    "height": HEIGHT,
    "focal_x": 1.069,
    "focal_y": 1.0639,
    "c_x": 0.0078,
    "c_y": -0.0053,
    "k1": K1,
    "k2": K2,
    "p1": P1,
    "p2": P2,
    "k3": K3,
}


def opensfm_px(normalised: FloatArray, width: int, height: int) -> FloatArray:
    """Pixels of normalised image coordinates by OpenSfM's geometry.rst."""
    return normalised * max(width, height) + [(width - 1) / 2, (height - 1) / 2]


@pytest.mark.parametrize(
    ("values", "k", "p"),
    [
        (BROWN, (K1, K2, K3), (P1, P2)),
        ({**BROWN, "projection_type": "radial"}, (K1, K2), (0.0, 0.0)),
        ({**BROWN, "projection_type": "simple_radial"}, (K1,), (0.0, 0.0)),
    ],
)
def test_opensfm_cameras_are_normalised_by_the_longer_side(
    tmp_path: Path,
    values: dict[str, object],
    k: tuple[float, ...],
    p: tuple[float, float],
    check: Check,
    brown: Brown,
) -> None:
    camera = read_calibration(write(tmp_path, "cameras.json", {"v2 some": values}), SILENT)

    def expected(points: FloatArray) -> FloatArray:
        normalised = brown(points, k, p) * [1.069, 1.0639] + [0.0078, -0.0053]
        return opensfm_px(normalised, WIDTH, HEIGHT)

    check(camera, expected)


def test_opensfm_s_perspective_camera_has_its_principal_point_in_the_middle(
    tmp_path: Path, brown: Brown
) -> None:
    values = {"projection_type": "perspective", "focal": 0.94, "k1": K1, "k2": K2}
    path = write(tmp_path, "camera_models_overrides.json", {"all": values})
    camera = read_calibration(path, (HEIGHT, WIDTH))  # upright: the longer side is the height
    assert (camera.cx, camera.cy) == (549.5, 799.5)
    points = np.array([[0.1, 0.3, 1.0], [-0.2, 0.5, 1.0]])
    expected = opensfm_px(0.94 * brown(points, (K1, K2), (0, 0)), HEIGHT, WIDTH)
    np.testing.assert_allclose(camera.project(points), expected, rtol=0, atol=1e-9)


def test_a_published_opensfm_camera_of_resized_frames_holds_for_the_originals(
    tmp_path: Path,
) -> None:
    # As OpenDroneMap wrote it after resizing 5472 x 3648 to 1368 x 912, without focal_y.
    published = {
        "projection_type": "brown",
        "width": 1368,
        "height": 912,
        "focal_x": 0.6664614123723713,
        "c_x": -0.0015460447606643697,
        "c_y": 0.004751874732641298,
        "k1": -0.2640629100413887,
        "k2": 0.10188934223670705,
        "p1": 0.0007345906274317972,
        "p2": 0.0002595206713083041,
        "k3": -0.02581956399353581,
    }
    path = write(tmp_path, "cameras.json", {"v2 dji fc6310r 5472 3648 brown 0.6666": published})
    camera = read_calibration(path, (5472, 3648))
    assert math.isclose(camera.fx, 3646.8768485, abs_tol=1e-6)
    assert camera.fx == camera.fy
    assert math.isclose(camera.cx, 2727.0400431, abs_tol=1e-6)  # 2735.5 − 8.4599569
    assert math.isclose(camera.cy, 1849.5022585, abs_tol=1e-6)  # 1823.5 + 26.0022585
    with pytest.raises(KgcpError, match=r"is for 1368 x 912 px, but \[camera\] says 5472 x 3078"):
        read_calibration(path, (5472, 3078))
    with pytest.raises(KgcpError, match=r"but \[camera\] says 3648 x 5472"):
        read_calibration(path, (3648, 5472))


def test_cameras_can_be_read_from_a_reconstruction(tmp_path: Path) -> None:
    parts = [{"cameras": {"a": BROWN}, "shots": {}}, {"cameras": {"b": BROWN}, "shots": {}}]
    path = write(tmp_path, "reconstruction.json", parts)
    single = write(tmp_path, "cameras.json", {"b": BROWN})
    assert read_calibration(path, SILENT, camera="b") == read_calibration(single, SILENT)


@pytest.mark.parametrize("model", ["fisheye", "fisheye_opencv", "dual", "spherical", "fisheye62"])
def test_opensfm_s_other_models_are_refused_by_name(tmp_path: Path, model: str) -> None:
    path = write(tmp_path, "cameras.json", {"x": {**BROWN, "projection_type": model}})
    with pytest.raises(
        KgcpError, match=rf"x: has the projection_type '{model}', which kgcp does not support"
    ):
        read_calibration(path, SILENT)
