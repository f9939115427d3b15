"""The likelihood: its derivatives, noise estimated from residuals, and clipped pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.image_model.noise import (
    Censoring,
    estimate_noise,
    find_censoring,
    find_smear,
    misfit,
    outlier_share,
)

COUNT = 1.0 / 255.0
OUTLYING = 3.5
WIDTH = 50  # pixels of a row


def no_clipping(count: int) -> Censoring:
    return Censoring(2.0, -1.0, np.zeros(count, bool), np.zeros(count, bool))


def all_clipped(count: int, *, high: bool) -> Censoring:
    return Censoring(1.0, 0.0, np.full(count, high), np.full(count, not high))


def loss(levels: FloatArray, model: FloatArray, sd: FloatArray, clip: Censoring) -> FloatArray:
    """The loss of each pixel, computed with that pixel alone."""
    parts = []
    for i in range(len(model)):
        one = slice(i, i + 1)
        each = replace(clip, at_high=clip.at_high[one], at_low=clip.at_low[one])
        parts.append(misfit(levels[one], model[one], sd[one], each).total)
    return np.array(parts)


def check_derivatives(model: FloatArray, clip: Censoring, *, curved: BoolArray) -> None:
    levels, sd = np.full_like(model, 0.5), np.full_like(model, 0.02)
    if clip.at_high.any():
        levels = np.ones_like(model)
    elif clip.at_low.any():
        levels = np.zeros_like(model)
    result = misfit(levels, model, sd, clip)
    step = 1e-4
    low, middle, high = (loss(levels, model + s * step * sd, sd, clip) for s in (-1.0, 0.0, 1.0))
    np.testing.assert_allclose(result.score, (low - high) / (2.0 * step), atol=1e-6)
    second = (high - 2.0 * middle + low) / step**2
    np.testing.assert_allclose(result.weight[curved], second[curved], atol=1e-5)
    assert np.all(result.weight > 0.0)


def test_score_and_weight_are_derivatives_of_the_loss() -> None:
    z = np.array([-9.0, -4.0, -3.3, -1.0, 0.0, 0.4, 2.0, 3.4, 3.6, 20.0])
    inlying = np.abs(z) < OUTLYING
    check_derivatives(0.5 - 0.02 * z, no_clipping(len(z)), curved=inlying)


def test_models_beyond_a_ceiling_keep_a_small_gradient() -> None:
    """Of a model on either side of the ceiling, and of the floor."""
    model = 0.5 + 0.02 * np.array([-9.0, -4.1, -2.1, -1.9, -0.5, 0.5, 1.9, 2.1, 4.1, 20.0, 40.0])
    clip = replace(no_clipping(len(model)), ceiling=0.54, floor=0.46)
    check_derivatives(model, clip, curved=np.abs(model - 0.5) < 0.05)
    levels, sd = np.full_like(model, 0.5), np.full_like(model, 0.02)
    score = misfit(levels, model, sd, clip).score
    np.testing.assert_array_equal(np.sign(score), np.sign(levels - model))
    beyond, at = (misfit(levels[:1], np.array([x]), sd[:1], clip).total for x in (0.64, 0.54))
    assert at < beyond < misfit(levels[:1], np.array([0.56]), sd[:1], no_clipping(1)).total


def test_pixels_explained_by_clipped_light_are_not_outliers() -> None:
    levels, model = np.array([0.99, 0.98, 0.5, 0.5]), np.array([1.0, 1.3, 0.51, 1.3])
    clip = replace(no_clipping(4), ceiling=1.0)
    found = misfit(levels, model, np.full(4, 0.02), clip)
    assert outlier_share(found, model, clip) == 0.25
    none_seen = replace(clip, at_high=np.ones(4, np.bool_))
    assert outlier_share(found, model, none_seen) == 1.0


@pytest.mark.parametrize("high", [True, False])
def test_clipped_pixels_have_derivatives_of_their_tail(high: bool) -> None:  # noqa: FBT001 - a case
    """Up to the point where they count as outliers."""
    missing = np.array([-6.0, -2.0, -0.5, 0.0, 1.0, 2.5, 3.1])
    model = 1.0 - 0.02 * missing if high else 0.02 * missing
    check_derivatives(
        model, all_clipped(len(missing), high=high), curved=np.full(7, fill_value=True)
    )


def test_clipped_pixels_do_not_penalise_brighter_models() -> None:
    model = np.array([1.3, 1.1, 0.9])
    result = misfit(np.ones(3), model, np.full(3, 0.02), all_clipped(3, high=True))
    np.testing.assert_allclose(result.score[:2], 0.0, atol=1e-4)
    assert result.score[2] > 1.0


def test_outliers_pull_less_the_farther_they_are_and_are_never_lost() -> None:
    z = np.array([3.4, 5.0, 10.0, 50.0])
    result = misfit(0.02 * z, np.zeros(4), np.full(4, 0.02), no_clipping(4))
    assert np.all(np.diff(np.abs(result.score)) < 0.0)
    np.testing.assert_allclose(result.weight, np.minimum(1.0, OUTLYING**2 / z**2))


def test_outlying_clipped_pixels_pull_with_a_bounded_force() -> None:
    model = np.array([0.95, 0.8, 0.5, 0.0])
    result = misfit(np.ones(4), model, np.full(4, 0.01), all_clipped(4, high=True))
    assert np.all(result.score > 0.0)
    assert np.all(result.score <= OUTLYING + 1e-12)
    assert np.all(np.diff(loss(np.ones(4), model, np.full(4, 0.01), all_clipped(4, high=True))) > 0)


def scattered(rng: np.random.Generator, edge_factor: float) -> tuple[FloatArray, FloatArray]:
    """Residuals of 300 pixels of ink, 300 of plate and 600 of edges."""
    share = np.concatenate((np.zeros(300), np.ones(300), rng.uniform(0.21, 0.79, 600)))
    sd = np.sqrt(0.008**2 + (0.02**2 - 0.008**2) * share)
    sd[600:] *= edge_factor
    return rng.normal(0.0, sd), share


def test_noise_follows_the_level() -> None:
    rng = np.random.default_rng(6)
    found = []
    for _ in range(20):
        residuals, share = scattered(rng, 1.0)
        noise = estimate_noise(residuals, share, np.full(1200, fill_value=True), COUNT)
        found.append((noise.sd[0], noise.sd[300], noise.sd[share > 0.2].mean()))
    dark, bright, _ = np.mean(found, axis=0)
    assert dark == pytest.approx(0.008, rel=0.04)
    assert bright == pytest.approx(0.02, rel=0.04)
    assert np.std(found, axis=0)[0] < 0.1 * 0.008


@pytest.mark.parametrize("from_edges", ["of both plateaus", "of ink and edges"])
def test_noise_of_ink_is_extrapolated_to_pure_ink(from_edges: str) -> None:
    """Ink pixels contain 2 % of plate, whose variance is six times as large."""
    rng, found = np.random.default_rng(13), []
    for _ in range(60):
        of_ink = np.concatenate((np.zeros(650), 0.14 * rng.random(250)))
        share = np.concatenate((of_ink, 0.2 + 0.6 * rng.random(600), np.ones(600)))
        variance = 0.004**2 + share * (0.010**2 - 0.004**2)
        usable = share < 1.0 if from_edges == "of ink and edges" else np.ones(len(share), bool)
        residuals = rng.normal(0.0, np.sqrt(variance))
        noise = estimate_noise(residuals, share, usable, COUNT / 10.0, from_edges=True)
        found.append((noise.plateau_sd[:900] ** 2 / variance[:900]).mean())
    assert float(np.mean(found)) == pytest.approx(1.0, abs=0.02)
    # with a tone curve, the plate's share of it is not known
    noise = estimate_noise(
        residuals, share, usable, COUNT / 10.0, from_edges=True, is_linear_in_share=False
    )
    whole = estimate_noise(residuals, share, usable, COUNT / 10.0, from_edges=True)
    assert 1.05 < (noise.plateau_sd[0] / whole.plateau_sd[0]) ** 2 < 1.12


def test_bands_of_many_pixels_have_their_own_noise_and_others_follow_the_line() -> None:
    """Demosaicing makes the dark side of edges three times as noisy."""
    rng = np.random.default_rng(12)
    share = np.concatenate((np.zeros(300), np.ones(300), rng.uniform(0.03, 0.14, 900), [0.75] * 7))
    sd = np.where((share > 0.0) & (share < 0.15), 0.03, 0.01)
    sd[1500:] = 0.001
    noise = estimate_noise(
        rng.normal(0.0, sd), share, np.full(len(share), fill_value=True), COUNT, in_bands=True
    )
    assert noise.sd[np.abs(share - 0.07) < 0.003] == pytest.approx(0.03, rel=0.08)
    assert noise.sd[share == 1.0] == pytest.approx(0.01, rel=0.1)
    assert noise.sd[1500:] == pytest.approx(noise.plateau_sd[1500:], rel=0.05)


@pytest.mark.parametrize("pixels", [10, 40])
def test_a_band_counts_by_its_pixels_against_ten_of_the_line(pixels: int) -> None:
    """Residuals of one size, whose trimmed variance is exactly that of their standard deviation."""
    count = [400, 400, 400, pixels]
    share = np.repeat([0.0, 1.0, 0.5, 0.25], count)
    variance = np.repeat([0.01**2, 0.02**2, 0.5 * (0.01**2 + 0.02**2), 0.05**2], count)
    residuals = np.sqrt(0.6230 * variance)
    noise = estimate_noise(residuals, share, np.ones(len(share), bool), COUNT, in_bands=True)
    line = 0.01**2 + 0.25 * (0.02**2 - 0.01**2)
    expected = (pixels * 0.05**2 + 10.0 * line) / (pixels + 10.0)
    assert noise.sd[-1] ** 2 == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("is_ink_seen", [False, True])
def test_noise_of_an_unseen_plateau_is_taken_from_edges(is_ink_seen: bool) -> None:  # noqa: FBT001 - a case
    """A narrow ring has no pixel of pure ink, whose noise is not that of the plate."""
    rng = np.random.default_rng(9)
    found: dict[bool, list[tuple[float, float, float]]] = {True: [], False: []}
    for _ in range(20):
        residuals, share = scattered(rng, 1.0)
        usable = (share > 0.0) if not is_ink_seen else (share < 1.0)
        for from_edges, noise in found.items():
            made = estimate_noise(residuals, share, usable, COUNT, from_edges=from_edges)
            noise.append((made.sd[0], made.sd[300], float(np.median(made.sd[600:]))))
    ink, plate, edge = np.sqrt(np.mean(np.square(found[True]), axis=0))
    assert ink == pytest.approx(0.008, rel=0.3)
    assert plate == pytest.approx(0.02, rel=0.1)
    assert edge == pytest.approx(0.0152, rel=0.1)
    ink, plate, _ = np.mean(found[False], axis=0)
    assert ink == pytest.approx(plate, rel=1e-9)


def test_ink_is_no_noisier_than_plate_for_noisy_edges() -> None:
    residuals, share = scattered(np.random.default_rng(10), 3.0)
    noise = estimate_noise(residuals, share, share > 0.0, COUNT, from_edges=True)
    assert noise.plateau_sd[0] == pytest.approx(noise.plateau_sd[300])


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 1.0, 1.1), (3.0, 2.5, 3.3)])
def test_noise_at_edges_is_raised_to_the_scatter_of_edges(
    factor: float, low: float, high: float
) -> None:
    residuals, share = scattered(np.random.default_rng(7), factor)
    noise = estimate_noise(residuals, share, np.full(1200, fill_value=True), COUNT)
    middle = np.abs(share - 0.5) < 0.1
    assert low <= np.median(noise.sd[middle] / noise.plateau_sd[middle]) < high
    np.testing.assert_allclose(noise.sd[:600], noise.plateau_sd[:600])


def test_outliers_and_clipped_pixels_do_not_change_the_noise() -> None:
    residuals, share = scattered(np.random.default_rng(8), 1.0)
    usable = np.full(1200, fill_value=True)
    plain = estimate_noise(residuals, share, usable, COUNT)
    residuals[[3, 70, 170, 330, 410, 700, 900]] = 0.6
    residuals[200:240], usable[200:240] = 0.3, False
    dirty = estimate_noise(residuals, share, usable, COUNT)
    np.testing.assert_allclose(dirty.sd, plain.sd, rtol=0.15)


def test_noise_is_never_below_that_of_rounding() -> None:
    share = np.linspace(0.0, 1.0, 100)
    noise = estimate_noise(np.zeros(100), share, np.full(100, fill_value=True), COUNT)
    np.testing.assert_allclose(noise.sd, 0.3 * COUNT)
    none_usable = estimate_noise(np.zeros(100), share, np.zeros(100, bool), COUNT)
    np.testing.assert_allclose(none_usable.sd, 0.3 * COUNT)


def test_the_ends_of_the_range_are_clipped() -> None:
    levels = np.array([0.0, 1.0, 2.0, 100.0, 254.0, 255.0]) * COUNT
    clip = find_censoring(levels, COUNT, len(levels))
    assert clip.at_low.tolist() == [True] + [False] * 5
    assert clip.at_high.tolist() == [False] * 5 + [True]
    assert 254.0 * COUNT < clip.high < 1.0
    assert clip.share == pytest.approx(1.0 / 3.0)


def test_twelve_bits_in_a_file_of_sixteen_clip_where_values_pile_up() -> None:
    rng = np.random.default_rng(2)
    full, count = 4095, 1.0 / 65535.0
    bright = np.minimum(np.rint(rng.normal(1.1 * full, 0.02 * full, 900)), full)
    dark = np.rint(rng.normal(300.0, 20.0, 1500))
    levels = np.concatenate((dark, bright)) * count
    clip = find_censoring(levels, count, WIDTH)
    np.testing.assert_array_equal(clip.at_high, levels == full * count)
    assert not clip.at_low.any()
    assert clip.high == pytest.approx(full * count, abs=count)


@pytest.mark.parametrize("flat", [0, 20_000])
@pytest.mark.parametrize("burnt", [True, False])
def test_pixels_smeared_by_compression_count_as_clipped(*, burnt: bool, flat: int) -> None:
    """At either end of the range, on small plates and large ones, with edges of all grey values."""
    rng = np.random.default_rng(4)
    smeared = np.clip(np.rint(rng.normal(255.0, 2.0, 800)), 0.0, 255.0)
    edges, other = rng.integers(0, 256, 500), np.rint(rng.normal(90.0, 3.0, 800))
    counts = np.concatenate((smeared, edges, other, np.full(flat, 255.0)))
    clip = find_censoring((counts if burnt else 255.0 - counts) * COUNT, COUNT, WIDTH)
    at_end, high = (clip.at_high, clip.high) if burnt else (clip.at_low, 1.0 - clip.low)
    assert 247.0 < high / COUNT < 251.0
    assert at_end[:800].mean() > 0.97
    assert at_end[800:1300].mean() < 0.04
    assert not at_end[1300:2100].any()
    assert at_end[2100:].all()


def test_small_windows_show_smeared_pixels_together() -> None:
    rng = np.random.default_rng(5)
    windows = []
    for _ in range(20):
        counts = np.full((WIDTH, WIDTH), 90.0)
        counts[10:14, 10:14] = np.minimum(np.rint(rng.normal(255.0, 2.0, (4, 4))), 255.0)
        windows.append((counts.ravel() * COUNT, WIDTH))
    alone = [find_smear([window], COUNT)[0] for window in windows]
    top, bottom = find_smear(windows, COUNT)
    assert min(alone) == 0
    assert 3 <= top <= 7
    assert bottom == 0
    levels, width = windows[int(np.argmin(alone))]
    clip = find_censoring(levels, COUNT, width, (top, bottom))
    assert np.count_nonzero(clip.at_high) >= 15
    assert clip.ceiling == 1.0


def test_levels_that_are_clipped_at_once_are_not_smeared() -> None:
    rng = np.random.default_rng(4)
    edges = rng.integers(0, 256, 500)
    clip = find_censoring(np.concatenate((np.full(800, 255), edges)) * COUNT, COUNT, WIDTH)
    assert clip.high / COUNT == pytest.approx(254.5)


@pytest.mark.parametrize("burnt", [True, False])
def test_levels_near_the_limit_beside_edges_alone_are_not_smeared(*, burnt: bool) -> None:
    """Blurred edges end there, or one colour is not yet clipped; compression smears everywhere."""
    rng = np.random.default_rng(7)
    rows = np.full((WIDTH, WIDTH), 255.0)
    rows[:, 20:30] = (214.0, 120.0, *[30.0] * 6, 120.0, 214.0)
    beside, away = rows.copy(), rows.copy()
    beside[:, 19], away[:, 17] = rng.integers(249, 255, (2, WIDTH))
    for counts, smears in ((beside, False), (away, True)):
        levels = (counts if burnt else 255.0 - counts).ravel() * COUNT
        clip = find_censoring(levels, COUNT, WIDTH)
        high, is_limited = (clip.high, clip.ceiling) if burnt else (1.0 - clip.low, clip.floor)
        assert (high / COUNT < 252.0) == smears
        assert np.isfinite(is_limited) == smears


def test_a_noisy_plate_just_below_saturation_is_not_clipped() -> None:
    """Some of its pixels are clipped; the others show its level."""
    rng = np.random.default_rng(6)
    counts = np.minimum(np.rint(rng.normal(252.0, 3.0, 2000)), 255.0)
    clip = find_censoring(counts * COUNT, COUNT, WIDTH)
    assert clip.high / COUNT == pytest.approx(254.5)
    assert clip.ceiling == np.inf
    assert 0.1 < clip.share < 0.3


def test_a_bright_plate_below_saturation_is_not_clipped() -> None:
    rng = np.random.default_rng(3)
    for count, full in ((COUNT, 200.0), (1.0 / 65535.0, 3600.0)):
        levels = np.rint(rng.normal(full, 0.02 * full, 2000)) * count
        clip = find_censoring(levels, count, WIDTH)
        assert not clip.at_high.any()
        assert clip.high > levels.max()
