"""The tone curve is learnt from all frames of a flight, unless `--no-learn` is given."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from kgcp.cli import main
from kgcp.io.tables.detections import read_detections
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.presets import preset

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

FRAMES = 7


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small frames of a camera with a film-like curve that flight.toml does not know.

    They are not sharpened or compressed, which can look like parts of another curve.
    """
    consumer = preset("consumer")
    settings = replace(
        consumer,
        sensor=replace(consumer.sensor, sharpening=0.0),
        jpeg_quality=None,
        camera=replace(consumer.camera, width=720, height=540, cx=364.2, cy=267.1),
        frames=FRAMES,
        distance_m=(14.0, 40.0),
        absent_share=0.0,
        decoy_share=0.0,
    )
    folder = tmp_path_factory.mktemp("learning") / "flight"
    write_simulated_flight(plan_flight(settings, 11), folder, jobs=1, on_frame=lambda: None)
    return folder


def detect(flight: Path, out: Path, *options: str) -> dict[str, object]:
    arguments = ["detect", str(flight), "--out", str(out), "--jobs", "0", "--json", "-q", *options]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    summary: dict[str, object] = json.loads(result.stdout)
    return summary


def test_all_frames_have_one_tone_curve_unless_it_is_left_out(flight: Path, tmp_path: Path) -> None:
    learnt = detect(flight, tmp_path / "learnt")
    assert learnt["tone_base"] == "a straight line"
    assert FRAMES - 1 <= learnt["measured_with_tone"] <= FRAMES  # type: ignore[operator]  # a number
    metadata = pq.read_schema(tmp_path / "learnt" / "detections.parquet").metadata
    said = json.loads(metadata[b"kgcp.learnt_imaging"])
    assert said["tone_base"] == "a straight line"
    assert -0.1 < said["smoothing"]["mean_px2"] < 0.1, "the simulated camera does not smooth"
    alone = detect(flight, tmp_path / "alone", "--no-learn")
    assert alone["tone_base"] is None
    assert alone["measured_with_tone"] == 0
    metadata = pq.read_schema(tmp_path / "alone" / "detections.parquet").metadata
    assert b"kgcp.learnt_imaging" not in metadata
    both = [read_detections(tmp_path / name / "detections.parquet") for name in ("learnt", "alone")]
    distances = [table.set_index("frame")["distance_m"] for table in both]
    changed = (distances[0] / distances[1] - 1.0).abs()
    assert 0.0 < changed.max() < 2e-3
    assert int((changed != 0.0).sum()) == learnt["measured_with_tone"], "all, by their smoothing"
