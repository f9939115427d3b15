"""Images of circles through a lens: their moments, and the eccentricity of their centroids.

The image of a circle is an ellipse only before the lens distorts it. And the ellipse's centre is
not the image of the circle's centre (Otepka & Fraser 2004). Both effects are modelled exactly: the
outline is projected point by point, and Green's theorem turns integrals over the area into
integrals along the outline. The outline is a smooth periodic curve, for which sums over equal steps
of the angle converge exponentially. 32 points are accurate to 1e-10 px for circles of usual size.

If the outline is displaced by δ, ∫ f dA changes by ∮ f (δ_x dy − δ_y dx). All derivatives are
derived from that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.geometry.calibration import distort_jacobian_by_calibration
from kgcp.geometry.camera import Camera

OUTLINE_POINTS = 32  # of one circle
_ANGLES_RAD = 2.0 * np.pi / OUTLINE_POINTS * np.arange(OUTLINE_POINTS)
_UNIT_CIRCLE = np.column_stack((np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)))


def _fourier_differentiation(count: int) -> FloatArray:
    """Return the matrix (k, k) that differentiates a periodic function given at k equal steps."""
    lag = np.subtract.outer(np.arange(count), np.arange(count))
    sign = np.where(lag % 2 == 0, 0.5, -0.5)
    with np.errstate(divide="ignore"):
        return np.where(lag == 0, 0.0, sign / np.tan(np.pi * lag / count))


_DIFFERENTIATION = _fourier_differentiation(OUTLINE_POINTS)
_STEP_RAD = 2.0 * np.pi / OUTLINE_POINTS
# Smaller areas are rounding errors of the coordinates. In px², or in the unit of normalised
# coordinates squared.
_MIN_AREA = 1e-20


def plane_axes(normals: FloatArray) -> FloatArray:
    """Return two orthogonal unit vectors (n, 3, 2) of the planes with unit normals (n, 3)."""
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
        """Return circles in planes with unit normals (n, 3)."""
        return cls(centres_m, plane_axes(normals), radii_m)

    def arms_m(self) -> FloatArray:
        """Return the vectors (n, k, 3) from the centres to points of the circles [m]."""
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
class CircleDerivatives:
    """The moments of n circles' images and their partial derivatives."""

    moments: FloatArray  # (n, 5): as in `CircleImages`
    by_centre: FloatArray  # (n, 5, 3): by the circle's centre in the camera frame [m]
    # (n, 5, 3): by a rotation vector [rad] in the camera frame that turns the circle's plane about
    # the circle's centre
    by_rotation: FloatArray
    by_radius: FloatArray  # (n, 5): by the radius [m]


@dataclass(frozen=True, slots=True, eq=False)
class Eccentricity:
    """Differences between the centroids of n circles' images and the images of their centres.

    centroid = image of the centre + perspective + in_marker.
    """

    centres_px: FloatArray  # (n, 2): images of the circles' centres
    # (n, 2): distorted centre of the undistorted ellipse − image of the circle's centre
    perspective_px: FloatArray
    # (n, 2): centroid of the distorted outline − distorted centre of the undistorted ellipse: the
    # effect of distortion that varies within the marker
    in_marker_px: FloatArray

    @property
    def total_px(self) -> FloatArray:
        """Both together (n, 2): centroid − image of the centre."""
        return self.perspective_px + self.in_marker_px


def circle_images(camera: Camera, circles: Circles3D) -> CircleImages:
    """Return outlines, areas and moments of circles' images.

    They are NaN for circles that are not entirely in front of the camera, or so far away that their
    images have no area.

    Parameters
    ----------
    camera : Camera
        Its distortion is applied to every point of the outlines.
    circles : Circles3D
        In the camera frame.
    """
    outlines = _distorted(camera, _outlines(circles))
    area, moments = _moments(outlines)
    return CircleImages(area, moments, outlines)


