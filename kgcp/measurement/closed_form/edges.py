"""Sub-pixel edge points, and ellipses fitted to them: §2.4 of Cucci (2016)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse, ellipse_from_conic, fit_ellipse, sampson_distance
from kgcp.measurement.search.code_signal import clear_of_dots
from kgcp.measurement.search.sampling import MIN_EDGE_SLOPE
from kgcp.targets.layout import Ring

_OFFSETS_PX = np.array([-1.5, -0.5, 0.5, 1.5])  # of the four samples across an edge
_CUBIC_FROM_SAMPLES = np.linalg.inv(np.vander(_OFFSETS_PX, 4, increasing=True))
_SEARCH_PX = np.arange(-2.5, 2.75, 0.25)  # changes of the radius that `steepest_ellipse` tries
_MAX_SHIFT_PX = 1.5  # of an edge point from the ellipse
_MIN_SLOPE = 0.3  # relative to the median slope along the contour
_PASSES = 3
_MARGIN_PX = 8
_MIN_POINTS = 8
_MIN_SHARE = 0.25  # of the sampled places that must give an edge point
_OUTLIER_SIGMAS = 3.0  # in standard deviations of the residuals
_MIN_OUTLIER_PX = 0.1
# RMS residual that is accepted: the larger of the two. The second is relative to the radius,
# because the raw image of a large circle is not quite an ellipse.
_MAX_RMS_PX = 0.35
_MAX_RMS_SHARE = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """The measured edge of one circle."""

    points_px: FloatArray  # (n, 2): sub-pixel edge points in the raw frame [px]
    ellipse: Ellipse  # fitted to them in the raw frame [px]
    conic: FloatArray  # (3, 3): fitted to them in normalised coordinates, free of distortion


@dataclass(frozen=True, slots=True, eq=False)
class SplinePatch:
    """A part of the frame as a cubic spline, addressed by pixel coordinates of the frame."""

    spline: FloatArray
    left: int
    top: int

    def sample(self, points: FloatArray) -> FloatArray:
        """Interpolate grey values (…) at points (…, 2) of the frame [px]; NaN outside the patch."""
        from scipy import ndimage

        rows, columns = points[..., 1] - self.top, points[..., 0] - self.left
        return np.asarray(
            ndimage.map_coordinates(
                self.spline, [rows, columns], order=3, prefilter=False, cval=np.nan
            )
        )


def spline_patch_around(grey: GreyArray, ellipse: Ellipse) -> SplinePatch:
    """Cut out the part of a frame that edge points of `ellipse`, and of those inside, may need."""
    reach = ellipse.a + _MARGIN_PX
    left, top = max(0, int(ellipse.x - reach)), max(0, int(ellipse.y - reach))
    right, bottom = int(ellipse.x + reach) + 2, int(ellipse.y + reach) + 2
    part = grey[top:bottom, left:right].astype(np.float64)
    if min(part.shape) < 4:
        raise Rejection(Reason.EDGES_LOST, "the ring is outside the frame")
    from scipy import ndimage  # here, since only this method needs it: 0.05 s

    return SplinePatch(ndimage.spline_filter(part, order=3, mode="mirror"), left, top)


def steepest_ellipse(
    patch: SplinePatch, start: Ellipse, angles_rad: FloatArray, *, dark_inside: bool
) -> Ellipse:
    """Return `start` scaled by up to two pixels of radius, to where the edge is steepest.

    The four samples of `edge_points` only reach edges about a pixel away, and overexposure can
    displace an edge farther than that. The criterion is the median slope over the contour.
    """
    factors = 1.0 + _SEARCH_PX / start.mean_radius
    points = start.points(angles_rad) - start.centre
    samples = patch.sample(start.centre + factors[:, None, None] * points)
    slopes = np.median(samples[2:] - samples[:-2], axis=1) * (1.0 if dark_inside else -1.0)
    if not np.isfinite(slopes).any():
        return start
    return start.scaled(float(factors[1 + int(np.nanargmax(slopes))]))


def edge_points(
    patch: SplinePatch, ellipse: Ellipse, angles_rad: FloatArray, *, dark_inside: bool
) -> FloatArray:
    """Return the sub-pixel edge points (k, 2) [px] near n points of an ellipse, k ≤ n.

    At each point the frame is sampled at four places across the ellipse, one pixel apart. The edge
    is at the inflection of the cubic through the samples. Points are left out if there is no
    inflection of the right sign within reach, or if the edge is much fainter there than elsewhere.
    """
    normals = np.stack((np.cos(angles_rad), np.sin(angles_rad)), axis=-1) @ np.linalg.inv(
        ellipse.stretch
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    base = ellipse.points(angles_rad)
    samples = patch.sample(base[:, None] + _OFFSETS_PX[:, None] * normals[:, None])
    rising = samples if dark_inside else -samples
    _, linear, quadratic, cubic = (rising @ _CUBIC_FROM_SAMPLES.T).T
    with np.errstate(divide="ignore", invalid="ignore"):  # without a cubic term: NaN, left out
        shift = -quadratic / (3.0 * cubic)
        slope = linear + shift * quadratic
    plausible = (np.abs(shift) <= _MAX_SHIFT_PX) & (cubic < 0.0) & (slope > MIN_EDGE_SLOPE)
    if plausible.any():
        plausible &= slope >= _MIN_SLOPE * np.median(slope[plausible])
    return np.asarray((base + shift[:, None] * normals)[plausible])


def fit_edge(
    patch: SplinePatch,
    camera: Camera,
    start: Ellipse,
    *,
    ring: Ring,
    edge_diameter_m: float,
    lag_deg: float,
) -> EdgeFit:
    """Measure one edge of a ring, starting from a preliminary ellipse.

    Edge points are measured at ⌈4√(a² + b²)⌉ places on the ellipse, except near dots, and an
    ellipse is fitted to them. This is repeated. After the last pass the points are corrected for
    distortion and the ellipse is fitted in normalised coordinates.

    Raises
    ------
    Rejection
        EDGES_LOST if too few points remain, POOR_ELLIPSE if they do not lie on an ellipse.
    """
    ellipse, dark_inside = start, edge_diameter_m > ring.inner_diameter_m
    for step in range(_PASSES + 1):
        count = math.ceil(4.0 * math.hypot(ellipse.a, ellipse.b))
        angles = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
        px_per_m = 2.0 * ellipse.mean_radius / edge_diameter_m
        clear = clear_of_dots(angles, ring, edge_diameter_m, lag_deg, px_per_m)
        if step == 0:
            ellipse = steepest_ellipse(patch, ellipse, angles[clear], dark_inside=dark_inside)
            continue
        points = edge_points(patch, ellipse, angles[clear], dark_inside=dark_inside)
        if len(points) < max(_MIN_POINTS, _MIN_SHARE * count):
            raise Rejection(Reason.EDGES_LOST, f"{len(points)} of {count} edge points are left")
        points, conic = _robust_fit(points)
        ellipse = ellipse_from_conic(conic)
    rms = float(np.sqrt(np.mean(sampson_distance(conic, points) ** 2)))
    if rms > max(_MAX_RMS_PX, _MAX_RMS_SHARE * ellipse.a):
        raise Rejection(Reason.POOR_ELLIPSE, f"edge points scatter by {rms:.2f} px")
    return EdgeFit(points, ellipse, fit_ellipse(camera.undistort(points)))


def _robust_fit(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit an ellipse and drop points far from it; return the remaining points and the conic."""
    conic = fit_ellipse(points)
    for _ in range(_PASSES):
        distance = np.abs(sampson_distance(conic, points))
        limit = max(_MIN_OUTLIER_PX, _OUTLIER_SIGMAS * 1.4826 * float(np.median(distance)))
        if (distance <= limit).all():
            break
        points = points[distance <= limit]
        conic = fit_ellipse(points)
    return points, conic
