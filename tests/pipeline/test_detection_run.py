"""The order in which frames are examined, and what a resumed run keeps."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from kgcp.errors import Reason
from kgcp.geometry.camera import Camera
from kgcp.measurement.guided import Prediction
from kgcp.measurement.records import ExposureSettings, FrameResult, Miss, ToneBase
from kgcp.pipeline.detect import NoProgress
from kgcp.pipeline.detection_run import DetectionRun
from kgcp.pipeline.execution.executor import WorkerPool
from kgcp.pipeline.execution.journal import Journal
from kgcp.pipeline.frame_task import DetectionJob, FrameInput, GuidedInput
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import TARGET_PLATE

CAMERA = Camera(320, 240, 900.0, 904.0, 156.3, 124.2)
FRAMES = [f"f_{number:02d}.png" for number in range(40)]
EXPECTED = Prediction(np.array([160.0, 120.0]), 2.0, 40.0, 0.1, "trajectory")
ABSENT = (Miss("A", Reason.NO_CANDIDATE),)


class ThisProcess:
    """A pool without processes."""

    def map(
        self, function: Callable[[Any], FrameResult], items: Iterable[Any]
    ) -> Generator[tuple[Any, FrameResult]]:
        for item in items:
            yield item, function(item)


class Looks:
    """Records of all looks at empty frames, each with the base used.

    Parameters
    ----------
    enough : int
        Results that tell the base.
    last : int
        Looks after which Ctrl-C is pressed.
    """

    def __init__(self, base: ToneBase, *, enough: int, last: int = 1000) -> None:
        self._base, self._enough, self._last = base, enough, last
        self.first: dict[str, ToneBase | None] = {}
        self.second: dict[str, ToneBase | None] = {}

    def examine(self, job: DetectionJob, frame_input: FrameInput) -> FrameResult:
        self.first[frame_input.frame] = job.tone_base
        return self._result(frame_input.frame)

    def examine_again(self, job: DetectionJob, look: GuidedInput) -> FrameResult:
        self.second[look.input.frame] = job.tone_base
        return self._result(look.input.frame)

    def _result(self, frame: str) -> FrameResult:
        if len(self.first) + len(self.second) > self._last:
            raise KeyboardInterrupt
        return FrameResult(frame, None, ExposureSettings(), ABSENT)

    def clearly_agreed_base(self, results: Iterable[FrameResult]) -> ToneBase | None:
        return self._base if sum(1 for _ in results) >= self._enough else None


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Looks], None]:
    """Examine all frames, and the first ones again, with the contents of the journal."""
    target = TARGET_PLATE.target
    job = DetectionJob(tmp_path / "frames", CAMERA, None, (target,), DetectSettings())
    inputs = [FrameInput(frame, None, {}) for frame in FRAMES]
    pool = cast("WorkerPool", ThisProcess())

    def looked_at(looks: Looks) -> None:
        module = "kgcp.pipeline.detection_run"
        monkeypatch.setattr(f"{module}.examine_frame", looks.examine)
        monkeypatch.setattr(f"{module}.examine_frame_again", looks.examine_again)
        monkeypatch.setattr(f"{module}.clearly_agreed_base", looks.clearly_agreed_base)
        with Journal(tmp_path / "journal", {}, (FrameResult,), is_new=False) as journal:
            detection_run = DetectionRun(job, inputs, journal, pool, NoProgress())
            detection_run.first_pass()
            detection_run.guided_pass({row: {"A": EXPECTED} for row in range(4)}, {})

    return looked_at


@pytest.mark.parametrize(("enough", "asked"), [(8, 8), (9, 16), (17, 32), (33, 40)])
def test_batches_over_both_bases_double_until_the_base_is_decided(
    run: Callable[[Looks], None], enough: int, asked: int
) -> None:
    """Each batch is spread evenly over all frames."""
    looks = Looks(ToneBase.SRGB, enough=enough)
    run(looks)
    bases = [*looks.first.values()]
    assert bases == [None] * asked + [ToneBase.SRGB] * (len(FRAMES) - asked)
    rows = sorted(FRAMES.index(frame) for frame in [*looks.first][:asked])
    assert np.diff([*rows, len(FRAMES)]).max() <= 2 * len(FRAMES) // asked


def test_a_second_look_is_resumed_over_the_base_in_the_journal(
    run: Callable[[Looks], None],
) -> None:
    interrupted = Looks(ToneBase.LINE, enough=8, last=len(FRAMES) + 2)
    with pytest.raises(KeyboardInterrupt):
        run(interrupted)
    resumed = Looks(ToneBase.LINE, enough=8)
    run(resumed)
    assert not resumed.first
    assert resumed.second == dict.fromkeys(FRAMES[2:4], ToneBase.LINE)


def test_a_second_look_over_another_base_is_not_kept(run: Callable[[Looks], None]) -> None:
    run(Looks(ToneBase.LINE, enough=8))
    changed = Looks(ToneBase.SRGB, enough=8)
    run(changed)
    assert len(changed.first) == len(FRAMES) - 8
    assert changed.second == dict.fromkeys(FRAMES[:4], ToneBase.SRGB)
