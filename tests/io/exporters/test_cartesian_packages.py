"""MicMac, MMVII and COLMAP: local frames, read back without kgcp's own geometry."""

from __future__ import annotations

import csv
import re
import runpy
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from pyproj import Transformer
from pyproj.enums import TransformDirection
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.exporters import colmap, micmac, mmvii
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export

Factory = Callable[..., MapPoints]
_GRID = Transformer.from_crs("EPSG:4258", "EPSG:25831", always_xy=True)


def _map_from_local(how_to: str, enu: FloatArray) -> FloatArray:
    """Follow the HOWTO: cct -I with its pipeline, then the CRS's own projection."""
    match = re.search(r"cct -d 6 (.*?)\n[^ ]", how_to, re.DOTALL)
    assert match
    pipeline = Transformer.from_pipeline(match[1].replace("\\\n", " "))
    east, north, up = enu.T
    lon, lat, height = pipeline.transform(east, north, up, direction=TransformDirection.INVERSE)
    return np.column_stack((*_GRID.transform(lon, lat), height))


def _parse(text: str) -> ET.Element:
    return ET.fromstring(text.encode())  # noqa: S314 - what has just been written


def _numbers(element: ET.Element, tag: str) -> FloatArray:
    return np.array([*map(float, str(element.findtext(tag)).split())])


def _bare(element: ET.Element, tag: str) -> str:
    return str(element.findtext(tag)).strip('"')


def test_micmac_has_the_points_with_uncertainties(points: MapPoints) -> None:
    texts = micmac.files(points)
    root = _parse(texts["micmac/gcps.xml"])
    assert root.tag == "DicoAppuisFlottant"
    entries = root.findall("OneAppuisDAF")
    names = [entry.findtext("NamePt") for entry in entries]
    assert names == ["K0001", "K0002", "K0003", "K0004", "north_gate"]  # alike, and apart
    enu = np.array([_numbers(entry, "Pt") for entry in entries])
    expected = [point.position_map for point in points.controls[:5]]
    back = _map_from_local(texts["micmac/HOWTO.txt"], enu)
    np.testing.assert_allclose(back, expected, atol=1e-6, rtol=0)
    # The grid's north is 0.55° off here: 2, 3, 4 cm along its axes turn into nearly the same.
    np.testing.assert_allclose(_numbers(entries[0], "Incertitude"), [0.02, 0.03, 0.04], rtol=0.01)


def test_micmac_has_the_measures_with_precision(points: MapPoints) -> None:
    root = _parse(micmac.files(points)["micmac/marks.xml"])
    images = {str(image.findtext("NameIm")): image for image in root}
    assert [*images] == ["IMG_1.JPG", "IMG_2.JPG", "IMG_3.JPG", "IMG_4.JPG", "IMG_6.JPG"]
    assert [mark.findtext("NamePt") for mark in images["IMG_3.JPG"].findall("OneMesureAF1I")] == [
        "K0003",
        "north_gate",
    ]
    mark = images["IMG_1.JPG"].find("OneMesureAF1I")
    assert mark is not None
    np.testing.assert_allclose(_numbers(mark, "PtIm"), [-0.5, 1200.5], atol=1e-6)
    worst = (6.5 + np.sqrt(2.5**2 + 2.0**2)) * 1e-4  # larger eigenvalue of [[9, 2], [2, 4]]
    assert _numbers(mark, "PrecPointe")[0] == pytest.approx(np.sqrt(worst), rel=1e-6)


def _mmvii_data(text: str, tag: str) -> ET.Element:
    root = _parse(text)
    assert root.tag == "Root"
    assert root.findtext("Type") == '"MMVII_Serialization"'
    data = root.find(f"Data/{tag}")
    assert data is not None
    return data


def _mmvii_points(texts: Mapping[str, str]) -> dict[str, ET.Element]:
    data = _mmvii_data(texts["mmvii/MesGCP-kgcp.xml"], "SetGCP")
    return {_bare(entry, "Name"): entry for entry in data.findall("Measures/el")}


def test_mmvii_has_points_and_marks_with_covariances(points: MapPoints) -> None:
    texts = mmvii.files(points)
    entries = _mmvii_points(texts)
    assert [*entries] == ["K0001", "K0002", "K0003", "K0004", "north_gate"]
    enu = np.array([_numbers(entry, "Pt") for entry in entries.values()])
    back = _map_from_local(texts["mmvii/HOWTO.txt"], enu)
    expected = [point.position_map for point in points.controls[:5]]
    np.testing.assert_allclose(back, expected, atol=1e-6, rtol=0)
    upper = _numbers(entries["K0001"], "__Opt__Sigma2")
    cov = np.zeros((3, 3))
    cov[np.triu_indices(3)] = upper
    cov = cov + cov.T - np.diag(np.diag(cov))
    assert points.gcps[0].cov_m2 is not None
    np.testing.assert_allclose(
        np.linalg.eigvalsh(cov), np.linalg.eigvalsh(points.gcps[0].cov_m2), rtol=1e-9
    )
    image = _mmvii_data(texts["mmvii/MesIm-IMG_1.JPG.xml"], "SetMesIm")
    assert _bare(image, "NameIm") == "IMG_1.JPG"
    (mark,) = image.findall("Measures/el")
    np.testing.assert_allclose(_numbers(mark, "Pt"), [-0.5, 1200.5], atol=1e-6)
    np.testing.assert_allclose(_numbers(mark, "Sigma2"), [9e-4, 2e-4, 4e-4])


