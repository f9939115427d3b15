"""The tone curve that all photographs of a camera share, and warnings if it is missing."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest

from kgcp.errors import KgcpWarning
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Response
from kgcp.measurement.discs.camera_tone import CameraTone
from kgcp.measurement.discs.fit_disc import ProcessingPrior
from kgcp.measurement.discs.records import Operator
from kgcp.measurement.field_photograph import PhotoDiscs, PhotoMiss, PhotoTask
from kgcp.measurement.image_model.photometry import Tone
from kgcp.pipeline.calibration.photographs import Photo
from kgcp.pipeline.calibration.run import _camera_of, _Kept, _Looks
from kgcp.pipeline.detect import NoProgress
from kgcp.pipeline.execution.executor import WorkerPool
from kgcp.pipeline.execution.journal import Journal, fingerprint
from kgcp.pipeline.execution.resilient_map import SerialExecutor, TaskFailure
from kgcp.targets.fields.layout import Field, GridKind

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")


class LosingPool(WorkerPool):
    """A pool that loses every job."""

    def map(
        self, function: Callable[..., Any], items: Iterable[Any]
    ) -> Generator[tuple[Any, Any | TaskFailure]]:
        assert callable(function)
        for item in items:
            yield item, TaskFailure.CRASHED


class MeasuringPool(WorkerPool):
    """A pool that works at once, in this process."""

    def map(
        self, function: Callable[..., Any], items: Iterable[Any]
    ) -> Generator[tuple[Any, Any | TaskFailure]]:
        for item in items:
            yield item, function(item)


UNRELIABLE = CameraTone(Tone.UNKNOWN, 1.0, is_reliable=False)


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal[_Kept]]:
    kinds: tuple[type[_Kept], ...] = (PhotoDiscs, PhotoMiss, CameraTone)
    with Journal(tmp_path / "journal", {"by": "test"}, kinds, is_new=False) as opened:
        yield opened


class TellingPool(WorkerPool):
    """A pool that returns a tone for any job: an unreliable one if there are many jobs."""

    def map(
        self, function: Callable[..., Any], items: Iterable[Any]
    ) -> Generator[tuple[Any, Any | TaskFailure]]:
        assert callable(function)
        for item in items:
            yield item, UNRELIABLE if self.jobs > 1 else replace(UNRELIABLE, is_reliable=True)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_tone_curve_hidden_by_compression_causes_a_warning(
    journal: Journal[_Kept], jobs: int
) -> None:
    pool = TellingPool(jobs, SerialExecutor(), (), Counter())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learned = _camera_of(journal, pool, cast("PhotoTask", None), ())
    assert learned is not None
    said = ["hardly tell their tone curve" in str(each.message) for each in caught]
    assert said == [True] * (jobs - 1)
    assert learned.is_reliable is (jobs == 1)


def test_without_a_learned_tone_there_is_a_warning_and_no_common_tone(
    journal: Journal[_Kept],
) -> None:
    pool = LosingPool(1, SerialExecutor(), (), Counter())
    with pytest.warns(KgcpWarning, match="has ended or taken too long"):
        assert _camera_of(journal, pool, cast("PhotoTask", None), ()) is None


def test_a_resumed_run_does_not_learn_the_tone_again(
    journal: Journal[_Kept], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes minutes. All digits are kept: photographs that were measured with it are found."""
    prior = ProcessingPrior(np.array([0.1, -0.7, 0.0, 0.5]) / 3.0, np.eye(4) / 7.0)
    learned = CameraTone(Tone.UNKNOWN_OVER_LINE, 1.25, prior, 0.7, is_curve_unknown=True)
    monkeypatch.setattr("kgcp.pipeline.calibration.run.learn_from_photos", lambda *_: learned)
    task = cast("PhotoTask", None)
    measuring = MeasuringPool(1, SerialExecutor(), (), Counter())
    assert _camera_of(journal, measuring, task, ()) is learned
    kept = _camera_of(journal, LosingPool(1, SerialExecutor(), (), Counter()), task, ())
    assert fingerprint(kept) == fingerprint(learned)
    assert kept is not None
    assert kept.tone is learned.tone


def test_photographs_measured_with_another_tone_are_measured_again(
    tmp_path: Path, journal: Journal[_Kept]
) -> None:
    """Other photographs give another tone."""
    photo = Photo("a.png", tmp_path / "a.png")
    photo.path.write_bytes(b"nothing")
    pool = MeasuringPool(1, SerialExecutor(), (), Counter())
    tones = (None, replace(UNRELIABLE, prior=ProcessingPrior.usual()), UNRELIABLE, UNRELIABLE)
    results = []
    for index, tone in enumerate(tones):
        result = PhotoMiss(photo.name, 0, 0, "too_few", f"look {index}")

        def measure(_: Photo, result: PhotoMiss = result) -> PhotoMiss:
            return result

        looks = _Looks(journal, pool, NoProgress(), tone)
        results += looks.through("photographs", [photo], [photo.name], measure)
    details = [result.detail for result in results if isinstance(result, PhotoMiss)]
    assert details == ["look 0", "look 1", "look 2", "look 2"]


def test_the_tone_is_learned_from_five_photographs_that_can_be_read(
    tmp_path: Path, journal: Journal[_Kept], monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = [Photo(f"{index}.png", tmp_path / f"{index}.png") for index in range(12)]
    for index, photo in enumerate(photos):
        grey = np.full((2, 2 + index), 128, dtype=np.uint8)
        if index in {0, 4}:
            photo.path.write_bytes(b"nothing")
        else:
            cv2.imwrite(str(photo.path), grey)
    widths: list[int] = []

    def learn(greys: Iterable[GreyArray], task: PhotoTask) -> None:
        assert task.camera is None
        widths.extend(grey.shape[1] - 2 for grey in greys)

    monkeypatch.setattr("kgcp.pipeline.calibration.photographs.learn_from_fields", learn)
    field = Field("f", GridKind.SQUARE, 5, 4, 0.03, 0.016)
    task = PhotoTask(field, Response.UNKNOWN, Operator.MODEL)
    _camera_of(journal, MeasuringPool(1, SerialExecutor(), (), Counter()), task, photos)
    assert widths == [2, 6, 8, 10, 1]
