"""Metashape, Pix4D, OPF and OpenSfM: what a reader of the format gets out of the files."""

from __future__ import annotations

import csv
import json
import runpy
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from pyproj import Transformer

from kgcp.errors import KgcpError
from kgcp.georef.camera_priors import opk_deg
from kgcp.io.exporters import metashape, opensfm, opf, pix4d
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export

Factory = Callable[..., MapPoints]


def _table(text: str) -> list[dict[str, str]]:
    return [*csv.DictReader(text.splitlines())]


def _xyz(row: dict[str, str]) -> list[float]:
    return [float(row[name]) for name in "xyz"]


# --- Metashape ---------------------------------------------------------------------------------


def test_metashape_markers_have_accuracies_and_roles(points: MapPoints) -> None:
    rows = _table(metashape.files(points)["metashape/markers.csv"])
    expected = points.gcps[:6]  # the gate once
    assert [row["label"] for row in rows] == [
        *(point.id for point in expected[:5]),
        "north_gate",
    ]
    for row, point in zip(rows, expected, strict=True):
        np.testing.assert_allclose(_xyz(row), point.position_map, atol=1e-6, rtol=0)
        sds = [float(row[f"accuracy_{axis}_m"]) for axis in "xyz"]
        np.testing.assert_allclose(sds, [0.02, 0.03, 0.04], atol=1e-9)
        assert row["enabled"] == str(int(not point.is_checkpoint))


def test_metashape_has_longitude_first(in_degrees: MapPoints) -> None:
    (row,) = _table(metashape.files(in_degrees)["metashape/markers.csv"])
    assert (float(row["x"]), float(row["y"])) == pytest.approx(
        (2.1701234567, 41.4007654321), abs=1e-11
    )


def test_metashape_marks_begin_at_the_corner(points: MapPoints) -> None:
    text = metashape.files(points)["metashape/markers.xml"]
    chunk = ET.fromstring(text.encode()).find("chunk")  # noqa: S314 - has just been written
    assert chunk is not None
    size = chunk.find("sensors/sensor/resolution")
    assert size is not None
    assert (size.get("width"), size.get("height")) == ("1600", "1201")
    cameras = {str(one.get("id")): one.get("label") for one in chunk.findall("cameras/camera")}
    markers = {str(one.get("id")): one for one in chunk.findall("markers/marker")}
    seen = {}
    for rays in chunk.findall("frames/frame/markers/marker"):
        label = markers[str(rays.get("marker_id"))].get("label")
        for ray in rays.findall("location"):
            key = (label, cameras[str(ray.get("camera_id"))])
            seen[key] = (float(str(ray.get("x"))), float(str(ray.get("y"))))
    assert len(seen) == 7
    assert seen["K0001", "IMG_1.JPG"] == pytest.approx((0.0, 1201.0), abs=1e-6)
    assert seen["K0002", "IMG_2.JPG"] == pytest.approx((1600.0, 0.0), abs=1e-6)
    assert seen["K0003", "IMG_3.JPG"] == pytest.approx((812.8456789, 78.2654321), abs=1e-6)
    assert seen["north_gate", "IMG_3.JPG"] == pytest.approx((1111.5, 222.5), abs=1e-6)
    reference = markers["2"].find("reference")
    assert reference is not None
    where = [float(str(reference.get(name))) for name in "xyz"]
    np.testing.assert_allclose(where, points.gcps[2].position_map, atol=1e-6, rtol=0)


def test_metashape_cameras_have_angles_and_accuracies(points: MapPoints) -> None:
    rows = _table(metashape.files(points)["metashape/cameras.csv"])
    for row, prior in zip(rows, points.priors, strict=True):
        np.testing.assert_allclose(_xyz(row), prior.position_map, atol=1e-6, rtol=0)
        angles = [float(row[f"{name}_deg"]) for name in ("omega", "phi", "kappa")]
        np.testing.assert_allclose(angles, opk_deg([prior])[0], atol=1e-6)
        assert float(row["accuracy_x_m"]) == pytest.approx(0.3, rel=1e-3)
        assert 0.2 < float(row["accuracy_kappa_deg"]) < 0.5


@dataclass
class FakeBar:
    """What the script touches of Metashape.Scalebar."""

    point0: object
    point1: object
    label: str = ""
    reference: SimpleNamespace = field(default_factory=SimpleNamespace)


@dataclass
class FakeChunk:
    markers: list[SimpleNamespace]
    cameras: list[SimpleNamespace]
    scalebars: list[FakeBar] = field(default_factory=list)

    def addScalebar(self, point0: object, point1: object) -> FakeBar:  # noqa: N802 - Metashape's
        self.scalebars.append(FakeBar(point0, point1))
        return self.scalebars[-1]


