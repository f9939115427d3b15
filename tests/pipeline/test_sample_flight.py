"""sample_flight/ is what the simulator writes today (`make sample-flight`)."""

import io
import os
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kgcp.pipeline.simulate import encode_frame, write_texts
from kgcp.simulation.flight import FlightPlan, grow_ground, plan_flight, render_frame
from kgcp.simulation.presets import preset

SAMPLE = Path(__file__).resolve().parents[2] / "sample_flight"
DEFAULT_SEED = 1
NUMBER = re.compile(rb"-?\d+\.\d+")


@pytest.fixture(scope="module")
def plan() -> FlightPlan:
    return plan_flight(preset("sample"), DEFAULT_SEED)


def test_text_files_are_reproduced_byte_for_byte(plan: FlightPlan, tmp_path: Path) -> None:
    """On Windows, whose sines are rounded differently, only to the last digits."""
    write_texts(plan, tmp_path)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(path.name for path in SAMPLE.iterdir() if path.is_file())
    for name in names:
        stored, remade = ((folder / name).read_bytes() for folder in (SAMPLE, tmp_path))
        if os.name == "nt":
            before, now = (np.array(NUMBER.findall(text), float) for text in (stored, remade))
            np.testing.assert_allclose(now, before, rtol=0.0, atol=1e-8, err_msg=name)
            stored, remade = (NUMBER.sub(b"", text) for text in (stored, remade))
        assert stored == remade, name


@pytest.mark.parametrize("index", [1, 12])
def test_frames_are_reproduced(plan: FlightPlan, index: int) -> None:
    stored = (SAMPLE / f"frames/frame_{index:04d}.jpg").read_bytes()
    remade = encode_frame(plan, index, render_frame(plan, grow_ground(plan.seed), index))
    if remade == stored:
        return
    # Another release of the JPEG library may write other bytes of the same picture.
    one, other = (
        np.asarray(Image.open(io.BytesIO(data))).astype(float) for data in (stored, remade)
    )
    assert np.abs(one - other).mean() < 0.02


def test_the_sample_flight_has_near_far_and_empty_frames(plan: FlightPlan) -> None:
    distances = [frame.target.distance_m for frame in plan.frames if frame.present]
    assert min(distances) < 10.0
    assert max(distances) > 90.0
    assert any(not frame.present for frame in plan.frames)
    assert any(frame.decoys and not frame.present for frame in plan.frames)
    assert sum(path.stat().st_size for path in SAMPLE.glob("frames/*")) < 8e6
