"""Runs that are stopped, disturbed or started twice end with the table of one that was not."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import read_table
from kgcp.measurement.records import FrameResult
from kgcp.pipeline.detect import RunOptions, detect_flight
from kgcp.pipeline.execution.resilient_map import TaskFailure
from kgcp.pipeline.frame_task import (
    DetectionJob,
    FrameInput,
    GuidedInput,
    examine_frame,
    examine_frame_again,
)
from kgcp.pipeline.run_summary import DetectionSummary
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import image_plate
from tests.flight_toml import RING_A, camera_table
from tests.systems import kill

CAMERA = Camera(320, 240, 900.0, 904.0, 156.3, 124.2)
FRAMES, EMPTY = 9, (3, 6)
FLIGHT = camera_table(CAMERA) + RING_A


class Stop:
    """A listener that presses Ctrl-C after some looks, and remembers what was said."""

    def __init__(self, after: int = 1000) -> None:
        self.after = after
        self.notes: list[str] = []
        self.done = self.found = 0  # of all stages together
        self.totals: dict[str, int] = {}

    def note(self, text: str) -> None:
        self.notes.append(text)

    def progress(self, stage: str, done: int, total: int, found: int) -> None:
        self.totals[stage] = total
        self.done = sum(self.totals.values()) - total + done
        self.found = found
        if self.done >= self.after:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def master(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A smooth passage, in two frames of which the target is hidden: they get a second look."""
    folder = tmp_path_factory.mktemp("master")
    (folder / "frames").mkdir()
    rng = np.random.default_rng(4)
    times = ["frame,time"]
    for number in range(FRAMES):
        irradiance = np.full((CAMERA.height, CAMERA.width), 0.3)
        if number not in EMPTY:
            pose = Pose(np.eye(3), np.array([-1.6 + 0.4 * number, -0.5, 27.0 + 0.3 * number]))
            image_plate(CAMERA, TARGET_PLATE, pose, Optics(0.7)).paste(irradiance)
        grey = Sensor().expose(irradiance, 0.9, rng)
        assert cv2.imwrite(str(folder / "frames" / f"f_{number}.png"), grey)
        times.append(f"f_{number}.png,2026-06-16T08:15:{number:02d}Z")
    (folder / "frames.csv").write_text("\n".join(times), encoding="utf-8")
    (folder / "flight.toml").write_text(FLIGHT, encoding="utf-8")
    return folder


