import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from kgcp.errors import SettingError
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve

SENSORS = [
    Sensor(),
    Sensor(full_well_e=3000.0, read_noise_e=20.0),
    Sensor(tone=ToneCurve.SRGB),
    Sensor(full_well_e=4000.0, tone=ToneCurve.FILM, sharpening=0.6, sharpening_px=1.1),
]


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
    expected = sensor.expected(light, 0.9)[0, 0]
    variance = sensor.variance(light, 0.9)[100, 100]
    assert inner.var() == pytest.approx(variance, rel=0.05)
    assert abs(inner.mean() - expected) < 0.1


def test_overexposed_pixels_are_white_and_silent() -> None:
    light = np.full((20, 20), 0.8)
    grey = Sensor().expose(light, 2.0, np.random.default_rng(1))
    assert grey.dtype == np.uint8
    assert np.all(grey == 255)
    assert_allclose(Sensor().variance(light, 2.0), 1.0 / 12.0)


def test_gain_is_exposure_not_amplification() -> None:
    light = np.full((400, 400), 0.5)
    low = Sensor().expose(light, 0.5, np.random.default_rng(1)).astype(float)
    high = Sensor().expose(light, 1.5, np.random.default_rng(1)).astype(float)
    assert high.mean() / low.mean() == pytest.approx(3.0, rel=1e-3)
    # Shot noise grows with the square root of the light only.
    assert high.std() / low.std() == pytest.approx(np.sqrt(3.0), rel=0.03)


def test_sharpening_overshoots_at_edges() -> None:
    step = np.tile(np.repeat([0.2, 0.6], 20), (40, 1))
    plain = Sensor().expected(step, 1.0)
    sharp = Sensor(sharpening=0.8).expected(step, 1.0)
    assert sharp.max() > plain.max() + 5.0
    assert_allclose(sharp[:, 0], plain[:, 0], atol=1e-9)


def test_spreading_keeps_a_uniform_scene() -> None:
    assert_allclose(Optics(1.3, (2.0, 1.0)).spread(np.full((30, 45), 0.37), 3), 0.37, atol=1e-12)


def test_impossible_sensors_are_refused() -> None:
    with pytest.raises(SettingError, match="full_well_e"):
        Sensor(full_well_e=-1.0)
