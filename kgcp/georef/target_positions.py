"""Positions of targets over time: on the vehicle, or static."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import attitude_axes, covariance_along, cross_matrix
from kgcp.georef.gps_counts import gps_count_remedy
from kgcp.georef.interpolation_error import interpolation_errors
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.trajectory import ENU_FROM_NED, Coverage, Motion, States, Trajectory, body_to_ned
from kgcp.georef.unix_time import date_of
from kgcp.settings import VehicleSettings
from kgcp.targets.plain import AnyTarget, PlainTarget


@dataclass(frozen=True, slots=True, eq=False)
class VehicleState:
    """Motion of the vehicle at the time of a target's position."""

    velocity_m_s: FloatArray  # (3,): of the target's centre, in the ENU frame [m/s]
    frame_from_body: FloatArray  # (3, 3): the vehicle's body axes in the ENU frame, as columns


@dataclass(frozen=True, slots=True, eq=False)
class TargetPosition:
    """Position of a target's centre."""

    position_m: FloatArray  # (3,): in the ENU frame [m]
    # (3, 3): covariance in ENU axes [m²]; None: trajectory or static target have no standard
    # deviations
    cov_m2: FloatArray | None
    # (3, 4): displacements of the position by one standard deviation of lever arm x, y, z and of
    # the synchronisation, ENU axes, as columns [m]. These four errors are the same in all frames.
    # The covariance that they cause between positions i and j is C_i C_jᵀ. None: static target
    common_m: FloatArray | None = None
    vehicle_state: VehicleState | None = None  # None: static target
    # (3, 3): share of `cov_m2` by the interpolation between the trajectory's epochs [m²]. This
    # error ends at the epochs. None: `cov_m2` is None, or static target
    interpolation_m2: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """The vehicle that carries the target."""

    motion: Motion  # its trajectory in the ENU frame of `local_frame`
    settings: VehicleSettings  # lever arm, time offset and their standard deviations
    local_frame: LocalFrame

    @classmethod
    def on(cls, trajectory: Trajectory, settings: VehicleSettings, local_frame: LocalFrame) -> Self:
        """Transform a trajectory from the map into the ENU frame."""
        position = local_frame.enu_from_map(trajectory.position_map)
        frame_from_ned = local_frame.level_rotations(position) @ ENU_FROM_NED
        motion = Motion(
            time_s=trajectory.time_s,
            position_m=position,
            frame_from_body=frame_from_ned @ body_to_ned(*trajectory.attitude_deg.T),
            sd_position_m=trajectory.sd_position_m,
            sd_attitude_deg=trajectory.sd_attitude_deg,
            cov_position_m2=trajectory.cov_position_m2,
        )
        return cls(motion, settings, local_frame)

    def coverage(self, time_s: FloatArray) -> list[Coverage]:
        """Return for frame times (n,) whether the trajectory covers them."""
        return self.motion.coverage(time_s + self.settings.time_offset_s)

    def positions(self, time_s: FloatArray) -> list[TargetPosition]:
        """Return the target's positions at frame times (n,) that the trajectory covers.

        position = trajectory point + R(frame ← body) · lever arm. The covariance is, to first
        order, the sum of the shares of the trajectory, of attitude times lever arm, of the
        interpolation of both, of the lever arm, and of the target's velocity times the
        synchronisation. Attitudes without standard deviations count as exact.
        """
        trajectory_s = time_s + self.settings.time_offset_s
        states = self.motion.states(trajectory_s)
        lever = states.frame_from_body @ np.array(self.settings.lever_arm_m)
        velocity = states.velocity_m_s + np.cross(states.angular_velocity_rad_s, lever)
        common = self._common_effects(states.frame_from_body, velocity)
        cov: Sequence[FloatArray | None] = [None] * len(time_s)
        interpolation: Sequence[FloatArray | None] = cov
        if states.sd_position_m is not None:
            own = self._trajectory_cov(states, states.sd_position_m)
            own = own + self._attitude_cov(states, lever)
            interpolation_m2 = self._interpolation_cov(trajectory_s, lever)
            cov = list(own + interpolation_m2 + common @ np.swapaxes(common, 1, 2))
            interpolation = list(interpolation_m2)
        vehicle_states = map(VehicleState, velocity, states.frame_from_body)
        positions = states.position_m + lever
        return list(map(TargetPosition, positions, cov, common, vehicle_states, interpolation))

    def _trajectory_cov(self, states: States, sd_position_m: FloatArray) -> FloatArray:
        """Return the share (n, 3, 3) of the trajectory point, rotated from map to ENU axes."""
        axes = self.local_frame.grid_rotation(states.position_m)
        if states.cov_position_m2 is None:
            return covariance_along(axes, sd_position_m)
        return np.asarray(axes @ states.cov_position_m2 @ np.swapaxes(axes, -1, -2))

    def _attitude_cov(self, states: States, lever: FloatArray) -> FloatArray:
        """Return the share (n, 3, 3) of attitude times lever arm."""
        if states.sd_attitude_deg is None:
            return np.zeros_like(states.frame_from_body)
        up = self.local_frame.level_rotations(states.position_m)[:, :, 2]
        axes = attitude_axes(states.frame_from_body, -up)
        effects = np.cross(axes, lever[:, :, None], axisa=1, axisb=1, axisc=1)
        return covariance_along(effects, np.radians(states.sd_attitude_deg))

    def _interpolation_cov(self, trajectory_s: FloatArray, lever: FloatArray) -> FloatArray:
        """Return the share (n, 3, 3) of the interpolation between the trajectory's epochs."""
        errors = interpolation_errors(self.motion, trajectory_s)
        arm = cross_matrix(lever)
        return np.asarray(
            errors.cov_position_m2 + arm @ errors.cov_turn_rad2 @ np.swapaxes(arm, -1, -2)
        )

    def _common_effects(self, frame_from_body: FloatArray, velocity_m_s: FloatArray) -> FloatArray:
        """Return `TargetPosition.common_m` of n positions (n, 3, 4)."""
        arm = frame_from_body * np.array(self.settings.sd_lever_arm_m)
        shift = velocity_m_s * self.settings.sd_time_s
        return np.concatenate((arm, shift[:, :, None]), axis=2)


