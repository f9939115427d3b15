from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.errors import SettingError
from kgcp.targets import code_design
from kgcp.targets.code_design import (
    LEAST_DISTANCE,
    check_new_codes,
    dots_apart,
    dots_apart_turned,
    least_apart,
    propose_codes,
)
from kgcp.targets.layout import Ring, Target
from kgcp.targets.validation import rotations_coincide


def ring(*code_deg: float, name: str = "T") -> Ring:
    return Ring(name, 0.9, 0.45, 0.9 / 1.4, 0.9 / 7.0, code_deg)


def named(all_codes: tuple[tuple[float, ...], ...]) -> list[Ring]:
    return [ring(*code, name=str(i)) for i, code in enumerate(all_codes)]


def sampled_distance(first: Ring, second: Ring, *, mirrored: bool) -> float:
    """Of dots as arcs on a circle of 0.1°, over all rotations by brute force."""
    angles = 0.1 * np.arange(3600)

    def arcs(code: np.ndarray) -> np.ndarray:
        off = np.abs((angles[:, None] - code + 180.0) % 360.0 - 180.0)
        return np.asarray(np.any(off < first.dot_half_angle_deg, axis=1))

    here = arcs(np.array(first.code_deg))
    there = arcs(np.array(second.code_deg) * (-1.0 if mirrored else 1.0))
    spectrum = np.fft.rfft(here) * np.conj(np.fft.rfft(there))
    overlap = np.fft.irfft(spectrum, 3600).max()
    return float(here.sum() + there.sum() - 2.0 * overlap) / (20.0 * first.dot_half_angle_deg)


def random_code(dots: int, rng: np.random.Generator) -> tuple[float, ...]:
    gaps = 35.0 + (360.0 - dots * 35.0) * rng.dirichlet(np.ones(dots))
    return tuple(np.cumsum(gaps) - gaps[0])


@given(st.integers(3, 5), st.integers(3, 5), st.booleans(), st.integers(0, 10**6))
def test_distance_is_that_of_all_rotations(m: int, n: int, mirrored: bool, seed: int) -> None:  # noqa: FBT001 - hypothesis gives it
    rng = np.random.default_rng(seed)
    first, second = ring(*random_code(m, rng)), ring(*random_code(n, rng))
    brute = sampled_distance(first, second, mirrored=mirrored)
    assert dots_apart(first, second, mirrored=mirrored) == pytest.approx(brute, abs=0.15)


def test_rotated_and_mirrored_codes_have_distance_zero() -> None:
    code = ring(0, 43, 78, 180)
    assert dots_apart(code, ring(10, 53, 88, 190)) == pytest.approx(0.0, abs=1e-9)
    mirror = ring(0, 180, 282, 317)
    assert dots_apart(code, mirror, mirrored=True) == pytest.approx(0.0, abs=1e-9)
    assert dots_apart(code, mirror) > LEAST_DISTANCE
    assert dots_apart(code, ring(0, 43, 78, 180, 260)) == pytest.approx(1.0)


def test_symmetric_codes_are_near_to_themselves() -> None:
    assert dots_apart_turned(ring(0, 180)) == pytest.approx(0.0, abs=1e-9)
    # A half turn lays 0 and 180 onto each other, and nothing else.
    assert dots_apart_turned(ring(0, 43, 78, 180)) == pytest.approx(4.0)
    assert dots_apart_turned(ring(0)) == 2.0  # no rotation lays a single dot onto another


def test_proposed_codes_are_the_farthest_of_all() -> None:
    """With three dots there are few enough to try all pairs."""
    width_deg = 2.0 * ring(0).dot_half_angle_deg
    candidates = code_design._candidates(3, width_deg, 5.0)
    everything = [ring(*code, name=str(i)) for i, code in enumerate(candidates)]
    own = np.array([dots_apart_turned(code) for code in everything])
    proposed = named(propose_codes(ring(0), 1, 3))
    assert least_apart(proposed) == pytest.approx(own.max(), abs=1e-3)
    apart = np.stack(
        [code_design._apart(candidates, candidate, width_deg) for candidate in candidates]
    )
    best_pair = np.minimum(np.minimum(apart, own), own[:, None]).max()
    pair = named(propose_codes(ring(0), 2, 3))
    assert least_apart(pair) == pytest.approx(best_pair, abs=1e-3)


@pytest.mark.parametrize(("count", "dots", "least"), [(1, 4, 5.7), (6, 4, 3.2)])
def test_proposed_codes_differ(count: int, dots: int, least: float) -> None:
    proposed = propose_codes(ring(0), count, dots)
    assert len(set(proposed)) == count
    assert least_apart(named(proposed)) >= least
    assert propose_codes(ring(0), count, dots) == proposed


def test_proposed_codes_beat_chance() -> None:
    rng = np.random.default_rng(2)
    by_chance = max(
        least_apart(named(tuple(random_code(4, rng) for _ in range(4)))) for _ in range(100)
    )
    assert least_apart(named(propose_codes(ring(0), 4, 4))) > by_chance


def test_known_codes_are_avoided() -> None:
    known = ring(7, 50, 85, 187, name="known")  # off the grid
    proposed = named(propose_codes(ring(0), 3, 4, [known]))
    assert least_apart([known, *proposed]) > 3.0


@pytest.mark.parametrize(
    ("new", "words"),
    [
        (ring(0, 90, 180, 270), "itself, turned"),
        (ring(3, 46, 81, 183), "rotations of each other"),
        (ring(0, 180, 282, 317), "'A', seen from behind"),
        (ring(0, 43, 78, 180, 260), "that of 'A'"),
    ],
)
def test_codes_that_could_be_confused_are_refused(new: Ring, words: str) -> None:
    known = Target(ring(0, 43, 78, 180, name="A"))
    with pytest.raises(SettingError, match=words):
        check_new_codes([Target(new)], [known])


def test_codes_that_are_proposed_pass() -> None:
    targets = [Target(proposal) for proposal in named(propose_codes(ring(0), 8, 3))]
    check_new_codes(targets, [])
    for first, second in itertools.combinations(targets, 2):
        assert dots_apart(first.ring, second.ring) >= LEAST_DISTANCE


def test_too_many_codes_are_refused() -> None:
    with pytest.raises(SettingError, match=r"only \d\.\d dots apart"):
        propose_codes(ring(0), 40, 3)


@pytest.mark.parametrize(("count", "dots"), [(10, 4), (18, 4), (12, 5)])
def test_many_proposed_codes_pass_too(count: int, dots: int) -> None:
    """Codes that differ by two dots may coincide if all their dots are off by half a dot."""
    proposed = named(propose_codes(ring(0), count, dots))
    check_new_codes([Target(proposal) for proposal in proposed], [])


def test_fifty_codes_of_four_dots_fit_on_a_coarse_grid() -> None:
    codes, least = code_design._farthest_codes(ring(0), 50, 4, [], 12.0, 40)
    assert least >= LEAST_DISTANCE
    check_new_codes([Target(proposal) for proposal in named(codes)], [])


@given(st.integers(2, 6), st.floats(0.0, 360.0), st.floats(0.0, 11.5), st.integers(0, 10**6))
def test_codes_coincide_where_all_dots_are_off_by_less_than_half_a_dot(
    dots: int, turn_deg: float, off_deg: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    code = np.array(random_code(dots, rng))
    moved = np.sort(np.mod(code + rng.choice([-off_deg, off_deg], dots) + turn_deg, 360.0))
    assert rotations_coincide(code[None], moved, ring(0).dot_half_angle_deg)[0]