def circle_derivatives(camera: Camera, circles: Circles3D) -> CircleDerivatives:
    """Return the moments of `circle_images` and their analytic derivatives."""
    normalised = _outlines(circles)
    outlines = _distorted(camera, normalised)
    area, moments = _moments(outlines)
    weights = _boundary_weights(outlines, area, moments)
    count = len(moments)
    by_centre, by_rotation = np.empty((count, 5, 3)), np.empty((count, 5, 3))
    by_radius = np.empty((count, 5))
    _fill_in_derivatives(
        np.ascontiguousarray(weights),
        camera.distort_jacobian(normalised),
        normalised,
        np.ascontiguousarray(circles.arms_m()),
        np.ascontiguousarray(circles.centres_m),
        (by_centre, by_rotation, by_radius),
    )
    return CircleDerivatives(moments, by_centre, by_rotation, by_radius / circles.radii_m[:, None])


@compiled
def _fill_in_derivatives(
    weights: FloatArray,
    lens: FloatArray,
    normalised: FloatArray,
    arms: FloatArray,
    centres: FloatArray,
    derivatives: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Fill in the derivatives of moments by centres, rotations and the radii's logarithms.

    Parameters
    ----------
    weights : (n, k, 5, 2) array
        Those of `_boundary_weights`.
    lens : (n, k, 2, 2) array
        Derivatives of the outlines' pixels by the normalised coordinates (n, k, 2).
    arms : (n, k, 3) array
        From the centres (n, 3) to the outlines' points.
    """
    by_centre, by_rotation, by_radius = derivatives
    by_centre[:], by_rotation[:], by_radius[:] = 0.0, 0.0, 0.0
    for i in range(len(arms)):
        for k in range(arms.shape[1]):
            arm_x, arm_y, arm_z = arms[i, k]
            depth = centres[i, 2] + arm_z
            x, y = normalised[i, k]
            for m in range(5):
                first, second = weights[i, k, m]
                by_x = (first * lens[i, k, 0, 0] + second * lens[i, k, 1, 0]) / depth
                by_y = (first * lens[i, k, 0, 1] + second * lens[i, k, 1, 1]) / depth
                by_z = -(by_x * x + by_y * y)
                by_centre[i, m, 0] += by_x
                by_centre[i, m, 1] += by_y
                by_centre[i, m, 2] += by_z
                # a rotation vector ω moves an arm a by ω × a; with a gradient g,
                # g · (ω × a) = ω · (a × g)
                by_rotation[i, m, 0] += arm_y * by_z - arm_z * by_y
                by_rotation[i, m, 1] += arm_z * by_x - arm_x * by_z
                by_rotation[i, m, 2] += arm_x * by_y - arm_y * by_x
                by_radius[i, m] += by_x * arm_x + by_y * arm_y + by_z * arm_z


def moments_jacobian_by_calibration(camera: Camera, circles: Circles3D) -> FloatArray:
    """Return the derivatives (n, 5, 12) of the circles' moments by `CALIBRATION_PARAMETERS`."""
    normalised = _outlines(circles)
    outlines = _distorted(camera, normalised)
    weights = _boundary_weights(outlines, *_moments(outlines))
    by_camera = distort_jacobian_by_calibration(camera, normalised.reshape(-1, 2))
    return _along_outlines(weights, by_camera.reshape(*normalised.shape, -1))


def _along_outlines(weights: FloatArray, by_point: FloatArray) -> FloatArray:
    """Chain derivatives of the outlines' points (n, k, 2, p) to those of the moments (n, 5, p).

    `weights` are those of `_boundary_weights`.
    """
    count, points = weights.shape[:2]
    flat = weights.transpose(0, 2, 1, 3).reshape(count, 5, 2 * points)
    return np.asarray(flat @ by_point.reshape(count, 2 * points, -1))


def eccentricity(camera: Camera, circles: Circles3D) -> Eccentricity:
    """Return the eccentricity of circles' images, separated by cause.

    There are two causes, as in figures 5 and 6 of ISPRS Archives XXXVII-B1 (2008). The part of the
    perspective is what an ideal lens would show (Dold 1997), mapped through the distortion. The
    rest is due to distortion that varies within the marker.
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
    """Return normalised outlines (n, k, 2); NaN for circles not entirely in front of the camera."""
    outlines = np.empty((len(circles.centres_m), OUTLINE_POINTS, 2))
    _fill_in_outlines(
        np.ascontiguousarray(circles.centres_m),
        np.ascontiguousarray(circles.axes),
        np.ascontiguousarray(circles.radii_m),
        _UNIT_CIRCLE,
        outlines,
    )
    return outlines


@compiled
def _fill_in_outlines(
    centres: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    circle: FloatArray,
    outlines: FloatArray,
) -> None:
    for i in range(len(centres)):
        is_ahead = True
        for k in range(len(circle)):
            u, v = circle[k]
            x = centres[i, 0] + radii[i] * (axes[i, 0, 0] * u + axes[i, 0, 1] * v)
            y = centres[i, 1] + radii[i] * (axes[i, 1, 0] * u + axes[i, 1, 1] * v)
            z = centres[i, 2] + radii[i] * (axes[i, 2, 0] * u + axes[i, 2, 1] * v)
            outlines[i, k, 0], outlines[i, k, 1] = x / z, y / z
            is_ahead &= z > 0.0
        if not is_ahead:
            outlines[i] = np.nan


def _distorted(camera: Camera, normalised: FloatArray) -> FloatArray:
    return camera.distort(normalised.reshape(-1, 2)).reshape(normalised.shape)


def _moments(outlines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return areas (n,) and moments (n, 5) of closed outlines (n, k, 2), by Green's theorem.

    The integrals are taken about the mean of the points: differences of large numbers would lose
    digits.
    """
    area, moments = np.empty(len(outlines)), np.empty((len(outlines), 5))
    _fill_in_moments(np.ascontiguousarray(outlines), _DIFFERENTIATION * _STEP_RAD, area, moments)
    return area, moments


@compiled
def _fill_in_moments(
    outlines: FloatArray, differentiation: FloatArray, area: FloatArray, moments: FloatArray
) -> None:
    points = outlines.shape[1]
    x, y, dx, dy = np.empty(points), np.empty(points), np.empty(points), np.empty(points)
    for i in range(len(outlines)):
        middle_x, middle_y = np.mean(outlines[i, :, 0]), np.mean(outlines[i, :, 1])
        dx[:], dy[:] = 0.0, 0.0
        for k in range(points):
            x[k], y[k] = outlines[i, k, 0] - middle_x, outlines[i, k, 1] - middle_y
            for j in range(points):  # the matrix is antisymmetric
                dx[j] -= differentiation[k, j] * x[k]
                dy[j] -= differentiation[k, j] * y[k]
        doubled = mean_x = mean_y = xx = xy = yy = 0.0
        for k in range(points):
            x2_dy, y2_dx = x[k] * x[k] * dy[k], y[k] * y[k] * dx[k]
            doubled += x[k] * dy[k] - y[k] * dx[k]
            mean_x += x2_dy
            mean_y -= y2_dx
            xx += x[k] * x2_dy
            xy += y[k] * x2_dy
            yy -= y[k] * y2_dx
        # all integrals have the sign of the outline's sense, which cancels
        signed_area = 0.5 * doubled if abs(0.5 * doubled) >= _MIN_AREA else np.nan
        mean_x, mean_y = 0.5 * mean_x / signed_area, 0.5 * mean_y / signed_area
        area[i] = abs(signed_area)
        moments[i, 0], moments[i, 1] = middle_x + mean_x, middle_y + mean_y
        moments[i, 2] = xx / (3.0 * signed_area) - mean_x * mean_x
        moments[i, 3] = 0.5 * xy / signed_area - mean_x * mean_y
        moments[i, 4] = yy / (3.0 * signed_area) - mean_y * mean_y


def _boundary_weights(
    outlines: FloatArray, area_px2: FloatArray, moments: FloatArray
) -> FloatArray:
    """Return the derivatives (n, k, 5, 2) of the moments by the points of the outlines."""
    x, y = np.moveaxis(outlines, -1, 0)
    dx, dy = x @ _DIFFERENTIATION.T * _STEP_RAD, y @ _DIFFERENTIATION.T * _STEP_RAD
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
