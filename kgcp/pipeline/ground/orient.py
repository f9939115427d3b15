"""Frames of a flight oriented by the static targets in them, and the files of the result."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera
from kgcp.georef.crs import is_geographic
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.sighting import Sighting, unmistakable
from kgcp.georef.target_positions import TargetPosition, TargetPositions
from kgcp.io.files.atomic import write_bytes
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frame_patterns import matching_frames
from kgcp.io.tables.columns import row_of
from kgcp.io.tables.detections import read_attempts
from kgcp.io.tables.parquet import write_table
from kgcp.io.tables.poses import (
    POSE_COLUMNS,
    POSE_RESIDUAL_COLUMNS,
    on_map,
    pose_residuals,
    poses_csv,
)
from kgcp.io.tables.provenance import derived_provenance, orientation_provenance
from kgcp.io.tables.staleness import POSES_TABLE
from kgcp.network.ground.frame_motions import orient_moving
from kgcp.network.ground.frame_poses import FramePose, print_scale_sd
from kgcp.network.ground.position_check import (
    FastCamera,
    WrongCamera,
    WrongPosition,
    wrong_input,
)
from kgcp.network.ground.resection import MIN_POINTS
from kgcp.network.ground.target_moves import MovedTarget
from kgcp.network.ground.vehicle_check import VehicleOff, vehicle_off
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.workspace import DETECTIONS, results_folder
from kgcp.quality.number_text import amount, listed, rounded

_SIGNIFICANT_SIGMAS = 3.0  # a larger common scale of the distances is reported
_MIN_SCALE = 1e-4  # of the distances, that is reported; no print or survey is better
_MAX_NAMED = 3  # targets in a message


@dataclass(frozen=True, slots=True)
class OrientOptions:
    """Options of an orientation.

    Attributes
    ----------
    frames : tuple of str
        Patterns of the names of frames to orient; empty: all.
    min_points : int
        Number of targets that must agree if their distances do not check the pose.
    has_free_focal : bool
        Whether the focal length is unknown.
    """

    frames: tuple[str, ...] = ()
    min_points: int = MIN_POINTS
    has_free_focal: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class FlightPoses:
    """Oriented frames of a flight.

    Attributes
    ----------
    flight : Flight
    poses : tuple of FramePose
        One per frame, in the frames' order, in the ENU frame of `local_frame`.
    local_frame : LocalFrame
    provenance : mapping of str
        The metadata of the table.
    wrong_input : WrongPosition or MovedTarget or WrongCamera or FastCamera or None
        What the images contradict: a position, that a target stayed there, or the calibration;
        None: nothing.
    vehicle_off : VehicleOff or None
        By how much the target on the vehicle is off its trajectory; None: not noticeably, or there
        is no such target.
    """

    flight: Flight
    poses: tuple[FramePose, ...]
    local_frame: LocalFrame
    provenance: Mapping[str, str]
    wrong_input: WrongPosition | MovedTarget | WrongCamera | FastCamera | None = None
    vehicle_off: VehicleOff | None = None

    @property
    def oriented(self) -> tuple[FramePose, ...]:
        """Frames with a pose."""
        return tuple(each for each in self.poses if each.pose is not None)

    @property
    def suspects(self) -> tuple[str, ...]:
        """Targets of which one has a wrong position, the likeliest first."""
        wrong = self.wrong_input
        return wrong.targets if isinstance(wrong, WrongPosition) else ()

    @property
    def focal_px(self) -> tuple[float, float] | None:
        """Focal length and its standard deviation by all frames [px]; None: it was known."""
        pairs = [
            (math.log(each.pose.focal_scale), each.sd_focal_scale)
            for each in self.oriented
            if each.pose is not None and each.sd_focal_scale is not None
        ]
        if not pairs:
            return None
        logs, sds = np.array(pairs).T
        weights = 1.0 / sds**2
        mean = float(np.sum(weights * logs) / np.sum(weights))
        scatter = float(np.sum(weights * (logs - mean) ** 2)) / max(1, len(logs) - 1)
        sd = math.sqrt(max(1.0, scatter) / float(np.sum(weights)))
        focal = self.flight.camera.mean_focal_px * math.exp(mean)
        return focal, focal * sd

    @property
    def distance_scale(self) -> tuple[float, float] | None:
        """Relative amount by which all distances are too long, and its standard deviation.

        Both are medians over the frames. None: no frame determines it.
        """
        pairs = [
            (each.distance_scale, each.sd_distance_scale)
            for each in self.oriented
            if each.distance_scale and each.sd_distance_scale is not None
        ]
        if not pairs:
            return None
        logs, sds = np.median(pairs, axis=0).tolist()
        return math.expm1(logs), sds

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings to consider before the poses are used."""
        doubts = []
        enough = [each for each in self.poses if len(each.targets) >= MIN_POINTS]
        oriented = sum(each.residuals is not None for each in enough)
        if 2 * oriented < len(enough):
            doubts.append(
                f"only {oriented} of {len(enough)} frames with {MIN_POINTS} targets or more could"
                " be oriented by them; look at position_m and at the names of the targets"
            )
        if self.wrong_input is not None:
            doubts.append(self._contradiction(self.wrong_input))
        if self.vehicle_off is not None:
            off = self.vehicle_off
            doubts.append(
                f"{off.target} on the vehicle is {rounded(off.beside_m)} m beside and"
                f" {rounded(abs(off.above_m))} m {'above' if off.above_m > 0.0 else 'below'} its"
                " place by the trajectory, as the frames show it among the static targets (median"
                f" of {off.frames} frames that contradict it, of {off.compared}); check times,"
                " lever_arm_m, and whether trajectory and position_m have one datum and epoch and"
                " heights of one kind"
            )
        if self.distance_scale is not None:
            share, sd = self.distance_scale
            if abs(share) > max(_MIN_SCALE, _SIGNIFICANT_SIGMAS * sd):
                doubts.append(
                    f"the distances are {1000.0 * abs(share):.1f} ‰ (± {1000.0 * sd:.1f})"
                    f" {'longer' if share > 0.0 else 'shorter'} than the positions say; look at the"
                    " targets' diameters and at the focal length"
                )
        unstated = self._targets_counted_as_exact
        if unstated:
            doubts.append(
                f"sd_position_m is not stated for {listed(unstated, _MAX_NAMED)}: the"
                " standard deviations of the poses count these positions as exact; state in"
                " flight.toml how accurate they are, and repeat the command"
            )
        return tuple(doubts)

    def _contradiction(self, wrong: WrongPosition | MovedTarget | WrongCamera | FastCamera) -> str:
        """Return the sentence on what the images contradict."""
        if isinstance(wrong, FastCamera):
            return (
                "the camera moves faster than motion_sd_deg_s"
                f" ({self.flight.camera.motion_sd_deg_s:g}°/s) says while its frames are read out,"
                f" or {self._suspect(wrong.otherwise)}; poses may be off by more than is stated;"
                " give the frames' times (eight in a row, 0.5 s apart at most, show the motion), or"
                " state how fast it may be (8 m/s at 30 m is 15°/s), and repeat 'kgcp detect'"
            )
        if isinstance(wrong, WrongPosition):
            first, *others = wrong.targets
            return (
                "the positions of the targets contradict each other: that of"
                f" {first} is off by {rounded(wrong.off_m)} m"
                + (
                    f", or that of {' or '.join(others)} is wrong: the frames do not tell which"
                    if others
                    else ""
                )
                + f" (χ² {wrong.chi2:.0f} of 3), or a diameter is wrong; poses may be off by more"
                " than is stated"
            )
        if isinstance(wrong, MovedTarget):
            return (
                f"{wrong.target} was moved: from {wrong.frame} on, the frames see it"
                f" {rounded(wrong.off_m)} m from where it was before; its points and the poses are"
                " wrong before or after; process the frames before and after as two flights, each"
                " with the position_m of its time, or leave this target out"
            )
        fitting = [
            f"{name} = {amount(value, sd)} instead of {getattr(self.flight.camera, name):g}"
            for name, (value, sd) in wrong.parameters.items()
        ]
        return (
            "the images contradict the camera's calibration"
            + (f" (they fit {', '.join(fitting)})" if fitting else "")
            + f"; poses are off by about {rounded(wrong.off_m)} m,"
            f" {wrong.off_sds:.0f} stated standard deviations; look whether the calibration is"
            " that of this camera, lens, zoom and focus"
            + (
                ", and whether motion_sd_deg_s covers how it moves"
                if self.flight.camera.readout_s
                else "; if its shutter is rolling, give readout_s"
            )
        )

    @staticmethod
    def _suspect(wrong: WrongPosition | MovedTarget | WrongCamera) -> str:
        """Return what is wrong if the camera's motion is as stated."""
        if isinstance(wrong, WrongPosition):
            return f"the position of {' or '.join(wrong.targets)} is wrong"
        if isinstance(wrong, MovedTarget):
            return f"{wrong.target} was moved"
        return "its calibration is wrong"

    @property
    def _targets_counted_as_exact(self) -> list[str]:
        """Targets that orient frames, without standard deviations of their positions."""
        used = {name for each in self.oriented for name in each.used}
        return [
            target.name
            for target in self.flight.all_targets
            if target.name in used and not any(target.sd_position_m)
        ]

    def summary(self) -> dict[str, object]:
        """Return all numbers for machines."""
        scale = self.distance_scale
        reasons = Counter(each.reason for each in self.poses if each.pose is None)
        focal = self.focal_px
        return {
            "frames": len(self.poses),
            "oriented": len(self.oriented),
            "by_one_ring": sum(each.is_by_one_ring for each in self.oriented),
            "rejected_targets": {
                each.frame: [name for name in each.targets if name not in each.used]
                for each in self.oriented
                if len(each.used) < len(each.targets) and not each.is_by_one_ring
            },
            "reasons": dict(sorted(reasons.items())),
            "distance_scale": None if scale is None else {"value": scale[0], "sd": scale[1]},
            "doubts": self.doubts,
            "focal_px": None if focal is None else {"value": focal[0], "sd": focal[1]},
        }


