from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("resource", reason="Windows counts no CPU time of threads")

from benchmarks.speed.costs import Costs, FrameCost, cost_line, cost_of
from benchmarks.speed.sources import Source, flight_over, photographs_of
from kgcp.io.flight.flight import read_flight

SAMPLE = Path(__file__).resolve().parents[2] / "sample_flight"


@pytest.fixture
def source() -> Source:
    return Source("sample", read_flight(SAMPLE), tuple(f"f_{number}.jpg" for number in range(10)))


def test_ratios_are_those_of_the_sums() -> None:
    frames = (FrameCost(2_000_000, 0.02, 0.01, 0.03, 1), FrameCost(2_000_000, 0.06, 0.01, 0.05, 1))
    costs = Costs("some", "with", frames)
    assert costs.search == pytest.approx(0.02 / 0.08)
    assert costs.whole == pytest.approx(1.0 + 0.08 / 0.08)
    assert costs.typical == pytest.approx(1.0 + (0.03 / 0.02 + 0.05 / 0.06) / 2)
    words = ["some", "with", "2", "2.0", "40.0", "0.25", "2.00", "2.17"]
    assert cost_line(costs).split() == words


def test_a_spread_has_the_first_and_the_last_frame(source: Source) -> None:
    chosen = source.spread(4).frames
    assert len(chosen) == 4
    assert (chosen[0], chosen[-1]) == (source.frames[0], source.frames[-1])
    assert source.spread(100).frames == source.frames


def test_photographs_are_put_together_by_size_and_timed(source: Source, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for name, shape in (("a.png", (90, 160)), ("b.png", (90, 160)), ("c.png", (120, 100))):
        cv2.imwrite(str(tmp_path / name), rng.integers(0, 255, shape, dtype=np.uint8))
    found = photographs_of(tmp_path, source)
    assert [source.frames for source in found] == [("a.png", "b.png"), ("c.png",)]
    assert (found[0].flight.camera.width, found[0].flight.camera.height) == (160, 90)
    cost = cost_of(tmp_path / "a.png", found[0].flight.camera, found[0].flight.targets)
    assert (cost.pixels, cost.found) == (160 * 90, 0)
    assert min(cost.decode_s, cost.search_s, cost.measure_s) >= 0.0


def test_without_a_folder_there_are_no_photographs(source: Source, tmp_path: Path) -> None:
    assert photographs_of(None, source) == []
    assert photographs_of(tmp_path / "nowhere", source) == []


def test_another_camera_keeps_the_targets(source: Source, tmp_path: Path) -> None:
    flight = flight_over(source, tmp_path, 400, 300)
    assert flight.targets == source.flight.targets
    assert replace(
        source.flight, frames_folder=tmp_path, camera=flight.camera, times_file=None
    ) == (flight)
