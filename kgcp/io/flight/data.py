"""The files that flight.toml names: each is read once, when it is first needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

from kgcp.errors import KgcpError
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.target_positions import TargetPositions
from kgcp.georef.trajectory import Trajectory
from kgcp.io.files.safe_read import is_missing
from kgcp.io.flight.flight import Flight
from kgcp.io.formats.frame_times import FrameTimes, read_times
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.trajectories import read_trajectory
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.settings import VehicleSettings
from kgcp.targets.plain import AnyTarget


class FlightData:
    """Times of the frames, reference poses of the camera and positions of the targets.

    The last two may become available later than the frames: detections need neither, and reference
    poses mostly come from an adjustment with the points that kgcp exports. `has_reference`
    and `has_position_of` tell whether they are there; this is decided only here.

    Parameters
    ----------
    frames : sequence of str
        Its frames, by which the images of the poses' file are known.
    """

    def __init__(self, flight: Flight, frames: Sequence[str]) -> None:
        self._flight, self._frames = flight, frames

    @property
    def has_reference(self) -> bool:
        """Whether flight.toml names reference poses that exist."""
        reference = self._flight.reference
        return reference is not None and not is_missing(reference.file)

    @property
    def has_trajectory(self) -> bool:
        """Whether flight.toml names a trajectory that exists."""
        vehicle = self._flight.vehicle
        return vehicle is not None and not is_missing(vehicle.trajectory_file)

    def has_position_of(self, target: AnyTarget) -> bool:
        """Tell whether a target has a position, or the files that its position is computed from."""
        is_placed = target.position_m is not None or self.has_trajectory
        return self._flight.crs is not None and is_placed

    @cached_property
    def frame_times(self) -> FrameTimes:
        """What the times file says, also of frames that are not there; without one, nothing.

        Raises
        ------
        KgcpError
            As `read_times`.
        """
        flight = self._flight
        if flight.times_file is None:
            return FrameTimes({})
        return read_times(flight.times_file, self._frames, flight.times_format)

    @property
    def scene_rotations(self) -> Mapping[str, SceneRotation]:
        """How the scene turns while a rolling shutter reads frames, by those with rates.

        Raises
        ------
        KgcpError
            As `frame_times`.
        """
        return self.frame_times.rotation if self._flight.camera.readout_s else {}

    @cached_property
    def reference_poses(self) -> ReferencePoses:
        """Reference poses, in the flight's CRS.

        Raises
        ------
        KgcpError
            If flight.toml names none; else as `read_reference_poses`.
        """
        flight = self._flight
        if flight.reference is None:
            raise KgcpError(
                f"{flight.folder / 'flight.toml'}: has no [reference]; give poses ="
                " 'reference.csv' with the camera's poses from an adjustment"
            )
        return read_reference_poses(
            flight.reference.file, flight.reference.options, crs=flight.crs, frames=self._frames
        )

    @cached_property
    def target_positions(self) -> TargetPositions:
        """Where the flight's targets were, by the vehicle's trajectory if it has one.

        Raises
        ------
        KgcpError
            If flight.toml has no crs, its crs is unusable, no target has a position, or the
            trajectory cannot be read.
        """
        flight, crs = self._flight, self._crs
        settings = VehicleSettings() if flight.vehicle is None else flight.vehicle.settings
        return TargetPositions.of(crs, flight.all_targets, self.trajectory, settings)

    @cached_property
    def static_positions(self) -> TargetPositions:
        """Positions of the static targets. The trajectory is not read.

        Raises
        ------
        KgcpError
            If flight.toml has no crs, its crs is unusable, or no target is static.
        """
        return TargetPositions.of(self._crs, self._flight.all_targets, None, VehicleSettings())

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """The vehicle's trajectory; None: no target is carried by a vehicle.

        Raises
        ------
        KgcpError
            If flight.toml has no crs, or as `read_trajectory`.
        """
        vehicle = self._flight.vehicle
        if vehicle is None:
            return None
        return read_trajectory(vehicle.trajectory_file, self._crs, vehicle.options)

    @property
    def _crs(self) -> str:
        flight = self._flight
        if flight.crs is None:
            raise KgcpError(
                f"{flight.folder / 'flight.toml'}: has no crs; name that of the coordinates,"
                ' for example crs = "EPSG:25831"'
            )
        return flight.crs
