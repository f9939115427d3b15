"""The rules of docs/design.md: allowed imports between layers, and sizes of folders and files."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from statistics import median, quantiles

PACKAGE = Path(__file__).resolve().parents[1] / "kgcp"

# From the ground up. A module belongs to the member with the longest name that fits; the members
# of one layer do not import each other.
LAYERS = (
    ("errors",),
    ("settings",),
    ("geometry",),
    ("targets",),
    ("measurement.records",),
    ("measurement.plate_prior",),
    ("measurement.search", "measurement.image_model"),
    ("measurement.adjustment",),
    ("measurement.closed_form", "measurement.discs"),
    ("measurement",),
    ("georef",),
    ("network",),
    ("quality",),
    ("simulation",),
    ("io.files",),
    ("io.images",),
    ("io.formats",),
    ("io.flight",),
    ("io.tables",),
    ("io.exporters", "io.print"),
    ("report",),
    ("report.bias", "report.calibration"),
    ("pipeline.execution",),
    ("pipeline",),
    ("cli",),
    ("__main__",),
)
LEVEL = {member: level for level, members in enumerate(LAYERS) for member in members}

# What each member may import besides the standard library and kgcp.
ARRAYS = frozenset({"numpy"})
NUMERICS = ARRAYS | {"scipy", "numba", "llvmlite"}  # the last one is numba's compiler
IMAGES = NUMERICS | {"cv2"}
LIBRARIES: dict[str, frozenset[str]] = {
    "errors": frozenset(),
    "settings": frozenset(),
    "geometry": NUMERICS,
    "targets": ARRAYS,
    "measurement.records": ARRAYS,
    "measurement.plate_prior": NUMERICS,
    "measurement.search": IMAGES,
    "measurement.image_model": IMAGES,
    "measurement.adjustment": IMAGES,
    "measurement.closed_form": IMAGES,
    "measurement.discs": IMAGES,
    "measurement": IMAGES,
    "georef": ARRAYS | {"scipy", "pyproj"},
    "network": ARRAYS | {"scipy", "cv2"},
    "simulation": IMAGES,
    "quality": ARRAYS | {"scipy"},
    "io.files": ARRAYS | {"yaml"},
    "io.images": IMAGES | {"PIL", "pyarrow", "simplejpeg"},
    "io.formats": ARRAYS | {"scipy", "pyproj"},
    "io.flight": ARRAYS | {"pyproj"},
    "io.tables": IMAGES | {"pandas", "PIL", "pyarrow"},
    "io.exporters": ARRAYS | {"pyproj", "scipy"},
    "io.print": ARRAYS | {"ezdxf", "matplotlib", "PIL"},
    "report": IMAGES | {"jinja2", "matplotlib"},
    "report.bias": IMAGES | {"jinja2", "markupsafe", "matplotlib"},
    "report.calibration": ARRAYS | {"jinja2", "matplotlib"},
    "pipeline.execution": frozenset(
        {"cv2", "distributed", "numba", "numpy", "scipy", "threadpoolctl"}
    ),
    "pipeline": IMAGES | {"pandas", "PIL", "pyarrow"},
    "cli": frozenset({"click", "tqdm"}),
    "__main__": frozenset(),
}

# Ways to a file, closed to everything below `io`.
FILE_MODULES = {"pathlib", "os", "io", "csv", "json", "tomllib", "tempfile", "shutil"}

FILE_ROOMS = {"", "io", "report", "pipeline", "cli", "__main__"}

# Where a module is imported when it is first needed: commands, and the names of the public API.
LAZY = ("cli", "")


@dataclass(frozen=True, slots=True)
class Import:
    """One import statement's module.

    Attributes
    ----------
    name : str
        Dotted; of `from kgcp import errors`, "kgcp.errors".
    is_hidden : bool
        Whether it stands in a function or under TYPE_CHECKING.
    """

    name: str
    is_hidden: bool


@cache
def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@cache
def module_names() -> set[str]:
    return {f"kgcp.{dotted(path)}".rstrip(".") for path in modules()}


@cache
def syntax(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def dotted(path: Path) -> str:
    """Name of a module below `kgcp`, "" for the package's own __init__."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def member(module: str) -> str:
    """The member of a layer that a module belongs to."""
    parts = module.split(".")
    for length in range(len(parts), 0, -1):
        if (name := ".".join(parts[:length])) in LEVEL:
            return name
    raise AssertionError(f"{module or 'kgcp/__init__.py'}: has no layer")


