from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import numpy as np
import pytest

from kgcp.geometry import _jit, distortion
from kgcp.geometry.arrays import FloatArray

LENS = (-0.1, 0.05, 1e-4, -2e-4, 0.01, 0.02, 0.0, 0.0)
SCALE = (3100.0, 3110.0, 2001.0, 1498.0)


def fresh_copy(module: ModuleType) -> ModuleType:
    """Import a module a second time: nothing of it is compiled."""
    spec = importlib.util.spec_from_file_location("copy", module.__file__)
    assert spec is not None
    assert spec.loader is not None
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    return copy


def there_and_back(module: ModuleType, points: FloatArray) -> tuple[FloatArray, ...]:
    pixels, back, slopes = np.empty_like(points), np.empty_like(points), np.empty((len(points), 4))
    module.distort_points(LENS, SCALE, points, pixels)
    module.undistort_points(LENS, SCALE, pixels, back)
    module.distort_slopes(LENS, SCALE, points, slopes.reshape(-1, 2, 2))
    return pixels, back, slopes


def test_few_points_are_distorted_without_numba_to_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = np.random.default_rng(1).normal(0.0, 0.5, (40, 2))
    points[:3] = (0.0, 0.0), (30.0, 40.0), (np.nan, 1.0)
    monkeypatch.setattr(_jit._Spared, "calls_left", 0)
    compiled = there_and_back(distortion, points)
    copy = fresh_copy(distortion)
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.setattr(_jit._Spared, "calls_left", 10_000)
    interpreted = there_and_back(copy, points)
    assert 0 < _jit._Spared.calls_left < 10_000
    for ours, numbas in zip(interpreted, compiled, strict=True):
        np.testing.assert_array_equal(ours, numbas)
    assert np.isnan(interpreted[1]).any()
