"""Settings of a simulated corridor block, and the shape of its ground.

Everything is in one local Cartesian frame, east, north, up, about the centre of the bend.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.local_frame import LocalFrame

CRS = "EPSG:25832"
ORIGIN_MAP: FloatArray = np.array([689_412.0, 5_336_208.0, 545.0])
FROM_END_M = 10.0  # distance of the outermost check points and GCPs from the outermost frames
FREE_PARAMETERS = ("f", "cx", "cy", "k1", "k2")  # of the calibration; f = fx = fy


class Control(StrEnum):
    """Control of the block in addition to the positions of its cameras."""

    GNSS = "GNSS only"
    GCPS = "+ 2 classic GCPs"
    KGCPS = "+ KGCPs"
    DISTANCES = "+ KGCPs with distances"


@dataclass(frozen=True, slots=True)
class BlockSettings:
    """Settings of a block. Names with sd_ are standard deviations.

    Attributes
    ----------
    interval_s, speed_m_s : float
        Interval between frames [s]; speed of the vehicle and the UAV [m/s].
    bend_radius_m : float
        Radius of the corridor's bend [m].
    height_m, sd_height_m : float
        Height of the camera above the road, and its variation [m].
    wander_m : tuple of float
        Amplitude of the UAV's offset from the vehicle, along and across [m].
    relief_m, undulation_m : float
        Largest height of tie points above ground, from a uniform distribution; amplitude of the
        ground's long waves [m].
    sd_tilt_deg, sd_heading_deg : float
        Roll and pitch, and heading, of the camera: variation from frame to frame [deg].
    tie_points, checks : int
        Number of points on the ground, including those that fewer than three frames see.
    seen_share : float
        Share of the frames with a tie point in view in which it is measured.
    sd_tie_px, sd_mark_px : float
        Noise of the images of tie points, and of the signalised check points and GCPs [px].
    sd_gnss_m, sd_gnss_drift_m : tuple of float
        Errors of camera positions, horizontal and up: independent and correlated ones [m].
    gnss_correlation_s : float
        Time over which the correlation of the latter falls to 1/e [s].
    sd_gcp_m : tuple of float
        Errors of classic GCPs, horizontal and up [m].
    sd_vehicle_m : tuple of float
        Errors of the vehicle's trajectory, horizontal and up, with a correlation that decays over
        `VehicleSettings.correlation_s` [m].
    sd_attitude_deg : float
        Errors of the vehicle's roll, pitch and heading [deg].
    sd_lever_arm_m, sd_time_s : float
        Errors of the lever arm, per axis [m], and of the synchronisation [s].
    sd_diameter_m : float
        Error of the diameter of the print [m].
    sd_believed : tuple of float
        Errors of `FREE_PARAMETERS` in the calibration from before the flight.
    """

    frames: int = 80
    interval_s: float = 1.5
    speed_m_s: float = 7.0
    bend_radius_m: float = 1500.0
    height_m: float = 50.0
    sd_height_m: float = 0.3
    wander_m: tuple[float, float] = (5.0, 3.0)
    relief_m: float = 1.5
    undulation_m: float = 0.5
    sd_tilt_deg: float = 0.3
    sd_heading_deg: float = 2.0
    tie_points: int = 2500
    checks: int = 24
    seen_share: float = 0.7
    sd_tie_px: float = 0.4
    sd_mark_px: float = 0.2
    sd_gnss_m: tuple[float, float] = (0.030, 0.050)
    sd_gnss_drift_m: tuple[float, float] = (0.030, 0.050)
    gnss_correlation_s: float = 200.0
    sd_gcp_m: tuple[float, float] = (0.010, 0.015)
    sd_vehicle_m: tuple[float, float] = (0.015, 0.020)
    sd_attitude_deg: float = 0.05
    sd_lever_arm_m: float = 0.003
    sd_time_s: float = 0.001
    sd_diameter_m: float = 0.0002
    sd_believed: tuple[float, ...] = (2.9, 2.0, 2.0, 1e-3, 2e-3)

    @property
    def length_m(self) -> float:
        """Distance that the vehicle drives from the first frame to the last [m]."""
        return (self.frames - 1) * self.interval_s * self.speed_m_s

    @property
    def checks_along_m(self) -> FloatArray:
        """Positions of the check points along the corridor; at least four frames see each [m]."""
        return np.linspace(FROM_END_M, self.length_m - FROM_END_M, self.checks)


def random_stream(seed: int, purpose: str, index: int = 0) -> np.random.Generator:
    """Return an independent stream of random numbers."""
    key = (*purpose.encode(), index)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def map_frame() -> LocalFrame:
    """Return the local frame of all blocks."""
    return LocalFrame.at(CRS, ORIGIN_MAP)


def axes_of(horizontal_and_up: tuple[float, float]) -> FloatArray:
    """Return values (3,) for east, north and up."""
    horizontal, up = horizontal_and_up
    return np.array([horizontal, horizontal, up])


def faded_covariance(times_s: FloatArray, correlation_s: float, sd: FloatArray) -> FloatArray:
    """Return the covariance (k n, k n) of k errors at n times; their correlation decays."""
    fading = np.exp(-np.abs(times_s[:, None] - times_s) / correlation_s)
    return np.kron(fading, np.diag(np.square(sd)))


def ground_m(settings: BlockSettings, along_m: FloatArray, across_m: FloatArray) -> FloatArray:
    """Return the height of the ground [m]; `across_m` is positive outside the bend."""
    waves = np.sin(2.0 * np.pi * along_m / 420.0)
    height: FloatArray = settings.undulation_m * waves + 0.4 * np.sin(
        2.0 * np.pi * along_m / 95.0 + across_m / 12.0
    )
    return height


def on_corridor(
    settings: BlockSettings, along_m: FloatArray, across_m: FloatArray, up_m: FloatArray
) -> FloatArray:
    """Return positions (n, 3) by distance along the bend, anticlockwise, and outwards of it."""
    angle = along_m / settings.bend_radius_m
    radius_m = settings.bend_radius_m + across_m
    return np.column_stack((radius_m * np.cos(angle), radius_m * np.sin(angle), up_m))
