"""Start values for a planar field: focal length and poses from homographies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.homography import homography_between, mapped
from kgcp.geometry.pose import Pose
from kgcp.network.adjust import PLAIN, adjust_network
from kgcp.network.equations import whitened
from kgcp.network.frame_camera import FrameCameraModel
from kgcp.network.records import (
    BendPrior,
    CalibrationPrior,
    Estimate,
    Network,
    Observations,
    PointPrior,
)

FOCALS = (0.5, 0.8, 1.2, 2.0, 3.2, 5.0, 8.0, 12.0)
"""Focal lengths that are tried as start values, as multiples of the frame's longer side."""
_KNOWN_SD = 1e-9  # standard deviation of parameters that must not change


def start_camera_and_poses(
    observations: Observations, points: FloatArray, size: tuple[int, int]
) -> tuple[Camera, Estimate]:
    """Return a camera without distortion and the pose of every photograph.

    The principal point is in the middle. Focal lengths are tried: `FOCALS` and that of Zhang's
    closed form (2000). The one with the best-fitting poses is taken. Every pose of a plane has a
    mirrored twin, and the better of the two counts.
    """
    width, height = size
    centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    count = int(observations.view.max()) + 1
    homographies = []
    for view in range(count):
        in_view = observations.view == view
        flat = points[observations.point[in_view], :2]
        homographies.append(homography_between(flat, observations.places[in_view] - centre))
    focals = {share * max(size) for share in FOCALS}
    closed = _closed_focal(homographies)
    if closed is not None:
        focals.add(min(max(closed, 0.3 * max(size)), 20.0 * max(size)))
    starts = []
    for focal in sorted(focals):
        camera = Camera(width, height, focal, focal, *centre.tolist())
        poses = [
            _pose(homography, focal, points[observations.point[observations.view == view]])
            for view, homography in enumerate(homographies)
        ]
        estimate, costs = better_poses(camera, observations, points, poses)
        # the median is robust against a photograph with wrong names
        starts.append((float(np.median(costs)), camera, estimate))
    _, camera, estimate = min(starts, key=lambda start: start[0])
    return camera, estimate


def homography_misfits(observations: Observations, points: FloatArray) -> FloatArray:
    """Return how far each photograph (v,) deviates from a perspective view of a plane.

    This is the RMS of the residuals relative to the spread of the discs: a few thousandths for a
    lens with distortion, about one if the discs have wrong names.
    """
    misfits = []
    for view in range(int(observations.view.max()) + 1):
        in_view = observations.view == view
        flat, places = points[observations.point[in_view], :2], observations.places[in_view]
        gaps = places - mapped(homography_between(flat, places), flat)
        spread = np.sum((places - places.mean(axis=0)) ** 2)
        misfits.append(math.sqrt(float(np.sum(gaps**2) / spread)))
    return np.array(misfits)


def better_poses(
    camera: Camera, observations: Observations, points: FloatArray, poses: list[Pose]
) -> tuple[Estimate, FloatArray]:
    """Return the best-fitting pose of every photograph, and its weighted sum of squares (v,).

    A planar field has two poses with nearly the same image, mirrored about the viewing ray. Both
    are adjusted. A pose with discs behind the camera does not count.
    """
    twins = [
        _mirrored(pose, points[observations.point[observations.view == view]])
        for view, pose in enumerate(poses)
    ]
    first, first_costs = refined_poses(camera, observations, points, poses)
    second, second_costs = refined_poses(camera, observations, points, twins)
    is_second = second_costs < first_costs
    chosen = Estimate(
        first.cameras,
        np.where(is_second[:, None, None], second.rotations, first.rotations),
        np.where(is_second[:, None], second.translations, first.translations),
        first.points,
    )
    return chosen, np.minimum(first_costs, second_costs)


def refined_poses(
    camera: Camera,
    observations: Observations,
    points: FloatArray,
    poses: list[Pose],
    bends: BendPrior | None = None,
) -> tuple[Estimate, FloatArray]:
    """Return poses adjusted to the discs for a known camera, and their sums of squares (v,).

    With `bends`, the field may bend in each photograph; the bends' prior is part of the sum.
    """
    model = FrameCameraModel(camera, ())
    values = model.values_of(camera)[None]
    network = Network(
        model,
        np.zeros(len(poses), dtype=np.intp),
        observations,
        PointPrior(points, None),
        CalibrationPrior(values, np.full_like(values, _KNOWN_SD)),
        bends,
    )
    start = Estimate(
        values,
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation_m for pose in poses]),
        points,
        np.zeros((len(poses), network.bend_count)),
    )
    solution = adjust_network(network, start, PLAIN)
    weights = np.ones(len(observations.view))
    squares = np.sum(whitened(network, solution.residuals, weights) ** 2, axis=1)
    costs = np.bincount(observations.view, squares, len(poses))
    if bends is not None:
        costs += np.sum((solution.estimate.bends / bends.sd) ** 2, axis=1)
    return solution.estimate, np.where(_is_in_front(observations, solution.estimate), costs, np.inf)


def _is_in_front(observations: Observations, estimate: Estimate) -> BoolArray:
    depths = np.einsum(
        "nj,nj->n", estimate.rotations[observations.view, 2], estimate.points[observations.point]
    )
    depths += estimate.translations[observations.view, 2]
    count = len(estimate.rotations)
    behind = np.bincount(observations.view[depths <= 0.0], minlength=count)
    return np.asarray(behind == 0)


def _closed_focal(homographies: list[FloatArray]) -> float | None:
    """Return the focal length by Zhang's conditions (2000), or None if they have no solution.

    Pixels are square, and the principal point is in the middle.
    """
    rows, right = [], []
    for homography in homographies:
        h = homography / np.linalg.norm(homography[:, :2])
        (a, b), (c, d), (e, f) = h[:, :2].tolist()
        for coefficient, constant in (
            (a * b + c * d, e * f),
            (a * a + c * c - b * b - d * d, e * e - f * f),
        ):
            rows.append(coefficient)
            right.append(-constant)
    design = np.array(rows)
    inverse_square = float(design @ np.array(right)) / float(design @ design)
    return 1.0 / math.sqrt(inverse_square) if inverse_square > 0.0 else None


def _pose(homography: FloatArray, focal: float, points: FloatArray) -> Pose:
    """Return the pose of a plane from the homography that maps it to centred pixels."""
    columns = homography / np.array([[focal], [focal], [1.0]])
    columns = columns * 2.0 / np.linalg.norm(columns[:, :2], axis=0).sum()
    middle = points.mean(axis=0)
    if columns[2] @ [middle[0], middle[1], 1.0] < 0.0:
        columns = -columns
    third = np.cross(columns[:, 0], columns[:, 1])
    u, _, vt = np.linalg.svd(np.stack((columns[:, 0], columns[:, 1], third), axis=1))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return Pose(rotation, columns[:, 2])


def _mirrored(pose: Pose, points: FloatArray) -> Pose:
    """Return the other pose of a planar field: its normal mirrored about the ray of its middle."""
    middle = points.mean(axis=0)
    centre = pose.rotation @ middle + pose.translation_m
    twin = replace(pose, translation_m=centre).mirrored()
    return replace(twin, translation_m=centre - twin.rotation @ middle)
