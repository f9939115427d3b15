"""Where plain targets must be in frames whose exterior orientation is known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations, visible_pixel
from kgcp.georef.target_positions import TargetPositions
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.targets.plain import PlainTarget

_FLOOR_PX, _FLOOR_LOG = 1.0, 0.002  # least standard deviations, whatever is stated
# Of poses that state none: those of a block that was adjusted are better, those of a navigation
# receiver alone much worse, and are not enough to look for plain targets.
_UNSTATED_PX, _UNSTATED_LOG = 5.0, 0.01
_SOURCE = "the reference"

Predictions = Mapping[str, PlainPrediction]
"""By the target's name."""


def predict_plain(
    frames: Sequence[str],
    targets: Sequence[PlainTarget],
    poses: ReferencePoses,
    positions: TargetPositions,
    camera: Camera,
) -> list[Predictions]:
    """Return for each frame where its plain targets must be; nothing of frames without a pose.

    The deviations follow from those of the pose and of the target's position.
    """
    rows = {frame: row for row, frame in enumerate(poses.frames)}
    orientations = ExteriorOrientations.of(poses, positions.local_frame)
    predictions: list[Predictions] = []
    for frame in frames:
        row = rows.get(frame)
        if row is None:
            predictions.append({})
            continue
        made = {
            target.name: _predicted(target, row, poses, orientations, positions, camera)
            for target in targets
        }
        predictions.append({name: one for name, one in made.items() if one is not None})
    return predictions


def _predicted(
    target: PlainTarget,
    row: int,
    poses: ReferencePoses,
    orientations: ExteriorOrientations,
    positions: TargetPositions,
    camera: Camera,
) -> PlainPrediction | None:
    """Return one prediction; None where the target is behind the camera."""
    place = positions.static[target.name]
    enu_from_camera = orientations.enu_from_camera[row]
    sight_m = (place.position_m - orientations.centre_m[row]) @ enu_from_camera
    centre_px = visible_pixel(camera, sight_m)
    if not np.isfinite(centre_px).all():
        return None
    level = positions.local_frame.level_rotations(place.position_m[None])[0]
    into_plate = -(level @ np.array(target.normal_enu)) @ enu_from_camera
    sd_angle_deg = 0.0 if poses.sd_angle_deg is None else float(poses.sd_angle_deg[row])
    distance_m = float(np.linalg.norm(sight_m))
    cov_m2 = np.zeros((3, 3)) if place.cov_m2 is None else place.cov_m2
    floor_px, floor_log = _UNSTATED_PX, _UNSTATED_LOG
    if orientations.cov_m2 is not None:
        floor_px, floor_log = _FLOOR_PX, _FLOOR_LOG
        cov_m2 = cov_m2 + orientations.cov_m2[row]
    cov_m2 = enu_from_camera.T @ cov_m2 @ enu_from_camera
    turned_m = math.radians(sd_angle_deg) * distance_m
    along = sight_m / distance_m
    across_m2 = cov_m2 + turned_m**2 * (np.eye(3) - np.outer(along, along))
    by_place = _pixel_slopes(camera, sight_m)
    return PlainPrediction(
        centre_px=centre_px,
        cov_px2=by_place @ across_m2 @ by_place.T + floor_px**2 * np.eye(2),
        position_m=sight_m,
        sd_log_distance=math.hypot(
            math.sqrt(float(along @ cov_m2 @ along)) / distance_m, floor_log
        ),
        normal=NormalPrior(into_plate, math.hypot(target.sd_normal_deg, sd_angle_deg)),
        radius_px=target.radii_m[0] * camera.mean_focal_px / distance_m,
        source=_SOURCE,
    )


def _pixel_slopes(camera: Camera, point_m: FloatArray) -> FloatArray:
    """Return the derivatives (2, 3) of a point's pixel by its place in the camera frame."""
    x, y, z = point_m.tolist()
    projection = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
    return np.asarray(camera.distort_jacobian(np.array([[x / z, y / z]]))[0] @ projection)
