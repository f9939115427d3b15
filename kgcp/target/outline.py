"""From places that may be a ring's to the ellipses of outer edges, many at once."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.errors import Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.conic import Ellipse, ellipse_from_conic, fit_ellipse
from kgcp.target.seeds import Level, Seeds

_ANGLES = 40
_ANGLES_RAD = 2.0 * np.pi / _ANGLES * np.arange(_ANGLES)
_RADII = np.arange(0.5, 1.71, 0.04)  # of the seed's radius
_STEP = 2  # samples either side that a slope is taken over
_FINEST_RADIUS_PX = 12.0
# ρ(θ) of an ellipse that is not far from a circle, nor its centre from the seed's.
_HARMONICS = np.stack(
    [np.ones(_ANGLES), *(f(k * _ANGLES_RAD) for k in (1, 2) for f in (np.cos, np.sin))], axis=1
)
_PRODUCTS = np.einsum("ai,aj->aij", _HARMONICS, _HARMONICS).reshape(_ANGLES, -1)
_WIDTHS = (0.25, 0.12, 0.07, 0.05, 0.05)  # of the weighting of residuals, of the seed's radius
_INLIER = 0.07
_MIN_INLIERS = 0.55
_MAX_AXIS_RATIO = 2.0


def find_outlines(pyramid: tuple[Level, ...], seeds: Seeds) -> tuple[Ellipse, ...]:
    """Follow the outer edge of every seed's ring and fit an ellipse to it.

    Twice: the centre of a large ring is known to some pixels at first.
    """
    return _distinct(_follow(pyramid, _reseeded(_follow(pyramid, seeds))))


def _follow(pyramid: tuple[Level, ...], seeds: Seeds) -> list[tuple[float, Ellipse]]:
    """Return an ellipse for every seed that has an outline, and how clear it is; best first."""
    found: list[tuple[float, Ellipse]] = []
    level_of = _finest_levels(pyramid, seeds.radii_px)
    for index, level in enumerate(pyramid):
        members = seeds.chosen(np.flatnonzero(level_of == index))
        if len(members):
            found += _outlines_in_level(level, members)
    return sorted(found, key=lambda item: -item[0])


def _reseeded(found: list[tuple[float, Ellipse]]) -> Seeds:
    outlines = _distinct(found)
    return Seeds(
        np.array([outline.centre for outline in outlines]).reshape(-1, 2),
        np.array([outline.mean_radius for outline in outlines]),
        np.ones(len(outlines)),
    )


def _distinct(found: list[tuple[float, Ellipse]]) -> tuple[Ellipse, ...]:
    """Drop ellipses that agree with an earlier one."""
    ellipses = [ellipse for _, ellipse in found]
    table = np.array([(e.x, e.y, e.mean_radius) for e in ellipses]).reshape(-1, 3)
    free = np.ones(len(table), dtype=bool)
    kept = []
    for i, (x, y, radius) in enumerate(table):
        if not free[i]:
            continue
        kept.append(ellipses[i])
        apart = np.hypot(table[:, 0] - x, table[:, 1] - y)
        free &= (apart > 0.25 * radius) | (np.abs(np.log(table[:, 2] / radius)) > 0.15)
    return tuple(kept)


def _finest_levels(pyramid: tuple[Level, ...], radii_px: FloatArray) -> IndexArray:
    wanted = np.floor(np.log2(np.maximum(radii_px / _FINEST_RADIUS_PX, 1.0))).astype(np.intp)
    return np.minimum(wanted, len(pyramid) - 1)


def _outlines_in_level(level: Level, seeds: Seeds) -> list[tuple[float, Ellipse]]:
    centres = level.from_frame(seeds.centres_px)
    radii = seeds.radii_px / level.factor
    slopes = _radial_slopes(level.image, centres, radii)
    edge, strength = _first_guess(slopes)
    curve = _fit_curves(edge, strength)
    fair = (np.abs(edge - curve @ _HARMONICS.T) < 2.0 * _INLIER).mean(axis=1) > _MIN_INLIERS - 0.15
    slopes, curve, centres, radii = slopes[fair], curve[fair], centres[fair], radii[fair]
    seeds = seeds.chosen(np.flatnonzero(fair))
    edge, strength, near = _near_curve(slopes, curve)
    curve = _fit_curves(edge, np.where(near, strength, 0.0), _WIDTHS[2:])
    residual = np.abs(edge - curve @ _HARMONICS.T)
    inlying = near & (residual < _INLIER) & (strength > 0.0)
    share = inlying.mean(axis=1)
    result = []
    for i in np.flatnonzero(share >= _MIN_INLIERS):
        rho = edge[i, inlying[i]] * radii[i]
        angle = _ANGLES_RAD[inlying[i]]
        points = centres[i] + rho[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
        ellipse = _ellipse_through(points, level)
        if ellipse is not None:
            result.append((float(share[i] * seeds.contrasts[i]), ellipse))
    return result


def _ellipse_through(points: FloatArray, level: Level) -> Ellipse | None:
    try:
        found = ellipse_from_conic(fit_ellipse(points))
    except Rejection:
        return None
    if found.a > _MAX_AXIS_RATIO * found.b:
        return None
    k = float(level.factor)
    return Ellipse(
        k * (found.x + 0.5) - 0.5,
        k * (found.y + 0.5) - 0.5,
        k * found.a,
        k * found.b,
        found.angle_rad,
    )


def _radial_slopes(image: GreyArray, centres: FloatArray, radii: FloatArray) -> FloatArray:
    """Return slopes (n, angles, radii) outwards of the grey values around n centres."""
    directions = np.stack((np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)), axis=-1).astype(np.float32)
    rays = directions[:, None] * _RADII.astype(np.float32)[None, :, None]
    points = (
        centres[:, None, None].astype(np.float32)
        + radii[:, None, None, None].astype(np.float32) * rays
    )
    points = points.reshape(len(radii), -1, 2)
    values = _remap(image, points).reshape(len(radii), _ANGLES, len(_RADII))
    return np.asarray(values[..., 2 * _STEP :].astype(np.float64) - values[..., : -2 * _STEP])


def _remap(image: GreyArray, points: npt.NDArray[np.float32]) -> GreyArray:
    """Sample bilinearly at points (m, k, 2); OpenCV takes at most 32767 rows at once."""
    parts = [
        cv2.remap(
            image, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for part in np.array_split(points, len(points) // 30000 + 1)
    ]
    return np.concatenate(parts)


_MIDDLES = _RADII[_STEP:-_STEP]


def _first_guess(slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
    best = slopes.argmax(axis=2)
    return _MIDDLES[best], np.maximum(
        np.take_along_axis(slopes, best[..., None], axis=2)[..., 0], 0.0
    )


def _fit_curves(
    edge: FloatArray, strength: FloatArray, widths: tuple[float, ...] = _WIDTHS
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


def _near_curve(
    slopes: FloatArray, curve: FloatArray
) -> tuple[FloatArray, FloatArray, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
    """Return the steepest edge within reach of each curve."""
    rho = curve @ _HARMONICS.T
    within = np.abs(_MIDDLES - rho[..., None]) < 0.17
    masked = np.where(within, slopes, -1e3)
    best = masked.argmax(axis=2)
    strength = np.take_along_axis(masked, best[..., None], axis=2)[..., 0]
    inner = np.clip(best, 1, len(_MIDDLES) - 2)
    left, top, right = (
        np.take_along_axis(slopes, (inner + d)[..., None], axis=2)[..., 0] for d in (-1, 0, 1)
    )
    bend = np.minimum(left - 2.0 * top + right, -1e-3)
    shift = np.clip(0.5 * (left - right) / bend, -0.5, 0.5)
    step = _RADII[1] - _RADII[0]
    return _MIDDLES[inner] + shift * step, np.maximum(strength, 0.0), strength > 0.0
