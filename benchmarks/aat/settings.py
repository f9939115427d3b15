"""What a simulated corridor block is like, and where its ground is.

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
FROM_END_M = 10.0  # first and last check point and GCP, from the first and last frame
FREE_PARAMETERS = ("f", "cx", "cy", "k1", "k2")  # of the calibration; f = fx = fy


class Way(StrEnum):
    """What controls the block besides the positions of its cameras."""

    GNSS = "GNSS only"
    GCPS = "+ 2 classic GCPs"
    KGCPS = "+ KGCPs"
    DISTANCES = "+ KGCPs with distances"


@dataclass(frozen=True, slots=True)
class BlockSettings:
    """What the block is like. Deviations are of one standard deviation.

    Attributes
    ----------
    interval_s, speed_m_s : float
        Of the frames [s]; of the vehicle and the UAV [m/s].
    bend_radius_m : float
        Of the corridor [m].
    height_m, sd_height_m : float
        Of the camera above the road [m].
    wander_m : tuple of float
        How far the UAV comes and goes from above the vehicle, along and across [m].
    relief_m, undulation_m : float
        Height of tie points above ground, uniform from 0; amplitude of the ground's long waves [m].
    sd_tilt_deg, sd_heading_deg : float
        Of the camera, from frame to frame [deg].
    tie_points, checks : int
        Points on the ground, before those in fewer than three frames are left out.
    seen_share : float
        Of the frames that see a tie point, how many have it measured.
    sd_tie_px, sd_mark_px : float
        Of the image of a tie point, and of the signalised check points and GCPs [px].
    sd_gnss_m, sd_gnss_drift_m : tuple of float
        Camera positions, horizontal and up: from frame to frame, and the error that they share [m].
    gnss_correlation_s : float
        Over which the shared error falls to 1/e [s].
    sd_gcp_m : tuple of float
        Classic ground control, horizontal and up [m].
    sd_vehicle_m : tuple of float
        Vehicle's trajectory, horizontal and up, fading over `VehicleSettings.correlation_s` [m].
    sd_attitude_deg : float
        Its roll, pitch and heading [deg].
    sd_lever_arm_m, sd_time_s : float
        Errors of the lever arm, per axis [m], and of the synchronisation [s].
    sd_diameter_m : float
        Of the print [m].
    sd_believed : tuple of float
        Of `FREE_PARAMETERS` in the calibration from before the flight.
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
        """Way of the vehicle from the first frame to the last [m]."""
        return (self.frames - 1) * self.interval_s * self.speed_m_s

    @property
    def checks_along_m(self) -> FloatArray:
        """Where the check points are along the corridor: at least four frames see each [m]."""
        return np.linspace(FROM_END_M, self.length_m - FROM_END_M, self.checks)


def random_stream(seed: int, purpose: str, index: int = 0) -> np.random.Generator:
    """Return an independent stream of random numbers."""
    key = (*purpose.encode(), index)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def map_frame() -> LocalFrame:
    """Return the frame of all blocks."""
    return LocalFrame.at(CRS, ORIGIN_MAP)


def axes_of(horizontal_and_up: tuple[float, float]) -> FloatArray:
    """Return values (3,) of east, north and up."""
    horizontal, up = horizontal_and_up
    return np.array([horizontal, horizontal, up])


def faded_covariance(times_s: FloatArray, correlation_s: float, sd: FloatArray) -> FloatArray:
    """Return the covariance (k n, k n) of n values of k errors that fade over time."""
    fading = np.exp(-np.abs(times_s[:, None] - times_s) / correlation_s)
    return np.kron(fading, np.diag(np.square(sd)))


def ground_m(settings: BlockSettings, along_m: FloatArray, across_m: FloatArray) -> FloatArray:
    """Return the height of the ground [m], outside the corridor's axis positive."""
    waves = np.sin(2.0 * np.pi * along_m / 420.0)
    height: FloatArray = settings.undulation_m * waves + 0.4 * np.sin(
        2.0 * np.pi * along_m / 95.0 + across_m / 12.0
    )
    return height


def on_corridor(
    settings: BlockSettings, along_m: FloatArray, across_m: FloatArray, up_m: FloatArray
) -> FloatArray:
    """Return places (n, 3) by their way along the bend, anticlockwise, and outside it."""
    angle = along_m / settings.bend_radius_m
    radius_m = settings.bend_radius_m + across_m
    return np.column_stack((radius_m * np.cos(angle), radius_m * np.sin(angle), up_m))
