"""The affine image of a disc against plain integration, and its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ncx2

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.discs.affine_model import NO_INNER, DiscPixels, distances_px
from kgcp.measurement.image_model.blur import Blur

SHAPES = {
    "small": (np.array([20.3, 19.6, 3.4, 0.5, 2.6]), 0.7),
    "blurred": (np.array([20.3, 19.6, 4.4, -0.8, 3.6]), 1.6),
    "large": (np.array([20.3, 19.6, 13.0, 2.0, 9.0]), 0.7),
}


def places(size: int = 41) -> FloatArray:
    rows, columns = np.mgrid[0:size, 0:size].astype(np.float64)
    return np.stack((columns.ravel(), rows.ravel()))


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("is_dark", [True, False])
def test_share_is_that_of_a_blurred_ellipse(name: str, *, is_dark: bool) -> None:
    """A blur of the ellipse's own shape is round where the ellipse is the unit circle."""
    geometry, sd = SHAPES[name]
    inner = np.array([[0.1, -0.05, 0.5]])
    stretch = geometry[[2, 3, 3, 4]].reshape(2, 2)
    relative = sd / np.sqrt(np.linalg.det(stretch))
    (xx, xy), (_, yy) = relative**2 * stretch @ stretch
    blur = Blur(xx, yy, xy)
    share = DiscPixels.of(places(), geometry, blur, is_dark=is_dark)
    value = share.white_share(geometry, blur).value
    offset = np.linalg.inv(stretch) @ (places() - geometry[:2, None])
    expected = ncx2.cdf(1.0 / relative**2, 2, np.sum(offset**2, axis=0) / relative**2)
    assert value == pytest.approx(1.0 - expected if is_dark else expected, abs=3e-4)
    ring = DiscPixels.of(places(), geometry, blur, is_dark=is_dark, inner=inner)
    hole = ncx2.cdf(
        (0.5 / relative) ** 2, 2, np.sum((offset - inner[0, :2, None]) ** 2, axis=0) / relative**2
    )
    value = ring.white_share(geometry, blur).value
    assert value == pytest.approx(1.0 - expected + hole if is_dark else expected - hole, abs=6e-4)
    assert ring.shares_within(geometry, blur)[1] == pytest.approx(hole, abs=3e-4)


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
        # derivatives of what oblique blur does to the curvature are left out
        assert slopes[row] == pytest.approx(
            numeric, abs=(0.12 if row in blurs else 0.02) * scale
        ), row


def test_distances_are_those_of_the_ellipse() -> None:
    geometry = np.array([20.0, 20.0, 10.0, 0.0, 5.0])
    points = np.array([[32.0, 20.0, 20.0, 20.0], [20.0, 26.0, 14.0, 20.0]])
    assert distances_px(points, geometry)[:3] == pytest.approx([2.0, 1.0, 1.0])
    assert distances_px(points, geometry)[3] < -4.0
