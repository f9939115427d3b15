"""The base of an unknown tone curve: some frames decide it, and the others are measured over it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from kgcp.errors import Reason
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.io.flight.flight import read_flight
from kgcp.measurement.guided import Prediction
from kgcp.measurement.plate_prior import PlatePrior, SceneRotation
from kgcp.measurement.records import ExposureSettings, FrameResult, Measurement, Miss, ToneBase
from kgcp.pipeline.detect import RunOptions, detect_flight
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
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.plate import image_plate
from tests.flight_toml import RING_A, camera_table

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

CAMERA = Camera(320, 240, 900.0, 904.0, 156.3, 124.2)
FRAMES, ASKED = 12, 8
FLIGHT = f'{camera_table(CAMERA)}response = "unknown"\n{RING_A}'


class StopAfter:
    """A listener that interrupts after some frames, and records the messages."""

    def __init__(self, looks: int) -> None:
        self._looks = looks
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def progress(self, stage: str, done: int, total: int, found: int) -> None:
        assert stage == "first look"
        assert found <= total == FRAMES
        if done >= self._looks:
            raise KeyboardInterrupt


def written_flight(folder: Path, tones: Mapping[int, ToneCurve], rest: ToneCurve) -> Path:
    (folder / "frames").mkdir(parents=True)
    rng = np.random.default_rng(4)
    for number in range(FRAMES):
        irradiance = np.full((CAMERA.height, CAMERA.width), 0.3)
        pose = Pose(np.eye(3), np.array([-0.4 + 0.07 * number, -0.2, 9.0 + 0.2 * number]))
        image_plate(CAMERA, TARGET_PLATE, pose, Optics(0.7)).paste(irradiance)
        grey = Sensor(tone=tones.get(number, rest)).expose(irradiance, 0.9, rng)
        assert cv2.imwrite(str(folder / "frames" / f"f_{number:02d}.png"), grey)
    (folder / "flight.toml").write_text(FLIGHT, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written_flight(tmp_path_factory.mktemp("tone") / "flight", {}, ToneCurve.SRGB)


@pytest.fixture
def bases(monkeypatch: pytest.MonkeyPatch) -> dict[str, ToneBase | None]:
    """Remember over which base each frame was measured; None: over both."""
    asked: dict[str, ToneBase | None] = {}

    def examined(job: DetectionJob, frame_input: FrameInput) -> FrameResult:
        asked[frame_input.frame] = job.tone_base
        result = examine_frame(job, frame_input)
        (outcome,) = result.outcomes
        assert isinstance(outcome, Measurement)
        assert (outcome.rival is None) == (job.tone_base is not None)
        return result

    monkeypatch.setattr("kgcp.pipeline.detection_run.examine_frame", examined)
    return asked


def detect(
    flight: Path,
    out: Path,
    listener: StopAfter | None = None,
    *,
    is_learning: bool = True,
    jobs: int = 0,
) -> DetectionSummary:
    settings = DetectSettings(is_learning=is_learning)
    options = RunOptions(jobs=jobs)
    return detect_flight(read_flight(flight), settings, out=out, options=options, listener=listener)


def table(out: Path) -> bytes:
    return (out / "detections.parquet").read_bytes()


def test_the_first_frames_decide_the_base_for_all_others(
    flight: Path, tmp_path: Path, bases: dict[str, ToneBase | None]
) -> None:
    summary = detect(flight, tmp_path)
    assert list(bases.values()) == [None] * ASKED + [ToneBase.SRGB] * (FRAMES - ASKED)
    assert {f"f_{number:02d}.png" for number in (0, 4, 8)} <= set(list(bases)[:ASKED])
    assert summary.tone_base == "sRGB"
    assert summary.measured_with_tone == ASKED
    assert summary.status["measured"] == FRAMES


def test_without_learning_every_frame_is_measured_over_both_bases(
    flight: Path, tmp_path: Path, bases: dict[str, ToneBase | None]
) -> None:
    summary = detect(flight, tmp_path, is_learning=False)
    assert set(bases.values()) == {None}
    assert summary.tone_base is None


def test_where_the_first_frames_disagree_all_are_measured_over_both(
    tmp_path: Path, bases: dict[str, ToneBase | None]
) -> None:
    film = dict.fromkeys(range(0, FRAMES, 2), ToneCurve.FILM)
    folder = written_flight(tmp_path / "flight", film, ToneCurve.SRGB)
    summary = detect(folder, tmp_path / "out")
    assert set(bases.values()) == {None}
    assert summary.tone_base is None
    assert summary.measured_with_tone == FRAMES


@pytest.fixture(scope="module")
def undisturbed(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table of a run in this process."""
    out = tmp_path_factory.mktemp("undisturbed")
    detect(flight, out)
    return table(out)


