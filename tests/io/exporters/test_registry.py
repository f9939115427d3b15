"""All formats together: their files, their speed, and that points, images and cameras agree."""

from __future__ import annotations

import csv
import json
import re
import time
from collections.abc import Callable
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import cv2
import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, rotation_from_opk
from kgcp.georef.camera_priors import CameraPrior
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.exporters import camera_priors, geopackage, metashape, odm, opf, pix4d
from kgcp.io.exporters.formats import DEFAULT_FORMATS, FORMATS
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export

ROOT = Path(__file__).resolve().parents[3]
Factory = Callable[..., MapPoints]


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_writes_the_files_it_declares(
    points: MapPoints, make_points: Factory, tmp_path: Path, name: str
) -> None:
    written = [str(path.relative_to(tmp_path)) for path in export(points, name, tmp_path)]
    declared = [pattern.strip("[]") for pattern in FORMATS[name].files]
    assert all(any(fnmatch(path, pattern) for pattern in declared) for path in written)
    assert all(any(fnmatch(path, pattern) for path in written) for pattern in declared)
    assert name == "csv" or any(path.endswith("HOWTO.txt") for path in written)
    assert not [path for path in tmp_path.rglob("*") if path.suffix == ".part"]
    if name not in {"colmap", "camera-priors", "opf"}:
        always = [pattern for pattern in FORMATS[name].files if pattern[0] != "["]
        always += ["metashape/markers.xml"] * (name == "metashape")  # names do not repeat here
        plain = make_points(gcps=points.controls)
        left = {str(path.relative_to(tmp_path)) for path in export(plain, name, tmp_path)}
        assert all(any(fnmatch(path, pattern) for pattern in always) for path in left)
        files = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
        assert files == left  # nothing old remains


@pytest.mark.parametrize("name", FORMATS)
def test_no_points_are_an_error(make_points: Factory, tmp_path: Path, name: str) -> None:
    with pytest.raises(KgcpError, match="no points left"):
        export(make_points(gcps=()), name, tmp_path)
    assert not [*tmp_path.iterdir()]


def test_check_points_alone_are_refused_where_only_controls_are_written(
    points: MapPoints, tmp_path: Path
) -> None:
    """An adjustment of an empty list fails, or runs without any control."""
    checks = replace(
        points, gcps=tuple(replace(point, is_checkpoint=True) for point in points.gcps)
    )
    for name in FORMATS:
        if name in {"odm", "opensfm", "micmac", "mmvii"}:
            with pytest.raises(KgcpError, match=f"{name}: all points are check points"):
                export(checks, name, tmp_path)
        else:
            assert export(checks, name, tmp_path)


def test_how_tos_say_what_is_ignored(points: MapPoints, tmp_path: Path) -> None:
    for name in set(FORMATS) - {"csv", "geojson", "geopackage", "camera-priors"}:
        (how_to,) = [p for p in export(points, name, tmp_path) if p.name == "HOWTO.txt"]
        text = how_to.read_text(encoding="utf-8")
        assert re.search(r"ignore|no place|does not\s+know|takes no", text), name
        assert "{" not in text, name  # every blank is filled
        assert max(map(len, text.splitlines())) <= 200


def test_the_page_has_every_format_and_default() -> None:
    page = (ROOT / "docs" / "exporting.md").read_text(encoding="utf-8")
    names = [name for line in page.splitlines() for name in re.findall(r"^\| `([a-z0-9-]+)`", line)]
    assert sorted(set(names)) == sorted(FORMATS)
    assert set(DEFAULT_FORMATS) <= set(FORMATS)


def test_a_thousand_points_are_exported_quickly(make_points: Factory, tmp_path: Path) -> None:
    """A coarse guard: CPU time, ten times what it should be."""
    one = make_points().gcps[0]
    gcps = tuple(
        replace(one, id=f"K{n:04d}", frame=f"{n}.JPG", position_map=one.position_map + 0.5 * n)
        for n in range(1000)
    )
    points = make_points(gcps=gcps)
    begin_s = time.process_time()
    for name in set(FORMATS) - {"colmap", "camera-priors"}:
        export(points, name, tmp_path)
    assert time.process_time() - begin_s < 15.0


