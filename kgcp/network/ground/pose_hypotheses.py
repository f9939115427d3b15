"""Poses of a frame from three points, by their images alone (P3P) or with their distances."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import rotation_onto
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.point_images import CameraPose, PointImages

_MAX_TRIPLES = 200


def hypotheses(
    camera: Camera, images: PointImages, focals: Sequence[float], seed: int
) -> Iterator[CameraPose]:
    """Yield all poses from triples of points, with these in front of the camera."""
    triples = _triples(len(images), seed)
    for focal in focals:
        rays = _normalised(camera, images.pixels, focal)
        for triple in triples:
            for pose in three_point_poses(images.positions_m[triple], rays[triple]):
                yield CameraPose(pose.centre_m, pose.world_from_camera, focal)
            if images.has_distance[triple].all():
                distances = focal * images.distances_m[triple]
                aligned = _aligned_pose(images.positions_m[triple], rays[triple], distances)
                if aligned is not None:
                    yield CameraPose(aligned.centre_m, aligned.world_from_camera, focal)


def _aligned_pose(
    positions_m: FloatArray, rays: FloatArray, distances_m: FloatArray
) -> CameraPose | None:
    """Return the pose in which points (3, 3) best lie at given distances along rays (3, 2).

    Near the critical cylinder of three points, noise may leave no exact pose; this one exists
    nevertheless. None: the points lie in a line.
    """
    directions = np.column_stack((rays, np.ones(len(rays))))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    in_camera = directions * distances_m[:, None]
    if _are_in_line(positions_m) or _are_in_line(in_camera):
        return None
    rotation = rotation_onto(in_camera, positions_m)
    return CameraPose(positions_m.mean(axis=0) - rotation @ in_camera.mean(axis=0), rotation)


def _are_in_line(points: FloatArray) -> bool:
    """Tell whether three points (3, 3) lie in a line, up to rounding."""
    first, second = points[1] - points[0], points[2] - points[0]
    limit = 1e-9 * float(first @ first + second @ second)
    return not float(np.linalg.norm(np.cross(first, second))) > limit


def _triples(count: int, seed: int) -> list[list[int]]:
    """Return all triples of points, or a random choice if there are too many."""
    if math.comb(count, 3) <= _MAX_TRIPLES:
        return [list(triple) for triple in itertools.combinations(range(count), 3)]
    rng = np.random.default_rng([seed, count])
    return [sorted(rng.choice(count, 3, replace=False).tolist()) for _ in range(_MAX_TRIPLES)]


def three_point_poses(positions_m: FloatArray, rays: FloatArray) -> Iterator[CameraPose]:
    """Yield the poses, at most four, in which three points (3, 3) lie on rays (3, 2).

    Rays are given by normalised coordinates. All points lie in front of the camera.
    """
    middle = positions_m.mean(axis=0)
    try:
        _, turns, shifts = cv2.solveP3P(
            np.ascontiguousarray(positions_m - middle).reshape(3, 1, 3),
            np.ascontiguousarray(rays).reshape(3, 1, 2),
            np.eye(3),
            None,
            flags=cv2.SOLVEPNP_AP3P,
        )
    except cv2.error:  # three points in a line
        return
    for turn, shift in zip(turns or (), shifts or (), strict=True):
        if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
            continue
        rotation = rotation_about(np.ascontiguousarray(turn.ravel()))
        depths = (positions_m - middle) @ rotation[2] + float(shift[2, 0])
        if np.all(depths > 0.0):
            yield CameraPose(middle - rotation.T @ shift.ravel(), rotation.T)


def _normalised(camera: Camera, pixels: FloatArray, focal: float) -> FloatArray:
    """Return normalised coordinates (n, 2) for `focal` times the camera's focal length.

    Distortion as a function of the place in the image stays the same.
    """
    return np.asarray(camera.undistort(pixels) / focal)
