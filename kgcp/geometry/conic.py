"""Conics in the plane as symmetric 3×3 matrices: xᵀ Q x = 0 for homogeneous points x = (x, y, 1).

The sign of an ellipse's matrix is chosen so that xᵀ Q x is negative inside: it has two positive
eigenvalues and a negative one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray

_MIN_POINTS = 6


@dataclass(frozen=True, slots=True)
class Ellipse:
    """An ellipse, given by its centre, semi-axes and direction."""

    # centre
    x: float
    y: float
    # semi-major and semi-minor axis, in the unit of the centre
    a: float
    b: float
    angle_rad: float  # direction of the major axis, from x towards y, in (-π/2, π/2]

    @property
    def centre(self) -> FloatArray:
        """Centre (2,)."""
        return np.array([self.x, self.y])

    @property
    def mean_radius(self) -> float:
        """Radius of the circle with the same area."""
        return math.sqrt(self.a * self.b)

    @property
    def stretch(self) -> FloatArray:
        """Symmetric matrix (2, 2) that maps the unit circle to this ellipse about the origin."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        xy = (self.a - self.b) * c * s
        return np.array(
            [[self.a * c * c + self.b * s * s, xy], [xy, self.a * s * s + self.b * c * c]]
        )

    @property
    def conic(self) -> FloatArray:
        """Matrix (3, 3) of this ellipse."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        along, across = 1.0 / (self.a * self.a), 1.0 / (self.b * self.b)
        xx, xy, yy = (
            c * c * along + s * s * across,
            c * s * (along - across),
            s * s * along + c * c * across,
        )
        x, y = -xx * self.x - xy * self.y, -xy * self.x - yy * self.y
        rest = -1.0 - x * self.x - y * self.y
        return np.array([[xx, xy, x], [xy, yy, y], [x, y, rest]])

    def points(self, angles_rad: FloatArray, factor: float = 1.0) -> FloatArray:
        """Return points (…, 2) at angles (…) on the ellipse, scaled by `factor` about its centre.

        The angles are those on the unit circle, which `stretch` maps to the ellipse without a
        rotation. If a circle is seen almost frontally, they are directions on the plate plus the
        plate's heading.
        """
        unit = np.empty((*np.shape(angles_rad), 2))
        unit[..., 0], unit[..., 1] = np.cos(angles_rad), np.sin(angles_rad)
        return factor * unit @ self.stretch + self.centre

    def scaled(self, factor: float) -> Ellipse:
        """Return the ellipse with the same centre and both axes multiplied by `factor`."""
        return Ellipse(self.x, self.y, factor * self.a, factor * self.b, self.angle_rad)


def oriented(conic: FloatArray) -> FloatArray:
    """Return the conic (3, 3), symmetric, with unit norm; xᵀ Q x is negative inside an ellipse."""
    symmetric = 0.5 * (conic + conic.T)
    norm = math.sqrt(np.vdot(symmetric, symmetric))
    sign = 1.0 if symmetric[0, 0] + symmetric[1, 1] > 0.0 else -1.0
    return np.asarray(symmetric * (sign / norm))


def transform_conic(conic: FloatArray, homography: FloatArray) -> FloatArray:
    """Return the conic (3, 3) to which a homography maps `conic` (x' = homography @ x)."""
    inverse = np.linalg.inv(homography)
    return oriented(inverse.T @ conic @ inverse)


def ellipse_from_conic(conic: FloatArray) -> Ellipse:
    """Return the ellipse that a conic (3, 3) describes.

    Raises
    ------
    Rejection
        POOR_ELLIPSE if the conic is not a real ellipse.
    """
    form = oriented(conic)
    quadratic, linear = form[:2, :2], form[:2, 2]
    curvatures, axes = np.linalg.eigh(quadratic)
    if curvatures[0] <= 0.0:
        raise Rejection(Reason.POOR_ELLIPSE, "the fitted conic is not an ellipse")
    centre = np.linalg.solve(quadratic, -linear)
    depth = -(form[2, 2] + linear @ centre)
    if depth <= 0.0:
        raise Rejection(Reason.POOR_ELLIPSE, "the fitted ellipse has no real points")
    a, b = np.sqrt(depth / curvatures)
    return Ellipse(float(centre[0]), float(centre[1]), float(a), float(b), _direction(axes[:, 0]))


def _direction(axis: FloatArray) -> float:
    """Return the angle of an axis without orientation [rad], in (-π/2, π/2]."""
    angle = math.atan2(axis[1], axis[0])
    return angle - math.pi * math.ceil(angle / math.pi - 0.5)


def fit_ellipse(points: FloatArray) -> FloatArray:
    """Fit an ellipse to at least six points (n, 2) and return it as a conic (3, 3).

    Direct least squares: Fitzgibbon's constraint 4ac - b² = 1 in the block form of Halíř & Flusser
    (1998), "Numerically stable direct least squares fitting of ellipses". The points are centred
    and scaled to unit size before.

    Raises
    ------
    Rejection
        POOR_ELLIPSE if the points do not determine an ellipse.
    """
    if len(points) < _MIN_POINTS:
        raise Rejection(Reason.POOR_ELLIPSE, f"{len(points)} points are too few for an ellipse")
    mean = points.mean(axis=0)
    scale = float(np.sqrt(np.mean((points - mean) ** 2)))
    x, y = ((points - mean) / scale).T if scale > 0.0 else np.zeros((2, len(points)))
    a, b, c, d, e, f = _direct_fit(x, y)
    unit = np.array([[a, 0.5 * b, 0.5 * d], [0.5 * b, c, 0.5 * e], [0.5 * d, 0.5 * e, f]])
    back = np.array([[scale, 0.0, mean[0]], [0.0, scale, mean[1]], [0.0, 0.0, 1.0]])
    return transform_conic(unit, back)


def _direct_fit(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the conic's coefficients (6,) of x², xy, y², x, y, 1."""
    quadratic = np.column_stack((x * x, x * y, y * y))
    linear = np.column_stack((x, y, np.ones_like(x)))
    try:
        reduce = -np.linalg.solve(linear.T @ linear, linear.T @ quadratic)
    except np.linalg.LinAlgError:
        raise Rejection(Reason.POOR_ELLIPSE, "the points lie on a line") from None
    scatter = quadratic.T @ (quadratic + linear @ reduce)
    constrained = np.stack((0.5 * scatter[2], -scatter[1], 0.5 * scatter[0]))
    vectors = np.real(np.linalg.eig(constrained)[1])
    discriminant = 4.0 * vectors[0] * vectors[2] - vectors[1] ** 2
    best = int(np.argmax(discriminant))
    if not discriminant[best] > 0.0:
        raise Rejection(Reason.POOR_ELLIPSE, "the points do not determine an ellipse")
    return np.concatenate((vectors[:, best], reduce @ vectors[:, best]))


def sampson_distance(conic: FloatArray, points: FloatArray) -> FloatArray:
    """Return first-order distances (n,) of points (n, 2) from a conic; negative inside."""
    homogeneous = np.column_stack((points, np.ones(len(points))))
    form = homogeneous @ oriented(conic)
    value = np.einsum("ni,ni->n", form, homogeneous)
    return np.asarray(0.5 * value / np.hypot(form[:, 0], form[:, 1]))


def chord(conic: FloatArray, point: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Intersect an ellipse with lines through a point inside it.

    Parameters
    ----------
    conic : (3, 3) array
        The ellipse.
    point : (2,) array
        A point inside.
    angles_rad : (n,) array
        Directions of the lines, from x towards y [rad].

    Returns
    -------
    (2, n, 2) array
        The intersections of each line: behind the point (A), then ahead of it (B). NaN if the line
        misses the ellipse.
    """
    directions = np.stack((np.cos(angles_rad), np.sin(angles_rad)), axis=-1)
    form = oriented(conic)
    origin = np.append(point, 1.0)
    along = directions @ form[:2, :2]
    quadratic = np.einsum("ni,ni->n", along, directions)
    linear = directions @ (form[:2] @ origin)
    with np.errstate(invalid="ignore"):  # NaN if the line misses
        half = np.sqrt(linear**2 - quadratic * (origin @ form @ origin))
    lengths = np.stack((-linear - half, -linear + half)) / quadratic
    return np.asarray(point + lengths[..., None] * directions)
