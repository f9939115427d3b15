"""Distances between the centroids of discs' images and the images of their centres, for reports.

There are two causes, separated as in figures 5 and 6 of ISPRS Archives XXXVII-B1 (2008).
Perspective displaces the centroid by (R²/f) ½ sin 2θ; distortion that varies within the marker
displaces it further. Both were neglected there. `parameters_if_neglected` returns the effect on an
adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_images, eccentricity

_ANGLES_DEG = np.arange(0.0, 76.0, 2.5)
_MARGIN = 0.04  # least distance of discs from the border, in frame widths
_COLUMNS = 13  # of the grid of discs over the frame


@dataclass(frozen=True, slots=True)
class MedianAndMax:
    """Median and largest of one quantity of some discs."""

    median: float
    largest: float

    @classmethod
    def of(cls, values: FloatArray) -> MedianAndMax:
        """Summarise values; NaN are ignored."""
        return cls(float(np.nanmedian(values)), float(np.nanmax(values)))


@dataclass(frozen=True, slots=True)
class EccentricitySummary:
    """One line of the table: a lens and its photographs."""

    focal_px: float
    radius_px: MedianAndMax  # of the images of the discs
    tilt_deg: MedianAndMax  # of the discs against the viewing rays
    perspective_px: MedianAndMax  # eccentricity with an ideal lens
    in_marker_px: MedianAndMax  # eccentricity by distortion that varies within the marker


def summarise_eccentricity(camera: Camera, circles: Circles3D) -> EccentricitySummary:
    """Return median and largest of all discs of all photographs.

    Parameters
    ----------
    circles : Circles3D
        In the camera frames of their photographs.
    """
    split = eccentricity(camera, circles)
    radius_px = np.sqrt(circle_images(camera, circles).area_px2 / np.pi)
    return EccentricitySummary(
        camera.mean_focal_px,
        MedianAndMax.of(radius_px),
        MedianAndMax.of(tilts_deg(circles)),
        MedianAndMax.of(np.linalg.norm(split.perspective_px, axis=1)),
        MedianAndMax.of(np.linalg.norm(split.in_marker_px, axis=1)),
    )


def tilts_deg(circles: Circles3D) -> FloatArray:
    """Return the angles (n,) between the normals of circles and the rays to their centres [deg]."""
    normals = np.cross(circles.axes[..., 0], circles.axes[..., 1])
    rays = circles.centres_m / np.linalg.norm(circles.centres_m, axis=1, keepdims=True)
    cosines = np.minimum(np.abs(np.sum(normals * rays, axis=1)), 1.0)
    return np.asarray(np.degrees(np.arccos(cosines)))


def eccentricity_over_angle(camera: Camera, radius_px: float) -> tuple[FloatArray, FloatArray]:
    """Return viewing angles (n,) [deg] and the eccentricity by perspective there (n,) [px].

    Parameters
    ----------
    radius_px : float
        Of the image of the disc seen frontally in the middle of the frame.
    """
    tilts = np.radians(_ANGLES_DEG)
    normals = np.column_stack((np.sin(tilts), np.zeros_like(tilts), np.cos(tilts)))
    radii = np.full(len(tilts), radius_px / camera.mean_focal_px)
    centres = np.tile([0.0, 0.0, 1.0], (len(tilts), 1))
    split = eccentricity(camera, Circles3D.with_normals(centres, normals, radii))
    return _ANGLES_DEG, np.linalg.norm(split.perspective_px, axis=1)


def displacement_over_frame(camera: Camera, radius_px: float) -> tuple[FloatArray, FloatArray]:
    """Return places (n, 2) and the displacements (n, 2) of discs' centroids by distortion [px].

    The discs are perpendicular to the optical axis. Pixels without a ray are left out.

    Parameters
    ----------
    radius_px : float
        Of the discs' images in the middle of the frame.
    """
    rows = max(2, round(_COLUMNS * camera.height / camera.width))
    margin = _MARGIN * camera.width
    x = np.linspace(margin, camera.width - 1.0 - margin, _COLUMNS)
    y = np.linspace(margin, camera.height - 1.0 - margin, rows)
    normalised = camera.undistort(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    normalised = normalised[np.isfinite(normalised).all(axis=1)]
    centres = np.column_stack((normalised, np.ones(len(normalised))))
    normals = np.tile([0.0, 0.0, 1.0], (len(centres), 1))
    radii = np.full(len(centres), radius_px / camera.mean_focal_px)
    split = eccentricity(camera, Circles3D.with_normals(centres, normals, radii))
    return split.centres_px, split.in_marker_px


def parameters_if_neglected(
    jacobian: FloatArray, weights: FloatArray, shifts_px: FloatArray
) -> FloatArray:
    """Return the changes of an adjustment's parameters (p,) if discs' centres are shifted.

    They follow from one linear step: (JᵀWJ)⁻¹ JᵀW δ.

    Parameters
    ----------
    jacobian : (m, p) array
        Derivatives of all image coordinates.
    weights : (m,) array
        Inverse variances of the image coordinates.
    shifts_px : (m,) array
        Neglected shifts, such as `Eccentricity.total_px`.
    """
    root = np.sqrt(weights)
    scale = np.linalg.norm(jacobian * root[:, None], axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = jacobian * root[:, None] / scale
    return np.asarray(np.linalg.lstsq(scaled, root * shifts_px, rcond=1e-12)[0] / scale)
