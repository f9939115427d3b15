"""Calibrations in other programs' formats, against what these programs project.

Every format is written here by its specification, from one camera on a frame that is not square;
the same formula, applied in the test or by the program's own library, says where points must
appear, up to the frame's edges.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pyopf.cameras import CalibratedCameras, PerspectiveInternals
from pyopf.cameras.calibrated_cameras import CalibratedSensor
from pyopf.io import load, save
from pyopf.uid64 import Uid64

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.io.calibrations import FORMATS, read_calibration
from kgcp.io.flight import read_flight

SILENT = (None, None)
WIDTH, HEIGHT = 1600, 1100
K1, K2, K3, P1, P2 = -0.061, 0.043, -0.009, 0.0007, -0.0011

# The corner of the frame's top-left pixel, its other corners, a point on its edge and its middle.
EDGES_PX = np.array(
    [[-0.5, -0.5], [1599.5, -0.5], [1599.5, 1099.5], [-0.5, 1099.5], [799.5, -0.5], [799.5, 549.5]]
)


def rays_at_the_edges(camera: Camera) -> FloatArray:
    """Points (n, 3) that the camera sees at the frame's edges."""
    normalised = camera.undistort(EDGES_PX)
    assert np.isfinite(normalised).all()
    depths = np.array([[1.0], [2.5], [80.0], [0.7], [3.0], [11.0]])
    points: FloatArray = np.hstack((normalised, np.ones((6, 1)))) * depths
    return points


def brown(points: FloatArray, k: tuple[float, ...], p: tuple[float, float]) -> FloatArray:
    """The distorted coordinates by OpenCV's documentation, written out once more."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x**2 + y**2
    radial = 1 + sum(value * r2 ** (order + 1) for order, value in enumerate(k))
    return np.column_stack(
        (
            x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x**2),
            y * radial + p[0] * (r2 + 2 * y**2) + 2 * p[1] * x * y,
        )
    )


def check(camera: Camera, expected_px: Callable[[FloatArray], FloatArray]) -> None:
    """Compare projections at the frame's edges; `expected_px` counts from the pixel's centre."""
    points = rays_at_the_edges(camera)
    np.testing.assert_allclose(camera.project(points), expected_px(points), rtol=0, atol=1e-6)


def write(folder: Path, name: str, content: object) -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")
    return path


# --- COLMAP


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
    tmp_path: Path, model: str, params: list[float]
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
    with pytest.raises(KgcpError, match=rf"line 1: has the model {model}, which kgcp has not"):
        read_calibration(path, SILENT)


def test_a_colmap_camera_with_the_wrong_number_of_parameters_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "cameras.txt", "# comment\n1 OPENCV 1600 1100 1700 1700 800 550\n")
    with pytest.raises(KgcpError, match="line 2: holds '1700 1700 800 550' instead of 8 finite"):
        read_calibration(path, SILENT)


# --- OpenSfM


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
    tmp_path: Path, values: dict[str, object], k: tuple[float, ...], p: tuple[float, float]
) -> None:
    camera = read_calibration(write(tmp_path, "cameras.json", {"v2 some": values}), SILENT)

    def expected(points: FloatArray) -> FloatArray:
        normalised = brown(points, k, p) * [1.069, 1.0639] + [0.0078, -0.0053]
        return opensfm_px(normalised, WIDTH, HEIGHT)

    check(camera, expected)


def test_opensfm_s_perspective_camera_looks_through_the_middle(tmp_path: Path) -> None:
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


def test_a_reconstruction_is_a_file_of_cameras(tmp_path: Path) -> None:
    parts = [{"cameras": {"a": BROWN}, "shots": {}}, {"cameras": {"b": BROWN}, "shots": {}}]
    path = write(tmp_path, "reconstruction.json", parts)
    single = write(tmp_path, "cameras.json", {"b": BROWN})
    assert read_calibration(path, SILENT, camera="b") == read_calibration(single, SILENT)


@pytest.mark.parametrize("model", ["fisheye", "fisheye_opencv", "dual", "spherical", "fisheye62"])
def test_opensfm_s_other_models_are_refused_by_name(tmp_path: Path, model: str) -> None:
    path = write(tmp_path, "cameras.json", {"x": {**BROWN, "projection_type": model}})
    with pytest.raises(KgcpError, match=rf"x: has the projection_type '{model}', which kgcp has"):
        read_calibration(path, SILENT)


# --- Metashape


METASHAPE = f"""\
<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>{WIDTH}</width>
  <height>{HEIGHT}</height>
  <f>1702.25</f>
  <cx>12.25</cx>
  <cy>-8.5</cy>
  <b1>8.25</b1>
  <k1>{K1}</k1>
  <k2>{K2}</k2>
  <k3>{K3}</k3>
  <p1>{P1}</p1>
  <p2>{P2}</p2>
  <date>2026-05-04T10:11:12Z</date>
