"""The blurred disc against plain integration and against the noncentral χ² distribution.

Neither shares any code with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import ncx2

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.blurred_discs import render
from kgcp.measurement.image_model.quadrature import (
    BEND,
    CHORD_COUNTS,
    EXPONENTIAL,
    FAR,
    SQUARINGS,
    TAIL_RATIO,
    Quadrature,
    quadrature_for,
)
from kgcp.measurement.image_model.ray_plate import PLATE_ROWS, VIEW_ROWS

BY_PLATE_X, BY_PLATE_Y, BY_DEPTH, BY_XX, BY_XY, BY_YY, BY_STREAK_X, BY_STREAK_Y = range(1, 9)


@dataclass(frozen=True)
class Disc:
    """A white disc about the origin, seen by pixels of unit size."""

    radius: float
    rule: Quadrature
    xx: float = 0.49
    yy: float = 0.49
    xy: float = 0.0
    streak_x: float = 0.0
    streak_y: float = 0.0

    def seen(self, x: FloatArray, y: FloatArray, rows: int = PLATE_ROWS) -> FloatArray:
        views = np.zeros((VIEW_ROWS, len(x)))
        views[0], views[1], views[2], views[5] = x, y, 1.0, 1.0
        blur = np.array([self.xx, self.yy, self.xy, self.streak_x, self.streak_y])
        out = np.zeros((rows, len(x)))
        circles = np.array([[0.0, 0.0, self.radius, 1.0, float(self.rule)]])
        render(views, blur, circles, np.array([0, len(x)]), np.arange(len(x)), out)
        return out

    def level(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(self.seen(x, y, rows=1)[0])


def isotropic(rho: FloatArray, radius: float, sigma: float) -> FloatArray:
    """1 − Q₁: the exact profile of a disc under isotropic Gaussian blur."""
    return np.asarray(ncx2.cdf((radius / sigma) ** 2, 2, (rho / sigma) ** 2))


def rule_for(ratio_whole: float, ratio_sigma: float) -> Quadrature:
    return Quadrature(quadrature_for(np.array([ratio_whole]), np.array([ratio_sigma]))[0])


def around(radius: float, reach: float, count: int = 211) -> tuple[FloatArray, FloatArray]:
    """Points on both sides of the edge, spread evenly about the centre."""
    rho = np.linspace(max(0.05, radius - reach), radius + reach, count)
    angle = 2.399963 * np.arange(count)
    return rho * np.cos(angle), rho * np.sin(angle)


def mean_of_normal(z: FloatArray, half: FloatArray) -> FloatArray:
    """Mean of Φ from z − half to z + half, over 40 Gauss-Legendre nodes."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    return np.asarray(ndtr(z[..., None] + half[..., None] * nodes) @ weights / 2.0)


def along_and_across(disc: Disc, u: FloatArray, v: FloatArray) -> tuple[FloatArray, ...]:
    """Covariance of the blur along a direction, across it and mixed."""
    covariance = np.array([[disc.xx, disc.xy], [disc.xy, disc.yy]])
    frame = np.stack((np.stack((u, v)), np.stack((-v, u))))  # (along or across, x or y, n)
    turned = np.einsum("ian,ab,jbn->ijn", frame, covariance, frame)
    return turned[0, 0], turned[1, 1], turned[0, 1]


def by_chords(disc: Disc, x: FloatArray, y: FloatArray, count: int) -> FloatArray:
    """Level of a disc by chords along its streak, or along the radius without one."""
    streak = np.broadcast_to([[disc.streak_x], [disc.streak_y]], (2, len(x)))
    smears = bool(disc.streak_x or disc.streak_y)
    length = np.hypot(*streak) if smears else np.hypot(x, y)
    u, v = (streak if smears else np.stack((x, y))) / length
    along, across, mixed = along_and_across(disc, u, v)
    sd = np.sqrt(np.maximum(along - mixed**2 / across, 1e-6 * along))
    alpha = np.pi * np.arange(1, count + 1) / (count + 1) - 0.5 * np.pi
    at, half_chord = disc.radius * np.sin(alpha)[:, None], disc.radius * np.cos(alpha)[:, None]
    off = at - (y * u - x * v)
    centre = x * u + y * v + mixed / across * off
    half = np.broadcast_to(np.maximum(0.5 * length, 0.01 * sd) / sd if smears else 0.0, off.shape)
    density = np.exp(-0.5 * off**2 / across) / np.sqrt(2.0 * np.pi * across)
    inside = mean_of_normal((half_chord - centre) / sd, half)
    inside -= mean_of_normal((-half_chord - centre) / sd, half)
    return np.asarray(np.pi / (count + 1) * np.sum(half_chord * density * inside, axis=0))


