"""What a journal keeps, finds again, and does not believe."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kgcp.errors import KgcpError, Reason
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import (
    Alternative,
    Appearance,
    CommonUncertainty,
    Considered,
    ExposureSettings,
    FrameResult,
    Miss,
    Observation,
    Uncertainty,
)
from kgcp.pipeline.execution.journal import Journal, fingerprint, from_text, to_text

NO_RESULTS = (
    *("", "\0", "[]", "{}", "[" * 100_000),
    *('{"record":"Path"}', '{"record":[]}', '{"record":"ExposureSettings","x":1}'),
    *('{"record":"Miss","reason":"no such"}', '{"array":[[1],[1,2]]}'),
)

numbers = st.floats(width=64)
maybe = st.none() | numbers


def arrays(*shape: int) -> st.SearchStrategy[np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    count = int(np.prod(shape))
    return st.lists(numbers, min_size=count, max_size=count).map(
        lambda values: np.array(values).reshape(shape)
    )


poses = st.builds(Pose, arrays(3, 3), arrays(3))
observations = st.builds(
    Observation,
    target=st.text(),
    ring=st.text(),
    instance=st.integers(0, 9),
    score=numbers.map(np.float64),
    pose=poses,
    centre_px=arrays(2),
    heading_deg=numbers,
    appearance=st.builds(Appearance, numbers, numbers, numbers, numbers, maybe, maybe),
    alternative=st.none() | st.builds(Alternative, poses, numbers),
    uncertainty=st.none()
    | st.builds(Uncertainty, arrays(6, 6), arrays(2, 2), numbers, numbers, numbers, numbers),
    common=st.none() | st.builds(CommonUncertainty, arrays(6, 6), numbers, numbers),
    is_guided=st.booleans(),
)
misses = st.builds(Miss, st.text(), st.sampled_from(Reason), st.text(), maybe, st.integers(0, 99))
candidates = st.builds(
    Considered,
    *(st.text(), st.text(), st.builds(Ellipse, *[numbers] * 5), numbers),
    st.booleans(),
    st.sampled_from(Reason),
    st.text(),
)
results = st.builds(
    FrameResult,
    st.text(),
    maybe,
    st.builds(ExposureSettings, maybe, maybe, maybe),
    st.lists(observations | misses, min_size=1, max_size=3).map(tuple),
    maybe,
    st.lists(candidates, max_size=2).map(tuple),
)


def bits(value: object) -> object:
    """Whatever makes a difference, down to the sign of a zero and the type."""
    if is_dataclass(value):
        return (type(value), *(bits(getattr(value, field.name)) for field in fields(value)))
    if isinstance(value, np.ndarray):
        return (value.shape, str(value.dtype), np.where(np.isnan(value), np.nan, value).tobytes())
    if isinstance(value, float):
        return float(value).hex()
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    return (type(value), value)


def result(frame: str) -> FrameResult:
    return FrameResult(frame, 0.1, ExposureSettings(), (Miss("A", Reason.CUT, "ü\n"),))


def open_journal(folder: Path, *, is_new: bool = False, camera: str = "b") -> Journal:
    making = {"the settings": "a", "the camera": camera}
    return Journal(folder / "journal", making, is_new=is_new)


@settings(max_examples=40, deadline=None)
@given(results)
def test_a_result_comes_back_to_the_last_bit(one: FrameResult) -> None:
    text = to_text(one)
    assert "\n" not in text
    assert bits(from_text(text)) == bits(one)


@pytest.mark.parametrize("text", NO_RESULTS, ids=lambda text: text[:30])
def test_what_is_no_result_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        from_text(text)


def test_a_fingerprint_tells_values_apart() -> None:
    marks = [
        fingerprint(1.0, 2.0),
        fingerprint(1.0, np.array([2.0])),
        fingerprint(np.nextafter(1, 2)),
    ]
    assert len({*marks, fingerprint(1.0), fingerprint("1.0"), fingerprint(result("a"))}) == 6
    assert fingerprint(1.0, 2.0) == marks[0]


def test_results_are_found_by_those_who_come_later(tmp_path: Path) -> None:
    for start in (0, 100, 200):
        with open_journal(tmp_path) as journal:
            assert len(list(journal)) == start
            for number in range(start, start + 100):
                journal.add(f"key-{number}", result(str(number)))
            assert journal.read(f"key-{start}").frame == str(start)
            assert journal.read(f"key-{start + 99}").frame == str(start + 99)
    journal = open_journal(tmp_path)
    assert [journal.read(key).frame for key in journal] == [str(number) for number in range(300)]
    assert "key-300" not in journal
    journal.remove()
    assert not list(tmp_path.iterdir())


def test_only_what_was_made_alike_is_kept(tmp_path: Path) -> None:
    with open_journal(tmp_path) as journal:
        journal.add("key", result("a"))
    with open_journal(tmp_path, camera="c") as journal:
        assert journal.changes == ("the camera",)
        assert "key" not in journal
        journal.add("key", result("b"))
    with open_journal(tmp_path, camera="c") as journal:
        assert journal.changes == ()
        assert journal.read("key").frame == "b"
    with open_journal(tmp_path, is_new=True) as journal:
        assert journal.changes == ()
        assert not list(journal)


@pytest.mark.parametrize(
    "damage", [lambda line: line[:-20], lambda line: line.replace(b"cut", b"cat"), lambda _: b"\0"]
)
def test_damaged_lines_count_as_not_done(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    with open_journal(tmp_path) as journal:
        for number in range(3):
            journal.add(f"key-{number}", result(str(number)))
    (part,) = (tmp_path / "journal").glob("part-*")
    lines = part.read_bytes().splitlines(keepends=True)
    part.write_bytes(b"".join((lines[0], damage(lines[1]), b"\n", lines[2])))
    journal = open_journal(tmp_path)
    assert list(journal) == ["key-0", "key-2"]
    assert journal.read("key-2").frame == "2"


def test_a_full_disk_is_a_line_and_the_journal_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = open_journal(tmp_path)
    journal.add("key-0", result("0"))
    journal.flush()
    journal.add("key-1", result("1"))

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(KgcpError, match=r"journal: No space left on device; when that is put"):
            journal.flush()
    assert list(open_journal(tmp_path)) == ["key-0"]
    assert not list((tmp_path / "journal").glob(".*"))
    journal.flush()
    assert list(open_journal(tmp_path)) == ["key-0", "key-1"]


def test_a_vanished_folder_is_a_line_and_is_not_made_again(tmp_path: Path) -> None:
    journal = open_journal(tmp_path)
    journal.add("key", result("a"))
    (tmp_path / "journal").rename(tmp_path / "elsewhere")
    with pytest.raises(KgcpError, match=r"journal: No such file or directory; when that"):
        journal.flush()
    assert [path.name for path in tmp_path.iterdir()] == ["elsewhere"]
    (tmp_path / "elsewhere").rename(tmp_path / "journal")
    journal.flush()
    assert list(open_journal(tmp_path)) == ["key"]


def test_a_link_is_no_journal(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "journal").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(KgcpError, match=r"is a link; delete it"):
        open_journal(tmp_path)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_writing_takes_little_of_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that says that every call to the disk takes 50 ms, and a result 20 ms."""
    now_s = 0.0

    def slow_disk(_: int) -> None:
        nonlocal now_s
        now_s += 0.05

    monkeypatch.setattr("kgcp.pipeline.execution.journal.time.monotonic", lambda: now_s)
    monkeypatch.setattr(os, "fsync", slow_disk)
    with open_journal(tmp_path) as journal:
        for number in range(2000):
            now_s += 0.02
            journal.add(str(number), result(str(number)))
    assert 0.0 < journal.seconds < 0.015 * now_s
