"""A simulated corridor block, with truth and observations: a UAV follows a vehicle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from benchmarks.aat.ride import Ride, drive
from benchmarks.aat.settings import (
    FREE_PARAMETERS,
    FROM_END_M,
    BlockSettings,
    axes_of,
    faded_covariance,
    ground_m,
    on_corridor,
    random_stream,
)
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Camera, Response
from kgcp.simulation.path import CameraState

_TRUE_CAMERA = Camera(
    width=4000,
    height=3000,
    fx=2900.0,
    fy=2900.0,
    cx=1988.3,
    cy=1509.6,
    k1=-0.061,
    k2=0.043,
    response=Response.LINEAR,
)
_STRIP_HALF_WIDTH_M = 36.0  # of tie points: a little wider than the frames see
_BEYOND_ENDS_M = 28.0
_CHECK_ACROSS_M = 16.0
_GCP_ACROSS_M = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class ImagePoints:
    """Points of the ground and their images.

    Attributes
    ----------
    points_enu_m : (m, 3) array
        True positions: first the check points, then the classic GCPs, then tie points [m].
    checks, gcps : int
        Number of check points and of GCPs.
    frame, point : (k,) arrays
        Indices of frame and point of each image point.
    pixels : (k, 2) array
        Image points, with noise [px].
    """

    points_enu_m: FloatArray
    checks: int
    gcps: int
    frame: IndexArray
    point: IndexArray
    pixels: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """A block: the truth, and all observations except those of the target.

    Attributes
    ----------
    camera, believed : Camera
        The true camera, and the calibration from before the flight, with which kgcp measures.
    views : tuple of CameraState
        True exterior orientations.
    gnss_enu_m : (n, 3) array
        Observed projection centres [m].
    gnss_cov_m2 : (3 n, 3 n) array
        Joint covariance of these positions.
    gcps_enu_m : (g, 3) array
        Surveyed positions of the classic GCPs [m].
    """

    settings: BlockSettings
    seed: int
    camera: Camera
    believed: Camera
    views: tuple[CameraState, ...]
    gnss_enu_m: FloatArray
    gnss_cov_m2: FloatArray
    gcps_enu_m: FloatArray
    image_points: ImagePoints
    ride: Ride


def simulate_block(settings: BlockSettings, seed: int) -> Block:
    """Simulate a block; the same settings and seed give the same block."""
    times_s = settings.interval_s * np.arange(settings.frames, dtype=np.float64)
    ride = drive(settings, times_s, random_stream(seed, "ride"))
    views = _camera_states(settings, times_s, random_stream(seed, "flight"))
    image_points = _image_points_of(settings, views, random_stream(seed, "sights"))
    rng = random_stream(seed, "survey")
    centres = np.array([view.position_enu_m for view in views])
    cov = faded_covariance(times_s, settings.gnss_correlation_s, axes_of(settings.sd_gnss_drift_m))
    cov[np.diag_indices_from(cov)] += np.tile(np.square(axes_of(settings.sd_gnss_m)), len(views))
    gcps = image_points.points_enu_m[image_points.checks : image_points.checks + image_points.gcps]
    return Block(
        settings,
        seed,
        _TRUE_CAMERA,
        calibrated(seed, "before", np.array(settings.sd_believed)),
        views,
        centres + (np.linalg.cholesky(cov) @ rng.standard_normal(len(cov))).reshape(-1, 3),
        cov,
        gcps + axes_of(settings.sd_gcp_m) * rng.standard_normal(gcps.shape),
        image_points,
        ride,
    )


def calibrated(seed: int, purpose: str, sd: FloatArray) -> Camera:
    """Return the true camera with random errors of f, cx, cy, k1, k2; `sd` (5,) are theirs."""
    focal, *others = sd * random_stream(seed, purpose).standard_normal(5)
    focal_px = _TRUE_CAMERA.fx + float(focal)
    moved = {
        name: getattr(_TRUE_CAMERA, name) + float(step)
        for name, step in zip(FREE_PARAMETERS[1:], others, strict=True)
    }
    return replace(_TRUE_CAMERA, fx=focal_px, fy=focal_px, **moved)


def _camera_states(
    settings: BlockSettings, times_s: FloatArray, rng: np.random.Generator
) -> tuple[CameraState, ...]:
    """Return the states of the camera: above the vehicle, with offsets of some metres that vary."""
    n = len(times_s)
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    far_m, aside_m = settings.wander_m
    along_m = settings.speed_m_s * times_s + far_m * np.sin(times_s / 6.0 + phase[0])
    along_m += 0.3 * far_m * rng.standard_normal(n)
    across_m = aside_m * (np.sin(times_s / 8.5 + phase[1]) + 0.3 * rng.standard_normal(n))
    road_m = ground_m(settings, along_m, np.zeros(n))
    up_m = road_m + settings.height_m + settings.sd_height_m * rng.standard_normal(n)
    centres = on_corridor(settings, along_m, across_m, up_m)
    sd_deg = np.array([settings.sd_tilt_deg, settings.sd_tilt_deg, settings.sd_heading_deg])
    turns = Rotation.from_rotvec(sd_deg * rng.standard_normal((n, 3)), degrees=True).as_matrix()
    angles = along_m / settings.bend_radius_m
    return tuple(
        CameraState(turn @ _facing_down(angle), centre)
        for turn, angle, centre in zip(turns, angles, centres, strict=True)
    )


def _facing_down(angle: float) -> FloatArray:
    """Return ENU ← camera of a camera that looks down with the top of its image forward."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]])