@pytest.mark.parametrize("looks", [3, ASKED, ASKED + 2])
def test_a_resumed_run_uses_the_same_base(
    flight: Path,
    undisturbed: bytes,
    tmp_path: Path,
    bases: dict[str, ToneBase | None],
    looks: int,
) -> None:
    with pytest.raises(KeyboardInterrupt):
        detect(flight, tmp_path / "out", StopAfter(looks))
    bases.clear()
    listener = StopAfter(1000)
    summary = detect(flight, tmp_path / "out", listener)
    assert len(bases) == FRAMES - looks
    assert summary.kept == looks
    (note,) = listener.notes
    assert f"results of {looks} of {FRAMES} frames are kept, 0 have changed" in note
    assert table(tmp_path / "out") == undisturbed


def test_the_choice_of_the_base_does_not_depend_on_the_number_of_workers(
    flight: Path, undisturbed: bytes, tmp_path: Path
) -> None:
    detect(flight, tmp_path, jobs=2)
    assert table(tmp_path) == undisturbed


def test_changed_deciding_frames_change_the_base_of_the_others(
    flight: Path, tmp_path: Path, bases: dict[str, ToneBase | None]
) -> None:
    copy = shutil.copytree(flight, tmp_path / "flight")
    with pytest.raises(KeyboardInterrupt):
        detect(copy, tmp_path / "out", StopAfter(FRAMES - 1))
    film = dict.fromkeys(range(FRAMES), ToneCurve.FILM)
    other = written_flight(tmp_path / "other", film, ToneCurve.FILM)
    for frame in list(bases)[:ASKED]:
        shutil.copyfile(other / "frames" / frame, copy / "frames" / frame)
    bases.clear()
    listener = StopAfter(1000)
    summary = detect(copy, tmp_path / "out", listener)
    (note,) = listener.notes
    assert f"results of up to 3 of {FRAMES} frames are kept, {ASKED} have changed" in note
    assert summary.kept == 0
    assert list(bases.values()) == [None] * FRAMES, "which is all that these frames say"
    detect(copy, tmp_path / "fresh")
    assert table(tmp_path / "out") == table(tmp_path / "fresh")


def test_the_likelier_base_is_used_for_all_if_the_choice_hardly_matters(
    flight: Path,
    tmp_path: Path,
    bases: dict[str, ToneBase | None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (
        ("_CLEAR_ADVANTAGE", np.inf),
        ("_MIN_FRAMES", ASKED),
        ("_SAME_DISTANCE_SIGMAS", 100.0),
    ):
        monkeypatch.setattr(f"kgcp.quality.learnt_imaging.{name}", value)
    summary = detect(flight, tmp_path)
    assert list(bases.values()) == [None] * ASKED + [ToneBase.SRGB] * (FRAMES - ASKED)
    assert (summary.tone_base, summary.measured_with_tone) == ("sRGB", ASKED)


def test_the_base_is_added_to_the_priors_of_a_target() -> None:
    rotation = SceneRotation((0.1, 0.0, 0.0), 0.01)
    target = TARGET_PLATE.target
    job = DetectionJob(Path(), CAMERA, None, (target,), DetectSettings(), tone_base=ToneBase.LINE)
    known = FrameInput("f.png", None, {target.name: PlatePrior(rotation=rotation)})
    assert job.priors(known) == {target.name: PlatePrior(None, rotation, ToneBase.LINE)}
    unknown = FrameInput("g.png", None, {})
    assert job.priors(unknown) == {target.name: PlatePrior(tone_base=ToneBase.LINE)}


def test_a_second_look_uses_the_same_base(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, asked = TARGET_PLATE.target, []

    def look(*arguments: object) -> tuple[None, tuple[()]]:
        asked.append(arguments[5])
        return None, ()

    monkeypatch.setattr("kgcp.pipeline.frame_task.measure_guided", look)
    folder = read_flight(flight).frames_folder
    job = DetectionJob(folder, CAMERA, None, (target,), DetectSettings(), tone_base=ToneBase.LINE)
    known = FrameInput("f_00.png", None, {})
    missed = FrameResult("f_00.png", None, ExposureSettings(), (Miss("A", Reason.NO_CANDIDATE),))
    expected = Prediction(np.array([160.0, 120.0]), 2.0, 40.0, 0.1, "trajectory")
    examine_frame_again(job, GuidedInput(known, missed, {"A": expected}))
    assert asked == [PlatePrior(tone_base=ToneBase.LINE)]