</calibration>
"""


def metashape_px(points: FloatArray) -> FloatArray:
    """The manual's frame camera, in pixels from the corner, brought to the pixel's centre."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x**2 + y**2
    radial = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
    distorted_x = x * radial + P1 * (r2 + 2 * x**2) + 2 * P2 * x * y
    distorted_y = y * radial + P2 * (r2 + 2 * y**2) + 2 * P1 * x * y
    u = WIDTH * 0.5 + 12.25 + distorted_x * 1702.25 + distorted_x * 8.25
    v = HEIGHT * 0.5 - 8.5 + distorted_y * 1702.25
    return np.column_stack((u, v)) - 0.5


def test_metashape_calibrations_project_by_the_manual_s_formula(tmp_path: Path) -> None:
    camera = read_calibration(write(tmp_path, "camera.xml", METASHAPE), SILENT)
    check(camera, metashape_px)


def metashape_document(*sensors: str) -> str:
    return (
        f'<document version="2.0.0"><chunk label="Chunk 1"><sensors>{"".join(sensors)}</sensors>'
        "<cameras/></chunk></document>"
    )


SENSOR = (
    '<sensor id="{id}" label="{label}" type="frame"><resolution width="1600" height="1100"/>'
    '<calibration type="frame" class="initial"><resolution width="1600" height="1100"/>'
    "<f>1600</f></calibration>"
    '<calibration type="frame" class="adjusted"><resolution width="1600" height="1100"/>'
    "<f>1702.25</f><cx>12.25</cx><cy>-8.5</cy><b1>8.25</b1>"
    f"<k1>{K1}</k1><k2>{K2}</k2><k3>{K3}</k3><p1>{P1}</p1><p2>{P2}</p2></calibration></sensor>"
)


