"""Operators of the literature, for comparison: weighted centroid, and target function.

Both use the grey values as they are. They know no tone curve, no clipping, no light that falls off,
and no edge but the disc's own. Their covariances are those of independent residuals.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.discs.adjust_disc import DiscTask, geometry_of, outline_geometry
from kgcp.measurement.discs.affine_model import distances_px
from kgcp.measurement.discs.covariance import moments_by_stretch
from kgcp.measurement.discs.pixel_choice import DiscWindow, choose_pixels, cut_disc_window
from kgcp.measurement.discs.records import (
    Disc,
    DiscMiss,
    DiscReason,
    Operator,
    ellipse_of_moments,
    moments_of_ellipse,
)
from kgcp.measurement.image_model.blur import Blur

_BLUR = Blur(0.64, 0.64, 0.0)  # pixels are chosen for it: up to 5.8 px from the outline
_AROUND_PX = 2.0  # pixels farther outside the outline show the background
_THRESHOLD_SIGMAS, _THRESHOLD = 3.0, 0.06  # of the background's noise, and of the contrast
_FEWEST_PIXELS = 12


def measure_by_centroid(task: DiscTask) -> Disc | DiscMiss:
    """Measure the centroid Σ g x / Σ g, weighted by the grey values g above the background.

    This is eq. (2) of the Australis paper (seed of automatic recognition). Pixels count if they
    differ from the background by 3 σ of its noise and by 6 % of the contrast. Second moments are
    computed in the same way.
    """
    window, places, levels = _pixels(task)
    if window is None:
        return DiscMiss(task.outline, DiscReason.CROWDED, "too few pixels")
    off_px = distances_px(places, outline_geometry(task.outline))
    around = levels[off_px > _AROUND_PX]
    if len(around) < _FEWEST_PIXELS:
        return DiscMiss(task.outline, DiscReason.CROWDED, "too little free ground")
    background = float(np.median(around))
    noise = 1.4826 * float(np.median(np.abs(around - background))) + window.levels_per_count / 4.0
    weight = (background - levels) if task.is_dark else (levels - background)
    contrast = float(np.quantile(weight, 0.9))
    threshold = max(_THRESHOLD_SIGMAS * noise, _THRESHOLD * contrast)
    weight = np.where(weight > threshold, weight, 0.0)
    total = float(weight.sum())
    if total <= 0.0:
        return DiscMiss(task.outline, DiscReason.NO_CONTRAST, "nothing above the background")
    centre = places @ weight / total
    off = places - centre[:, None]
    # a blurred disc's moments, without the pixel's own
    xx, xy, yy = (
        float(weight @ (a * b)) / total for a, b in ((off[0], off[0]), off, (off[1],) * 2)
    )
    vector = np.array((*centre, xx - 1.0 / 12.0, xy, yy - 1.0 / 12.0))
    products = np.stack((off[0], off[1], off[0] ** 2 - xx, off[0] * off[1] - xy, off[1] ** 2 - yy))
    products = np.where(weight > 0.0, products, 0.0) * (noise / total)
    inside, outside = background - contrast * (1 if task.is_dark else -1), background
    return Disc(
        outline=task.outline,
        vector=vector,
        cov=products @ products.T,
        inside=inside,
        outside=outside,
        gradient=np.zeros(2),
        blur_px=math.nan,
        clipped=math.nan,
        inflation=1.0,
        pixels=int(np.count_nonzero(weight)),
        operator=Operator.CENTROID,
    )


def measure_by_gaussian(task: DiscTask) -> Disc | DiscMiss:
    """Fit the target function T = s Ω(−E) + β of Otepka & Fraser (2004), eqs. (2)-(5).

    E = x̄²/a² + ȳ²/b² − 1, and Ω is the distribution function of a Gaussian with the standard
    deviation σ. Since σ is in units of E, the blur is wider along the major axis.

    Two things differ from the paper. Derivatives are those of T itself, with ∂T/∂σ = (E/σ) s G(−E);
    eq. (9) has the wrong sign. And the ellipse is a symmetric matrix instead of (a, b, φ), as φ is
    undefined for a circle.
    """
    window, places, levels = _pixels(task)
    if window is None:
        return DiscMiss(task.outline, DiscReason.CROWDED, "too few pixels")
    geometry = outline_geometry(task.outline)
    off_px = distances_px(places, geometry)
    is_inmost = off_px <= min(-0.5, float(np.median(off_px)))
    if not is_inmost.any():  # other edges reach all pixels within
        return DiscMiss(task.outline, DiscReason.CROWDED, "no pixel within the disc")
    inside = float(np.median(levels[is_inmost]))
    outside = float(np.median(levels[off_px > min(_AROUND_PX, float(off_px.max()) - 0.5)]))
    radius_px = task.radius_px
    start = np.array((*geometry, inside - outside, outside, 1.4 / radius_px))

    from scipy.optimize import least_squares  # for those that ask for this method: 0.1 s

    def residuals(p: FloatArray) -> FloatArray:
        return target_function(p, places)[0] - levels

    def slopes(p: FloatArray) -> FloatArray:
        return target_function(p, places)[1].T

    scale = np.array((1.0, 1.0, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1))
    solution = least_squares(residuals, start, slopes, x_scale=scale, method="lm", max_nfev=60)
    freedom = len(levels) - len(start)
    scaled = target_function(solution.x, places)[1]
    normal = scaled @ scaled.T
    if not solution.success or np.linalg.cond(normal) > 1e15 or abs(solution.x[7]) < 1e-6:
        return DiscMiss(task.outline, DiscReason.POOR_FIT, "no solution")
    inverse = np.linalg.inv(normal) * (2.0 * solution.cost / freedom)
    x, y, xx, xy, yy = solution.x[:5].tolist()
    moments = 0.25 * np.array((xx * xx + xy * xy, xy * (xx + yy), xy * xy + yy * yy))
    vector = np.array((x, y, *moments))
    if not 0.5 < ellipse_of_moments(vector).mean_radius / radius_px < 2.0:
        return DiscMiss(task.outline, DiscReason.POOR_FIT, "its size is not that of its outline")
    to_moments = moments_by_stretch(solution.x[:5])
    return Disc(
        outline=task.outline,
        vector=vector,
        cov=to_moments @ inverse[:5, :5] @ to_moments.T,
        inside=float(solution.x[5] + solution.x[6]),
        outside=float(solution.x[6]),
        gradient=np.zeros(2),
        blur_px=0.5 * abs(float(solution.x[7])) * radius_px,
        clipped=math.nan,
        inflation=1.0,
        pixels=len(levels),
        operator=Operator.GAUSSIAN,
    )


def target_function(parameters: FloatArray, places_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T (n,) and its derivatives (8, n).

    Parameters
    ----------
    parameters : (8,) array
        Centre x, y and stretch xx, xy, yy [px]; s and β [levels]; σ.
    places_px : (2, n) array
    """
    x, y, xx, xy, yy, scale, background, sigma = parameters.tolist()
    inverse = np.linalg.inv(np.array(((xx, xy), (xy, yy))))
    u = inverse @ (places_px - np.array(((x,), (y,))))
    ellipse = np.sum(u * u, axis=0) - 1.0
    below = ndtr(-ellipse / sigma)
    density = np.exp(-0.5 * (ellipse / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
    # dE = −2 uᵀ M⁻¹ (dc + dM u)
    back = inverse @ u
    by_ellipse = -scale * density
    rows = [
        *(-2.0 * by_ellipse * back),
        -2.0 * by_ellipse * back[0] * u[0],
        -2.0 * by_ellipse * (back[0] * u[1] + back[1] * u[0]),
        -2.0 * by_ellipse * back[1] * u[1],
        below,
        np.ones_like(below),
        scale * density * ellipse / sigma,
    ]
    return scale * below + background, np.stack(rows)


def _pixels(task: DiscTask) -> tuple[DiscWindow | None, FloatArray, FloatArray]:
    """Return window, places (2, n) and levels (n,); no window where there are too few."""
    geometry = geometry_of(moments_of_ellipse(task.outline.ellipse))
    window = cut_disc_window(task.grey, geometry, 8.0)
    index, is_enough = choose_pixels(window, geometry, _BLUR, task.others, is_thinned=False)
    if not is_enough or len(index) < _FEWEST_PIXELS:
        return None, np.empty((2, 0)), np.empty(0)
    return window, window.places_px(index), window.levels[index]
