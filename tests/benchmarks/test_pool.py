"""Order, processes and failures of the pool."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path

import pytest

from benchmarks.pool import ordered_map

ITEMS = tuple(range(11))

_offset: int | None = None


def begin(offset: int, folder: Path) -> None:
    """Leave one line per call in a file named after the process."""
    global _offset  # noqa: PLW0603 - what a start leaves behind is what is tested
    _offset = offset
    with (folder / str(os.getpid())).open("a", encoding="utf-8") as stream:
        stream.write("started\n")


def shifted(item: int) -> int:
    assert _offset is not None
    return item * item + _offset


def shifted_but_seven(item: int) -> int:
    if item == 7:
        raise LookupError("seven")
    return shifted(item)


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_order_and_every_process_starts_once(jobs: int, tmp_path: Path) -> None:
    results = ordered_map(
        shifted, ITEMS, jobs=jobs, start=begin, start_arguments=(100, tmp_path), items_per_task=2
    )
    assert list(results) == [item * item + 100 for item in ITEMS]
    starts = {int(path.name): path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    assert set(starts.values()) == {"started\n"}
    assert 1 <= len(starts) <= jobs
    assert (os.getpid() in starts) is (jobs == 1)


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_an_item_raises_arrives_after_the_results_before_it(jobs: int, tmp_path: Path) -> None:
    results = ordered_map(
        shifted_but_seven, ITEMS, jobs=jobs, start=begin, start_arguments=(0, tmp_path)
    )
    assert list(islice(results, 7)) == [item * item for item in range(7)]
    with pytest.raises(LookupError, match="seven"):
        next(results)


def test_no_items_no_results(tmp_path: Path) -> None:
    none = ordered_map(shifted, (), jobs=3, start=begin, start_arguments=(0, tmp_path))
    assert list(none) == []


def test_one_item_needs_no_pool(tmp_path: Path) -> None:
    one = ordered_map(shifted, (4,), jobs=3, start=begin, start_arguments=(1, tmp_path))
    assert list(one) == [17]
    assert [path.name for path in tmp_path.iterdir()] == [str(os.getpid())]