def by_parabola(disc: Disc, x: FloatArray, y: FloatArray) -> FloatArray:
    """Level of a disc with a parabola for an edge, by the formula in docs/method/image_model.md."""
    rho, radius = np.hypot(x, y), disc.radius
    u, v = x / rho, y / rho
    radial, across, mixed = along_and_across(disc, u, v)
    motion_r, motion_t = (
        disc.streak_x * u + disc.streak_y * v,
        disc.streak_y * u - disc.streak_x * v,
    )
    uniform = motion_t**2 / 12.0
    total = across + uniform
    sd = np.sqrt(radial + (2.0 * total**2 - 1.2 * uniform**2) / (4.0 * radius**2))
    shift = total / (2.0 * radius) + 3.0 * total**2 / (8.0 * radius**3)
    z, half = (radius - shift - rho) / sd, 0.5 * np.abs(motion_r) / sd
    nodes, weights = np.polynomial.legendre.leggauss(60)
    place = 0.5 * nodes  # on the streak, −½ … ½, outwards
    outward_t = np.where(motion_r > 0.0, motion_t, -motion_t)[:, None]
    slant = (mixed / sd)[:, None]
    blur = z[:, None] - 2.0 * half[:, None] * place
    curving = (slant * blur + outward_t * place) ** 2 - slant**2 - outward_t**2 / 12.0
    bent = (curving * np.exp(-0.5 * blur**2) / np.sqrt(2.0 * np.pi)) @ weights / 2.0
    return np.asarray(mean_of_normal(z, half) - bent / (2.0 * radius * sd))


BLURS = st.tuples(st.floats(0.4, 1.5), st.floats(0.4, 1.5), st.floats(-0.6, 0.6))
ROUND_BLURS = st.tuples(st.floats(0.7, 0.9), st.floats(0.7, 0.9), st.floats(-0.2, 0.2))
STREAKS = st.one_of(
    st.just((0.0, 0.0)),
    st.tuples(st.floats(0.5, 8.0), st.floats(0.0, 6.3)).map(
        lambda polar: (polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1]))
    ),
)


def some_disc(radius: float, blur: tuple[float, float, float], streak: tuple[float, float]) -> Disc:
    """A disc with the quadrature rule for its radius and blur."""
    sd_x, sd_y, correlation = blur
    covariance = np.array([[sd_x**2, 0.0], [0.0, sd_y**2]])
    covariance[0, 1] = covariance[1, 0] = correlation * sd_x * sd_y
    least, most = np.sqrt(np.linalg.eigvalsh(covariance + np.outer(streak, streak) / 12.0))
    rule = rule_for(radius / most, radius / least)
    return Disc(radius, rule, sd_x**2, sd_y**2, covariance[0, 1], *streak)


@settings(deadline=None)
@given(radius=st.floats(0.3, 40.0), blur=BLURS, streak=STREAKS)
def test_every_rule_equals_a_plain_implementation(
    radius: float, blur: tuple[float, float, float], streak: tuple[float, float]
) -> None:
    disc = some_disc(radius, blur, streak)
    x, y = around(radius, 4.0 + 0.5 * float(np.hypot(*streak)), 41)
    if disc.rule is Quadrature.EDGE:
        # streaks that are short along the radius are a series, of the fourth order in their length:
        # up to 1.1e-4 was seen
        np.testing.assert_allclose(disc.level(x, y), by_parabola(disc, x, y), rtol=0.0, atol=3e-4)
    else:
        plain = by_chords(disc, x, y, int(CHORD_COUNTS[disc.rule]))
        np.testing.assert_allclose(disc.level(x, y), plain, rtol=0.0, atol=1e-6)


@settings(deadline=None, max_examples=40)
@given(radius=st.floats(0.3, 40.0), blur=ROUND_BLURS, streak=STREAKS)
def test_every_rule_approximates_its_integral(
    radius: float, blur: tuple[float, float, float], streak: tuple[float, float]
) -> None:
    disc = some_disc(radius, blur, streak)
    x, y = around(radius, 4.0 + 0.5 * float(np.hypot(*streak)), 21)
    # docs/method/image_model.md, "Blurred discs"
    tolerance = 3e-3 if disc.rule is Quadrature.EDGE else 3e-4
    assert np.abs(disc.level(x, y) - by_chords(disc, x, y, 900)).max() < tolerance