@cache
def imports(path: Path) -> list[Import]:
    """All imports of a file, wherever in it."""
    found: list[Import] = []

    def visit(node: ast.AST, *, is_hidden: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(Import(alias.name, is_hidden) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            names = {f"{node.module}.{alias.name}" for alias in node.names} & module_names()
            found.extend(Import(name, is_hidden) for name in names or {node.module})
        if isinstance(node, ast.expr):  # holds no statement
            return
        for child in ast.iter_child_nodes(node):
            defers = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.If)
            visit(child, is_hidden=is_hidden or defers)

    visit(syntax(path), is_hidden=False)
    return found


@cache
def internal() -> dict[str, list[Import]]:
    """What each module imports from this package, by dotted names below `kgcp`."""
    return {
        dotted(path): [
            Import(each.name.removeprefix("kgcp").removeprefix("."), each.is_hidden)
            for each in imports(path)
            if each.name.partition(".")[0] == "kgcp"
        ]
        for path in modules()
    }


def names(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


def test_every_module_has_its_layer() -> None:
    for path in modules():
        if dotted(path) not in {"", "io"}:
            member(dotted(path))
    assert set(LIBRARIES) == set(LEVEL)


def test_imports_point_downwards() -> None:
    upwards = []
    for own, imported in internal().items():
        if own in {"", "io"}:  # no room of its own: it imports nothing, or lazily
            assert not [each for each in imported if not each.is_hidden]
            continue
        upwards += [
            f"{own} imports {each.name}"
            for each in imported
            if each.name
            and member(each.name) != member(own)
            and LEVEL[member(each.name)] >= LEVEL[member(own)]
        ]
    assert upwards == []


def test_members_use_only_the_libraries_of_their_layer() -> None:
    strangers = []
    for path in modules():
        packages = {each.name.partition(".")[0] for each in imports(path)}
        own = dotted(path)
        allowed = frozenset() if own in {"", "io"} else LIBRARIES[member(own)]
        strange = packages - sys.stdlib_module_names - {"kgcp"} - allowed
        strangers += [f"{names(path)} imports {name}" for name in sorted(strange)]
    assert strangers == []


def test_no_layer_below_io_handles_files() -> None:
    knowing = [
        names(path)
        for path in modules()
        if dotted(path).split(".")[0] not in FILE_ROOMS
        and FILE_MODULES & {each.name.partition(".")[0] for each in imports(path)}
    ]
    assert knowing == []


def test_no_import_is_hidden() -> None:
    """Inside a function or under TYPE_CHECKING, an import would hide a dependency."""
    hidden = [
        f"{own} imports {each.name}"
        for own, imported in internal().items()
        if own.split(".", maxsplit=1)[0] not in LAZY
        for each in imported
        if each.is_hidden
    ]
    assert hidden == []


def test_no_modules_import_each_other_in_a_circle() -> None:
    state: dict[str, str] = {}
    way: list[str] = []

    def visit(module: str) -> None:
        if state.get(module) == "done":
            return
        assert state.get(module) != "open", f"circle: {way[way.index(module) :]}"
        state[module] = "open"
        way.append(module)
        for each in internal().get(module, []):
            if each.name != module and not (
                each.is_hidden and module.split(".", maxsplit=1)[0] in LAZY
            ):
                visit(each.name)
        way.pop()
        state[module] = "done"

    for module in internal():
        visit(module)


def folders() -> list[Path]:
    return sorted({path.parent for path in modules()})


def test_folders_have_few_modules() -> None:
    entries = {path.name for path in PACKAGE.iterdir() if path.suffix in {"", ".py"}}
    assert len(entries - {"__pycache__"}) <= 15
    for folder in folders():
        assert len(list(folder.glob("*.py"))) - 1 <= 20, folder.relative_to(PACKAGE)
        assert (folder / "__init__.py").exists(), folder.relative_to(PACKAGE)


def functions() -> Iterator[tuple[str, int]]:
    """Name a function by file and line, and count the lines below its signature and docstring."""
    for path in modules():
        for node in ast.walk(syntax(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                last = body[-1].end_lineno if body else None
                lines = 0 if last is None else last - body[0].lineno + 1
                yield f"{names(path)}:{node.lineno}", lines


def test_functions_and_files_are_short() -> None:
    """In the middle and mostly; a kernel with comments may be longer than that."""
    sizes = dict(functions())
    assert median(sizes.values()) <= 10
    assert quantiles(sizes.values(), n=10)[-1] <= 35
    assert {name: size for name, size in sizes.items() if size > 130} == {}
    files = [len(path.read_text(encoding="utf-8").splitlines()) for path in modules()]
    assert quantiles(files, n=10)[-1] <= 350
    assert max(files) <= 600


def test_layers_are_named_once() -> None:
    for lower, upper in pairwise(LAYERS):
        assert not set(lower) & set(upper)
