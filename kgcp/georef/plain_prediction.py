"""Prediction of static targets in frames with known exterior orientation or with marks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, cross_matrix, place_covariances
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.georef.exterior_orientation import ExteriorOrientations, visible_pixel
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.target_positions import TargetPositions
from kgcp.measurement.plain_prediction import PlainPrediction, PredictedPlace
from kgcp.measurement.plate_prior import NormalPrior, SceneRotation
from kgcp.targets.plain import AnyTarget, PlainTarget

# Least standard deviations of a centre and of the logarithm of a distance, whatever is stated.
_MIN_SD_PX, _MIN_SD_LOG = 1.0, 0.002
# The same for poses that do not state both of their standard deviations. Poses of an adjusted block
# are better. Those of a navigation receiver are much worse, too bad to search for plain targets.
_UNSTATED_SD_PX, _UNSTATED_SD_LOG = 5.0, 0.01

# Standard deviations of predictions from marks: of the optical axis from the vertical in a frame
# that looks down, and of the logarithm of a distance.
_DOWN_SD_DEG, _MARKED_SD_LOG = 10.0, 0.08
_MIN_LEVEL_UP = 0.95  # least upward component of the normal of a level target
_ROW_STEPS = 3  # a target's row depends on the motion until that row, by some per cent

Predictions = Mapping[str, PlainPrediction]
"""Predictions by the target's name."""

Rotations = Mapping[str, SceneRotation]
"""How the scene turns while a rolling shutter reads a frame, by the target's name."""


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
    # (6, 6): covariance of centre [m] and left rotation vector [rad], ENU axes; None: not stated
    cov: FloatArray | None
    source: str  # where it comes from, in few words

    @property
    def sd_angle_deg(self) -> float:
        """Standard deviation of the attitude, the RMS of those about the three axes [deg]."""
        if self.cov is None:
            return 0.0
        return math.degrees(math.sqrt(float(np.trace(self.cov[3:, 3:])) / 3.0))


def reference_orientations(
    poses: ReferencePoses, local_frame: LocalFrame
) -> dict[str, FrameOrientation]:
    """Return reference poses by frame."""
    orientations = ExteriorOrientations.of(poses, local_frame)
    by_frame = {}
    covs = orientations.cov if orientations.states_all else None
    for row, frame in enumerate(poses.frames):
        cov = None if covs is None else covs[row]
        by_frame[frame] = FrameOrientation(
            orientations.centre_m[row], orientations.enu_from_camera[row], cov, "the reference"
        )
    return by_frame


def predict_plain(
    targets: Sequence[PlainTarget],
    orientation: FrameOrientation,
    positions: TargetPositions,
    camera: Camera,
    rotations: Rotations,
) -> Predictions:
    """Predict plain targets in a frame.

    The standard deviations follow from those of the frame's orientation and of the target's
    position, and with a rolling shutter from that of the motion until the target's row.

    Parameters
    ----------
    rotations : mapping
        The known ones.
    """
    sights = _sights(targets, orientation, positions, camera, rotations)
    return {
        target.name: _predicted(target, sights[target.name], orientation, positions)
        for target in targets
    }


def _predicted(
    target: PlainTarget,
    sight: _Sight,
    orientation: FrameOrientation,
    positions: TargetPositions,
) -> PlainPrediction:
    distance_m = float(np.linalg.norm(sight.position_m))
    ray = sight.position_m / distance_m
    sd_log_distance = math.sqrt(max(0.0, float(ray @ sight.cov_m2 @ ray))) / distance_m
    min_sd_log = _UNSTATED_SD_LOG if orientation.cov is None else _MIN_SD_LOG
    place_m = positions.static[target.name].position_m
    return PlainPrediction(
        centre_px=sight.place.centre_px,
        cov_px2=sight.place.cov_px2,
        position_m=sight.position_m,
        sd_log_distance=math.hypot(sd_log_distance, min_sd_log),
        normal=_stated_normal(target, place_m, orientation, positions.local_frame),
        radius_px=sight.place.radius_px,
        source=orientation.source,
    )


def predict_places(
    targets: Sequence[AnyTarget],
    orientation: FrameOrientation,
    positions: TargetPositions,
    camera: Camera,
    rotations: Rotations,
) -> dict[str, PredictedPlace]:
    """Predict the places of static targets, as `predict_plain`."""
    sights = _sights(targets, orientation, positions, camera, rotations)
    return {name: sight.place for name, sight in sights.items()}


