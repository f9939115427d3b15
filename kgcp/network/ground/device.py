"""EO devices: a few points that are identified by their geometry alone.

A device has four to eight points in its own frame, mostly five with one out of plane. Their images
have no names. Three image points are assigned to every ordered triple of the device's points, which
gives poses (P3P); the other points are projected and assigned. The best permutations are adjusted,
together with the focal length if it is only roughly known. The one with the smallest residuals
counts if these are by far the smallest.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.attitude import rotation_onto
from kgcp.geometry.camera import Camera
from kgcp.network.ground.point_images import CameraPose, PointImages, Readout
from kgcp.network.ground.pose_adjustment import adjusted_pose
from kgcp.network.ground.pose_hypotheses import three_point_poses
from kgcp.network.ground.resection import NoPoseError

DEVICE_MARGIN = 3.0
"""Least ratio of the RMS of the next best permutation to that of the best one."""

LEAST_POINTS, MOST_POINTS = 4, 8
_MAX_COORDINATE_M = 1000.0
_SAME = 0.03  # distances that differ by less, relative to the device's size, count as equal
_FOCAL_SIGMAS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # start values, in standard deviations of the logarithm
_MAX_REFINED = 12  # permutations that are adjusted, the best ones first
# Largest RMS of the residuals: relative to the device's size in the image, or in pixels if that is
# more. The first corresponds to 0.5 mm in each of the positions of a device of 0.3 m. The second is
# more than displaced edges of discs cause. If a device is mirrored or its axes are exchanged, the
# RMS is 0.1 to 1 % of the size.
_MAX_RMS, _MAX_RMS_PX = 0.001, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class DevicePose:
    """A camera oriented in a device's frame.

    Attributes
    ----------
    pose : CameraPose
        With the focal length's scale.
    cov : (6, 6) or (7, 7) array
        As of `Resection`, times the residuals' variance factor if that is above 1.
    names : (n,) array
        Index of each image point among the device's points.
    rms_px : float
        RMS of the residuals, per coordinate.
    margin : float
        RMS of the next best permutation over this one's, which counts as at least the stated
        standard deviation.
    """

    pose: CameraPose
    cov: FloatArray
    names: IndexArray
    rms_px: float
    margin: float

    @property
    def in_words(self) -> str:
        """The quality of the fit."""
        return f"RMS {self.rms_px:.3f} px, margin {self.margin:.0f}"


def require_distinct(points_m: FloatArray) -> None:
    """Refuse a device (n, 3) that looks the same with some of its points exchanged.

    Raises
    ------
    SettingError
        If the device has too few or too many points, or a symmetry: a rotation that maps the points
        to each other. The message names the points.
    """
    count = len(points_m)
    if not LEAST_POINTS <= count <= MOST_POINTS:
        raise SettingError("device", f"has {count} points", f"give {LEAST_POINTS} to {MOST_POINTS}")
    if not np.abs(points_m).max() <= _MAX_COORDINATE_M:
        raise SettingError(
            "device",
            f"has a point farther than {_MAX_COORDINATE_M:g} m",
            "give positions in metres",
        )
    gaps = np.linalg.norm(points_m[:, None] - points_m[None], axis=-1)
    size = float(gaps.max())
    orders = np.array(list(itertools.permutations(range(count))))[1:]
    change = np.abs(gaps[orders[:, :, None], orders[:, None, :]] - gaps).max(axis=(1, 2))
    for order in orders[change <= _SAME * size]:
        if _misfit(points_m, points_m[order]) <= _SAME * size:
            exchanged = [str(i + 1) for i in np.flatnonzero(order != np.arange(count)).tolist()]
            raise SettingError(
                "device",
                f"looks the same with its points {', '.join(exchanged)} exchanged",
                "move one of them: distances must differ by more than 3 % of the device's size",
            )


def _misfit(points_m: FloatArray, others_m: FloatArray) -> float:
    """Return the largest distance between points and others after rotating them onto these."""
    centred, others = points_m - points_m.mean(axis=0), others_m - others_m.mean(axis=0)
    rotated = centred @ rotation_onto(points_m, others_m).T
    return float(np.linalg.norm(rotated - others, axis=1).max())


def orient_by_device(
    camera: Camera,
    points_m: FloatArray,
    pixels: FloatArray,
    pixel_cov: FloatArray,
    *,
    sd_focal: float = 0.0,
) -> DevicePose:
    """Return the camera's pose in the frame of a device, and the identity of the image points.

    Parameters
    ----------
    points_m : (n, 3) array
        Points of the device; see `require_distinct`.
    pixels : (n, 2) array
        Images of all of them, in any order.
    pixel_cov : (n, 2, 2) array
    sd_focal : float
        Relative standard deviation of the focal length; 0: it is known.

    Raises
    ------
    NoPoseError
        If no permutation has a pose with all points in front of the camera, the best one does not
        fit well, or the next best one fits nearly as well.
    """
    starts = _starts(camera, points_m, pixels, sd_focal)
    fits = []
    for names, start in starts[:_MAX_REFINED]:
        images = _named(camera, points_m[list(names)], pixels, pixel_cov)
        adjusted = adjusted_pose(camera, images, start, sd_focal)
        if adjusted is not None:
            pose, cov, residuals = adjusted
            cov = cov * _variance_factor(residuals[:, :2], pixel_cov, len(cov))
            fits.append((float(np.sqrt(np.mean(residuals[:, :2] ** 2))), names, pose, cov))
    if not fits:
        raise NoPoseError("no permutation of the device's points fits")
    fits.sort(key=lambda fit: fit[0])
    rms, names, pose, cov = fits[0]
    floor = math.sqrt(float(np.mean(np.trace(pixel_cov, axis1=1, axis2=2))) / 2.0)
    margin = fits[1][0] / max(rms, floor) if len(fits) > 1 else math.inf
    if margin < DEVICE_MARGIN:
        raise NoPoseError(
            f"two permutations of the device's points fit alike (margin {margin:.1f})"
        )
    most_px = max(_MAX_RMS_PX, _MAX_RMS * float(np.linalg.norm(np.ptp(pixels, axis=0))))
    if rms > most_px:
        raise NoPoseError(
            f"the discs do not fit the device (RMS {rms:.2f} px, at most {most_px:.2f}); look at"
            " the positions of its points, and whether its axes are right-handed"
        )
    return DevicePose(pose, cov, np.array(names), rms, margin)


def _variance_factor(residuals_px: FloatArray, pixel_cov: FloatArray, unknowns: int) -> float:
    """Return the variance factor of residuals (n, 2), at least 1."""
    weighted = np.linalg.solve(pixel_cov, residuals_px[..., None])[..., 0]
    return max(1.0, float(np.sum(residuals_px * weighted)) / (residuals_px.size - unknowns))


def _named(
    camera: Camera, positions_m: FloatArray, pixels: FloatArray, pixel_cov: FloatArray
) -> PointImages:
    unknown = np.full(len(pixels), np.nan)
    exact = np.zeros((len(pixels), 3, 3))
    readout = Readout.of(camera, pixels)
    return PointImages(positions_m, exact, pixels, pixel_cov, unknown, unknown, readout=readout)


def _starts(
    camera: Camera, points_m: FloatArray, pixels: FloatArray, sd_focal: float
) -> list[tuple[tuple[int, ...], CameraPose]]:
    """Return permutations (the device's point of each image point) with a pose, best ones first."""
    count = len(pixels)
    triple = _widest(pixels)
    others = [i for i in range(count) if i not in triple]
    best: dict[tuple[int, ...], tuple[float, CameraPose]] = {}
    for chosen, pose in _poses_of_triple(camera, points_m, pixels[triple], sd_focal):
        in_camera = pose.in_camera(points_m)
        if not np.all(in_camera[:, 2] > 0.0):
            continue
        projected = pose.focal_scale * in_camera[:, :2] / in_camera[:, 2:]
        gaps = projected[:, None] - camera.undistort(pixels)[others]
        costs = np.sum(gaps**2, axis=2) / pose.focal_scale
        unassigned = [i for i in range(count) if i not in chosen]
        for order in itertools.permutations(unassigned):
            names = np.empty(count, dtype=np.intp)
            names[triple], names[others] = chosen, order
            key = tuple(names.tolist())
            misfit = float(costs[list(order), range(len(others))].sum())
            if key not in best or misfit < best[key][0]:
                best[key] = (misfit, pose)
    ordered = sorted(best.items(), key=lambda item: (item[1][0], item[0]))
    return [(names, pose) for names, (_, pose) in ordered]


def _poses_of_triple(
    camera: Camera, points_m: FloatArray, pixels: FloatArray, sd_focal: float
) -> Iterator[tuple[tuple[int, ...], CameraPose]]:
    """Yield ordered triples of the device's points with poses that image them at pixels (3, 2)."""
    focals = [math.exp(sd_focal * step) for step in _FOCAL_SIGMAS] if sd_focal else [1.0]
    for focal in focals:
        rays = camera.undistort(pixels) / focal
        for chosen in itertools.permutations(range(len(points_m)), 3):
            for start in three_point_poses(points_m[list(chosen)], rays):
                yield chosen, CameraPose(start.centre_m, start.world_from_camera, focal)


def _widest(pixels: FloatArray) -> list[int]:
    """Return the three image points with the largest triangle."""
    triples = np.array(list(itertools.combinations(range(len(pixels)), 3)))
    first, second = (pixels[triples[:, i]] - pixels[triples[:, 0]] for i in (1, 2))
    areas = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    widest: list[int] = triples[int(np.argmax(areas))].tolist()
    return widest
