"""Where to begin with a field that has depth: focal length and poses from resections."""

from __future__ import annotations

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.network.records import Estimate, Observations
from kgcp.network.start import FOCALS, better_poses

_TRIALS, _CONFIDENCE = 200, 0.999
_MOST_OFF = 0.02  # of the frame's longer side: distortion and a wrong focal length, not wrong names
_FINER = 1.15  # ratio of focal lengths about the best, which a network then adjusts
_FINER_STEPS = 2


def start_in_space(
    observations: Observations, points: FloatArray, size: tuple[int, int]
) -> tuple[Camera, Estimate]:
    """Return a camera without distortion and the pose of every photograph.

    Poses are resected for each of some focal lengths, with the principal point in the middle, by
    triples of discs that most others agree with. The focal length is taken whose poses fit best.
    """
    width, height = size

    def at(focal: float) -> tuple[float, Camera, Estimate]:
        """Return the typical misfit of the photographs at a focal length, with camera and poses."""
        camera = Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
        count = int(observations.view.max()) + 1
        poses = [_resected(camera, observations, points, view) for view in range(count)]
        estimate, costs = better_poses(camera, observations, points, poses)
        # the median of the photographs: one with wrong names does not decide
        return float(np.median(costs)), camera, estimate

    coarse = min((at(share * max(size)) for share in FOCALS), key=lambda start: start[0])
    steps = [step for step in range(-_FINER_STEPS, _FINER_STEPS + 1) if step]
    finer = [at(coarse[1].fx * _FINER**step) for step in steps]
    _, camera, estimate = min((coarse, *finer), key=lambda start: start[0])
    return camera, estimate


def _resected(camera: Camera, observations: Observations, points: FloatArray, view: int) -> Pose:
    """Return the pose of a photograph by P3P, with wrong names left out."""
    mine = observations.view == view
    field, places = points[observations.point[mine]], observations.places[mine]
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    try:
        is_posed, turn, shift, _ = cv2.solvePnPRansac(
            field,
            places,
            matrix,
            None,
            iterationsCount=_TRIALS,
            reprojectionError=_MOST_OFF * max(camera.width, camera.height),
            confidence=_CONFIDENCE,
            flags=cv2.SOLVEPNP_P3P,
        )
        if not is_posed:
            _, turn, shift = cv2.solvePnP(field, places, matrix, None, flags=cv2.SOLVEPNP_EPNP)
        rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
        return Pose(rotation, np.asarray(shift, dtype=np.float64).ravel())
    except cv2.error:  # in a row, or at one place: any pose in front, which will not fit
        middle = field.mean(axis=0)
        return Pose(np.eye(3), np.array([0.0, 0.0, 10.0 * np.ptp(field)]) - middle)
