"""The inputs in a flight's folder before anything is measured, and the doubts about them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TypeVar

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.crs import longitude_latitude
from kgcp.georef.prediction import reference_states
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Attempt, Sighting, known_times_s
from kgcp.georef.target_positions import TargetPositions
from kgcp.georef.trajectory import Trajectory
from kgcp.io.files.safe_read import is_missing
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.io.formats.frame_times import FrameTimes
from kgcp.io.images.exif import read_frame_header
from kgcp.io.images.frames import list_frames
from kgcp.io.images.remote import StoredFolder, at_hand
from kgcp.io.tables.provenance import TARGET_TABLE
from kgcp.io.tables.staleness import (
    changed_since_orient,
    frames_of_other_poses,
    listed_changes,
)
from kgcp.pipeline.frame_priors import motions_while_read
from kgcp.quality.checks.calibration import check_camera
from kgcp.quality.checks.camera_position import check_camera_position
from kgcp.quality.checks.clock import (
    MIN_EXIF_TIMES,
    check_completeness,
    check_exif_deviation,
    check_exif_times,
    check_fractions,
    check_overlap,
    check_same_times,
)
from kgcp.quality.checks.course import (
    Course,
    check_attitude,
    check_flips,
    check_steady_offsets,
    course_of,
)
from kgcp.quality.checks.deviations import (
    check_deviations,
    check_pose_deviations,
    check_target_deviations,
    check_vehicle_deviations,
)
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild, ranked
from kgcp.quality.checks.frame_header import FrameHeader, check_frames
from kgcp.quality.checks.lever_arm import check_lever_arm
from kgcp.quality.checks.measured import measured_doubts
from kgcp.quality.checks.place import check_grid_scale, check_place
from kgcp.quality.checks.plate import check_plates
from kgcp.quality.checks.reference import check_reference, check_visibility
from kgcp.quality.checks.spikes import check_spikes
from kgcp.quality.checks.static_targets import check_overlaps
from kgcp.quality.consistency import Consistency, study_consistency
from kgcp.quality.number_text import counted

SAMPLED_FRAMES = 100
"""Headers that are read where a command has other work to do."""

_STORED_FRAMES = 5
_PLACES = 1000  # of a trajectory that are compared with the frames' own

_OF_PLACES = frozenset({Cause.AXES_SWAPPED, Cause.ANGLE_UNIT, Cause.CRS})
_OF_TIMES = frozenset({Cause.CLOCK, Cause.FRAME_ORDER})
_CAUSES_OF_ERRORS = _OF_PLACES | {Cause.CLOCK, Cause.CAMERA_POSITION}

_Input = TypeVar("_Input")


@contextmanager
def naming_causes(doubts: Sequence[Doubt]) -> Iterator[None]:
    """Replace an error about places or times by its cause, if a grave doubt explains it.

    Raises
    ------
    KgcpError
        The error of the block, or the doubt in its place.
    """
    try:
        yield
    except KgcpError as error:
        causes = [doubt for doubt in doubts if doubt.is_grave and doubt.code in _CAUSES_OF_ERRORS]
        if not causes:
            raise
        raise KgcpError(causes[0]) from error


@dataclass(frozen=True)
class FlightInputs:
    """The records of a flight, read when first needed; errors are kept as doubts."""

    flight: Flight
    data: FlightData
    frames: tuple[str, ...]  # all of them, sorted
    headers: tuple[FrameHeader, ...]  # of all frames, or of some, evenly spaced
    # times that the frames had when targets were detected in them [s]; None: not detected yet
    detected_s: Mapping[str, float] | None = None

    @classmethod
    def of(
        cls,
        flight: Flight,
        frames: Sequence[str],
        folder: StoredFolder | None = None,
        *,
        max_headers: int | None = None,
        headers_of: Sequence[str] | None = None,
    ) -> FlightInputs:
        """Read the headers of a flight's frames.

        Parameters
        ----------
        folder : StoredFolder, optional
            Place of the frames, if they are not in the flight's folder.
        max_headers : int, optional
            Largest number of headers to read; by default all.
        headers_of : sequence of str, optional
            Frames whose headers are read; by default all.
        """
        return cls(
            flight,
            FlightData(flight, frames),
            tuple(frames),
            read_headers(flight, headers_of or frames, folder, max_headers),
        )

    @classmethod
    def detected(
        cls, flight: Flight, data: FlightData, attempts: Sequence[Attempt]
    ) -> FlightInputs:
        """Take frames and times from detections, and read some headers."""
        frames = sorted({attempt.frame for attempt in attempts})
        headers = read_headers(flight, frames, max_headers=SAMPLED_FRAMES)
        return cls(flight, data, tuple(frames), headers, known_times_s(attempts))

    @cached_property
    def problems(self) -> list[Doubt]:
        """What could not be read, as far as it was tried."""
        return []

    @cached_property
    def times_s(self) -> Mapping[str, float]:
        """Times of frames [s]: those of the detections, of the times file, or of the headers."""
        if self.detected_s is not None:
            return self.detected_s
        by_header = {
            header.frame: header.time_s for header in self.headers if header.time_s is not None
        }
        if self.flight.times_file is None:
            return by_header
        if self._file_times is None:
            return {}
        return by_header | self._named_s if self.flight.may_use_exif_times else self._named_s

    @property
    def _named_s(self) -> dict[str, float]:
        """Times that the times file gives to frames [s]."""
        frames, named = set(self.frames), self._file_times
        times = {} if named is None else named.time_s
        return {frame: time_s for frame, time_s in times.items() if frame in frames}

    @cached_property
    def _file_times(self) -> FrameTimes | None:
        """What the times file says; None: it cannot be read."""
        return self._read(lambda: self.data.frame_times)

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """The vehicle's trajectory; None: there is none, or it cannot be read."""
        if not self.data.has_trajectory:
            return None
        return self._read(lambda: self.data.trajectory)

    @cached_property
    def target_positions(self) -> TargetPositions | None:
        """Where the targets were; None: not known."""
        is_placed = any(map(self.data.has_position_of, self.flight.all_targets))
        if not is_placed or (self.data.has_trajectory and self.trajectory is None):
            return None
        return self._read(lambda: self.data.target_positions)

    @cached_property
    def reference_poses(self) -> ReferencePoses | None:
        """Reference poses; None: there are none, or they cannot be read."""
        if not self.data.has_reference:
            return None
        return self._read(lambda: self.data.reference_poses)

    @cached_property
    def course(self) -> Course | None:
        """The vehicle's course; None: it is not known, or the vehicle stands."""
        positions, trajectory = self.target_positions, self.trajectory
        if positions is None or positions.vehicle is None or trajectory is None:
            return None
        return course_of(positions.vehicle, trajectory.attitude_deg)

    @cached_property
    def expected_radii_px(self) -> FloatArray | None:
        """Radii (n,) of the first target in the frames that reference poses put it into [px].

        None: not known, since poses, times or places are missing.
        """
        positions, poses = self.target_positions, self.reference_poses
        if positions is None or poses is None:
            return None
        camera = self.flight.camera
        try:
            states = reference_states(
                self.frames,
                [self.times_s.get(frame) for frame in self.frames],
                self.flight.all_targets[0],
                poses,
                positions,
                camera,
            )
        except KgcpError:  # no time, or outside the trajectory: that is a doubt
            return None
        states = states[np.isfinite(states).all(axis=1)]
        radius = np.exp(states[:, 2])
        last = np.array([camera.width, camera.height]) - 1 - radius[:, None]
        centre = states[:, :2]
        return radius[np.all((centre >= radius[:, None]) & (centre <= last), axis=1)]

    @cached_property
    def plausibility(self) -> tuple[Doubt, ...]:
        """What does not fit, grave doubts first; without what cannot be read."""
        flight = self.flight
        doubts = [
            *check_camera(
                flight.camera,
                is_guessed=flight.is_camera_guessed,
                grade=flight.calibration_grade,
            ),
            *check_plates(flight.all_targets),
            *check_target_deviations(flight.all_targets),
            *check_frames(self.headers, flight.camera, flight.exif_camera),
            *self._doubts_of_places(),
            *self._doubts_of_times(),
        ]
        if flight.vehicle is not None:
            moving = [each.name for each in flight.all_targets if each.position_m is None]
            doubts += check_lever_arm(flight.vehicle.settings, moving)
            doubts += check_vehicle_deviations(flight.vehicle.settings)
        if self.target_positions is not None and not _has_wrong_places(doubts):
            doubts += check_overlaps(flight.static_targets, self.target_positions.static)
            doubts += check_attitude(self.course)
            vehicle = self.target_positions.vehicle
            if vehicle is not None and self.trajectory is not None:
                headings_deg = self.trajectory.attitude_deg[:, 2]
                doubts += check_steady_offsets(self.course, vehicle.settings)
                doubts += check_flips(vehicle.motion, headings_deg, vehicle.settings)
                doubts += check_spikes(vehicle.motion)
                doubts += check_deviations(vehicle.motion, self.trajectory.format)
            if self.reference_poses is not None:
                doubts += check_reference(self.reference_poses, self.target_positions)
        poses = self.reference_poses
        if poses is not None and flight.reference is not None:
            doubts += check_pose_deviations(poses)
            doubts += outdated_poses(flight.reference.file, flight)
        is_doubted = any(doubt.is_grave or doubt.code in _OF_TIMES for doubt in doubts)
        if poses is not None and not is_doubted:
            doubts += check_visibility(poses.frames, self.frames, self.expected_radii_px)
        return ranked(doubts)

    def doubts(self) -> tuple[Doubt, ...]:
        """Return all doubts and reading errors, grave ones first."""
        doubts = self.plausibility
        if _has_wrong_places(doubts):
            return doubts  # reading errors are then a consequence
        return ranked((*self.problems, *doubts))

    def compared(
        self, sightings: Sequence[Sighting]
    ) -> tuple[Consistency | None, tuple[Doubt, ...]]:
        """Return the agreement of vehicle and camera (None: unknown), and all doubts, ranked."""
        data, camera = self.data, self.flight.camera
        positions = data.target_positions
        poses = data.reference_poses if data.has_reference else None
        agreement = motions = None
        if poses is not None:
            motions = self.motions(sightings)
            agreement = study_consistency(sightings, positions, poses, camera, motions)
        doubts = measured_doubts(
            self.plausibility,
            sightings,
            positions,
            poses,
            camera,
            self.headers,
            agreement,
            self.flight.all_targets,
            motions,
        )
        return agreement, doubts

    def motions(self, sightings: Sequence[Sighting]) -> CameraMotions | None:
        """Return how the camera moves while a rolling shutter reads frames, as the poses show.

        Raises
        ------
        KgcpError
            If the poses or the target's positions cannot be read.
        """
        data = self.data
        poses, local_frame = data.reference_poses, data.target_positions.local_frame
        return motions_while_read(self.flight, data, poses, local_frame, self.times_s, sightings)

    def _doubts_of_places(self) -> list[Doubt]:
        crs = self.flight.crs
        if crs is None:
            return []
        places = []
        if self.trajectory is not None:
            places.append((self.trajectory.position_map, "the trajectory"))
        places += [
            (np.array([target.position_m]), f"the static target {target.name!r}")
            for target in self.flight.static_targets
        ]
        if self.reference_poses is not None and len(self.reference_poses.frames):
            places.append((self.reference_poses.position_map, "the reference poses"))
        checks = (check_place(crs, position, where) for position, where in places)
        doubts = self._read(lambda: [*chain.from_iterable(checks)]) or []
        if places and not doubts and not self.problems:
            position, where = places[0]
            few = position[:: max(1, len(position) // _PLACES), :2]
            ground = longitude_latitude(crs, few)
            ground = ground[np.isfinite(ground).all(axis=1)]
            doubts += check_camera_position(self.headers, crs, ground, where)
            doubts += check_grid_scale(crs, position)
        return doubts

    def _doubts_of_times(self) -> Iterator[Doubt]:
        times = self.times_s
        if self.trajectory is not None and self.flight.vehicle is not None:
            settings = self.flight.vehicle.settings
            frame_s = np.array([times[frame] for frame in sorted(times)])
            yield from check_overlap(frame_s, self.trajectory.time_s, settings.time_offset_s)
            yield from check_fractions(frame_s, settings.sd_time_s)
            yield from check_same_times(times)
            is_of_exif = any(header.time_s is not None for header in self.headers)
            if is_of_exif and self.flight.times_file is None:
                yield from check_exif_deviation(settings.sd_time_s)
        is_known = self.detected_s is not None or self._file_times is not None
        if self.flight.vehicle is not None and is_known:
            may_be_by_header = self.detected_s is None and self.flight.may_use_exif_times
            read = {header.frame for header in self.headers}
            frames = [
                frame
                for frame in self.frames
                if frame in read or frame in times or not may_be_by_header
            ]
            yield from check_completeness(frames, times)
        if self.flight.times_file is not None:
            # EXIF agrees with itself
            compared = self._named_s if self.detected_s is None else times
            for is_zone_known in (True, False):
                both = [
                    (header.frame, compared[header.frame], exif_s)
                    for header in self.headers
                    if (exif_s := header.time_s if is_zone_known else header.clock_s) is not None
                    and header.frame in compared
                ]
                if len(both) >= MIN_EXIF_TIMES:
                    yield from check_exif_times(
                        *zip(*both, strict=True), is_zone_known=is_zone_known
                    )
                    return

    def _read(self, read: Callable[[], _Input]) -> _Input | None:
        try:
            return read()
        except KgcpError as error:
            sentence, _, remedy = str(error).rpartition("; ")
            doubt = grave(Cause.UNREADABLE, sentence or remedy, remedy if sentence else "")
            if doubt.sentence not in {problem.sentence for problem in self.problems}:
                self.problems.append(doubt)
            return None


def _has_wrong_places(doubts: Sequence[Doubt]) -> bool:
    """Tell whether places are so doubtful that what follows from them means nothing."""
    return any(doubt.code in _OF_PLACES for doubt in doubts)


def outdated_poses(file: Path, flight: Flight) -> tuple[Doubt, ...]:
    """Return the doubt about poses by `kgcp orient` if flight.toml has been changed since.

    It is grave if camera or crs have been changed, or if the poses are those of other frames.
    """
    others = frames_of_other_poses(file, flight)
    if others:
        return (
            grave(
                Cause.REFERENCE,
                f"{file}: 'kgcp orient' computed these poses from other files than"
                f" {counted(len(others), 'frame')} of this flight ({others[0]}"
                f"{', …' if others[1:] else ''}), perhaps of another flight with such names",
                "give the poses of this flight; or repeat 'kgcp detect' and 'kgcp orient' if its"
                " frames have been changed",
            ),
        )
    changes = changed_since_orient(file, flight)
    if not changes:
        return ()
    doubt = mild if all(change.startswith(TARGET_TABLE) for change in changes) else grave
    return (
        doubt(
            Cause.REFERENCE,
            f"{file}: 'kgcp orient' computed these poses before flight.toml was changed:"
            f" {listed_changes(changes)}",
            "repeat 'kgcp orient', after 'kgcp detect' if that must be repeated, too",
        ),
    )


def missing_files(flight: Flight) -> tuple[Doubt, ...]:
    """Return the files that flight.toml names and that do not exist yet."""
    named = []
    if flight.vehicle is not None:
        named.append((flight.vehicle.trajectory_file, "[vehicle] trajectory", "export-gcp"))
    if flight.reference is not None:
        named.append((flight.reference.file, "[reference] poses", "bias-report"))
    return tuple(
        mild(
            Cause.UNREADABLE,
            f"{file}: does not exist; {key} names it and 'kgcp {command}' needs it",
            "put it there or correct flight.toml",
        )
        for file, key, command in named
        if is_missing(file)
    )


def missing_frames(flight: Flight, sightings: Sequence[Sighting]) -> tuple[Doubt, ...]:
    """Return a doubt if frames of sightings are gone from a folder that still has others."""
    try:
        present = {*list_frames(flight.frames_folder)}
    except KgcpError:  # in an archive or a store
        return ()
    frames = sorted({sighting.frame for sighting in sightings})
    missing = [frame for frame in frames if frame not in present]
    if len(missing) in (0, len(frames)):
        return ()
    return (
        mild(
            Cause.UNREADABLE,
            "frames with the target that are no longer in the folder of the frames:"
            f" {len(missing)} of {len(frames)} ({missing[0]}{', …' if len(missing) > 1 else ''})",
            "repeat 'kgcp detect' if they are not to be used",
        ),
    )


def read_headers(
    flight: Flight,
    frames: Sequence[str],
    folder: StoredFolder | None = None,
    max_headers: int | None = None,
) -> tuple[FrameHeader, ...]:
    """Read the headers of frames, at most `max_headers` of them, evenly spaced.

    Objects of a store are read as a whole, so that only a few of them are.
    """
    if folder is not None:
        max_headers = min(max_headers or _STORED_FRAMES, _STORED_FRAMES)
    chosen = frames
    if max_headers is not None and max_headers < len(frames):
        rows = np.linspace(0, len(frames) - 1, max_headers).astype(int)
        chosen = [frames[row] for row in rows.tolist()]
    headers = []
    for frame in chosen:
        with at_hand(folder or flight.frames_folder, frame) as path:
            headers.append(read_frame_header(path, frame))
    return tuple(headers)


def timed_frames(inputs: FlightInputs) -> tuple[list[str], FloatArray]:
    """Return the frames that have a time, in their order, and their times (n,) [s]."""
    names = [frame for frame in inputs.frames if frame in inputs.times_s]
    return names, np.array([inputs.times_s[frame] for frame in names])
