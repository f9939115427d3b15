"""Common properties of all calibration formats: recognition, sizes, names."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.io.formats.calibrations import FORMATS, read_calibration
from tests.io.formats.calibrations.one_camera import HEIGHT, SILENT, WIDTH, write

BROWN = {"projection_type": "brown", "focal_x": 1.069, "focal_y": 1.063, "c_x": 0.008, "c_y": 0.0}
PERSPECTIVE = {
    "type": "perspective",
    "focal_length_px": 1705.5,
    "principal_point_px": [812.25, 541.5],
    "radial_distortion": [-0.06, 0.04, 0.0],
    "tangential_distortion": [0.001, 0.0],
}
SAMPLES: dict[str, object] = {
    "colmap": f"1 RADIAL {WIDTH} {HEIGHT} 1700 800 550 -0.06 0.04\n",
    "opensfm": {"a": BROWN},
    "metashape": (
        "<calibration><projection>frame</projection><width>1600</width><height>1100</height>"
        "<f>1700</f></calibration>"
    ),
    "mmvii": (
        "<Root><Data><InternalCalibration><Name>a</Name><PixelFrame><NbPix>1600 1100</NbPix>"
        '</PixelFrame><Projection>"Stenope"</Projection><PerfectProj><F>1700</F><PP>800 550</PP>'
        "</PerfectProj></InternalCalibration></Data></Root>"
    ),
    "opf": {
        "format": "application/opf-calibrated-cameras+json",
        "sensors": [{"id": 5, "internals": PERSPECTIVE}],
    },
    "pix4d": (
        "Pix4D camera calibration file 0\n#Focal Length mm assuming a sensor width of 16x11mm\n"
        "F 17\nPx 8\nPy 5.5\nK1 0\nK2 0\nK3 0\nT1 0\nT2 0\n"
    ),
    "dji": "2024-03-08;1710.5,1702.25,12.25,-8.5,-0.06,0.04,0,0,0",
    "visiona": (
        "camera = { f = 1700.0; pp = [800.0, 550.0]; TD = [0.0, 0.0]; RD = [-0.06, 0.04, 0.0]; };\n"
    ),
    "opencv": (
        "%YAML:1.0\n---\nimage_width: 1600\nimage_height: 1100\ncamera_matrix: !!opencv-matrix\n"
        "   rows: 3\n   cols: 3\n   dt: d\n   data: [1700, 0, 800, 0, 1700, 550, 0, 0, 1]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n"
        "   data: [0, 0, 0, 0]\n"
    ),
    "ros": (
        "image_width: 1600\nimage_height: 1100\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [1700, 0, 800, 0, 1700, 550, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
    ),
}


def test_every_format_has_a_sample() -> None:
    assert SAMPLES.keys() == set(FORMATS.names)


@pytest.mark.parametrize("form", sorted(FORMATS.names))
def test_the_format_is_recognised_by_content_and_not_by_name(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, "camera", SAMPLES[form])
    named = read_calibration(path, (WIDTH, HEIGHT), form)
    assert read_calibration(path, (WIDTH, HEIGHT)) == named


@pytest.mark.parametrize("form", sorted(FORMATS.names))
@pytest.mark.parametrize("content", ["", "no such thing\n", "[1, 2]", "{}", "<a/>", "\x00\x01"])
def test_a_wrong_format_name_is_a_one_line_error_about_the_file(
    tmp_path: Path, form: str, content: str
) -> None:
    path = write(tmp_path, "camera", content)
    with pytest.raises(KgcpError) as caught:
        read_calibration(path, (WIDTH, HEIGHT), form)
    assert str(caught.value).startswith(f"{path}")
    assert "\n" not in str(caught.value)


@settings(max_examples=25, deadline=None)
@given(
    cx=st.floats(-400, 2000),
    cy=st.floats(-300, 1300),
    k1=st.floats(-0.3, 0.3),
    p1=st.floats(-0.01, 0.01),
)
def test_a_colmap_camera_is_read_back_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, cx: float, cy: float, k1: float, p1: float
) -> None:
    folder = tmp_path_factory.mktemp("colmap")
    line = f"3 OPENCV {WIDTH} {HEIGHT} 1700.5 1699.25 {cx + 0.5!r} {cy + 0.5!r} {k1!r} 0 {p1!r} 0\n"
    camera = read_calibration(write(folder, "cameras.txt", line), SILENT)
    assert (camera.k1, camera.p1) == (k1, p1)
    assert math.isclose(camera.cx, cx, abs_tol=1e-9)
    assert math.isclose(camera.cy, cy, abs_tol=1e-9)


TARGET = (
    '[[target]]\nname = "A"\nouter_diameter_m = 0.9\ninner_diameter_m = 0.45\n'
    "code_diameter_m = 0.642857143\ndot_diameter_m = 0.128571429\ncode_deg = [0, 43, 78]\n"
)


def test_flight_toml_names_format_and_camera(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    sized = {**BROWN, "width": WIDTH, "height": HEIGHT}
    write(tmp_path, "cameras.json", {"a": sized, "b": {**sized, "focal_x": 0.9}})
    toml = tmp_path / "flight.toml"
    toml.write_text(f'[camera]\nfile = "cameras.json"\nformat = "opensfm"\ncamera = "b"\n{TARGET}')
    assert read_flight(tmp_path).camera.fx == 0.9 * WIDTH
    toml.write_text(f'[camera]\nfile = "cameras.json"\nformat = "open"\n{TARGET}')
    with pytest.raises(KgcpError, match=r"\[camera\] format: 'open' is not known; give one of"):
        read_flight(tmp_path)
    toml.write_text(
        f'[camera]\nwidth = 9\nheight = 9\nfx = 9\nfy = 9\ncx = 4\ncy = 4\ncamera = "b"\n{TARGET}'
    )
    with pytest.raises(KgcpError, match=r"\[camera\] camera: needs a file"):
        read_flight(tmp_path)