def test_the_script_adds_scale_bars_from_markers_to_cameras(
    points: MapPoints,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    export(points, "metashape", tmp_path)
    markers = [SimpleNamespace(label=name) for name in ("K0001", "K0002", "K0003", "north_gate")]
    cameras = [
        SimpleNamespace(label="IMG_1", photo=None),  # labels may lack the extension
        SimpleNamespace(label="renamed", photo=SimpleNamespace(path="/photos/IMG_3.JPG")),
    ]
    chunk = FakeChunk(markers, cameras)
    fake = ModuleType("Metashape")
    fake.app = SimpleNamespace(document=SimpleNamespace(chunk=chunk))  # type: ignore[attr-defined] # a stand-in
    monkeypatch.setitem(sys.modules, "Metashape", fake)
    script = tmp_path / "metashape" / "add_scale_bars.py"
    for _ in range(2):  # twice: the same bars
        runpy.run_path(str(script), run_name="__main__")
    assert [(bar.point0, bar.point1) for bar in chunk.scalebars] == [
        (markers[0], cameras[0]),
        (markers[2], cameras[1]),
        (markers[3], cameras[1]),
    ]
    assert chunk.scalebars[1].reference.distance == pytest.approx(81.123456, abs=1e-6)
    assert chunk.scalebars[1].reference.accuracy == pytest.approx(np.hypot(0.0153, 0.0123456789))
    assert "3 scale bars set, 3 rows" in capsys.readouterr().out


def test_separators_in_file_names_are_refused(points: MapPoints) -> None:
    bad = replace(points, gcps=(replace(points.gcps[0], frame="a/IMG,1.JPG"),))
    for module in (metashape, pix4d):
        with pytest.raises(KgcpError, match="in its name"):
            module.files(bad)
    spaced = replace(points, gcps=(replace(points.gcps[0], frame="a/IMG 1.JPG"),), priors=())
    assert "IMG 1.JPG" in metashape.files(spaced)["metashape/scale_bars.csv"]
    assert "IMG 1.JPG" in pix4d.files(spaced)["pix4d/marks.csv"]


# --- Pix4D -------------------------------------------------------------------------------------


def test_pix4d_points_and_marks(points: MapPoints) -> None:
    texts = pix4d.files(points)
    rows = [line.split(",") for line in texts["pix4d/gcps.csv"].splitlines()]
    assert [row[0] for row in rows] == ["K0001", "K0002", "K0003", "K0004", "north_gate"]
    for row, point in zip(rows, points.controls[:5], strict=True):
        np.testing.assert_allclose([*map(float, row[1:4])], point.position_map, atol=1e-6, rtol=0)
        worst = (6.5 + np.sqrt(2.5**2 + 1.0**2)) * 1e-4  # larger eigenvalue of [[4, 1], [1, 9]]
        assert float(row[4]) == pytest.approx(np.sqrt(worst), abs=1e-8)
        assert float(row[5]) == pytest.approx(0.04, abs=1e-8)
    assert [line.split(",")[0] for line in texts["pix4d/checkpoints.csv"].splitlines()] == ["K0005"]
    marks = [line.split(",") for line in texts["pix4d/marks.csv"].splitlines()]
    assert len(marks) == 7
    assert marks[0][:2] == ["IMG_1.JPG", "K0001"]
    assert [*map(float, marks[0][2:4])] == pytest.approx([0.0, 1201.0], abs=1e-6)
    assert float(marks[0][4]) == pytest.approx(0.0312, abs=1e-4)


@pytest.mark.parametrize(("crs", "tolerance"), [("EPSG:4326", 1e-11), ("EPSG:2180", 1e-6)])
def test_pix4d_and_opf_follow_the_axes_of_the_crs(
    in_degrees: MapPoints, crs: str, tolerance: float
) -> None:
    """EPSG defines 4326 as latitude, longitude and 2180 as northing, easting."""
    points = replace(in_degrees, crs=crs)
    x, y, z = points.gcps[0].position_map
    (row,) = [line.split(",") for line in pix4d.files(points)["pix4d/gcps.csv"].splitlines()]
    assert [*map(float, row[1:4])] == pytest.approx([y, x, z], abs=tolerance)
    (gcp,) = json.loads(opf.files(points)["opf/input_control_points.json"])["gcps"]
    assert gcp["geolocation"]["coordinates"] == [y, x, z]
    assert gcp["geolocation"]["sigmas"] == pytest.approx([0.03, 0.02, 0.04])
    assert "latitude or northing first" in " ".join(pix4d.files(points)["pix4d/HOWTO.txt"].split())


# --- OPF ---------------------------------------------------------------------------------------


def test_pyopf_reads_the_project(points: MapPoints, tmp_path: Path) -> None:
    pytest.importorskip("pyopf")
    from pyopf.io import load
    from pyopf.resolve import resolve

    export(points, "opf", tmp_path)
    project = resolve(load(tmp_path / "opf" / "project.opf"))
    images = {camera.id: camera.uri for camera in project.camera_list.cameras}
    gcps = {gcp.id: gcp for gcp in project.input_control_points.gcps}
    assert [*gcps] == ["K0001", "K0002", "K0003", "K0004", "K0005", "north gate"]
    for point in points.gcps:
        gcp = gcps[point.id]
        location = gcp.geolocation
        assert location.crs.definition == "EPSG:25831"
        np.testing.assert_allclose(location.coordinates, point.position_map, atol=1e-6, rtol=0)
        np.testing.assert_allclose(location.sigmas, [0.02, 0.03, 0.04])
        assert gcp.is_checkpoint is point.is_checkpoint
        marks = {images[mark.camera_id]: mark for mark in gcp.marks}
        mark = marks[point.frame]
        np.testing.assert_allclose(mark.position_px, point.centre_px + 0.5, atol=1e-6)
        assert mark.accuracy == pytest.approx(0.1), "the floor"
    assert len(gcps["north gate"].marks) == 2
    np.testing.assert_allclose(gcps["K0001"].marks[0].position_px, [0.0, 1201.0], atol=1e-9)


def test_opf_escapes_paths_and_says_what_feet_are(make_points: Factory) -> None:
    point = make_points().gcps[0]
    spaced = replace(point, frame="a/IMG 1.JPG", position_map=np.array([987000.0, 2e5, 100.0]))
    texts = opf.files(make_points("EPSG:2263", (spaced,)))
    assert '"a/IMG%201.JPG"' in texts["opf/camera_list.json"]
    (gcp,) = json.loads(texts["opf/input_control_points.json"])["gcps"]
    definition = gcp["geolocation"]["crs"]["definition"]
    assert definition.startswith("PROJCRS[")  # a bare code would put heights in feet
    assert gcp["geolocation"]["sigmas"] == pytest.approx(
        [0.02 * 3937 / 1200, 0.03 * 3937 / 1200, 0.04]
    )


# --- OpenSfM -----------------------------------------------------------------------------------


def test_opensfm_reads_the_same_points_and_pixels(points: MapPoints) -> None:
    entries = json.loads(opensfm.files(points)["opensfm/ground_control_points.json"])["points"]
    assert [entry["id"] for entry in entries] == ["K0001", "K0002", "K0003", "K0004", "north gate"]
    to_grid = Transformer.from_crs("EPSG:4326", "EPSG:25831", always_xy=True)
    rays = {}
    for entry, point in zip(entries, points.controls, strict=False):
        lla = entry["position"]
        back = (*to_grid.transform(lla["longitude"], lla["latitude"]), lla["altitude"])
        np.testing.assert_allclose(back, point.position_map, atol=1e-6, rtol=0)
        for ray in entry["observations"]:
            # geometry.rst: normalised by the longer side from the middle of the pixel grid
            rays[entry["id"], ray["shot_id"]] = np.array(ray["projection"]) * 1600.0 + [
                799.5,
                600.0,
            ]
    assert len(rays) == 6
    for point in points.controls:
        pixel = rays[point.id, point.frame.rpartition("/")[2]]
        np.testing.assert_allclose(pixel, point.centre_px, atol=1e-6)
    (edge,) = entries[0]["observations"]
    assert edge["projection"] == pytest.approx([-0.5, 600.5 / 1600.0], abs=1e-9)


def test_opensfm_camera_positions(points: MapPoints) -> None:
    shots = json.loads(opensfm.files(points)["opensfm/exif_overrides.json"])
    to_grid = Transformer.from_crs("EPSG:4326", "EPSG:25831", always_xy=True)
    for prior in points.priors:
        gps = shots[prior.frame.rpartition("/")[2]]["gps"]
        back = (*to_grid.transform(gps["longitude"], gps["latitude"]), gps["altitude"])
        np.testing.assert_allclose(back, prior.position_map, atol=1e-6, rtol=0)
        assert gps["dop"] == pytest.approx(0.4, rel=1e-3)


def test_opensfm_shifts_datums(make_points: Factory) -> None:
    """The old observatory of Bern, origin of CH1903+, by swisstopo's formulae for WGS 84.

    Their constant terms, in 10 000″; the formulae hold to 0.12″ and 0.08″. On CH1903+ itself the
    place is at 7° 26′ 22.50″, 46° 57′ 08.66″: 3.4″ and 4.8″ away.
    """
    point = replace(make_points().gcps[0], position_map=np.array([2600000.0, 1200000.0, 600.0]))
    texts = opensfm.files(make_points("EPSG:2056", (point,)))
    (entry,) = json.loads(texts["opensfm/ground_control_points.json"])["points"]
    assert entry["position"]["longitude"] == pytest.approx(2.6779094 * 1e4 / 3600, abs=3e-5)
    assert entry["position"]["latitude"] == pytest.approx(16.9023892 * 1e4 / 3600, abs=3e-5)


def test_an_unknown_datum_is_an_error_and_no_guess(make_points: Factory) -> None:
    points = make_points("+proj=tmerc +lat_0=41 +lon_0=2 +ellps=GRS80")
    with pytest.raises(KgcpError, match=r"opensfm: .*WGS 84"):
        opensfm.files(points)
