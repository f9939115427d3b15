"""Every command that README, docs or help show is run, on a flight of a few frames."""

from __future__ import annotations

import re
import shlex
import shutil
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from kgcp.cli import COMMANDS, main
from kgcp.io.flight.flight import read_flight

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Runs of bare folders, which tests/benchmarks/test_first_flight.py repeats.
FIRST_FLIGHTS = {"first_flight.md", "first_flight_runs.md"}
FRAMES = ("frame_0002.jpg", "frame_0006.jpg", "frame_0011.jpg", "frame_0015.jpg")
# OpenDroneMap's, and of benchmarks/
OF_OTHERS = {"--force-gps", "--gcp", "--gps-accuracy", "--tilt", "--wander"}
HERE = "sample_flight"
BARE = ("my_photos",)  # folders without a flight.toml, for kgcp init
# Not run here: there is no cluster and no store, and tests/cli/test_simulate.py simulates, and
# tests/cli/test_calibrate.py calibrates, and test_place.py and test_orient.py have
# static targets, tests/pipeline/test_plain_flight.py marked ones.
READ_ONLY = {
    "--scheduler",
    "--places",
    "simulate",
    "calibrate",
    "place",
    "orient",
    "north",
}  # tests/cli/test_merging.py merges flights
STORES = ("s3://", "gs://")


@dataclass(frozen=True)
class Shown:
    """A command as it stands somewhere."""

    where: str
    arguments: tuple[str, ...]


