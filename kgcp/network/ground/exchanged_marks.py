"""Marks in a frame whose names are exchanged."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import permutations, product

import numpy as np
from scipy.optimize import linear_sum_assignment

from kgcp.geometry.camera import Camera
from kgcp.georef.plain_prediction import MarkedPlace
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.point_images import CameraPose, PointImages, Readout
from kgcp.network.ground.pose_adjustment import adjusted_pose
from kgcp.network.ground.pose_hypotheses import three_point_poses

_MAX_TRIPLES = 6  # triples of marks from which poses start; one with right names is enough
# Triples of marks to which all names are given in turn; one that is not nearly in a line is enough.
_RENAMED_TRIPLES = 3
_START_SHARE = 0.1  # residual allowed at a pose from three marks, relative to the frame's width
_MAX_MEAN_CHI2 = 25.0  # χ² per mark at which a pose is accepted
_TILT_SD_DEG = 10.0  # standard deviation of the camera axis about the vertical
_DISPLACEMENT_SIGMAS = 4.0  # displacement of one of three marks that is allowed for


def exchanged_marks(
    places: Mapping[str, MarkedPlace], positions: Mapping[str, TargetPosition], camera: Camera
) -> tuple[str, ...] | None:
    """Return the targets whose marks in a frame have exchanged names; None if there are none.

    Names are exchanged if no camera above the targets can see them as marked, but can see them with
    these names exchanged. At least three marks are needed: exchanging two of three reverses their
    sense of rotation. Three marks nearly in a line do not show it.

    Parameters
    ----------
    positions : mapping of str to TargetPosition
        Positions of at least the marked targets in the ENU frame.
    """
    names = [*places]
    if len(names) < 3:
        return None
    images = _point_images(places, positions, camera)
    if any(next(_misfits(camera, each), None) is not None for each in _displaced(images)):
        return None
    best, least = None, math.inf
    for order in _orders(camera, images):
        pixels = images.pixels[order]
        readout = Readout.of(camera, pixels)
        exchanged = replace(
            images, pixels=pixels, pixel_cov=images.pixel_cov[order], readout=readout
        )
        misfit = min(_misfits(camera, exchanged), default=math.inf)
        if misfit < least:
            best, least = order, misfit
    if best is None:
        return None
    return tuple(name for at, name in enumerate(names) if best[at] != at)


def _orders(camera: Camera, images: PointImages) -> list[list[int]]:
    """Return possible assignments: for each one, the number of every target's mark.

    Three marks with any names give poses; the targets projected there are assigned to the marks.
    """
    rays, count = camera.undistort(images.pixels), len(images)
    orders = set()
    for triple, named in product(_triples(count)[:_RENAMED_TRIPLES], permutations(range(count), 3)):
        for pose in three_point_poses(images.positions_m[list(named)], rays[triple]):
            points_m = pose.in_camera(images.positions_m)
            if np.any(points_m[:, 2] <= 0.0):
                continue
            gaps_px = np.abs(camera.project(points_m)[:, None] - images.pixels).max(axis=2)
            targets, marks = linear_sum_assignment(gaps_px)
            if gaps_px[targets, marks].max() < _START_SHARE * camera.width:
                orders.add(tuple(marks.tolist()))
    return [[*order] for order in sorted(orders)]


def _point_images(
    places: Mapping[str, MarkedPlace], positions: Mapping[str, TargetPosition], camera: Camera
) -> PointImages:
    covs = [positions[name].cov_m2 for name in places]
    pixels = np.array([(place.x_px, place.y_px) for place in places.values()])
    unknown = np.full(len(places), np.nan)
    return PointImages(
        np.array([positions[name].position_m for name in places]),
        np.array([np.zeros((3, 3)) if cov is None else cov for cov in covs]),
        pixels,
        np.array([place.sd_px**2 * np.eye(2) for place in places.values()]),
        unknown,
        unknown,
        readout=Readout.of(camera, pixels),
    )


def _displaced(images: PointImages) -> Iterator[PointImages]:
    """Yield the marks as they are and, if there are three, with one of them displaced.

    Three marks determine the pose without redundancy. Displacing them allows for their errors.
    """
    yield images
    if len(images) > 3:
        return
    for mark, axis in np.ndindex(3, 2):
        for sigmas in (-_DISPLACEMENT_SIGMAS, _DISPLACEMENT_SIGMAS):
            pixels = images.pixels.copy()
            pixels[mark, axis] += sigmas * math.sqrt(float(images.pixel_cov[mark, axis, axis]))
            yield replace(images, pixels=pixels)


def _misfits(camera: Camera, images: PointImages) -> Iterator[float]:
    """Yield the misfit of each acceptable pose: χ² of the marks plus that of the camera's tilt.

    Acceptable poses see the marks from above, and fit them.
    """
    for start in _starts(camera, images):
        pose, chi2 = start, 0.0
        if len(images) > 3:
            adjusted = adjusted_pose(camera, images, start, 0.0)
            if adjusted is None:
                continue
            pose, residuals_px = adjusted[0], adjusted[2][:, :2]
            chi2 = float(np.sum(residuals_px**2 / images.pixel_cov[:, :1, 0]))
        is_above = bool(np.all(pose.centre_m[2] > images.positions_m[:, 2]))
        down = -float(pose.world_from_camera[2, 2])
        if is_above and down > 0.0 and chi2 <= _MAX_MEAN_CHI2 * len(images):
            tilt_deg = math.degrees(math.acos(min(1.0, down)))
            yield chi2 + (tilt_deg / _TILT_SD_DEG) ** 2


def _starts(camera: Camera, images: PointImages) -> Iterator[CameraPose]:
    """Yield poses from three marks with which the others roughly agree."""
    rays, count = camera.undistort(images.pixels), len(images)
    for triple in _triples(count):
        for pose in three_point_poses(images.positions_m[triple], rays[triple]):
            points_m = pose.in_camera(images.positions_m)
            if np.any(points_m[:, 2] <= 0.0):
                continue
            residuals_px = camera.project(points_m) - images.pixels
            if np.max(np.abs(residuals_px)) < _START_SHARE * camera.width:
                yield pose


def _triples(count: int) -> list[list[int]]:
    """Return triples of consecutive marks."""
    firsts = range(1 if count == 3 else min(count, _MAX_TRIPLES))
    return [[(first + offset) % count for offset in range(3)] for first in firsts]
