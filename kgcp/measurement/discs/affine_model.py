"""The image of a disc as an affine image of the unit circle: an ellipse, without a camera.

The ellipse has a centre c and a symmetric stretch M. In the coordinates u = M⁻¹ (p − c) the disc is
the unit circle, and the blur B of the image becomes Σ = M⁻¹ B M⁻¹. So `blurred_discs.render`, which
blurs the circles of a coded target, also blurs a disc. Derivatives are carried back: when M changes
by dM, the disc moves past a pixel by M⁻¹ dM u, and the blur changes by −(M⁻¹ dM Σ + Σ dM M⁻¹).

Pixels are squares. The blur contains the variance of their integration, but its shape is a
Gaussian's. That displaces no edge that is seen as a whole. Of a clipped edge only a part is seen;
there, blur and level made up for the difference in shape, and discs came out 0.01 px too large or
too small. So the effect of the squares' fourth cumulants on edges is added, to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.blur import REACH_SIGMAS, Blur
from kgcp.measurement.image_model.blurred_discs import render
from kgcp.measurement.image_model.blurred_plate import KURTOSIS_STEP, WhiteShare
from kgcp.measurement.image_model.quadrature import quadrature_for
from kgcp.measurement.image_model.ray_plate import JACOBIAN_ROWS, PLATE_ROWS

_VIEW_ROWS = 6
_SHIFT_ROWS = 3  # the value, and its derivatives by a shift of the disc
_SLACK_PX = 1.0  # how far the edge may move while the pixels in reach stay the same
_LEAST_SEMI_AXIS_PX = 0.4
_FOURTH_CUMULANT_PX4 = -1.0 / 120.0  # of a uniform distribution over a pixel's width

# x, y [px] and the stretch xx, xy, yy [px]
Geometry = FloatArray

NO_INNER = np.empty((0, 3))
"""`DiscPixels.inner` of a disc: no circles within its edge."""


@dataclass(frozen=True, slots=True, eq=False)
class DiscPixels:
    """n pixels of a photograph around a disc, or around a ring that is adjusted as a whole."""

    places_px: FloatArray  # (2, n)
    is_dark: bool  # whether the area within the outer edge is darker than the ground
    # (k, 3): centre and radius of the circles within the outer edge, which is the unit circle
    inner: FloatArray
    # (n,): white share of the pixels that no edge reaches
    background: FloatArray
    circles: FloatArray  # (k + 1, 5): as `render` takes them
    # (k + 2,): circle i reaches the pixels members[starts[i]:starts[i + 1]]
    starts: IndexArray
    members: IndexArray
    kurtosis: float  # excess kurtosis of the point spread, beyond that of pixels

    @classmethod
    def of(
        cls,
        places_px: FloatArray,
        geometry: Geometry,
        blur: Blur,
        *,
        is_dark: bool,
        inner: FloatArray = NO_INNER,
        kurtosis: float = 0.0,
    ) -> DiscPixels:
        """Find which pixels (2, n) an edge reaches."""
        smallest, largest = semi_axes(geometry)
        sd_px = blur.largest_sd_px
        circles = np.zeros((len(inner) + 1, 5))
        circles[0, 2], circles[1:, :3] = 1.0, inner
        circles[::2, 3], circles[1::2, 3] = (-1.0, 1.0) if is_dark else (1.0, -1.0)
        radii = circles[:, 2]
        circles[:, 4] = quadrature_for(
            smallest * radii / sd_px, largest * radii / sharpest_px(blur)
        )
        reach_px = REACH_SIGMAS * sd_px + _SLACK_PX
        off_px = distances_px(places_px, geometry)
        is_member = off_px <= reach_px if len(inner) else np.abs(off_px) <= reach_px
        members = np.flatnonzero(is_member)
        inside = (off_px < -reach_px).astype(np.float64)
        background = 1.0 - inside if is_dark else inside
        background[members] = 1.0 if is_dark else 0.0
        starts = len(members) * np.arange(len(circles) + 1)
        members = np.tile(members, len(circles))
        return cls(places_px, is_dark, inner, background, circles, starts, members, kurtosis)

    def white_share(self, geometry: Geometry, blur: Blur) -> WhiteShare:
        """Return the share of the brighter level in every pixel, with derivatives.

        Derivatives are laid out as those of a plate: rows 0…4 by the geometry, row 5 zero, then by
        the blur.
        """
        views, inverse, on_disc = self._rendered(geometry, blur)
        if self.kurtosis:
            by_kurtosis = self._by_kurtosis(views, blur, on_disc)
            on_disc[:_SHIFT_ROWS] += self.kurtosis * by_kurtosis
        members = self.members[: self.starts[1]]  # the same for all circles
        _add_fourth_cumulants(views, inverse, blur.total_covariance, self.circles, members, on_disc)
        slopes = np.empty((JACOBIAN_ROWS, views.shape[1]))
        _carry_slopes(inverse, blur.vector, views, on_disc, slopes)
        return WhiteShare(views[:2], on_disc[0], slopes)

    def by_kurtosis(self, geometry: Geometry, blur: Blur) -> FloatArray:
        """Return the derivative (n,) of the white share by the point spread's kurtosis."""
        views, _, on_disc = self._rendered(geometry, blur)
        return np.asarray(self._by_kurtosis(views, blur, on_disc)[0])

    def _rendered(
        self, geometry: Geometry, blur: Blur
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return views (6, n), inverse stretch (3,), and share with derivatives on the disc (9, n).

        The blur is Gaussian here, without kurtosis.
        """
        views, inverse = np.empty((_VIEW_ROWS, self.places_px.shape[1])), np.empty(3)
        _meet_disc(geometry, self.places_px, inverse, views)
        on_disc = np.zeros((PLATE_ROWS, views.shape[1]))
        on_disc[0] = self.background
        render(views, blur.vector, self.circles, self.starts, self.members, on_disc)
        return views, inverse, on_disc

    def _by_kurtosis(self, views: FloatArray, blur: Blur, on_disc: FloatArray) -> FloatArray:
        """Return the derivative by the point spread's kurtosis, as `blurred_plate.kurtosis_row`.

        It is that of the share, and of its derivatives by a shift of the disc (3, n), without those
        by the blur. `on_disc` is without kurtosis.
        """
        changed = np.zeros_like(on_disc)
        for factor in (1.0 + KURTOSIS_STEP, 1.0 - KURTOSIS_STEP):
            vector = blur.vector * np.array((factor, factor, factor, 1.0, 1.0))
            render(views, vector, self.circles, self.starts, self.members, changed)
        changed[0] += 2.0 * self.background
        difference = changed[:_SHIFT_ROWS] - 2.0 * on_disc[:_SHIFT_ROWS]
        return np.asarray(difference / (6.0 * KURTOSIS_STEP**2))

    def shares_within(self, geometry: Geometry, blur: Blur) -> FloatArray:
        """Return the share (k + 1, n) of every pixel that each blurred circle of a ring covers."""
        views, inverse = np.empty((_VIEW_ROWS, self.places_px.shape[1])), np.empty(3)
        _meet_disc(geometry, self.places_px, inverse, views)
        shares = np.zeros((len(self.circles), 1, views.shape[1]))
        for circle, begin, end, share in zip(
            self.circles, self.starts[:-1], self.starts[1:], shares, strict=True
        ):
            alone = np.where(np.arange(5) == 3, 1.0, circle)[None]
            reached = np.array([0, end - begin])
            render(views, blur.vector, alone, reached, self.members[begin:end], share)
        return shares[:, 0]


def semi_axes(geometry: Geometry) -> tuple[float, float]:
    """Return the smaller and the larger semi-axis [px]."""
    _, _, xx, xy, yy = geometry.tolist()
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return mean - half, mean + half


def mean_radius_px(geometry: Geometry) -> float:
    """Return the radius of the circle of the same area [px]."""
    return math.sqrt(math.prod(semi_axes(geometry)))


def sharpest_px(blur: Blur) -> float:
    """Return the standard deviation along the direction of the weakest blur [px]."""
    xx, yy, xy = blur.total_covariance
    least = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy)
    return math.sqrt(max(least, 1e-6))


def limited(geometry: Geometry) -> Geometry:
    """Return the geometry with semi-axes that are large enough, after a step that went too far."""
    smallest, _ = semi_axes(geometry)
    if smallest >= _LEAST_SEMI_AXIS_PX:
        return geometry
    values, axes = np.linalg.eigh(geometry[[2, 3, 3, 4]].reshape(2, 2))
    matrix = axes * np.maximum(values, _LEAST_SEMI_AXIS_PX) @ axes.T
    return np.array((*geometry[:2], matrix[0, 0], matrix[0, 1], matrix[1, 1]))


def distances_px(places_px: FloatArray, geometry: Geometry) -> FloatArray:
    """Return first-order distances (n,) of pixels from the ellipse, negative inside [px]."""
    off_px = np.empty(places_px.shape[1])
    _distances(places_px, geometry, off_px)
    return off_px


@compiled
def _distances(places_px: FloatArray, geometry: FloatArray, off_px: FloatArray) -> None:
    determinant = geometry[2] * geometry[4] - geometry[3] * geometry[3]
    a, b, d = geometry[4] / determinant, -geometry[3] / determinant, geometry[2] / determinant
    for i in range(len(off_px)):
        x, y = places_px[0, i] - geometry[0], places_px[1, i] - geometry[1]
        u, v = a * x + b * y, b * x + d * y
        rho = math.sqrt(u * u + v * v)
        slope_x, slope_y = a * u + b * v, b * u + d * v
        slope = math.sqrt(slope_x * slope_x + slope_y * slope_y)
        # the centre has no direction: the mean radius is its distance
        off_px[i] = (rho - 1.0) * rho / slope if rho > 1e-6 else -math.sqrt(determinant)


@compiled
def _meet_disc(
    geometry: FloatArray, places_px: FloatArray, inverse: FloatArray, views: FloatArray
) -> None:
    """Fill in the inverse stretch (3,) xx, xy, yy and the first rows of the plate views."""
    determinant = geometry[2] * geometry[4] - geometry[3] * geometry[3]
    inverse[0], inverse[1] = geometry[4] / determinant, -geometry[3] / determinant
    inverse[2] = geometry[2] / determinant
    for i in range(places_px.shape[1]):
        x, y = places_px[0, i] - geometry[0], places_px[1, i] - geometry[1]
        views[0, i] = inverse[0] * x + inverse[1] * y
        views[1, i] = inverse[1] * x + inverse[2] * y
        views[2, i], views[3, i] = inverse[0], inverse[1]
        views[4, i], views[5, i] = inverse[1], inverse[2]


@compiled
def _carry_slopes(
    inverse: FloatArray,
    blur: FloatArray,
    views: FloatArray,
    on_disc: FloatArray,
    slopes: FloatArray,
) -> None:
    """Carry derivatives from the unit circle to the ellipse and to the blur in the image."""
    a, b, d = inverse[0], inverse[1], inverse[2]
    side_ax, side_ay = blur[0] * a + blur[2] * b, blur[2] * a + blur[1] * b
    side_bx, side_by = blur[0] * b + blur[2] * d, blur[2] * b + blur[1] * d
    sxx, sxy = side_ax * a + side_ay * b, side_ax * b + side_ay * d
    syy = side_bx * b + side_by * d
    for i in range(views.shape[1]):
        t1, t2 = on_disc[1, i], on_disc[2, i]
        t4, t5, t6 = on_disc[4, i], on_disc[5, i], on_disc[6, i]
        u, v = views[0, i], views[1, i]
        slopes[0, i], slopes[1, i] = t1 * a + t2 * b, t1 * b + t2 * d
        # G = M⁻¹ E with E = xx: [[a, 0], [b, 0]]; yy: [[0, b], [0, d]]; xy: [[b, a], [d, b]]
        slopes[2, i] = (t1 * a + t2 * b) * u - 2.0 * (
            t4 * a * sxx + t5 * (a * sxy + b * sxx) + t6 * b * sxy
        )
        slopes[4, i] = (t1 * b + t2 * d) * v - 2.0 * (
            t4 * b * sxy + t5 * (b * syy + d * sxy) + t6 * d * syy
        )
        gxx, gxy = b * sxx + a * sxy, b * sxy + a * syy
        gyx, gyy = d * sxx + b * sxy, d * sxy + b * syy
        slopes[3, i] = t1 * (b * u + a * v) + t2 * (d * u + b * v)
        slopes[3, i] -= 2.0 * (t4 * gxx + t5 * (gxy + gyx) + t6 * gyy)
        slopes[5, i] = 0.0
        by_xx = (t4 * a + 2.0 * t5 * b) * a + t6 * b * b
        by_yy = (t4 * b + 2.0 * t5 * d) * b + t6 * d * d
        slopes[6, i], slopes[7, i] = by_xx + by_yy, by_xx - by_yy
        slopes[8, i] = 2.0 * (t4 * a * b + t5 * (a * d + b * b) + t6 * b * d)
        slopes[9, i] = slopes[10, i] = 0.0


@compiled
def _add_fourth_cumulants(
    views: FloatArray,
    inverse: FloatArray,
    covariance: tuple[float, float, float],
    circles: FloatArray,
    members: IndexArray,
    on_disc: FloatArray,
) -> None:
    """Add the effect of the pixels' fourth cumulants κ along x and along y on the edges.

    It is κ/24 times the sum of the fourth derivatives along x and y. For a straight edge with the
    unit normal (a, b), blurred to Φ(z) with z = distance/σ, that sum is (a⁴ + b⁴) (3z − z³)
    φ(z)/σ⁴. The effect is added to the value and to its derivatives by a shift of the disc, as
    `render` has them, not to those by the blur.
    """
    xx, yy, xy = covariance
    for c in range(len(circles)):
        factor = circles[c, 3] * _FOURTH_CUMULANT_PX4 / 24.0 / math.sqrt(2.0 * math.pi)
        for i in members:
            u, v = views[0, i] - circles[c, 0], views[1, i] - circles[c, 1]
            rho = max(math.sqrt(u * u + v * v), 1e-9)
            x = (inverse[0] * u + inverse[1] * v) / rho
            y = (inverse[1] * u + inverse[2] * v) / rho
            per_px2 = x * x + y * y
            spread2 = (xx * x * x + 2.0 * xy * x * y + yy * y * y) / per_px2  # σ² along the normal
            per_sd = math.sqrt(per_px2 * spread2)
            z = (circles[c, 2] - rho) / per_sd
            directed = (x**4 + y**4) / (per_px2 * per_px2)
            scale = factor * directed * math.exp(-0.5 * z * z) / (spread2 * spread2)
            on_disc[0, i] += scale * (3.0 - z * z) * z
            by_shift = scale * (z**4 - 6.0 * z * z + 3.0) / (rho * per_sd)
            on_disc[1, i] += by_shift * u
            on_disc[2, i] += by_shift * v
