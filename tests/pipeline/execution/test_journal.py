"""What a journal keeps, finds again, and does not believe."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from zlib import crc32

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
    Imaging,
    Measurement,
    Miss,
    RivalTone,
    ToneBase,
    Uncertainty,
)
from kgcp.pipeline.execution.journal import Journal, fingerprint, from_text, results_in, to_text
from tests.systems import needs_links, not_on_windows

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
    Measurement,
    target=st.text(),
    ring=st.text(),
    instance=st.integers(0, 9),
    score=numbers.map(np.float64),
    pose=poses,
    centre_px=arrays(2),
    heading_deg=numbers,
    appearance=st.builds(Appearance, numbers, numbers, numbers, numbers, maybe, maybe),
    alternative=st.none() | st.builds(Alternative, poses, numbers, st.none() | arrays(6, 6)),
    uncertainty=st.none()
    | st.builds(Uncertainty, arrays(6, 6), arrays(2, 2), numbers, numbers, numbers, numbers),
    common=st.none() | st.builds(CommonUncertainty, arrays(6, 6), numbers, numbers),
    is_guided=st.booleans(),
    imaging=st.none()
    | st.builds(
        Imaging,
        base=st.sampled_from(ToneBase),
        black=numbers,
        white=numbers,
        tone=st.tuples(numbers, numbers, numbers),
        sharpening=numbers,
        noise_black=numbers,
        noise_white=numbers,
    ),
)
with_rivals = st.builds(
    lambda seen, other, advantage: replace(seen, rival=RivalTone(other, advantage)),
    observations,
    observations,
    numbers,
)
misses = st.builds(Miss, st.text(), st.sampled_from(Reason), st.text(), maybe, st.integers(0, 99))
candidates = st.builds(
    Considered,
    target=st.text(),
    ring=st.text(),
    outline=st.builds(Ellipse, *[numbers] * 5),
    score=numbers,
    is_match=st.booleans(),
    reason=st.sampled_from(Reason),
    detail=st.text(),
)
results = st.builds(
    FrameResult,
    st.text(),
    maybe,
    st.builds(ExposureSettings, maybe, maybe, maybe),
    st.lists(observations | with_rivals | misses, min_size=1, max_size=3).map(tuple),
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


def open_journal(folder: Path, *, is_new: bool = False, camera: str = "b") -> Journal[FrameResult]:
    making = {"the settings": "a", "the camera": camera}
    return Journal(folder / "journal", making, (FrameResult,), is_new=is_new)


def fill(folder: Path, count: int) -> None:
    with open_journal(folder) as journal:
        for number in range(count):
            journal.add(f"key-{number}", result(str(number)))


def keys(folder: Path) -> list[str]:
    with open_journal(folder) as journal:
        return sorted(journal)


@settings(max_examples=40, deadline=None)
@given(results)
def test_a_result_comes_back_to_the_last_bit(one: FrameResult) -> None:
    text = to_text(one)
    assert "\n" not in text
    assert bits(from_text(text, (FrameResult,))) == bits(one)


@pytest.mark.parametrize("text", NO_RESULTS, ids=lambda text: text[:30])
def test_what_is_no_result_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        from_text(text, (FrameResult,))


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
                journal.add(f"key-{number:03d}", result(str(number)))
            assert journal.read(f"key-{start:03d}").frame == str(start)
            assert journal.read(f"key-{start + 99:03d}").frame == str(start + 99)
    with open_journal(tmp_path) as journal:
        frames = [journal.read(key).frame for key in sorted(journal)]
        assert frames == [str(number) for number in range(300)]
        assert journal.get("key-300") is None
        journal.remove()
    assert not list(tmp_path.iterdir())


def test_results_that_were_made_with_something_else_are_not_lost(tmp_path: Path) -> None:
    fill(tmp_path, 1)
    text = r"1 result of an interrupted run; changed since: the camera \(was .\); undo this"
    with pytest.raises(KgcpError, match=text):
        open_journal(tmp_path, camera="c")
    with open_journal(tmp_path) as journal:
        assert journal.read("key-0").frame == "0"
    with open_journal(tmp_path, is_new=True, camera="c") as journal:
        assert not list(journal)
    fill(tmp_path, 1)  # nothing would be lost


def run(program: str, folder: Path) -> subprocess.Popen[str]:
    """Start a program that finds a journal open, in another process."""
    lines = (
        "import os, sys",
        "from pathlib import Path",
        "from kgcp.errors import Reason",
        "from kgcp.measurement.records import ExposureSettings, FrameResult, Miss",
        "from kgcp.pipeline.execution.journal import Journal",
        "making = {'the settings': 'a', 'the camera': 'b'}",
        "journal = Journal(Path(sys.argv[1]), making, (FrameResult,), is_new=False)",
    )
    return subprocess.Popen(
        [sys.executable, "-c", "\n".join((*lines, program)), str(folder / "journal")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def test_one_process_at_a_time_has_it(tmp_path: Path) -> None:
    with run("print('open', flush=True); sys.stdin.read()", tmp_path) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with pytest.raises(KgcpError, match=r"another kgcp is writing here; wait") as caught:
            open_journal(tmp_path)
        assert caught.value.on_command_line().endswith("choose another results folder (--out)")
        other.kill()
    assert keys(tmp_path) == [], "its lock ended with the process"


def test_results_outlive_a_kill(tmp_path: Path) -> None:
    program = (
        "for number in range(5000):\n"
        "    outcomes = (Miss('A', Reason.CUT, 'x' * 500),)\n"
        "    result = FrameResult(str(number), 0.1, ExposureSettings(), outcomes)\n"
        "    journal.add(f'key-{number}', result)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    with run(program, tmp_path) as other:
        other.wait()
    assert len(keys(tmp_path)) == 5000


@pytest.mark.parametrize(
    "damage",
    [
        lambda line: line[:-20] + b"\n",
        lambda line: line.replace(b"cut", b"cat"),
        lambda line: line.replace(b"0.1", b"0.2"),
        lambda _: b"\0\n",
        lambda line: (body := line[9:].replace(b"cut", b"cat")) and b"%08x " % crc32(body) + body,
    ],
)
def test_damaged_lines_count_as_not_done(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    fill(tmp_path, 3)
    lines = (tmp_path / "journal").read_bytes().splitlines(keepends=True)
    lines[2] = damage(lines[2])
    (tmp_path / "journal").write_bytes(b"".join(lines))
    with open_journal(tmp_path) as journal:
        assert journal.get("key-1") is None
        assert journal.read("key-2").frame == "2"
    (tmp_path / "journal").write_bytes(b"".join(lines[1:]))
    assert keys(tmp_path) == [], "nothing says what made it"


def test_a_line_that_was_cut_spoils_no_other(tmp_path: Path) -> None:
    fill(tmp_path, 2)
    data = (tmp_path / "journal").read_bytes()
    (tmp_path / "journal").write_bytes(data[:-20])
    with open_journal(tmp_path) as journal:
        assert list(journal) == ["key-0"]
        journal.add("key-2", result("2"))
    assert keys(tmp_path) == ["key-0", "key-2"]


@pytest.mark.parametrize("key", ["made-by", "never"])
def test_a_result_that_cannot_be_read_again_is_an_error(key: str, tmp_path: Path) -> None:
    text = r"journal: is damaged; start over"
    with open_journal(tmp_path) as journal, pytest.raises(KgcpError, match=text) as caught:
        journal.read(key)
    assert caught.value.on_command_line().endswith(" (--restart)")


@not_on_windows("limits no sizes of files")
def test_a_full_disk_is_a_one_line_error_and_the_journal_stays(tmp_path: Path) -> None:
    program = (
        "import resource, signal\n"
        "from kgcp.errors import KgcpError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (700, 700))\n"
        "try:\n"
        "    with journal:\n"
        "        for number in range(9):\n"
        "            miss = Miss('A', Reason.CUT, 'x' * 50)\n"
        "            result = FrameResult(str(number), 0.1, ExposureSettings(), (miss,))\n"
        "            journal.add(f'key-{number}', result)\n"
        "except KgcpError as error:\n"
        "    print(error)\n"
    )
    with run(program, tmp_path) as other:
        told, _ = other.communicate()
    assert "journal: No space left on device; fix this" in told
    assert keys(tmp_path) == ["key-0"]


def test_what_is_in_the_way_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(KgcpError, match=r"cannot be written .*; choose another results folder"):
        open_journal(tmp_path / "file")


@needs_links
def test_a_link_in_the_way_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "precious").write_bytes(b"mine")
    (tmp_path / "journal").symlink_to(tmp_path / "precious")
    with pytest.raises(KgcpError, match=r"journal: cannot be written \(is a link; delete it\)"):
        open_journal(tmp_path)
    assert (tmp_path / "precious").read_bytes() == b"mine"


@not_on_windows("has no pipes in folders")
def test_a_pipe_in_the_way_is_a_one_line_error(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "journal")
    with pytest.raises(KgcpError, match=r"journal: cannot be written \(is not a file; delete it\)"):
        open_journal(tmp_path)


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


@pytest.mark.skipif(os.name == "nt", reason="Windows does not delete open files")
def test_a_journal_that_was_deleted_ends_without_that_of_another_run(tmp_path: Path) -> None:
    with open_journal(tmp_path) as journal:
        (tmp_path / "journal").unlink()
        journal.remove()
        with open_journal(tmp_path) as other:
            journal.remove()
            assert (tmp_path / "journal").exists()
            other.remove()
    assert not (tmp_path / "journal").exists()


def test_results_can_be_counted_without_the_journal(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    assert results_in(path) == set()
    with open_journal(tmp_path) as journal:
        journal.add("key-0", FrameResult("0", 0.1, ExposureSettings(), ()))
        assert results_in(path) == set(), "its run goes on"
    path.write_bytes(path.read_bytes() + b"broken")
    assert results_in(path) == {"key-0"}
    assert path.read_bytes().endswith(b"broken"), "it is only read"
