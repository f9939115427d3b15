"""Start values for a field with depth: focal length and poses from resections."""

from __future__ import annotations

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.network.records import Estimate, Observations
from kgcp.network.start import FOCALS, better_poses

_TRIALS, _CONFIDENCE = 200, 0.999  # of RANSAC
# Largest residual of an inlier, relative to the frame's longer side: it allows for distortion and a
# wrong focal length, but not for wrong names.
_MAX_RESIDUAL = 0.02
# Around the best of `FOCALS`, finer steps are tried: this many on either side, with this ratio. The
# network then adjusts the focal length.
_FINE_STEPS = 2
_FINE_RATIO = 1.15


def start_in_space(
    observations: Observations, points: FloatArray, size: tuple[int, int]
) -> tuple[Camera, Estimate]:
    """Return a camera without distortion and the pose of every photograph.

    The principal point is in the middle. For each focal length tried, every pose is resected from
    a triple of discs with which most others agree (RANSAC). The focal length with the best-fitting
    poses is taken.
    """
    width, height = size

    def at(focal: float) -> tuple[float, Camera, Estimate]:
        """Return the median misfit of the photographs at a focal length, camera and poses."""
        camera = Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
        count = int(observations.view.max()) + 1
        poses = [_resected(camera, observations, points, view) for view in range(count)]
        estimate, costs = better_poses(camera, observations, points, poses)
        # the median is robust against a photograph with wrong names
        return float(np.median(costs)), camera, estimate

    coarse = min((at(share * max(size)) for share in FOCALS), key=lambda start: start[0])
    steps = [step for step in range(-_FINE_STEPS, _FINE_STEPS + 1) if step]
    fine = [at(coarse[1].fx * _FINE_RATIO**step) for step in steps]
    _, camera, estimate = min((coarse, *fine), key=lambda start: start[0])
    return camera, estimate


def _resected(camera: Camera, observations: Observations, points: FloatArray, view: int) -> Pose:
    """Return the pose of a photograph by P3P and RANSAC, which leaves out wrong names."""
    in_view = observations.view == view
    field, places = points[observations.point[in_view]], observations.places[in_view]
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    try:
        is_posed, turn, shift, _ = cv2.solvePnPRansac(
            field,
            places,
            matrix,
            None,
            iterationsCount=_TRIALS,
            reprojectionError=_MAX_RESIDUAL * max(camera.width, camera.height),
            confidence=_CONFIDENCE,
            flags=cv2.SOLVEPNP_P3P,
        )
        if not is_posed:
            _, turn, shift = cv2.solvePnP(field, places, matrix, None, flags=cv2.SOLVEPNP_EPNP)
        rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
        return Pose(rotation, np.asarray(shift, dtype=np.float64).ravel())
    except cv2.error:  # discs in a row or at one place: return any pose in front, it will not fit
        middle = field.mean(axis=0)
        return Pose(np.eye(3), np.array([0.0, 0.0, 10.0 * np.ptp(field)]) - middle)
