from __future__ import annotations

import csv
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from kgcp.io.tables.places import places_csv
from kgcp.network.ground.target_places import PlacedTarget


@pytest.mark.parametrize(("is_geographic", "unit_m"), [(False, 1.0), (True, 111_320.0)])
def test_places_are_written_to_a_micrometre(unit_m: float, *, is_geographic: bool) -> None:
    position = np.array([2.123456789012345, 41.123456789012345, 171.1234567])
    placed = SimpleNamespace(
        target="A",
        position_map=position,
        sds=np.full(6, 2e-5),
        diameter_m=0.9,
        sd_diameter_m=1e-5,
        normal=np.array([0.0, 0.0, 1.0]),
    )
    text = places_csv([cast("PlacedTarget", placed)], is_geographic=is_geographic)
    (row,) = csv.DictReader(text.splitlines())
    off_m = (np.array([float(row[axis]) for axis in "xyz"]) - position) * [unit_m, unit_m, 1.0]
    assert np.abs(off_m).max() < 1e-6
