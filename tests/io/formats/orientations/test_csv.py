from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.attitude import opk_from_rotation, place_covariances, rotation_from_opk
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.orientations.records import OrientationFileOptions
from kgcp.io.tables.poses import POSE_CSV_HEADER, pose_csv_cells

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


# A camera 30 m above the ground that only its view of the ground holds in place: its rotation errs
# by 1 mrad, and its position makes up for that.
_SIGHT = np.array([[0.0, 0.0, -30.0]])
_ROTATION = np.array([[0.0, 30.0, 0.0], [-30.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # moves C by -ω × s
_BY_ERROR = np.vstack(
    (np.hstack((_ROTATION, np.eye(3))), np.hstack((np.eye(3), np.zeros((3, 3)))))
) @ np.diag([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01])
_COV = _BY_ERROR @ _BY_ERROR.T


def _posed(tmp_path: Path, **cells: str) -> Path:
    """A file as `kgcp orient` writes it, with one pose and some of its cells exchanged."""
    place = np.array([448_000.0, 5_411_000.0, 300.0])
    row = pose_csv_cells("a.jpg", place, np.array([1.0, -2.0, 30.0]), _COV)
    row = [cells.get(name, cell) for name, cell in zip(POSE_CSV_HEADER, row, strict=True)]
    return _write(tmp_path, ",".join(POSE_CSV_HEADER), ",".join(row))


def test_covariances_of_poses_are_read_as_written(tmp_path: Path) -> None:
    poses = read_reference_poses(_posed(tmp_path))
    assert poses.cov is not None
    assert poses.sd_position_m is not None
    np.testing.assert_allclose(poses.cov[0], _COV, rtol=1e-8, atol=1e-15)
    np.testing.assert_allclose(poses.sd_position_m[0], np.sqrt(np.diag(_COV))[:3], rtol=1e-8)
    np.testing.assert_allclose(place_covariances(poses.cov, _SIGHT)[0], 1e-4 * np.eye(3), atol=1e-9)


def test_covariances_follow_the_axes_into_other_coordinates(tmp_path: Path) -> None:
    """The grids of two zones are 4° apart; what is along x in one is not in the other."""
    along_x = np.diag([1e-4, 1e-6, 1e-6])  # of the place below the camera [m²]
    by_rotation = np.vstack((_ROTATION, np.eye(3))) @ np.array([1e-3, 1e-3, 0.0])
    cov = np.outer(by_rotation, by_rotation) + np.pad(along_x, (0, 3))
    place = np.array([448_000.0, 5_411_000.0, 300.0])
    rows = [
        pose_csv_cells(name, place + np.array([east_m, 0.0, 0.0]), np.array([1.0, -2.0, 30.0]), cov)
        for name, east_m in (("a.jpg", 0.0), ("b.jpg", 100.0))
    ]
    path = _write(tmp_path, ",".join(POSE_CSV_HEADER), *map(",".join, rows))
    options = OrientationFileOptions(crs="EPSG:25832")
    poses = read_reference_poses(path, options, crs="EPSG:25831")
    orientations = ExteriorOrientations.of(
        poses, LocalFrame.at("EPSG:25831", poses.position_map[0])
    )
    x = orientations.centre_m[1] - orientations.centre_m[0]
    x /= np.linalg.norm(x)
    assert abs(np.degrees(np.arctan2(x[1], x[0]))) > 0.5, "nor is it east"
    below = orientations.place_covariances([0], _SIGHT)[0]
    np.testing.assert_allclose(below @ x, 1e-4 * x, atol=1e-8)
    assert poses.cov is not None
    assert poses.sd_position_m is not None
    np.testing.assert_allclose(poses.sd_position_m[0], np.sqrt(np.diag(poses.cov[0]))[:3])


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({"sd_x": "0.1"}, "line 2: sd_x is 0.1, but 0.0316228 by cov_x_x to cov_rot_z_rot_z"),
        ({"sd_angle_deg": "0"}, "line 2: sd_angle_deg is 0, but 0.0572958 by cov_x_x"),
        ({"cov_x_rot_y": "-0.1"}, "line 2: cov_x_x to cov_rot_z_rot_z are no covariance"),
        ({"cov_x_x": "-1e-3"}, "line 2: cov_x_x to cov_rot_z_rot_z are no covariance; if a spread"),
        ({"sd_x": "0.03", "cov_x_x": "0.0010"}, "line 2: .* if a spreadsheet has rounded them"),
    ],
)
def test_a_contradictory_covariance_is_refused(
    tmp_path: Path, cells: dict[str, str], words: str
) -> None:
    with pytest.raises(KgcpError, match=words):
        read_reference_poses(_posed(tmp_path, **cells))


def test_a_part_of_a_covariance_is_refused(tmp_path: Path) -> None:
    path = _write(tmp_path, _HEADER + ",cov_x_x,cov_y_y", "a.jpg,1,2,3,4,5,6,0.1,0.1")
    with pytest.raises(KgcpError, match="has cov_x_x, cov_y_y but not cov_x_y"):
        read_reference_poses(path)
