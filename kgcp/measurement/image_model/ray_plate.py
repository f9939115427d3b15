"""From rays to the plate, pixel by pixel, and derivatives back from there; compiled.

Loops go over all pixels for few numbers at a time: so the vector units take several at once.
"""

from __future__ import annotations

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray

VIEW_ROWS = 15
PLATE_ROWS = 9
SLOPE_ROWS = 11


def views_of(pose: FloatArray, rays: FloatArray) -> FloatArray:
    """Return what `meet_plate` fills in: views (15, n) of pixels by their rays."""
    views = np.empty((VIEW_ROWS, rays.shape[1]))
    meet_plate(pose, rays, views)
    return views


@compiled
def meet_plate(pose: FloatArray, rays: FloatArray, views: FloatArray) -> None:
    """Meet the pixels' rays with the plate.

    Parameters
    ----------
    pose : (3, 4) array
        Rotation and translation, target → camera.
    rays : (6, n) array
        Normalised coordinates x, y and their derivatives xx, xy, yx, yy by raw pixels.
    views : (15, n) array
        Receives the point on the plate (2) [m]; the metres on the plate along axis j per raw pixel
        along k, as 2·j + k (4); the point from the target's centre in the camera frame (3) [m]; and
        b, as 3·j + k (6): the point moves by −b_j · v along plate axis j when the plate moves by v.
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
def carry_slopes(
    pose: FloatArray, views: FloatArray, on_plate: FloatArray, slopes: FloatArray
) -> None:
    """Carry derivatives from the plate to pose, blur and streak.

    Parameters
    ----------
    pose, views
        As for `meet_plate`.
    on_plate : (9, n) array
        White share; its derivatives by the plate's motion along its two axes [m], by the relative
        depth, by the blur on the plate xx, xy, yy [m²] and by the streak there x, y [m].
    slopes : (11, n) array
        Receives the derivatives by translation [m], rotation vector [rad], blur (xx + yy)/2,
        (xx − yy)/2, xy [px²] and streak x, y [px].
    """
    height = pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3]
    count, t, arm, b = views.shape[1], on_plate, views[6:9], views[9:15]
    for k in range(3):
        by_height = pose[k, 2] / height
        for i in range(count):
            slopes[k, i] = t[1, i] * b[k, i] + t[2, i] * b[3 + k, i] + t[3, i] * by_height
    for i in range(count):
        slopes[3, i] = arm[1, i] * slopes[2, i] - arm[2, i] * slopes[1, i]
        slopes[4, i] = arm[2, i] * slopes[0, i] - arm[0, i] * slopes[2, i]
        slopes[5, i] = arm[0, i] * slopes[1, i] - arm[1, i] * slopes[0, i]
    for i in range(count):
        a, c, d, e = views[2, i], views[3, i], views[4, i], views[5, i]
        by_xx = (t[4, i] * a + 2.0 * t[5, i] * d) * a + t[6, i] * d * d
        by_yy = (t[4, i] * c + 2.0 * t[5, i] * e) * c + t[6, i] * e * e
        slopes[6, i], slopes[7, i] = by_xx + by_yy, by_xx - by_yy
        by_xy = t[4, i] * a * c + t[5, i] * (a * e + d * c) + t[6, i] * d * e
        slopes[8, i] = 2.0 * by_xy
    for i in range(count):
        slopes[9, i] = views[2, i] * t[7, i] + views[4, i] * t[8, i]
        slopes[10, i] = views[3, i] * t[7, i] + views[5, i] * t[8, i]
