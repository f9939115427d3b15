"""Metashape: what the script sets, and the contents of the files."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.georef.camera_priors import opk_deg
from kgcp.io.exporters import metashape
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export
from tests.io.exporters.conftest import OWN_DATUM
from tests.io.exporters.metashape_stand_in import (
    OPK,
    YPR,
    Camera,
    Chunk,
    CoordinateSystem,
    Marker,
    Vector,
    run_script,
)

Factory = Callable[..., MapPoints]
SCRIPT = "metashape/import_into_metashape.py"


def table(text: str) -> list[dict[str, str]]:
    return [*csv.DictReader(text.splitlines())]


def chunk_of(*labels: str, folder: str | None = "/photos") -> Chunk:
    """A chunk whose labels are names, or stems, of six photos."""
    names = {f"IMG_{number}" for number in range(1, 7)}
    assert {label.partition(".")[0] for label in labels} <= names
    cameras = [
        Camera(key, label, None if folder is None else f"{folder}/{label.partition('.')[0]}.JPG")
        for key, label in enumerate(labels)
    ]
    return Chunk(cameras)


def run(points: MapPoints, folder: Path, chunk: Chunk | None, *edits: tuple[str, str]) -> None:
    export(points, "metashape", folder)
    text = (folder / SCRIPT).read_text(encoding="utf-8")
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    run_script(text, folder / SCRIPT, chunk)


def marker(chunk: Chunk, label: str) -> Marker:
    (found,) = [each for each in chunk.markers if each.label == label]
    return found


ALL = tuple(f"IMG_{number}.JPG" for number in range(1, 7))
STEMS = tuple(f"IMG_{number}" for number in range(1, 7))


@pytest.mark.parametrize("labels", [ALL, STEMS])
@pytest.mark.parametrize("folder", ["/photos", "C:\\photos", None])
@pytest.mark.parametrize("extensions", [True, False])
def test_one_run_sets_everything_whatever_the_labels(
    points: MapPoints,
    tmp_path: Path,
    labels: tuple[str, ...],
    folder: str | None,
    *,
    extensions: bool,
) -> None:
    chunk = chunk_of(*labels, folder=folder)
    for _ in range(2):  # a second run changes nothing
        run(replace(points, image_extensions=extensions), tmp_path, chunk)
    expected = {point.id.replace(" ", "_"): point for point in points.gcps}
    assert [each.label for each in chunk.markers] == [*expected]
    for label, point in expected.items():
        reference = marker(chunk, label).reference
        np.testing.assert_allclose([*reference.location], point.position_map, atol=1e-6, rtol=0)
        np.testing.assert_allclose([*reference.accuracy], [0.02, 0.03, 0.04], atol=1e-9)
        assert reference.enabled is not point.is_checkpoint
    marks = {
        (each.label, camera.key + 1): projection
        for each in chunk.markers
        for camera, projection in each.projections.items()
    }
    assert len(marks) == 7
    assert all(projection.pinned for projection in marks.values())
    # the corner of the first pixel is (0, 0): half a pixel more than kgcp's
    np.testing.assert_allclose([*marks["K0001", 1].coord], [0.0, 1201.0], atol=1e-6)
    np.testing.assert_allclose([*marks["K0002", 2].coord], [1600.0, 0.0], atol=1e-6)
    np.testing.assert_allclose([*marks["north_gate", 3].coord], [1111.5, 222.5], atol=1e-6)
    assert chunk.marker_crs.wkt == CoordinateSystem("EPSG::25831").wkt
    assert chunk.crs.wkt == CoordinateSystem("EPSG::4326").wkt, "the chunk's own stays"
    assert chunk.marker_projection_accuracy == pytest.approx(0.1)

    assert len(chunk.scalebars) == 6, "one for each ray of the points that are not for checking"
    bar = chunk.scalebars[2]
    assert bar.point0 is marker(chunk, "K0003")
    assert bar.point1 is chunk.cameras[2]
    assert bar.reference.distance == pytest.approx(81.123456, abs=1e-6)
    assert bar.reference.accuracy == pytest.approx(np.hypot(0.0153, 0.0123456789))
    assert bar.reference.enabled


def test_a_run_after_another_export_leaves_nothing_of_the_earlier_one(
    points: MapPoints, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames were added or left out: numbers go to other frames, and the last ones are free."""
    chunk = chunk_of(*STEMS)
    pillar, other = chunk.addMarker(), chunk.addMarker()
    pillar.label, other.label = "K0099", "south-K0009"  # a surveyor's, and another flight's
    chunk.addScalebar(other, chunk.cameras[0]).label = "south-K0009_IMG_1.JPG"
    run(points, tmp_path, chunk)
    fewer = [point for point in points.gcps if point.id.startswith("K")][1:4]
    renumbered = [
        replace(point, id=f"K{number:04d}", is_checkpoint=number == 3)
        for number, point in enumerate(fewer, start=1)
    ]
    gate = [point for point in points.gcps if point.id == "north gate"]
    run(replace(points, gcps=(*renumbered, *gate), priors=()), tmp_path, chunk)
    seen = {
        each.label: [camera.key + 1 for camera in each.projections.keys()]  # noqa: SIM118 - Metashape's
        for each in chunk.markers
    }
    assert {label: seen[label] for label in ("K0001", "K0002", "K0003")} == {
        point.id: [int(point.frame.partition("_")[2].partition(".")[0])] for point in renumbered
    }
    assert "K0004" not in seen
    assert {"K0099", "south-K0009", "north_gate"} <= seen.keys()
    bars = {bar.label for bar in chunk.scalebars if bar.point0.label[0] == "K"}
    assert bars == {f"{point.id}_{point.frame.partition('/')[2]}" for point in renumbered[:2]}
    assert "south-K0009_IMG_1.JPG" in {bar.label for bar in chunk.scalebars}
    assert "of an earlier run removed" in capsys.readouterr().out


