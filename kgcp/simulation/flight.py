"""A whole simulated flight: planned at once, rendered frame by frame in any order."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.pose import Pose
from kgcp.georef.camera_priors import BODY_FROM_LEVEL_PLATE
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.trajectory import Trajectory
from kgcp.settings import VehicleSettings
from kgcp.simulation.ground import Ground
from kgcp.simulation.imaging import Optics
from kgcp.simulation.instruments import adjust_reference, record_trajectory
from kgcp.simulation.light_field import PlateLight
from kgcp.simulation.path import (
    FRAME_INTERVAL_S,
    ROAD_RADIUS_M,
    CameraState,
    climb,
    drive,
    hover,
)
from kgcp.simulation.plate import PrintedPlate
from kgcp.simulation.presets import SimulationSettings
from kgcp.simulation.regions import regular_polygon
from kgcp.simulation.rolling_shutter import RowMotion
from kgcp.simulation.scene import PlatePose, SimulatedScene, render_irradiance
from kgcp.targets.layout import Ring, Target

CRS = "EPSG:25832"
ORIGIN_MAP: FloatArray = np.array([689_412.0, 5_336_208.0, 545.0])  # its grid north is 1.9° off
START_S = 1_781_597_700.0  # 2026-06-16T08:15:00Z
LEVER_ARM_M = (-0.8, 0.15, -1.95)
_LEAD_S = 5.0  # trajectory before the first and after the last frame
_DECOY_CLEARANCE_M = 4.6  # from the target to the end of its vehicle, and the decoy's plate
_DECOY_ATTEMPTS = 40


def _target(name: str, code_deg: tuple[float, ...], replica_deg: tuple[float, ...]) -> Target:
    ring = Ring(name, 0.9, 0.45, 0.9 / 1.4, 0.9 / 7.0, code_deg)
    return Target(ring, (ring.scaled(f"{name}-inner", 0.2, replica_deg),))


TARGET_PLATE = PrintedPlate(
    _target("A", (0, 43, 78, 180), (10, 80, 150, 250, 290)), regular_polygon(4, 0.61)
)
DECOY_PLATE = PrintedPlate(
    _target("decoy", (0, 60, 150, 270), (0, 50, 120, 200, 300)), regular_polygon(8, 0.58)
)


@dataclass(frozen=True, slots=True, eq=False)
class FramePlan:
    """The truth of one frame."""

    index: int
    time_s: float  # mid-exposure of the row of the target's centre, Unix UTC, without error [s]
    camera: CameraState  # exterior orientation at that time, without error
    target: Pose  # target → camera; also where the target is not `present`
    target_enu_m: FloatArray  # (3,): target centre [m]
    present: bool  # whether the whole ring is in the frame; otherwise nothing of the plate is
    decoys: tuple[Pose, ...]  # decoy plates that are wholly in the frame
    optics: Optics
    gain: float


@dataclass(frozen=True, slots=True, eq=False)
class FlightPlan:
    """Everything about a simulated flight but its pixels."""

    settings: SimulationSettings
    seed: int
    frames: tuple[FramePlan, ...]
    target_map: FloatArray  # (n, 3): target centres in the flight's CRS
    # (n,): the frames' times with their error: mid-exposure of the middle row [s]
    recorded_times_s: FloatArray
    vehicle: VehicleSettings  # as the surveyor knows it; the true lever arm differs by its error
    trajectory: Trajectory  # with its errors
    reference: ReferencePoses  # with their errors


def frame_name(settings: SimulationSettings, index: int) -> str:
    """Return the file name of a frame."""
    return f"frame_{index:04d}.{'png' if settings.jpeg_quality is None else 'jpg'}"


def plan_flight(settings: SimulationSettings, seed: int) -> FlightPlan:
    """Decide where everything is, and what the surveyor's instruments report.

    The same settings and seed give the same plan. Random numbers come from one stream per
    purpose and frame, so that a frame does not depend on the others.
    """
    local_frame = LocalFrame.at(CRS, ORIGIN_MAP)
    rng = _stream(seed, "survey")
    lever_arm_m = LEVER_ARM_M + settings.sd_lever_arm_m * rng.standard_normal(3)
    elapsed_s = _LEAD_S + np.linspace(0.0, 1.0, settings.frames) * _duration_s(settings)
    frames = _plan_frames(settings, seed, local_frame, elapsed_s, lever_arm_m)
    names = tuple(frame_name(settings, index) for index in range(settings.frames))
    cameras = tuple(frame.camera for frame in frames)
    trajectory_s = _duration_s(settings) + 2.0 * _LEAD_S
    return FlightPlan(
        settings,
        seed,
        frames,
        local_frame.map_from_enu(np.array([frame.target_enu_m for frame in frames])),
        np.array([_middle_row_time_s(settings, frame) for frame in frames])
        + settings.sd_time_s * rng.standard_normal(settings.frames),
        VehicleSettings(
            lever_arm_m=LEVER_ARM_M,
            sd_lever_arm_m=(settings.sd_lever_arm_m,) * 3,
            sd_time_s=settings.sd_time_s,
        ),
        record_trajectory(settings, local_frame, START_S, trajectory_s, rng),
        adjust_reference(settings, local_frame, names, cameras, rng),
    )


def render_frame(plan: FlightPlan, ground: Ground, index: int) -> GreyArray:
    """Render one frame (height, width) of grey values, or (height, width, 3) of a phone (uint8).

    `ground` is that of `grow_ground`.
    """
    settings, frame = plan.settings, plan.frames[index]
    rng = _stream(plan.seed, "pixels", index)
    field = _light_field(plan, frame)
    scene = SimulatedScene(
        frame.camera.ground,
        PlatePose(TARGET_PLATE, frame.target, field),
        tuple(PlatePose(DECOY_PLATE, pose, field) for pose in frame.decoys),
    )
    irradiance = render_irradiance(settings.camera, ground, scene, frame.optics, rng)
    if settings.phone is not None:
        return settings.phone.photograph(settings.sensor, irradiance, frame.gain, rng)
    return settings.sensor.expose(irradiance, frame.gain, rng)


def _light_field(plan: FlightPlan, frame: FramePlan) -> PlateLight | None:
    """Return the light on the plates of a frame, each in its own axes.

    It is drawn anew for every frame, dirt included, so that a flight averages over many plates.
    """
    settings = plan.settings
    if settings.shadow is None and settings.dirt is None and settings.glare is None:
        return None
    return PlateLight.drawn(
        settings.shadow,
        settings.dirt,
        settings.glare,
        frame.gain,
        _stream(plan.seed, "light", frame.index),
    )


def grow_ground(seed: int) -> Ground:
    """Return the ground of a flight: made once, used by every frame."""
    return Ground.grown(_stream(seed, "ground"), ROAD_RADIUS_M)


def _stream(seed: int, purpose: str, index: int = 0) -> np.random.Generator:
    """Return an independent random stream."""
    key = (*purpose.encode(), index)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def _share_of(count: int, share: float, rng: np.random.Generator) -> FloatArray:
    """Return `count` values of which the given share, in random places, is 1 and the rest 0."""
    chosen = np.zeros(count)
    chosen[: round(share * count)] = 1.0
    return rng.permutation(chosen)


def _duration_s(settings: SimulationSettings) -> float:
    """Return the time from the first frame to the last [s]."""
    return FRAME_INTERVAL_S * (settings.frames - 1)


def _plan_frames(
    settings: SimulationSettings,
    seed: int,
    local_frame: LocalFrame,
    elapsed_s: FloatArray,
    lever_arm_m: FloatArray,
) -> tuple[FramePlan, ...]:
    """Plan all frames of a drive; the random numbers of one do not depend on the others."""
    states = drive(elapsed_s)
    enu_from_body = local_frame.level_rotations(states.position_enu_m) @ states.level_from_body
    target_enu_m = states.position_enu_m + enu_from_body @ lever_arm_m
    absent = _share_of(settings.frames, settings.absent_share, _stream(seed, "absent"))
    decoy = _share_of(settings.frames, settings.decoy_share, _stream(seed, "decoy"))
    return tuple(
        _plan_frame(
            settings,
            index,
            START_S + elapsed_s[index],
            enu_from_body[index] @ BODY_FROM_LEVEL_PLATE,
            target_enu_m[index],
            _stream(seed, "frame", index),
            _stream(seed, "motion", index),
            present=not absent[index],
            decoy=bool(decoy[index]),
        )
        for index in range(settings.frames)
    )


def _plan_frame(
    settings: SimulationSettings,
    index: int,
    time_s: float,
    enu_from_plate: FloatArray,
    target_enu_m: FloatArray,
    rng: np.random.Generator,
    motion_rng: np.random.Generator,
    *,
    present: bool,
    decoy: bool,
) -> FramePlan:
    """Draw from where a frame is taken, what stands in it, its blur and its exposure."""
    distance_m = climb(settings, index, rng)
    reach_m = 0.5 * TARGET_PLATE.target.ring.outer_diameter_m
    camera = hover(
        settings,
        target_enu_m,
        distance_m,
        reach_m if present else TARGET_PLATE.outline.reach_m,
        rng,
        present=present,
    )
    pose = camera.pose_of(enu_from_plate, target_enu_m)
    length, direction = rng.uniform(*settings.streak_px), rng.uniform(0.0, 2.0 * math.pi)
    return FramePlan(
        index,
        time_s,
        camera,
        pose,
        target_enu_m,
        present,
        _lay_decoy(settings, camera, pose, rng) if decoy else (),
        Optics(
            float(rng.uniform(*settings.psf_px)),
            (length * math.cos(direction) + 0.0, length * math.sin(direction) + 0.0),  # no -0
            settings.lens,
            _row_motion(settings, pose, motion_rng),
        ),
        float(np.exp(rng.uniform(*np.log(settings.gain)))),
    )


def _row_motion(
    settings: SimulationSettings, target: Pose, rng: np.random.Generator
) -> RowMotion | None:
    if not settings.camera.readout_s:
        return None
    return settings.motion.drawn(settings.camera, _pose_row(settings, target), rng)


def _pose_row(settings: SimulationSettings, target: Pose) -> float:
    """Return the row of the target's centre, to whose moment a frame's poses belong.

    If the centre is outside the frame, it is the first or last row.
    """
    _, row = settings.camera.project(target.translation_m[None])[0]
    return float(np.clip(row, 0.0, settings.camera.height - 1.0))


def _middle_row_time_s(settings: SimulationSettings, frame: FramePlan) -> float:
    """Return the time of a frame: mid-exposure of its middle row [s]."""
    rows = _pose_row(settings, frame.target) / (settings.camera.height - 1.0) - 0.5
    return frame.time_s - rows * settings.camera.readout_s


def _lay_decoy(
    settings: SimulationSettings, camera: CameraState, target: Pose, rng: np.random.Generator
) -> tuple[Pose, ...]:
    """Lay a decoy on the ground within the frame and clear of the vehicle, if there is room."""
    optics = settings.camera
    size = np.array([optics.width, optics.height])
    ground = camera.ground
    centre = optics.project(target.translation_m[None])[0]
    turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True).as_matrix()
    for _ in range(_DECOY_ATTEMPTS):
        pixel = rng.random(2) * size
        ray = np.append(optics.undistort(pixel[None])[0], 1.0)
        position = ray * (ground.translation_m @ ground.normal) / (ray @ ground.normal)
        px_per_m = optics.mean_focal_px / float(np.linalg.norm(position))
        margin = DECOY_PLATE.outline.reach_m * px_per_m + 2.0
        inside = np.all((pixel > margin) & (pixel < size - 1 - margin))
        if inside and np.linalg.norm(pixel - centre) > _DECOY_CLEARANCE_M * px_per_m:
            return (Pose(ground.rotation @ turn, position),)
    return ()
