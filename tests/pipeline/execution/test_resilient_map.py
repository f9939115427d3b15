"""What dies, hangs or raises among the items of a pool, and what becomes of the others."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import closing
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import pytest

from kgcp.errors import KgcpError, SettingError
from kgcp.pipeline.execution.local_processes import (
    Preparation,
    SupervisedProcessPool,
    WorkerProcess,
    _serve,
)
from kgcp.pipeline.execution.resilient_map import (
    SerialExecutor,
    TaskFailure,
    resilient_map,
    usable_cores,
)
from tests.systems import kill, not_on_windows

DEADLY, UNLUCKY, SLOW = 3, 5, 7
LIMIT_S = 1.5


def work(folder: Path, item: int) -> int:
    """Square a number; of some, the process dies, always or once, or hangs."""
    if item == DEADLY:
        kill(os.getpid())
    if item == UNLUCKY and not (folder / "died").exists():
        (folder / "died").touch()
        kill(os.getpid())
    if item == SLOW:
        time.sleep(60.0)
    return item * item


def wait_forever(folder: Path, item: int) -> int:
    (folder / f"{os.getpid()}.{item}").touch()
    time.sleep(300.0)
    return item


def fail(item: int) -> int:
    raise LookupError(str(item))


def fail_by_setting(_: int) -> int:
    raise SettingError("fx", "is 0", "give more")


class OddError(Exception):
    """An error that pickle cannot make again."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(f"{one} and {two}")


def fail_oddly(_: int) -> int:
    raise OddError("this", "that")


def run_out_of_memory(folder: Path, item: int) -> int:
    if item == DEADLY or not (folder / str(item)).exists():
        (folder / str(item)).touch()
        raise MemoryError
    return item


def pid_and(*values: object) -> tuple[int, tuple[object, ...]]:
    return os.getpid(), values


def end_process(_: object) -> None:
    os._exit(1)


def is_prepared(path: Path) -> bool:
    return path.exists() and path.read_text(encoding="utf-8").endswith("ready ")


def prepare(path: Path) -> None:
    """Write down begin and end of a long preparation, unless another process is through with it."""
    if not is_prepared(path):
        with path.open("a", encoding="utf-8") as file:
            file.write("begin ")
        time.sleep(0.2)
        with path.open("a", encoding="utf-8") as file:
            file.write("ready ")


def pool(jobs: int, limit_s: float = LIMIT_S) -> Executor:
    return SupervisedProcessPool(jobs, limit_s) if jobs else SerialExecutor()


def test_what_kills_its_process_is_lost_and_nothing_else(tmp_path: Path) -> None:
    with pool(2) as executor:
        results = dict(resilient_map(partial(work, tmp_path), range(9), executor, 2))
    lost = {DEADLY: TaskFailure.CRASHED, SLOW: TaskFailure.TIMED_OUT}
    assert results == {item: lost.get(item, item * item) for item in range(9)}
    assert (tmp_path / "died").exists(), "died once, and was tried again"


def test_what_lacks_memory_is_tried_again_in_another_process(tmp_path: Path) -> None:
    with pool(2) as executor:
        items = (DEADLY, UNLUCKY)
        results = dict(resilient_map(partial(run_out_of_memory, tmp_path), items, executor, 2))
    assert results == {DEADLY: TaskFailure.CRASHED, UNLUCKY: UNLUCKY}


def test_few_items_are_taken_before_their_time() -> None:
    taken = 0

    def numbers() -> Iterator[int]:
        nonlocal taken
        for taken in count(1):  # noqa: UP028 - it is to be seen
            yield taken

    for jobs, ahead in ((0, 1), (2, 5)):
        taken = 0
        with (
            pool(jobs) as executor,
            closing(resilient_map(abs, numbers(), executor, jobs)) as results,
        ):
            for done, _ in enumerate(islice(results, 30), start=1):
                assert taken <= done + ahead


def test_what_an_item_raises_arrives() -> None:
    for jobs in (0, 1):
        with pool(jobs) as executor, pytest.raises(LookupError, match="4"):
            list(resilient_map(fail, (4,), executor, jobs))
    with (
        pool(1) as executor,
        pytest.raises(SettingError, match=r"^fx: is 0; give more"),
    ):
        list(resilient_map(fail_by_setting, (4,), executor, 1))
    with (
        pool(1) as executor,
        pytest.raises(RuntimeError, match="OddError: this and that"),
    ):
        list(resilient_map(fail_oddly, (4,), executor, 1))