def test_cameras_without_a_position_get_kgcps(points: MapPoints, tmp_path: Path) -> None:
    chunk = chunk_of(*STEMS)
    run(points, tmp_path, chunk)
    for prior, camera in zip(points.priors, (chunk.cameras[0], chunk.cameras[2]), strict=True):
        reference = camera.reference
        np.testing.assert_allclose([*reference.location], prior.position_map, atol=1e-6, rtol=0)
        np.testing.assert_allclose([*reference.rotation], opk_deg([prior])[0], atol=1e-6)
        assert reference.location_accuracy is not None
        assert next(iter(reference.location_accuracy)) == pytest.approx(0.3, rel=1e-3)
        assert 0.2 < [*reference.rotation_accuracy][2] < 0.5
        assert reference.location_enabled is reference.rotation_enabled is True
    assert chunk.euler_angles is OPK
    assert chunk.camera_crs.wkt == CoordinateSystem("EPSG::25831").wkt
    assert chunk.cameras[1].reference.location is None


@pytest.mark.parametrize("replaced", [False, True])
def test_positions_and_markers_of_others_stay_as_they_are(
    points: MapPoints, tmp_path: Path, capsys: pytest.CaptureFixture[str], *, replaced: bool
) -> None:
    """EXIF positions and another marker are in WGS 84: kgcp's are transformed into that."""
    chunk = chunk_of(*STEMS)
    for index in (0, 1):
        chunk.cameras[index].reference.location = Vector([2.17, 41.4, 200.0])
        chunk.cameras[index].reference.rotation = Vector([10.0, 0.0, 0.0])
    foreign = chunk.addMarker()
    foreign.label, foreign.reference.location = "pillar", Vector([2.17, 41.4, 170.0])
    edits = [("REPLACE_CAMERAS = False", "REPLACE_CAMERAS = True")] if replaced else []
    run(points, tmp_path, chunk, *edits)
    assert [*foreign.reference.location] == [2.17, 41.4, 170.0]
    assert chunk.marker_crs is None, "still the chunk's"
    longitude, latitude, height = marker(chunk, "K0001").reference.location
    assert (longitude, latitude) == pytest.approx((2.1696, 41.3995), abs=1e-3)
    assert height == pytest.approx(122.3456789, abs=1e-3)
    first = [*chunk.cameras[0].reference.location]
    assert first == [2.17, 41.4, 200.0] or (replaced and first[2] == pytest.approx(197.3, abs=0.1))
    assert [*chunk.cameras[1].reference.location] == [2.17, 41.4, 200.0]
    third = chunk.cameras[2].reference
    assert [*third.location][:2] == pytest.approx((2.17, 41.4), abs=1e-3)
    assert third.rotation is None, "its angles are of another system"
    assert chunk.euler_angles is YPR
    expected = "2 camera positions set, 0 left" if replaced else "1 camera positions set, 1 left"
    assert expected in capsys.readouterr().out


