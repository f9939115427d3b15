"""What an unknown rotation of the scene, while a rolling shutter reads it, makes of a pose.

Rows that are exposed later are displaced, as if the image were sheared. The image of a plate that
nearly faces the camera depends on the square of its tilt: a shear of 0.4 % looks like a tilt of 5°.
So the pose does not follow the rotation linearly, and derivatives do not give its mean square
displacement. With them, squared Mahalanobis distances of poses had a median of 15 in simulated
flights whose motion was not known (`benchmarks.accuracy.presets`, preset `rolling`).

The displacement is found for some rotations instead. For each, it is known which edges the camera
would have seen without it; the pose that fits them best is searched for.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.image_model.plate import Circles
from kgcp.measurement.image_model.rolling_shutter import ray_motions

# Rotations (12, 3): with weights of 1/20, sums over them are the means of all polynomials up to the
# fifth degree in three independent unit normal variables. The vertices of an icosahedron are evenly
# spread; the squared radius of 5 gives the second moments, 12/20 · 5/3 = 1, and the fourth. The
# thirteenth point, without a rotation, displaces nothing.
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
# Around a circle, shears displace edges by the second harmonic, and tilts by the first four.
_POINTS, _POINTS_OF_DOTS = 24, 8
_DOT_SHARE = 0.3  # of the largest radius, below which a circle is a dot
_STEPS, _SETTLED = 20, 1e-5  # the latter in radians, and of the depth
# What a step changes at most, in radians and of the depth: of a plate that faces the camera, images
# hardly depend on the tilt, so that derivatives alone ask for any.
_LARGEST_STEP = 0.1
_RIDGE = 1e-9  # of the diagonal: keeps the equations of such a plate regular


def mean_square_displacement(
    pose: Pose, circles: Circles, delay_s: float, sd_rad_s: float
) -> FloatArray:
    """Return the mean square (6, 6) of what unknown rotations displace a pose by.

    Parameters
    ----------
    pose : Pose
        As it was measured, without any rotation.
    circles : Circles
        Those of the plate that were measured, dots included: without, nothing tells the heading.
    delay_s : float
        How much later a ray is exposed than the target's centre, per unit of its y.
    sd_rad_s : float
        Standard deviation of the rotation about each of the camera's axes.

    Returns
    -------
    (6, 6) array
        Of translation [m] and rotation vector [rad], left perturbation in the camera frame.
    """
    off = pose_displacements(pose, circles, delay_s, sd_rad_s * _ROTATIONS)
    return np.asarray(_WEIGHT * off.T @ off)


def pose_displacements(
    pose: Pose, circles: Circles, delay_s: float, rotations_rad_s: FloatArray
) -> FloatArray:
    """Return by how much (k, 6) poses of known rotations (k, 3) are off the one of none.

    Edges count by their lengths, and square to themselves only: Gauss-Newton steps compare points
    that have the same place on their circle. Steps are limited, and so are displacements, however
    fast the rotations.
    """
    points_m, tangents, lengths_m = _edges_of(circles)
    seen = pose.transform(points_m)
    rays = seen[:, :2] / seen[:, 2:]
    delays_s = delay_s * (rays[:, 1] - pose.translation_m[1] / pose.translation_m[2])
    by_time = np.moveaxis(rotations_rad_s @ ray_motions(*rays.T), 0, -1)  # (k, n, 2)
    targets = rays - by_time * delays_s[:, None]
    turns = np.repeat(np.eye(3)[None], len(targets), axis=0)
    moves_m = np.zeros((len(targets), 3))
    for _ in range(_STEPS):
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
        steps *= (_LARGEST_STEP / np.maximum(sizes, _LARGEST_STEP))[:, None]
        moves_m += steps[:, :3]
        turns = np.array([rotation_about(step) for step in steps[:, 3:]]) @ turns
        if sizes.max() < _SETTLED:
            break
    return np.concatenate((moves_m, _rotation_vectors(turns)), axis=1)


def _edges_of(circles: Circles) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (n, 2) of circles [m], tangents (n, 2), and lengths (n,) they stand for [m]."""
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
    """Return the vectors (k, 3) of rotations (k, 3, 3) by less than 180° [rad]."""
    twice = np.stack([turns[:, j, i] - turns[:, i, j] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    sine = 0.5 * np.linalg.norm(twice, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turns, axis1=1, axis2=2) - 1.0))
    return np.asarray(0.5 * twice / np.maximum(np.sinc(angle / np.pi), 1e-9)[:, None])
