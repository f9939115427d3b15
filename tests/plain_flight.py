"""A small rendered flight over static plain targets, as a folder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, opk_from_rotation
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.flight.target_table import target_lines
from kgcp.measurement.plain_pose import pose_towards
from kgcp.simulation.ground import Ground
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import PlainPlate, PrintedPlate
from kgcp.simulation.regions import regular_polygon
from kgcp.simulation.scene import PlainPose, PlatePose, SimulatedScene, render_irradiance
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import AnyTarget, PlainPolarity, PlainTarget

CRS = "EPSG:25832"
ORIGIN_MAP = np.array([689_412.0, 5_336_208.0, 545.0])
CAMERA = Camera(480, 360, 700.0, 700.0, 241.2, 178.1, k1=-0.05, response=Response.LINEAR)
_START_S = 1_781_597_700.0
# a level plate on the vehicle: its x axis to the right, south, its y axis backwards, west
_ENU_FROM_PLATE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_GROUND_FROM_ENU = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


def plain_target(
    name: str, offset_m: tuple[float, float], *diameters_m: float, polarity: str = "bright"
) -> PlainTarget:
    """A target on the ground, so far east and north of the origin."""
    x, y, z = (ORIGIN_MAP + np.append(offset_m, 0.0)).tolist()
    return PlainTarget(
        name, diameters_m, PlainPolarity(polarity), (x, y, z), (0.002,) * 3, border_m=0.5
    )


TARGETS = (
    plain_target("white", (-4.0, -3.0), 0.8),
    plain_target("black", (4.0, -2.5), 0.9, polarity="dark"),
    plain_target("ring", (3.5, 3.0), 1.2, 0.6, polarity="dark"),
)


def coded_ring(name: str, code: tuple[float, ...]) -> Ring:
    """A ring of the usual proportions, 1.3 m across."""
    return Ring(name, 1.3, 0.65, 1.3 / 1.4, 1.3 / 7.0, code)


def coded_target(name: str, offset_m: tuple[float, float], code: tuple[float, ...]) -> Target:
    """A coded target on the ground."""
    ring = coded_ring(name, code)
    x, y, z = (ORIGIN_MAP + np.append(offset_m, 0.0)).tolist()
    return Target(ring, position_m=(x, y, z), sd_position_m=(0.002,) * 3)


CODED = (
    coded_target("A", (-1.8, 1.8), (0, 43, 78, 180)),
    coded_target("B", (1.8, 0.6), (0, 60, 150, 270)),
    coded_target("C", (0.0, -2.8), (0, 35, 120, 200)),
)


@dataclass(frozen=True)
class PlainFlight:
    """Where everything is; `write` renders it."""

    targets: tuple[PlainTarget, ...] = TARGETS
    coded: tuple[Target, ...] = ()
    moving: Target | None = None  # on a vehicle that drives east, 1 m from frame to frame
    frames: int = 3
    seed: int = 3
    height_m: float = 25.0
    sd_position_m: float = 0.02
    sd_angle_deg: float = 0.02
    true_normals: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)  # ENU

    def cameras(self) -> tuple[FloatArray, FloatArray]:
        """Projection centres (n, 3) and rotations ENU ← camera (n, 3, 3), exact."""
        rng = np.random.default_rng(self.seed)
        centres, rotations = [], []
        for _ in range(self.frames):
            turn = rotation_about(np.array([0.0, 0.0, rng.uniform(0.0, 2.0 * math.pi)]))
            tilt = rotation_about(np.append(rng.uniform(-0.15, 0.15, 2), 0.0))
            centres.append(np.append(rng.uniform(-1.0, 1.0, 2), self.height_m))
            rotations.append(turn @ _GROUND_FROM_ENU.T @ tilt)
        return np.array(centres), np.array(rotations)

    def centres_m(self, frame: int) -> FloatArray:
        """Centres (k, 3) of the plain targets in a frame's camera axes [m]."""
        return self._in_camera(frame, self.targets)

    def _vehicle_enu_m(self, after_s: FloatArray) -> FloatArray:
        """Places (n, 3) of the moving target, in seconds after the first frame."""
        after_s = np.asarray(after_s, dtype=np.float64)
        still = np.zeros_like(after_s)
        return np.stack((after_s - 1.0, still + 0.3, still), axis=-1)

    def _moving_pose(self, frame: int) -> Pose:
        centres, rotations = self.cameras()
        place = self._vehicle_enu_m(np.array(float(frame)))
        camera_from_enu = rotations[frame].T
        return Pose(camera_from_enu @ _ENU_FROM_PLATE, camera_from_enu @ (place - centres[frame]))

    def _plates(self, frame: int, lying: FloatArray) -> tuple[PlatePose, ...]:
        plates = [
            (target, Pose(lying, centre))
            for target, centre in zip(self.coded, self._in_camera(frame, self.coded), strict=True)
        ]
        if self.moving is not None:
            plates.append((self.moving, self._moving_pose(frame)))
        outline = regular_polygon(4, 0.9)
        return tuple(PlatePose(PrintedPlate(target, outline), pose) for target, pose in plates)

    def _lying(self, frame: int, target: PlainTarget) -> FloatArray:
        """Axes (3, 3) of a plain target in a frame's camera: it lies level, or as it truly does."""
        _, rotations = self.cameras()
        enu_from_target = _GROUND_FROM_ENU.T
        if target.name in self.true_normals:
            normal = -np.array(self.true_normals[target.name])  # into the plate
            enu_from_target = pose_towards(np.zeros(3), normal / np.linalg.norm(normal)).rotation
        return np.asarray(rotations[frame].T @ enu_from_target)

    def _in_camera(self, frame: int, targets: Sequence[AnyTarget]) -> FloatArray:
        if not targets:
            return np.empty((0, 3))
        local_frame = LocalFrame.at(CRS, ORIGIN_MAP)
        places = local_frame.enu_from_map(np.array([each.position_m for each in targets]))
        centres, rotations = self.cameras()
        return np.asarray((places - centres[frame]) @ rotations[frame])

    def write(self, folder: Path) -> Path:
        """Write flight.toml, frames and reference.csv."""
        (folder / "frames").mkdir(parents=True)
        rng = np.random.default_rng(self.seed + 1)
        self._write_frames(folder / "frames", rng)
        self._write_reference(folder / "reference.csv", rng)
        self._write_times(folder / "frames.csv")
        if self.moving is not None:
            self._write_trajectory(folder / "vehicle.csv")
        (folder / "flight.toml").write_text(self._toml(), encoding="utf-8")
        return folder

    def _write_frames(self, folder: Path, rng: np.random.Generator) -> None:
        ground = Ground.grown(rng, 500.0)
        centres, rotations = self.cameras()
        for frame in range(self.frames):
            camera_from_enu = rotations[frame].T
            lying = camera_from_enu @ _GROUND_FROM_ENU.T
            scene = SimulatedScene(
                Pose(lying, -camera_from_enu @ centres[frame]),
                None,
                self._plates(frame, lying),
                tuple(
                    PlainPose(PlainPlate(target), Pose(self._lying(frame, target), centre))
                    for target, centre in zip(self.targets, self.centres_m(frame), strict=True)
                ),
            )
            irradiance = render_irradiance(CAMERA, ground, scene, Optics(0.6), rng)
            cv2.imwrite(str(folder / f"f_{frame}.png"), Sensor().expose(irradiance, 1.0, rng))

    def _write_reference(self, path: Path, rng: np.random.Generator) -> None:
        local_frame = LocalFrame.at(CRS, ORIGIN_MAP)
        centres, rotations = self.cameras()
        centres = centres + self.sd_position_m * rng.standard_normal(centres.shape)
        turns = math.radians(self.sd_angle_deg) * rng.standard_normal((self.frames, 3))
        rotations = rotations @ np.array([rotation_about(turn) for turn in turns])
        on_map = local_frame.map_from_enu(centres)
        to_map = np.swapaxes(local_frame.grid_rotation(centres), 1, 2)
        angles = opk_from_rotation(to_map @ rotations @ CAMERA_FROM_PHOTO)
        lines = ["frame,x,y,z,omega_deg,phi_deg,kappa_deg,sd_x,sd_y,sd_z,sd_angle_deg"]
        sds = (*(self.sd_position_m,) * 3, self.sd_angle_deg)
        for frame, (place, opk) in enumerate(zip(on_map, angles, strict=True)):
            numbers = (f"{value:.9f}" for value in (*place, *opk, *sds))
            lines.append(",".join((f"f_{frame}.png", *numbers)))
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _write_times(self, path: Path) -> None:
        lines = [f"f_{frame}.png,{_START_S + frame}" for frame in range(self.frames)]
        path.write_text("\n".join(["frame,time", *lines]) + "\n", encoding="utf-8")

    def _write_trajectory(self, path: Path) -> None:
        after_s = np.arange(-2.0, self.frames + 2.0, 0.1)
        on_map = LocalFrame.at(CRS, ORIGIN_MAP).map_from_enu(self._vehicle_enu_m(after_s))
        lines = ["time,x,y,z,roll_deg,pitch_deg,heading_deg,sd_x,sd_y,sd_z"]
        lines += [
            f"{_START_S + time:.3f},{x:.6f},{y:.6f},{z:.6f},0,0,90,0.01,0.01,0.01"
            for time, (x, y, z) in zip(after_s, on_map, strict=True)
        ]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _toml(self) -> str:
        keys = ("width", "height", "fx", "fy", "cx", "cy", "k1")
        lines = [
            'name = "plain"',
            f'crs = "{CRS}"',
            "[camera]",
            *(f"{key} = {getattr(CAMERA, key)!r}" for key in keys),
            'response = "linear"',
            "[reference]",
            'poses = "reference.csv"',
        ]
        for target in self.targets:
            lines += [
                "[[target]]",
                f'name = "{target.name}"',
                f'shape = "{target.shape}"',
                f'polarity = "{target.polarity}"',
                f"diameter_m = {target.outer_diameter_m!r}",
                f"position_m = {list(target.position_m)}",
                f"sd_position_m = {list(target.sd_position_m)}",
                f"border_m = {target.border_m!r}",
            ]
            if target.normal_enu is None:
                lines.append('normal = "free"')
            if len(target.diameters_m) > 1:
                lines.append(f"inner_diameter_m = {list(target.diameters_m[1:])}")
        moving = () if self.moving is None else (self.moving,)
        lines += [line for target in (*self.coded, *moving) for line in target_lines(target)]
        if moving:
            lines += ["[vehicle]", 'trajectory = "vehicle.csv"', "lever_arm_m = [0.0, 0.0, 0.0]"]
        return "\n".join(lines) + "\n"
