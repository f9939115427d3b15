"""`poses.parquet` and `poses.csv`: oriented frames on the flight's map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, opk_from_rotation
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.files.csv_text import DEGREE_DECIMALS, csv_text
from kgcp.io.formats.orientations.csv import COVARIANCE_COLUMNS, covariance_cells
from kgcp.io.tables.columns import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    TEXT,
    Column,
    finite_cell,
    matrix_cell,
)
from kgcp.network.ground.frame_poses import FramePose
from kgcp.network.ground.point_images import CameraPose

_AXES = "xyz"
_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")


@dataclass(frozen=True, slots=True, eq=False)
class MapPose:
    """A frame's pose on the map."""

    frame_pose: FramePose
    position_map: FloatArray | None  # (3,); None: not oriented
    opk_deg: FloatArray | None  # (3,)
    cov: FloatArray | None  # (6, 6): position [m] and rotation vector [rad], the map's axes

    @property
    def sd_angle_deg(self) -> float | None:
        """Standard deviation of an angle: the root mean square of all three [deg]."""
        return None if self.cov is None else _sd_angle_deg(self.cov)


def _sd_angle_deg(cov: FloatArray) -> float:
    return math.degrees(math.sqrt(float(np.trace(cov[3:6, 3:6])) / 3.0))


def on_map(poses: Sequence[FramePose], local_frame: LocalFrame) -> list[MapPose]:
    """Transform poses from the ENU frame to the map."""
    rows = []
    for frame_pose in poses:
        if frame_pose.pose is None or frame_pose.cov is None:
            rows.append(MapPose(frame_pose, None, None, None))
            continue
        map_from_enu = local_frame.grid_rotation(frame_pose.pose.centre_m).T
        rotation = map_from_enu @ frame_pose.pose.world_from_camera @ CAMERA_FROM_PHOTO
        block_rotation = np.kron(np.eye(2), map_from_enu)
        rows.append(
            MapPose(
                frame_pose,
                local_frame.map_from_enu(frame_pose.pose.centre_m[None])[0],
                opk_from_rotation(rotation[None])[0],
                block_rotation @ frame_pose.cov @ block_rotation.T,
            )
        )
    return rows


def _rejected(row: MapPose) -> str:
    pose = row.frame_pose
    return "" if pose.pose is None else " ".join(n for n in pose.targets if n not in pose.used)


def _method(row: MapPose) -> str:
    if row.frame_pose.pose is None:
        return ""
    return "ring" if row.frame_pose.is_by_one_ring else "points"


def _focal(row: MapPose) -> float | None:
    pose = row.frame_pose
    if pose.pose is None or pose.sd_focal_scale is None:
        return None
    return pose.pose.focal_scale


POSE_COLUMNS: tuple[Column[MapPose], ...] = (
    Column("frame", TEXT, lambda row: row.frame_pose.frame),
    Column("method", TEXT, _method),
    Column("reason", TEXT, lambda row: row.frame_pose.reason),
    *Column[MapPose].of_vector(_AXES, lambda row: row.position_map),
    *Column[MapPose].of_vector(_ANGLES, lambda row: row.opk_deg),
    *Column[MapPose].of_sds([f"sd_{axis}" for axis in _AXES], lambda row: row.cov),
    Column("sd_angle_deg", NUMBER, lambda row: row.sd_angle_deg),
    Column("cov", NUMBERS, lambda row: matrix_cell(row.cov)),
    Column("targets", INTEGER, lambda row: len(row.frame_pose.targets)),
    Column("targets_used", INTEGER, lambda row: len(row.frame_pose.used)),
    Column("rejected", TEXT, _rejected),
    Column("margin", NUMBER, lambda row: row.frame_pose.margin),
    Column("variance_factor", NUMBER, lambda row: row.frame_pose.variance_factor),
    Column("focal_scale", NUMBER, _focal),
    Column("sd_focal_scale", NUMBER, lambda row: row.frame_pose.sd_focal_scale),
)