def test_metashape_documents_give_the_adjusted_calibration_of_a_sensor(tmp_path: Path) -> None:
    one = SENSOR.format(id=0, label="FC6310R, 8.8mm")
    path = write(tmp_path, "cameras.xml", metashape_document(one))
    check(read_calibration(path, SILENT), metashape_px)
    two = one + SENSOR.format(id=1, label="FC6310R, 8.8mm")
    path = write(tmp_path, "cameras.xml", metashape_document(two))
    with pytest.raises(KgcpError, match="holds the cameras '0', '1'; choose one"):
        read_calibration(path, SILENT)  # equal labels: the ids tell them apart
    check(read_calibration(path, SILENT, camera="1"), metashape_px)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<b1>8.25</b1>", "<b1>8.25</b1><b2>0.31</b2>", "has B2 = 0.31, which kgcp has not"),
        ("<k3>", "<k4>-1e-3</k4><k3>", "has K4 = -0.001, which kgcp has not"),
        ("<p1>", "<p3>-2e-5</p3><p1>", "has P3 = -2e-05, which kgcp has not"),
        ("<p1>", "<p4>0.5</p4><p1>", "has P4 = 0.5, which kgcp has not"),
        (">frame<", ">fisheye<", "has the projection 'fisheye', which kgcp has not"),
        (
            "<f>1702.25</f>",
            "<fx>1702</fx><fy>1702</fy>",
            "has no <f>, as in files of old PhotoScan",
        ),
        ("<f>1702.25", "<f>wide", "calibration f: holds 'wide' instead of a finite number"),
        (f"<width>{WIDTH}</width>", "", "calibration size: holds '1100' instead of 2 finite"),
    ],
)
def test_metashape_terms_that_cannot_be_represented_are_named(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = write(tmp_path, "camera.xml", METASHAPE.replace(old, new))
    with pytest.raises(KgcpError, match=words):
        read_calibration(path, SILENT)


def test_metashape_terms_of_zero_are_harmless(tmp_path: Path) -> None:
    text = METASHAPE.replace("<k3>", "<b2>0</b2><k4>0.0</k4><p3>0</p3><k3>")
    check(read_calibration(write(tmp_path, "camera.xml", text), SILENT), metashape_px)


# --- Pix4D and OPF


def corner_px(points: FloatArray) -> FloatArray:
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


def test_opf_sensors_are_read_as_pyopf_writes_them(tmp_path: Path) -> None:
    path = tmp_path / "calibrated_cameras.json"
    save(opf_cameras(18446744073709551615), str(path))  # ids are unsigned, of 64 bits
    with pytest.raises(KgcpError, match="has no image size; add width and height"):
        read_calibration(path, SILENT)
    check(read_calibration(path, (WIDTH, HEIGHT)), corner_px)
    assert len(load(str(path)).sensors) == 1


def test_opf_fisheyes_are_refused_and_several_sensors_listed(tmp_path: Path) -> None:
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
    check(read_calibration(path, SILENT, camera="1"), corner_px)


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


def test_pix4d_blocks_of_equal_parameters_are_one_camera(tmp_path: Path) -> None:
    blocks = [PIX4D_BLOCK.format(name=name, focal=1705.5) for name in ("1 a.JPG", "b.JPG")]
    path = write(tmp_path, "calibrated_camera_parameters.txt", PIX4D_HEAD + "".join(blocks))
    check(read_calibration(path, SILENT), corner_px)
    other = PIX4D_BLOCK.format(name="c.JPG", focal=1706.0)
    path.write_text(path.read_text() + other)
    with pytest.raises(KgcpError, match=r"holds the cameras '1 a.JPG', 'c.JPG'; choose one"):
        read_calibration(path, SILENT)
    assert read_calibration(path, SILENT, camera="c.JPG").fy == 1706.0


def test_a_published_pix4d_calibration(tmp_path: Path) -> None:
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


def test_pix4d_s_cam_is_in_millimetres_of_the_sensor_that_it_states(tmp_path: Path) -> None:
    path = write(tmp_path, "internal.cam", pix4d_cam(12.8, 8.8))
    check(read_calibration(path, (WIDTH, HEIGHT)), corner_px)
    with pytest.raises(KgcpError, match="which is not of the shape of 1600 x 1200 px"):
        read_calibration(path, (WIDTH, 1200))
    path.write_text(path.read_text().replace("T2", "S2"))
    with pytest.raises(KgcpError, match="camera '0' T2: holds 'nothing' instead of a finite"):
        read_calibration(path, (WIDTH, HEIGHT))


def test_inpho_s_cam_is_refused(tmp_path: Path) -> None:
    text = "#Focal Length (mm) assuming a sensor width of 12.8x8.8mm\n#Image size 1600x1100 pixel\n"
    with pytest.raises(KgcpError, match="is no calibration of a known format"):
        read_calibration(write(tmp_path, "inpho.cam", text + "FOCAL 13.6\n"), (WIDTH, HEIGHT))


# --- DJI


DEWARP = f"2024-03-08;1710.5,1702.25,12.25,-8.5,{K1},{K2},{P1},{P2},{K3}"
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
    '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
    ' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:DewarpFlag="0"'
    f' drone-dji:DewarpData="{DEWARP}"/></rdf:RDF></x:xmpmeta>'
)


def dji_px(points: FloatArray) -> FloatArray:
    """The middle of the photo is half its width and height from its corner."""
    middle = np.array([WIDTH, HEIGHT]) / 2 - 0.5
    return brown(points, (K1, K2, K3), (P1, P2)) * [1710.5, 1702.25] + middle + [12.25, -8.5]


