"""Which discs of a field are enough for a photograph."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from kgcp.measurement.field_photograph import _are_in_one_row


@pytest.mark.parametrize(("beside", "is_row"), [(0, True), (1, True), (2, False)])
def test_a_row_with_a_single_disc_beside_it_counts_as_a_row(beside: int, *, is_row: bool) -> None:
    points_m = np.zeros((9, 3))
    points_m[:, 0] = np.arange(9.0)
    points_m[:beside, 1] = 0.5
    assert _are_in_one_row(points_m) is is_row


def test_testing_whether_discs_are_in_a_row_needs_little_memory() -> None:
    """Matrices of every disc with every other one, for each that is left out, took seconds."""
    points_m = np.random.default_rng(1).normal(size=(300, 3))
    tracemalloc.start()
    assert not _are_in_one_row(points_m)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200_000
