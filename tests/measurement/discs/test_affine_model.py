"""The affine image of a disc against plain integration, and its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ncx2, norm

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.discs.affine_model import NO_INNER, DiscPixels, distances_px
from kgcp.measurement.image_model.blur import Blur

PIXEL_PX2 = 1.0 / 12.0  # variance of an even distribution over a pixel's width
SUBPIXELS = 8  # per pixel, each way
SHAPES = {
    "small": (np.array([20.3, 19.6, 3.4, 0.5, 2.6]), 0.7),
    "blurred": (np.array([20.3, 19.6, 4.4, -0.8, 3.6]), 1.6),
    "large": (np.array([20.3, 19.6, 13.0, 2.0, 9.0]), 0.7),
}


def places(size: int = 41) -> FloatArray:
    rows, columns = np.mgrid[0:size, 0:size].astype(np.float64)
    return np.stack((columns.ravel(), rows.ravel()))


def seen_by_pixels(
    centre: FloatArray, stretch: FloatArray, radius: float, relative: float
) -> FloatArray:
    """Return which share of the light of each pixel comes from within an ellipse.

    It is blurred by a Gaussian of the ellipse's own shape, which is round where that is the unit
    circle, and integrated over the pixels' squares.
    """
    total = np.zeros(places().shape[1])
    within = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    for dx in within:
        for dy in within:
            off_px = places() + np.array((dx, dy))[:, None] - centre[:, None]
            square = np.sum((np.linalg.inv(stretch) @ off_px) ** 2, axis=0)
            total += ncx2.cdf((radius / relative) ** 2, 2, square / relative**2)
    return total / SUBPIXELS**2


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("is_dark", [True, False])
def test_share_is_that_of_a_blurred_ellipse_in_square_pixels(name: str, *, is_dark: bool) -> None:
    geometry, sd = SHAPES[name]
    inner = np.array([[0.1, -0.05, 0.5]])
    centre, stretch = geometry[:2], geometry[[2, 3, 3, 4]].reshape(2, 2)
    relative = sd / np.sqrt(np.linalg.det(stretch))
    (xx, xy), (_, yy) = relative**2 * stretch @ stretch
    blur = Blur(xx + PIXEL_PX2, yy + PIXEL_PX2, xy)
    share = DiscPixels.of(places(), geometry, blur, is_dark=is_dark)
    value = share.white_share(geometry, blur).value
    expected = seen_by_pixels(centre, stretch, 1.0, relative)
    assert value == pytest.approx(1.0 - expected if is_dark else expected, abs=5e-4)
    ring = DiscPixels.of(places(), geometry, blur, is_dark=is_dark, inner=inner)
    hole = seen_by_pixels(centre + stretch @ inner[0, :2], stretch, 0.5, relative)
    value = ring.white_share(geometry, blur).value
    assert value == pytest.approx(1.0 - expected + hole if is_dark else expected - hole, abs=1e-3)


def test_shares_within_circles_are_those_of_a_gaussian_blur() -> None:
    geometry, sd = SHAPES["small"]
    inner = np.array([[0.1, -0.05, 0.5]])
    stretch = geometry[[2, 3, 3, 4]].reshape(2, 2)
    relative = sd / np.sqrt(np.linalg.det(stretch))
    (xx, xy), (_, yy) = relative**2 * stretch @ stretch
    blur = Blur(xx, yy, xy)
    ring = DiscPixels.of(places(), geometry, blur, is_dark=True, inner=inner)
    offset = np.linalg.inv(stretch) @ (places() - geometry[:2, None])
    for share, (x, y, radius) in zip(
        ring.shares_within(geometry, blur), ((0.0, 0.0, 1.0), *inner.tolist()), strict=True
    ):
        square = (offset[0] - x) ** 2 + (offset[1] - y) ** 2
        expected = ncx2.cdf((radius / relative) ** 2, 2, square / relative**2)
        assert share == pytest.approx(expected, abs=3e-4)


def test_a_straight_edge_in_square_pixels_is_not_that_of_a_gaussian() -> None:
    """Along x, square pixels change the profile by 0.001 of the contrast; a fifth of it is left."""
    geometry, sd = np.array([20.3, 19.6, 4000.0, 0.0, 4000.0]), 0.6
    geometry[0] -= 4000.0
    blur = Blur(sd**2 + PIXEL_PX2, sd**2 + PIXEL_PX2, 0.0)
    row = np.stack((np.linspace(17.0, 24.0, 141), np.full(141, 19.6)))
    off_px = 20.3 - row[0]
    value = DiscPixels.of(row, geometry, blur, is_dark=False).white_share(geometry, blur).value

    def integral(x: FloatArray) -> FloatArray:
        z = x / sd
        return np.asarray(x * norm.cdf(z) + sd * norm.pdf(z))

    expected = integral(off_px + 0.5) - integral(off_px - 0.5)
    gaussian = norm.cdf(off_px / blur.mean_sd_px)
    assert np.abs(gaussian - expected).max() > 8e-4
    assert np.abs(value - expected).max() < 0.2 * np.abs(gaussian - expected).max()


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("is_ring", [False, True])
def test_derivatives_are_those_of_the_share(name: str, *, is_ring: bool) -> None:
    geometry, sd = SHAPES[name]
    blur, step = Blur(sd * sd, 1.1 * sd * sd, 0.05), 1e-4
    inner = np.array([[0.1, -0.05, 0.5]]) if is_ring else NO_INNER
    pixels = DiscPixels.of(places(), geometry, blur, is_dark=True, inner=inner)
    slopes = pixels.white_share(geometry, blur).jacobian
    blurs = {6: (1.0, 1.0, 0.0), 7: (1.0, -1.0, 0.0), 8: (0.0, 0.0, 1.0)}
    for row in (*range(5), *blurs):
        shares = []
        for sign in (1.0, -1.0):
            moved, other = geometry.copy(), blur
            if row in blurs:
                xx, yy, xy = (sign * step * part for part in blurs[row])
                other = Blur(blur.xx + xx, blur.yy + yy, blur.xy + xy)
            else:
                moved[row] += sign * step
            shares.append(pixels.white_share(moved, other).value)
        numeric = (shares[0] - shares[1]) / (2.0 * step)
        scale = np.abs(numeric).max()
        # derivatives of the term of oblique blur and curvature are neglected
        assert slopes[row] == pytest.approx(
            numeric, abs=(0.12 if row in blurs else 0.02) * scale
        ), row


def test_distances_are_those_of_the_ellipse() -> None:
    geometry = np.array([20.0, 20.0, 10.0, 0.0, 5.0])
    points = np.array([[32.0, 20.0, 20.0, 20.0], [20.0, 26.0, 14.0, 20.0]])
    assert distances_px(points, geometry)[:3] == pytest.approx([2.0, 1.0, 1.0])
    assert distances_px(points, geometry)[3] < -4.0
