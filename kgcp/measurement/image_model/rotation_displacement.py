"""Errors of a pose due to an unknown rotation of the scene during a rolling-shutter readout.

Rows that are exposed later are displaced, as if the image were sheared. The image of a plate that
almost faces the camera depends on the square of its tilt: a shear of 0.4 % looks like a tilt of 5°.
So the pose is not a linear function of the rotation, and its mean square displacement does not
follow from derivatives. When it was computed from them, squared Mahalanobis distances of poses had
a median of 15 in simulated flights with unknown motion (`benchmarks.accuracy.presets`, preset
`rolling`).

Instead, the displacement is computed for a set of rotations. For each it is known where the camera
would have seen the edges without it, and the pose that fits these best is searched.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.image_model.plate import Circles
from kgcp.measurement.image_model.rolling_shutter import ray_motions

# A cubature rule: 12 rotations (12, 3) whose sums with weights of 1/20 are the means of all
# polynomials up to degree five in three independent unit normal variables. The directions are the
# vertices of an icosahedron. The squared radius of 5 makes the second moments 12/20 · 5/3 = 1, and
# the fourth ones correct, too. The rule's thirteenth point is no rotation, which displaces nothing.
_GOLDEN = 0.5 * (1.0 + math.sqrt(5.0))
_VERTICES = np.array(
    [
        np.roll((0.0, short, long), turn)
        for turn in range(3)
        for short in (-1.0, 1.0)
        for long in (-_GOLDEN, _GOLDEN)
    ]
)
_ROTATIONS = math.sqrt(5.0) * _VERTICES / math.hypot(1.0, _GOLDEN)
_WEIGHT = 1.0 / 20.0
# Points per circle. Around a circle, shears displace edges by the second harmonic, and tilts by the
# first four.
_POINTS, _POINTS_OF_DOTS = 24, 8
_DOT_SHARE = 0.3  # circles with smaller radii, relative to the largest one, are dots
_MAX_STEPS, _SETTLED = 20, 1e-5  # a step below the latter, in radians and of the depth, is the last
# Largest step, in radians and relative to the depth. The image of a plate that faces the camera
# hardly depends on its tilt, so that the equations alone may ask for steps of any size.
_MAX_STEP = 0.1
_RIDGE = 1e-9  # relative to the diagonal; keeps the equations of such a plate regular


def mean_square_displacement(
    pose: Pose, circles: Circles, delay_s: float, sd_rad_s: float
) -> FloatArray:
    """Return the mean square (6, 6) of the displacement of a pose by unknown rotations.

    Parameters
    ----------
    pose : Pose
        The pose measured under the assumption of no rotation.
    circles : Circles
        The measured circles of the plate, including dots: without dots the heading is undetermined.
    delay_s : float
        Delay of a ray's exposure relative to the target's centre, per unit of its normalised y [s].
    sd_rad_s : float
        Standard deviation of the rate of rotation about each camera axis.

    Returns
    -------
    (6, 6) array
        For translation [m] and rotation vector [rad], left perturbation in the camera frame.
    """
    off = pose_displacements(pose, circles, delay_s, sd_rad_s * _ROTATIONS)
    return np.asarray(_WEIGHT * off.T @ off)


def pose_displacements(
    pose: Pose, circles: Circles, delay_s: float, rotations_rad_s: FloatArray
) -> FloatArray:
    """Return the displacements (k, 6) from the pose without a rotation to those with rotations.

    Gauss-Newton steps minimise the distances of edge points, only perpendicular to the edges and
    weighted by the lengths that the points represent. Corresponding points have the same position
    on their circle. Steps are limited in size and number, so displacements stay finite however fast
    the rotations (k, 3) are.
    """
    points_m, tangents, lengths_m = _edges_of(circles)
    seen = pose.transform(points_m)
    rays = seen[:, :2] / seen[:, 2:]
    delays_s = delay_s * (rays[:, 1] - pose.translation_m[1] / pose.translation_m[2])
    by_time = np.moveaxis(rotations_rad_s @ ray_motions(*rays.T), 0, -1)  # (k, n, 2)
    targets = rays - by_time * delays_s[:, None]
    turns = np.repeat(np.eye(3)[None], len(targets), axis=0)
    moves_m = np.zeros((len(targets), 3))
    for _ in range(_MAX_STEPS):
        axes = turns @ pose.rotation[:, :2]
        on_plate = points_m @ np.swapaxes(axes, 1, 2)
        centres_m = pose.translation_m + moves_m
        placed = on_plate + centres_m[:, None]
        images = placed[..., :2] / placed[..., 2:]
        # normals of the edges in the image, and how far along them the edges must move
        along = tangents @ np.swapaxes(axes, 1, 2)
        along = along[..., :2] - images * along[..., 2:]
        normals = np.stack((-along[..., 1], along[..., 0]), axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        off = np.sum(normals * (targets - images), axis=-1)
        # derivatives along the normals by where a point is in the camera frame, then by the pose
        depth = -np.sum(normals * images, axis=-1, keepdims=True)
        by_place = np.concatenate((normals, depth), axis=-1) / placed[..., 2:]
        jacobian = np.concatenate((by_place, np.cross(on_plate, by_place)), axis=-1)
        weighted = np.swapaxes(jacobian * lengths_m[:, None], 1, 2)
        normal = weighted @ jacobian
        normal[:, range(6), range(6)] *= 1.0 + _RIDGE
        steps = np.linalg.solve(normal, weighted @ off[..., None])[..., 0]
        shifts = np.linalg.norm(steps[:, :3], axis=1) / centres_m[:, 2]
        sizes = np.maximum(np.linalg.norm(steps[:, 3:], axis=1), shifts)
        steps *= (_MAX_STEP / np.maximum(sizes, _MAX_STEP))[:, None]
        moves_m += steps[:, :3]
        turns = np.array([rotation_about(step) for step in steps[:, 3:]]) @ turns
        if sizes.max() < _SETTLED:
            break
    return np.concatenate((moves_m, _rotation_vectors(turns)), axis=1)


def _edges_of(circles: Circles) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points of circles (n, 2) [m], tangents (n, 2), and the lengths they represent [m]."""
    points, tangents, lengths = [], [], []
    least_m = _DOT_SHARE * float(circles.radii_m.max())
    for centre_m, radius_m in zip(circles.centres_m.T, circles.radii_m.tolist(), strict=True):
        count = _POINTS_OF_DOTS if radius_m < least_m else _POINTS
        angles = 2.0 * np.pi / count * np.arange(count)
        outward = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        points.append(centre_m + radius_m * outward)
        tangents.append(outward[:, ::-1] * (-1.0, 1.0))
        lengths.append(np.full(count, 2.0 * np.pi * radius_m / count))
    return np.concatenate(points), np.concatenate(tangents), np.concatenate(lengths)


def _rotation_vectors(turns: FloatArray) -> FloatArray:
    """Return the rotation vectors (k, 3) [rad] of rotations (k, 3, 3) by less than 180°."""
    twice = np.stack([turns[:, j, i] - turns[:, i, j] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    sine = 0.5 * np.linalg.norm(twice, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turns, axis1=1, axis2=2) - 1.0))
    return np.asarray(0.5 * twice / np.maximum(np.sinc(angle / np.pi), 1e-9)[:, None])
