"""Circles seen through a lens: moments of their images, and how far these are from the centre.

The image of a circle is an ellipse only before the lens distorts it, and the ellipse's centre is
not the image of the circle's centre (Otepka & Fraser 2004). Both effects are exact here: the
outline is projected point by point, and Green's theorem turns integrals over the area into
integrals along it. The outline is a smooth periodic curve, so that equal steps of the angle
converge exponentially: 32 points give a circle of usual size to 1e-10 px.

An outline that is displaced by δ changes ∫ f dA by ∮ f (δ_x dy − δ_y dx). All derivatives follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.geometry.calibration import image_by_calibration
from kgcp.geometry.camera import Camera

OUTLINE_POINTS = 32  # along an outline
_ANGLES = 2.0 * np.pi / OUTLINE_POINTS * np.arange(OUTLINE_POINTS)
_UNIT_CIRCLE = np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES)))


def _fourier_slopes(count: int) -> FloatArray:
    """Return the matrix (k, k) that differentiates periodic values at k equal steps of 2π/k."""
    lag = np.subtract.outer(np.arange(count), np.arange(count))
    sign = np.where(lag % 2 == 0, 0.5, -0.5)
    with np.errstate(divide="ignore"):
        return np.where(lag == 0, 0.0, sign / np.tan(np.pi * lag / count))


_SLOPES = _fourier_slopes(OUTLINE_POINTS)
_STEP = 2.0 * np.pi / OUTLINE_POINTS
_LEAST_AREA = 1e-20  # px², or of the normalised plane: rounding of coordinates has as much


def plane_axes(normals: FloatArray) -> FloatArray:
    """Return two perpendicular unit vectors (n, 3, 2) square to each of n unit vectors (n, 3)."""
    turns = cross_matrix(normals)
    first = np.where(np.abs(normals[:, :1]) < 0.9, turns[..., 0], turns[..., 1])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, (turns @ first[..., None])[..., 0]), axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Circles3D:
    """n circles in the camera frame."""

    centres_m: FloatArray  # (n, 3)
    # (n, 3, 2): two perpendicular unit vectors of each circle's plane, as columns
    axes: FloatArray
    radii_m: FloatArray  # (n,)

    @classmethod
    def with_normals(
        cls, centres_m: FloatArray, normals: FloatArray, radii_m: FloatArray
    ) -> Circles3D:
        """Return circles square to unit normals (n, 3)."""
        return cls(centres_m, plane_axes(normals), radii_m)

    def arms_m(self) -> FloatArray:
        """Return points (n, k, 3) of the circles, from their centres [m]."""
        arms = np.einsum("nij,kj->nki", self.axes, _UNIT_CIRCLE)
        return np.asarray(self.radii_m[:, None, None] * arms)


@dataclass(frozen=True, slots=True, eq=False)
class CircleImages:
    """Images of n circles in raw pixels."""

    area_px2: FloatArray  # (n,)
    # (n, 5): centroid x, y [px] and second moments of the area xx, xy, yy [px²]
    moments: FloatArray
    outlines_px: FloatArray  # (n, k, 2)


@dataclass(frozen=True, slots=True, eq=False)
class CircleSlopes:
    """The moments of n circles' images, and their derivatives."""

    moments: FloatArray  # (n, 5): as `CircleImages`
    by_centre: FloatArray  # (n, 5, 3): of the circle's centre in the camera frame [m]
    # (n, 5, 3): by a rotation vector of its plane about its own centre, camera frame [rad]
    by_rotation: FloatArray
    by_radius: FloatArray  # (n, 5) [1/m]


@dataclass(frozen=True, slots=True, eq=False)
class Eccentricity:
    """How far the centroids of n circles' images are from the images of their centres.

    centroid = image of the centre + perspective + in_marker.
    """

    centres_px: FloatArray  # (n, 2): images of the circles' centres
    # (n, 2): distorted centre of the undistorted ellipse − image of the circle's centre
    perspective_px: FloatArray
    # (n, 2): centroid of the distorted outline − distorted centre of the undistorted ellipse:
    # distortion that changes within the marker
    in_marker_px: FloatArray

    @property
    def total_px(self) -> FloatArray:
        """Both together (n, 2): what to subtract from a centroid to have the centre's image."""
        return self.perspective_px + self.in_marker_px


def circle_images(camera: Camera, circles: Circles3D) -> CircleImages:
    """Return outlines, areas and moments of circles' images; NaN of those that have none.

    They must be wholly before the camera, and not endlessly far.

    Parameters
    ----------
    camera : Camera
        With its distortion, which acts on every point of the outline.
    circles : Circles3D
        In the camera frame.
    """
    outlines = _distorted(camera, _outlines(circles))
    area, moments = _moments(outlines)
    return CircleImages(area, moments, outlines)


