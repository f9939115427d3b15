"""Images of circles and of concentric circles: centre, distance, tilt and pose.

Everything here works in normalised coordinates (x/z, y/z), free of distortion, so that the
camera matrix of the paper's eq. 1 is the identity. Equation numbers are those of Cucci (2016),
"Accurate optical target pose determination for applications in aerial photogrammetry".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.conic import chord, ellipse_from_conic, oriented, transform_conic
from kgcp.geometry.pose import Pose

_GAMMAS = np.linspace(0.0, math.pi, 36, endpoint=False)
_MAX_STEPS = 60
_MAX_STEP = 0.05  # of the ellipse's radius
_SMALLEST_RIDGE = 1e-12  # the two minima of a frontal circle are one, without any slope
_NO_SPREAD = 1e-20  # sum of squared relative deviations


@dataclass(frozen=True, slots=True, eq=False)
class CirclePlane:
    """One of the two positions in space that a circle can have, given its image."""

    # (3,): unit normal of the circle's plane in the camera frame, pointing away from the camera
    normal: FloatArray
    # (3,): the circle's centre in the camera frame, in units of the circle's radius
    centre: FloatArray

    @property
    def image_centre(self) -> FloatArray:
        """Projected centre (2,), normalised coordinates."""
        return np.asarray(self.centre[:2] / self.centre[2])


def kim_centre(outer: FloatArray, inner: FloatArray) -> FloatArray:
    """Return the projected centre (2,) of two concentric circles, given their conics (3, 3).

    After Kim et al. (2005), as §4 of the paper uses it: for the repeated eigenvalue λ of
    Q_i Q_o⁻¹ each row of Q_o⁻¹ - λ Q_i⁻¹ is the centre. For measured ellipses the repeated
    eigenvalue becomes two, with three rows each: six candidates. They are reconciled here: with
    the mean of the two eigenvalues, Q_o⁻¹ - λ Q_i⁻¹ is the centre times its transpose, of rank
    one but for noise. Its dominant eigenvector, taken where the outer ellipse is the unit circle,
    weights every row by what it knows of the centre.
    """
    ellipse = ellipse_from_conic(outer)
    frame = np.eye(3)  # from where the outer ellipse is the unit circle about the origin
    frame[:2, :2] = ellipse.stretch
    frame[:2, 2] = ellipse.centre
    outer_unit = np.diag([1.0, 1.0, -1.0])
    inner_unit = oriented(frame.T @ oriented(inner) @ frame)
    # k² of the repeated value is the single one. A complex pair means that noise has pushed the
    # twins together: their real part is both.
    twins = np.sort(np.real(np.linalg.eigvals(inner_unit @ outer_unit)))[1:]
    pencil = outer_unit - twins.mean() * np.linalg.inv(inner_unit)
    values, vectors = np.linalg.eigh(0.5 * (pencil + pencil.T))
    centre = frame @ vectors[:, np.argmax(np.abs(values))]
    return np.asarray(centre[:2] / centre[2])


def circle_distance(centre: FloatArray, gammas_rad: FloatArray, conic: FloatArray) -> FloatArray:
    """Return d(C', γ, Q') of eq. 12: the distance OC by eqs. 1-5, in units of the radius.

    Parameters
    ----------
    centre : (2,) array
        Assumed projected centre C', normalised.
    gammas_rad : (n,) array
        Directions γ of the lines that cut the ellipse in the ends of a diameter [rad].
    conic : (3, 3) array
        Image Q' of the circle, normalised coordinates.

    Returns
    -------
    (n,) array
        OC / r. Equal for all γ if C' is the projected centre. NaN if C' is not inside.

    Notes
    -----
    Halves of a diameter cut equal areas, OA sin θ1 = OB sin θ2, and with (2r)² of eq. 4
    OC = r sin(θ1 + θ2) / √(sin² θ1 + sin² θ2 - 2 sin θ1 sin θ2 cos(θ1 + θ2)),
    which is eq. 5 without its cancelling cosines.
    """
    ray_c, rays = _rays(centre), _rays(chord(conic, centre, gammas_rad))
    # The arc of the sine and the cosine: an arc cosine alone has no digits for small angles.
    theta1, theta2 = np.arctan2(np.linalg.norm(np.cross(rays, ray_c), axis=-1), rays @ ray_c)
    s1, s2, both = np.sin(theta1), np.sin(theta2), theta1 + theta2
    return np.asarray(np.sin(both) / np.sqrt(s1**2 + s2**2 - 2.0 * s1 * s2 * np.cos(both)))


def _rays(points: FloatArray) -> FloatArray:
    """Return unit viewing rays (…, 3) of normalised points (…, 2): eq. 1."""
    homogeneous = np.concatenate((points, np.ones((*points.shape[:-1], 1))), axis=-1)
    return np.asarray(homogeneous / np.linalg.norm(homogeneous, axis=-1, keepdims=True))


def minimise_dispersion(conic: FloatArray, start: FloatArray) -> FloatArray:
    """Return the projected centre C' (2,) that minimises D (eq. 14), from a starting point.

    D(C') of eq. 13 is the standard deviation of d over γ: a root mean square, so damped
    Gauss-Newton steps replace the paper's gradient descent. D itself falls towards the ellipse,
    where d falls to the radius; relative to the mean of d it rises, with the same zeros: that is
    what is minimised. The end is one of the two minima of `circle_planes`, the one in whose basin
    the start lies.
    """
    scale = ellipse_from_conic(conic).mean_radius
    centre, damping = np.asarray(start, dtype=np.float64), 1e-3
    residuals = _spread(centre, conic)
    for _ in range(_MAX_STEPS):
        jacobian = _spread_slopes(centre, conic, 1e-6 * scale)
        normal = jacobian.T @ jacobian
        ridge = max(damping * float(np.trace(normal)), _SMALLEST_RIDGE)
        step = np.linalg.solve(normal + ridge * np.eye(2), -jacobian.T @ residuals)
        step /= max(1.0, float(np.linalg.norm(step)) / (_MAX_STEP * scale))
        trial = _spread(centre + step, conic)
        if not trial @ trial < residuals @ residuals:
            damping *= 10.0
        else:
            centre, residuals, damping = centre + step, trial, 0.1 * damping
        if np.linalg.norm(step) < 1e-10 * scale or residuals @ residuals < _NO_SPREAD:
            break
    return centre


def _spread(centre: FloatArray, conic: FloatArray) -> FloatArray:
    """Relative deviations (n,) of d from its mean over γ."""
    distances = circle_distance(centre, _GAMMAS, conic)
    return np.asarray(distances / distances.mean() - 1.0)


def _spread_slopes(centre: FloatArray, conic: FloatArray, step: float) -> FloatArray:
    """Differentiate `_spread` with respect to the centre, numerically: (n, 2)."""
    columns = [
        (_spread(centre + shift, conic) - _spread(centre - shift, conic)) / (2.0 * step)
        for shift in step * np.eye(2)
    ]
    return np.column_stack(columns)


def circle_planes(conic: FloatArray) -> tuple[CirclePlane, CirclePlane]:
    """Return both positions of a circle in space, from its normalised image (3, 3) alone.

    They are mirror images about the cone's axis, and equal for a circle seen exactly along it.

    The cone Q' over the image is cut in circles by two families of planes. With its eigenvalues
    λ1 ≥ λ2 > 0 > λ3 and axes e1, e2, e3 their normals are
    √((λ1 - λ2)/(λ1 - λ3)) (±e1) + √((λ2 - λ3)/(λ1 - λ3)) e3; the centre's ray is the pole of the
    plane's horizon, Q'⁻¹ n, and the plane lies at r λ2 / √(-λ1 λ3). The two projected centres
    are the two minima of the paper's Figure 7, in the closed form that it asks for.

    Raises
    ------
    Rejection
        IMPOSSIBLE_GEOMETRY if the conic is not the image of a circle in front of the camera.
    """
    values, axes = np.linalg.eigh(oriented(conic))
    low, middle, high = values.tolist()
    if not low < 0.0 < middle:
        raise Rejection(Reason.IMPOSSIBLE_GEOMETRY, "the outer conic is not an ellipse's cone")
    along = math.sqrt((middle - low) / (high - low)) * axes[:, 0]
    across = math.sqrt((high - middle) / (high - low)) * axes[:, 2]
    height = middle / math.sqrt(-high * low)
    return (
        _circle_plane(along + across, along / low + across / high, height),
        _circle_plane(along - across, along / low - across / high, height),
    )


def _circle_plane(normal: FloatArray, ray: FloatArray, height: float) -> CirclePlane:
    """Place the circle: `ray` is Q'⁻¹ n, of either sign as n is."""
    sign = 1.0 if normal[2] > 0.0 else -1.0
    return CirclePlane(sign * normal, ray * (sign * height / float(normal @ ray)))


def pose_on_plane(plane: CirclePlane, radius_m: float, towards_x: FloatArray) -> Pose:
    """Return the pose of a target whose +x axis is seen through an image point.

    Parameters
    ----------
    radius_m : float
        Radius of the circle in the plane [m].
    towards_x : (2,) array
        Normalised image point on the target's positive x axis.
    """
    (a, b, c), (x, y, z), (u, v) = (
        array.tolist() for array in (plane.normal, plane.centre, towards_x)
    )
    depth = (a * x + b * y + c * z) / (a * u + b * v + c)
    x, y, z = depth * u - x, depth * v - y, depth - z
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    rotation = [[x, b * z - c * y, a], [y, c * x - a * z, b], [z, a * y - b * x, c]]
    return Pose(rotation=np.array(rotation), translation_m=radius_m * plane.centre)


def conic_of_circle(pose: Pose, radius_m: float) -> FloatArray:
    """Return the image (3, 3), normalised, of a circle about the target's origin."""
    circle = np.diag([1.0, 1.0, -(radius_m**2)])
    return transform_conic(circle, _plate_homography(pose))


def conic_on_plate(pose: Pose, conic: FloatArray) -> FloatArray:
    """Return the curve (3, 3) on the plate [m] whose normalised image is `conic`."""
    return transform_conic(conic, np.asarray(np.linalg.inv(_plate_homography(pose))))


def _plate_homography(pose: Pose) -> FloatArray:
    """Plate coordinates [m] → normalised image coordinates."""
    return np.column_stack((pose.rotation[:, :2], pose.translation_m))
