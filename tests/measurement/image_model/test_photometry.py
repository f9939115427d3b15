"""From white share to grey value: every row of the Jacobian, and the known curve."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.blurred_plate import WhiteShare
from kgcp.measurement.image_model.photometry import (
    PARAM_COUNT,
    PLAIN_COUNT,
    Light,
    Param,
    PhotometricModel,
    Tone,
    apply_tone,
    apply_tone_uncompiled,
    decoded,
    encoded,
    light_after_step,
    light_over_base,
    plateau_levels,
    undo_edge_tone,
)
from kgcp.measurement.image_model.sharpening import unsharp_mask
from kgcp.measurement.image_model.srgb import (
    encode_pixels,
    srgb_encoded,
    srgb_encoded_number,
    srgb_slope,
)

WIDTH, HEIGHT, SHARPENING_PX = 31, 22, 1.2
TONE = Tone.UNKNOWN
STEP = 1e-6
LIGHT = Light(0.06, 0.8, 0.04, -0.03, 0.02, 0.35, -0.2, 0.1, sharpening=0.5, linear_sharpening=0.2)
UNSHAPED = replace(LIGHT, tone_1=0.0, tone_2=0.0, tone_3=0.0)
LINEAR = replace(UNSHAPED, sharpening=0.0)
CASES = [
    (Tone.LINEAR, 0.0, LINEAR),
    (Tone.SRGB, 0.0, UNSHAPED),
    (Tone.SRGB, SHARPENING_PX, UNSHAPED),
    (Tone.NEAR_SRGB, SHARPENING_PX, replace(LIGHT, linear_sharpening=0.0)),
    (Tone.UNKNOWN, 0.0, LIGHT),
    (Tone.UNKNOWN, SHARPENING_PX, LIGHT),
]


def make_imager(tone: Tone, sharpening_px: float) -> PhotometricModel:
    """Two pixels of three are modelled; the others are ink or plate."""
    rng = np.random.default_rng(8)
    index = np.sort(rng.permutation(WIDTH * HEIGHT)[: WIDTH * HEIGHT * 2 // 3])
    offsets = np.stack((index % WIDTH / WIDTH - 0.5, index // WIDTH / HEIGHT - 0.5))
    if sharpening_px == 0.0:
        return PhotometricModel(offsets, tone, None)
    plateau = rng.integers(0, 2, WIDTH * HEIGHT).astype(np.float64)
    mask = unsharp_mask((HEIGHT, WIDTH), index, plateau, sharpening_px)
    return PhotometricModel(offsets, tone, mask)


def make_share(photometry: PhotometricModel) -> WhiteShare:
    rng = np.random.default_rng(9)
    count = int(photometry.offsets.shape[1])
    return WhiteShare(np.zeros((2, count)), rng.random(count), rng.normal(size=(11, count)))


@pytest.mark.parametrize(("tone", "sharpening_px", "light"), CASES)
def test_levels_are_the_same_with_and_without_derivatives(
    tone: Tone, sharpening_px: float, light: Light
) -> None:
    photometry = make_imager(tone, sharpening_px)
    share = make_share(photometry)
    levels, jacobian = photometry.linearised(share, light)
    np.testing.assert_allclose(levels, photometry.levels(share.value, light), atol=1e-14)
    assert jacobian.shape == (PLAIN_COUNT, len(levels))


@pytest.mark.parametrize(("tone", "sharpening_px", "light"), CASES)
def test_geometric_rows_of_the_jacobian_are_derivatives(
    tone: Tone, sharpening_px: float, light: Light
) -> None:
    photometry = make_imager(tone, sharpening_px)
    share = make_share(photometry)
    _, jacobian = photometry.linearised(share, light)
    for row in range(11):
        high, low = (
            photometry.levels(share.value + sign * STEP * share.jacobian[row], light)
            for sign in (1.0, -1.0)
        )
        expected = (high - low) / (2.0 * STEP)
        np.testing.assert_allclose(jacobian[row], expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "name", [field.name for field in fields(Light) if field.name != "edge_tone"]
)
@pytest.mark.parametrize(("tone", "sharpening_px", "light"), CASES)
def test_photometric_rows_of_the_jacobian_are_derivatives(
    tone: Tone,
    sharpening_px: float,
    light: Light,
    name: str,
) -> None:
    photometry = make_imager(tone, sharpening_px)
    share = make_share(photometry)
    _, jacobian = photometry.linearised(share, light)
    # light that varies over a whole ring is flat over the mask: its rows leave sharpening out
    is_flat = name.startswith("slope") or name == "curvature"
    if is_flat:
        light = replace(light, linear_sharpening=0.0)
        _, jacobian = photometry.linearised(share, light)
    seen = make_imager(tone, 0.0) if is_flat else photometry
    high, low = (
        seen.levels(share.value, replace(light, **{name: getattr(light, name) + sign * STEP}))
        for sign in (1.0, -1.0)
    )
    expected = (high - low) / (2.0 * STEP)
    if name.startswith("tone") and not tone.is_shaped:
        expected = np.zeros_like(high)  # the curve is known: none to be estimated
    np.testing.assert_allclose(jacobian[Param[name.upper()]], expected, rtol=1e-6, atol=2e-7)


@pytest.mark.parametrize("tone", [each for each in Tone if each is not Tone.BINNED])
def test_rows_of_the_jacobian_are_derivatives_in_uneven_light(tone: Tone) -> None:
    """Levels differ from pixel to pixel, also for pixels that only sharpening uses."""
    light = replace(LIGHT if tone.is_shaped else UNSHAPED, linear_sharpening=0.0)
    light = replace(light, slope_x=0.0, slope_y=0.0, curvature=0.0, edge_tone=0.4)
    photometry = make_imager(tone, SHARPENING_PX)
    share = make_share(photometry)
    # darker and brighter by more than the tone curve is bent
    added = np.random.default_rng(10).uniform(-0.2, 0.3, (2, len(share.value)))
    added[0] = np.abs(added[0]) if tone is Tone.SRGB else added[0]
    levels, jacobian = photometry.linearised(share, light, added)
    np.testing.assert_allclose(levels, photometry.levels(share.value, light, added), atol=1e-14)

    names = ["black", "white", "sharpening", "edge_tone"]
    names += ["tone_1", "tone_2", "tone_3"] * tone.is_shaped
    for name in names:
        high, low = (
            photometry.levels(share.value, replace(light, **{name: value}), added)
            for value in (getattr(light, name) + STEP, getattr(light, name) - STEP)
        )
        expected = (high - low) / (2.0 * STEP)
        np.testing.assert_allclose(jacobian[Param[name.upper()]], expected, rtol=1e-6, atol=1e-6)
    if not tone.is_shaped:  # the curve is known: none to be estimated
        assert not jacobian[Param.TONE_1 : Param.SHARPENING].any()

    for k in range(2):  # levels are flat over the mask
        change = np.zeros_like(added)
        change[k] = 1.0
        high, low = (
            photometry.levels(share.value, light, added + sign * STEP * change)
            for sign in (1.0, -1.0)
        )
        expected = (high - low) / (2.0 * STEP)
        np.testing.assert_allclose(jacobian[PARAM_COUNT + k], expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("edge_tone", [-0.6, 0.0, 0.9])
def test_edge_tone_changes_the_white_share(edge_tone: float) -> None:
    photometry = make_imager(Tone.UNKNOWN, 0.0)
    light = replace(LIGHT, linear_sharpening=0.0)
    share = make_share(photometry).value
    bent = share + edge_tone * share * (1.0 - share)
    added = np.full((2, len(share)), 0.05)
    edge_toned = photometry.levels(share, replace(light, edge_tone=edge_tone), added)
    np.testing.assert_allclose(edge_toned, photometry.levels(bent, light, added), atol=1e-14)
    back = undo_edge_tone(bent, replace(light, edge_tone=edge_tone))
    np.testing.assert_allclose(back, share, atol=1e-12)


@pytest.mark.parametrize("tone", [Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE])
def test_the_light_varies_before_the_tone_curve(tone: Tone) -> None:
    """Ink without light stays black; other pixels look like a larger white share in even light."""
    photometry, light = make_imager(tone, 0.0), replace(LIGHT, black=0.0)
    share = make_share(photometry).value
    even = replace(light, slope_x=0.0, slope_y=0.0)
    x, y = photometry.offsets
    lit = 1.0 + light.slope_x * x + light.slope_y * y
    np.testing.assert_allclose(
        photometry.levels(share, light), photometry.levels(lit * share, even), atol=1e-14
    )


@pytest.mark.parametrize("modelled", [0.05, 0.5, 1.0])
def test_sharpening_is_an_unsharp_mask_on_the_whole_window(modelled: float) -> None:
    """The same as OpenCV's blur of the plain image, in which other pixels are ink or plate."""

    def sharpened(image: FloatArray, strength: float) -> FloatArray:
        smooth = cv2.GaussianBlur(
            image.reshape(HEIGHT, WIDTH), (7, 7), SHARPENING_PX, borderType=cv2.BORDER_REPLICATE
        )
        return np.where(is_modelled, image + strength * (image - smooth.ravel()), image)

    rng = np.random.default_rng(1)
    index = np.flatnonzero(rng.random(WIDTH * HEIGHT) < modelled)
    share = rng.random(len(index))
    plateau = rng.integers(0, 2, WIDTH * HEIGHT).astype(np.float64)
    is_modelled = np.isin(np.arange(WIDTH * HEIGHT), index)
    light = replace(LIGHT, slope_x=0.0, slope_y=0.0, curvature=0.0)
    even = np.zeros((2, len(index)))
    in_light = np.where(plateau > 0.5, light.white, light.black)
    in_light[index] = decoded(PhotometricModel(even, TONE, None).levels(share, light), TONE)
    grey = encoded(sharpened(in_light, light.linear_sharpening), TONE)
    mask = unsharp_mask((HEIGHT, WIDTH), index, plateau, SHARPENING_PX)
    sharp = PhotometricModel(even, TONE, mask).levels(share, light)
    np.testing.assert_allclose(sharp, sharpened(grey, light.sharpening)[index], atol=1e-12)


