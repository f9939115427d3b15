"""Poses of a target in the camera frame, and the angles that the paper and the tables report."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled, interpreted
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera

# Sine of the angle between normal and viewing ray below which a view counts as frontal: both poses
# coincide then.
_FRONTAL_SINE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose of the target in the camera frame: p_camera = rotation @ p_target + translation_m.

    Attributes
    ----------
    rotation : (3, 3) array
        Target axes in the camera frame, as columns; the third is the plate's normal.
    translation_m : (3,) array
        Target centre in the camera frame [m].
    """

    rotation: FloatArray
    translation_m: FloatArray

    @property
    def distance_m(self) -> float:
        """Distance between the camera's projection centre and the target's centre [m]."""
        return float(np.linalg.norm(self.translation_m))

    @property
    def normal(self) -> FloatArray:
        """Unit normal (3,) of the plate in the camera frame, pointing into the plate."""
        return self.rotation[:, 2]

    @property
    def quaternion_wxyz(self) -> FloatArray:
        """Unit quaternion (4,) of the rotation, w first and not negative."""
        from scipy.spatial.transform import Rotation  # 0.2 s that workers do not need

        return np.asarray(
            Rotation.from_matrix(self.rotation).as_quat(canonical=True, scalar_first=True)
        )

    @property
    def matrix(self) -> FloatArray:
        """Rotation and translation side by side (3, 4)."""
        matrix = np.empty((3, 4))
        matrix[:, :3], matrix[:, 3] = self.rotation, self.translation_m
        return matrix

    def transform(self, points_target: FloatArray) -> FloatArray:
        """Bring points (n, 3) or (n, 2) on the plate [m] into the camera frame (n, 3) [m]."""
        columns = points_target.shape[-1]
        return points_target @ self.rotation[:, :columns].T + self.translation_m

    def turned(self, angle_deg: float) -> Pose:
        """Return the pose after turning the target about its own z axis, from +x towards +y."""
        turn = rotation_about(np.array([0.0, 0.0, math.radians(angle_deg)]))
        return Pose(self.rotation @ turn, self.translation_m)

    def moved(self, step: FloatArray) -> Pose:
        """Return the pose after a step (6,): translation [m], rotation vector [rad].

        Both are in the camera frame; the rotation is applied from the left.
        """
        turn = rotation_about_once(step[3:6])
        return Pose(turn @ self.rotation, self.translation_m + step[:3])

    def mirrored(self) -> Pose:
        """Return the pose with the plate's normal mirrored about the viewing ray of its centre.

        It is reached by the smallest possible rotation: about the axis perpendicular to normal and
        ray, by twice the angle between them.
        """
        (a, b, c), (x, y, z) = self.normal.tolist(), self.translation_m.tolist()
        axis = np.array([b * z - c * y, c * x - a * z, a * y - b * x])
        sine, cosine = math.hypot(*axis), a * x + b * y + c * z
        if sine < _FRONTAL_SINE * self.distance_m:
            return self
        turn = rotation_about(axis / sine * 2.0 * math.atan2(sine, cosine))
        return Pose(turn @ self.rotation, self.translation_m)

    def tilted(self, min_tilt_rad: float) -> Pose:
        """Return the pose with a tilt against the centre's viewing ray of at least this angle.

        The direction of the tilt is kept; a frontal pose is tilted in an arbitrary direction.
        """
        axis, tilt_rad = self._tilt()
        turn = rotation_about(max(0.0, min_tilt_rad - tilt_rad) * axis)
        return Pose(turn @ self.rotation, self.translation_m)

    def tilted_across(self, angle_rad: float) -> Pose:
        """Return the pose tilted by an angle perpendicular to the present direction of the tilt.

        The angle is that between the new normal and the centre's viewing ray.
        """
        axis, tilt_rad = self._tilt()
        across = np.cross(self.translation_m, axis) / self.distance_m
        turn = rotation_about(angle_rad * across) @ rotation_about(-tilt_rad * axis)
        return Pose(turn @ self.rotation, self.translation_m)

    def _tilt(self) -> tuple[FloatArray, float]:
        """Return axis and angle [rad] of the rotation from the centre's viewing ray to the normal.

        The axis (3,) is a unit vector; for a frontal pose, an arbitrary one perpendicular to the
        ray.
        """
        (a, b, c), (x, y, z) = self.normal.tolist(), self.translation_m.tolist()
        distance = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / distance, y / distance, z / distance
        axis = y * c - z * b, z * a - x * c, x * b - y * a
        sine = math.hypot(*axis)
        tilt_rad = math.atan2(sine, a * x + b * y + c * z)
        if sine < _FRONTAL_SINE:
            axis = 0.0, z, -y
            sine = math.hypot(*axis)
        return np.array(axis) / sine, tilt_rad

    @property
    def roll_deg(self) -> float:
        """φ of the paper's eq. 11: tilt of a diameter in the camera's yz plane; 0 for R = I.

        It is the diameter of the plate that is parallel to the camera's yz plane. With the plate's
        normal n its direction is d ∝ n × e_x, and φ = atan2(d_z, d_y) with d_y > 0.
        """
        n = self.normal
        return math.degrees(math.atan2(-n[1], n[2]))

    @property
    def pitch_deg(self) -> float:
        """θ of the paper: tilt of the diameter parallel to the camera's xz plane; 0 for R = I."""
        n = self.normal
        return math.degrees(math.atan2(-n[0], n[2]))


@compiled
def rotation_about(vector: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) [rad], by Rodrigues' formula.

    Compiled, because adjustments make many small rotations and a general library takes longer.
    """
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    first = math.sin(angle) / angle if angle > 1e-8 else 1.0
    second = (1.0 - math.cos(angle)) / square if angle > 1e-4 else 0.5
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    x, y, z, xx, yy, zz = first * x, first * y, first * z, x * x, y * y, z * z
    return np.array(
        [
            [1.0 - second * (yy + zz), xy - z, xz + y],
            [xy + z, 1.0 - second * (xx + zz), yz - x],
            [xz - y, yz + x, 1.0 - second * (xx + yy)],
        ]
    )


@compiled
def rotations_about(vectors: FloatArray) -> FloatArray:
    """Return the rotation matrices (n, 3, 3) of rotation vectors (n, 3) [rad]."""
    rotations = np.empty((len(vectors), 3, 3))
    for i in range(len(vectors)):
        rotations[i] = rotation_about(vectors[i])
    return rotations


rotation_about_once = interpreted(rotation_about)
"""The same for one call per frame or flight, which is not worth loading compiled code."""


def image_heading_deg(camera: Camera, pose: Pose) -> float:
    """Return the direction of the target's +x axis in the raw image [deg], in (-180, 180].

    It is measured clockwise from image x, at the projected centre. As the derivative of the
    distorted projection along the axis, it does not depend on a length on the plate.
    """
    centre, axis = pose.translation_m, pose.rotation[:, 0]
    normalised = centre[:2] / centre[2]
    along = (axis[:2] - normalised * axis[2]) / centre[2]
    dx, dy = camera.distort_jacobian(normalised) @ along
    return math.degrees(math.atan2(dy, dx))
