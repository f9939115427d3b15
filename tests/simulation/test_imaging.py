import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.ndimage import convolve, gaussian_filter

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve

SENSORS = [
    Sensor(),
    Sensor(full_well_e=3000.0, read_noise_e=20.0),
    Sensor(tone=ToneCurve.SRGB),
    Sensor(full_well_e=4000.0, tone=ToneCurve.FILM, sharpening=0.6, sharpening_px=1.1),
]


def expected(sensor: Sensor, light: FloatArray, gain: float) -> FloatArray:
    """Grey values 0…255 of an exposure without noise, not rounded."""
    grey = sensor.tone.apply(np.minimum(gain * light, 1.0))
    if sensor.sharpening:
        grey = grey + sensor.sharpening * (grey - gaussian_filter(grey, sensor.sharpening_px))
    return np.asarray(255.0 * np.clip(grey, 0.0, 1.0))


def variance(sensor: Sensor, light: FloatArray, gain: float) -> FloatArray:
    """Noise variance of the grey values, to first order, with 1/12 for rounding.

    Shot and read noise through the slope of the tone curve, spread by the squared kernel of the
    unsharp mask. Clipped pixels have the variance of rounding alone.
    """
    exposure = gain * light
    electrons = sensor.full_well_e * exposure + sensor.read_noise_e**2
    noise = electrons / sensor.full_well_e**2
    noise = noise * sensor.tone.slope(np.clip(exposure, 0.0, 1.0)) ** 2
    noise[(exposure <= 0.0) | (exposure >= 1.0)] = 0.0
    impulse = np.zeros((21, 21))
    impulse[10, 10] = 1.0
    smooth = gaussian_filter(impulse, sensor.sharpening_px)
    kernel = impulse + sensor.sharpening * (impulse - smooth)
    return np.asarray(255.0**2 * convolve(noise, kernel * kernel) + 1.0 / 12.0)


@given(tone=st.sampled_from(ToneCurve), x=st.floats(0.01, 0.99))
def test_slope_is_the_derivative(tone: ToneCurve, x: float) -> None:
    low, high = tone.apply(np.array([x - 1e-5, x + 1e-5]))
    assert float(tone.slope(np.array([x]))[0]) == pytest.approx((high - low) / 2e-5, rel=1e-2)


@pytest.mark.parametrize("tone", ToneCurve)
def test_tone_curves_rise_from_black_to_white(tone: ToneCurve) -> None:
    grey = tone.apply(np.linspace(0.0, 1.0, 1000))
    assert_allclose(grey[[0, -1]], [0.0, 1.0], atol=1e-12)
    assert np.all(np.diff(grey) > 0.0)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("level", [0.1, 0.4, 0.8])
def test_noise_has_the_declared_variance_and_no_bias(sensor: Sensor, level: float) -> None:
    light = np.full((200, 300), level)
    grey = sensor.expose(light, 0.9, np.random.default_rng(11)).astype(float)
    inner = grey[10:-10, 10:-10]
    assert inner.var() == pytest.approx(variance(sensor, light, 0.9)[100, 100], rel=0.05)
    assert abs(inner.mean() - expected(sensor, light, 0.9)[0, 0]) < 0.1


def test_overexposed_pixels_are_white_and_silent() -> None:
    light = np.full((20, 20), 0.8)
    grey = Sensor().expose(light, 2.0, np.random.default_rng(1))
    assert grey.dtype == np.uint8
    assert np.all(grey == 255)
    assert_allclose(variance(Sensor(), light, 2.0), 1.0 / 12.0)


def test_gain_is_exposure_not_amplification() -> None:
    light = np.full((400, 400), 0.5)
    low = Sensor().expose(light, 0.5, np.random.default_rng(1)).astype(float)
    high = Sensor().expose(light, 1.5, np.random.default_rng(1)).astype(float)
    assert high.mean() / low.mean() == pytest.approx(3.0, rel=1e-3)
    # Shot noise grows with the square root of the light only.
    assert high.std() / low.std() == pytest.approx(np.sqrt(3.0), rel=0.03)


def test_sharpening_overshoots_at_edges() -> None:
    step = np.tile(np.repeat([0.2, 0.6], 20), (40, 1))
    plain = expected(Sensor(), step, 1.0)
    sharp = expected(Sensor(sharpening=0.8), step, 1.0)
    assert sharp.max() > plain.max() + 5.0
    assert_allclose(sharp[:, 0], plain[:, 0], atol=1e-9)


def test_spreading_keeps_a_uniform_scene() -> None:
    assert_allclose(Optics(1.3, (2.0, 1.0)).spread(np.full((30, 45), 0.37), 3), 0.37, atol=1e-12)


def test_impossible_sensors_are_refused() -> None:
    with pytest.raises(SettingError, match="full_well_e"):
        Sensor(full_well_e=-1.0)
