"""Marks in a frame that carry each other's names."""

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

_MOST_TRIPLES = 6  # that poses start from: one with right names is enough
_NAMED_TRIPLES = 3  # of these, that get any names: one that is not nearly in a line is enough
_START_SHARE = 0.1  # of the frame's width, that marks may be off a pose from three of them
_LIKELY_CHI2 = 25.0  # of a mark, in the mean, at most
_DOWN_SD_DEG = 10.0  # how far the axis of a camera that looks down is off the vertical
_SIGMAS = 4.0  # that one of three marks may be displaced by


def exchanged_marks(
    places: Mapping[str, MarkedPlace], positions: Mapping[str, TargetPosition], camera: Camera
) -> tuple[str, ...] | None:
    """Return the targets whose marks carry each other's names, as all marks of a frame say it.

    No camera above the targets can see them as they are marked, and one can with these names
    exchanged. Three marks at least tell: exchanged names turn the sense in which they follow each
    other. Three that are nearly in a line do not.

    Parameters
    ----------
    positions : mapping of str to TargetPosition
        Of the marked targets at least, in the ENU frame.
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
    """Return which mark each target may be, where three marks with any names put the camera."""
    rays, count = camera.undistort(images.pixels), len(images)
    orders = set()
    for triple, named in product(_triples(count)[:_NAMED_TRIPLES], permutations(range(count), 3)):
        for pose in three_point_poses(images.positions_m[list(named)], rays[triple]):
            points_m = pose.in_camera(images.positions_m)
            if np.any(points_m[:, 2] <= 0.0):
                continue
            off_px = np.abs(camera.project(points_m)[:, None] - images.pixels).max(axis=2)
            targets, marks = linear_sum_assignment(off_px)
            if off_px[targets, marks].max() < _START_SHARE * camera.width:
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
    """Yield the marks; of three, which no adjustment smooths, also with one of them displaced."""
    yield images
    if len(images) > 3:
        return
    for mark, axis in np.ndindex(3, 2):
        for sigmas in (-_SIGMAS, _SIGMAS):
            pixels = images.pixels.copy()
            pixels[mark, axis] += sigmas * math.sqrt(float(images.pixel_cov[mark, axis, axis]))
            yield replace(images, pixels=pixels)


def _misfits(camera: Camera, images: PointImages) -> Iterator[float]:
    """Yield the misfits of poses that see the marks as they are, from above; tilt counts, too."""
    for start in _starts(camera, images):
        pose, chi2 = start, 0.0
        if len(images) > 3:
            adjusted = adjusted_pose(camera, images, start, 0.0)
            if adjusted is None:
                continue
            pose, off_px = adjusted[0], adjusted[2][:, :2]
            chi2 = float(np.sum(off_px**2 / images.pixel_cov[:, :1, 0]))
        is_above = bool(np.all(pose.centre_m[2] > images.positions_m[:, 2]))
        down = -float(pose.world_from_camera[2, 2])
        if is_above and down > 0.0 and chi2 <= _LIKELY_CHI2 * len(images):
            tilt_deg = math.degrees(math.acos(min(1.0, down)))
            yield chi2 + (tilt_deg / _DOWN_SD_DEG) ** 2


def _starts(camera: Camera, images: PointImages) -> Iterator[CameraPose]:
    """Yield poses of three marks that the others roughly agree with."""
    rays, count = camera.undistort(images.pixels), len(images)
    for triple in _triples(count):
        for pose in three_point_poses(images.positions_m[triple], rays[triple]):
            points_m = pose.in_camera(images.positions_m)
            if np.any(points_m[:, 2] <= 0.0):
                continue
            off_px = camera.project(points_m) - images.pixels
            if np.max(np.abs(off_px)) < _START_SHARE * camera.width:
                yield pose


def _triples(count: int) -> list[list[int]]:
    """Return threes of marks that follow each other."""
    firsts = range(1 if count == 3 else min(count, _MOST_TRIPLES))
    return [[(first + each) % count for each in range(3)] for first in firsts]
