"""Frames from an object store and results into it, with a local server of S3's protocol."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("moto", reason="moto is not installed: pip install 'moto[s3]'")
pytest.importorskip("flask_cors", reason="moto's server needs flask and flask-cors")

import boto3
from click.testing import CliRunner, Result
from moto.moto_server.threaded_moto_server import ThreadedMotoServer
from pyarrow.fs import FileSystem, copy_files

from benchmarks.reliability.torture import make_flight
from kgcp.cli import main
from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.io.images.remote import StoredFolder, at_hand, frames_below, parsed_url, stamps_of
from kgcp.pipeline.detect import NoProgress, RunOptions, detect_flight
from kgcp.pipeline.workspace import open_workspace

FRAMES = 6
KEYS = {
    "AWS_ACCESS_KEY_ID": "anybody",
    "AWS_SECRET_ACCESS_KEY": "secret",
    "AWS_EC2_METADATA_DISABLED": "true",
}


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # a line per request
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in KEYS.items():
            patch.setenv(name, value)
        server.start()
        host, port = server.get_host_and_port()
        yield f"{host}:{port}"
        server.stop()


@pytest.fixture(scope="module")
def query(endpoint: str) -> str:
    return f"?endpoint_override={endpoint}&scheme=http&region=us-east-1&allow_bucket_creation=true"


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stores") / "flight"
    make_flight(folder, FRAMES, 1)
    return folder


@pytest.fixture(scope="module")
def expected(flight: Path) -> bytes:
    out = flight.parent / "here"
    detect_flight(read_flight(flight), out=out, options=RunOptions(jobs=0))
    return (out / "detections.parquet").read_bytes()


@pytest.fixture
def bucket(
    query: str, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[FileSystem]:
    """A store that has the flight as `flights/one`, and an empty cache of results."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    system, _ = FileSystem.from_uri(f"s3://flights{query}")
    system.create_dir("flights")
    copy_files(str(flight), "flights/one", destination_filesystem=system)
    yield system
    system.delete_dir_contents("flights")


def detect(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["detect", *arguments, "-q"])


def names_in(endpoint: str) -> set[str]:
    client = boto3.client("s3", endpoint_url=f"http://{endpoint}", region_name="us-east-1")
    return {each["Key"] for each in client.list_objects_v2(Bucket="flights").get("Contents", ())}


def content(bucket: FileSystem, path: str) -> bytes:
    with bucket.open_input_file(path) as stream:
        data: bytes = stream.read()
    return data


