"""RealityScan: the files have the form that its help describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.exporters import realityscan
from kgcp.io.exporters.points import MapPoints

Factory = Callable[..., MapPoints]


def rows(text: str, columns: int) -> list[list[str]]:
    """By groundcontrol.xml and measurementsimport.xml: `,` separates, `#` and `;` are comments."""
    lines = [line for line in text.splitlines() if line[0] not in "#;"]
    cells = [line.split(",") for line in lines]
    assert all(len(row) == columns for row in cells)
    return cells


def test_points_have_their_three_accuracies(points: MapPoints) -> None:
    texts = realityscan.files(points)
    controls = rows(texts["realityscan/ground_control.csv"], 7)
    assert [row[0] for row in controls] == ["K0001", "K0002", "K0003", "K0004", "north_gate"]
    for row, point in zip(controls, points.controls, strict=False):
        np.testing.assert_allclose([*map(float, row[1:4])], point.position_map, atol=1e-6, rtol=0)
        np.testing.assert_allclose([*map(float, row[4:])], [0.02, 0.03, 0.04], atol=1e-9)
    (check,) = rows(texts["realityscan/checkpoints.csv"], 7)
    assert check[0] == "K0005"


def test_longitude_comes_first(in_degrees: MapPoints) -> None:
    (row,) = rows(realityscan.files(in_degrees)["realityscan/ground_control.csv"], 7)
    assert [*map(float, row[1:3])] == pytest.approx([2.1701234567, 41.4007654321], abs=1e-11)


@pytest.mark.parametrize(("extensions", "name"), [(True, "IMG_1.JPG"), (False, "IMG_1")])
def test_image_coordinates_count_from_the_corner_of_the_frame(
    points: MapPoints, name: str, *, extensions: bool
) -> None:
    texts = realityscan.files(replace(points, image_extensions=extensions))
    marks = rows(texts["realityscan/measurements.csv"], 5)
    assert len(marks) == 7
    assert marks[0][:2] == [name, "K0001"]
    assert [*map(float, marks[0][2:4])] == pytest.approx([0.0, 1201.0], abs=1e-6)
    assert float(marks[0][4]) == pytest.approx(0.0312, abs=1e-4)
    assert {row[1] for row in marks} >= {"K0005", "north_gate"}


def test_names_that_would_be_read_as_comments_are_refused(points: MapPoints) -> None:
    for bad in ("IMG#1.JPG", "IMG;1.JPG"):
        frame = replace(points.gcps[0], frame=bad)
        with pytest.raises(KgcpError, match="in its name"):
            realityscan.files(replace(points, gcps=(frame,)))


def test_points_without_accuracies_are_refused(points: MapPoints) -> None:
    unknown = replace(points.gcps[0], cov_m2=None)
    with pytest.raises(KgcpError, match="no standard deviations"):
        realityscan.files(replace(points, gcps=(unknown,)))