@single_threaded()
def orient_flight(
    flight: Flight,
    detections: Path | str | None = None,
    options: OrientOptions = OrientOptions(),
) -> FlightPoses:
    """Orient frames by the static targets that were measured in them.

    Parameters
    ----------
    detections : Path, optional
        What `detect_flight` wrote; by default in the flight's results folder.
    options : OrientOptions
        Which frames, and how.

    Raises
    ------
    KgcpError
        If there is no static target, no crs, no frame of these names, or no frame can be oriented.
    """
    table = results_folder(flight.folder) / DETECTIONS if detections is None else Path(detections)
    if not flight.static_targets:
        raise KgcpError(
            f"{flight.folder / 'flight.toml'}: no target is static; give position_m to the"
            " targets by which frames are to be oriented"
        )
    attempts = read_attempts(table, flight)
    frames = sorted({attempt.frame for attempt in attempts})
    if options.frames:
        frames = matching_frames(frames, options.frames)
    data = FlightData(flight, frames)
    positions = data.target_positions
    sightings = [attempt.sighting for attempt in attempts if attempt.sighting is not None]
    sd_scale = print_scale_sd(flight.static_targets)
    with np.errstate(all="ignore"):  # trial poses may be absurd; results that are not finite fail
        poses, motions = orient_moving(
            frames,
            sightings,
            positions.static,
            flight.camera,
            min_points=options.min_points,
            has_free_focal=options.has_free_focal,
            sd_scale=sd_scale,
            rotations=data.scene_rotations,
        )
        wrong = wrong_input(poses, sightings, positions.static, flight.camera, sd_scale, motions)
        off = None
        if not options.has_free_focal:  # it would change all distances
            on_vehicle = _on_vehicle(sightings, positions, flight.camera)
            prints_sd = print_scale_sd(flight.all_targets)
            off = vehicle_off(poses, on_vehicle, flight.camera, prints_sd)
    if not any(each.pose is not None for each in poses):
        reasons = Counter(each.reason for each in poses)
        reason, count = reasons.most_common(1)[0]
        raise KgcpError(
            f"{table}: no frame can be oriented; of {len(poses)} frames {count} have this reason:"
            f" {reason}"
        )
    choices = {
        "frames": options.frames,
        "min_points": options.min_points,
        "free_focal": options.has_free_focal,
    }
    provenance = derived_provenance(flight, table, choices, has_reference=False)
    return FlightPoses(flight, tuple(poses), positions.local_frame, provenance, wrong, off)


