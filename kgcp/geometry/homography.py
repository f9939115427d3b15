"""Homographies: projective maps of a plane."""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry.arrays import FloatArray

_MIN_DEPTH = 1e-9  # relative to that of the mean of the points that define the homography


def homography_between(plane_points: FloatArray, images: FloatArray) -> FloatArray:
    """Return the homography (3, 3) from points (n, 2) of a plane to their images (n, 2).

    It is computed by the normalised DLT, and scaled so that the mean of the points has the depth 1.
    """
    to_plane, to_image = _normalising(plane_points), _normalising(images)
    x, y = (plane_points @ to_plane[:2, :2] + to_plane[:2, 2]).T
    u, v = (images @ to_image[:2, :2] + to_image[:2, 2]).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        (
            np.stack((x, y, one, zero, zero, zero, -u * x, -u * y, -u), axis=1),
            np.stack((zero, zero, zero, x, y, one, -v * x, -v * y, -v), axis=1),
        )
    )
    is_short = len(rows) < rows.shape[1]  # then only the full SVD contains the null vector
    solved = np.linalg.svd(rows, full_matrices=is_short)[2][-1].reshape(3, 3)
    by_points = np.linalg.inv(to_image) @ solved @ to_plane
    depth = float(by_points[2] @ (*plane_points.mean(axis=0), 1.0))
    return np.asarray(by_points / depth if depth else by_points)


def mapped(homography: FloatArray, plane_points: FloatArray) -> FloatArray:
    """Return the images (n, 2) of points (n, 2) of a plane.

    Points behind the camera have no image: they are mapped to somewhere far away.
    """
    images = np.column_stack((plane_points, np.ones(len(plane_points)))) @ homography.T
    return np.asarray(images[:, :2] / np.maximum(images[:, 2:], _MIN_DEPTH))


def _normalising(points: FloatArray) -> FloatArray:
    """Return the similarity (3, 3) that gives points (n, 2) the mean 0 and an RMS radius of √2."""
    middle = points.mean(axis=0)
    scale = math.sqrt(2.0) / float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = -scale * middle
    return matrix