@given(
    st.lists(st.floats(-0.15, 1.2), min_size=5, max_size=5),
    st.lists(st.floats(-0.2, 0.2), min_size=5, max_size=5),
)
def test_light_after_a_step_has_the_predicted_levels(
    light: list[float], change: list[float]
) -> None:
    x, step = np.array(light), 0.1 * np.array(change)
    before = Light(0.1, 0.8, tone_1=0.3, tone_2=-0.2, tone_3=0.1)

    def after(share: float) -> Light:
        names = ("black", "white", "tone_1", "tone_2", "tone_3")
        steps = zip(names, change, strict=True)
        return replace(before, **{n: getattr(before, n) + 0.5 * share * c for n, c in steps})

    high, low = (apply_tone(x + s * step, after(s).values) for s in (STEP, -STEP))
    promised = apply_tone(x, before.values) + (high - low) / (2.0 * STEP)
    moved = light_after_step(x, step, before.values, after(1.0).values)
    np.testing.assert_allclose(apply_tone(moved, after(1.0).values), promised, atol=1e-6)


def test_light_takes_the_plain_step_where_the_tone_curve_is_flat() -> None:
    flat = Light(0.1, 0.8, tone_1=1.0)  # its slope is 0 at the plate
    x, step = np.array([0.2, 1.0]), np.array([0.01, 0.01])
    moved = light_after_step(x, step, Light(0.1, 0.8).values, flat.values)
    assert moved[1] == x[1] + step[1]
    # elsewhere x' (2 − x') = 0.2 + 0.01 + 0.2 · 0.8
    assert moved[0] == pytest.approx(1.0 - math.sqrt(1.0 - 0.37), abs=1e-9)