@pytest.mark.parametrize("extensions", [True, False])
def test_photos_with_the_same_name_are_distinguished_by_their_folders(
    points: MapPoints, tmp_path: Path, capsys: pytest.CaptureFixture[str], *, extensions: bool
) -> None:
    """As of two flights whose cameras count from 1: labels repeat, folders do not."""
    frames = ("north/IMG_1.JPG", "south/IMG_1.JPG", "south/IMG_2.JPG")
    gcps = tuple(
        replace(point, frame=frame) for point, frame in zip(points.gcps[:3], frames, strict=True)
    )
    paths = ("/data/north/frames/IMG_1.JPG", r"D:\data\south\frames\IMG_1.JPG", "/other/IMG_2.JPG")
    chunk = Chunk([Camera(key, f"IMG_{min(key, 1) + 1}", path) for key, path in enumerate(paths)])
    chunk.cameras[1].label = "IMG_1"
    run(replace(points, gcps=gcps, priors=(), image_extensions=extensions), tmp_path, chunk)
    seen = {
        each.label: [camera.key for camera, _ in each.projections.items()] for each in chunk.markers
    }
    assert seen == {"K0001": [0], "K0002": [1], "K0003": []}
    assert [bar.point1 for bar in chunk.scalebars] == chunk.cameras[:2]
    assert "1 photos are not in the chunk" in capsys.readouterr().out
    assert not (tmp_path / "metashape/markers.xml").exists(), "labels cannot tell them apart"


def test_missing_and_duplicate_photos_are_named(
    points: MapPoints, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chunk = chunk_of("IMG_1.JPG", "IMG_3.JPG", "IMG_3.JPG")
    run(points, tmp_path, chunk)
    text = capsys.readouterr().out
    assert "6 markers set\n1 projections set\n1 scale bars set\n" in text
    names = "IMG_2.JPG, IMG_3.JPG, IMG_4.JPG, IMG_5.JPG, IMG_6.JPG"
    assert f"5 photos are not in the chunk, or have a name that several have: {names}" in text


@pytest.mark.parametrize("chunk", [None, Chunk([])])
def test_a_chunk_without_photos_is_an_error(
    points: MapPoints, tmp_path: Path, chunk: Chunk | None
) -> None:
    with pytest.raises(RuntimeError, match="add them and run the script again"):
        run(points, tmp_path, chunk)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("marker.reference.accuracy", "marker.reference.location_accuracy"),
        ("bar.reference.distance", "bar.distance"),
        ("bar.reference.accuracy = float(", "bar.reference.accuracy = str("),
        ("reference.rotation_accuracy", "reference.rotation_sd"),
        ("chunk.marker_projection_accuracy", "chunk.marker_accuracy"),
        ("chunk.marker_crs = crs", "chunk.marker_crs = CRS"),
        ("Metashape.Marker.Projection(place, True)", "place"),
        ("Metashape.EulerAnglesOPK", "Metashape.EulerAngles.OPK"),
        ("chunk.addScalebar(markers[row", "chunk.addScalebar(row[row"),
    ],
)
def test_the_stand_in_refuses_what_the_reference_does_not_have(
    points: MapPoints, tmp_path: Path, right: str, wrong: str
) -> None:
    with pytest.raises((AttributeError, TypeError, KeyError)):
        run(points, tmp_path, chunk_of(*STEMS), (right, wrong))


