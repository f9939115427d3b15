"""KGCPs of a simulated block: kgcp measures rendered frames and computes the points."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from benchmarks.aat.block import Block
from benchmarks.aat.settings import CRS, FREE_PARAMETERS, map_frame, random_stream
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.gcp import Gcp, build_gcps
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.measurement.records import Measurement
from kgcp.measurement.systematic_errors import common_uncertainty, pose_by_calibration
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.ground import Ground
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.scene import PlatePose, SimulatedScene, render_irradiance
from kgcp.targets.layout import Ring, Target

_WINDOW_PX = np.array([480, 640])  # the rendered part of a frame, around the target
_SENSOR = Sensor()
_STREAK_PX = (0.0, 0.35)  # 7 m/s, 1/1200 s, 17 mm per pixel
_DOWN = np.diag([1.0, -1.0, -1.0])  # axes of the ground's plane: x east, y south, z down


@dataclass(frozen=True, slots=True, eq=False)
class KgcpSet:
    """Observations of n KGCPs for an adjustment.

    Attributes
    ----------
    frame : (n,) array
        Index of the frame that sees the point.
    position_enu_m : (n, 3) array
        Coordinates of the points, in the frame of the block [m].
    cov_m2 : (3 n, 3 n) array
        Joint covariance, with the correlations of docs/tables.md.
    pixels : (n, 2) array
        Image points [px].
    pixel_cov_px2 : (n, 2, 2) array
        Covariances of the image points.
    distance_m, sd_distance_m : (n,) arrays
        Distances from camera to target, by the calibration that kgcp was given [m].
    by_calibration : (n, 5) array
        Derivatives of `distance_m` by f (= fx = fy), cx, cy, k1, k2 of that calibration.
    sd_common : float
        Relative standard deviation of an error that all distances share: the size of the print.
    """

    frame: IndexArray
    position_enu_m: FloatArray
    cov_m2: FloatArray
    pixels: FloatArray
    pixel_cov_px2: FloatArray
    distance_m: FloatArray
    sd_distance_m: FloatArray
    by_calibration: FloatArray
    sd_common: float


def kgcps_of(block: Block, keep: Path | None) -> KgcpSet:
    """Return the block's KGCPs; take them from the folder `keep` if it has them."""
    if keep is None:
        return measure_kgcps(block)
    key = hashlib.sha256(repr(block.settings).encode()).hexdigest()[:10]
    path = keep / f"kgcps_{key}_{block.seed}.npz"
    if not path.is_file():
        found = measure_kgcps(block)
        keep.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}")
        np.savez(partial, **{field.name: getattr(found, field.name) for field in fields(found)})
        partial.replace(path)
    with np.load(path) as stored:
        values = {name: stored[name] for name in stored.files}
    return KgcpSet(**values | {"sd_common": float(values["sd_common"])})


def measure_kgcps(block: Block) -> KgcpSet:
    """Render and measure the target of every frame, and compute the points by kgcp."""
    target = nominal_target(block.settings.sd_diameter_m)
    ground = Ground.grown(random_stream(block.seed, "ground"), block.settings.bend_radius_m)
    seen = [_measure(block, ground, target, index) for index in range(len(block.views))]
    found = [(index, one) for index, one in enumerate(seen) if one is not None]
    sightings = [_sighting(block, index, one) for index, one in found]
    target_positions = TargetPositions.of(
        CRS, (target,), block.ride.trajectory, block.ride.settings
    )
    points, _ = build_gcps(sightings, target_positions, block.believed)
    slopes = [distance_by_calibration(block.believed, one.pose) for _, one in found]
    return _assembled(points, np.array(slopes), block.ride.settings.correlation_s)


def nominal_target(sd_diameter_m: float, scale: float = 1.0) -> Target:
    """Return the target with its nominal size, or with all lengths times `scale`."""
    ring = _resized(TARGET_PLATE.target.ring, scale)
    replicas = tuple(_resized(replica, scale) for replica in TARGET_PLATE.target.replicas)
    return Target(replace(ring, sd_outer_diameter_m=sd_diameter_m), replicas)


def _resized(ring: Ring, scale: float) -> Ring:
    return replace(
        ring,
        outer_diameter_m=scale * ring.outer_diameter_m,
        inner_diameter_m=scale * ring.inner_diameter_m,
        code_diameter_m=scale * ring.code_diameter_m,
        dot_diameter_m=scale * ring.dot_diameter_m,
    )


def window_of(camera: Camera, first_px: FloatArray) -> Camera:
    """Return the camera of a window whose first pixel is the pixel (2,) of the frame."""
    width, height = map(int, _WINDOW_PX)
    x, y = map(float, first_px)
    return replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - y)


