"""Working folders whose results go to an object store."""

from __future__ import annotations

from pathlib import Path

import pytest

from kgcp.errors import KgcpError, KgcpWarning
from kgcp.io.images.remote import StoredFolder
from kgcp.pipeline.workspace import open_workspace

STORE = StoredFolder("s3://results/flight")


@pytest.fixture(autouse=True)
def empty_store(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(StoredFolder, "require_writable", lambda _: None)


def write_results(flight: Path) -> Path:
    """Write a result into the working folder, and leave it so that it is uploaded."""
    with open_workspace(flight, STORE) as workspace:
        result = workspace.out / "detections.parquet"
        result.write_bytes(b"a table")
    return result


def test_uploaded_results_are_deleted_from_this_machine(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stored: dict[str, bytes] = {}

    def write(place: StoredFolder, path: Path) -> None:
        stored[str(place)] = path.read_bytes()

    monkeypatch.setattr(StoredFolder, "write", write)
    result = write_results(tmp_path)
    assert stored == {"s3://results/flight/detections.parquet": b"a table"}
    assert not result.exists()


@pytest.mark.parametrize("is_interrupted", [False, True])
def test_the_folder_of_results_that_are_not_uploaded_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, is_interrupted: bool
) -> None:
    def fail(place: StoredFolder, path: Path) -> None:
        raise KeyboardInterrupt if is_interrupted else KgcpError(f"{place}: no way for {path.name}")

    monkeypatch.setattr(StoredFolder, "write", fail)
    if is_interrupted:
        with (
            pytest.warns(KgcpWarning, match="they are in .*: copy them by hand") as caught,
            pytest.raises(KeyboardInterrupt),
        ):
            write_results(tmp_path)
        text = str(caught[0].message)
    else:
        with pytest.raises(KgcpError, match=r"the results are in .*: copy them by hand") as error:
            write_results(tmp_path)
        text = str(error.value)
    (result,) = (tmp_path / "cache").rglob("detections.parquet")
    assert str(result.parent) in text


def test_a_user_without_a_home_needs_a_folder_for_results(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", home)
    with pytest.raises(KgcpError, match="no home folder; set XDG_CACHE_HOME"):
        write_results(tmp_path)
