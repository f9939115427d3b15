"""From a flight's files to where its targets were."""

from __future__ import annotations

from kgcp.errors import KgcpError
from kgcp.georef.target_positions import Whereabouts
from kgcp.io.flight.flight import Flight
from kgcp.io.formats.trajectories import read_trajectory
from kgcp.settings import VehicleSettings


def read_whereabouts(flight: Flight) -> Whereabouts:
    """Read the vehicle's trajectory, if the flight has one, and place the flight's targets.

    Raises
    ------
    KgcpError
        If flight.toml has no crs, its crs is unusable, no target has a position, or the
        trajectory cannot be read.
    """
    if flight.crs is None:
        raise KgcpError(
            f"{flight.folder / 'flight.toml'}: has no crs; name that of the coordinates,"
            ' for example crs = "EPSG:25831"'
        )
    trajectory = None
    if flight.trajectory_file is not None and flight.trajectory_notation is not None:
        trajectory = read_trajectory(flight.trajectory_file, flight.crs, flight.trajectory_notation)
    settings = flight.vehicle or VehicleSettings()
    return Whereabouts.of(flight.crs, flight.targets, trajectory, settings)
