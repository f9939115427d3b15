"""The drive of the vehicle with the target along the corridor, and its recorded trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from benchmarks.aat.settings import BlockSettings, axes_of, ground_m, map_frame, on_corridor
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.camera_priors import BODY_FROM_LEVEL_PLATE
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.trajectory import Trajectory
from kgcp.settings import VehicleSettings
from kgcp.simulation.path import VehicleStates

_START_S = 1_781_597_700.0  # 2026-06-16T08:15:00Z
_LEAD_S = 5.0  # trajectory before the first and after the last frame
_TRAJECTORY_INTERVAL_S = 0.05
_POINT_ABOVE_ROAD_M = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Ride:
    """The drive of the vehicle: truth and observations.

    Attributes
    ----------
    target_enu_m : (n, 3) array
        True centre of the target in every frame [m].
    enu_from_plate : (n, 3, 3) array
        True axes of the plate, as columns.
    road_m : (n,) array
        Height of the road below the vehicle [m].
    plate_scale : float
        True size of the print, divided by the nominal one.
    trajectory : Trajectory
        Recorded trajectory, with errors.
    settings : VehicleSettings
        Settings of the vehicle as the surveyor knows them, for example the lever arm.
    frame_times_s : (n,) array
        Recorded times of the frames [s].
    """

    target_enu_m: FloatArray
    enu_from_plate: FloatArray
    road_m: FloatArray
    plate_scale: float
    trajectory: Trajectory
    settings: VehicleSettings
    frame_times_s: FloatArray


def drive(settings: BlockSettings, times_s: FloatArray, rng: np.random.Generator) -> Ride:
    """Simulate a drive along the corridor, with frames at times (n,) since the start [s]."""
    local_frame = map_frame()
    nominal = VehicleSettings(
        lever_arm_m=(-0.8, 0.15, -1.95),
        sd_lever_arm_m=(settings.sd_lever_arm_m,) * 3,
        sd_time_s=settings.sd_time_s,
    )
    states, road_m = _states(settings, times_s)
    body = local_frame.level_rotations(states.position_enu_m) @ states.level_from_body
    lever_m = nominal.lever_arm_m + settings.sd_lever_arm_m * rng.standard_normal(3)
    return Ride(
        target_enu_m=states.position_enu_m + body @ lever_m,
        enu_from_plate=body @ BODY_FROM_LEVEL_PLATE,
        road_m=road_m,
        plate_scale=1.0 + settings.sd_diameter_m / 0.9 * float(rng.standard_normal()),
        trajectory=_record(settings, local_frame, nominal.correlation_s, times_s[-1], rng),
        settings=nominal,
        frame_times_s=_START_S + times_s + settings.sd_time_s * float(rng.standard_normal()),
    )


def _states(settings: BlockSettings, elapsed_s: FloatArray) -> tuple[VehicleStates, FloatArray]:
    """Return the true states of the vehicle at times (n,), and the height of the road [m]."""
    along_m = settings.speed_m_s * elapsed_s + 2.0 * np.sin(0.11 * elapsed_s)
    road_m = ground_m(settings, along_m, np.zeros_like(along_m))
    states = VehicleStates(
        on_corridor(settings, along_m, np.zeros_like(along_m), road_m + _POINT_ABOVE_ROAD_M),
        roll_deg=0.9 * np.sin(0.43 * elapsed_s) + 0.3,
        pitch_deg=0.5 * np.sin(0.61 * elapsed_s),
        heading_deg=np.mod(-np.degrees(along_m / settings.bend_radius_m), 360.0),
    )
    return states, road_m


def _record(
    settings: BlockSettings,
    local_frame: LocalFrame,
    correlation_s: float,
    duration_s: float,
    rng: np.random.Generator,
) -> Trajectory:
    """Return the vehicle's trajectory with errors whose correlation decays over time."""
    elapsed_s = np.arange(-_LEAD_S, duration_s + _LEAD_S, _TRAJECTORY_INTERVAL_S)
    states, _ = _states(settings, elapsed_s)
    attitude_deg = np.column_stack((states.roll_deg, states.pitch_deg, states.heading_deg))
    sd_m, sd_deg = axes_of(settings.sd_vehicle_m), np.full(3, settings.sd_attitude_deg)
    kept = np.exp(-_TRAJECTORY_INTERVAL_S / correlation_s)
    steps = rng.standard_normal((len(elapsed_s), 6))
    steps[1:] *= np.sqrt(1.0 - kept * kept)
    errors = np.asarray(lfilter([1.0], [1.0, -kept], steps, axis=0))
    return Trajectory(
        _START_S + elapsed_s,
        local_frame.map_from_enu(states.position_enu_m) + errors[:, :3] * sd_m,
        attitude_deg + errors[:, 3:] * sd_deg,
        np.tile(sd_m, (len(elapsed_s), 1)),
        np.tile(sd_deg, (len(elapsed_s), 1)),
    )
