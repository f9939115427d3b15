from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.simulation.imaging import Sensor, ToneCurve
from kgcp.simulation.phone import Demosaicing, Phone, demosaic, demosaic_by_nearest

SENSOR = Sensor()
QUIET = Sensor(full_well_e=1e7, read_noise_e=0.0)
GUIDED = Phone(local_tone=0.0)
BILATERAL = Phone(Demosaicing.NEAREST, bilateral=0.3, local_tone=0.0)

both_demosaicings = pytest.mark.parametrize("interpolate", [demosaic, demosaic_by_nearest])
both_phones = pytest.mark.parametrize("phone", [GUIDED, BILATERAL], ids=["guided", "bilateral"])


@both_demosaicings
def test_demosaicing_keeps_linear_ramps(interpolate: Callable[[FloatArray], FloatArray]) -> None:
    y, x = np.mgrid[0.0:30.0, 0.0:40.0]
    ramp = 0.2 + 0.01 * x + 0.005 * y
    for colour in interpolate(ramp):
        assert_allclose(colour[3:-3, 3:-3], ramp[3:-3, 3:-3], atol=1e-12)


@both_demosaicings
def test_demosaicing_returns_the_measured_colours(
    interpolate: Callable[[FloatArray], FloatArray],
) -> None:
    raw = np.random.default_rng(2).random((12, 16))
    red, green, blue = interpolate(raw)
    assert_array_equal(red[::2, ::2], raw[::2, ::2])
    assert_array_equal(green[::2, 1::2], raw[::2, 1::2])
    assert_array_equal(green[1::2, ::2], raw[1::2, ::2])
    assert_array_equal(blue[1::2, 1::2], raw[1::2, 1::2])


@both_phones
def test_grey_light_stays_grey(phone: Phone) -> None:
    frame = phone.photograph(QUIET, np.full((40, 50), 0.5), 0.9, np.random.default_rng(1))
    assert frame.shape == (40, 50, 3)
    assert frame.dtype == np.uint8
    assert np.all(np.abs(frame.astype(float) - 255.0 * 0.45) <= 1.5)


@pytest.mark.parametrize("phone", [replace(GUIDED, noise_reduction=3.0), BILATERAL])
def test_noise_reduction_smooths_noise_and_keeps_edges(phone: Phone) -> None:
    light = np.tile(np.repeat([0.1, 0.8], 40), (60, 1))
    rng = np.random.default_rng
    rough = Phone(noise_reduction=0.0, local_tone=0.0).photograph(SENSOR, light, 1.0, rng(5))
    smooth = phone.photograph(SENSOR, light, 1.0, rng(5))
    flat = (slice(5, -5), slice(50, 75), 1)
    assert smooth[flat].std() < 0.5 * rough[flat].std()
    step = smooth[5:-5, 42, 1].mean() - smooth[5:-5, 37, 1].mean()
    assert step > 0.97 * 0.7 * 255.0


@pytest.mark.parametrize("demosaicing", Demosaicing)
def test_no_stage_moves_an_edge(demosaicing: Demosaicing) -> None:
    x = np.arange(80) - 39.5
    light = np.tile(0.1 + 0.6 / (1.0 + np.exp(-x / 0.6)), (60, 1))  # symmetric about 39.5
    sensor = replace(QUIET, sharpening=0.8, sharpening_px=1.2)
    phone = replace(GUIDED, demosaicing=demosaicing)
    frame = phone.photograph(sensor, light, 1.0, np.random.default_rng(1))
    profile = frame[8:-8].mean(axis=(0, 2))
    assert_allclose(profile + profile[::-1], profile[0] + profile[-1], atol=2.0)


def test_a_bilateral_filter_makes_edges_steeper() -> None:
    light = np.tile(0.1 + 0.6 / (1.0 + np.exp(-np.arange(-39.5, 40.0) / 0.9)), (60, 1))

    def steepest(phone: Phone) -> float:
        frame = phone.photograph(QUIET, light, 1.0, np.random.default_rng(1))
        return float(np.diff(frame[8:-8].mean(axis=(0, 2))).max())

    plain = replace(BILATERAL, bilateral=0.0, noise_reduction=0.0)
    assert 1.02 * steepest(plain) < steepest(BILATERAL) < 1.5 * steepest(plain)


def test_local_tone_mapping_brings_regions_nearer_to_each_other() -> None:
    light = np.tile(np.repeat([0.08, 0.7], 100), (120, 1))
    phone = Phone(local_tone=0.4, local_tone_px=10.0)
    frame = phone.photograph(QUIET, light, 1.0, np.random.default_rng(1)).astype(float)
    dark, bright = frame[60, 20, 1], frame[60, 180, 1]
    assert bright / dark == pytest.approx((0.7 / 0.08) ** 0.6, rel=0.05)


def test_tone_curve_and_sharpening_are_the_sensors() -> None:
    light = np.full((20, 20), 0.3)
    frame = Phone(local_tone=0.0).photograph(
        replace(QUIET, tone=ToneCurve.SRGB), light, 1.0, np.random.default_rng(1)
    )
    assert_allclose(frame, 255.0 * ToneCurve.SRGB.apply(np.array([0.3]))[0], atol=1.5)


def test_impossible_phones_are_refused() -> None:
    with pytest.raises(SettingError, match="local_tone"):
        Phone(local_tone=1.5)
    with pytest.raises(SettingError, match="bilateral"):
        Phone(bilateral=-0.1)