class NoPosition(StrEnum):
    """Why the position of a target is not known."""

    NO_TIME = "no_time"
    BEFORE_TRAJECTORY = Coverage.BEFORE.value
    AFTER_TRAJECTORY = Coverage.AFTER.value
    IN_TRAJECTORY_GAP = Coverage.GAP.value


@dataclass(frozen=True, slots=True, eq=False)
class TargetPositions:
    """Positions of all targets of a flight at any time."""

    local_frame: LocalFrame  # the flight's map, and the ENU frame of all positions
    static: Mapping[str, TargetPosition]  # of static targets, by name
    vehicle: Vehicle | None  # which carries the one moving target

    @classmethod
    def of(
        cls,
        crs: str,
        targets: Sequence[AnyTarget],
        trajectory: Trajectory | None,
        settings: VehicleSettings,
    ) -> Self:
        """Prepare the flight's targets.

        The ENU frame has its origin at the trajectory's first position, or at that of the first
        static target.

        Raises
        ------
        KgcpError
            If there is neither a static target nor a trajectory, or if the CRS is unusable.
        """
        known = [np.array(target.position_m) for target in targets if target.position_m is not None]
        if trajectory is not None:
            known.insert(0, trajectory.position_map[0])
        if not known:
            raise KgcpError(
                "flight.toml: no target has a position; give a [vehicle] with a trajectory,"
                " or position_m in [[target]]"
            )
        local_frame = LocalFrame.at(crs, known[0])
        vehicle = None if trajectory is None else Vehicle.on(trajectory, settings, local_frame)
        return cls(local_frame, _static_positions(targets, local_frame), vehicle)

    def positions(
        self, targets: Sequence[str], time_s: Sequence[float | None]
    ) -> list[TargetPosition | NoPosition]:
        """Return the position of each named target at its time (Unix UTC, frames' clock) [s].

        Raises
        ------
        KgcpError
            If a moving target has no vehicle, if two moving targets would share the vehicle's lever
            arm, if no frame has a time, or if no time lies within the trajectory.
        """
        positions: list[TargetPosition | NoPosition] = [
            self.static.get(target, NoPosition.NO_TIME) for target in targets
        ]
        moving = [index for index, target in enumerate(targets) if target not in self.static]
        if not moving:
            return positions
        vehicle = self._vehicle_of(sorted({targets[index] for index in moving}))
        timed = [(index, time) for index in moving if (time := time_s[index]) is not None]
        if not timed:
            raise KgcpError(
                "no frame has a time; give [frames] times = 'frames.csv' in flight.toml and run"
                " 'kgcp detect' again"
            )
        indices = np.array([index for index, _ in timed])
        for index, position in zip(
            indices, _moving_positions(vehicle, [t for _, t in timed]), strict=True
        ):
            positions[index] = position
        return positions

    def _vehicle_of(self, moving: Sequence[str]) -> Vehicle:
        names = " and ".join(repr(name) for name in moving)
        if self.vehicle is None:
            raise KgcpError(
                f"flight.toml: target {names} has no position; give a [vehicle] with a trajectory,"
                " or position_m in its [[target]]"
            )
        if len(moving) > 1:
            raise KgcpError(
                f"flight.toml: targets {names} share one lever_arm_m; give position_m to those"
                " that are static, and remove those that are not to be used"
            )
        return self.vehicle


