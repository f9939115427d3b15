from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.attitude import opk_from_rotation, rotation_from_opk
from kgcp.io.formats.orientations import read_reference_poses

_HEADER = "frame,x,y,z,omega_deg,phi_deg,kappa_deg"


def _write(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "reference.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_poses_are_read_with_their_deviations(tmp_path: Path) -> None:
    path = _write(
        tmp_path,
        _HEADER + ",sd_x,sd_y,sd_z,sd_angle_deg",
        "sub\\a.jpg,1,2,3,4,5,6,0.1,0.2,0.3,0.4",
    )
    poses = read_reference_poses(path)
    assert poses.frames == ("sub/a.jpg",)
    np.testing.assert_allclose(poses.position_map, [[1, 2, 3]])
    np.testing.assert_allclose(poses.opk_deg, [[4, 5, 6]])
    assert poses.sd_position_m is not None
    np.testing.assert_allclose(poses.sd_position_m, [[0.1, 0.2, 0.3]])
    assert poses.sd_angle_deg is not None
    np.testing.assert_allclose(poses.sd_angle_deg, [0.4])


def test_a_duplicate_frame_is_refused_with_both_line_numbers(tmp_path: Path) -> None:
    path = _write(tmp_path, _HEADER, "a.jpg,1,2,3,4,5,6", "b.jpg,1,2,3,4,5,6", "a.jpg,1,2,3,4,5,6")
    with pytest.raises(KgcpError, match=r"line 4: frame 'a\.jpg' is also in line 2"):
        read_reference_poses(path)


def test_a_missing_file_names_the_key(tmp_path: Path) -> None:
    with pytest.raises(KgcpError, match=r"\[reference\] poses"):
        read_reference_poses(tmp_path / "reference.csv")


def test_opk_agrees_with_a_published_adjustment() -> None:
    # Pix4D's sample project, DSC_0157: omega, phi, kappa and the matrix of its own parameter file,
    # which maps the world into a camera with y down and z forward.
    rotation = rotation_from_opk(np.array([[-2.946680, 3.053212, 119.804001]]))[0]
    world_to_camera = np.diag([1.0, -1.0, -1.0]) @ rotation.T
    published = np.array(
        [
            [-0.49632902, 0.86794436, -0.01816834],
            [0.866499, 0.494001, -0.071708],
            [-0.053263, -0.051334, -0.997260],
        ]
    )
    np.testing.assert_allclose(world_to_camera, published, atol=2e-6)


def test_opk_angles_are_read_back_as_they_were_written() -> None:
    opk = np.array([[3.0, -4.0, 170.0], [-170.0, 60.0, -20.0]])
    np.testing.assert_allclose(opk_from_rotation(rotation_from_opk(opk)), opk, atol=1e-10)
