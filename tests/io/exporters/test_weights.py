"""Packages get accuracies that an adjustment can use; tables and maps keep the measured ones."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.weights import ASSUMED_SHARE, POINT_FLOOR_M, distance_share, with_floors
from kgcp.io.exporters.write import export

Factory = Callable[..., MapPoints]
SHARP = np.array([[4.0, 1.0], [1.0, 2.0]]) * 1e-6  # thousandths of a pixel, as of a large ring
DULL = np.array([[0.09, 0.01], [0.01, 0.04]])


@given(
    sds=st.tuples(st.floats(1e-4, 2.0), st.floats(1e-4, 2.0)),
    correlation=st.floats(-0.99, 0.99),
    floor_px=st.floats(0.0, 1.0),
)
def test_no_direction_of_a_mark_is_below_the_floor(
    sds: tuple[float, float], correlation: float, floor_px: float
) -> None:
    cross = correlation * sds[0] * sds[1]
    cov = np.array([[sds[0] ** 2, cross], [cross, sds[1] ** 2]])
    (floored,) = with_floors((point(centre_cov_px2=cov),), floor_px)
    assert floored.centre_cov_px2 is not None
    before, after = np.linalg.eigvalsh(cov), np.linalg.eigvalsh(floored.centre_cov_px2)
    np.testing.assert_allclose(after, np.maximum(before, floor_px**2), rtol=1e-6, atol=1e-12)


def point(**values: object) -> Gcp:
    plain = Gcp(
        id="K0001",
        frame="a.jpg",
        target="A",
        time_s=0.0,
        position_map=np.zeros(3),
        cov_m2=None,
        centre_px=np.zeros(2),
        centre_cov_px2=SHARP,
        distance_m=80.0,
        sd_distance_m=0.002,
        sd_common_distance_m=None,
    )
    return replace(plain, **values)  # type: ignore[arg-type]  # the caller's are of their types


def test_a_distance_has_the_share_of_calibration_and_print() -> None:
    (known,) = with_floors((point(sd_common_distance_m=0.016),), 0.1)
    assert known.sd_distance_m == pytest.approx(math.hypot(0.002, 0.016))
    (assumed,) = with_floors((point(),), 0.1)
    assert assumed.sd_distance_m == pytest.approx(math.hypot(0.002, ASSUMED_SHARE * 80.0))
    assert distance_share(point(sd_common_distance_m=0.016)) == pytest.approx(0.0002)


def test_no_point_has_an_infinite_weight() -> None:
    """Zeros are what some programs write for deviations that they do not know."""
    exact, known = np.zeros((3, 3)), np.diag([0.01, 0.02, 0.03]) ** 2
    floored, kept = with_floors((point(cov_m2=exact), point(cov_m2=known)), 0.1)
    assert floored.cov_m2 is not None
    np.testing.assert_allclose(floored.cov_m2, POINT_FLOOR_M**2 * np.eye(3))
    assert kept.cov_m2 is known


def test_what_is_unknown_stays_unknown() -> None:
    (floored,) = with_floors((point(centre_cov_px2=None, sd_distance_m=None),), 0.1)
    assert floored.cov_m2 is None
    assert floored.centre_cov_px2 is None
    assert floored.sd_distance_m is None


@pytest.fixture
def sharp(make_points: Factory) -> MapPoints:
    points = make_points()
    gcps = (replace(each, centre_cov_px2=SHARP, sd_distance_m=0.0004) for each in points.gcps)
    return replace(points, gcps=tuple(gcps))


def elements(path: Path, tag: str) -> list[str]:
    root = ET.parse(path).getroot()  # noqa: S314 - what has just been written
    return [element.text or "" for element in root.iter(tag)]


def mark_accuracies(points: MapPoints, name: str, folder: Path) -> list[float]:
    """The standard deviations of all marks in the files of a format [px]."""
    export(points, name, folder)
    if name == "pix4d":
        rows = csv.reader(io.StringIO((folder / "pix4d/marks.csv").read_text()))
        return [float(row[4]) for row in rows]
    if name == "opf":
        control = json.loads((folder / "opf/input_control_points.json").read_text())
        return [mark["accuracy"] for gcp in control["gcps"] for mark in gcp["marks"]]
    if name == "micmac":
        texts = elements(folder / "micmac/marks.xml", "PrecPointe")
        return [float(text) for text in texts]
    paths = (folder / "mmvii").glob("MesIm-*.xml")
    texts = [text for path in paths for text in elements(path, "Sigma2")]
    return [math.sqrt(float(text.split()[place])) for text in texts for place in (0, 2)]


@pytest.mark.parametrize("name", ["pix4d", "opf", "micmac", "mmvii"])
def test_marks_of_packages_have_the_floor(sharp: MapPoints, name: str, tmp_path: Path) -> None:
    for floor_px in (0.1, 0.25):
        accuracies = mark_accuracies(replace(sharp, mark_floor_px=floor_px), name, tmp_path)
        assert accuracies
        np.testing.assert_allclose(accuracies, floor_px, rtol=1e-6)
        howto = (tmp_path / name / "HOWTO.txt").read_text(encoding="utf-8")
        assert f"no standard deviation is below {floor_px:g} px (kgcp export-gcp --mark-fl" in howto
    dull = replace(sharp, gcps=tuple(replace(p, centre_cov_px2=DULL) for p in sharp.gcps))
    assert min(mark_accuracies(dull, name, tmp_path)) > 0.19, "what is worse stays as it is"
    exact = mark_accuracies(replace(sharp, mark_floor_px=0.0), name, tmp_path)
    assert max(exact) < 0.0025


def test_metashape_gets_distances_and_their_accuracy(sharp: MapPoints, tmp_path: Path) -> None:
    export(sharp, "metashape", tmp_path)
    howto = (tmp_path / "metashape/HOWTO.txt").read_text(encoding="utf-8")
    assert "has one for all: 0.100 px" in howto
    assert "the share is 0.016 % here" in howto
    rows = csv.DictReader(io.StringIO((tmp_path / "metashape/scale_bars.csv").read_text()))
    expected = math.hypot(0.0004, 0.0123456789)
    for row in rows:
        assert float(row["accuracy_m"]) == pytest.approx(expected, rel=1e-6)


def test_mmvii_gets_the_same_distances(sharp: MapPoints, tmp_path: Path) -> None:
    unknown = replace(sharp, gcps=tuple(replace(p, sd_common_distance_m=None) for p in sharp.gcps))
    export(unknown, "mmvii", tmp_path)
    lines = (tmp_path / "mmvii/kgcp.obs").read_text(encoding="utf-8").splitlines()[1:]
    for line in lines:
        _, _, _, distance_m, sd_m = line.split()
        assert float(sd_m) == pytest.approx(math.hypot(0.0004, 3e-4 * float(distance_m)), rel=1e-6)
    assert "share of 0.03 % is assumed" in (tmp_path / "mmvii/HOWTO.txt").read_text()


def test_csv_and_gis_files_keep_the_measured_accuracies(sharp: MapPoints, tmp_path: Path) -> None:
    export(sharp, "csv", tmp_path)
    with (tmp_path / "kgcps.csv").open(encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            assert float(row["sd_x_px"]) == pytest.approx(0.002)
            assert float(row["sd_distance_m"]) == pytest.approx(0.0004)
    export(sharp, "geojson", tmp_path)
    features = json.loads((tmp_path / "geojson/kgcps.geojson").read_text())["features"]
    assert {each["properties"]["sd_distance_m"] for each in features} == {0.0004}