def test_one_pool_serves_several_maps(tmp_path: Path) -> None:
    with pool(1) as executor:
        (first,) = resilient_map(partial(pid_and, tmp_path), (1,), executor, 1)
        (second,) = resilient_map(pid_and, (2,), executor, 1)
        with pytest.raises(LookupError):
            list(resilient_map(fail, (4,), executor, 1))
        (third,) = resilient_map(pid_and, (2,), executor, 1)
    assert first[1] == (second[1][0], (tmp_path, 1))  # type: ignore[index] # nothing was lost
    assert second == third


def test_one_process_prepares_what_all_of_them_need(tmp_path: Path) -> None:
    path = tmp_path / "steps"
    preparation = Preparation(partial(is_prepared, path), partial(prepare, path))
    with SupervisedProcessPool(2, LIMIT_S, preparation) as executor:
        assert dict(resilient_map(abs, range(6), executor, 2)) == {i: i for i in range(6)}
    assert path.read_text(encoding="utf-8") == "begin ready "


def meet(folder: Path, own: str, other: str) -> None:
    """Wait until another process does the other part, which proves that neither waits."""
    with (folder / own).open("a", encoding="utf-8") as file:
        file.write("begun ")
    deadline = time.monotonic() + 20.0
    while not (folder / other).exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    (folder / f"{own} ended").touch()


def both_ended(folder: Path) -> bool:
    return (folder / "a ended").exists() and (folder / "b ended").exists()


def test_processes_prepare_parts_at_the_same_time_and_each_once(tmp_path: Path) -> None:
    parts = (partial(meet, tmp_path, "a", "b"), partial(meet, tmp_path, "b", "a"))
    preparation = Preparation(partial(both_ended, tmp_path), refuse, parts)
    with SupervisedProcessPool(3, LIMIT_S, preparation) as executor:
        assert dict(resilient_map(abs, range(6), executor, 3)) == {i: i for i in range(6)}
    for name in ("a", "b"):
        assert (tmp_path / name).read_text(encoding="utf-8") == "begun "


def test_a_part_whose_process_ends_is_left_to_the_slow_way(tmp_path: Path) -> None:
    path = tmp_path / "steps"
    preparation = Preparation(partial(is_prepared, path), partial(prepare, path), (end,))
    with SupervisedProcessPool(2, LIMIT_S, preparation) as executor:
        assert dict(resilient_map(abs, range(6), executor, 2)) == {i: i for i in range(6)}
    assert path.read_text(encoding="utf-8") == "begin ready "


def refuse() -> bool:
    raise LookupError("no folder")


def end() -> bool:
    os._exit(3)


def test_a_preparation_that_fails_says_why_and_leaves_no_process() -> None:
    preparation = Preparation(refuse, refuse)
    worker = WorkerProcess(LIMIT_S, preparation)
    for _ in range(2):
        with pytest.raises(LookupError, match="no folder"):
            worker.call(abs, 1)
    assert not multiprocessing.active_children()


def test_a_process_that_ends_while_it_prepares_is_no_item_s_fault() -> None:
    preparation = Preparation(end, refuse)
    with pytest.raises(KgcpError, match="end as soon as they start"):
        WorkerProcess(LIMIT_S, preparation).call(abs, 1)


@pytest.mark.usefixtures("sigint_raises")
def test_a_signal_waits_for_the_end_of_a_call_in_this_process() -> None:
    steps: list[str] = []

    def stop(item: int) -> None:
        signal.raise_signal(signal.SIGINT)
        steps.append(f"{item} ended")

    with pytest.raises(KeyboardInterrupt):
        list(resilient_map(stop, (1, 2), SerialExecutor(), 0))
    assert steps == ["1 ended"]


def test_processes_that_cannot_start_are_a_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kgcp.pipeline.execution.local_processes._serve", end_process)
    text = "end as soon as they start; free memory"
    with pool(1) as executor, pytest.raises(KgcpError, match=text) as caught:
        list(resilient_map(abs, (1, 2), executor, 1))
    assert caught.value.on_command_line().endswith(" (--jobs 0)")


@not_on_windows("has no limit of open files")
def test_a_limit_of_open_files_is_a_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    import resource

    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: (100, 200))
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: asked.append(limits))
    SupervisedProcessPool(20, LIMIT_S).shutdown()
    assert asked == [(144, 200)]

    def refuse(*_: object) -> None:
        raise ValueError("current limit exceeds maximum limit")

    monkeypatch.setattr(resource, "setrlimit", refuse)
    with pytest.raises(KgcpError, match=r"80 worker processes need more open files .* \(100\)"):
        SupervisedProcessPool(80, LIMIT_S)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a server of processes")