def test_mmvii_covariances_turn_with_the_axes(points: MapPoints) -> None:
    """Grid north is 0.55° west of true north: the covariance turns by that, as a tensor."""
    along_grid_north = replace(points.gcps[0], cov_m2=np.diag([1e-4, 1.0, 1e-4]))
    texts = mmvii.files(replace(points, gcps=(along_grid_north,)))
    xx, xy, _, yy, _, _ = _numbers(_mmvii_points(texts)["K0001"], "__Opt__Sigma2")
    turn_deg = np.degrees(0.5 * np.arctan2(2.0 * xy, yy - xx))  # of the long axis, towards east
    assert turn_deg == pytest.approx(-0.83 * np.sin(np.radians(41.4)), abs=0.01)


def test_mmvii_distances_name_image_and_point(points: MapPoints) -> None:
    """By ctopodata.cpp: `*` begins a comment; code 3, from, to, value, sigma."""
    texts = mmvii.files(points)
    names = _mmvii_points(texts)
    lines = [line.partition("*")[0].split() for line in texts["mmvii/kgcp.obs"].splitlines()]
    rows = [cells for cells in lines if cells]
    assert len(rows) == 6
    for cells, point in zip(rows, points.controls, strict=True):
        assert cells[0] == "3"
        assert f"mmvii/MesIm-{cells[1]}.xml" in texts
        assert cells[2] in names
        assert float(cells[3]) == pytest.approx(point.distance_m, abs=1e-9)
        assert float(cells[4]) == pytest.approx(point.sd_distance_m, abs=1e-9)


def test_mmvii_gets_the_coordinate_frame_of_its_points(points: MapPoints) -> None:
    """By cSysCo.cpp: RTL*x*y*z*CRS, in PROJ's order of axes, is east, north, up over that point."""
    texts = mmvii.files(points)
    definition = _bare(_mmvii_data(texts["mmvii/CurSysCo.xml"], "SysCoData"), "Def")
    kind, *place, crs = definition.split("*")
    assert kind == "RTL"
    origin = np.array([float(value) for value in place])
    to_earth = Transformer.from_crs(crs, "+proj=geocent +ellps=GRS80")
    shift = np.array(to_earth.transform(origin[0], origin[1], origin[2]))
    longitude, latitude = np.radians(origin[:2])
    about_z = Rotation.from_euler("z", longitude + 0.5 * np.pi)
    turn = (about_z * Rotation.from_euler("x", 0.5 * np.pi - latitude)).as_matrix()
    entries = _mmvii_points(texts)
    enu = np.array([_numbers(entry, "Pt") for entry in entries.values()])
    earth = (enu @ turn.T + shift).T
    back = Transformer.from_crs("EPSG:4936", "EPSG:4937", always_xy=True).transform(*earth)
    found = np.column_stack((*_GRID.transform(back[0], back[1]), back[2]))
    expected = [point.position_map for point in points.controls[:5]]
    np.testing.assert_allclose(found, expected, atol=1e-6, rtol=0)


def test_local_distances_are_true_where_those_of_the_grid_are_not(points: MapPoints) -> None:
    """80 m across the map near the zone's meridian: 0.9996 of it on the grid."""
    start = np.array([500000.0, 4583523.0, 0.0])
    ends = (start, start + np.array([80.0, 0.0, 0.0]))
    two = tuple(
        replace(point, position_map=end) for point, end in zip(points.gcps[:2], ends, strict=True)
    )
    entries = _mmvii_points(mmvii.files(replace(points, gcps=two))).values()
    first, second = (_numbers(entry, "Pt") for entry in entries)
    assert np.linalg.norm(second - first) == pytest.approx(80.0 / 0.9996, abs=1e-5)


def test_feet_become_metres(make_points: Factory) -> None:
    """US survey feet have 1200/3937 m; ellipsoidal heights are metres whatever the grid counts.

    Between the standard parallels of EPSG:2263, 40° 40′ and 41° 2′, the cone's scale is below 1 by
    (11′)²/2 = 5e-6 at most; 100 m of height stretch lengths by 100 / 6.38e6.
    """
    one = make_points().gcps[0]
    ends = ([984000.0, 200000.0, 100.0], [985000.0, 200000.0, 100.0], [984000.0, 200000.0, 110.0])
    gcps = tuple(
        replace(one, id=f"K{number}", frame=f"{number}.jpg", position_map=np.array(end))
        for number, end in enumerate(ends)
    )
    entries = _mmvii_points(mmvii.files(make_points("EPSG:2263", gcps))).values()
    first, second, above = (_numbers(entry, "Pt") for entry in entries)
    expected = 1000.0 * 1200.0 / 3937.0 * (1.0 + 100.0 / 6.38e6)
    assert np.linalg.norm(second - first) == pytest.approx(expected, rel=6e-6)
    assert above[2] - first[2] == pytest.approx(10.0, abs=1e-5)


