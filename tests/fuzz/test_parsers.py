"""Every reader with damaged seed files, and with the files that fuzzing has found (`fuzz/`)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzz.targets import TARGETS, feed, feed_in_new_folder

FUZZ = Path(__file__).resolve().parents[2] / "fuzz"
SEEDS = {
    target: tuple(path.read_bytes() for path in sorted((FUZZ / "seeds" / target).iterdir()))
    for target in TARGETS
}
KEPT = sorted(path for kind in ("seeds", "found") for path in (FUZZ / kind).glob("*/*"))
# Replacements of numbers and words: of another type, too large, or terminators.
VALUES = (
    *(b"", b"0", b"-1", b"nan", b"-inf", b"1e308", b"1e-308", b"1e999", b"9" * 30, b"9" * 5000),
    *(b"0x" + b"f" * 5000, b"true", b"null", b"2026-06-16", b"0001-01-01T00:00:00+23:59"),
    *(b"[]", b"{}", b'""', b"'", b'"', b"\n", b"\0", b"\xff", b"<a>", b"&a;", b"*a", b"%", b"#"),
    *(b"../../..", b"/dev/zero", b"EPSG:4978", b"EPSG:25832", b" " * 3000, b"[" * 3000),
)
_FEW_EXAMPLES = {"discs": 12}  # each is measured several times, which takes long
TOKEN = re.compile(rb"[-+.\w]+")


@st.composite
def damaged(draw: st.DrawFn, target: str) -> bytes:
    """A seed of which words are replaced, pieces are cut, moved or doubled, and bytes changed."""
    data = draw(st.sampled_from(SEEDS[target]))
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(data) - 1, 0)))
        end = place + draw(st.integers(1, 40))
        match draw(
            st.sampled_from(("word", "word", "word", "cut", "double", "byte", "end", "swap"))
        ):
            case "word":
                token = TOKEN.search(data, place)
                start, stop = token.span() if token else (place, place)
                data = data[:start] + draw(st.sampled_from(VALUES)) + data[stop:]
            case "cut":
                data = data[:place] + data[end:]
            case "double":
                data = data[:end] + data[place:]
            case "byte":
                data = data[:place] + draw(st.binary(max_size=4)) + data[place + 1 :]
            case "end":
                data = data[:place]
            case "swap":
                data = data[end:] + data[:end]
    return data


@pytest.mark.parametrize("target", TARGETS)
def test_damaged_files_raise_only_known_errors(target: str, tmp_path: Path) -> None:
    examples = _FEW_EXAMPLES.get(target, 40)

    @settings(max_examples=examples, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(
        data=st.one_of(damaged(target), damaged(target), damaged(target), st.binary(max_size=99))
    )
    def check(data: bytes) -> None:
        feed(target, data, tmp_path)

    check()


@pytest.mark.parametrize("path", KEPT, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_files_that_once_crashed_a_reader_are_accepted_or_refused(path: Path) -> None:
    """A reader accepts a file, or refuses it in one line; any other exception fails."""
    feed_in_new_folder(path.parent.name, path.read_bytes())


def test_kept_files_are_small_and_cover_every_reader() -> None:
    assert sum(path.stat().st_size for path in KEPT) < 200_000
    assert {path.parent.name for path in KEPT} == set(TARGETS)