@pytest.fixture
def flight(master: Path, tmp_path: Path) -> Path:
    return shutil.copytree(master, tmp_path / "flight")


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count what is looked at, and how often."""
    counter: Counter[str] = Counter()

    def counted(job: DetectionJob, frame_input: FrameInput) -> FrameResult:
        counter[frame_input.frame] += 1
        return examine_frame(job, frame_input)

    def counted_again(job: DetectionJob, look: GuidedInput) -> FrameResult:
        counter[f"{look.input.frame} again"] += 1
        return examine_frame_again(job, look)

    monkeypatch.setattr("kgcp.pipeline.detection_run.examine_frame", counted)
    monkeypatch.setattr("kgcp.pipeline.detection_run.examine_frame_again", counted_again)
    return counter


def detect(
    folder: Path,
    listener: Stop | None = None,
    *,
    is_restart: bool = False,
    min_radius_px: float = 6.0,
) -> DetectionSummary:
    return detect_flight(
        read_flight(folder),
        DetectSettings(min_radius_px=min_radius_px),
        options=RunOptions(jobs=0, is_restart=is_restart),
        listener=listener,
    )


def table(folder: Path) -> bytes:
    return (folder / "kgcp" / "detections.parquet").read_bytes()


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "kgcp").iterdir())


def stop(folder: Path, after: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        detect(folder, Stop(after))


@pytest.fixture(scope="module")
def undisturbed(master: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = shutil.copytree(master, tmp_path_factory.mktemp("undisturbed") / "flight")
    detect(folder)
    return table(folder)


def test_a_run_stopped_after_every_look_does_nothing_twice(
    flight: Path, undisturbed: bytes, looks: Counter[str]
) -> None:
    after, total = 1, FRAMES
    while after <= total:  # which the second look increases
        listener = Stop(after)
        with pytest.raises(KeyboardInterrupt):
            detect(flight, listener)
        after, total = after + 1, sum(listener.totals.values())
        assert files(flight) == [".detections.journal"]
    listener = Stop()
    summary = detect(flight, listener)
    assert set(looks.values()) == {1}
    assert looks.keys() >= {
        *(f"f_{number}.png" for number in range(FRAMES)),
        *(f"f_{number}.png again" for number in EMPTY),
    }
    assert table(flight) == undisturbed
    assert files(flight) == ["detections.parquet", "run.json"]
    assert summary.kept == FRAMES
    rows = read_table(flight / "kgcp" / "detections.parquet", DETECTION_COLUMNS)
    assert listener.totals == {"first look": FRAMES, "second look": len(EMPTY)}
    assert listener.done == FRAMES + len(EMPTY)
    assert listener.found == (rows["status"] == "measured").sum() > FRAMES // 2
    (note,) = listener.notes
    assert note == (
        f"resuming an interrupted run: results of {FRAMES} of {FRAMES} frames are kept,"
        " 0 have changed since"
    )


def test_a_finished_run_leaves_nothing_to_go_on_with(flight: Path, looks: Counter[str]) -> None:
    listeners = [Stop(), Stop()]
    for listener in listeners:
        detect(flight, listener)
    assert looks["f_0.png"] == 2
    assert not listeners[1].notes


def test_restart_forgets(flight: Path, undisturbed: bytes, looks: Counter[str]) -> None:
    stop(flight, FRAMES)
    listener = Stop()
    detect(flight, listener, is_restart=True)
    assert looks["f_0.png"] == 2
    assert not listener.notes
    assert table(flight) == undisturbed


def test_what_changed_is_done_again(flight: Path, looks: Counter[str]) -> None:
    stop(flight, FRAMES + 1)
    frames = flight / "frames"
    shutil.copyfile(frames / "f_8.png", frames / "f_1.png")  # another size, most likely
    os.utime(frames / "f_2.png", ns=(1, 1))
    shutil.copyfile(frames / "f_4.png", frames / "g_0.png")  # a new one
    (frames / "f_5.png").unlink()
    text = (flight / "frames.csv").read_text(encoding="utf-8")
    (flight / "frames.csv").write_text(text.replace("08:15:07", "08:15:07.1"), encoding="utf-8")
    for after in (FRAMES - 3, 1000):  # of those kept, one is in the second batch
        listener = Stop(after)
        if after < 1000:
            with pytest.raises(KeyboardInterrupt):
                detect(flight, listener)
            assert listener.notes[0].startswith(
                "resuming an interrupted run: results of up to 5 of 9 frames are kept, 3 have"
            )
        else:
            detect(flight, listener)
            assert listener.notes[0].startswith(
                "resuming an interrupted run: results of up to 7 of 9 frames are kept, 1 have"
            )
    twice = {"f_1.png", "f_2.png", "f_7.png"}
    first = {frame: times for frame, times in looks.items() if "again" not in frame}
    assert first == {
        **{f"f_{number}.png": 1 for number in range(FRAMES)},
        **dict.fromkeys(twice, 2),
        "g_0.png": 1,
    }
    resumed = table(flight)
    detect(flight, is_restart=True)
    assert table(flight) == resumed


@pytest.mark.parametrize(
    ("edit", "min_radius_px", "what"),
    [
        (("fx = 900.0", "fx = 901.0"), 6.0, "the camera"),
        (("0, 43, 78", "0, 44, 78"), 6.0, "the targets"),
        (("", ""), 7.0, r"min_radius_px \(was 6\.0\)"),
    ],
)
def test_a_change_of_what_all_depends_on_loses_nothing(
    edit: tuple[str, str], min_radius_px: float, what: str, flight: Path, looks: Counter[str]
) -> None:
    stop(flight, 3)
    text = (flight / "flight.toml").read_text(encoding="utf-8")
    (flight / "flight.toml").write_text(text.replace(*edit), encoding="utf-8")
    with pytest.raises(KgcpError, match=rf"run; changed since: {what}; undo this to resume"):
        detect(flight, min_radius_px=min_radius_px)
    (flight / "flight.toml").write_text(text, encoding="utf-8")
    detect(flight)
    assert looks["f_0.png"] == 1


def test_a_table_that_cannot_be_written_keeps_the_journal(
    flight: Path, undisturbed: bytes, looks: Counter[str]
) -> None:
    (flight / "kgcp" / "detections.parquet" / "occupied").mkdir(parents=True)
    with pytest.raises(KgcpError, match=r"detections\.parquet: is a folder"):
        detect(flight)
    shutil.rmtree(flight / "kgcp" / "detections.parquet")
    detect(flight)
    assert table(flight) == undisturbed
    assert set(looks.values()) == {1}


def test_frames_that_vanish_stop_the_run_and_are_no_rows(
    flight: Path, undisturbed: bytes, looks: Counter[str]
) -> None:
    frames, elsewhere = flight / "frames", flight / "elsewhere"

    class Unmount(Stop):
        def progress(self, stage: str, done: int, total: int, found: int) -> None:
            super().progress(stage, done, total, found)
            if done == 4:
                frames.rename(elsewhere)

    with pytest.raises(KgcpError, match=r"f_\d\.png: has disappeared; once the frames are back"):
        detect(flight, Unmount())
    elsewhere.rename(frames)
    detect(flight)
    assert table(flight) == undisturbed
    assert looks["f_0.png"] == looks["f_3.png"] == 1


def test_frames_that_change_stop_the_run_before_its_table(
    flight: Path, undisturbed: bytes, looks: Counter[str]
) -> None:
    frames = flight / "frames"
    whole = {name: (frames / name).read_bytes() for name in ("f_1.png", "f_7.png")}
    for name, content in whole.items():
        (frames / name).write_bytes(content[:1000])

    class Copying(Stop):
        def progress(self, stage: str, done: int, total: int, found: int) -> None:
            super().progress(stage, done, total, found)
            if (stage, done) == ("first look", total):
                for name, content in whole.items():
                    (frames / name).write_bytes(content)

    with pytest.raises(
        KgcpError, match=r"f_1\.png: has changed .*, and so have 1 other frame; once"
    ):
        detect(flight, Copying())
    assert files(flight) == [".detections.journal"]
    detect(flight)
    assert table(flight) == undisturbed
    assert [looks[f"f_{number}.png"] for number in (0, 1, 7)] == [1, 2, 2]


def test_a_frame_that_is_deleted_after_its_measurement_keeps_its_row(
    flight: Path, undisturbed: bytes
) -> None:
    class Deleting(Stop):
        def progress(self, stage: str, done: int, total: int, found: int) -> None:
            super().progress(stage, done, total, found)
            if (stage, done) == ("second look", total):
                (flight / "frames" / "f_1.png").unlink()

    detect(flight, Deleting())
    assert table(flight) == undisturbed


def test_no_record_of_an_earlier_run_lies_beside_a_new_table(
    flight: Path, undisturbed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> int:
        raise KeyboardInterrupt

    detect(flight, min_radius_px=20.0)
    assert table(flight) != undisturbed
    monkeypatch.setattr("kgcp.pipeline.detect.draw_overlay", stopped)
    with pytest.raises(KeyboardInterrupt):
        detect_flight(
            read_flight(flight), options=RunOptions(jobs=0, overlay=flight / "kgcp" / "sheet")
        )
    assert table(flight) == undisturbed
    assert files(flight) == [".detections.journal", "detections.parquet", "sheet"]


def test_one_run_at_a_time(flight: Path, undisturbed: bytes) -> None:
    class Second(Stop):
        def progress(self, stage: str, done: int, total: int, found: int) -> None:
            super().progress(stage, done, total, found)
            with pytest.raises(KgcpError, match="another kgcp is writing here; wait"):
                detect(flight)

    detect(flight, Second())
    assert table(flight) == undisturbed


def examine_or_die(job: DetectionJob, frame_input: FrameInput) -> FrameResult:
    if frame_input.frame == "f_8.png":
        kill(os.getpid())
    return examine_frame(job, frame_input)


def test_a_frame_that_kills_its_worker_costs_no_other(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for what frames say of each other: the lost one is missing there."""
    settings = DetectSettings(is_guided=False, is_learning=False)
    with monkeypatch.context() as patch:
        patch.setattr("kgcp.pipeline.detection_run.examine_frame", examine_or_die)
        detect_flight(read_flight(flight), settings, options=RunOptions(jobs=1))
    detect_flight(read_flight(flight), settings, out=tmp_path, options=RunOptions(jobs=0))
    rows, others = (
        read_table(folder / "detections.parquet", DETECTION_COLUMNS).set_index("frame")
        for folder in (flight / "kgcp", tmp_path)
    )
    assert rows.index[rows["status"] == "unreadable"].to_list() == ["f_8.png"]
    assert rows.loc["f_8.png", "reason"] == "worker_died"
    assert (others["status"] == "measured").sum() > FRAMES // 3
    pd.testing.assert_frame_equal(rows.drop("f_8.png"), others.drop("f_8.png"))


