"""The house of docs/design.md, enforced: who may import whom, and how large a thing may grow."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "kgcp"

# From the ground up; the members of one layer do not know each other.
LAYERS = (
    ("errors",),
    ("settings",),
    ("geometry",),
    ("targets",),
    ("measurement",),
    ("georef",),
    ("simulation",),
    ("quality",),
    ("io",),
    ("report",),
    ("pipeline",),
    ("cli",),
    ("__main__",),
)
LEVEL = {member: level for level, members in enumerate(LAYERS) for member in members}

# What each part may use besides the standard library and kgcp; `io`, `report`, `pipeline`: all.
LIBRARIES = {
    "errors": set(),
    "settings": set(),
    "geometry": {"numpy", "scipy", "numba"},
    "targets": {"numpy"},
    "measurement": {"numpy", "scipy", "cv2"},
    "georef": {"numpy", "scipy", "pyproj"},
    "simulation": {"numpy", "scipy", "cv2"},
    "quality": {"numpy", "scipy"},
    "cli": {"click", "tqdm"},
    "__main__": set(),
}

# Ways to a file, closed to everything below `io`.
FILE_MODULES = {"pathlib", "os", "io", "csv", "json", "tomllib", "tempfile", "shutil"}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def member(path: Path) -> str | None:
    """The part of the house that a file belongs to; None for the package's own __init__."""
    part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    return None if part == "__init__" else part


def imported(path: Path) -> Iterator[str]:
    """Names of all modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            if node.module == "kgcp":  # `from kgcp import survey` names a member
                yield from (f"kgcp.{alias.name}" for alias in node.names)
            else:
                yield node.module


def names(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


def test_every_part_of_the_package_has_its_layer() -> None:
    assert {member(path) for path in modules()} - {None} <= set(LEVEL)


@pytest.mark.parametrize("path", modules(), ids=names)
def test_imports_point_downwards(path: Path) -> None:
    own = member(path)
    for name in imported(path):
        package, _, rest = name.partition(".")
        other = rest.partition(".")[0]
        if package != "kgcp" or not rest or other in {"__version__", own}:
            continue
        assert own is not None, f"kgcp/__init__.py imports {name}: it must stay light"
        assert LEVEL[other] < LEVEL[own], f"{own} imports {name}"


@pytest.mark.parametrize("path", modules(), ids=names)
def test_parts_use_only_the_libraries_of_their_layer(path: Path) -> None:
    own = member(path)
    packages = {name.partition(".")[0] for name in imported(path)}
    foreign = packages - sys.stdlib_module_names - {"kgcp"}
    if own is None:
        assert not foreign
    elif own in LIBRARIES:
        assert foreign <= LIBRARIES[own]


@pytest.mark.parametrize(
    "path",
    [path for path in modules() if LEVEL.get(member(path) or "errors", 0) < LEVEL["io"]],
    ids=names,
)
def test_nothing_below_io_knows_files(path: Path) -> None:
    assert not FILE_MODULES & {name.partition(".")[0] for name in imported(path)}


@pytest.mark.parametrize("path", modules(), ids=names)
def test_files_stay_readable(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 500


def body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function below its signature and docstring."""
    statements = function.body[1:] if ast.get_docstring(function) else function.body
    if not statements:
        return 0
    last = statements[-1].end_lineno
    assert last is not None
    return last - statements[0].lineno + 1


def test_functions_stay_short() -> None:
    sizes = {
        f"{names(path)}:{node.name}": body_lines(node)
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    assert {name: size for name, size in sizes.items() if size > 60} == {}
    assert median(sizes.values()) <= 10