def test_exported_points_images_and_cameras_agree(make_points: Factory) -> None:
    """Project by OpenCV what a reader of OPF and of camera_priors.csv gets: the same pixels."""
    template = make_points()
    local_frame = LocalFrame.at(template.crs, template.gcps[0].position_map)
    camera_enu = np.array([12.0, -7.0, 76.0])
    opk = np.array([[3.0, -6.0, 41.0]])
    enu_from_camera = (
        local_frame.grid_rotation(camera_enu) @ rotation_from_opk(opk)[0] @ CAMERA_FROM_PHOTO
    )
    camera = template.camera
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    distortion = np.array([camera.k1, camera.k2, camera.p1, camera.p2])
    ground = np.array([[5.0, -9.0, 1.0], [-11.0, 3.0, -2.0], [30.0, 12.0, 0.5]])
    inside = (ground - camera_enu) @ enu_from_camera
    pixels = cv2.projectPoints(inside, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
    gcps = tuple(
        replace(
            template.gcps[0],
            id=f"K{number}",
            frame="one.jpg",
            position_map=local_frame.map_from_enu(place[None])[0],
            centre_px=pixel,
            distance_m=float(np.linalg.norm(ray)),
        )
        for number, (place, pixel, ray) in enumerate(zip(ground, pixels, inside, strict=True))
    )
    map_from_camera = local_frame.grid_rotation(camera_enu).T @ enu_from_camera
    prior = CameraPrior(
        "one.jpg", local_frame.map_from_enu(camera_enu[None])[0], map_from_camera, None
    )
    points = make_points(gcps=gcps, priors=(prior,))

    (row,) = csv.DictReader(
        camera_priors.files(points)["camera_priors/camera_priors.csv"].splitlines()
    )
    centre = local_frame.enu_from_map(np.array([[float(row[name]) for name in "xyz"]]))[0]
    angles = np.array([[float(row[f"{name}_deg"]) for name in ("omega", "phi", "kappa")]])
    attitude = local_frame.grid_rotation(centre) @ rotation_from_opk(angles)[0] @ CAMERA_FROM_PHOTO
    for gcp in json.loads(opf.files(points)["opf/input_control_points.json"])["gcps"]:
        place = local_frame.enu_from_map(np.array([gcp["geolocation"]["coordinates"]]))
        ray = (place - centre) @ attitude
        got = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), matrix, distortion)[0][0, 0]
        (mark,) = gcp["marks"]
        np.testing.assert_allclose(got + 0.5, mark["position_px"], atol=1e-5)  # 0.1 µm at 76 m


@pytest.mark.parametrize("name", ["metashape", "mmvii"])
def test_how_tos_of_packages_with_distances_explain_their_common_error(
    points: MapPoints, tmp_path: Path, name: str
) -> None:
    """1.23 cm of 79 m are 0.016 % of the distance; without a stated value, one is assumed."""
    silent = tuple(replace(point, sd_common_distance_m=None) for point in points.gcps)
    for some, words in (
        (points, "the share is 0.016 % here"),
        (replace(points, gcps=silent), "flight.toml does not say"),
    ):
        (how_to,) = [path for path in export(some, name, tmp_path) if path.name == "HOWTO.txt"]
        text = " ".join(how_to.read_text(encoding="utf-8").split())
        assert "wrong by 0.1 %, all distances are wrong by 0.1 %" in text
        assert "Leave the calibration free" in text
        assert words in text


@pytest.mark.parametrize(
    ("crs", "heights"),
    [
        ("EPSG:25831", "ellipsoidal height [metre]"),
        ("EPSG:2263", "ellipsoidal height [metre]"),  # though the grid has feet
        ("EPSG:25831+5773", "EGM96 height [metre]"),
        ("EPSG:2263+6360", "NAVD88 height (ftUS) [US survey foot]"),
        ("EPSG:4326", "ellipsoidal height [metre]"),
    ],
)
def test_how_tos_say_what_heights_are(points: MapPoints, crs: str, heights: str) -> None:
    for module in (odm, metashape, pix4d, opf, camera_priors, geopackage):
        priors = () if module is odm else points.priors  # its angles need a geoid's grid
        texts = module.files(replace(points, crs=crs, priors=priors))
        (how_to,) = [text for path, text in texts.items() if path.endswith("HOWTO.txt")]
        assert heights in str(how_to), module.__name__
