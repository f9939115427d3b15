"""Start values of a circle in space: the best of the circles that single frames allow."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import circle_planes
from kgcp.geometry.circle_image import circle_images
from kgcp.measurement.discs.records import ellipse_of_moments
from kgcp.network.ground.space_circle import (
    CircleViews,
    NoCircleError,
    SpaceCircle,
    angle_deg,
    mean_radius,
)

_MAX_CANDIDATES = 60  # normals that are tried
_START_ERROR = 0.03  # relative error of the moments that a good start may have
# A second start is returned if its normal differs by at least this angle and its cost by little:
# per frame, by less than this share of the cost of a frame that does not fit at all.
_OTHER_NORMAL_DEG = 20.0
_MAX_COST_DIFFERENCE = 0.2
_MAX_ROUNDS = 12
_MIN_AHEAD = 0.5  # share of the frames that must have the point in front of them


def circle_starts(camera: Camera, views: CircleViews) -> list[SpaceCircle]:
    """Return the best circle by single frames and, if nearly as good, one with another normal."""
    centre = _meeting_point(camera, views)
    step = max(1, math.ceil(2 * len(views) / _MAX_CANDIDATES))
    candidates = list(_of_single_frames(camera, views, centre, range(0, len(views), step)))
    if not candidates:
        raise NoCircleError("no image is that of a circle in front of the camera")
    costs = [_start_cost(camera, views, candidate) for candidate in candidates]
    order = np.argsort(costs, kind="stable")
    first = order[0]
    near = (
        row for row in order[1:] if costs[row] - costs[first] < _MAX_COST_DIFFERENCE * len(views)
    )
    other = next(
        (
            candidates[row]
            for row in near
            if angle_deg(candidates[first].normal, candidates[row].normal) > _OTHER_NORMAL_DEG
        ),
        None,
    )
    return [candidates[first]] if other is None else [candidates[first], other]


def _meeting_point(camera: Camera, views: CircleViews) -> FloatArray:
    """Return the point (3,) with the least angles to all rays, by robust least squares."""
    normalised = camera.undistort(views.moments[:, :2])
    rays = np.column_stack((normalised, np.ones(len(views))))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = np.einsum("nij,nj->ni", views.world_from_camera, rays)
    square = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weights = np.ones(len(views))
    for _ in range(_MAX_ROUNDS):
        normal = np.einsum("n,nij->ij", weights, square)
        if not np.isfinite(normal).all() or not np.linalg.cond(normal) < 1e10:
            raise NoCircleError("all rays start at one place, or are parallel")
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, square, views.camera_m))
        sights = point - views.camera_m
        distance = np.linalg.norm(sights, axis=1)
        angles_rad = np.linalg.norm(np.einsum("nij,nj->ni", square, sights), axis=1) / distance
        scale = max(float(np.median(angles_rad)), 1e-9)
        weights = 1.0 / (distance**2 * (1.0 + (angles_rad / (3.0 * scale)) ** 2))
    if np.mean(np.einsum("ni,ni->n", sights, rays) > 0.0) < _MIN_AHEAD:
        raise NoCircleError("the rays meet behind the cameras")
    return np.asarray(point)


def _of_single_frames(
    camera: Camera, views: CircleViews, centre_m: FloatArray, rows: Sequence[int]
) -> Iterator[SpaceCircle]:
    """Yield both circles that each of some frames allows, with the centre from all frames."""
    places = camera.undistort(views.moments[:, :2])
    inverse = np.linalg.inv(camera.distort_jacobian(places))
    for row in rows:
        xx, xy, yy = views.moments[row, 2:].tolist()
        spread = inverse[row] @ np.array(((xx, xy), (xy, yy))) @ inverse[row].T
        vector = np.array((*places[row], spread[0, 0], spread[0, 1], spread[1, 1]))
        try:
            planes = circle_planes(ellipse_of_moments(vector).conic)
        except (Rejection, ValueError):
            continue
        distance = float(np.linalg.norm(centre_m - views.camera_m[row]))
        for plane in planes:
            radius_m = distance / float(np.linalg.norm(plane.centre))
            normal = -views.world_from_camera[row] @ plane.normal
            yield SpaceCircle(centre_m, normal, radius_m)


def _start_cost(camera: Camera, views: CircleViews, circle: SpaceCircle) -> float:
    """Return the cost of a circle: squared errors of the shapes, limited to 1 per frame."""
    images = circle_images(camera, circle.in_cameras(views))
    errors = (views.moments - images.moments)[:, 2:] / mean_radius(views.moments)[:, None] ** 2
    squares = np.sum((errors / _START_ERROR) ** 2, axis=1)
    return float(np.sum(np.where(np.isfinite(squares), squares / (1.0 + squares), 1.0)))