def render_window(block: Block, ground: Ground, index: int) -> tuple[GreyArray, FloatArray]:
    """Render the window of one frame around the target.

    Returns
    -------
    grey : (height, width) array
    first_px : (2,) array
        First pixel of the window, in the frame.
    """
    ride, view = block.ride, block.views[index]
    rng = random_stream(block.seed, "pixels", index)
    pose = view.pose_of(ride.enu_from_plate[index], ride.target_enu_m[index])
    centre_px = block.camera.project(pose.translation_m[None])[0]
    first_px = np.rint(centre_px - 0.5 * _WINDOW_PX + rng.uniform(-40.0, 40.0, 2))
    principal_px = np.array([block.camera.cx, block.camera.cy])
    # a principal point may be at most half a frame outside; 20 px of margin for the believed one
    first_px = np.clip(
        first_px,
        np.ceil(principal_px - 1.5 * _WINDOW_PX) + 20.0,
        np.floor(principal_px + 0.5 * _WINDOW_PX) - 20.0,
    )
    plate = replace(TARGET_PLATE, target=nominal_target(0.0, ride.plate_scale))
    plane = view.pose_of(_DOWN, np.array([0.0, 0.0, ride.road_m[index]]))
    optics = Optics(float(rng.uniform(0.55, 0.75)), _STREAK_PX)
    scene = SimulatedScene(plane, PlatePose(plate, pose), ())
    window = window_of(block.camera, first_px)
    irradiance = render_irradiance(window, ground, scene, optics, rng)
    return _SENSOR.expose(irradiance, float(rng.uniform(0.7, 1.0)), rng), first_px


def distance_by_calibration(camera: Camera, pose: Pose) -> FloatArray:
    """Return the derivatives (5,) of a measured distance by `FREE_PARAMETERS` [m per unit].

    A distance is proportional to the focal length, for the same image of the target. An adjustment
    that changes the focal length must change the distances as well.
    """
    radius_m = 0.5 * TARGET_PLATE.target.ring.outer_diameter_m
    slopes = pose.translation_m / pose.distance_m @ pose_by_calibration(camera, radius_m, pose)[:3]
    by = dict(zip(CALIBRATION_PARAMETERS, slopes, strict=True))
    by["f"] = by["fx"] + by["fy"]
    return np.array([by[name] for name in FREE_PARAMETERS])


def _measure(block: Block, ground: Ground, target: Target, index: int) -> Measurement | None:
    """Return kgcp's measurement of the target, with its image point in the whole frame."""
    grey, first_px = render_window(block, ground, index)
    believed = window_of(block.believed, first_px)
    outcome = measure_frame(grey, believed, (target,), DetectSettings())[0]
    if not isinstance(outcome, Measurement):
        return None
    common = common_uncertainty(believed, None, target.ring, outcome.pose)
    return replace(outcome, centre_px=outcome.centre_px + first_px, common=common)


def _sighting(block: Block, index: int, seen: Measurement) -> Sighting:
    uncertainty, common = seen.uncertainty, seen.common
    return Sighting(
        frame=f"{index:04d}",
        number=index + 1,
        target=seen.target,
        instance=seen.instance,
        time_s=float(block.ride.frame_times_s[index]),
        centre_px=seen.centre_px,
        centre_cov_px2=None if uncertainty is None else uncertainty.centre_cov_px2,
        distance_m=seen.pose.distance_m,
        sd_distance_m=None if uncertainty is None else uncertainty.sd_distance_m,
        sd_common_distance_m=None if common is None else common.sd_distance_m,
        pose=seen.pose,
        score=seen.score,
    )


def _assembled(points: Sequence[Gcp], slopes: FloatArray, correlation_s: float) -> KgcpSet:
    """Transform the points from the map to the block's frame, with their correlations."""
    local_frame = map_frame()
    position = local_frame.enu_from_map(np.array([point.position_map for point in points]))
    axes = local_frame.grid_rotation(position)
    times_s = np.array([point.time_s for point in points])
    cov = axes @ np.array([point.cov_m2 for point in points]) @ np.swapaxes(axes, 1, 2)
    common = axes @ np.array([point.common_m for point in points])
    relative = [(point.sd_common_distance_m or 0.0) / point.distance_m for point in points]
    return KgcpSet(
        frame=np.array([int(point.frame) for point in points]),
        position_enu_m=position,
        cov_m2=joint_covariance(times_s, cov, common, correlation_s),
        pixels=np.array([point.centre_px for point in points]),
        pixel_cov_px2=np.array([point.centre_cov_px2 for point in points]),
        distance_m=np.array([point.distance_m for point in points]),
        sd_distance_m=np.array([point.sd_distance_m for point in points], dtype=np.float64),
        by_calibration=slopes,
        sd_common=float(np.mean(relative)),
    )


def joint_covariance(
    times_s: FloatArray, cov_m2: FloatArray, common_m: FloatArray, correlation_s: float
) -> FloatArray:
    """Return the covariance (3 n, 3 n) of all points, as docs/tables.md describes it.

    Between the points i and j it is C_i C_jᵀ + a L_i L_jᵀ, where C are the common effects,
    L Lᵀ = cov − C Cᵀ, and a = exp(−|Δt| / correlation_s).
    """
    fades = np.linalg.cholesky(cov_m2 - common_m @ np.swapaxes(common_m, 1, 2))
    fading = np.exp(-np.abs(times_s[:, None] - times_s) / correlation_s)
    whole = np.einsum("iak,jbk,ij->iajb", fades, fades, fading)
    whole += np.einsum("iak,jbk->iajb", common_m, common_m)
    joint: FloatArray = whole.reshape(2 * (3 * len(times_s),))
    return joint
