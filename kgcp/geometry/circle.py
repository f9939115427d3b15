"""Centre, distance, tilt and pose of circles from their images (conics).

All coordinates are normalised (x/z, y/z) and free of distortion, so that the camera matrix of the
paper's eq. 1 is the identity. Equation numbers are those of Cucci (2016), "Accurate optical target
pose determination for applications in aerial photogrammetry".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.conic import chord, ellipse_from_conic, oriented, transform_conic
from kgcp.geometry.pose import Pose

_GAMMAS_RAD = np.linspace(0.0, math.pi, 36, endpoint=False)  # directions γ of eq. 13
_MAX_STEPS = 60
_MAX_STEP = 0.05  # in units of the ellipse's mean radius
# Least damping of the normal equations. For a frontal circle the two minima coincide, and the
# equations are singular there.
_MIN_RIDGE = 1e-12
_CONVERGED_SPREAD = 1e-20  # sum of squared relative deviations of the distances


@dataclass(frozen=True, slots=True, eq=False)
class CirclePlane:
    """One of the two planes and positions in space that explain the image of a circle."""

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

    The method is that of Kim et al. (2005), as used in §4 of the paper. Q_i Q_o⁻¹ has a repeated
    eigenvalue λ, and each row of Q_o⁻¹ - λ Q_i⁻¹ is the centre in homogeneous coordinates. With
    measured ellipses, λ splits into two eigenvalues with three rows each, which gives six
    candidates.

    Here they are combined: with the mean of the two eigenvalues, Q_o⁻¹ - λ Q_i⁻¹ is the centre
    times its transpose, a matrix of rank one except for noise. Its dominant eigenvector weights
    each row by how well it determines the centre. It is computed in coordinates in which the outer
    ellipse is the unit circle.
    """
    ellipse = ellipse_from_conic(outer)
    frame = np.eye(3)  # from coordinates in which the outer ellipse is the unit circle
    frame[:2, :2] = ellipse.stretch
    frame[:2, 2] = ellipse.centre
    outer_unit = np.diag([1.0, 1.0, -1.0])
    inner_unit = oriented(frame.T @ oriented(inner) @ frame)
    # With the ratio k of the radii, the single eigenvalue is k² times the repeated one, so the two
    # larger values are the repeated pair. Noise may make the pair complex: then its real part
    # stands for both.
    repeated = np.sort(np.real(np.linalg.eigvals(inner_unit @ outer_unit)))[1:]
    pencil = outer_unit - repeated.mean() * np.linalg.inv(inner_unit)
    values, vectors = np.linalg.eigh(0.5 * (pencil + pencil.T))
    centre = frame @ vectors[:, np.argmax(np.abs(values))]
    return np.asarray(centre[:2] / centre[2])


def circle_distance(centre: FloatArray, gammas_rad: FloatArray, conic: FloatArray) -> FloatArray:
    """Return d(C', γ, Q') of eq. 12: the distance OC from eqs. 1-5, in units of the radius.

    Parameters
    ----------
    centre : (2,) array
        Assumed projected centre C', normalised.
    gammas_rad : (n,) array
        Directions γ of lines through C' [rad]. Each cuts the ellipse where the ends of a diameter
        are projected.
    conic : (3, 3) array
        Image Q' of the circle, normalised coordinates.

    Returns
    -------
    (n,) array
        OC / r. Equal for all γ if C' is the projected centre. NaN if C' is not inside the ellipse.

    Notes
    -----
    The triangles OAC and OBC over the halves of the diameter AB have equal areas, so OA sin θ1 = OB
    sin θ2. With (2r)² from eq. 4 this gives
    OC = r sin(θ1 + θ2) / √(sin² θ1 + sin² θ2 - 2 sin θ1 sin θ2 cos(θ1 + θ2)),
    which is eq. 5 without the loss of digits by cancelling cosines.
    """
    ray_c, rays = _rays(centre), _rays(chord(conic, centre, gammas_rad))
    # From sine and cosine: the arc cosine alone loses all digits for small angles.
    theta1, theta2 = np.arctan2(np.linalg.norm(np.cross(rays, ray_c), axis=-1), rays @ ray_c)
    s1, s2, both = np.sin(theta1), np.sin(theta2), theta1 + theta2
    return np.asarray(np.sin(both) / np.sqrt(s1**2 + s2**2 - 2.0 * s1 * s2 * np.cos(both)))


def _rays(points: FloatArray) -> FloatArray:
    """Return unit viewing rays (…, 3) of normalised points (…, 2): eq. 1."""
    homogeneous = np.concatenate((points, np.ones((*points.shape[:-1], 1))), axis=-1)
    return np.asarray(homogeneous / np.linalg.norm(homogeneous, axis=-1, keepdims=True))