@pytest.mark.parametrize(
    ("crs", "definition"),
    [
        ("EPSG:25831", "CRS = 'EPSG::25831'"),
        ("EPSG:4979", "CRS = 'EPSG::4326'"),
        ("EPSG:25831+5773", "CRS = 'COMPD_CS["),
        ("+proj=tmerc +lat_0=41 +lon_0=2 +ellps=GRS80", "CRS = 'PROJCS["),
        (OWN_DATUM, "TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7]"),
    ],
)
def test_the_script_knows_the_crs(points: MapPoints, crs: str, definition: str) -> None:
    text = metashape.files(replace(points, crs=crs, priors=()))[SCRIPT]
    assert definition in text
    assert "@" not in text


def test_unknown_values_keep_metashape_s_defaults(points: MapPoints, tmp_path: Path) -> None:
    unknown = (
        replace(point, cov_m2=None, centre_cov_px2=None, sd_distance_m=None)
        for point in points.gcps
    )
    chunk = chunk_of(*STEMS)
    run(replace(points, gcps=tuple(unknown)), tmp_path, chunk)
    assert marker(chunk, "K0001").reference.accuracy is None
    assert chunk.scalebars[0].reference.accuracy is None
    assert chunk.marker_projection_accuracy == 0.5


def test_markers_have_longitude_first(in_degrees: MapPoints) -> None:
    (row,) = table(metashape.files(in_degrees)["metashape/markers.csv"])
    assert (float(row["x"]), float(row["y"])) == pytest.approx(
        (2.1701234567, 41.4007654321), abs=1e-11
    )


@pytest.mark.parametrize("extensions", [True, False])
def test_the_xml_has_the_same_marks_and_points(points: MapPoints, *, extensions: bool) -> None:
    points = replace(points, image_extensions=extensions)
    texts = metashape.files(points)
    chunk = ET.fromstring(texts["metashape/markers.xml"].encode()).find("chunk")  # noqa: S314 - has just been written
    assert chunk is not None
    size = chunk.find("sensors/sensor/resolution")
    assert size is not None
    assert (size.get("width"), size.get("height")) == ("1600", "1201")
    cameras = {str(one.get("id")): one.get("label") for one in chunk.findall("cameras/camera")}
    markers = {str(one.get("id")): one for one in chunk.findall("markers/marker")}
    seen = {
        (
            markers[str(rays.get("marker_id"))].get("label"),
            cameras[str(ray.get("camera_id"))],
            float(str(ray.get("x"))),
            float(str(ray.get("y"))),
        )
        for rays in chunk.findall("frames/frame/markers/marker")
        for ray in rays.findall("location")
    }
    rows = table(texts["metashape/marks.csv"])
    assert seen == {
        (row["marker"], row["camera"], float(row["x_px"]), float(row["y_px"])) for row in rows
    }
    assert len(seen) == 7
    assert {row["camera"].endswith(".JPG") for row in rows} == {extensions}
    reference = markers["2"].find("reference")
    assert reference is not None
    where = [float(str(reference.get(name))) for name in "xyz"]
    np.testing.assert_allclose(where, points.gcps[2].position_map, atol=1e-6, rtol=0)


def test_stems_that_two_photos_share_are_refused(points: MapPoints) -> None:
    raw = replace(points.gcps[1], frame="a/IMG_1.TIF")
    both = replace(points, gcps=(points.gcps[0], raw), priors=())
    metashape.files(both)
    with pytest.raises(KgcpError, match="same file name 'a/IMG_1'"):
        metashape.files(replace(both, image_extensions=False))
