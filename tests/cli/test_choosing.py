"""Some frames instead of all: `kgcp detect --frames`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.io.images.frame_patterns import matching_frames
from kgcp.io.tables.detections import read_detections
from kgcp.pipeline.detect import NoProgress, RunOptions, detect_flight
from tests.cli.conftest import FRAMES, SampleFlight

FEW = ("--frames", "*_000[06].jpg", "--frames", "frame_0000*", "--jobs", "0")


def test_frame_patterns_match_the_whole_path() -> None:
    frames = ["a/1.jpg", "a/2.jpg", "b/1.JPG"]
    assert matching_frames(frames, ()) == frames
    assert matching_frames(frames, ("*1.jpg",)) == ["a/1.jpg"]
    assert matching_frames(frames, ("b/*", "a/[!1]*")) == ["a/2.jpg", "b/1.JPG"]
    assert matching_frames(frames, ("a\\*",)) == ["a/1.jpg", "a/2.jpg"]
    with pytest.raises(KgcpError, match=r"'2.jpg' matches none of 3 frames \(a/1.jpg, a/2.jpg, "):
        matching_frames(frames, ("a/*", "2.jpg"))


def test_a_table_of_selected_frames_is_accepted_for_the_flight(unmeasured: SampleFlight) -> None:
    assert "matches none of 5 frames (" in unmeasured.fails("detect", "--frames", "DJI*")
    result = unmeasured.run("detect", *FEW, "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert (summary["frames"], summary["frames_not_chosen"]) == (2, 3)
    assert summary["times_without_frame"] == 0
    assert "3 other frames not examined (--frames)" in result.stderr
    table = unmeasured.out / "detections.parquet"
    assert set(read_detections(table)["frame"]) == {FRAMES[0], FRAMES[2]}
    metadata = pq.read_schema(table).metadata
    assert json.loads(metadata[b"kgcp.choice"])["frames"] == ["*_000[06].jpg", "frame_0000*"]
    assert unmeasured.run("export-gcp").exit_code == 0
    frames = unmeasured.path / "frames"
    shutil.copy(frames / FRAMES[0], frames / "frame_0009.jpg")
    assert unmeasured.run("export-gcp").exit_code == 0  # no pattern matches the new frame
    shutil.copy(frames / FRAMES[0], frames / "frame_0000b.jpg")
    assert "a new frame (frame_0000b.jpg)" in unmeasured.fails("export-gcp")


class Impatient(NoProgress):
    """Interrupts a run after this many frames."""

    def __init__(self, patience: int) -> None:
        self.patience = patience
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def progress(self, stage: str, done: int, total: int, found: int) -> None:  # noqa: ARG002
        if done == self.patience:
            raise KeyboardInterrupt


def test_a_run_over_all_frames_resumes_an_interrupted_selection(
    unmeasured: SampleFlight, tmp_path: Path
) -> None:
    flight = read_flight(unmeasured.path)
    some = RunOptions(jobs=0, frame_patterns=(FRAMES[0], FRAMES[4]))
    with pytest.raises(KeyboardInterrupt):
        detect_flight(flight, options=some, listener=Impatient(1))
    listener = Impatient(99)
    summary = detect_flight(flight, options=RunOptions(jobs=0), listener=listener)
    assert (summary.frames, summary.kept) == (5, 1)
    whole = detect_flight(flight, out=tmp_path / "whole", options=RunOptions(jobs=0))
    assert summary.table.read_bytes() == whole.table.read_bytes()


def test_some_frames_do_not_replace_the_table_of_all(
    unmeasured: SampleFlight, tmp_path: Path
) -> None:
    assert unmeasured.run("detect", *FEW).exit_code == 0
    assert unmeasured.run("detect", *FEW).exit_code == 0  # that of some may be replaced
    assert unmeasured.run("detect", "--jobs", "0").exit_code == 0
    table = unmeasured.out / "detections.parquet"
    whole = table.read_bytes()
    message = unmeasured.fails("detect", *FEW)
    assert f"{table}: has the detections of all frames, which would be lost" in message
    assert "(--frames)" in message
    assert table.read_bytes() == whole
    assert unmeasured.run("detect", *FEW, "--out", str(tmp_path / "few")).exit_code == 0
    table.write_bytes(b"damaged")
    assert unmeasured.run("detect", *FEW).exit_code == 0


def test_some_frames_do_not_end_an_interrupted_run_of_all(
    unmeasured: SampleFlight, tmp_path: Path
) -> None:
    flight = read_flight(unmeasured.path)
    with pytest.raises(KeyboardInterrupt):
        detect_flight(flight, options=RunOptions(jobs=0), listener=Impatient(5))
    message = unmeasured.fails("detect", *FEW, "--min-radius", "7")
    assert "has an interrupted run's results of 3 other frames, which would be lost" in message
    assert "(--frames)" in message
    assert unmeasured.run("detect", *FEW, "--out", str(tmp_path / "few")).exit_code == 0
    result = unmeasured.run("detect", "--jobs", "0")
    assert "results of 5 of 5 frames are kept" in result.stderr
    with pytest.raises(KeyboardInterrupt):
        detect_flight(flight, options=RunOptions(jobs=0), listener=Impatient(5))
    (unmeasured.out / "detections.parquet").unlink()
    assert unmeasured.run("detect", *FEW, "--restart").exit_code == 0
