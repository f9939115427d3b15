"""Moments of aberrated point spreads, measured on the image of a point."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.simulation.imaging import Optics
from kgcp.simulation.point_spread import Aberration

SIZE, FINE = 41, 5


def point_image(optics: Optics) -> FloatArray:
    """Image of a point in the middle of the middle pixel, on sub-pixels."""
    scene = np.zeros((SIZE * FINE, SIZE * FINE))
    scene[SIZE * FINE // 2, SIZE * FINE // 2] = 1.0
    return optics.spread(scene, 1)


def axes() -> tuple[FloatArray, FloatArray]:
    places = np.arange(SIZE * FINE) - float(SIZE * FINE // 2)
    return places[None, :] / FINE, places[:, None] / FINE


def image_of(aberration: Aberration, psf_px: float = 0.8) -> FloatArray:
    return point_image(Optics(FINE * psf_px, aberration=aberration))


@pytest.mark.parametrize("coma", [0.05, 0.2, 0.24])
@pytest.mark.parametrize("direction_deg", [0.0, 110.0, 245.0])
def test_the_centroid_of_coma_stays_where_it_is(coma: float, direction_deg: float) -> None:
    image = image_of(Aberration(1.6, 35.0, coma, direction_deg))
    x, y = axes()
    assert image.sum() == pytest.approx(1.0, abs=1e-8)
    assert abs((image * x).sum()) < 1e-6
    assert abs((image * y).sum()) < 1e-6


def test_defocus_spreads_a_point_over_a_disc() -> None:
    focused, defocused = image_of(Aberration()), image_of(Aberration(defocus_px=FINE * 1.6))
    x, _ = axes()
    assert defocused.sum() == pytest.approx(1.0, abs=1e-8)
    variance = ((defocused - focused) * x * x).sum()
    assert variance == pytest.approx(1.6**2 / 4.0, rel=1e-3)
    # fourth cumulants add up, and a Gaussian has none: a⁴/8 − 3 (a²/4)² along each axis
    fourth = (defocused * x**4).sum() - 3.0 * (0.8**2 + variance) ** 2
    assert fourth == pytest.approx(-(1.6**4) / 16.0, rel=5e-3)


@pytest.mark.parametrize("coma", [0.0, 0.2])
def test_second_moments_are_those_of_the_astigmatism(coma: float) -> None:
    aberration = Aberration(1.6, 35.0, coma, 110.0)
    image = image_of(aberration)
    x, y = axes()
    moments = np.array(
        [
            [(image * x * x).sum(), (image * x * y).sum()],
            [(image * x * y).sum(), (image * y * y).sum()],
        ]
    )
    assert_allclose(moments, aberration.covariance_px2(0.8), atol=1e-6)
    small, large = np.sqrt(np.linalg.eigvalsh(moments))
    assert large / small == pytest.approx(1.6, abs=1e-5)
    assert large * small == pytest.approx(0.64, abs=1e-5)


def test_third_moments_are_those_of_seidels_coma() -> None:
    image = image_of(Aberration(1.3, 35.0, 0.25, 60.0))
    x, y = axes()
    along = 0.5 * x + np.sqrt(0.75) * y
    across = -np.sqrt(0.75) * x + 0.5 * y
    assert (image * along**3).sum() == pytest.approx(0.25 * 0.8**3, rel=1e-3)
    assert (image * along * across**2).sum() == pytest.approx(0.25 * 0.8**3 / 3.0, rel=1e-3)
    assert abs((image * across**3).sum()) < 1e-6
    assert image.min() > -1e-7


def test_without_aberration_the_spread_is_the_gaussian() -> None:
    assert_allclose(image_of(Aberration()), point_image(Optics(FINE * 0.8)), atol=1e-15)


@given(
    ratio=st.floats(1.0, 2.5),
    share=st.floats(0.0, 1.0),
    direction_deg=st.floats(0.0, 360.0),
    psf_px=st.floats(0.4, 2.0),
)
def test_every_admitted_spread_keeps_uniform_light(
    ratio: float, share: float, direction_deg: float, psf_px: float
) -> None:
    coma = share * 0.5 / ratio**1.5 * (1.0 - 1e-12)
    optics = Optics(psf_px, aberration=Aberration(ratio, 20.0, coma, direction_deg))
    assert_allclose(optics.spread(np.full((12, 15), 0.37), 3), 0.37, atol=1e-12)


def test_more_coma_than_the_spread_can_hold_is_refused() -> None:
    with pytest.raises(SettingError, match=r"give at most 0\.24"):
        Aberration(astigmatism=1.6, coma=0.3)
    with pytest.raises(SettingError, match="astigmatism"):
        Aberration(astigmatism=0.9)