def _sights(
    targets: Sequence[AnyTarget],
    orientation: FrameOrientation,
    positions: TargetPositions,
    camera: Camera,
    rotations: Rotations,
) -> dict[str, _Sight]:
    unknown = SceneRotation.unknown(camera)
    return {
        each.name: _Sight.of(
            each, orientation, positions, camera, rotations.get(each.name, unknown)
        )
        for each in targets
    }


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """A static target as an oriented camera sees it."""

    position_m: FloatArray  # (3,): its centre in the camera frame [m]
    cov_m2: FloatArray  # (3, 3): its covariance in the camera frame [m²]
    place: PredictedPlace

    @classmethod
    def of(
        cls,
        target: AnyTarget,
        orientation: FrameOrientation,
        positions: TargetPositions,
        camera: Camera,
        rotation: SceneRotation,
    ) -> Self:
        """Return it at the moment of its row."""
        static = positions.static[target.name]
        camera_from_enu = orientation.enu_from_camera.T
        from_centre_m = static.position_m - orientation.centre_m
        sight_m = camera_from_enu @ from_centre_m
        centre_px = visible_pixel(camera, sight_m)
        cov_m2 = np.zeros((3, 3)) if static.cov_m2 is None else static.cov_m2
        min_sd_px = _UNSTATED_SD_PX
        if orientation.cov is not None:
            min_sd_px = _MIN_SD_PX
            cov_m2 = cov_m2 + place_covariances(orientation.cov, from_centre_m)
        cov_m2 = camera_from_enu @ cov_m2 @ camera_from_enu.T
        if camera.readout_s and np.isfinite(centre_px).all():
            # the scene turns until the target's row is exposed
            velocity, middle_m, delay_s = np.array(rotation.velocity_rad_s), sight_m, 0.0
            for _ in range(_ROW_STEPS):
                delay_s = float(camera.delay_s(centre_px[None])[0])
                sight_m = rotation_about(delay_s * velocity) @ middle_m
                centre_px = visible_pixel(camera, sight_m)
                if not np.isfinite(centre_px).all():
                    break
            by_turn = delay_s * rotation.sd_rad_s * cross_matrix(sight_m)
            cov_m2 = cov_m2 + by_turn @ by_turn.T
        px_per_m = camera.mean_focal_px / float(np.linalg.norm(sight_m))
        if np.isfinite(centre_px).all():
            by_position = _pixel_by_position(camera, sight_m)
            cov_px2 = by_position @ cov_m2 @ by_position.T
        else:
            cov_px2 = px_per_m**2 * float(np.linalg.eigvalsh(cov_m2)[-1]) * np.eye(2)
        place = PredictedPlace(
            centre_px,
            cov_px2 + min_sd_px**2 * np.eye(2),
            0.5 * target.outer_diameter_m * px_per_m,
        )
        return cls(sight_m, cov_m2, place)


def _stated_normal(
    target: PlainTarget,
    position_m: FloatArray,
    orientation: FrameOrientation,
    local_frame: LocalFrame,
) -> NormalPrior | None:
    """Return a target's normal by flight.toml, in the camera frame; None if it is not stated."""
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
    """Predict plain targets from marks in a frame that looks down.

    Only targets that lie level, or whose normal is unknown, are predicted. The distance follows
    from the distances between all marks, of which there must be two or more. The assumption that
    the camera looks down holds to some degrees, and limits the accuracy.

    Parameters
    ----------
    places : mapping
        Marks of static targets, by their names.
    """
    depth_m = _depth_of_marks(places, positions, camera)
    if depth_m is None:
        return {}
    predictions = {}
    for target in targets:
        place = places.get(target.name)
        is_unknown = target.normal_enu is None
        if place is None or (
            target.normal_enu is not None and target.normal_enu[2] < _MIN_LEVEL_UP
        ):
            continue
        centre_px = np.array([place.x_px, place.y_px])
        position_m = depth_m * np.append(camera.undistort(centre_px[None])[0], 1.0)
        predictions[target.name] = PlainPrediction(
            centre_px=centre_px,
            cov_px2=place.sd_px**2 * np.eye(2),
            position_m=position_m,
            sd_log_distance=_MARKED_SD_LOG,
            normal=None if is_unknown else NormalPrior(np.array([0.0, 0.0, 1.0]), _DOWN_SD_DEG),
            radius_px=target.radii_m[0] * camera.mean_focal_px / float(np.linalg.norm(position_m)),
            source="a mark",
        )
    return predictions


def _depth_of_marks(
    places: Mapping[str, MarkedPlace], positions: TargetPositions, camera: Camera
) -> float | None:
    """Return the depth of marked targets along the optical axis [m]; None: too few are marked."""
    if len(places) < 2:
        return None
    pixels = np.array([(place.x_px, place.y_px) for place in places.values()])
    normalised = camera.undistort(pixels)
    on_ground = np.array([positions.static[name].position_m[:2] for name in places])
    first, second = np.triu_indices(len(places), 1)
    apart_m = np.linalg.norm(on_ground[first] - on_ground[second], axis=1)
    apart = np.linalg.norm(normalised[first] - normalised[second], axis=1)
    usable = (apart > 0.0) & (apart_m > 0.0)
    return float(np.median(apart_m[usable] / apart[usable])) if usable.any() else None


def _pixel_by_position(camera: Camera, point_m: FloatArray) -> FloatArray:
    """Return the derivatives (2, 3) of a point's pixel by its position in the camera frame."""
    x, y, z = point_m.tolist()
    projection = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
    return np.asarray(camera.distort_jacobian(np.array([[x / z, y / z]]))[0] @ projection)
