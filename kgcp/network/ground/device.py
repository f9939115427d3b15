"""EO devices: a few points whose own geometry tells which is which.

A device has four to eight points in its own frame, mostly five with one out of plane. Their images
have no names. Three image points are taken for every ordered three of the device's points (P3P),
the rest is projected and assigned. The best permutations are adjusted, with the focal length if it
is known roughly only. The one with the smallest residuals is taken, if it is by far the smallest.
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
"""RMS of the next best permutation over that of the best, from which on the best counts."""

LEAST_POINTS, MOST_POINTS = 4, 8
_FARTHEST_M = 1000.0
_ALIKE = 0.03  # of the device's size: distances that differ by less are the same
_FOCALS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # starts, in standard deviations of the logarithm
_REFINED = 12  # permutations that are adjusted
# RMS of the residuals, at most: of the device's size in the image, which is 0.5 mm of 0.3 m in
# every place; what discs are off by their edges is less than the floor. A device that is mirrored,
# or whose axes are exchanged, is off by 0.1 to 1 %.
_MOST_RMS, _MOST_RMS_FLOOR_PX = 0.001, 0.1


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
        Which point of the device each image point is.
    rms_px : float
        Of the residuals, per coordinate.
    margin : float
        RMS of the next best permutation over this one's, which counts as no smaller than the
        stated deviation.
    """

    pose: CameraPose
    cov: FloatArray
    names: IndexArray
    rms_px: float
    margin: float

    @property
    def in_words(self) -> str:
        """How well it fits."""
        return f"RMS {self.rms_px:.3f} px, margin {self.margin:.0f}"


def require_distinct(points_m: FloatArray) -> None:
    """Refuse a device (n, 3) that looks the same with its points exchanged.

    Raises
    ------
    SettingError
        Naming the points, if the device has too few, too many, or a symmetry: a turn that brings
        all points to places of others.
    """
    count = len(points_m)
    if not LEAST_POINTS <= count <= MOST_POINTS:
        raise SettingError("device", f"has {count} points", f"give {LEAST_POINTS} to {MOST_POINTS}")
    if not np.abs(points_m).max() <= _FARTHEST_M:
        raise SettingError(
            "device", f"has a point farther than {_FARTHEST_M:g} m", "give positions in metres"
        )
    gaps = np.linalg.norm(points_m[:, None] - points_m[None], axis=-1)
    size = float(gaps.max())
    orders = np.array(list(itertools.permutations(range(count))))[1:]
    change = np.abs(gaps[orders[:, :, None], orders[:, None, :]] - gaps).max(axis=(1, 2))
    for order in orders[change <= _ALIKE * size]:
        if _misfit(points_m, points_m[order]) <= _ALIKE * size:
            moved = [str(i + 1) for i in np.flatnonzero(order != np.arange(count)).tolist()]
            raise SettingError(
                "device",
                f"looks the same with its points {', '.join(moved)} exchanged",
                "move one of them: distances must differ by more than 3 % of the device's size",
            )


def _misfit(points_m: FloatArray, others_m: FloatArray) -> float:
    """Return the largest distance of points that are turned, but not mirrored, onto others."""
    here, there = points_m - points_m.mean(axis=0), others_m - others_m.mean(axis=0)
    turned = here @ rotation_onto(points_m, others_m).T
    return float(np.linalg.norm(turned - there, axis=1).max())


def orient_by_device(
    camera: Camera,
    points_m: FloatArray,
    pixels: FloatArray,
    pixel_cov: FloatArray,
    *,
    sd_focal: float = 0.0,
) -> DevicePose:
    """Return the camera's pose in the frame of a device, and which point is which.

    Parameters
    ----------
    points_m : (n, 3) array
        Points of the device; see `require_distinct`.
    pixels : (n, 2) array
        Their images, in any order.
    pixel_cov : (n, 2, 2) array
    sd_focal : float
        Relative standard deviation of the focal length; 0: it is known.

    Raises
    ------
    NoPoseError
        If no permutation fits before the camera, the best does not fit well, or the next best fits
        nearly as well.
    """
    starts = _starts(camera, points_m, pixels, sd_focal)
    fits = []
    for names, start in starts[:_REFINED]:
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
    most_px = max(_MOST_RMS_FLOOR_PX, _MOST_RMS * float(np.linalg.norm(np.ptp(pixels, axis=0))))
    if rms > most_px:
        raise NoPoseError(
            f"the discs do not fit the device (RMS {rms:.2f} px, at most {most_px:.2f}); look at"
            " the positions of its points, and whether its axes are right-handed"
        )
    return DevicePose(pose, cov, np.array(names), rms, margin)


def _variance_factor(residuals_px: FloatArray, pixel_cov: FloatArray, unknowns: int) -> float:
    """Return by how much residuals (n, 2) have larger variances than stated; at least 1."""
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
    """Return permutations (device's point of each image point) with a pose, likely ones first."""
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
        left = [i for i in range(count) if i not in chosen]
        for order in itertools.permutations(left):
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
    """Yield the poses in which ordered threes of the device are seen at three pixels (3, 2)."""
    focals = [math.exp(sd_focal * step) for step in _FOCALS] if sd_focal else [1.0]
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