def test_a_server_that_cannot_start_is_a_one_line_error(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 25)  # longer than the address of a socket may be
    folder.mkdir()
    started = subprocess.run(
        [sys.executable, "-m", "kgcp", "detect", str(tmp_path), "--jobs", "1"],
        env={**os.environ, "TMPDIR": str(folder)},
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert started.returncode == 1
    (line,) = started.stderr.splitlines()
    assert line.startswith("kgcp: error: worker processes cannot be started (AF_UNIX path too long")
    assert line.endswith("or work without them (--jobs 0)")


def test_a_map_that_is_closed_early_does_not_wait(tmp_path: Path) -> None:
    start_s = time.monotonic()

    def stop() -> Iterator[int]:
        yield 0
        while not list(tmp_path.iterdir()):
            time.sleep(0.05)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), pool(1, 300.0) as executor:
        list(resilient_map(partial(wait_forever, tmp_path), stop(), executor, 1))
    assert time.monotonic() - start_s < 60.0
    wait_until_gone(workers_in(tmp_path))


@pytest.mark.parametrize("pause_s", [0.0, 0.05, 0.2])
def test_a_pool_that_is_closed_while_its_processes_start_does_not_wait(pause_s: float) -> None:
    """On Windows, the parent has both ends of a pipe until the process takes one of them."""
    start_s = time.monotonic()
    with pool(2) as executor:
        executor.submit(abs, 1)
        time.sleep(pause_s)
    assert time.monotonic() - start_s < 30.0


class SlowExecutor(Executor):
    """Ends a call long after an interrupt should have been heard."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401, ARG002 - the base class's
        future: Future[Any] = Future()
        end = threading.Timer(3.0 * LIMIT_S, future.set_result, [None])
        end.daemon = True
        end.start()
        return future


@not_on_windows("sends no signals to threads")
@pytest.mark.usefixtures("sigint_raises")
def test_an_interrupt_is_heard_soon_where_it_does_not_end_a_wait() -> None:
    """As on Windows before Python 3.13, and here if another thread gets the signal."""

    def interrupt() -> None:
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)

    start_s = time.monotonic()
    threading.Timer(0.1, interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        list(resilient_map(abs, (1,), SlowExecutor(), 1))
    assert time.monotonic() - start_s < LIMIT_S


def workers_in(folder: Path) -> list[int]:
    return [int(path.name.partition(".")[0]) for path in folder.iterdir()]


def wait_until_gone(pids: list[int]) -> None:
    assert pids
    until = time.monotonic() + 30.0
    while any(Path(f"/proc/{pid}/cmdline").exists() and is_alive(pid) for pid in pids):
        assert time.monotonic() < until, "a worker has outlived its parent"
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes() != b""  # that of a zombie is empty
    except OSError:
        return False


def test_no_worker_outlives_a_parent_that_is_killed(tmp_path: Path) -> None:
    program = (
        "from functools import partial; from pathlib import Path; import sys\n"
        "sys.path.insert(0, sys.argv[2])\n"
        "from test_resilient_map import pool, wait_forever\n"
        "from kgcp.pipeline.execution.resilient_map import resilient_map\n"
        "if __name__ == '__main__':\n"
        "    work = partial(wait_forever, Path(sys.argv[1]))\n"
        "    with pool(2, 300.0) as executor:\n"
        "        list(resilient_map(work, (1, 2), executor, 2))\n"
    )
    script, marks = tmp_path / "parent.py", tmp_path / "marks"
    marks.mkdir()
    script.write_text(program, encoding="utf-8")
    command = [sys.executable, str(script), str(marks), str(Path(__file__).parent)]
    with subprocess.Popen(command) as parent:
        while len(list(marks.iterdir())) < 2:
            assert parent.poll() is None
            time.sleep(0.05)
        parent.kill()
    wait_until_gone(workers_in(marks))


def test_there_is_a_core_to_use() -> None:
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


@pytest.mark.parametrize("error", [EOFError, ConnectionResetError, BrokenPipeError])
def test_a_worker_whose_parent_is_gone_ends_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    """A parent that is killed with results unread resets the pipe."""

    class ClosedPipe:
        is_ready = is_read = False

        def send(self, _: object) -> None:
            self.is_ready = True

        def recv_bytes(self) -> bytes:
            self.is_read = True
            raise error

    monkeypatch.setattr(signal, "signal", lambda *_: None)  # this process can be interrupted
    pipe = ClosedPipe()
    _serve(pipe)
    assert pipe.is_ready
    assert pipe.is_read
