"""Poses of Pix4D: its text, and OPF as its own library writes it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from pyopf.cameras import CalibratedCameras, CameraData, CameraList
from pyopf.cameras.calibrated_cameras import CalibratedCamera
from pyopf.crs import BaseToTranslatedCanonicalCrsTransform, Crs, SceneReferenceFrame
from pyopf.io import save
from pyopf.uid64 import Uid64
from pyproj import CRS, Transformer

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, opk_from_rotation, rotation_from_opk
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.orientations.records import OrientationFileOptions

NAMES = tuple(f"DJI_{index:04d}.JPG" for index in range(7))
Truth = Mapping[str, FloatArray]
Check = Callable[[ReferencePoses, FloatArray, FloatArray], None]


# --- Pix4D


def pix4d_file(folder: Path, position: FloatArray, rotation: FloatArray) -> Path:
    lines = ["imageName X Y Z Omega Phi Kappa"]
    for name, xyz, opk in zip(NAMES, position, opk_from_rotation(rotation), strict=True):
        lines.append(" ".join((name, *(f"{value:.12f}" for value in (*xyz, *opk)))))
    path = folder / "calibrated_external_camera_parameters.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_pix4d_angles_are_those_of_the_conventions(
    tmp_path: Path, truth: Truth, check: Check
) -> None:
    path = pix4d_file(tmp_path, truth["utm"], truth["utm_from_photo"])
    check(read_reference_poses(path), truth["utm"], truth["utm_from_photo"])
    moved = read_reference_poses(path, OrientationFileOptions(crs="EPSG:32631"), crs="EPSG:4326")
    np.testing.assert_allclose(moved.position_map, truth["geodetic"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        rotation_from_opk(moved.opk_deg), truth["enu_from_photo"], rtol=0, atol=1e-9
    )


def test_pix4d_s_local_coordinates_need_their_offset(
    tmp_path: Path, truth: Truth, check: Check
) -> None:
    shift = np.array([299_000.0, 4_585_000.0, 400.0])
    path = pix4d_file(tmp_path, truth["utm"] - shift, truth["utm_from_photo"])
    offset = tmp_path / "offset.xyz"
    offset.write_text("299000.000 4585000.000 400.000\n")
    poses = read_reference_poses(path, OrientationFileOptions(offset_file=offset))
    check(poses, truth["utm"], truth["utm_from_photo"])
    offset.write_text("none\n")
    with pytest.raises(KgcpError, match=r"offset\.xyz: has no line of two or three numbers; give"):
        read_reference_poses(path, OrientationFileOptions(offset_file=offset))


def test_a_published_pose_of_pix4d_is_read(tmp_path: Path) -> None:
    path = tmp_path / "external.txt"
    path.write_text(
        "imageName X Y Z Omega Phi Kappa\n"
        "DSC_0157.JPG 332081.126000 3488911.819856 4093.688402 -2.946680 3.053212 119.804001\n"
    )
    poses = read_reference_poses(path, frames=("flight 1/DSC_0157.JPG",))
    assert poses.frames == ("flight 1/DSC_0157.JPG",)
    assert poses.position_map.tolist() == [[332081.126, 3488911.819856, 4093.688402]]
    path.write_text(path.read_text() + "DSC_0158.JPG 1 2 3 4 5\n")
    with pytest.raises(KgcpError, match="line 3: holds '1 2 3 4 5' instead of 6 finite numbers"):
        read_reference_poses(path)


# --- OPF


def opf_project(
    folder: Path, position: FloatArray, rotation: FloatArray, scene: SceneReferenceFrame
) -> Path:
    """Write a project's files with Pix4D's own library, and the project that names them."""
    ids = [2**63 + index for index in range(len(position))]
    opk = opk_from_rotation(rotation)
    cameras = CalibratedCameras(
        cameras=[
            CalibratedCamera(
                id=Uid64(int=number),
                sensor_id=Uid64(int=3),
                orientation_deg=angles,
                position=xyz,
            )
            for number, xyz, angles in zip(ids, position, opk, strict=True)
        ],
        sensors=[],
    )
    listed = CameraList(
        [
            CameraData(Uid64(int=number), f"../image%20files/{name}#page=0")
            for number, name in zip(ids, NAMES, strict=True)
        ]
    )
    parts = {"calibrated_cameras": cameras, "camera_list": listed, "scene_reference_frame": scene}
    for name, part in parts.items():
        save(part, str(folder / f"{name}.json"))
    items = [
        {
            "id": name,
            "type": name,
            "resources": [
                {
                    "uri": f"{name}.json",
                    "format": f"application/opf-{name.replace('_', '-')}+json",
                }
            ],
        }
        for name in parts
    ]
    project = folder / "project.opf"
    project.write_text(json.dumps({"format": "application/opf-project+json", "items": items}))
    return project


def scene_of(
    crs: str, scale: FloatArray, shift: FloatArray, *, swap: bool, geoid_m: float | None = None
) -> SceneReferenceFrame:
    transform = BaseToTranslatedCanonicalCrsTransform(scale, shift, swap)
    return SceneReferenceFrame(transform, Crs(crs, geoid_m))


def canonical(scene: SceneReferenceFrame, base: FloatArray) -> FloatArray:
    """Apply pyopf's own matrix to coordinates in the CRS' own axis order."""
    padded = np.column_stack((base, np.ones(len(base))))
    result: FloatArray = (padded @ scene.base_to_canonical.transformation_matrix.T)[:, :3]
    return result


@pytest.mark.parametrize("named", ["project.opf", "calibrated_cameras.json"])
def test_opf_positions_are_shifted_from_the_base(
    tmp_path: Path, truth: Truth, check: Check, named: str
) -> None:
    shift = np.array([-299_123.25, -4_585_321.75, -512.5])
    scene = scene_of(CRS("EPSG:32631").to_wkt(), np.ones(3), shift, swap=False)
    opf_project(tmp_path, canonical(scene, truth["utm"]), truth["utm_from_photo"], scene)
    poses = read_reference_poses(
        tmp_path / named, crs="EPSG:32631", frames=[f"image files/{name}" for name in NAMES]
    )
    assert poses.frames == tuple(f"image files/{name}" for name in NAMES)
    check(poses, truth["utm"], truth["utm_from_photo"])


def test_opf_swaps_northing_and_easting_and_adds_a_geoid_height(
    tmp_path: Path, truth: Truth, check: Check
) -> None:
    # Poland's EPSG:2180 has northing first: a left-handed system, which OPF swaps.
    geodetic = truth["geodetic"] + [18.5, 10.5, 0.0]
    northing, easting = Transformer.from_crs("EPSG:4258", "EPSG:2180").transform(
        geodetic[:, 1], geodetic[:, 0]
    )
    base = np.column_stack((northing, easting, geodetic[:, 2] - 31.25))
    shift = np.array([-500_000.0, -480_000.0, -450.0])
    scene = scene_of("EPSG:2180", np.ones(3), shift, swap=True, geoid_m=31.25)
    path = opf_project(tmp_path, canonical(scene, base), truth["utm_from_photo"], scene)
    poses = read_reference_poses(path, crs="EPSG:2180")
    expected = np.column_stack((easting, northing, geodetic[:, 2]))
    check(poses, expected, truth["utm_from_photo"])


def test_opf_in_feet_has_heights_of_metres(tmp_path: Path, truth: Truth, check: Check) -> None:
    # New York Long Island in US survey feet, a CRS without heights: these are feet, too.
    foot = 1200.0 / 3937.0
    base = np.array([984_000.0, 207_000.0, 900.0]) + (truth["utm"] - truth["utm"][0]) / foot
    scene = scene_of("EPSG:2263", np.full(3, foot), np.array([-3e5, -6e4, 0.0]), swap=False)
    path = opf_project(tmp_path, canonical(scene, base), truth["utm_from_photo"], scene)
    expected = base * [1.0, 1.0, foot]  # easting and northing stay feet, heights are metres
    check(read_reference_poses(path, crs="EPSG:2263"), expected, truth["utm_from_photo"])


def test_an_incomplete_opf_project_is_refused_with_what_it_lacks(
    tmp_path: Path, truth: Truth
) -> None:
    scene = scene_of("EPSG:32631", np.ones(3), np.zeros(3), swap=True)
    path = opf_project(tmp_path, truth["utm"], truth["utm_from_photo"], scene)
    with pytest.raises(KgcpError, match="crs: has the axes east and north with swap_xy true"):
        read_reference_poses(path, crs="EPSG:32631")
    site = (
        'ENGINEERINGCRS["Site",ENGINEERINGDATUM["Corner"],CS[Cartesian,3],AXIS["x",east],'
        'AXIS["y",north],AXIS["z",up],LENGTHUNIT["metre",1.0]]'
    )
    save(
        scene_of(site, np.ones(3), np.zeros(3), swap=False),
        str(tmp_path / "scene_reference_frame.json"),
    )
    with pytest.raises(KgcpError, match=r"is in a scene without a map; align it to a map and give"):
        read_reference_poses(path, crs="EPSG:32631")
    stated = read_reference_poses(path, OrientationFileOptions(crs="EPSG:32631"), crs="EPSG:32631")
    np.testing.assert_allclose(stated.position_map, truth["utm"], rtol=0, atol=1e-9)
    (tmp_path / "camera_list.json").unlink()
    with pytest.raises(KgcpError, match=r"needs .*camera_list\.json, which does not exist; name"):
        read_reference_poses(tmp_path / "calibrated_cameras.json", crs="EPSG:32631")
