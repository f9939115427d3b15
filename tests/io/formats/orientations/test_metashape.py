"""Poses of Metashape, whose world is geocentric."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.orientations.records import OrientationFileOptions

NAMES = tuple(f"DJI_{index:04d}.JPG" for index in range(7))
Truth = Mapping[str, FloatArray]
Check = Callable[[ReferencePoses, FloatArray, FloatArray], None]


GEOGRAPHIC = CRS("EPSG:4326").to_wkt("WKT1_GDAL")
LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'


def numbers(values: FloatArray) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


def metashape_document(
    truth: Truth, reference: str, *, in_component: bool, with_world: bool = True
) -> str:
    """Poses in a chunk that is turned, shifted and 12.354 times smaller than the world."""
    turn = Rotation.from_euler("xyz", [20.0, -50.0, 130.0], degrees=True).as_matrix()
    scale, origin = 12.354, truth["ecef"].mean(axis=0)
    cameras = []
    for name, centre, rotation in zip(NAMES, truth["ecef"], truth["ecef_from_photo"], strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = turn.T @ rotation @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = turn.T @ (centre - origin) / scale
        label = name.removesuffix(".JPG")
        cameras.append(
            f'<camera id="0" sensor_id="0" component_id="4" label="{label}" enabled="true">'
            f'<transform>{numbers(matrix)}</transform><reference x="1" y="2" z="3"/></camera>'
        )
    world = (
        f"<transform><rotation>{numbers(turn)}</rotation><translation>{numbers(origin)}"
        f"</translation><scale>{scale}</scale></transform>"
    )
    world = world if with_world else ""
    component = f'<components><component id="4">{world}</component></components>'
    return (
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1">'
        f'<sensors next_id="0"/>{component if in_component else ""}'
        f'<cameras next_id="9"><camera id="8" label="unaligned"/><group label="g">'
        f"{''.join(cameras)}</group></cameras>"
        f"<reference>{reference}</reference>{'' if in_component else world}</chunk></document>"
    )


@pytest.mark.parametrize("in_component", [True, False])
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32631"])
def test_metashape_s_world_is_geocentric_whatever_the_chunk_s_crs(
    tmp_path: Path, truth: Truth, check: Check, crs: str, *, in_component: bool
) -> None:
    path = tmp_path / "cameras.xml"
    wkt = CRS(crs).to_wkt("WKT1_GDAL")
    path.write_text(metashape_document(truth, wkt, in_component=in_component))
    poses = read_reference_poses(path, crs="EPSG:32631", frames=[f"b/{name}" for name in NAMES])
    assert poses.frames == tuple(f"b/{name}" for name in NAMES)  # labels lack the extension
    check(poses, truth["utm"], truth["utm_from_photo"])
    with pytest.raises(KgcpError, match=r"names its CRS already; delete \[reference\]"):
        read_reference_poses(path, OrientationFileOptions(crs="EPSG:32631"), crs="EPSG:32631")


def test_metashape_s_local_coordinates_are_taken_in_the_stated_crs(
    tmp_path: Path, truth: Truth, check: Check
) -> None:
    path = tmp_path / "cameras.xml"
    path.write_text(metashape_document(truth, LOCAL, in_component=False))
    with pytest.raises(KgcpError, match="is in local coordinates; align it to a map"):
        read_reference_poses(path, crs="EPSG:32631")
    stated = OrientationFileOptions(crs="EPSG:4978")
    poses = read_reference_poses(path, stated, crs="EPSG:32631")
    check(poses, truth["utm"], truth["utm_from_photo"])
    path.write_text(metashape_document(truth, GEOGRAPHIC, in_component=True, with_world=False))
    with pytest.raises(KgcpError, match="has cameras without a transform to the world; align"):
        read_reference_poses(path, crs="EPSG:32631")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<scale>12.354</scale>", "<scale>big</scale>", "component 4 transform scale: holds 'big'"),
        ("GEOGCS[", "GEOGRAPH[", "chunk reference: is not a CRS that pyproj reads"),
        ("</document>", "<chunk/></document>", "holds 2 chunks instead of one; export one chunk"),
        (" 0 0 0 1</transform>", "</transform>", "transform: holds '.*' instead of 16 finite"),
    ],
)
def test_a_damaged_metashape_file_is_refused_with_the_reason(
    tmp_path: Path, truth: Truth, old: str, new: str, words: str
) -> None:
    path = tmp_path / "cameras.xml"
    text = metashape_document(truth, GEOGRAPHIC, in_component=True)
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(KgcpError, match=words) as caught:
        read_reference_poses(path, crs="EPSG:32631")
    assert "\n" not in str(caught.value)


def test_a_mirrored_camera_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    path.write_text(
        '<document><chunk><cameras><camera label="a"><transform>'
        "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk></document>"
    )
    with pytest.raises(KgcpError, match="camera 'a': has a matrix that is not a rotation"):
        read_reference_poses(path, OrientationFileOptions(crs="EPSG:32631"), crs="EPSG:32631")