def test_ink_and_plate_have_their_levels_whatever_the_tone() -> None:
    photometry = make_imager(Tone.UNKNOWN, 0.0)
    count = photometry.offsets.shape[1]
    even = replace(LIGHT, slope_x=0.0, slope_y=0.0, curvature=0.0)
    black, white = plateau_levels(even, Tone.UNKNOWN)
    np.testing.assert_allclose(photometry.levels(np.zeros(count), even), black)
    np.testing.assert_allclose(photometry.levels(np.ones(count), even), white)


@given(st.floats(0.0, 1.0))
def test_srgb_decodes_to_the_light_it_encodes(light: float) -> None:
    grey = float(srgb_encoded(np.array([light]))[0])
    back = grey / 12.92 if grey <= 0.04045 else ((grey + 0.055) / 1.055) ** 2.4
    assert back == pytest.approx(light, abs=2e-7)  # the standard's two branches meet to 1e-7


def test_uncompiled_tone_equals_the_compiled_one() -> None:
    share = np.linspace(0.0, 1.0, 33)
    np.testing.assert_allclose(
        apply_tone_uncompiled(share, LIGHT), apply_tone(share, LIGHT.values), rtol=1e-14, atol=1e-15
    )
    for value in (-0.1, 0.001, 0.7):
        assert srgb_encoded_number(value) == pytest.approx(float(srgb_encoded(np.array(value))))


