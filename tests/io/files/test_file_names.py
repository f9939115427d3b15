"""Names of the files that kgcp writes, on every system."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath, PureWindowsPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.io.exporters.formats import FORMATS
from kgcp.io.images.remote import StoredFolder, parsed_url
from kgcp.io.print.write import file_stem
from kgcp.report.contact_sheet import PAGE

DEVICES = {"con", "prn", "aux", "nul"} | {
    f"{name}{n}" for name in ("com", "lpt") for n in range(10)
}
FORBIDDEN = re.compile(r'[<>:"|?\\\x00-\x1f]|[ .]$')


def is_portable(name: str) -> bool:
    """Whether Windows, macOS and Linux take a name as it is."""
    first = name.partition(".")[0].rstrip().casefold()
    return first not in DEVICES and not FORBIDDEN.search(name) and len(name.encode()) <= 200


@pytest.mark.parametrize("name", ["CON", "nul.txt", "a" * 200, "ü" * 200, "A/B:C*", "..", "T 1. "])
def test_targets_of_any_name_have_files(name: str, tmp_path: Path) -> None:
    file = f"{file_stem(name)}_A1.pdf"
    assert is_portable(file)
    (tmp_path / file).write_bytes(b"")


@given(st.text(min_size=1, max_size=200))
def test_file_names_of_targets_are_portable(name: str) -> None:
    assert is_portable(f"{file_stem(name)}.svg")
    assert PureWindowsPath(file_stem(name)).parts == (file_stem(name),)


def test_long_names_stay_apart() -> None:
    assert file_stem("x" * 150 + "1") != file_stem("x" * 150 + "2")


def test_what_is_always_written_has_portable_names() -> None:
    files = [name.strip("[]").replace("*", "x") for form in FORMATS.values() for name in form.files]
    for name in [*files, PAGE, "detections.parquet", "run.json", "flight.toml", "targets.toml"]:
        for part in PurePosixPath(name).parts:
            assert is_portable(part), name


@pytest.mark.parametrize("text", ["C:/flights/one", "C:\\flights\\one", "c://flights", "a/b:c"])
def test_letters_of_drives_are_no_stores(text: str) -> None:
    assert parsed_url(text) == Path(text)


def test_urls_of_files_are_paths() -> None:
    assert parsed_url("file:///data/my%20flight") == Path("/data/my flight")
    assert parsed_url("file://localhost/data") == Path("/data")
    assert parsed_url("file://server/share/my%20flight") == Path("//server/share/my flight")
    assert isinstance(parsed_url("s3://bucket/flight"), StoredFolder)
