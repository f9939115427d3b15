"""Common properties of all formats of poses: recognition, names, map coordinates."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import read_flight
from kgcp.io.formats.orientations import FORMATS, read_reference_poses
from kgcp.io.formats.orientations.records import OrientationFileOptions

SAMPLES: dict[str, Any] = {
    "csv": "frame,x,y,z,omega_deg,phi_deg,kappa_deg\na.jpg,1,2,3,0,0,0\n",
    "colmap": "1 1 0 0 0 1 2 3 1 a.jpg\n\n",
    "pix4d": "imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 0 0 0\n",
    "opensfm": [{"shots": {"a.jpg": {"rotation": [0, 0, 0], "translation": [1, 2, 3]}}}],
    "metashape": (
        '<document><chunk><cameras><camera label="a.jpg"><transform>'
        "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk></document>"
    ),
    "odm": {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {
                    "filename": "a.jpg",
                    "rotation": [0, 0, 0],
                    "translation": [500000.0, 0.0, 3.0],
                },
                "geometry": {"type": "Point", "coordinates": [3.0, 0.0, 3.0]},
            }
        ],
    },
    "opf": {
        "format": "application/opf-calibrated-cameras+json",
        "cameras": [{"id": 7, "position": [1, 2, 3], "orientation_deg": [0, 0, 0]}],
    },
}
OPF_PARTS: dict[str, dict[str, object]] = {
    "camera_list": {"cameras": [{"id": 7, "uri": "a.jpg"}]},
    "scene_reference_frame": {
        "crs": {"definition": "EPSG:32631"},
        "base_to_canonical": {"shift": [0, 0, 0], "scale": [1, 1, 1], "swap_xy": False},
    },
}


def test_every_format_has_a_sample() -> None:
    assert SAMPLES.keys() == set(FORMATS.names)


@pytest.mark.parametrize("form", sorted(SAMPLES))
def test_the_format_is_recognised_by_content_and_not_by_name(tmp_path: Path, form: str) -> None:
    path = tmp_path / "poses"
    sample = SAMPLES[form]
    path.write_text(sample if isinstance(sample, str) else json.dumps(sample))
    for name, part in OPF_PARTS.items():
        kind = {"format": f"application/opf-{name.replace('_', '-')}+json"}
        (tmp_path / f"{name}.json").write_text(json.dumps({**part, **kind}))
    stated = "EPSG:32631" if form in {"colmap", "metashape", "opensfm"} else None
    named = read_reference_poses(path, OrientationFileOptions(form, stated), crs="EPSG:32631")
    found = read_reference_poses(path, OrientationFileOptions(None, stated), crs="EPSG:32631")
    assert found.frames == named.frames == ("a.jpg",)
    np.testing.assert_array_equal(found.position_map, named.position_map)


@pytest.mark.parametrize("content", ["", "words\n", "{}", "[]", "<a/>", "\x00\x01"])
def test_a_file_of_no_format_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "poses"
    path.write_text(content)
    with pytest.raises(
        KgcpError, match=r"poses: is not a file of reference poses of a known format \(col"
    ):
        read_reference_poses(path)


@pytest.mark.parametrize(
    ("names", "frames", "expected"),
    [
        ("a.jpg", "x/a.jpg y/b.jpg", "x/a.jpg"),
        ("a.jpg", "x/a.jpg x/a.jpg", "x/a.jpg"),  # two targets in one frame
        ("a", "x/a.jpg y/b.jpg", "x/a.jpg"),
        ("C:\\flight\\y\\a.jpg", "x/a.jpg y/a.jpg", "y/a.jpg"),
        ("y/a", "x/a.jpg y/a.jpg", "y/a.jpg"),
        ("a.JPG", "x/a.jpg", "a.JPG"),  # letters keep their case
        ("none.jpg", "x/a.jpg", "none.jpg"),
    ],
)
def test_frames_match_names_without_folder_or_extension(
    tmp_path: Path, names: str, frames: str, expected: str
) -> None:
    path = tmp_path / "external.txt"
    path.write_text(f"imageName X Y Z Omega Phi Kappa\n{names} 1 2 3 0 0 0\n")
    assert read_reference_poses(path, frames=frames.split()).frames == (expected,)


def test_the_csv_file_must_name_frames_by_their_whole_path(tmp_path: Path) -> None:
    path = tmp_path / "reference.csv"
    path.write_text("frame,x,y,z,omega_deg,phi_deg,kappa_deg\na.jpg,1,2,3,0,0,0\n")
    assert read_reference_poses(path, frames=("x/a.jpg", "y/a.jpg")).frames == ("a.jpg",)


def test_names_that_match_two_frames_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "external.txt"
    path.write_text("imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 0 0 0\n")
    with pytest.raises(KgcpError, match=r"image 'a.jpg' may be 'x/a.jpg' or 'y/a.jpg'; rename"):
        read_reference_poses(path, frames=("x/a.jpg", "y/a.jpg"))
    path.write_text(path.read_text() + "x/a.jpg 1 2 3 0 0 0\n")
    with pytest.raises(KgcpError, match=r"images 'a.jpg' and 'x/a.jpg' are both 'x/a.jpg'"):
        read_reference_poses(path, frames=("x/a.jpg",))


def test_deviations_are_rotated_with_the_axes(tmp_path: Path) -> None:
    # South of the equator and turned by 90°: EPSG:2053 counts westing and southing.
    path = tmp_path / "reference.csv"
    path.write_text(
        "frame,x,y,z,omega_deg,phi_deg,kappa_deg,sd_x,sd_y,sd_z,sd_angle_deg\n"
        "a.jpg,29,-26,1500,0,0,0,0.01,0.02,0.03,0.1\n"
    )
    options = OrientationFileOptions(crs="EPSG:4148")
    poses = read_reference_poses(path, options, crs="EPSG:2053")
    assert poses.sd_position_m is not None
    np.testing.assert_allclose(poses.sd_position_m, [[0.01, 0.02, 0.03]], atol=1e-9)
    np.testing.assert_allclose(np.abs(poses.opk_deg), [[0, 0, 180]], atol=1e-6)
    turned = read_reference_poses(path, options, crs="EPSG:4148")
    np.testing.assert_allclose(turned.opk_deg, [[0, 0, 0]])
    assert turned.sd_angle_deg is not None


def test_a_missing_grid_is_named(tmp_path: Path) -> None:
    path = tmp_path / "reconstruction.json"
    shot = {"rotation": [0, 0, 0], "translation": [1, 2, 3]}
    reference = {"longitude": 2.17, "latitude": 41.4, "altitude": 50.0}
    path.write_text(json.dumps([{"shots": {"a": shot}, "reference_lla": reference}]))
    with pytest.raises(KgcpError, match=r"needs the grid \S+, which is not installed; install"):
        read_reference_poses(path, crs="EPSG:25831+5773")
    with pytest.raises(KgcpError, match=r"has coordinates in its own CRS, but flight.toml"):
        read_reference_poses(path)


@pytest.mark.parametrize("form", sorted(FORMATS.names))
@pytest.mark.parametrize(
    "content", ["", "no such thing\n", "[1, 2]", "{}", "<a/>", "\x00\x01", "a,b\n1,2\n", "[]"]
)
def test_a_wrong_format_name_is_a_one_line_error_about_the_file(
    tmp_path: Path, form: str, content: str
) -> None:
    path = tmp_path / "poses"
    path.write_text(content)
    with pytest.raises(KgcpError) as caught:
        read_reference_poses(path, OrientationFileOptions(form), crs="EPSG:32631")
    assert str(caught.value).startswith(f"{path}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        "frame,x,y,z,omega_deg,phi_deg,kappa_deg\n",
        "imageName X Y Z Omega Phi Kappa\n",
        '[{"shots": {}}]',
        '<document><chunk><cameras><camera label="unaligned"/></cameras></chunk></document>',
    ],
)
def test_a_file_without_poses_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "poses"
    path.write_text(content)
    with pytest.raises(KgcpError, match="holds no pose; export the aligned frames"):
        read_reference_poses(path)


def test_flight_toml_describes_the_file(tmp_path: Path) -> None:
    (tmp_path / "frames" / "b").mkdir(parents=True)
    (tmp_path / "frames" / "b" / "a.jpg").touch()
    (tmp_path / "poses.txt").write_text("1 1 0 0 0 1 2 3 1 a.jpg\n\n")
    (tmp_path / "shift.xyz").write_text("400000 4500000 0\n")
    toml = tmp_path / "flight.toml"
    flight = (
        'crs = "EPSG:32631"\n[camera]\nwidth = 9\nheight = 9\nfx = 9\nfy = 9\ncx = 4\ncy = 4\n'
        '[[target]]\nname = "A"\nouter_diameter_m = 0.9\ninner_diameter_m = 0.45\n'
        "code_diameter_m = 0.642857143\ndot_diameter_m = 0.128571429\ncode_deg = [0, 43, 78]\n"
    )
    toml.write_text(flight)
    without = FlightData(read_flight(tmp_path), ())
    assert not without.has_reference
    with pytest.raises(KgcpError, match=r"flight.toml: has no \[reference\]; give poses"):
        _ = without.reference_poses
    reference = '[reference]\nposes = "poses.txt"\ncrs = "EPSG:32631"\noffset = "shift.xyz"\n'
    toml.write_text(f'{flight}{reference}format = "colmap"\n')
    data = FlightData(read_flight(tmp_path), ("b/a.jpg",))
    assert data.has_reference
    poses = data.reference_poses
    assert data.reference_poses is poses  # read once
    assert poses.frames == ("b/a.jpg",)
    np.testing.assert_allclose(poses.position_map, [[399_999.0, 4_499_998.0, -3.0]])
    toml.write_text(f'{flight}{reference}format = "bundler"\n')
    with pytest.raises(KgcpError, match=r"\[reference\] format: 'bundler' is not known; give one"):
        read_flight(tmp_path)
    toml.write_text(f"{flight}{reference.replace('shift', 'none')}")
    with pytest.raises(KgcpError, match=r"\[reference\] offset: 'none.xyz' does not exist"):
        read_flight(tmp_path)