def _image_points_of(
    settings: BlockSettings, views: tuple[CameraState, ...], rng: np.random.Generator
) -> ImagePoints:
    points = _lay_points(settings, rng)
    seen, pixels = project_all(_TRUE_CAMERA, views, points)
    special = settings.checks + 2
    measured = rng.random(seen.shape) < settings.seen_share
    measured[:, :special] = True
    seen = seen & measured
    kept = seen.sum(axis=0) >= 3
    if not kept[:special].all():
        raise ValueError("a check point or GCP is seen in fewer than three frames")
    frame, point = np.nonzero(seen[:, kept])
    sd_px = np.where(point < special, settings.sd_mark_px, settings.sd_tie_px)
    noise = sd_px[:, None] * rng.standard_normal((len(frame), 2))
    return ImagePoints(
        points[kept], settings.checks, 2, frame, point, pixels[:, kept][frame, point] + noise
    )


def _lay_points(settings: BlockSettings, rng: np.random.Generator) -> FloatArray:
    length_m, ties = settings.length_m, settings.tie_points
    side = np.where(np.arange(settings.checks) % 2, 1.0, -1.0)
    along_m = np.concatenate(
        (
            settings.checks_along_m,
            [FROM_END_M, length_m - FROM_END_M],
            rng.uniform(-_BEYOND_ENDS_M, length_m + _BEYOND_ENDS_M, ties),
        )
    )
    across_m = np.concatenate(
        (
            side * rng.uniform(0.0, _CHECK_ACROSS_M, settings.checks),
            [_GCP_ACROSS_M, -_GCP_ACROSS_M],
            rng.uniform(-_STRIP_HALF_WIDTH_M, _STRIP_HALF_WIDTH_M, ties),
        )
    )
    up_m = ground_m(settings, along_m, across_m)
    up_m[-ties:] += rng.uniform(0.0, settings.relief_m, ties)
    return on_corridor(settings, along_m, across_m, up_m)


def project_all(
    camera: Camera, views: tuple[CameraState, ...], points_enu_m: FloatArray
) -> tuple[npt.NDArray[np.bool_], FloatArray]:
    """Return which of n views see which of m points (n, m), and their images (n, m, 2) [px]."""
    pixels = np.array(
        [
            camera.project((points_enu_m - view.position_enu_m) @ view.enu_from_camera)
            for view in views
        ]
    )
    near = np.array(
        [np.linalg.norm((points_enu_m - view.position_enu_m)[:, :2], axis=1) for view in views]
    )
    limits = np.array([camera.width - 1.0, camera.height - 1.0])
    inside = np.all((pixels >= 0.0) & (pixels <= limits), axis=2)
    return inside & (
        near < 60.0
    ), pixels  # farther out, the distortion would fold points back into the frame
