from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.conic import ellipse_from_conic, fit_ellipse
from kgcp.geometry.ellipse_fit import fit_ellipses
from kgcp.measurement.search.edge_tracking import RAYS, RAYS_RAD

DIRECTIONS = np.stack((np.cos(RAYS_RAD), np.sin(RAYS_RAD)), axis=-1)


def fitted(edges: np.ndarray, inlying: np.ndarray, most: float = 2.0) -> tuple[np.ndarray, bool]:
    ellipses, shares = np.zeros((1, 5)), np.zeros(1)
    fit_ellipses(edges[None], inlying[None], DIRECTIONS, most, ellipses, shares)
    assert float(shares[0]) in (0.0, pytest.approx(inlying.mean()))
    return ellipses[0], bool(shares[0])


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("seed", range(8))
def test_fits_equal_those_of_single_ellipses(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    edges = 1.0 + 0.25 * np.cos(2.0 * (RAYS_RAD - rng.uniform(0.0, 3.0)))
    edges += 0.1 * np.cos(RAYS_RAD - rng.uniform(0.0, 3.0)) + rng.normal(0.0, noise, RAYS)
    inlying = rng.random(RAYS) < 0.7
    found, possible = fitted(edges, inlying)
    expected = ellipse_from_conic(fit_ellipse((edges[:, None] * DIRECTIONS)[inlying]))
    assert possible
    np.testing.assert_allclose(
        found[:4], [expected.x, expected.y, expected.a, expected.b], atol=1e-6
    )
    assert np.cos(found[4] - expected.angle_rad) ** 2 == pytest.approx(1.0, abs=1e-6)


def test_a_circle_is_found_to_the_last_digits() -> None:
    found, possible = fitted(np.full(RAYS, 1.1), np.ones(RAYS, dtype=np.bool_))
    assert possible
    np.testing.assert_allclose(found[:4], [0.0, 0.0, 1.1, 1.1], atol=1e-7)


def test_ellipses_beyond_the_axis_ratio_are_rejected() -> None:
    edges = 1.0 / np.hypot(np.cos(RAYS_RAD), 2.5 * np.sin(RAYS_RAD))
    found, possible = fitted(edges, np.ones(RAYS, dtype=np.bool_))
    assert not possible
    np.testing.assert_allclose(found[2] / found[3], 2.5, rtol=1e-6)


def test_without_edge_points_no_ellipse_is_fitted() -> None:
    _, possible = fitted(np.ones(RAYS), np.zeros(RAYS, dtype=np.bool_))
    assert not possible
