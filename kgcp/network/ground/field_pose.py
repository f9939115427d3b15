"""The exterior orientation of one photograph of a field of discs, in the field's own frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_images, eccentricity, plane_axes
from kgcp.network.ground.frame_poses import FOCAL_DETERMINED, FOCAL_SCALES, SD_FOCAL
from kgcp.network.ground.point_images import CameraPose, PointImages, Readout
from kgcp.network.ground.resection import NoPoseError, Resection, orient
from kgcp.targets.fields.points import AnyField

# Errors of the discs beyond their noise, by lens and board: start values, first a usual one, then a
# large one. If the value is too small, most discs are left out as wrongly named.
_START_EXTRA_PX = (0.05, 0.5)
# Rounds of updating eccentricities and extra noise, and the relative change of the noise that ends
# them.
_MAX_ROUNDS, _SETTLED = 8, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class FieldPose:
    """A camera oriented in a field's frame.

    Attributes
    ----------
    pose : CameraPose
        With the focal length's scale.
    cov : (6, 6) or (7, 7) array
        As of `Resection`.
    discs, discs_used : int
        Numbers of discs that were measured, and of those that agree.
    rms_px : float
        RMS of the residuals of the latter, per coordinate.
    radius_scale : float
        Median ratio of the discs' measured radii to those expected from the field's diameters.
    """

    pose: CameraPose
    cov: FloatArray
    discs: int
    discs_used: int
    rms_px: float
    radius_scale: float

    @property
    def in_words(self) -> str:
        """The quality of the fit."""
        return f"RMS {self.rms_px:.3f} px, {self.discs_used} of {self.discs} discs"


def orient_by_field(
    camera: Camera,
    field: AnyField,
    point: IndexArray,
    moments: FloatArray,
    covs: FloatArray,
    *,
    has_free_focal: bool = False,
) -> FieldPose:
    """Return the camera's pose in the frame of a field.

    Centroids are corrected for eccentricity, including distortion. Errors of the discs beyond their
    noise are estimated from the residuals.

    Parameters
    ----------
    point : (k,) array
        Indices of the measured discs in the field.
    moments : (k, 5) array
        Moments of their images, as `discs.records.MOMENTS`.
    covs : (k, 5, 5) array
    has_free_focal : bool
        Whether the focal length is unknown, to a factor of two.

    Raises
    ------
    NoPoseError
        As `orient`, and if the focal length is not determined.
    """
    places, place_cov = moments[:, :2], covs[:, :2, :2]
    positions_m, axes = field.points_m()[point], plane_axes(field.normals()[point])
    radii_m, unknown = field.radii_m()[point], np.full(len(point), np.nan)
    position_cov = field.point_sds_m()[point, :, None] ** 2 * np.eye(3)
    readout = Readout.of(camera, places)
    images = PointImages(
        positions_m, position_cov, places, place_cov, unknown, unknown, readout=readout
    )
    resection = _first(camera, images, has_free_focal=has_free_focal)
    extra_px = math.nan
    for _ in range(_MAX_ROUNDS):
        pose = resection.pose
        circles = Circles3D(pose.in_camera(positions_m), pose.world_from_camera.T @ axes, radii_m)
        # eccentricity and size are proportional to the focal length
        offsets_px = pose.focal_scale * eccentricity(camera, circles).total_px
        expected_px = pose.focal_scale * _radii_px(circle_images(camera, circles).moments)
        before_px, extra_px = extra_px, _extra_noise_px(camera, images, resection)
        images = replace(images, pixels=places - offsets_px)
        resection = _oriented(camera, images, extra_px, has_free_focal=has_free_focal)
        if abs(extra_px - before_px) <= _SETTLED * extra_px:
            break
    if has_free_focal and not math.sqrt(resection.cov[6, 6]) <= FOCAL_DETERMINED:
        sd = 100.0 * math.sqrt(resection.cov[6, 6])
        raise NoPoseError(f"the focal length is not determined (± {sd:.0f} %)")
    rms_px = float(np.sqrt(np.mean(resection.residuals[resection.is_used, :2] ** 2)))
    used = int(np.count_nonzero(resection.is_used))
    radius_scale = float(np.median((_radii_px(moments) / expected_px)[resection.is_used]))
    return FieldPose(resection.pose, resection.cov, len(point), used, rms_px, radius_scale)


def _radii_px(moments: FloatArray) -> FloatArray:
    """Return the radii (n,) of circles with the same area as ellipses with moments (n, 5)."""
    xx, xy, yy = moments[:, 2:].T
    return np.asarray(2.0 * (xx * yy - xy**2) ** 0.25)


def _first(camera: Camera, images: PointImages, *, has_free_focal: bool) -> Resection:
    """Return the resection with the smallest start value of the extra noise that gives one."""
    problem = NoPoseError("")
    for extra_px in _START_EXTRA_PX:
        try:
            return _oriented(camera, images, extra_px, has_free_focal=has_free_focal)
        except NoPoseError as error:
            problem = error
    raise problem


def _oriented(
    camera: Camera, images: PointImages, extra_px: float, *, has_free_focal: bool
) -> Resection:
    cov = images.pixel_cov + extra_px**2 * np.eye(2)
    return orient(
        camera,
        replace(images, pixel_cov=cov),
        focals=FOCAL_SCALES if has_free_focal else (1.0,),
        sd_focal=SD_FOCAL if has_free_focal else 0.0,
    )


def _extra_noise_px(camera: Camera, images: PointImages, resection: Resection) -> float:
    """Return the error of the agreeing discs beyond their stated noise, per coordinate [px]."""
    kept = images.chosen(resection.is_used)
    count = 2 * len(kept)
    # the share of the squared errors that remains in the residuals
    share = max(1.0 - len(resection.cov) / count, 0.1)
    squares_px2 = float(np.sum(resection.residuals[resection.is_used, :2] ** 2)) / share
    stated_px2 = float(np.trace(kept.pixel_cov.sum(axis=0))) + _by_positions(
        camera, kept, resection.pose
    )
    return math.sqrt(max(squares_px2 - stated_px2, 0.0) / count)


def _by_positions(camera: Camera, images: PointImages, pose: CameraPose) -> float:
    """Return the sum of the variances in the image that the points' positions cause [px²]."""
    distance_m = np.linalg.norm(pose.in_camera(images.positions_m), axis=1)
    scale = pose.focal_scale * camera.mean_focal_px / distance_m
    across_m2 = 2.0 / 3.0 * np.trace(images.position_cov, axis1=1, axis2=2)
    return float(np.sum(scale**2 * across_m2))
