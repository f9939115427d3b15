from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from kgcp.cli import COMMANDS, main
from kgcp.errors import Reason
from kgcp.io.flight.camera_table import CAMERA_KEYS
from kgcp.io.flight.flight import FRAMES_KEYS, REFERENCE_KEYS
from kgcp.io.flight.target_table import PLAIN_KEYS, PLATE_KEYS, REPLICA_KEYS
from kgcp.io.flight.vehicle_table import VEHICLE_KEYS
from kgcp.io.formats import calibrations, frame_times, orientations, trajectories
from kgcp.io.tables.calibration import FIELD_COLUMNS, OBSERVATION_COLUMNS, PHOTO_COLUMNS
from kgcp.io.tables.columns import Column
from kgcp.io.tables.consistency import CONSISTENCY_COLUMNS
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.gcps import BIAS_COLUMNS, GCP_COLUMNS
from kgcp.io.tables.places import PLACE_COLUMNS, PLACE_RESIDUAL_COLUMNS
from kgcp.io.tables.poses import POSE_COLUMNS, POSE_RESIDUAL_COLUMNS
from kgcp.quality.checks.doubt import Cause
from tests.test_layers import LAYERS, module_names

ROOT = Path(__file__).resolve().parents[1]
TABLES = (ROOT / "docs" / "tables.md").read_text(encoding="utf-8")
FLIGHT_TOML = (ROOT / "docs" / "flight_toml.md").read_text(encoding="utf-8")
FOREIGN_FILES = (ROOT / "docs" / "foreign_files.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
DESIGN = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def test_named_benchmarks_exist() -> None:
    code = [*(ROOT / "kgcp").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    named = {
        (path, module)
        for path in (*PAGES, *code, ROOT / "benchmarks" / "README.md", ROOT / "Makefile")
        for module in re.findall(r"benchmarks(?:\.[a-z_]+)+", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 50
    for path, module in named:
        place = ROOT.joinpath(*module.split("."))
        found = (place.with_suffix(".py"), place, place.parent.with_suffix(".py"))
        assert any(each.exists() for each in found), f"{path}: {module}"


def test_no_file_has_merge_conflict_markers() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a clone")
    if shutil.which("git") is None:
        pytest.skip("no git to ask")
    command = ["git", "grep", "-nIE", "^(<<<<<<<|>>>>>>>) "]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout, found.stderr) == (1, "", "")


def test_examples_read_frames_as_they_are_stored() -> None:
    """OpenCV turns frames by the orientation tag of EXIF unless it is told not to."""
    for page in PAGES:
        for block in page.read_text(encoding="utf-8").split("```python")[1:]:
            code, _, _ = block.partition("```")
            assert ("imread(" in code) == ("cv2.IMREAD_IGNORE_ORIENTATION" in code), page.name


def test_no_line_of_a_paragraph_begins_with_a_mark_of_markdown() -> None:
    """Such as the > of a menu, where lines were folded: the rest becomes a quotation or a list."""
    mark = re.compile(r"(?:[-+*>]|#{1,6}|\d+[.)]) ")
    for page in (*PAGES, ROOT / "benchmarks" / "README.md"):
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        before = ""
        for line in text.splitlines():
            is_text = before.strip() != "" and before[0] != " " and not mark.match(before)
            assert not (is_text and mark.match(line)), f"{page.name}: {line}"
            before = line


def section(heading: str, page: str = TABLES) -> str:
    """The text below a heading of a page, up to the next one of any level."""
    match = re.search(rf"^#+ {re.escape(heading)}$(.*?)(?=^#|\Z)", page, re.MULTILINE | re.DOTALL)
    assert match, heading
    return match[1]


def first_column(text: str) -> list[str]:
    """The code words in the first column of a table."""
    return [
        word
        for line in text.splitlines()
        if line.startswith("| `")
        for word in re.findall(r"`([^`]+)`", line.split("|")[1])
    ]


@pytest.mark.parametrize(
    ("heading", "columns"),
    [
        ("detections.parquet", DETECTION_COLUMNS),
        ("kgcps.parquet", GCP_COLUMNS),
        ("consistency.parquet", CONSISTENCY_COLUMNS),
        ("bias.parquet", BIAS_COLUMNS),
        ("places.parquet", PLACE_COLUMNS),
        ("poses.parquet", POSE_COLUMNS),
        ("pose_residuals.parquet", POSE_RESIDUAL_COLUMNS),
        ("place_residuals.parquet", PLACE_RESIDUAL_COLUMNS),
        ("photos.parquet", PHOTO_COLUMNS),
        ("observations.parquet", OBSERVATION_COLUMNS),
        ("field.parquet", FIELD_COLUMNS),
    ],
)
def test_exactly_the_columns_that_exist_are_documented(
    heading: str, columns: tuple[Column[Any], ...]
) -> None:
    documented = first_column(section(heading))
    assert len(documented) == len(set(documented))
    assert set(documented) == {column.name for column in columns}


def test_every_reason_is_documented_in_its_own_words() -> None:
    lines = [line for line in section("Reasons").splitlines() if line.startswith("| `")]
    assert lines == [f"| `{r.value}` | `{r.status.value}` | {r.description} |" for r in Reason]


def test_every_cause_of_a_doubt_is_documented_in_its_own_words() -> None:
    lines = [line for line in section("Doubts").splitlines() if line.startswith("| `")]
    assert lines == [f"| `{cause.value}` | {cause.description} |" for cause in Cause]


@pytest.mark.parametrize(
    "key",
    sorted(
        {
            *(*FRAMES_KEYS, *CAMERA_KEYS, *PLATE_KEYS, *PLAIN_KEYS, *REPLICA_KEYS),
            *(*VEHICLE_KEYS, *REFERENCE_KEYS),
        }
    ),
)
def test_every_key_of_flight_toml_is_documented(key: str) -> None:
    text = section("flight.toml", FLIGHT_TOML)
    assert f"`{key}`" in text or (key[0] == "k" and "`k1` … `k6`" in text)


@pytest.mark.parametrize(
    ("heading", "formats"),
    [
        ("Calibrations", calibrations.FORMATS.names),
        ("Poses", orientations.FORMATS.names),
        ("Trajectories and times", {*trajectories.FORMATS.names, *frame_times.FORMATS.names}),
    ],
)
def test_every_format_that_is_read_is_documented(heading: str, formats: Iterable[str]) -> None:
    documented = {*first_column(section(heading, FOREIGN_FILES))}
    assert documented - {"format", "times_format"} == {*formats}


def test_every_page_is_reached_from_the_readme() -> None:
    """By one link, or by two."""
    linked = {ROOT / target for target in links(README)}
    again = {
        page.parent / target
        for page in linked
        if page.suffix == ".md"
        for target in links(page.read_text(encoding="utf-8"))
    }
    reached = {path.resolve() for path in linked | again}
    assert {page for page in PAGES if page.is_relative_to(ROOT / "docs")} <= reached


def links(text: str) -> list[str]:
    targets = re.findall(r"\]\(([^)\s#]+)", text)
    return [target for target in targets if not target.startswith("https://")]


QUESTIONS = (ROOT / "docs" / "questions.md").read_text(encoding="utf-8")


def test_every_question_has_an_answer_that_leads_on() -> None:
    headings = re.findall(r"^## (.*)$", QUESTIONS, re.MULTILINE)
    assert len(headings) >= 15
    for heading in headings:
        assert heading.endswith("?"), heading
        answer = section(heading, QUESTIONS)
        assert 150 < len(answer) < 2500, heading
        assert links(answer), f"{heading}: an answer names the page that has more"


def test_the_contents_of_the_questions_are_its_headings() -> None:
    contents = QUESTIONS.partition("\n## ")[0]
    anchors = re.findall(r"^- \[([^\]]+)\]\(#", contents, re.MULTILINE)
    assert anchors == re.findall(r"^## (.*)$", QUESTIONS, re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_have_existing_targets(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        path, _, anchor = target.partition("#")
        if path.startswith("https://"):
            continue
        linked = page.parent / path if path else page
        assert linked.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {
                re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings
            }
            assert anchor in slugs, target


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_explains_itself_with_an_example(name: str) -> None:
    result = CliRunner().invoke(main, [name, "--help"])
    assert result.exit_code == 0
    assert f"kgcp {name} " in result.stdout.partition("\n")[2], "an example, below the usage line"
    assert main.get_command(click.Context(main), name) is not None


def test_the_commands_of_the_readme_exist() -> None:
    lines = [line.strip().partition("#")[0] for line in README.splitlines() if line[:4] == " " * 4]
    calls = [shlex.split(line)[1:] for line in lines if line.startswith("kgcp ")]
    assert {call[0] for call in calls} == set(COMMANDS)
    for name, *arguments in calls:
        command = main.get_command(click.Context(main), name)
        assert command is not None
        if "--help" not in arguments:
            command.make_context(name, list(arguments))  # raises on unknown options


def test_the_make_targets_of_the_readme_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    for target in re.findall(r"(?:`|^ {4})make ([a-z-]+)", text, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_the_design_page_shows_every_folder_and_top_level_module() -> None:
    shown = {
        f"{line[: line.index(name)].count('  ')}{name}"
        for line in section("The tree", DESIGN).splitlines()
        for name in re.findall(r"^ {6,}(\w+(?:/|\.py))", line)
    }
    package = ROOT / "kgcp"
    folders = {path.parent for path in package.rglob("*.py")} - {package}
    depths = {f"{len(path.relative_to(ROOT).parts) + 1}{path.name}/" for path in folders}
    assert shown == depths | {"3settings.py", "3errors.py"}


def test_the_design_page_has_the_layers_in_their_order() -> None:
    lines = [line for line in section("Layers", DESIGN).splitlines() if line.startswith(" " * 4)]
    shown = [set(re.split(r" {3}(?=\S)", line[4:52].strip())) for line in lines]
    assert shown == [set(layer) for layer in reversed(LAYERS) if layer != ("__main__",)]


def test_the_modules_of_the_data_flow_exist() -> None:
    words = re.findall(
        r"[a-z]\w*(?:\.\w+)+(?:, [a-z_]+)*$", section("Data flow", DESIGN), re.MULTILINE
    )
    assert len(words) > 20
    for line in words:
        first, *others = line.split(", ")
        room = first.rpartition(".")[0]
        for name in (first, *(other if "." in other else f"{room}.{other}" for other in others)):
            assert any(f".{module}".endswith(f".{name}") for module in module_names()), name
