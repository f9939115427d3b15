from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from kgcp.errors import KgcpError
from kgcp.io.flight.flight import Flight, read_flight
from kgcp.io.formats.frame_times import FrameTimes
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import write_table
from kgcp.io.tables.provenance import detections_provenance, frame_samples
from kgcp.io.tables.staleness import require_current
from kgcp.settings import DetectSettings
from tests.flight_toml import ON_A_VEHICLE

FRAMES = [f"{number}.pgm" for number in range(4)]


def write_frames(flight: Flight, seed: int) -> None:
    """Write uncompressed frames, which are equally long whatever they show."""
    rng = np.random.default_rng(seed)
    for name in FRAMES:
        pixels = rng.integers(0, 255, 200 * 100, dtype=np.uint8)
        (flight.frames_folder / name).write_bytes(b"P5 200 100 255\n" + pixels.tobytes())


def test_uncompressed_frames_of_another_flight_are_refused(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "flight.toml").write_text(ON_A_VEHICLE)
    flight = read_flight(tmp_path)
    write_frames(flight, seed=1)
    sizes = {name: (flight.frames_folder / name).stat().st_size for name in FRAMES}
    samples = frame_samples(flight.frames_folder, sizes)
    assert len(set(samples.values())) == len(FRAMES)
    about = detections_provenance(flight, DetectSettings(), sizes, samples, FrameTimes({}), None)
    path = tmp_path / "detections.parquet"
    null = {column.name: None for column in DETECTION_COLUMNS}
    write_table(path, DETECTION_COLUMNS, [{**null, "frame": name} for name in FRAMES], about)
    table = pd.read_parquet(path)
    require_current(path, table, flight)
    write_frames(flight, seed=2)
    with pytest.raises(KgcpError, match=r"'kgcp detect': files of 4 frames \(0.pgm, …\); repeat"):
        require_current(path, table, flight)
    (flight.frames_folder / FRAMES[0]).unlink()
    with pytest.raises(KgcpError, match="files of 3 frames"):
        require_current(path, table, flight)
    write_frames(flight, seed=1)
    require_current(path, table, flight)


def test_compressed_frames_are_not_sampled(tmp_path: Path) -> None:
    """Their lengths differ, and show which they are."""
    for name, size in (("1.jpg", 5000), ("2.jpg", 6000)):
        (tmp_path / name).write_bytes(bytes(size))
    assert frame_samples(tmp_path, {"1.jpg": 5000, "2.jpg": 6000, "3.jpg": None}) == {}
