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

# What discs are off besides their noise, by lens and board: as little as usual, then much. Of more,
# most discs would be left out as wrongly named.
_BEYOND_NOISE_PX = (0.05, 0.5)
_ROUNDS, _SETTLED = 8, 0.05  # of eccentricities and noise; relative change of the noise


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
        Discs of the field that were measured, and those that agree.
    rms_px : float
        Of the residuals of these, per coordinate.
    radius_scale : float
        Radii of the discs in the image, over those that the field's diameters have in this pose.
    """

    pose: CameraPose
    cov: FloatArray
    discs: int
    discs_used: int
    rms_px: float
    radius_scale: float

    @property
    def in_words(self) -> str:
        """How well it fits."""
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

    Centroids are reduced by their eccentricity, through the lens. How far discs are off beyond
    their noise is estimated from the residuals.

    Parameters
    ----------
    point : (k,) array
        Which of the field's discs were measured.
    moments : (k, 5) array
        Of their images, as `discs.records.MOMENTS`.
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
    found = _first(camera, images, has_free_focal=has_free_focal)
    beyond_px = math.nan
    for _ in range(_ROUNDS):
        pose = found.pose
        circles = Circles3D(pose.in_camera(positions_m), pose.world_from_camera.T @ axes, radii_m)
        # both grow with the focal length
        off_px = pose.focal_scale * eccentricity(camera, circles).total_px
        sizes_px = pose.focal_scale * _sizes_px(circle_images(camera, circles).moments)
        before_px, beyond_px = beyond_px, _beyond_noise_px(camera, images, found)
        images = replace(images, pixels=places - off_px)
        found = _oriented(camera, images, beyond_px, has_free_focal=has_free_focal)
        if abs(beyond_px - before_px) <= _SETTLED * beyond_px:
            break
    if has_free_focal and not math.sqrt(found.cov[6, 6]) <= FOCAL_DETERMINED:
        sd = 100.0 * math.sqrt(found.cov[6, 6])
        raise NoPoseError(f"the focal length is not determined (± {sd:.0f} %)")
    rms_px = float(np.sqrt(np.mean(found.residuals[found.is_used, :2] ** 2)))
    used = int(np.count_nonzero(found.is_used))
    radius_scale = float(np.median((_sizes_px(moments) / sizes_px)[found.is_used]))
    return FieldPose(found.pose, found.cov, len(point), used, rms_px, radius_scale)


def _sizes_px(moments: FloatArray) -> FloatArray:
    """Return radii (n,) of circles as large as areas with these moments (n, 5)."""
    xx, xy, yy = moments[:, 2:].T
    return np.asarray(2.0 * (xx * yy - xy**2) ** 0.25)


def _first(camera: Camera, images: PointImages, *, has_free_focal: bool) -> Resection:
    problem = NoPoseError("")
    for beyond_px in _BEYOND_NOISE_PX:
        try:
            return _oriented(camera, images, beyond_px, has_free_focal=has_free_focal)
        except NoPoseError as error:
            problem = error
    raise problem


def _oriented(
    camera: Camera, images: PointImages, beyond_px: float, *, has_free_focal: bool
) -> Resection:
    cov = images.pixel_cov + beyond_px**2 * np.eye(2)
    return orient(
        camera,
        replace(images, pixel_cov=cov),
        focals=FOCAL_SCALES if has_free_focal else (1.0,),
        sd_focal=SD_FOCAL if has_free_focal else 0.0,
    )


def _beyond_noise_px(camera: Camera, images: PointImages, found: Resection) -> float:
    """Return by how much more than their noise the discs that agree are off, per coordinate."""
    kept = images.chosen(found.is_used)
    numbers = 2 * len(kept)
    # what the unknowns have not taken up of the squares
    share = max(1.0 - len(found.cov) / numbers, 0.1)
    off2 = float(np.sum(found.residuals[found.is_used, :2] ** 2)) / share
    stated2 = float(np.trace(kept.pixel_cov.sum(axis=0))) + _by_positions(camera, kept, found.pose)
    return math.sqrt(max(off2 - stated2, 0.0) / numbers)


def _by_positions(camera: Camera, images: PointImages, pose: CameraPose) -> float:
    """Return the variances in the image, summed, that the points' positions account for [px²]."""
    distance_m = np.linalg.norm(pose.in_camera(images.positions_m), axis=1)
    scale = pose.focal_scale * camera.mean_focal_px / distance_m
    across_m2 = 2.0 / 3.0 * np.trace(images.position_cov, axis1=1, axis2=2)
    return float(np.sum(scale**2 * across_m2))
