"""Frames from Google's object store and results into it, with a local emulator of its protocol."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("gcp_storage_emulator", reason="pip install gcp-storage-emulator")

from click.testing import CliRunner
from pyarrow.fs import FileSelector, FileSystem

from benchmarks.reliability.torture import make_flight
from kgcp.cli import main
from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.detect import RunOptions, detect_flight

FRAMES = 4


@pytest.fixture(scope="module")
def query() -> Iterator[str]:
    """Run the server in a separate process: Arrow waits for it without letting threads run."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    command = ["start", "--host", "127.0.0.1", "--port", port, "--in-memory"]
    server = subprocess.Popen(
        [sys.executable, "-m", "gcp_storage_emulator", *command, "--default-bucket", "flights"],
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    try:
        for _ in range(200):
            try:
                socket.create_connection(("127.0.0.1", int(port))).close()
                break
            except OSError:
                time.sleep(0.05)
        yield f"?endpoint_override=127.0.0.1:{port}&scheme=http&retry_limit_seconds=3"
    finally:
        server.terminate()
        server.wait()


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight with a table in a folder of its own, which no store keeps as such."""
    folder = tmp_path_factory.mktemp("stores") / "flight"
    make_flight(folder, FRAMES, 1)
    (folder / "tables").mkdir()
    (folder / "vehicle.csv").rename(folder / "tables" / "vehicle.csv")
    toml = folder / "flight.toml"
    toml.write_text(toml.read_text().replace('"vehicle.csv"', '"tables/vehicle.csv"'))
    return folder


@pytest.fixture(scope="module")
def expected(flight: Path) -> bytes:
    out = flight.parent / "here"
    detect_flight(read_flight(flight), out=out, options=RunOptions(jobs=0))
    return (out / "detections.parquet").read_bytes()


@pytest.fixture
def name(query: str, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a folder that has the flight, below the bucket."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    name = uuid.uuid4().hex
    system = opened(query)
    for path in flight.rglob("*"):
        if path.is_file():
            stored = f"flights/{name}/{path.relative_to(flight).as_posix()}"
            with system.open_output_stream(stored) as stream:
                stream.write(path.read_bytes())
    return name


def opened(query: str) -> FileSystem:
    return FileSystem.from_uri(f"gs://anonymous@flights{query}")[0]


def content(query: str, path: str) -> bytes:
    with opened(query).open_input_file(f"flights/{path}") as stream:
        data: bytes = stream.read()
    return data


def test_a_flight_in_googles_store_gives_the_bytes_of_a_local_one(
    name: str, query: str, flight: Path, expected: bytes
) -> None:
    stored = f"gs://anonymous@flights/{name}{query}"
    done = CliRunner().invoke(main, ["detect", stored, "--jobs", "0", "--json", "-q"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["table"] == f"gs://flights/{name}/kgcp/detections.parquet"
    assert content(query, f"{name}/kgcp/detections.parquet") == expected
    made = opened(query).get_file_info(FileSelector(f"flights/{name}/kgcp", recursive=True))
    assert sorted(each.base_name for each in made) == ["detections.parquet", "run.json"]
    out = flight.parent / "here"
    for place, folder in ((str(out), str(flight)), (f"{stored[: -len(query)]}/out{query}", stored)):
        table = f"{name}/out/detections.parquet"
        with opened(query).open_output_stream(f"flights/{table}") as stream:
            stream.write(expected)
        options = ["export-gcp", "--format", "csv", "--out", place, folder]
        done = CliRunner().invoke(main, options)
        assert done.exit_code == 0, done.output
    assert content(query, f"{name}/out/kgcps.csv") == (out / "kgcps.csv").read_bytes()


@pytest.mark.parametrize(
    ("place", "problem"),
    [
        ("/nowhere", "gs://flights/nowhere/flight.toml: does not exist; correct the"),
        ("-of-others", "gs://flights-of-others/flight.toml: does not exist; correct the"),
    ],
)
def test_missing_objects_in_google_storage_are_a_one_line_error(
    place: str, problem: str, query: str
) -> None:
    done = CliRunner().invoke(main, ["detect", f"gs://anonymous@flights{place}{query}"])
    assert done.exit_code == 1
    assert done.output.startswith(f"kgcp: error: {problem}")
    assert done.output.count("\n") == 1