def test_who_is_lost_is_tried_again_by_the_next_run(
    flight: Path, undisturbed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lossy(
        function: Callable[[Any], FrameResult], items: Iterable[Any], *_: object
    ) -> Generator[tuple[Any, FrameResult | TaskFailure]]:
        for item in items:
            is_deadly = isinstance(item, FrameInput) and item.frame == "f_2.png"
            is_hopeless = isinstance(item, GuidedInput) and item.input.frame == "f_6.png"
            yield (
                item,
                TaskFailure.CRASHED
                if is_deadly
                else TaskFailure.TIMED_OUT
                if is_hopeless
                else function(item),
            )

    with monkeypatch.context() as patch:
        patch.setattr("kgcp.pipeline.execution.executor.resilient_map", lossy)
        stop(flight, FRAMES)
        summary = detect(flight)
    assert summary.kept == FRAMES - 1, "who has died is tried again by the next run"
    assert summary.reasons["worker_died"] == summary.status["unreadable"] == 1
    rows = read_table(flight / "kgcp" / "detections.parquet", DETECTION_COLUMNS).set_index("frame")
    died = rows.loc["f_2.png"]
    assert (died["status"], died["reason"], died["detail"]) == ("unreadable", "worker_died", "")
    assert pd.Timestamp(str(died["time"])).second == 2
    assert rows.loc["f_6.png", "reason"] == "no_candidate"
    assert "second look: timed_out" in str(rows.loc["f_6.png", "detail"])
    detect(flight)
    assert table(flight) == undisturbed