def code_blocks(text: str) -> Iterator[str]:
    """Blocks between fences, and those that are indented."""
    fenced = re.compile(r"^```\w*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    yield from fenced.findall(text)
    yield from re.findall(r"(?:^(?: {4}.*)?\n)+", fenced.sub("", text), re.MULTILINE)


def calls(text: str, where: str) -> Iterator[Shown]:
    joined = re.sub(r"\\\n\s*", " ", text)
    for line in joined.splitlines():
        match = re.match(r"\s*(?:\$ |Examples?: )?(?:\.venv/bin/)?kgcp (\S.*)$", line)
        if match:
            words = shlex.split(match[1], comments=True)
            yield Shown(where, tuple(HERE if word == "FLIGHT" else word for word in words))


def shown_on_pages() -> Iterator[Shown]:
    for page in PAGES:
        text = "" if page.name in FIRST_FLIGHTS else page.read_text(encoding="utf-8")
        for block in code_blocks(text):
            yield from calls(block, page.name)


def shown_by_help(name: str) -> list[Shown]:
    text = command_of(name).help or ""
    assert "Example" in text
    return list(calls(text.partition("Example")[2].join(("Example", "")), f"{name} --help"))


def command_of(name: str) -> click.Command:
    command = main.get_command(click.Context(main), name)
    assert command is not None, name
    return command


def options_of(command: click.Command) -> set[str]:
    return {
        name
        for parameter in command.params
        if isinstance(parameter, click.Option)
        for name in (*parameter.opts, *parameter.secondary_opts)
    } | {"-h", "--help"}


def all_shown() -> list[Shown]:
    """Each command once, with or without a FLIGHT, in the order of the work.

    A command that only lacks the last options of another one is run with that.
    """
    everything = [*shown_on_pages(), *(one for name in COMMANDS for one in shown_by_help(name))]
    first = {
        tuple(word for word in one.arguments if word != HERE): one for one in reversed(everything)
    }
    beginnings = {words[:end] for words in first for end in range(len(words))}
    rank = list(COMMANDS)
    kept = (one for words, one in first.items() if words not in beginnings)
    return sorted(kept, key=lambda one: rank.index(one.arguments[0]))


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The sample flight with few frames, measured; it is also the current folder's flight."""
    folder = tmp_path_factory.mktemp("shown")
    flight = folder / HERE
    (flight / "frames").mkdir(parents=True)
    for path in (ROOT / HERE).glob("*.*"):
        shutil.copy(path, flight)
    for name in FRAMES:
        shutil.copy(ROOT / HERE / "frames" / name, flight / "frames")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgcp.pipeline.execution.executor.usable_cores", lambda: 0)  # in this process
        patch.chdir(folder)
        assert CliRunner().invoke(main, ["detect", HERE], catch_exceptions=False).exit_code == 0
        shutil.copytree(flight, folder, dirs_exist_ok=True)
        for bare in BARE:
            shutil.copytree(flight / "frames", folder / bare)
        yield folder


def lightened(arguments: tuple[str, ...]) -> list[str]:
    """The same command in this process."""
    words = list(arguments)
    if "--jobs" in words:
        words[words.index("--jobs") + 1] = "0"
    return words


@pytest.mark.parametrize(
    "shown", all_shown(), ids=lambda one: f"{one.where}: kgcp {' '.join(one.arguments)}"
)
def test_documented_commands_run(shown: Shown, workspace: Path) -> None:
    name, *arguments = shown.arguments
    lighter = lightened(shown.arguments)
    is_read_only = any(word in READ_ONLY or word.startswith(STORES) for word in shown.arguments)
    if lighter != [name, *arguments] or is_read_only:
        command_of(name).make_context(name, list(arguments))  # as it stands
    if is_read_only:
        return
    before = set(workspace.iterdir())
    result = CliRunner().invoke(main, lighter, catch_exceptions=False)
    assert result.exit_code == 0, result.stderr
    for path in set(workspace.iterdir()) - before:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for bare in BARE:
        (workspace / bare / "flight.toml").unlink(missing_ok=True)


def programs() -> list[str]:
    """Python of all pages but docs/api.md, whose examples tests/test_api.py runs in turn."""
    pages = (page.read_text(encoding="utf-8") for page in PAGES if page.name != "api.md")
    blocks = (textwrap.dedent(block).strip() for text in pages for block in code_blocks(text))
    return [block for block in blocks if block.startswith("import ")]


@pytest.mark.usefixtures("workspace")
@pytest.mark.parametrize("program", programs())
def test_documented_python_runs(program: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(program, "shown", "exec"), {})  # noqa: S102 - it is the project's own
    assert "frame_0002.jpg" in capsys.readouterr().out


def test_the_flight_toml_of_the_guide_is_valid(tmp_path: Path) -> None:
    guide = (ROOT / "docs" / "guide.md").read_text(encoding="utf-8")
    match = re.search(r"^```toml\n(.*?)^```$", guide, re.MULTILINE | re.DOTALL)
    assert match
    (tmp_path / "flight.toml").write_text(match[1], encoding="utf-8")
    (tmp_path / "frames").mkdir()
    flight = read_flight(tmp_path)
    assert [target.name for target in flight.targets] == ["A"]
    assert flight.vehicle is not None


def test_every_command_is_shown_to_newcomers() -> None:
    readme = [one.arguments[0] for one in shown_on_pages() if one.where == "README.md"]
    assert set(readme) == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_and_explains_every_option(name: str) -> None:
    assert {one.arguments[0] for one in shown_by_help(name)} == {name}
    assert all(
        option.help for option in command_of(name).params if isinstance(option, click.Option)
    )
    text = CliRunner().invoke(main, [name, "--help"]).stdout
    assert "\\b" not in text
    assert "\b" not in text


def test_options_in_the_text_exist_and_are_tested() -> None:
    """Every option that is spoken of is one, and some test or shown command uses it."""
    existing = set().union(*(options_of(command_of(name)) for name in COMMANDS))
    existing |= options_of(main)
    tried = "\n".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")
    )
    used = {word for one in all_shown() for word in one.arguments}
    for page in PAGES:
        spans = re.findall(r"`((?:kgcp |--)[^`\n]*)`", page.read_text(encoding="utf-8"))
        for option in re.findall(r"(?<!\S)--[a-z][a-z-]*", "\n".join(spans)):
            if option not in OF_OTHERS:
                assert option in existing, f"{page.name}: {option}"
                is_tried = option in used or re.search(rf"{option}\b(?!-)", tried)
                assert is_tried, f"{page.name}: {option}"
