"""Homographies: perspective maps of a plane."""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry.arrays import FloatArray

_LEAST_DEPTH = 1e-9  # over that of the middle of what it was computed from


def homography_between(flat: FloatArray, places: FloatArray) -> FloatArray:
    """Return the homography (3, 3) from points (n, 2) of a plane to their images (n, 2).

    It is that of the normalised DLT. The depth of the points' middle is 1.
    """
    to_plane, to_image = _normalising(flat), _normalising(places)
    x, y = (flat @ to_plane[:2, :2] + to_plane[:2, 2]).T
    u, v = (places @ to_image[:2, :2] + to_image[:2, 2]).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        (
            np.stack((x, y, one, zero, zero, zero, -u * x, -u * y, -u), axis=1),
            np.stack((zero, zero, zero, x, y, one, -v * x, -v * y, -v), axis=1),
        )
    )
    is_short = len(rows) < rows.shape[1]  # then the last vector is only among all of them
    solved = np.linalg.svd(rows, full_matrices=is_short)[2][-1].reshape(3, 3)
    by_points = np.linalg.inv(to_image) @ solved @ to_plane
    depth = float(by_points[2] @ (*flat.mean(axis=0), 1.0))
    return np.asarray(by_points / depth if depth else by_points)


def mapped(homography: FloatArray, flat: FloatArray) -> FloatArray:
    """Return the images (n, 2) of points (n, 2) of a plane; far away where they have none."""
    images = np.column_stack((flat, np.ones(len(flat)))) @ homography.T
    return np.asarray(images[:, :2] / np.maximum(images[:, 2:], _LEAST_DEPTH))


def _normalising(points: FloatArray) -> FloatArray:
    middle = points.mean(axis=0)
    scale = math.sqrt(2.0) / float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = -scale * middle
    return matrix
