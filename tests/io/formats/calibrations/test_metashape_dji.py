"""Metashape's cameras against its manual, DJI's against its own."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

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


def test_metashape_calibrations_project_by_the_manual_s_formula(
    tmp_path: Path, check: Check
) -> None:
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


def test_metashape_documents_give_the_adjusted_calibration_of_a_sensor(
    tmp_path: Path, check: Check
) -> None:
    one = SENSOR.format(id=0, label="FC6310R, 8.8mm")
    path = write(tmp_path, "cameras.xml", metashape_document(one))
    check(read_calibration(path, SILENT), metashape_px)
    two = one + SENSOR.format(id=1, label="FC6310R, 8.8mm")
    path = write(tmp_path, "cameras.xml", metashape_document(two))
    with pytest.raises(KgcpError, match="holds the cameras '0', '1'; choose one"):
        read_calibration(path, SILENT)  # equal labels: the ids distinguish them
    check(read_calibration(path, SILENT, camera="1"), metashape_px)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "<b1>8.25</b1>",
            "<b1>8.25</b1><b2>0.31</b2>",
            "has B2 = 0.31, which kgcp does not support",
        ),
        ("<k3>", "<k4>-1e-3</k4><k3>", "has K4 = -0.001, which kgcp does not support"),
        ("<p1>", "<p3>-2e-5</p3><p1>", "has P3 = -2e-05, which kgcp does not support"),
        ("<p1>", "<p4>0.5</p4><p1>", "has P4 = 0.5, which kgcp does not support"),
        (">frame<", ">fisheye<", "has the projection 'fisheye', which kgcp does not support"),
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


def test_metashape_terms_of_zero_are_harmless(tmp_path: Path, check: Check) -> None:
    text = METASHAPE.replace("<k3>", "<b2>0</b2><k4>0.0</k4><p3>0</p3><k3>")
    check(read_calibration(write(tmp_path, "camera.xml", text), SILENT), metashape_px)


DEWARP = f"2024-03-08;1710.5,1702.25,12.25,-8.5,{K1},{K2},{P1},{P2},{K3}"
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
    '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
    ' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:DewarpFlag="0"'
    f' drone-dji:DewarpData="{DEWARP}"/></rdf:RDF></x:xmpmeta>'
)


def dji_px(points: FloatArray, brown: Brown) -> FloatArray:
    """Pixels of DJI's model, which counts from the middle of the photo."""
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
    tmp_path: Path, text: str, check: Check, brown: Brown
) -> None:
    path = write(tmp_path, "dewarp.txt", text)
    with pytest.raises(KgcpError, match="has no image size"):
        read_calibration(path, SILENT)
    check(read_calibration(path, (WIDTH, HEIGHT)), partial(dji_px, brown=brown))


def test_a_photo_of_dji_brings_its_calibration_and_size(
    tmp_path: Path, check: Check, brown: Brown
) -> None:
    path = tmp_path / "DJI_0001.JPG"
    Image.new("L", (WIDTH, HEIGHT), 90).save(path, "JPEG", xmp=XMP.encode())
    check(read_calibration(path, SILENT), partial(dji_px, brown=brown))
    upright = Image.Exif()
    upright[0x0112] = 6  # to be turned by a viewer; the calibration is the sensor's
    Image.new("L", (WIDTH, HEIGHT), 90).save(path, "JPEG", xmp=XMP.encode(), exif=upright)
    check(read_calibration(path, SILENT), partial(dji_px, brown=brown))
    dewarped = XMP.replace('DewarpFlag="0"', 'DewarpFlag="1"')
    Image.new("L", (WIDTH, HEIGHT), 90).save(path, "JPEG", xmp=dewarped.encode())
    with pytest.raises(KgcpError, match="is dewarped already"):
        read_calibration(path, SILENT)
    Image.new("L", (WIDTH, HEIGHT), 90).save(path, "JPEG")
    with pytest.raises(KgcpError, match="is not a calibration of a known format"):
        read_calibration(path, SILENT)