def test_a_stored_flight_gives_the_bytes_of_a_local_one(
    bucket: FileSystem, endpoint: str, query: str, expected: bytes, tmp_path: Path
) -> None:
    before = names_in(endpoint)
    done = detect(f"s3://flights/one{query}", "--jobs", "1", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["table"] == "s3://flights/one/kgcp/detections.parquet"
    assert content(bucket, "flights/one/kgcp/detections.parquet") == expected
    made = {"one/kgcp/detections.parquet", "one/kgcp/run.json"}
    assert {name for name in names_in(endpoint) - before if not name.endswith("/")} == made
    assert not any(path.is_file() for path in (tmp_path / "cache").rglob("*"))


def test_points_are_made_of_stored_detections(
    bucket: FileSystem, query: str, flight: Path, expected: bytes
) -> None:
    with bucket.open_output_stream("flights/one/kgcp/detections.parquet") as stream:
        stream.write(expected)
    command = ["export-gcp", "--format", "csv", "--out"]
    out = flight.parent / "here"
    for place in (out, f"s3://flights/one/kgcp{query}"):
        folder = flight if place == out else f"s3://flights/one{query}"
        done = CliRunner().invoke(main, [*command, str(place), str(folder)])
        assert done.exit_code == 0, done.output
    assert "wrote s3://flights/one/kgcp/kgcps.csv" in done.output
    for name in ("kgcps.parquet", "kgcps.csv"):
        assert content(bucket, f"flights/one/kgcp/{name}") == (out / name).read_bytes()


class Stop(NoProgress):
    def progress(self, stage: str, done: int, total: int, found: int) -> None:  # noqa: ARG002 - the base class's signature
        if done == FRAMES // 2:
            raise KeyboardInterrupt


@pytest.mark.usefixtures("bucket")
def test_results_of_an_interrupted_run_are_kept_on_the_local_machine(
    bucket: FileSystem, endpoint: str, query: str, flight: Path, expected: bytes
) -> None:
    out = parsed_url(f"s3://flights/results/7{query}")
    options = RunOptions(jobs=0)
    with pytest.raises(KeyboardInterrupt), open_workspace(flight, out) as workspace:
        detect_flight(
            read_flight(workspace.flight), out=workspace.out, options=options, listener=Stop()
        )
    assert not [name for name in names_in(endpoint) if "parquet" in name]
    done = detect(str(flight), "--out", f"s3://flights/results/7{query}", "--jobs", "0", "--json")
    assert json.loads(done.stdout)["kept"] == FRAMES // 2
    assert content(bucket, "flights/results/7/detections.parquet") == expected


def test_a_frame_missing_in_the_store_has_no_stamp_and_is_an_error_when_read(
    bucket: FileSystem, query: str, flight: Path
) -> None:
    folder = StoredFolder(f"s3://flights/one{query}", "frames")
    frames = frames_below(folder)
    assert frames == frames_below(flight / "frames")
    stamps = list(stamps_of(folder, [*frames, "missing.png"]))
    assert [stamp is None for stamp in stamps] == [False] * FRAMES + [True]
    with at_hand(folder, frames[0]) as path:
        assert path.read_bytes() == (flight / "frames" / frames[0]).read_bytes()
    assert not path.exists()
    bucket.delete_file(f"flights/one/frames/{frames[0]}")
    with (
        pytest.raises(KgcpError, match=rf"one/frames/{frames[0]}: does not exist; correct the URL"),
        at_hand(folder, frames[0]),
    ):
        pass


def test_no_object_name_leads_out_of_its_folder(
    bucket: FileSystem, endpoint: str, query: str
) -> None:
    assert bucket is not None
    client = boto3.client("s3", endpoint_url=f"http://{endpoint}", region_name="us-east-1")
    client.put_object(Bucket="flights", Key="bad/frames/..\\..\\out.png", Body=b"")
    with pytest.raises(KgcpError, match="is not a path below it; rename the object"):
        frames_below(StoredFolder(f"s3://flights/bad{query}", "frames"))
    client.put_object(
        Bucket="flights", Key="out/flight.toml", Body=b'[frames]\nfolder = "../one/frames"'
    )
    done = detect(f"s3://flights/out{query}", "--jobs", "0")
    assert done.exit_code == 1
    assert "s3://flights/out/flight.toml: [frames] folder: '../one/frames'" in done.output


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("s3://flights/two{query}", "s3://flights/two/flight.toml: does not exist; correct the"),
        ("s3://flights/one?zone=3", "s3://flights/one: Unexpected query parameter in S3 URI"),
        ("ftp://flights/one", "ftp://flights/one: unsupported location; use a folder"),
    ],
)
@pytest.mark.usefixtures("bucket")
def test_an_unusable_store_is_a_one_line_error(url: str, problem: str, query: str) -> None:
    done = detect(url.format(query=query))
    assert done.exit_code == 1
    assert done.output.startswith(f"kgcp: error: {problem}")
    assert done.output.count("\n") == 1


def test_a_missing_results_folder_is_reported_before_the_work_begins(
    flight: Path, query: str
) -> None:
    query = query.replace("allow_bucket_creation=true", "allow_bucket_creation=false")
    done = detect(str(flight), "--out", f"s3://nobody-has-it/results{query}")
    assert done.exit_code == 1
    assert "s3://nobody-has-it/results: cannot be written" in done.output


def test_urls_of_files_are_paths_and_keys_stay_secret() -> None:
    assert parsed_url("file:///data/flight") == Path("/data/flight")
    assert parsed_url("flight") == Path("flight")
    stored = parsed_url("gs://anybody:secret@flights/one/?retry_limit_seconds=9")
    assert isinstance(stored, StoredFolder)
    assert str(stored) == "gs://flights/one"
    assert str(stored / "frames" / "a.png") == "gs://flights/one/frames/a.png"
