"""Calls from several threads share the number of threads of the numeric libraries."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import cv2
import pytest
import scipy.linalg  # noqa: F401 - brings a BLAS of its own
from threadpoolctl import threadpool_info, threadpool_limits

from kgcp.pipeline.execution.threads import single_threaded


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    with threadpool_limits(2):
        yield
    cv2.setNumThreads(before)


def threads() -> set[int]:
    """Return the numbers of threads of all numeric libraries."""
    return {cv2.getNumThreads(), *(library["num_threads"] for library in threadpool_info())}


@pytest.mark.usefixtures("two_threads")
def test_the_last_of_calls_that_overlap_restores_the_threads() -> None:
    before = threads()
    assert 2 in before
    first, second = ExitStack(), ExitStack()
    first.enter_context(single_threaded())
    second.enter_context(single_threaded())
    assert threads() == {1}
    first.close()
    assert threads() == {1}, "the other call is still at work"
    second.close()
    assert threads() == before
