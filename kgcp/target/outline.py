"""From places that may be a ring's to the ellipses of outer edges, all at once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.conic import Ellipse
from kgcp.target.seeds import Level, Seeds

_ANGLES = 40
_ANGLES_RAD = 2.0 * np.pi / _ANGLES * np.arange(_ANGLES)
_DIRECTIONS = np.stack((np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)), axis=-1)
_RADII = np.arange(0.5, 1.71, 0.04)  # of the seed's radius
_STEP = 2  # samples either side that a slope is taken over
_MIDDLES = _RADII[_STEP:-_STEP]
_FINEST_RADIUS_PX = 12.0
# ρ(θ) of an ellipse that is not far from a circle, nor its centre from the seed's.
_HARMONICS = np.stack(
    [np.ones(_ANGLES), *(f(k * _ANGLES_RAD) for k in (1, 2) for f in (np.cos, np.sin))], axis=1
)
_PRODUCTS = np.einsum("ai,aj->aij", _HARMONICS, _HARMONICS).reshape(_ANGLES, -1)
_WIDTHS = (0.25, 0.12, 0.07, 0.05)  # of the weighting of residuals, of the seed's radius
_REACH = 0.17  # of an edge from a curve, of the seed's radius
_INLIER = 0.07
_MIN_INLIERS, _MIN_INLIERS_AT_FIRST = 0.55, 0.4
_MAX_AXIS_RATIO = 2.0
_NO_SLOPE = -1000
_RIDGE = 1e-9  # keeps the points of too few edges from a singular fit; they are refused anyway

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Outlines:
    """Ellipses (n,) and how clear they are: centres, semi-axes [px], directions [rad]."""

    centres_px: FloatArray
    axes_px: FloatArray
    angles_rad: FloatArray
    clearness: FloatArray

    @property
    def radii_px(self) -> FloatArray:
        """Radii of circles of the same areas."""
        return np.asarray(np.sqrt(self.axes_px.prod(axis=1)))

    def chosen(self, which: IndexArray) -> _Outlines:
        """Return some of them."""
        return _Outlines(
            self.centres_px[which],
            self.axes_px[which],
            self.angles_rad[which],
            self.clearness[which],
        )

    def ellipses(self) -> tuple[Ellipse, ...]:
        """Return them one by one."""
        rows = np.column_stack((self.centres_px, self.axes_px, self.angles_rad)).tolist()
        return tuple(Ellipse(*row) for row in rows)


def find_outlines(pyramid: tuple[Level, ...], seeds: Seeds) -> tuple[Ellipse, ...]:
    """Follow the outer edge of every seed's ring and fit an ellipse to it.

    Twice: the centre of a large ring is known to some pixels at first.
    """
    for _ in range(2):
        if not len(seeds):
            return ()
        outlines = _distinct(_follow(pyramid, seeds))
        seeds = Seeds(outlines.centres_px, outlines.radii_px, np.ones(len(outlines.clearness)))
    return outlines.ellipses()


def _distinct(outlines: _Outlines) -> _Outlines:
    """Drop ellipses that agree with a clearer one; the clearest comes first."""
    order = np.argsort(-outlines.clearness, kind="stable")
    x, y = outlines.centres_px[order].T
    size = np.log(outlines.radii_px[order])
    free = np.ones(len(order), dtype=bool)
    kept = []
    for i in range(len(order)):
        if free[i]:
            kept.append(order[i])
            apart = np.hypot(x - x[i], y - y[i])
            free &= (apart > 0.25 * np.exp(size[i])) | (np.abs(size - size[i]) > 0.15)
    return outlines.chosen(np.array(kept, dtype=np.intp))


def _follow(pyramid: tuple[Level, ...], seeds: Seeds) -> _Outlines:
    """Return an ellipse for every seed that has an outline."""
    slopes = _radial_slopes(pyramid, seeds)
    best = slopes.argmax(axis=2)
    edge, strength = _MIDDLES[best], np.maximum(_taken(slopes, best), 0)
    curve = _fit_curves(edge, strength)
    inlying = np.abs(edge - curve @ _HARMONICS.T) < 2.0 * _INLIER
    fair = np.flatnonzero(inlying.mean(axis=1) > _MIN_INLIERS_AT_FIRST)
    seeds, curve = seeds.chosen(fair), curve[fair]
    edge, strength = _near_curves(slopes[fair], curve)
    curve = _fit_curves(edge, strength, _WIDTHS[2:])
    inlying = (np.abs(edge - curve @ _HARMONICS.T) < _INLIER) & (strength > 0)
    share = inlying.mean(axis=1)
    good = np.flatnonzero(share >= _MIN_INLIERS)
    return _fit_ellipses(
        edge[good], inlying[good], seeds.chosen(good), share[good] * seeds.contrasts[good]
    )


def _radial_slopes(pyramid: tuple[Level, ...], seeds: Seeds) -> npt.NDArray[np.int16]:
    """Return slopes (n, angles, radii) outwards of the grey values around the seeds."""
    values = np.empty((len(seeds), _ANGLES, len(_RADII)), dtype=np.uint8)
    wanted = np.floor(np.log2(np.maximum(seeds.radii_px / _FINEST_RADIUS_PX, 1.0))).astype(np.intp)
    wanted = np.minimum(wanted, len(pyramid) - 1)
    rays = (_DIRECTIONS[:, None] * _RADII[:, None]).astype(np.float32).reshape(-1, 2)
    for index in np.unique(wanted):
        level, members = pyramid[index], np.flatnonzero(wanted == index)
        centres = level.from_frame(seeds.centres_px[members]).astype(np.float32)
        radii = (seeds.radii_px[members] / level.factor).astype(np.float32)
        points = centres[:, None] + radii[:, None, None] * rays
        values[members] = _remap(level.image, points).reshape(-1, _ANGLES, len(_RADII))
    outer, inner = values[..., 2 * _STEP :], values[..., : -2 * _STEP]
    return np.subtract(outer, inner, dtype=np.int16)


def _remap(image: GreyArray, points: npt.NDArray[np.float32]) -> GreyArray:
    """Sample bilinearly at points (m, k, 2); OpenCV takes at most 32767 rows at once."""
    parts = [
        cv2.remap(
            image, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for part in np.array_split(points, len(points) // 30000 + 1)
    ]
    return np.concatenate(parts)


def _taken(values: npt.NDArray[np.int16], index: IndexArray) -> npt.NDArray[np.int16]:
    return np.take_along_axis(values, index[..., None], axis=2)[..., 0]


def _fit_curves(
    edge: FloatArray, strength: npt.NDArray[np.int16], widths: tuple[float, ...] = _WIDTHS
) -> FloatArray:
    """Fit the harmonics (n, 5) to edges (n, angles), robustly."""
    typical = np.median(strength, axis=1, keepdims=True) + 1e-6
    weight0 = np.clip(strength / typical, 0.0, 1.0)
    curve = np.zeros((len(edge), _HARMONICS.shape[1]))
    curve[:, 0] = np.median(edge, axis=1)
    eye = 1e-3 * np.eye(_HARMONICS.shape[1])
    for width in widths:
        residual = edge - curve @ _HARMONICS.T
        weight = weight0 / (1.0 + (residual / width) ** 2) ** 2
        normal = (weight @ _PRODUCTS).reshape(-1, *eye.shape) + eye
        curve = np.linalg.solve(normal, ((weight * edge) @ _HARMONICS)[..., None])[..., 0]
    return curve


def _near_curves(
    slopes: npt.NDArray[np.int16], curve: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.int16]]:
    """Return the steepest edges (n, angles) within reach of the curves, and their slopes."""
    rho = curve @ _HARMONICS.T
    within = np.abs(_MIDDLES - rho[..., None]) < _REACH
    best = np.where(within, slopes, _NO_SLOPE).argmax(axis=2)
    strength = np.where(within.any(axis=2), np.maximum(_taken(slopes, best), 0), 0)
    inner = np.clip(best, 1, len(_MIDDLES) - 2)
    left, top, right = (_taken(slopes, inner + d).astype(np.float64) for d in (-1, 0, 1))
    bend = np.minimum(left - 2.0 * top + right, -1e-3)
    shift = np.clip(0.5 * (left - right) / bend, -0.5, 0.5)
    return _MIDDLES[inner] + shift * (_RADII[1] - _RADII[0]), strength


def _fit_ellipses(
    edge: FloatArray, inlying: BoolArray, seeds: Seeds, clearness: FloatArray
) -> _Outlines:
    """Fit an ellipse to each seed's edges, `kgcp.geometry.conic.fit_ellipse` for many at once.

    The unit is the seed's radius, the origin its centre. What is no ellipse is dropped.
    """
    x, y = np.moveaxis(edge[..., None] * _DIRECTIONS, 2, 0)
    quadratic = np.stack((x * x, x * y, y * y), axis=1) * inlying[:, None]
    linear = np.stack((x, y, np.ones_like(x)), axis=1) * inlying[:, None]
    mixed = linear @ quadratic.swapaxes(1, 2)
    reduce = -np.linalg.solve(linear @ linear.swapaxes(1, 2) + _RIDGE * np.eye(3), mixed)
    scatter = quadratic @ quadratic.swapaxes(1, 2) + mixed.swapaxes(1, 2) @ reduce
    constrained = np.stack((0.5 * scatter[:, 2], -scatter[:, 1], 0.5 * scatter[:, 0]), axis=1)
    vectors = np.real(np.linalg.eig(constrained)[1])
    discriminants = 4.0 * vectors[:, 0] * vectors[:, 2] - vectors[:, 1] ** 2
    best = discriminants.argmax(axis=1)
    form = np.take_along_axis(vectors, best[:, None, None], axis=2)
    real = np.flatnonzero(discriminants.max(axis=1) > 0.0)
    coefficients = np.concatenate((form, reduce @ form), axis=1)[real, :, 0]
    centre, axes, angle, possible = _axes_of_conics(coefficients)
    seeds = seeds.chosen(real)
    return _Outlines(
        seeds.centres_px + seeds.radii_px[:, None] * centre,
        seeds.radii_px[:, None] * axes,
        angle,
        clearness[real],
    ).chosen(np.flatnonzero(possible))


def _axes_of_conics(
    coefficients: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return centres, semi-axes, directions, and which can be, of x², xy, y², x, y and 1."""
    a, b, c, d, e, f = (coefficients * np.sign(coefficients[:, :1] + coefficients[:, 2:3])).T
    determinant = 4.0 * a * c - b * b
    x, y = (b * e - 2.0 * c * d) / determinant, (b * d - 2.0 * a * e) / determinant
    depth = -(f + 0.5 * (d * x + e * y))
    middle, half = 0.5 * (a + c), 0.5 * np.hypot(a - c, b)
    squares = np.maximum(depth, 0.0) / np.stack((middle - half, middle + half))
    axes = np.sqrt(squares).T
    angle = 0.5 * np.arctan2(-b, c - a)  # of the lesser curvature
    possible = (axes[:, 1] > 0.0) & (axes[:, 0] <= _MAX_AXIS_RATIO * axes[:, 1])
    return np.stack((x, y), axis=1), axes, angle, possible
