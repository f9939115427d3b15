"""What all formats of poses share: recognition, names, maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.poses import read_reference_poses
from kgcp.io.poses.notation import PoseNotation

SAMPLES: dict[str, Any] = {
    "csv": "frame,x,y,z,omega_deg,phi_deg,kappa_deg\na.jpg,1,2,3,0,0,0\n",
    "colmap": "1 1 0 0 0 1 2 3 1 a.jpg\n\n",
    "pix4d": "imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 0 0 0\n",
    "opensfm": [{"shots": {"a.jpg": {"rotation": [0, 0, 0], "translation": [1, 2, 3]}}}],
    "metashape": (
        '<document><chunk><cameras><camera label="a.jpg"><transform>'
        "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk></document>"
    ),
}


@pytest.mark.parametrize("form", sorted(SAMPLES))
def test_the_content_tells_the_format_whatever_the_name(tmp_path: Path, form: str) -> None:
    path = tmp_path / "poses"
    sample = SAMPLES[form]
    path.write_text(sample if isinstance(sample, str) else json.dumps(sample))
    stated = None if form in {"csv", "pix4d"} else "EPSG:32631"
    named = read_reference_poses(path, PoseNotation(form, stated), crs="EPSG:32631")
    found = read_reference_poses(path, PoseNotation(None, stated), crs="EPSG:32631")
    assert found.frames == named.frames == ("a.jpg",)
    np.testing.assert_array_equal(found.position_map, named.position_map)


@pytest.mark.parametrize("content", ["", "words\n", "{}", "[]", "<a/>", "\x00\x01"])
def test_a_file_of_no_format_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "poses"
    path.write_text(content)
    with pytest.raises(KgcpError, match=r"poses: holds no reference poses of a known format \(col"):
        read_reference_poses(path)


@pytest.mark.parametrize(
    ("names", "frames", "expected"),
    [
        ("a.jpg", "x/a.jpg y/b.jpg", "x/a.jpg"),
        ("a", "x/a.jpg y/b.jpg", "x/a.jpg"),
        ("C:\\flight\\y\\a.jpg", "x/a.jpg y/a.jpg", "y/a.jpg"),
        ("y/a", "x/a.jpg y/a.jpg", "y/a.jpg"),
        ("a.JPG", "x/a.jpg", "a.JPG"),  # letters keep their case
        ("none.jpg", "x/a.jpg", "none.jpg"),
    ],
)
def test_other_programs_know_frames_by_less_than_their_path(
    tmp_path: Path, names: str, frames: str, expected: str
) -> None:
    path = tmp_path / "external.txt"
    path.write_text(f"imageName X Y Z Omega Phi Kappa\n{names} 1 2 3 0 0 0\n")
    assert read_reference_poses(path, frames=frames.split()).frames == (expected,)


def test_names_that_fit_twice_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "external.txt"
    path.write_text("imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 0 0 0\n")
    with pytest.raises(KgcpError, match=r"image 'a.jpg' may be 'x/a.jpg' or 'y/a.jpg'; rename"):
        read_reference_poses(path, frames=("x/a.jpg", "y/a.jpg"))
    path.write_text(path.read_text() + "x/a.jpg 1 2 3 0 0 0\n")
    with pytest.raises(KgcpError, match=r"images 'a.jpg' and 'x/a.jpg' are both 'x/a.jpg'"):
        read_reference_poses(path, frames=("x/a.jpg",))


def test_deviations_turn_with_the_axes(tmp_path: Path) -> None:
    # South of the equator and turned by 90°: EPSG:2053 counts westing and southing.
    path = tmp_path / "reference.csv"
    path.write_text(
        "frame,x,y,z,omega_deg,phi_deg,kappa_deg,sd_x,sd_y,sd_z,sd_angle_deg\n"
        "a.jpg,29,-26,1500,0,0,0,0.01,0.02,0.03,0.1\n"
    )
    notation = PoseNotation(crs="EPSG:4148")
    poses = read_reference_poses(path, notation, crs="EPSG:2053")
    assert poses.sd_position_m is not None
    np.testing.assert_allclose(poses.sd_position_m, [[0.01, 0.02, 0.03]], atol=1e-9)
    np.testing.assert_allclose(np.abs(poses.opk_deg), [[0, 0, 180]], atol=1e-6)
    turned = read_reference_poses(path, notation, crs="EPSG:4148")
    np.testing.assert_allclose(turned.opk_deg, [[0, 0, 0]])
    assert turned.sd_angle_deg is not None


def test_a_missing_grid_is_named(tmp_path: Path) -> None:
    path = tmp_path / "reconstruction.json"
    shot = {"rotation": [0, 0, 0], "translation": [1, 2, 3]}
    reference = {"longitude": 2.17, "latitude": 41.4, "altitude": 50.0}
    path.write_text(json.dumps([{"shots": {"a": shot}, "reference_lla": reference}]))
    with pytest.raises(KgcpError, match=r"needs the grid \S+, which is not installed; install"):
        read_reference_poses(path, crs="EPSG:25831+5773")
    with pytest.raises(KgcpError, match=r"has coordinates of its own CRS, but flight.toml has no"):
        read_reference_poses(path)
