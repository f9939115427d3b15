"""From rays to the plate, pixel by pixel, and derivatives back from there; compiled."""

from __future__ import annotations

import numpy as np

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray

VIEW_ROWS = 15
PLATE_ROWS = 9
SLOPE_ROWS = 11


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
    arm, b = np.zeros(3), np.zeros(3)
    for i in range(rays.shape[1]):
        x, y = rays[0, i], rays[1, i]
        facing = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2]
        depth = height / facing
        arm[0], arm[1], arm[2] = depth * x - pose[0, 3], depth * y - pose[1, 3], depth - pose[2, 3]
        for j in range(2):
            share = (pose[0, j] * x + pose[1, j] * y + pose[2, j]) / facing
            views[j, i] = 0.0
            for k in range(3):
                b[k] = pose[k, j] - share * pose[k, 2]
                views[j, i] += pose[k, j] * arm[k]
                views[9 + 3 * j + k, i] = b[k]
            for k in range(2):
                views[2 + 2 * j + k, i] = depth * (b[0] * rays[2 + k, i] + b[1] * rays[4 + k, i])
        for k in range(3):
            views[6 + k, i] = arm[k]


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
    for i in range(views.shape[1]):
        t, arm, b = on_plate[:, i], views[6:9, i], views[9:15, i]
        a, c, d, e = views[2, i], views[3, i], views[4, i], views[5, i]
        for k in range(3):
            slopes[k, i] = t[1] * b[k] + t[2] * b[3 + k] + t[3] * pose[k, 2] / height
        slopes[3, i] = arm[1] * slopes[2, i] - arm[2] * slopes[1, i]
        slopes[4, i] = arm[2] * slopes[0, i] - arm[0] * slopes[2, i]
        slopes[5, i] = arm[0] * slopes[1, i] - arm[1] * slopes[0, i]
        by_xx = (t[4] * a + 2.0 * t[5] * d) * a + t[6] * d * d
        by_yy = (t[4] * c + 2.0 * t[5] * e) * c + t[6] * e * e
        slopes[6, i] = by_xx + by_yy
        slopes[7, i] = by_xx - by_yy
        slopes[8, i] = 2.0 * (t[4] * a * c + t[5] * (a * e + d * c) + t[6] * d * e)
        slopes[9, i] = a * t[7] + d * t[8]
        slopes[10, i] = c * t[7] + e * t[8]