def minimise_dispersion(conic: FloatArray, start: FloatArray) -> FloatArray:
    """Return the projected centre C' (2,) that minimises D (eq. 14), from a starting point.

    D(C') of eq. 13 is the standard deviation of d over γ. It is a root mean square, so damped
    Gauss-Newton steps can replace the paper's gradient descent.

    D itself decreases towards the ellipse, where d falls to the radius. Therefore D over the mean
    of d is minimised, which increases there and has the same zeros.

    The result is one of the two minima that `circle_planes` gives in closed form: the one in whose
    basin of attraction the start lies.
    """
    scale = ellipse_from_conic(conic).mean_radius
    centre, damping = np.asarray(start, dtype=np.float64), 1e-3
    residuals = _spread(centre, conic)
    for _ in range(_MAX_STEPS):
        jacobian = _spread_jacobian(centre, conic, 1e-6 * scale)
        normal = jacobian.T @ jacobian
        ridge = max(damping * float(np.trace(normal)), _MIN_RIDGE)
        step = np.linalg.solve(normal + ridge * np.eye(2), -jacobian.T @ residuals)
        step /= max(1.0, float(np.linalg.norm(step)) / (_MAX_STEP * scale))
        trial = _spread(centre + step, conic)
        if not trial @ trial < residuals @ residuals:
            damping *= 10.0
        else:
            centre, residuals, damping = centre + step, trial, 0.1 * damping
        if np.linalg.norm(step) < 1e-10 * scale or residuals @ residuals < _CONVERGED_SPREAD:
            break
    return centre


def _spread(centre: FloatArray, conic: FloatArray) -> FloatArray:
    """Return the relative deviations (n,) of d from its mean over γ."""
    distances = circle_distance(centre, _GAMMAS_RAD, conic)
    return np.asarray(distances / distances.mean() - 1.0)


def _spread_jacobian(centre: FloatArray, conic: FloatArray, step: float) -> FloatArray:
    """Differentiate `_spread` with respect to the centre, numerically: (n, 2)."""
    columns = [
        (_spread(centre + shift, conic) - _spread(centre - shift, conic)) / (2.0 * step)
        for shift in step * np.eye(2)
    ]
    return np.column_stack(columns)


def circle_planes(conic: FloatArray) -> tuple[CirclePlane, CirclePlane]:
    """Return both positions of a circle in space, from its normalised image (3, 3) alone.

    They are mirror images about the cone's axis. They coincide if the circle is seen exactly along
    that axis.

    Two families of planes cut the cone Q' over the image in circles. With the eigenvalues λ1 ≥ λ2 >
    0 > λ3 and axes e1, e2, e3 of Q' their normals are n = √((λ1 - λ2)/(λ1 - λ3)) (±e1) + √((λ2 -
    λ3)/(λ1 - λ3)) e3. The viewing ray of the circle's centre is the pole of the plane's horizon,
    Q'⁻¹ n. The plane's distance from the projection centre is r λ2 / √(-λ1 λ3). The two projected
    centres are the two minima in the paper's Figure 7, in the closed form that the paper asks for.

    Raises
    ------
    Rejection
        IMPOSSIBLE_GEOMETRY if the conic is not the image of a circle in front of the camera.
    """
    values, axes = np.linalg.eigh(oriented(conic))
    low, middle, high = values.tolist()
    if not low < 0.0 < middle:
        raise Rejection(Reason.IMPOSSIBLE_GEOMETRY, "the outer conic is not the image of a circle")
    along = math.sqrt((middle - low) / (high - low)) * axes[:, 0]
    across = math.sqrt((high - middle) / (high - low)) * axes[:, 2]
    height = middle / math.sqrt(-high * low)
    return (
        _circle_plane(along + across, along / low + across / high, height),
        _circle_plane(along - across, along / low - across / high, height),
    )


def _circle_plane(normal: FloatArray, ray: FloatArray, height: float) -> CirclePlane:
    """Place the circle on the ray Q'⁻¹ n; the signs of `normal` and `ray` do not matter."""
    sign = 1.0 if normal[2] > 0.0 else -1.0
    return CirclePlane(sign * normal, ray * (sign * height / float(normal @ ray)))


def pose_on_plane(plane: CirclePlane, radius_m: float, towards_x: FloatArray) -> Pose:
    """Return the pose of a target in a plane, with the heading given by an image point.

    Parameters
    ----------
    radius_m : float
        Radius of the circle [m].
    towards_x : (2,) array
        Any image point on the target's positive x axis, in normalised coordinates.
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
    """Return the normalised image (3, 3) of a circle about the target's origin."""
    circle = np.diag([1.0, 1.0, -(radius_m**2)])
    return transform_conic(circle, _plate_homography(pose))


def conic_on_plate(pose: Pose, conic: FloatArray) -> FloatArray:
    """Return the curve (3, 3) on the plate [m] whose normalised image is `conic`."""
    return transform_conic(conic, np.asarray(np.linalg.inv(_plate_homography(pose))))


def _plate_homography(pose: Pose) -> FloatArray:
    """Return the homography (3, 3) from plate coordinates [m] to normalised image coordinates."""
    return np.column_stack((pose.rotation[:, :2], pose.translation_m))
