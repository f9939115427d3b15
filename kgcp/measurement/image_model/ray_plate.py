"""Intersection of pixels' rays with the plate, and the chain rule back to the pose (compiled).

A "view" of a pixel is what depends on pixel and pose alone: the point where its ray meets the
plate, the scale there, and the derivatives by the pose. Every loop runs over all pixels for a few
numbers, so that it is vectorised.
"""

from __future__ import annotations

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray

VIEW_ROWS = 15
PLATE_ROWS = 9  # white share, and its derivatives on the plate
JACOBIAN_ROWS = 11  # pose, blur and streak


def plate_views(pose: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the views (15, n) of pixels with given rays (6, n); see `intersect_plate`."""
    views = np.empty((VIEW_ROWS, rays.shape[1]))
    intersect_plate(pose, rays, views)
    return views


@compiled
def intersect_plate(pose: FloatArray, rays: FloatArray, views: FloatArray) -> None:
    """Intersect the pixels' rays with the plate.

    Parameters
    ----------
    pose : (3, 4) array
        Rotation and translation, target → camera.
    rays : (6, n) array
        Normalised coordinates x, y and their derivatives xx, xy, yx, yy by raw pixels.
    views : (15, n) array
        Filled in. Rows 0, 1: the point on the plate [m]. Rows 2 + 2·j + k: metres on the plate
        along axis j per raw pixel along k. Rows 6 to 8: the vector from the target's centre to the
        point in the camera frame [m]. Rows 9 + 3·j + k: vectors b_j; the point moves by −b_j · v
        along plate axis j if the plate moves by v.
    """
    height = pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3]
    normal_x, normal_y, normal_z = pose[0, 2], pose[1, 2], pose[2, 2]
    for i in range(rays.shape[1]):
        x, y = rays[0, i], rays[1, i]
        depth = height / (normal_x * x + normal_y * y + normal_z)
        views[6, i], views[7, i] = depth * x - pose[0, 3], depth * y - pose[1, 3]
        views[8, i] = depth - pose[2, 3]
    for j in range(2):
        axis_x, axis_y, axis_z = pose[0, j], pose[1, j], pose[2, j]
        for i in range(rays.shape[1]):
            x, y, depth = rays[0, i], rays[1, i], views[8, i] + pose[2, 3]
            share = (axis_x * x + axis_y * y + axis_z) * depth / height
            b_x, b_y = axis_x - share * normal_x, axis_y - share * normal_y
            views[j, i] = axis_x * views[6, i] + axis_y * views[7, i] + axis_z * views[8, i]
            views[9 + 3 * j, i], views[10 + 3 * j, i] = b_x, b_y
            views[11 + 3 * j, i] = axis_z - share * normal_z
            views[2 + 2 * j, i] = depth * (b_x * rays[2, i] + b_y * rays[4, i])
            views[3 + 2 * j, i] = depth * (b_x * rays[3, i] + b_y * rays[5, i])


@compiled
def chain_to_parameters(
    pose: FloatArray, views: FloatArray, on_plate: FloatArray, jacobian: FloatArray
) -> None:
    """Apply the chain rule: from derivatives on the plate to those by pose, blur and streak.

    Parameters
    ----------
    pose, views
        As for `intersect_plate`.
    on_plate : (9, n) array
        White share, and its derivatives by the plate's motion along its two axes [m], by the
        relative depth, by the blur on the plate xx, xy, yy [m²] and by the streak there x, y [m].
    jacobian : (11, n) array
        Filled in: derivatives by translation [m], rotation vector [rad], blur (xx + yy)/2, (xx −
        yy)/2, xy [px²] and streak x, y [px].
    """
    height = pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3]
    count, t, arm, b = views.shape[1], on_plate, views[6:9], views[9:15]
    for k in range(3):
        by_height = pose[k, 2] / height
        for i in range(count):
            jacobian[k, i] = t[1, i] * b[k, i] + t[2, i] * b[3 + k, i] + t[3, i] * by_height
    for i in range(count):
        jacobian[3, i] = arm[1, i] * jacobian[2, i] - arm[2, i] * jacobian[1, i]
        jacobian[4, i] = arm[2, i] * jacobian[0, i] - arm[0, i] * jacobian[2, i]
        jacobian[5, i] = arm[0, i] * jacobian[1, i] - arm[1, i] * jacobian[0, i]
    for i in range(count):
        a, c, d, e = views[2, i], views[3, i], views[4, i], views[5, i]
        by_xx = (t[4, i] * a + 2.0 * t[5, i] * d) * a + t[6, i] * d * d
        by_yy = (t[4, i] * c + 2.0 * t[5, i] * e) * c + t[6, i] * e * e
        jacobian[6, i], jacobian[7, i] = by_xx + by_yy, by_xx - by_yy
        by_xy = t[4, i] * a * c + t[5, i] * (a * e + d * c) + t[6, i] * d * e
        jacobian[8, i] = 2.0 * by_xy
    for i in range(count):
        jacobian[9, i] = views[2, i] * t[7, i] + views[4, i] * t[8, i]
        jacobian[10, i] = views[3, i] * t[7, i] + views[5, i] * t[8, i]
