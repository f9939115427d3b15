"""Where plain targets must be in frames whose exterior orientation is known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, cross_matrix
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations, visible_pixel
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.target_positions import TargetPositions
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.targets.plain import PlainTarget

_FLOOR_PX, _FLOOR_LOG = 1.0, 0.002  # least standard deviations, whatever is stated
# Of poses that do not state both: those of a block that was adjusted are better, those of a
# navigation receiver alone much worse, and are not enough to look for plain targets.
_UNSTATED_PX, _UNSTATED_LOG = 5.0, 0.01

# Of what is marked: how far a camera that looks down does not, and distances from marks.
_DOWN_SD_DEG, _MARKED_LOG = 10.0, 0.08
_LEVEL = 0.95  # upward component of a normal that counts as level

Predictions = Mapping[str, PlainPrediction]
"""By the target's name."""


@dataclass(frozen=True, slots=True)
class MarkedPlace:
    """Where somebody has marked a target in a frame."""

    x_px: float
    y_px: float
    sd_px: float  # standard deviation of either coordinate [px]


@dataclass(frozen=True, slots=True, eq=False)
class FrameOrientation:
    """The exterior orientation of one frame, as far as predictions need it."""

    centre_m: FloatArray  # (3,): projection centre in the ENU frame [m]
    enu_from_camera: FloatArray  # (3, 3): camera axes in the ENU frame, as columns
    # (6, 6): of centre [m] and left rotation vector [rad], ENU axes; None: not stated
    cov: FloatArray | None
    source: str  # who says so, in few words

    @property
    def sd_angle_deg(self) -> float:
        """Standard deviation of an angle, as the root of the three's mean square [deg]."""
        if self.cov is None:
            return 0.0
        return math.degrees(math.sqrt(float(np.trace(self.cov[3:, 3:])) / 3.0))


def reference_orientations(
    poses: ReferencePoses, local_frame: LocalFrame
) -> dict[str, FrameOrientation]:
    """Return reference poses by their frames."""
    orientations = ExteriorOrientations.of(poses, local_frame)
    made = {}
    for row, frame in enumerate(poses.frames):
        cov = None
        if orientations.cov_m2 is not None and poses.sd_angle_deg is not None:
            turn = math.radians(float(poses.sd_angle_deg[row])) ** 2 * np.eye(3)
            zero = np.zeros((3, 3))
            cov = np.block([[orientations.cov_m2[row], zero], [zero, turn]])
        made[frame] = FrameOrientation(
            orientations.centre_m[row], orientations.enu_from_camera[row], cov, "the reference"
        )
    return made


def predict_plain(
    targets: Sequence[PlainTarget],
    orientation: FrameOrientation,
    positions: TargetPositions,
    camera: Camera,
) -> Predictions:
    """Return where a frame's plain targets must be, but for those behind the camera.

    The deviations follow from those of the frame's orientation and of the target's position.
    """
    made = {target.name: _predicted(target, orientation, positions, camera) for target in targets}
    return {name: prediction for name, prediction in made.items() if prediction is not None}


def _predicted(
    target: PlainTarget,
    orientation: FrameOrientation,
    positions: TargetPositions,
    camera: Camera,
) -> PlainPrediction | None:
    """Return where a target must be; None: not before the camera."""
    place = positions.static[target.name]
    camera_from_enu = orientation.enu_from_camera.T
    from_centre_m = place.position_m - orientation.centre_m
    sight_m = camera_from_enu @ from_centre_m
    centre_px = visible_pixel(camera, sight_m)
    if not np.isfinite(centre_px).all():
        return None
    cov_m2 = np.zeros((3, 3)) if place.cov_m2 is None else place.cov_m2
    floor_px, floor_log = _UNSTATED_PX, _UNSTATED_LOG
    if orientation.cov is not None:
        floor_px, floor_log = _FLOOR_PX, _FLOOR_LOG
        # with p = Rᵀ (X − C), errors of C and of a left turn α give Rᵀ (−δC + (X − C) × α)
        by_pose = np.hstack((-np.eye(3), cross_matrix(from_centre_m)))
        cov_m2 = cov_m2 + by_pose @ orientation.cov @ by_pose.T
    cov_m2 = camera_from_enu @ cov_m2 @ camera_from_enu.T
    distance_m = float(np.linalg.norm(sight_m))
    along, by_place = sight_m / distance_m, _pixel_slopes(camera, sight_m)
    # a rolling shutter's camera moves until the row is exposed
    delay_s = float(camera.delay_s(centre_px[None])[0])
    turn_px = math.radians(camera.motion_sd_deg_s) * delay_s * camera.mean_focal_px
    sd_along = math.sqrt(max(0.0, float(along @ cov_m2 @ along))) / distance_m
    return PlainPrediction(
        centre_px=centre_px,
        cov_px2=by_place @ cov_m2 @ by_place.T + (floor_px**2 + turn_px**2) * np.eye(2),
        position_m=sight_m,
        sd_log_distance=math.hypot(sd_along, floor_log),
        normal=_stated_normal(target, place.position_m, orientation, positions.local_frame),
        radius_px=target.radii_m[0] * camera.mean_focal_px / distance_m,
        source=orientation.source,
    )


