"""From places that may be a ring's to the ellipses of outer edges, all at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.conic import Ellipse
from kgcp.target.distinct import distinct
from kgcp.target.rays import RAYS, RAYS_RAD, follow
from kgcp.target.seeds import Level, Seeds

_DIRECTIONS = np.stack((np.cos(RAYS_RAD), np.sin(RAYS_RAD)), axis=-1)
_FINEST_RADIUS_PX = 12.0
_MAX_AXIS_RATIO = 2.0
_NEAR, _ALIKE = 0.25, 0.15  # of one ring: distance of centres, of its radius; ratio of radii
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
    kept = distinct(outlines.centres_px, outlines.radii_px, outlines.clearness, _NEAR, _ALIKE)
    return outlines.chosen(kept)


def _follow(pyramid: tuple[Level, ...], seeds: Seeds) -> _Outlines:
    """Return an ellipse for every seed that has an outline."""
    edges = np.empty((len(seeds), RAYS))
    inlying = np.empty((len(seeds), RAYS), dtype=np.bool_)
    wanted = np.floor(np.log2(np.maximum(seeds.radii_px / _FINEST_RADIUS_PX, 1.0))).astype(np.intp)
    wanted = np.minimum(wanted, len(pyramid) - 1)
    for index in np.unique(wanted):
        level, members = pyramid[index], np.flatnonzero(wanted == index)
        centres = level.from_frame(seeds.centres_px[members])
        found = np.empty((len(members), RAYS)), np.empty((len(members), RAYS), dtype=np.bool_)
        follow(level.image, centres, seeds.radii_px[members] / level.factor, *found)
        edges[members], inlying[members] = found
    share = inlying.mean(axis=1)
    good = np.flatnonzero(share)
    return _fit_ellipses(
        edges[good], inlying[good], seeds.chosen(good), share[good] * seeds.contrasts[good]
    )


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
