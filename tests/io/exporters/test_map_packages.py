"""Pix4D, OPF and OpenSfM: what readers of these formats get from the files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from kgcp.errors import KgcpError, KgcpWarning
from kgcp.io.exporters import metashape, opensfm, opf, pix4d
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export
from tests.io.exporters.conftest import OWN_DATUM

Factory = Callable[..., MapPoints]


def test_separators_in_file_names_are_refused(points: MapPoints) -> None:
    bad = replace(points, gcps=(replace(points.gcps[0], frame="a/IMG,1.JPG"),))
    for module in (metashape, pix4d):
        with pytest.raises(KgcpError, match="in its name"):
            module.files(bad)
    spaced = replace(points, gcps=(replace(points.gcps[0], frame="a/IMG 1.JPG"),), priors=())
    assert "IMG 1.JPG" in metashape.files(spaced)["metashape/scale_bars.csv"]
    assert "IMG 1.JPG" in pix4d.files(spaced)["pix4d/marks.csv"]


# --- Pix4D -------------------------------------------------------------------------------------


def test_pix4d_gets_points_and_marks(points: MapPoints) -> None:
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


@pytest.mark.parametrize(
    ("crs", "tolerance"),
    [("EPSG:4326", 1e-11), ("EPSG:2180", 1e-6), ("EPSG:32661", 1e-6), ("EPSG:32761", 1e-6)],
)
def test_pix4d_and_opf_follow_the_axes_of_the_crs(
    in_degrees: MapPoints, crs: str, tolerance: float
) -> None:
    """EPSG defines 4326 as latitude, longitude and the others as northing, easting."""
    points = replace(in_degrees, crs=crs)
    x, y, z = points.gcps[0].position_map
    (row,) = [line.split(",") for line in pix4d.files(points)["pix4d/gcps.csv"].splitlines()]
    assert [*map(float, row[1:4])] == pytest.approx([y, x, z], abs=tolerance)
    (gcp,) = json.loads(opf.files(points)["opf/input_control_points.json"])["gcps"]
    assert gcp["geolocation"]["coordinates"] == [y, x, z]
    assert gcp["geolocation"]["sigmas"] == pytest.approx([0.03, 0.02, 0.04])
    assert "latitude or northing first" in " ".join(pix4d.files(points)["pix4d/HOWTO.txt"].split())


@pytest.mark.parametrize(
    ("crs", "metres_per_unit_of_z"), [("EPSG:2263", 1.0), ("EPSG:2263+6360", 1200 / 3937)]
)
def test_accuracies_of_pix4d_have_the_units_of_the_coordinates(
    points: MapPoints, crs: str, metres_per_unit_of_z: float
) -> None:
    def accuracies(points: MapPoints) -> list[float]:
        first = pix4d.files(points)["pix4d/gcps.csv"].splitlines()[0]
        return [*map(float, first.split(",")[4:])]

    horizontal_m, vertical_m = accuracies(points)
    horizontal, vertical = accuracies(replace(points, crs=crs, priors=()))
    assert horizontal == pytest.approx(horizontal_m * 3937 / 1200, abs=1e-8)
    assert vertical == pytest.approx(vertical_m / metres_per_unit_of_z, abs=1e-8)


def test_the_lines_of_pix4d_have_as_many_cells_each(points: MapPoints) -> None:
    first, *others = points.gcps
    mixed = replace(points, gcps=(replace(first, cov_m2=None), *others))
    rows = pix4d.files(mixed)["pix4d/gcps.csv"].splitlines()
    assert {len(row.split(",")) for row in rows} == {4}


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


@pytest.mark.parametrize(
    ("crs", "swaps", "unit_m"),
    [
        ("EPSG:25831", False, 1.0),
        ("EPSG:2180", True, 1.0),
        ("EPSG:2263", False, 1200 / 3937),
        ("EPSG:32661", True, 1.0),
        ("EPSG:5041", False, 1.0),
    ],
)
def test_the_scene_frame_brings_points_near_zero_in_right_handed_metres(
    points: MapPoints, tmp_path: Path, crs: str, unit_m: float, *, swaps: bool
) -> None:
    pytest.importorskip("pyopf")
    from pyopf.io import load
    from pyopf.resolve import resolve

    export(replace(points, crs=crs, priors=()), "opf", tmp_path)
    project = resolve(load(tmp_path / "opf" / "project.opf"))
    frame = project.scene_reference_frame
    step = frame.base_to_canonical
    assert step.swap_xy is swaps
    gcps = project.input_control_points.gcps
    assert frame.crs.definition == gcps[0].geolocation.crs.definition
    for gcp, point in zip(gcps, points.gcps, strict=False):
        metres = np.array(gcp.geolocation.coordinates) * step.scale
        near = (metres[[1, 0, 2]] if swaps else metres) + step.shift
        assert np.abs(near).max() < 110.0
        first = points.gcps[0].position_map
        east, north, up = (point.position_map - first) * [unit_m, unit_m, 1.0]
        at_first = np.array(gcps[0].geolocation.coordinates) * step.scale
        offset = near - ((at_first[[1, 0, 2]] if swaps else at_first) + step.shift)
        np.testing.assert_allclose(offset, [east, north, up], atol=1e-6)


def test_ellipsoidal_heights_in_feet_are_stated_or_refused(points: MapPoints) -> None:
    crs = "+proj=utm +zone=31 +ellps=GRS80 +units=us-ft +vunits=us-ft +type=crs"
    in_feet = replace(points, crs=crs, priors=())
    (gcp, *_) = json.loads(opf.files(in_feet)["opf/input_control_points.json"])["gcps"]
    stated = CRS.from_user_input(gcp["geolocation"]["crs"]["definition"])
    assert [axis.unit_name for axis in stated.axis_info] == 3 * ["US survey foot"]
    with pytest.raises(KgcpError, match="has no form that Metashape reads"):
        metashape.files(in_feet)


def test_opf_keeps_the_datum_of_a_proj_string(points: MapPoints) -> None:
    own = replace(points, crs=OWN_DATUM, priors=())
    frame = json.loads(opf.files(own)["opf/scene_reference_frame.json"])
    assert "598.1" in frame["crs"]["definition"]


def test_points_in_degrees_have_no_scene_frame(
    points: MapPoints, in_degrees: MapPoints, tmp_path: Path
) -> None:
    export(points, "opf", tmp_path)
    export(in_degrees, "opf", tmp_path)
    assert not (tmp_path / "opf/scene_reference_frame.json").exists()
    assert "scene_reference_frame" not in (tmp_path / "opf/project.opf").read_text("utf-8")


def test_opf_escapes_paths_and_states_the_length_of_feet(make_points: Factory) -> None:
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


def test_opensfm_gets_camera_positions(points: MapPoints) -> None:
    shots = json.loads(opensfm.files(points)["opensfm/exif_overrides.json"])
    to_grid = Transformer.from_crs("EPSG:4326", "EPSG:25831", always_xy=True)
    for prior in points.priors:
        gps = shots[prior.frame.rpartition("/")[2]]["gps"]
        back = (*to_grid.transform(gps["longitude"], gps["latitude"]), gps["altitude"])
        np.testing.assert_allclose(back, prior.position_map, atol=1e-6, rtol=0)
        assert gps["dop"] == pytest.approx(0.4, rel=1e-3)


def test_opensfm_gets_points_converted_to_wgs84(make_points: Factory) -> None:
    """The old observatory of Bern, origin of CH1903+, by swisstopo's formulae for WGS 84.

    Their constant terms, in 10 000″; the formulae hold to 0.12″ and 0.08″. On CH1903+ itself the
    place is at 7° 26′ 22.50″, 46° 57′ 08.66″: 3.4″ and 4.8″ away.
    """
    point = replace(make_points().gcps[0], position_map=np.array([2600000.0, 1200000.0, 600.0]))
    with pytest.warns(KgcpWarning, match="opensfm: .* is good to 1 m only"):
        texts = opensfm.files(make_points("EPSG:2056", (point,)))
    (entry,) = json.loads(texts["opensfm/ground_control_points.json"])["points"]
    assert entry["position"]["longitude"] == pytest.approx(2.6779094 * 1e4 / 3600, abs=3e-5)
    assert entry["position"]["latitude"] == pytest.approx(16.9023892 * 1e4 / 3600, abs=3e-5)


def test_an_unknown_datum_is_an_error(make_points: Factory) -> None:
    points = make_points("+proj=tmerc +lat_0=41 +lon_0=2 +ellps=GRS80")
    with pytest.raises(KgcpError, match=r"opensfm: .*WGS 84"):
        opensfm.files(points)