def test_encode_pixels_equals_srgb_encoded() -> None:
    light = np.concatenate((np.linspace(-0.1, 2.0, 997), np.geomspace(1e-4, 30.0, 503)))
    slope = np.empty(len(light))
    np.testing.assert_allclose(encode_pixels(light, slope), srgb_encoded(light), rtol=1e-12)
    np.testing.assert_allclose(slope, srgb_slope(light), rtol=1e-12)


def test_steps_add_to_every_parameter_in_order() -> None:
    start = Parameters.of(Pose(np.eye(3), np.array([0.0, 0.0, 9.0])), Blur(0.6, 0.4, 0.05), LIGHT)
    of_light = np.linspace(-0.02, 0.02, len(fields(Light)))
    skew = (0.01, -0.02, 0.03, 0.04)
    step = np.array([0.0] * 6 + [0.1, 0.02, -0.03, 0.5, -0.4, *of_light, *skew, -0.3])
    moved = start.moved(step)
    np.testing.assert_allclose(moved.vector, start.vector + step)


def test_steps_never_lead_to_an_impossible_blur() -> None:
    start = Parameters.of(Pose(np.eye(3), np.array([0.0, 0.0, 9.0])), Blur(0.6, 0.4, 0.05), LIGHT)
    for mean, difference, xy in ((-3.0, 0.0, 0.0), (0.0, 2.0, 1.0), (-0.3, -5.0, 3.0)):
        step = np.zeros(PARAM_COUNT)
        step[Param.BLUR_MEAN : Param.STREAK_X] = mean, difference, xy
        blur = start.moved(step).blur
        assert np.linalg.eigvalsh([[blur.xx, blur.xy], [blur.xy, blur.yy]])[0] > 0.0
        assert 0.5 * (blur.xx + blur.yy) > 1.0 / 13.5, "a pixel alone spreads by 1/12"


FILM = Light(0.0, 1.0, tone_1=0.73, tone_2=0.34, tone_3=-0.78)  # as of sRGB's curve


@pytest.mark.parametrize(
    ("tone", "other", "light"),
    [
        (Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE, replace(FILM, black=0.02, white=1.007)),
        (Tone.UNKNOWN_OVER_LINE, Tone.UNKNOWN, Light(0.13, 0.95, tone_1=1.2, tone_2=-0.45)),
        (Tone.UNKNOWN, Tone.UNKNOWN, LIGHT),
    ],
)
def test_a_curve_converted_to_another_base_keeps_its_grey_values(
    tone: Tone, other: Tone, light: Light
) -> None:
    share = np.linspace(0.0, 1.0, 41)
    same = light_over_base(light, tone, other)
    before, after = (
        encoded(apply_tone_uncompiled(share, each), base)
        for each, base in ((light, tone), (same, other))
    )
    assert after[[0, -1]] == pytest.approx(before[[0, -1]], abs=1e-9)
    assert np.abs(after - before).max() < 0.04
    assert (same.sharpening, same.slope_x) == (light.sharpening, light.slope_x)
    if other is tone:
        assert same.values == pytest.approx(light.values, abs=1e-9)