def test_names_that_break_the_lines_are_refused(points: MapPoints) -> None:
    for frame in ("IMG 1.JPG", "IMG*1.JPG", 'IMG"1.JPG'):
        bad = replace(points, gcps=(replace(points.gcps[0], frame=frame),))
        with pytest.raises(KgcpError, match="in its name"):
            mmvii.files(bad)


def test_points_without_deviations_are_refused(points: MapPoints) -> None:
    bare = replace(points, gcps=(replace(points.gcps[0], cov_m2=None),))
    for module in (micmac, mmvii):
        with pytest.raises(KgcpError, match="K0001 has no standard deviations"):
            module.files(bare)


def test_measures_of_an_earlier_export_are_removed(points: MapPoints, tmp_path: Path) -> None:
    export(points, "mmvii", tmp_path)
    mine = tmp_path / "mmvii" / "notes.txt"
    mine.touch()
    export(replace(points, gcps=points.gcps[1:2]), "mmvii", tmp_path)
    assert [path.name for path in (tmp_path / "mmvii").glob("MesIm-*")] == ["MesIm-IMG_2.JPG.xml"]
    (tmp_path / "mmvii" / "MesIm-a.xml").mkdir()
    with pytest.raises(KgcpError, match=r"MesIm-a\.xml: is a folder"):
        export(points, "mmvii", tmp_path)
    assert mine.exists()


def test_colmap_reads_the_priors_from_its_database(
    points: MapPoints, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    export(points, "colmap", tmp_path)
    database_path = tmp_path / "database.db"
    _make_database(pycolmap, database_path, ["a/IMG_1.JPG", "a/IMG_3.JPG", "a/IMG_9.JPG"])
    script = tmp_path / "colmap" / "add_pose_priors.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(database_path)])
    runpy.run_path(str(script), run_name="__main__")
    runpy.run_path(str(script), run_name="__main__")  # twice: no doubles
    database = pycolmap.Database.open(database_path)
    priors = {prior.corr_data_id.id: prior for prior in database.read_all_pose_priors()}
    images = {image.name: image for image in database.read_all_images()}
    database.close()
    assert set(priors) == {images[name].data_id.id for name in ("a/IMG_1.JPG", "a/IMG_3.JPG")}
    how_to = (tmp_path / "colmap" / "HOWTO.txt").read_text(encoding="utf-8")
    for expected in points.priors:
        prior = priors[images[expected.frame].data_id.id]
        assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.CARTESIAN
        back = _map_from_local(how_to, np.asarray(prior.position).reshape(1, 3))
        np.testing.assert_allclose(back[0], expected.position_map, atol=1e-6, rtol=0)
        assert expected.cov is not None
        np.testing.assert_allclose(
            np.linalg.eigvalsh(prior.position_covariance),
            np.linalg.eigvalsh(expected.cov[:3, :3]),
            rtol=1e-9,
        )


def test_the_colmap_script_reports_priors_that_it_keeps_for_other_images(
    points: MapPoints,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    database_path = tmp_path / "database.db"
    _make_database(pycolmap, database_path, ["a/IMG_1.JPG", "a/IMG_3.JPG"])
    script = str(tmp_path / "colmap" / "add_pose_priors.py")
    fewer = replace(points, priors=points.priors[:1])
    for exported, arguments, kept in ((points, [], 0), (fewer, [], 1), (fewer, ["--only"], 0)):
        export(exported, "colmap", tmp_path)
        monkeypatch.setattr(sys, "argv", [script, str(database_path), *arguments])
        runpy.run_path(script, run_name="__main__")
        text = capsys.readouterr().out
        assert ("pose priors of other images kept: 1" in text) == bool(kept)
        database = pycolmap.Database.open(database_path)
        assert len(database.read_all_pose_priors()) == len(exported.priors[:2]) + kept
        database.close()


def _make_database(pycolmap: ModuleType, path: Path, names: list[str]) -> None:
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera(
        model="OPENCV", width=1600, height=1201, params=[2300, 2310, 801.8, 597.7, 0, 0, 0, 0]
    )
    camera.camera_id = database.write_camera(camera)
    for name in names:
        image = pycolmap.Image(name=name, camera_id=camera.camera_id)
        database.write_image(image)
    database.close()


def test_the_colmap_list_has_the_aligner_s_format(points: MapPoints) -> None:
    texts = colmap.files(points)
    reference = [line.split() for line in texts["colmap/reference.txt"].splitlines()]
    table = [*csv.DictReader(texts["colmap/pose_priors.csv"].splitlines())]
    assert [cells[0] for cells in reference] == ["a/IMG_1.JPG", "a/IMG_3.JPG"]
    assert [cells[1:] for cells in reference] == [[row["x"], row["y"], row["z"]] for row in table]


def test_colmap_needs_priors_with_covariances(points: MapPoints) -> None:
    for priors in ((), (replace(points.priors[0], cov=None),)):
        with pytest.raises(KgcpError, match="no camera position with a covariance"):
            colmap.files(replace(points, priors=priors))
