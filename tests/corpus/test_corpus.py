"""Input that lies comes to a row or to one line, in time, and leaves everything else alone."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("resource", reason="Windows limits no memory and has no pipes in folders")

from click.testing import CliRunner

from kgcp.cli import main
from tests.corpus.flights import CASES as FLIGHTS
from tests.corpus.frames import CASES as FRAMES
from tests.corpus.ground import SEEN, Case, reasons, run, sound_flight, state
from tests.corpus.results import CASES as RESULTS

_PAGES = (".html", ".svg", ".xml")
CASES = (*FRAMES, *FLIGHTS, *RESULTS)


def test_the_corpus_is_large_and_its_names_differ() -> None:
    assert len(CASES) >= 60
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.fixture(scope="module", autouse=True)
def _warm(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Import and compile what is needed before there is a limit of time."""
    flight = sound_flight(tmp_path_factory.mktemp("warm"))
    for command, *options in (
        *(("bias-report", "--reexpose", "0"), ("export-gcp", "--format", "all")),
        ("detect", "--jobs", "0"),
    ):
        result = CliRunner().invoke(main, (command, str(flight), *options))
        assert result.exit_code == (command == "detect"), result.stderr  # it shows no target
    assert reasons(flight) == {"sound.png": SEEN}


@pytest.mark.parametrize("case", CASES, ids=lambda case: ascii(case.name))
def test_a_lie_comes_to_what_is_expected(tmp_path: Path, case: Case) -> None:
    flight = sound_flight(tmp_path)
    case.plant(flight)
    before = state(tmp_path)
    result = run(case, flight)
    assert state(tmp_path) == before, "nothing is written but results"
    lines = result.stderr.splitlines()
    errors = [line for line in lines if line.startswith("kgcp: error: ")]
    if isinstance(result.exception, Exception):
        raise result.exception
    assert "Traceback" not in result.stderr
    assert all(line.isprintable() for line in lines), lines
    if case.words:
        assert result.exit_code == 1, result.stderr
        assert errors == lines[-1:]
        assert case.words in errors[0]
        assert "; " in errors[0], "the remedy follows a semicolon"
        assert len(errors[0]) < 2000
    elif case.command[0] != "detect":
        assert result.exit_code == 0, result.stderr
        assert not errors
    else:
        assert result.exit_code == 1, result.stderr
        assert errors == lines[-1:]
        assert "no target was measured in any of" in errors[0]
        assert reasons(flight) == {"sound.png": SEEN, **case.rows}
    pages = [path for path in flight.glob("kgcp/**/*") if path.suffix in _PAGES]
    assert bool(pages) >= bool(case.absent)
    for path in pages:
        assert not [piece for piece in case.absent if piece in path.read_bytes()], path