@pytest.mark.parametrize(
    "text",
    [
        DEWARP,
        DEWARP.partition(";")[2] + "\n",
        XMP,
        f"<drone-dji:DewarpData>{DEWARP}</drone-dji:DewarpData>",
    ],
)
def test_dji_s_principal_point_counts_from_the_middle_of_the_photo(
    tmp_path: Path, text: str
) -> None:
    path = write(tmp_path, "dewarp.txt", text)
    with pytest.raises(KgcpError, match="has no image size"):
        read_calibration(path, SILENT)
    check(read_calibration(path, (WIDTH, HEIGHT)), dji_px)


def test_a_photo_of_dji_brings_its_calibration_and_size(tmp_path: Path) -> None:
    path = tmp_path / "DJI_0001.JPG"
    Image.new("L", (WIDTH, HEIGHT), 90).save(path, "JPEG", xmp=XMP.encode())
    check(read_calibration(path, SILENT), dji_px)
    dewarped = XMP.replace('DewarpFlag="0"', 'DewarpFlag="1"')
    Image.new("L", (WIDTH, HEIGHT), 90).save(path, "JPEG", xmp=dewarped.encode())
    with pytest.raises(KgcpError, match="is dewarped already"):
        read_calibration(path, SILENT)
    Image.new("L", (WIDTH, HEIGHT), 90).save(path, "JPEG")
    with pytest.raises(KgcpError, match="is no calibration of a known format"):
        read_calibration(path, SILENT)


# --- all of them


SAMPLES: dict[str, object] = {
    "colmap": f"1 RADIAL {WIDTH} {HEIGHT} 1700 800 550 -0.06 0.04\n",
    "opensfm": {"a": BROWN},
    "metashape": METASHAPE,
    "opf": opf_cameras(5).to_dict(),
    "pix4d": PIX4D_HEAD + PIX4D_BLOCK.format(name="a.JPG", focal=1705.5),
    "dji": DEWARP,
    "opencv": (
        "%YAML:1.0\n---\nimage_width: 1600\nimage_height: 1100\ncamera_matrix: !!opencv-matrix\n"
        "   rows: 3\n   cols: 3\n   dt: d\n   data: [1700, 0, 800, 0, 1700, 550, 0, 0, 1]\n"
    ),
    "ros": (
        "image_width: 1600\nimage_height: 1100\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [1700, 0, 800, 0, 1700, 550, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
    ),
}


def test_every_format_has_a_sample() -> None:
    assert SAMPLES.keys() == FORMATS.keys()


@pytest.mark.parametrize("form", sorted(FORMATS))
def test_the_content_tells_the_format_whatever_the_name(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, "camera", SAMPLES[form])
    named = read_calibration(path, (WIDTH, HEIGHT), form)
    assert read_calibration(path, (WIDTH, HEIGHT)) == named


@pytest.mark.parametrize("form", sorted(FORMATS))
@pytest.mark.parametrize("content", ["", "no such thing\n", "[1, 2]", "{}", "<a/>", "\x00\x01"])
def test_a_format_that_is_named_wrongly_is_a_line_about_the_file(
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
def test_colmap_round_trip(
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
    write(tmp_path, "cameras.json", {"a": BROWN, "b": {**BROWN, "focal_x": 0.9}})
    toml = tmp_path / "flight.toml"
    toml.write_text(f'[camera]\nfile = "cameras.json"\nformat = "opensfm"\ncamera = "b"\n{TARGET}')
    assert read_flight(tmp_path).camera.fx == 0.9 * WIDTH
    toml.write_text(f'[camera]\nfile = "cameras.json"\nformat = "open"\n{TARGET}')
    with pytest.raises(KgcpError, match=r"\[camera\] format: 'open' is not known; give one of"):
        read_flight(tmp_path)
    toml.write_text(
        f'[camera]\nwidth = 9\nheight = 9\nfx = 9\nfy = 9\ncx = 4\ncy = 4\ncamera = "b"\n{TARGET}'
    )
    with pytest.raises(KgcpError, match=r"\[camera\] camera: stands without a file"):
        read_flight(tmp_path)
