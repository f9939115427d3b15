"""Cameras written for other programs are read back by kgcp and by those programs' libraries."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pycolmap
import pytest
from pyopf.io import load

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, CalibrationCovariance
from kgcp.geometry.camera import Camera, Response
from kgcp.io.flight.camera_file import camera_toml
from kgcp.io.flight.camera_table import read_camera_file
from kgcp.io.formats.calibrations import read_calibration
from kgcp.io.formats.camera_writers import CAMERA_FORMATS, CalibratedCamera, camera_file

CAMERA = Camera(
    width=1600,
    height=1100,
    fx=1705.513,
    fy=1705.513,
    cx=811.27,
    cy=541.91,
    k1=-0.0613,
    k2=0.0431,
    p1=0.00071,
    p2=-0.0011,
    k3=-0.0092,
)
RATIONAL = replace(CAMERA, fx=1706.25, k4=0.011, k5=-0.002, k6=0.0003)
GRID = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7)), -1).reshape(
    -1, 2
)


def covariance(names: tuple[str, ...]) -> FloatArray:
    root = np.random.default_rng(2).standard_normal((len(names), len(names)))
    return CalibrationCovariance.of(names, root @ root.T).cov


def made(camera: Camera) -> CalibratedCamera:
    return CalibratedCamera(camera, covariance(("fx", "fy", "cx", "cy", "k1", "p2")), 0.031)


def write(folder: Path, camera: Camera, form: str) -> Path:
    name, text = camera_file(made(camera), form)
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("form", CAMERA_FORMATS)
def test_kgcp_reads_back_what_it_writes(tmp_path: Path, form: str) -> None:
    read = read_calibration(write(tmp_path, CAMERA, form), (1600, 1100))
    assert np.abs(read.distort(GRID) - CAMERA.distort(GRID)).max() < 1e-9


@pytest.mark.parametrize("form", ["opencv", "ros", "colmap"])
def test_formats_that_can_hold_the_rational_model_keep_it(tmp_path: Path, form: str) -> None:
    read = read_calibration(write(tmp_path, RATIONAL, form), (1600, 1100))
    assert np.abs(read.distort(GRID) - RATIONAL.distort(GRID)).max() < 1e-9


@pytest.mark.parametrize("form", ["metashape", "opensfm", "pix4d", "opf", "mmvii"])
def test_terms_that_a_format_cannot_hold_are_refused_by_name(form: str) -> None:
    with pytest.raises(KgcpError, match="k4, k5, k6"):
        camera_file(made(RATIONAL), form)


@pytest.mark.parametrize("form", ["pix4d", "opf", "mmvii"])
def test_formats_with_one_focal_length_refuse_two(form: str) -> None:
    with pytest.raises(KgcpError, match="fx and fy differ"):
        camera_file(made(replace(CAMERA, fx=1706.0)), form)


def test_opencv_reads_its_file(tmp_path: Path) -> None:
    path = write(tmp_path, RATIONAL, "opencv")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    coefficients = storage.getNode("distortion_coefficients").mat()
    cov = storage.getNode("calibration_covariance").mat()
    names = storage.getNode("calibration_covariance_of").string().split()
    storage.release()
    points = np.column_stack((GRID, np.ones(len(GRID))))
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    assert np.abs(pixels.reshape(-1, 2) - RATIONAL.distort(GRID)).max() < 1e-6
    assert names == list(CALIBRATION_PARAMETERS)
    assert np.array_equal(cov, made(RATIONAL).cov)


@pytest.mark.parametrize("camera", [CAMERA, RATIONAL], ids=["brown", "rational"])
def test_colmap_reads_its_file(tmp_path: Path, camera: Camera) -> None:
    write(tmp_path, camera, "colmap")
    for name in ("images.txt", "points3D.txt"):
        (tmp_path / name).write_text("")
    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(tmp_path))
    (read,) = reconstruction.cameras.values()
    pixels = np.array([read.img_from_cam(np.append(point, 1.0)) for point in GRID])
    assert np.abs(pixels - 0.5 - camera.distort(GRID)).max() < 1e-6


def test_pyopf_reads_its_file(tmp_path: Path) -> None:
    cameras = load(str(write(tmp_path, CAMERA, "opf")))
    (sensor,) = cameras.sensors
    assert sensor.internals.focal_length_px == CAMERA.fx
    assert np.allclose(sensor.internals.principal_point_px, [CAMERA.cx + 0.5, CAMERA.cy + 0.5])
    assert np.array_equal(sensor.image_size_px, [1600, 1100])


def test_mmvii_has_the_terms_as_its_own_files_note_them(tmp_path: Path) -> None:
    """By the comments of MMVII's own files: (3X2+Y2,2XY) is p1, and (2XY,X2+3Y2) p2."""
    path = write(tmp_path, CAMERA, "mmvii")
    root = ET.parse(path).getroot()  # noqa: S314 - written just now

    def number(tag: str) -> float:
        return float(root.findtext(f".//{tag}") or "nan")

    x, y = GRID.T
    r2 = x**2 + y**2
    radial = number("K1") * r2 + number("K2") * r2**2 + number("K3") * r2**3
    across = x + x * radial + number("p1") * (3 * x**2 + y**2) + number("p2") * 2 * x * y
    down = y + y * radial + number("p1") * 2 * x * y + number("p2") * (x**2 + 3 * y**2)
    centre = [float(text) for text in (root.findtext(".//PP") or "").split()]
    pixels = np.stack((across, down), 1) * number("F") + centre
    assert np.abs(pixels - CAMERA.distort(GRID)).max() < 1e-9
    path.write_text(path.read_text().replace("<b2>0.0", "<b2>0.01"))
    with pytest.raises(KgcpError, match=r"b2 = 0\.01"):
        read_calibration(path, (None, None))
    path.write_text(path.read_text().replace("Stenope", "EquiDist"))
    with pytest.raises(KgcpError, match="the projection 'EquiDist'"):
        read_calibration(path, (None, None))


def test_metashape_has_the_covariance_in_its_own_terms() -> None:
    _, text = camera_file(made(replace(CAMERA, fx=1706.0)), "metashape")
    params = text.partition("<params>")[2].partition("</params>")[0].split()
    assert params == ["f", "cx", "cy", "b1", "k1", "p1"]
    numbers = text.partition("<coeffs>")[2].partition("</coeffs>")[0].split()
    cov = np.array([float(number) for number in numbers]).reshape(6, 6)
    own = made(CAMERA).cov
    assert cov[0, 0] == own[1, 1]  # f is fy
    assert cov[3, 3] == pytest.approx(own[0, 0] - 2 * own[0, 1] + own[1, 1])  # b1 is fx - fy
    assert cov[5, 5] == own[7, 7]  # p1 is p2


def test_opensfm_overrides_all_cameras() -> None:
    document = json.loads(camera_file(made(CAMERA), "opensfm")[1])
    assert list(document) == ["all"]


def test_camera_toml_contains_the_covariance(tmp_path: Path) -> None:
    camera = replace(CAMERA, response=Response.SRGB)
    known = CalibrationCovariance(covariance(("fx", "fy", "cx", "cy", "k1", "k3")))
    path = tmp_path / "camera.toml"
    path.write_text(camera_toml(camera, known), encoding="utf-8")
    stated = read_camera_file(path)
    read, read_covariance = stated.camera, stated.covariance
    assert read == camera
    assert read_covariance is not None
    assert np.array_equal(read_covariance.cov, known.cov)
