"""Arguments as the shells of Windows pass them on."""

from __future__ import annotations

import os
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from kgcp.cli import Program, main, shells
from kgcp.cli.options import flight_places_argument
from tests.systems import not_on_windows


class OneCommand(Program):
    """A program whose command prints its arguments."""

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:  # noqa: ARG002 - click's signature
        @click.command(cmd_name)
        @flight_places_argument
        @click.option("--frames", multiple=True)
        def show(flights: tuple[Path, ...], frames: tuple[str, ...]) -> None:
            click.echo(" | ".join([*map(str, flights), *frames]))

        return show


class NtOs:
    """The module os, as click sees it on Windows."""

    name = "nt"

    def __getattr__(self, name: str) -> object:
        return getattr(os, name)


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder with two flights and two frames, and a shell that expands nothing."""
    monkeypatch.setattr(shells, "SHELL_EXPANDS", False)
    monkeypatch.setattr("click.core.os", NtOs())
    for name in ("HOME", "USERPROFILE"):  # the second one is that of Windows
        monkeypatch.setenv(name, "/home/someone")
    monkeypatch.chdir(tmp_path)
    for name in ("b 1", "a [1]"):
        (tmp_path / name).mkdir()
    for name in ("1.JPG", "2.JPG"):
        (tmp_path / name).touch()


def shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *args: str) -> str:
    """Run the program by the arguments of its process, and return what it prints."""
    monkeypatch.setattr("sys.argv", ["kgcp", "show", *args])
    with pytest.raises(SystemExit):
        OneCommand("kgcp").main()
    return "".join(capsys.readouterr()).rstrip("\n")


@pytest.mark.usefixtures("windows")
@pytest.mark.parametrize(
    ("arguments", "meaning"),
    [
        ((".", "--frames", "*.JPG"), ". | *.JPG"),
        (("*1*",), "1.JPG | a [1] | b 1"),
        (("a [1*",), "a [1]"),
        (("none*",), "none*"),
        (('b 1"', "--frames", '2"'), "b 1 | 2"),
        (("~/flights",), str(Path("/home/someone/flights"))),
        (("s3://bucket/flight*",), "s3://bucket/flight*"),
    ],
)
def test_arguments_mean_what_was_typed(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    meaning: str,
) -> None:
    assert shown(monkeypatch, capsys, *arguments) == meaning


@pytest.mark.usefixtures("windows")
def test_options_that_a_quotation_mark_has_swallowed_are_reported() -> None:
    result = CliRunner().invoke(main, ["detect", 'D:\\my photos" --jobs 2'])
    assert result.exit_code == 2
    assert "leave out the backslash before the quotation mark" in result.stderr


@not_on_windows("has none of the other shells")
def test_other_shells_have_expanded_what_they_should(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a1").touch()
    assert shown(monkeypatch, capsys, "a*", '~/b"') == 'a* | ~/b"'