def _moving_positions(
    vehicle: Vehicle, time_s: Sequence[float]
) -> list[TargetPosition | NoPosition]:
    """Return the positions of the target on the vehicle at frame times, or why they are unknown."""
    times = np.array(time_s)
    coverage = vehicle.coverage(times)
    inside = np.array([kind is Coverage.INSIDE for kind in coverage])
    if not inside.any():
        raise KgcpError(_no_overlap(vehicle, times))
    positions = iter(vehicle.positions(times[inside]))
    return [
        next(positions) if kind is Coverage.INSIDE else NoPosition(kind.value) for kind in coverage
    ]


def _no_overlap(vehicle: Vehicle, time_s: FloatArray) -> str:
    covered, gap_s = vehicle.motion.time_s, vehicle.motion.max_gap_s
    remedy = gps_count_remedy(float(time_s.min()), float(covered[0])) or (
        "correct [vehicle] time_offset_s in flight.toml (GPS time is 18 s ahead of UTC) or give the"
        " trajectory of this flight"
    )
    return (
        f"none of the {len(time_s)} frames with the target lies within the vehicle's trajectory:"
        f" frames {_utc(time_s.min())} to {_utc(time_s.max())}, time_offset_s ="
        f" {vehicle.settings.time_offset_s:g}, trajectory {_utc(covered[0])} to"
        f" {_utc(covered[-1])} without gaps over {gap_s:g} s; {remedy}"
    )


def _utc(unix_s: float) -> str:
    moment = date_of(unix_s).replace(tzinfo=None)
    return f"{moment.isoformat(timespec='milliseconds')}Z"


def _static_positions(
    targets: Sequence[AnyTarget], local_frame: LocalFrame
) -> dict[str, TargetPosition]:
    positions = {}
    for target in targets:
        if target.position_m is not None:
            positions[target.name] = static_position(target.position_m, target, local_frame)
    return positions


def static_position(
    position_map: tuple[float, float, float], target: AnyTarget, local_frame: LocalFrame
) -> TargetPosition:
    """Return the position of the centre of a target's face, from its stated position.

    The face of a plain target is its thickness above the stated position. The covariance is unknown
    if no standard deviation is stated.
    """
    position = local_frame.enu_from_map(np.array([position_map]))[0]
    axes = local_frame.grid_rotation(position)
    cov = covariance_along(axes, np.array(target.sd_position_m))
    is_cov_known = any(target.sd_position_m)
    if isinstance(target, PlainTarget) and target.thickness_m and target.normal_enu is not None:
        level = local_frame.level_rotations(position[None])[0]
        normal = level @ np.array(target.normal_enu)
        sd_across_m = target.thickness_m * math.radians(target.sd_normal_deg)
        position = position + target.thickness_m * normal
        cov = cov + sd_across_m**2 * (np.eye(3) - np.outer(normal, normal))
    return TargetPosition(position, cov if is_cov_known else None)
