"""What all photographs tell of the camera together is missed where it is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable
from typing import Any, cast

import pytest

from kgcp.errors import KgcpWarning
from kgcp.measurement.discs.photograph import PhotoTask
from kgcp.pipeline.calibration.run import _camera_of
from kgcp.pipeline.execution.executor import WorkerPool
from kgcp.pipeline.execution.resilient_map import SerialExecutor, TaskFailure


class LosingPool(WorkerPool):
    """Loses whatever it is given."""

    def map(
        self, function: Callable[..., Any], items: Iterable[Any]
    ) -> Generator[tuple[Any, Any | TaskFailure]]:
        assert callable(function)
        for item in items:
            yield item, TaskFailure.CRASHED


def test_a_tone_that_cannot_be_learned_together_is_told() -> None:
    pool = LosingPool(1, SerialExecutor(), (), Counter())
    with pytest.warns(KgcpWarning, match="has ended or taken too long"):
        assert _camera_of(pool, cast("PhotoTask", None), ()) is None
