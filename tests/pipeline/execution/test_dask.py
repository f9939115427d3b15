"""Dask's workers instead of a pool: the same bytes, whatever dies."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

pytest.importorskip("distributed", reason="Dask is not installed: pip install kgcp[dask]")

from click.testing import CliRunner
from distributed import KilledWorker, LocalCluster
from distributed.scheduler import WorkerState

from benchmarks.reliability.torture import make_flight
from kgcp.cli import main
from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.detect import NoProgress, RunOptions, detect_flight
from kgcp.pipeline.execution.dask_client import connected
from kgcp.pipeline.execution.dask_worker import _processes
from kgcp.pipeline.execution.resilient_map import Lost, TaskFailure, resilient_map
from tests.systems import kill

FRAMES = 8
ANY_PORT = "127.0.0.1:0"


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    """Two workers, each a process with a nanny."""
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=ANY_PORT,
        silence_logs=logging.CRITICAL,
    ) as own:
        yield own


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cluster") / "flight"
    make_flight(folder, FRAMES, 1)
    return folder


@pytest.fixture(scope="module")
def expected(flight: Path) -> bytes:
    """The table of a run in this process."""
    return detect(flight, "here", RunOptions(jobs=0))


def detect(
    flight: Path, out: str, options: RunOptions, listener: NoProgress | None = None
) -> bytes:
    folder = flight.parent / out
    detect_flight(read_flight(flight), out=folder, options=options, listener=listener)
    return (folder / "detections.parquet").read_bytes()


class Killer(NoProgress):
    """Kills a worker of a cluster when so much is done."""

    def __init__(self, cluster: LocalCluster, done: int) -> None:
        self.cluster, self.done = cluster, done
        self.killed: int | None = None

    def progress(self, stage: str, done: int, total: int, found: int) -> None:  # noqa: ARG002 - the base class's signature
        if self.killed is None and done >= self.done:
            self.killed = self.cluster.workers[0].pid
            kill(self.killed)


def test_a_cluster_on_this_machine_gives_the_same_bytes(flight: Path, expected: bytes) -> None:
    command = ["detect", str(flight), "--scheduler", "local:1", "--out", str(flight.parent / "own")]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0, done.output
    assert (flight.parent / "own" / "detections.parquet").read_bytes() == expected


def test_what_kills_its_process_or_hangs_costs_no_worker_and_no_other() -> None:
    deadly = "__import__('os').kill(__import__('os').getpid(), 9)"
    slow = "__import__('time').sleep(60)"
    items = ["1 + 1", deadly, "2 + 2", slow, "3 + 3", "4 + 4"]
    with connected("local:2", 0.5, ()) as workers:
        assert workers.jobs == 2
        results = dict(resilient_map(eval, items, workers, 2))
        assert workers.jobs == 2
        assert _processes
    assert not _processes, "no process is left of the run"
    assert results == {
        **{item: eval(item) for item in items if item[0].isdigit()},  # noqa: S307 - these are ours
        deadly: TaskFailure.CRASHED,
        slow: TaskFailure.TIMED_OUT,
    }


def test_a_cluster_that_loses_a_worker_gives_the_bytes_of_this_process(
    flight: Path, expected: bytes, cluster: LocalCluster
) -> None:
    killer = Killer(cluster, 3)
    options = RunOptions(scheduler=cluster.scheduler_address)
    assert detect(flight, "dask", options, killer) == expected
    assert killer.killed is not None
    assert (flight.parent / "dask" / "run.json").exists()


def test_what_dask_gives_up_is_tried_again_or_ends_in_one_line() -> None:
    with connected("local:1", 60.0, ()) as workers:
        for error, kind in (
            (
                KilledWorker("key", cast("WorkerState", SimpleNamespace(address="tcp://one")), 3),
                Lost,
            ),
            (ModuleNotFoundError("kgcp"), KgcpError),
            (LookupError("of the call itself"), LookupError),
            (None, KgcpError),  # cancelled, by a client that has lost its scheduler
        ):
            inner: Future[object] = Future()
            if error is None:
                inner.cancel()
            else:
                inner.set_exception(error)
            future: Future[object] = Future()
            workers._waiting.add(future)
            workers._hand_over(future, inner)
            assert isinstance(future.exception(timeout=0.0), kind)


def test_workers_must_be_as_the_run_needs_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = tmp_path / "frames"
    with (
        pytest.raises(KgcpError, match=r"frames: is not seen by the worker .*; mount it there"),
        connected("local:1", 60.0, (nowhere,)),
    ):
        pass
    monkeypatch.setattr("kgcp.pipeline.execution.dask_client.versions", lambda: {"kgcp": "0.0.1"})
    with (
        pytest.raises(KgcpError, match=r"has kgcp .*, not 0\.0\.1, and might give other results"),
        connected("local:1", 60.0, ()),
    ):
        pass


def test_a_scheduler_that_is_of_no_use_is_a_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kgcp.pipeline.execution.dask_client._CONNECT_S", 0.5)
    monkeypatch.setattr("kgcp.pipeline.execution.dask_client._WORKERS_S", 0.4)
    monkeypatch.setattr("kgcp.pipeline.execution.dask_client._WATCH_S", 0.2)
    for scheduler, problem in (
        ("local:0", "is not an address; give one like"),
        ("tcp://127.0.0.1:9", "cannot be reached"),
        ("carrier://pigeon:1", "cannot be reached"),
    ):
        with pytest.raises(KgcpError, match=problem), connected(scheduler, 60.0, ()):
            pass
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address=ANY_PORT) as empty,
        pytest.raises(KgcpError, match=r"has had no workers for 0 s; once it has workers"),
        connected(empty.scheduler_address, 60.0, ()),
    ):
        pass
    with suppress(KeyError):
        monkeypatch.delitem(sys.modules, "distributed")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(KgcpError, match=r"needs Dask .*pip install 'kgcp\[dask\]'"):
        connected("local:1", 60.0, ()).__enter__()


def test_no_jobs_and_a_scheduler_contradict_each_other(tmp_path: Path) -> None:
    command = ["detect", str(tmp_path), "--scheduler", "local:2", "--jobs", "0"]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 2
    assert "give one" in done.output