def test_the_normal_distribution_s_polynomials_are_accurate() -> None:
    z = np.linspace(0.0, FAR, 2001)
    density = np.polynomial.Polynomial(EXPONENTIAL)(0.5 * z * z / 2**SQUARINGS) ** (2**SQUARINGS)
    density /= np.sqrt(2.0 * np.pi)
    tail = density * np.polynomial.Polynomial(TAIL_RATIO)(1.0 / (1.0 + BEND * z))
    np.testing.assert_allclose(density, np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi), atol=3e-8)
    np.testing.assert_allclose(tail, ndtr(-z), rtol=0.0, atol=4e-8)


@settings(deadline=None)
@given(ratio=st.floats(0.1, 60.0), sigma=st.floats(0.3, 3.0))
def test_isotropic_discs_follow_the_noncentral_chi_square(ratio: float, sigma: float) -> None:
    radius = ratio * sigma
    x, y = around(radius, 4.0 * sigma, 41)
    disc = Disc(radius, rule_for(ratio, ratio), xx=sigma**2, yy=sigma**2)
    assert np.abs(disc.level(x, y) - isotropic(np.hypot(x, y), radius, sigma)).max() < 4e-4


@pytest.mark.parametrize("rule", Quadrature)
def test_the_level_is_the_same_with_and_without_derivatives(rule: Quadrature) -> None:
    disc = Disc((0.7, 1.5, 2.5, 5.0, 8.0, 20.0, 20.0)[rule], rule, xy=0.1, streak_x=2.0)
    x, y = around(disc.radius, 3.0)
    np.testing.assert_allclose(disc.level(x, y), disc.seen(x, y)[0], rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("rule", Quadrature)
@pytest.mark.parametrize("streak", [(0.0, 0.0), (2.1, -1.3), (-0.5, 6.0)])
def test_derivatives_are_those_of_the_level(rule: Quadrature, streak: tuple[float, float]) -> None:
    radius = (0.7, 1.5, 2.5, 5.0, 8.0, 20.0, 20.0)[rule]
    disc = Disc(radius, rule, 0.8, 1.3, 0.25, *streak)
    x, y = around(radius, 2.5)
    seen, step = disc.seen(x, y), 3e-4

    def slope(**fields: float) -> FloatArray:
        ends = [
            replace(disc, **{key: getattr(disc, key) + sign * step for key in fields})
            for sign in (1.0, -1.0)
        ]
        return np.asarray((ends[0].level(x, y) - ends[1].level(x, y)) / (2.0 * step))

    numeric = {
        BY_PLATE_X: (disc.level(x - step, y) - disc.level(x + step, y)) / (2.0 * step),
        BY_PLATE_Y: (disc.level(x, y - step) - disc.level(x, y + step)) / (2.0 * step),
        BY_XX: slope(xx=step),
        BY_XY: 0.5 * slope(xy=step),  # one of two equal elements
        BY_YY: slope(yy=step),
    }
    if any(streak):
        numeric |= {BY_STREAK_X: slope(streak_x=step), BY_STREAK_Y: slope(streak_y=step)}
    for row, expected in numeric.items():
        if rule is Quadrature.EDGE:  # the term of oblique blur has no derivatives
            off = np.linalg.norm(seen[row] - expected)
            assert off < 0.2 * np.linalg.norm(expected), row
        else:
            np.testing.assert_allclose(seen[row], expected, rtol=0.0, atol=3e-5, err_msg=str(row))
    wider = 2.0 * (disc.xx * seen[BY_XX] + 2.0 * disc.xy * seen[BY_XY] + disc.yy * seen[BY_YY])
    wider += streak[0] * seen[BY_STREAK_X] + streak[1] * seen[BY_STREAK_Y]
    np.testing.assert_allclose(seen[BY_DEPTH], wider, rtol=0.0, atol=1e-7)


def test_derivatives_of_an_edge_under_an_even_blur_are_those_of_the_level() -> None:
    disc, step = Disc(9.0, Quadrature.EDGE, 0.8, 0.8), 3e-4
    x, y = around(disc.radius, 2.5)
    seen = disc.seen(x, y)
    by_x = (disc.level(x - step, y) - disc.level(x + step, y)) / (2.0 * step)
    wider, narrower = (replace(disc, xx=at, yy=at) for at in (0.8 + step, 0.8 - step))
    by_blur = (wider.level(x, y) - narrower.level(x, y)) / (2.0 * step)
    np.testing.assert_allclose(seen[BY_PLATE_X], by_x, rtol=0.0, atol=3e-5)
    np.testing.assert_allclose(seen[BY_XX] + seen[BY_YY], by_blur, rtol=0.0, atol=3e-5)


@pytest.mark.parametrize(
    ("radius", "blur"),
    [
        (14.0, (0.5, 1.0, 0.0, 0.0, 0.0)),
        (20.0, (0.8, 1.3, 0.25, 0.0, 0.0)),
        (12.0, (0.5, 0.5, 0.0, 3.0, 0.0)),
        (15.0, (1.7, 1.7, 0.0, 5.0, 0.0)),
        (20.0, (1.7, 1.7, 0.0, -5.0, 5.0)),
        (26.0, (1.0, 1.0, 0.0, 7.0, 0.0)),
        (24.0, (1.6, 0.7, 0.3, 2.0, -4.0)),
        (24.0, (0.9, 0.9, 0.0, 0.2, 0.1)),
    ],
)
def test_the_closed_form_under_oblique_blur_agrees_with_chords(
    radius: float, blur: tuple[float, float, float, float, float]
) -> None:
    """Blur or motion whose parts along and across the radius are correlated."""
    x, y = around(radius, 5.0)
    edge, chords = (Disc(radius, r, *blur) for r in (Quadrature.EDGE, Quadrature.CHORDS_70))
    assert np.abs(edge.level(x, y) - chords.level(x, y)).max() < 6e-4


@pytest.mark.parametrize(("radius", "length"), [(2.0, 4.0), (3.5, 9.0), (9.0, 12.0), (20.0, 30.0)])
def test_a_streak_equals_the_mean_of_shifted_discs(radius: float, length: float) -> None:
    """Against the noncentral χ² distribution, averaged over the exposure."""
    sigma, direction = 0.7, np.array([0.8, -0.6])
    whole = np.hypot(sigma, length / np.sqrt(12.0))
    rule = rule_for(radius / whole, radius / sigma)
    assert rule is not Quadrature.EDGE
    motion = length * direction
    disc = Disc(radius, rule, sigma**2, sigma**2, 0.0, motion[0], motion[1])
    shifts = np.outer(motion, (np.arange(600) + 0.5) / 600 - 0.5)
    x, y = around(radius, 0.5 * length + 2.0, 100)
    rho = np.hypot(x[:, None] + shifts[0], y[:, None] + shifts[1])
    expected = isotropic(rho, radius, sigma).mean(axis=1)
    assert np.abs(disc.level(x, y) - expected).max() < 4e-4


def test_anisotropic_blur_equals_the_mean_of_randomly_shifted_discs() -> None:
    """A disc shifted by random blur: the share of shifts that cover a point is its level."""
    rng = np.random.default_rng(5)
    covariance = np.array([[0.9, 0.5], [0.5, 1.6]])
    shifts = rng.multivariate_normal(np.zeros(2), covariance, size=400_000)
    ratio = 2.2 / np.sqrt(1.9)
    disc = Disc(2.2, rule_for(ratio, ratio), 0.9, 1.6, 0.5)
    for rho in (0.5, 1.8, 2.4, 3.5):
        covered = np.hypot(rho + shifts[:, 0], shifts[:, 1]) <= disc.radius
        expected = covered.mean()
        level = disc.level(np.array([rho]), np.zeros(1))[0]
        assert abs(level - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / len(shifts))


@pytest.mark.parametrize("length", [0.01, 0.13, 0.37, 0.4, 3.0, 9.0])
def test_a_smeared_edge_equals_the_mean_of_shifted_edges(length: float) -> None:
    """Along the radius, where a streak does not bend the edge."""
    sharp = Disc(20.0, Quadrature.EDGE, 0.9, 1.4)
    shifts = (np.arange(2000) + 0.5) / 2000 - 0.5
    rho = np.linspace(12.0, 28.0, 33)
    mean = [sharp.level(at + length * shifts, np.zeros(2000)).mean() for at in rho.tolist()]
    smeared = replace(sharp, streak_x=length).level(rho, np.zeros(33))
    np.testing.assert_allclose(smeared, mean, rtol=0.0, atol=2e-5)


def test_results_do_not_depend_on_the_number_of_pixels() -> None:
    """Pixels are computed in batches, of which the last may be incomplete."""
    disc = Disc(3.0, Quadrature.CHORDS_9)
    x, y = around(disc.radius, 3.0, 77)
    together = disc.seen(x, y)
    for count in (1, 15, 16, 17, 64, 76):
        np.testing.assert_array_equal(disc.seen(x[:count], y[:count]), together[:, :count])