def circle_slopes(camera: Camera, circles: Circles3D) -> CircleSlopes:
    """Return the moments of `circle_images` and their derivatives, analytically."""
    arms = circles.arms_m()
    points = circles.centres_m[:, None] + arms
    normalised = _outlines(circles)
    outlines = _distorted(camera, normalised)
    area, moments = _moments(outlines)
    weights = _boundary_weights(outlines, area, moments)
    x, y = normalised[..., 0], normalised[..., 1]
    projection = np.zeros((*x.shape, 2, 3))
    projection[..., 0, 0] = projection[..., 1, 1] = 1.0
    projection[..., 0, 2], projection[..., 1, 2] = -x, -y
    projection /= points[..., 2, None, None]
    by_point = camera.distort_jacobian(normalised) @ projection
    # a turn ω moves an arm a by ω × a, hence g · (ω × a) = ω · (a × g)
    by_turn = by_point @ cross_matrix(-arms)
    by_radius = by_point @ (arms / circles.radii_m[:, None, None])[..., None]
    return CircleSlopes(
        moments,
        _along_outlines(weights, by_point),
        _along_outlines(weights, by_turn),
        _along_outlines(weights, by_radius)[..., 0],
    )


def moments_by_calibration(camera: Camera, circles: Circles3D) -> FloatArray:
    """Return the derivatives (n, 5, 12) of the moments by `CALIBRATION_PARAMETERS`."""
    normalised = _outlines(circles)
    outlines = _distorted(camera, normalised)
    weights = _boundary_weights(outlines, *_moments(outlines))
    by_camera = image_by_calibration(camera, normalised.reshape(-1, 2))
    return _along_outlines(weights, by_camera.reshape(*normalised.shape, -1))


def _along_outlines(weights: FloatArray, by_point: FloatArray) -> FloatArray:
    """Return derivatives (n, 5, p) of moments from those of the outlines' points (n, k, 2, p)."""
    count, points = weights.shape[:2]
    flat = weights.transpose(0, 2, 1, 3).reshape(count, 5, 2 * points)
    return np.asarray(flat @ by_point.reshape(count, 2 * points, -1))


def eccentricity(camera: Camera, circles: Circles3D) -> Eccentricity:
    """Return how far centroids of circles' images are from their centres, by cause.

    Two causes, as in figures 5 and 6 of ISPRS Archives XXXVII-B1 (2008): the perspective's part is
    what an ideal lens would show (Dold 1997), carried through the distortion at the ellipse's
    centre; the rest is distortion that changes within the marker.
    """
    ideal = _outlines(circles)
    ellipse_centres = _moments(ideal)[1][:, :2]
    projected = circles.centres_m[:, :2] / circles.centres_m[:, 2:]
    points = np.concatenate((projected[:, None], ellipse_centres[:, None], ideal), axis=1)
    distorted = _distorted(camera, points)
    centres, middles = distorted[:, 0], distorted[:, 1]
    centroids = _moments(distorted[:, 2:])[1][:, :2]
    return Eccentricity(centres, middles - centres, centroids - middles)


def _outlines(circles: Circles3D) -> FloatArray:
    """Return normalised points (n, k, 2); NaN for circles that are not wholly before the camera."""
    points = circles.centres_m[:, None] + circles.arms_m()
    depth = np.where(np.all(points[..., 2] > 0.0, axis=1)[:, None], points[..., 2], np.nan)
    return np.asarray(points[..., :2] / depth[..., None])


def _distorted(camera: Camera, normalised: FloatArray) -> FloatArray:
    return camera.distort(normalised.reshape(-1, 2)).reshape(normalised.shape)


def _moments(outlines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return areas (n,) and moments (n, 5) of closed outlines (n, k, 2), by Green's theorem.

    About the outline's middle, so that differences of large numbers do not cost digits.
    """
    middle = outlines.mean(axis=1)
    x, y = np.moveaxis(outlines - middle[:, None], -1, 0)
    dx, dy = x @ _SLOPES.T * _STEP, y @ _SLOPES.T * _STEP
    area = 0.5 * np.sum(x * dy - y * dx, axis=1)
    area[np.abs(area) < _LEAST_AREA] = np.nan
    orientation = area  # the same sign in all integrals: it cancels
    x2_dy, y2_dx = x * x * dy, y * y * dx
    mean_x = 0.5 * np.sum(x2_dy, axis=1) / orientation
    mean_y = -0.5 * np.sum(y2_dx, axis=1) / orientation
    xx = np.sum(x * x2_dy, axis=1) / (3.0 * orientation) - mean_x**2
    yy = -np.sum(y * y2_dx, axis=1) / (3.0 * orientation) - mean_y**2
    xy = 0.5 * np.sum(y * x2_dy, axis=1) / orientation - mean_x * mean_y
    moments = np.column_stack((middle[:, 0] + mean_x, middle[:, 1] + mean_y, xx, xy, yy))
    return np.abs(area), moments


def _boundary_weights(
    outlines: FloatArray, area_px2: FloatArray, moments: FloatArray
) -> FloatArray:
    """Return the derivatives (n, k, 5, 2) of the moments by the points of the outlines."""
    x, y = np.moveaxis(outlines, -1, 0)
    dx, dy = x @ _SLOPES.T * _STEP, y @ _SLOPES.T * _STEP
    sign = np.sign(np.sum((x - moments[:, :1]) * dy - (y - moments[:, 1:2]) * dx, axis=1))
    flux = np.stack((dy, -dx), axis=-1) * (sign / area_px2)[:, None, None]
    off_x, off_y = x - moments[:, :1], y - moments[:, 1:2]
    integrands = np.stack(
        (
            off_x,
            off_y,
            off_x * off_x - moments[:, 2:3],
            off_x * off_y - moments[:, 3:4],
            off_y * off_y - moments[:, 4:5],
        ),
        axis=-1,
    )
    return np.asarray(integrands[..., None] * flux[..., None, :])
