"""A flight over static targets as files: its detections are drawn from their own covariances."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, opk_from_rotation
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_derivatives
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import write_table
from kgcp.network.ground.space_circle import outline_noise

CRS = "EPSG:25832"
ORIGIN_MAP = np.array([689_412.0, 5_336_208.0, 545.0])
CAMERA = Camera(1600, 1200, 2300.0, 2300.0, 803.2, 596.1, k1=-0.05)
OUTLINE_PX = 0.005  # white noise of outlines: of a centre, per coordinate
_HEADING_SD = 1e-3
_CODES = ([0, 43, 78, 180], [0, 60, 150, 270], [0, 35, 120, 200], [0, 80, 125, 230], [0, 25, 150])
_NULL_ROW: dict[str, object] = {column.name: None for column in DETECTION_COLUMNS}


@functools.cache
def local_frame() -> LocalFrame:
    """The frame of all these flights: to look up its CRS takes longer than to plan a flight."""
    return LocalFrame.at(CRS, ORIGIN_MAP)


@dataclass
class GroundFlight:
    """Where everything is; `write` makes the folder."""

    names: tuple[str, ...] = ("A", "B", "C", "D")
    # of the targets, relative to the origin: map axes [m]
    offsets_m: FloatArray = field(
        default_factory=lambda: np.array(
            [[-4.0, -3.0, 0.0], [4.0, -3.0, 0.5], [4.0, 3.0, -0.3], [-4.0, 3.0, 0.2]]
        )
    )
    diameter_m: float = 0.9  # as printed
    stated_diameter_m: float = 0.9  # as flight.toml has it
    stated_camera: Camera = CAMERA  # as flight.toml has it
    frames: int = 12
    seed: int = 1
    wrong: dict[tuple[int, str], FloatArray] = field(default_factory=dict)  # errors [m]
    renamed: dict[tuple[int, str], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.local_frame = local_frame()
        self.rng = np.random.default_rng(self.seed)
        self.positions_map = ORIGIN_MAP + self.offsets_m
        self.positions = self.local_frame.enu_from_map(self.positions_map)
        self.centres, self.rotations = self._exterior()
        self.frame_names = tuple(f"f_{index:03d}.png" for index in range(self.frames))

    def _exterior(self) -> tuple[FloatArray, FloatArray]:
        centres, rotations = [], []
        for index in range(self.frames):
            azimuth = 2.0 * math.pi * index / self.frames + self.rng.normal(0.0, 0.1)
            centre = np.array([9.0 * math.cos(azimuth), 9.0 * math.sin(azimuth), 28.0])
            look = -centre + np.append(self.rng.normal(0.0, 0.5, 2), 0.0)
            z = look / np.linalg.norm(look)
            x = np.cross(z, [0.0, 1.0, 0.2])
            x /= np.linalg.norm(x)
            turn = rotation_about(np.array([0.0, 0.0, self.rng.uniform(0.0, 6.2)]))
            centres.append(centre)
            rotations.append(np.column_stack((x, np.cross(z, x), z)) @ turn)
        return np.array(centres), np.array(rotations)

    def pose(self, frame: int, target: int) -> Pose:
        """The true pose of a level target, target → camera."""
        enu_from_target = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        rotation = self.rotations[frame].T @ enu_from_target
        sight = self.rotations[frame].T @ (self.positions[target] - self.centres[frame])
        return Pose(rotation, sight)

    def measured(self, frame: int, target: int) -> tuple[Pose, FloatArray]:
        """A pose drawn from its covariance, as measured with the stated diameter."""
        pose, radius_m = self.pose(frame, target), 0.5 * self.diameter_m
        circle = Circles3D(
            pose.translation_m[None], pose.rotation[None, :, :2], np.array([radius_m])
        )
        slopes = circle_derivatives(CAMERA, circle)
        by_pose = np.concatenate((slopes.by_centre[0], slopes.by_rotation[0]), axis=1)
        moments = np.array([[0.0, 0.0, *([(0.25 * (CAMERA.fx * radius_m / 30.0) ** 2)] * 3)]])
        moments[0, 3] = 0.0
        information = by_pose.T @ np.linalg.inv(OUTLINE_PX**2 * outline_noise(moments)[0]) @ by_pose
        information[3:, 3:] += np.outer(pose.normal, pose.normal) / _HEADING_SD**2
        cov = np.linalg.inv(information)
        step = np.linalg.cholesky(0.5 * (cov + cov.T)) @ self.rng.standard_normal(6)
        moved = pose.moved(step)
        moved = Pose(
            moved.rotation, moved.translation_m + self.wrong.get((frame, self.names[target]), 0.0)
        )
        scale = self.stated_diameter_m / self.diameter_m
        size = np.diag([scale, scale, scale, 1.0, 1.0, 1.0])
        if self.stated_camera is not CAMERA:
            moved = self._as_by_stated_camera(moved)
        return Pose(moved.rotation, scale * moved.translation_m), size @ cov @ size

    def _as_by_stated_camera(self, pose: Pose) -> Pose:
        """The pose that gives a ring the same image in the camera of flight.toml."""
        angles = np.arange(48) * (math.pi / 24.0)
        rim = 0.5 * self.diameter_m * np.stack((np.cos(angles), np.sin(angles), 0.0 * angles), -1)
        camera = self.stated_camera
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0, 0, 1.0]])
        lens = np.array([camera.k1, camera.k2, camera.p1, camera.p2])
        start = cv2.Rodrigues(pose.rotation)[0], pose.translation_m[:, None].copy()
        pixels = CAMERA.project(pose.transform(rim[:, :2]))
        _, turn, shift = cv2.solvePnP(rim, pixels, matrix, lens, *start, useExtrinsicGuess=True)
        return Pose(cv2.Rodrigues(turn)[0].astype(np.float64), np.asarray(shift[:, 0], np.float64))

    def write(self, folder: Path, *, sd_position_m: float = 0.01) -> Path:
        """Write flight.toml, blank frames, reference.csv and the detections."""
        (folder / "frames").mkdir(parents=True)
        blank = np.zeros((4, 4), np.uint8)
        for name in self.frame_names:
            cv2.imwrite(str(folder / "frames" / name), blank)
        (folder / "flight.toml").write_text(self._toml(sd_position_m), encoding="utf-8")
        self._write_reference(folder / "reference.csv")
        rows = [
            self._row(frame, target)
            for frame in range(self.frames)
            for target in range(len(self.names))
        ]
        sizes = [(folder / "frames" / name).stat().st_size for name in self.frame_names]
        about = {"frame_bytes": json.dumps(sizes)}
        write_table(folder / "kgcp" / "detections.parquet", DETECTION_COLUMNS, rows, about)
        return folder

    def _toml(self, sd_position_m: float) -> str:
        camera = self.stated_camera
        lines = [
            'name = "ground"',
            f'crs = "{CRS}"',
            "[camera]",
            *(f"{key} = {getattr(camera, key)!r}" for key in ("width", "height", "fx", "fy")),
            *(f"{key} = {getattr(camera, key)!r}" for key in ("cx", "cy", "k1")),
            "[reference]",
            'poses = "reference.csv"',
        ]
        for index, name in enumerate(self.names):
            size = self.stated_diameter_m
            lines += [
                "[[target]]",
                f'name = "{name}"',
                f"outer_diameter_m = {size!r}",
                f"inner_diameter_m = {size / 2!r}",
                f"code_diameter_m = {size / 1.4!r}",
                f"dot_diameter_m = {size / 7!r}",
                f"code_deg = {_CODES[index]}",
                f"position_m = {self.positions_map[index].tolist()}",
                f"sd_position_m = {[sd_position_m] * 3}",
            ]
        return "\n".join(lines) + "\n"

    def _write_reference(self, path: Path) -> None:
        on_map = self.local_frame.map_from_enu(self.centres)
        to_map = np.swapaxes(self.local_frame.grid_rotation(self.centres), 1, 2)
        angles = opk_from_rotation(to_map @ self.rotations @ CAMERA_FROM_PHOTO)
        lines = ["frame,x,y,z,omega_deg,phi_deg,kappa_deg"]
        for name, place, opk in zip(self.frame_names, on_map, angles, strict=True):
            numbers = (f"{value:.9f}" for value in (*place, *opk))
            lines.append(",".join((name, *numbers)))
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _row(self, frame: int, target: int) -> dict[str, object]:
        pose, cov = self.measured(frame, target)
        x, y = self.stated_camera.project(pose.translation_m[None])[0].tolist()
        name = self.names[target]
        return {
            **_NULL_ROW,
            "frame": self.frame_names[frame],
            "target": self.renamed.get((frame, name), name),
            "shape": "coded",
            "time_source": "none",
            "instance": 0,
            "status": "measured",
            "reason": "",
            "detail": "",
            "candidates": 0,
            "guided": False,
            "scale_used": name,
            "x_px": x,
            "y_px": y,
            "sd_x_px": OUTLINE_PX,
            "sd_y_px": OUTLINE_PX,
            "cov_xy_px2": 0.0,
            "distance_m": pose.distance_m,
            "sd_distance_m": math.sqrt(float(cov[2, 2])),
            **dict(zip(("tx_m", "ty_m", "tz_m"), pose.translation_m.tolist(), strict=True)),
            **dict(zip(("qw", "qx", "qy", "qz"), pose.quaternion_wxyz.tolist(), strict=True)),
            "pose_cov": cov.ravel().tolist(),
            "score": 0.99,
            "radius_px": CAMERA.fx * 0.5 * self.stated_diameter_m / pose.distance_m,
        }