def _stated_normal(
    target: PlainTarget,
    position_m: FloatArray,
    orientation: FrameOrientation,
    local_frame: LocalFrame,
) -> NormalPrior | None:
    """Return how a target lies in the camera frame, as flight.toml says; None: it does not."""
    if target.normal_enu is None:
        return None
    level = local_frame.level_rotations(position_m[None])[0]
    return NormalPrior(
        -orientation.enu_from_camera.T @ level @ np.array(target.normal_enu),
        math.hypot(target.sd_normal_deg, orientation.sd_angle_deg),
    )


def predict_marked(
    targets: Sequence[PlainTarget],
    places: Mapping[str, MarkedPlace],
    positions: TargetPositions,
    camera: Camera,
) -> Predictions:
    """Return where plain targets must be that are marked in a frame that looks down.

    Those that lie level, or whose normal is not known.

    How far they are, the distances of all marks tell: two at least. That it looks down is good to
    some degrees, and so are these.

    Parameters
    ----------
    places : mapping
        Of static targets, by their names.
    """
    depth_m = _depth_of_marks(places, positions, camera)
    if depth_m is None:
        return {}
    predictions = {}
    for target in targets:
        place = places.get(target.name)
        is_free = target.normal_enu is None
        if place is None or (target.normal_enu is not None and target.normal_enu[2] < _LEVEL):
            continue
        centre_px = np.array([place.x_px, place.y_px])
        position_m = depth_m * np.append(camera.undistort(centre_px[None])[0], 1.0)
        predictions[target.name] = PlainPrediction(
            centre_px=centre_px,
            cov_px2=place.sd_px**2 * np.eye(2),
            position_m=position_m,
            sd_log_distance=_MARKED_LOG,
            normal=None if is_free else NormalPrior(np.array([0.0, 0.0, 1.0]), _DOWN_SD_DEG),
            radius_px=target.radii_m[0] * camera.mean_focal_px / float(np.linalg.norm(position_m)),
            source="a mark",
        )
    return predictions


def _depth_of_marks(
    places: Mapping[str, MarkedPlace], positions: TargetPositions, camera: Camera
) -> float | None:
    """Return how far marked targets are along the camera's axis [m]; None: too few are marked."""
    if len(places) < 2:
        return None
    pixels = np.array([(place.x_px, place.y_px) for place in places.values()])
    plane = camera.undistort(pixels)
    on_ground = np.array([positions.static[name].position_m[:2] for name in places])
    first, second = np.triu_indices(len(places), 1)
    apart_m = np.linalg.norm(on_ground[first] - on_ground[second], axis=1)
    apart = np.linalg.norm(plane[first] - plane[second], axis=1)
    usable = (apart > 0.0) & (apart_m > 0.0)
    return float(np.median(apart_m[usable] / apart[usable])) if usable.any() else None


def _pixel_slopes(camera: Camera, point_m: FloatArray) -> FloatArray:
    """Return the derivatives (2, 3) of a point's pixel by its place in the camera frame."""
    x, y, z = point_m.tolist()
    projection = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
    return np.asarray(camera.distort_jacobian(np.array([[x / z, y / z]]))[0] @ projection)
