from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from kgcp.errors import KgcpError, one_line
from kgcp.io.files.safe_read import (
    is_file,
    is_folder,
    is_missing,
    is_sound,
    read_bytes,
    read_lines,
)
from kgcp.io.files.safe_yaml import load_yaml
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.detections import read_detections
from kgcp.io.tables.parquet import read_table
from kgcp.io.tables.staleness import refuse_to_replace_whole
from kgcp.pipeline.workspace import results_folder
from tests.systems import needs_links, not_on_windows, share

KEY = "[vehicle] trajectory"


def test_only_regular_files_are_read_and_names_of_any_length_may_be_asked_for(
    tmp_path: Path,
) -> None:
    whole = tmp_path / "file"
    whole.write_bytes(b"12345")
    assert read_bytes(whole, KEY) == b"12345"
    share(whole, tmp_path / "link")
    assert read_bytes(tmp_path / "link", KEY, 5) == b"12345"
    with pytest.raises(
        KgcpError,
        match=r"file: has at least 5 bytes, more than the 4 allowed for .*trajectory.*; na",
    ):
        read_bytes(whole, KEY, 4)
    names = ["."]
    if os.name != "nt":  # which has no pipes in folders
        os.mkfifo(tmp_path / "pipe")
        names.append("pipe")
    for name in names:
        with pytest.raises(
            KgcpError, match=r"is not a regular file; flight.toml names it under \[veh"
        ):
            read_bytes(tmp_path / name, KEY)
    for name in ("gone", "n" * 5000, "a\0b"):
        assert not is_file(tmp_path / name)
        assert not is_folder(tmp_path / name)
        with pytest.raises(KgcpError, match=r"does not exist; flight.toml names it under \[veh"):
            read_bytes(tmp_path / name, KEY)


@not_on_windows("has no such files")
def test_sizes_that_the_system_does_not_tell_are_limited_too(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("/proc/self/status")  # of 0 bytes, it says
    with pytest.raises(KgcpError, match="more than the 3 allowed"):
        read_bytes(tmp_path / "link", KEY, 3)


def test_lines_are_read_as_they_are_wanted(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    path.write_bytes("\ufeffø\r\nb\r\n\0".encode())
    lines = read_lines(path, KEY)
    assert [next(lines), next(lines)] == ["ø\r\n", "b\r\n"]
    with pytest.raises(
        KgcpError, match=r"line 3: is not a valid text line .binary file.+; name a text file"
    ):
        next(lines)
    path.write_bytes(b"a\n" + b"x" * (2 << 20))
    with pytest.raises(KgcpError, match="line 2: is not a valid text line"):
        list(read_lines(path, KEY))


def test_a_file_that_another_program_has_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Windows refuses it; none of the keys that name the file is wrong."""
    path = tmp_path / "data.parquet"
    path.write_bytes(b"1,2")

    def refused(*_: object, **__: object) -> object:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refused)
    monkeypatch.setattr("pyarrow.parquet.read_table", refused)
    for read in (
        lambda: read_bytes(path, KEY),
        lambda: list(read_lines(path, KEY)),
        lambda: ForeignFile(path, KEY).head,
        lambda: read_table(path, ()),
    ):
        with pytest.raises(KgcpError, match=r"is protected, or open in another program; make it"):
            read()


def test_a_file_in_a_protected_folder_is_not_missing(hidden: Path) -> None:
    assert not is_missing(hidden / "file")
    for name in ("gone", "n" * 5000, "a\0b"):
        assert is_missing(hidden.parent / name)
    assert not is_missing(hidden.parent)
    for read in (
        lambda: read_bytes(hidden / "file", KEY),
        lambda: read_detections(hidden / "detections.parquet"),
        lambda: read_flight(hidden),
        lambda: refuse_to_replace_whole(hidden / "detections.parquet"),
    ):
        with pytest.raises(KgcpError, match=r"is protected, or open in another program; make it"):
            read()


def test_files_in_a_protected_folder_are_not_ignored(hidden: Path) -> None:
    sample = Path(__file__).parents[3] / "sample_flight"
    text = (sample / "flight.toml").read_text("utf-8").replace('folder = "frames"', "")
    for name in ("frames", "vehicle", "reference"):
        text = text.replace(f'"{name}.csv"', f'"hidden/{name}.csv"')
    (hidden.parent / "frames").mkdir()
    (hidden.parent / "flight.toml").write_text(text, "utf-8")
    data = FlightData(read_flight(hidden.parent), [])
    assert data.has_reference
    assert data.has_trajectory
    with pytest.raises(KgcpError, match=r"frames\.csv: is protected"):
        _ = data.frame_times


def test_numbers_are_sound_up_to_what_could_overflow() -> None:
    assert all(map(is_sound, (0.0, -1.8e9, 6.4e6, 1781597701000.0)))
    assert not any(map(is_sound, (math.nan, math.inf, -math.inf, 1e15, 10**400)))


def test_a_message_is_one_line_that_no_terminal_obeys() -> None:
    message = str(KgcpError("a\r\nb\x1b[2J\u2028\x85é 日本…"))
    assert message == "a  b\\x1b[2J  é 日本…"
    cut = one_line("what " + "x" * 10**6 + "; remedy")
    assert len(cut) < 1600
    assert cut.startswith("what x")
    assert cut.endswith("x; remedy")


@needs_links
@pytest.mark.parametrize("leads_to", ["../elsewhere", "nowhere"])
def test_results_go_through_no_link(tmp_path: Path, leads_to: str) -> None:
    assert results_folder(tmp_path) == tmp_path / "kgcp"
    (tmp_path / "kgcp" / "a").mkdir(parents=True)
    (tmp_path / "kgcp" / "file").symlink_to("elsewhere")  # a rename replaces it
    assert results_folder(tmp_path) == tmp_path / "kgcp"
    (tmp_path / "kgcp" / "a" / "b").symlink_to("..")
    with pytest.raises(KgcpError, match="b: is a link to a folder; delete it, or choose"):
        results_folder(tmp_path)
    (tmp_path / "flight").mkdir()
    (tmp_path / "flight" / "kgcp").symlink_to(leads_to)
    with pytest.raises(KgcpError, match="kgcp: is a link; delete it, or use its destination"):
        results_folder(tmp_path / "flight")


def test_yaml_is_plain_and_no_larger_than_its_text() -> None:
    matrix = "a: !!opencv-matrix\n  rows: 1\n  cols: 2\n  dt: d\n  data: [ 1., 2.5e+03 ]\n"
    assert load_yaml(matrix) == {"a": {"rows": 1, "cols": 2, "dt": "d", "data": [1.0, 2500.0]}}
    merges = "".join(f"b{n}: &b{n} {{<<: [{9 * f'*b{n - 1},'}]}}\n" for n in range(1, 30))
    for text in (
        *(f"b0: &b0 {{a: 1}}\n{merges}", "!!python/object/apply:os.system [id]", "[" * 10_000),
        *("- " * 10_000, "a: !!opencv-matrix 3\n", "? [1]\n: 2\n", "a: \x1b\n"),
    ):
        with pytest.raises(ValueError, match=r"\S"):
            load_yaml(text)