def _on_vehicle(
    sightings: Sequence[Sighting], positions: TargetPositions, camera: Camera
) -> dict[str, tuple[Sighting, TargetPosition]]:
    """Return the sightings of the target on the vehicle by frame, with its places."""
    moving = [each for each in unmistakable(sightings) if each.target not in positions.static]
    times_s = [each.row_time_s(camera) for each in moving]
    try:
        places = positions.positions([each.target for each in moving], times_s)
    except KgcpError:  # no trajectory, or no times: nothing to compare with
        return {}
    return {
        each.frame: (each, place)
        for each, place in zip(moving, places, strict=True)
        if isinstance(place, TargetPosition)
    }


def write_poses(poses: FlightPoses, folder: Path) -> tuple[Path, ...]:
    """Write `poses.parquet`, `pose_residuals.parquet` and `poses.csv`; return their paths.

    Raises
    ------
    KgcpError
        If a file cannot be written.
    """
    rows = on_map(poses.poses, poses.local_frame)
    crs = poses.local_frame.crs
    table, text = folder / POSES_TABLE, folder / "poses.csv"
    content = poses_csv(rows, is_geographic=is_geographic(crs)).encode()
    write_bytes(text, content)
    cells = (row_of(POSE_COLUMNS, row) for row in rows)
    about = {**poses.provenance, "crs": crs}
    write_table(
        table, POSE_COLUMNS, cells, {**about, **orientation_provenance(poses.flight, content)}
    )
    residuals = folder / "pose_residuals.parquet"
    cells = (row_of(POSE_RESIDUAL_COLUMNS, row) for row in pose_residuals(poses.poses))
    write_table(residuals, POSE_RESIDUAL_COLUMNS, cells, about)
    return table, residuals, text