@dataclass(frozen=True, slots=True, eq=False)
class PoseResidual:
    """Residuals of one target in the pose of a frame."""

    frame: str
    target: str
    is_used: bool
    residual: FloatArray  # (3,): x and y [px], and logarithm of the distance
    chi2: float


def _distance_percent(row: PoseResidual) -> float | None:
    log = float(row.residual[2])
    return 100.0 * math.expm1(log) if math.isfinite(log) else None


POSE_RESIDUAL_COLUMNS: tuple[Column[PoseResidual], ...] = (
    Column("frame", TEXT, lambda row: row.frame),
    Column("target", TEXT, lambda row: row.target),
    Column("used", BOOLEAN, lambda row: row.is_used),
    Column("chi2", NUMBER, lambda row: finite_cell(row.chi2)),
    Column("residual_x_px", NUMBER, lambda row: finite_cell(float(row.residual[0]))),
    Column("residual_y_px", NUMBER, lambda row: finite_cell(float(row.residual[1]))),
    Column("residual_distance_percent", NUMBER, _distance_percent),
)


def pose_residuals(poses: Sequence[FramePose]) -> Iterator[PoseResidual]:
    """Yield the residuals of every target, in frames that three or more targets orient."""
    for pose in poses:
        if pose.residuals is None or pose.chi2 is None:
            continue
        for name, residual, chi2 in zip(pose.targets, pose.residuals, pose.chi2, strict=True):
            yield PoseResidual(pose.frame, name, name in pose.used, residual, float(chi2))


POSE_CSV_HEADER = (
    "frame",
    *_AXES,
    *_ANGLES,
    *(f"sd_{axis}" for axis in _AXES),
    "sd_angle_deg",
    *COVARIANCE_COLUMNS,
)


def pose_csv_cells(
    frame: str,
    position: FloatArray,
    opk_deg: FloatArray,
    cov: FloatArray,
    *,
    is_geographic: bool = False,
) -> list[str]:
    """Return a pose as cells, in the columns of reference poses.

    Parameters
    ----------
    position : (3,) array
        In metres, or longitude and latitude in degrees and height in metres.
    opk_deg : (3,) array
    cov : (6, 6) array
        Of position [m] and left rotation vector [rad].
    """
    decimals = DEGREE_DECIMALS if is_geographic else 6
    x, y, z = position.tolist()
    return [
        frame,
        f"{x:.{decimals}f}",
        f"{y:.{decimals}f}",
        f"{z:.6f}",
        *(f"{angle:.9f}" for angle in opk_deg.tolist()),
        *(f"{sd:.6f}" for sd in np.sqrt(np.diag(cov)[:3]).tolist()),
        f"{_sd_angle_deg(cov):.7f}",
        *covariance_cells(cov),
    ]


def poses_csv(rows: Sequence[MapPose], *, is_geographic: bool) -> str:
    """Return the oriented frames in the columns of reference poses."""
    cells = [
        pose_csv_cells(
            row.frame_pose.frame,
            row.position_map,
            row.opk_deg,
            row.cov,
            is_geographic=is_geographic,
        )
        for row in rows
        if row.position_map is not None and row.opk_deg is not None and row.cov is not None
    ]
    return csv_text(POSE_CSV_HEADER, cells)


@dataclass(frozen=True, slots=True, eq=False)
class OwnFramePose:
    """A frame's pose relative to the device or field that it shows, and further cells."""

    frame: str
    pose: CameraPose
    cov: FloatArray  # (6, 6) or (7, 7): as of `Resection`
    more: tuple[str, ...]


def own_frame_poses_csv(rows: Iterable[OwnFramePose], more: Sequence[str]) -> str:
    """Return poses in the columns of reference poses, then `focal_scale` and further columns."""
    table = []
    for row in rows:
        pose = row.pose
        opk_deg = opk_from_rotation((pose.world_from_camera @ CAMERA_FROM_PHOTO)[None])[0]
        cells = pose_csv_cells(row.frame, pose.centre_m, opk_deg, row.cov)
        table.append([*cells, f"{pose.focal_scale:.6f}", *row.more])
    return csv_text([*POSE_CSV_HEADER, "focal_scale", *more], table)
