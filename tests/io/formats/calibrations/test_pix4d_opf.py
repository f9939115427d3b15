"""Pix4D's cameras, and OPF's as its own library writes them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pyopf.cameras import CalibratedCameras, PerspectiveInternals
from pyopf.cameras.calibrated_cameras import CalibratedSensor
from pyopf.io import load, save
from pyopf.uid64 import Uid64

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


def corner_px(points: FloatArray, brown: Brown) -> FloatArray:
    """Pix4D's perspective camera, in pixels from the corner, brought to the pixel's centre."""
    distorted = brown(points, (K1, K2, K3), (P1, P2))
    return distorted * 1705.5 + [812.25, 541.5] - 0.5


def opf_cameras(*ids: int) -> CalibratedCameras:
    return CalibratedCameras(
        cameras=[],
        sensors=[
            CalibratedSensor(
                id=Uid64(int=number),
                internals=PerspectiveInternals(
                    principal_point_px=np.array([812.25, 541.5]),
                    focal_length_px=1705.5,
                    radial_distortion=np.array([K1, K2, K3]),
                    tangential_distortion=np.array([P1, P2]),
                ),
            )
            for number in ids
        ],
    )


def test_opf_sensors_are_read_as_pyopf_writes_them(
    tmp_path: Path, check: Check, brown: Brown
) -> None:
    path = tmp_path / "calibrated_cameras.json"
    save(opf_cameras(18446744073709551615), str(path))  # ids are unsigned, of 64 bits
    with pytest.raises(KgcpError, match="has no image size; add width and height"):
        read_calibration(path, SILENT)
    check(read_calibration(path, (WIDTH, HEIGHT)), partial(corner_px, brown=brown))
    assert len(load(str(path)).sensors) == 1


def test_opf_fisheyes_are_refused_and_several_sensors_listed(
    tmp_path: Path, check: Check, brown: Brown
) -> None:
    document = opf_cameras(1, 2).to_dict()
    document["sensors"][1]["internals"]["type"] = "fisheye"
    document["sensors"][0]["image_size_px"] = [WIDTH, HEIGHT]
    path = write(tmp_path, "input_cameras.json", document)
    with pytest.raises(KgcpError, match=r"holds the cameras '1', '2'; choose one with \[camera\]"):
        read_calibration(path, SILENT)
    with pytest.raises(KgcpError, match=r"sensors\[1\] internals: has the type 'fisheye', which"):
        read_calibration(path, (WIDTH, HEIGHT), camera="2")
    with pytest.raises(KgcpError, match=r"holds no camera '3', but '1', '2'; correct \[camera\]"):
        read_calibration(path, SILENT, camera="3")
    check(read_calibration(path, SILENT, camera="1"), partial(corner_px, brown=brown))


PIX4D_HEAD = """\
fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""
PIX4D_BLOCK = f"""\
{{name}} {WIDTH} {HEIGHT}
{{focal}} 0 812.25
0 {{focal}} 541.5
0 0 1
{K1} {K2} {K3}
{P1} {P2}
114.126 378.820 -2.312
-0.49632902 0.86794436 -0.01816834
0.866499 0.494001 -0.071708
-0.053263 -0.051334 -0.997260
"""


def test_pix4d_blocks_of_equal_parameters_are_one_camera(
    tmp_path: Path, check: Check, brown: Brown
) -> None:
    blocks = [PIX4D_BLOCK.format(name=name, focal=1705.5) for name in ("1 a.JPG", "b.JPG")]
    path = write(tmp_path, "calibrated_camera_parameters.txt", PIX4D_HEAD + "".join(blocks))
    check(read_calibration(path, SILENT), partial(corner_px, brown=brown))
    other = PIX4D_BLOCK.format(name="c.JPG", focal=1706.0)
    path.write_text(path.read_text() + other)
    with pytest.raises(KgcpError, match=r"holds the cameras '1 a.JPG', 'c.JPG'; choose one"):
        read_calibration(path, SILENT)
    assert read_calibration(path, SILENT, camera="c.JPG").fy == 1706.0


def test_a_published_pix4d_calibration_is_read(tmp_path: Path) -> None:
    # The sample project of DSC_0157.JPG: an image of 7360 x 4912 px.
    block = """\
DSC_0157.JPG 7360 4912
7363.51850023951465118444 0 3686.33719996831450771424
0 7363.51850023951465118444 2439.04083412635009153746
0 0 1
-0.09005921067656787182 0.10773972435740564180 -0.01257054987797603419
-0.00029570539858373248 -0.00027422056492206067
114.12600004808672338186 378.81985574952466322429 -2.31159761431545440757
-0.49632901575943477734 0.86794436424468834890 -0.01816834310427051929
0.86649900151927328196 0.49400145706385401034 -0.07170802455019638366
-0.05326338781351704077 -0.05133362440616233 -0.99726024
"""
    camera = read_calibration(write(tmp_path, "params.txt", PIX4D_HEAD + block), SILENT)
    assert (camera.width, camera.height) == (7360, 4912)
    assert camera.cx == 3685.8371999683145
    assert (camera.p1, camera.p2) == (-0.00029570539858373248, -0.00027422056492206067)


def pix4d_cam(width_mm: float, height_mm: float) -> str:
    per_px = width_mm / WIDTH
    return (
        f"Pix4D camera calibration file 0\n"
        f"#Focal Length mm assuming a sensor width of {width_mm:.20f}x{height_mm:.20f}mm\n"
        f"F {1705.5 * per_px:.20f}\n#Principal Point mm\nPx {812.25 * per_px:.20f}\n"
        f"Py {541.5 * per_px:.20f}\n#Symmetrical Lens Distortion Coeffs\n"
        f"K1 {K1:.20f}\nK2 {K2:.20f}\nK3 {K3:.20f}\n#Tangential Lens Distortion Coeffs\n"
        f"T1 {P1:.20f}\nT2 {P2:.20f}\n"
    )


def test_pix4d_s_cam_is_in_millimetres_of_the_sensor_that_it_states(
    tmp_path: Path, check: Check, brown: Brown
) -> None:
    path = write(tmp_path, "internal.cam", pix4d_cam(12.8, 8.8))
    check(read_calibration(path, (WIDTH, HEIGHT)), partial(corner_px, brown=brown))
    with pytest.raises(KgcpError, match="which is not of the shape of 1600 x 1200 px"):
        read_calibration(path, (WIDTH, 1200))
    path.write_text(path.read_text().replace("T2", "S2"))
    with pytest.raises(KgcpError, match="camera '0' T2: holds 'nothing' instead of a finite"):
        read_calibration(path, (WIDTH, HEIGHT))


def test_inpho_s_cam_is_refused(tmp_path: Path) -> None:
    text = "#Focal Length (mm) assuming a sensor width of 12.8x8.8mm\n#Image size 1600x1100 pixel\n"
    with pytest.raises(KgcpError, match="is not a calibration of a known format"):
        read_calibration(write(tmp_path, "inpho.cam", text + "FOCAL 13.6\n"), (WIDTH, HEIGHT))
