from __future__ import annotations

import ast
import errno
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from kgcp.errors import KgcpError
from kgcp.geometry import _jit, distortion
from kgcp.geometry.arrays import FloatArray

LENS = (-0.1, 0.05, 1e-4, -2e-4, 0.01, 0.02, 0.0, 0.0)
SCALE = (3100.0, 3110.0, 2001.0, 1498.0)
_KGCP = Path(_jit.__file__).parents[1]
_DECORATORS = {"compiled", "compiled_if_often", "reassociated", "inlined", "fused"}


def fresh_copy(module: ModuleType) -> ModuleType:
    """Import a module a second time: nothing of it is compiled."""
    spec = importlib.util.spec_from_file_location("copy", module.__file__)
    assert spec is not None
    assert spec.loader is not None
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    return copy


def there_and_back(module: ModuleType, points: FloatArray) -> tuple[FloatArray, ...]:
    pixels, back, slopes = np.empty_like(points), np.empty_like(points), np.empty((len(points), 4))
    module.distort_points(LENS, SCALE, points, pixels)
    module.undistort_points(LENS, SCALE, module.first_fold_r2(LENS), pixels, back)
    module.fill_in_jacobians(LENS, SCALE, points, slopes.reshape(-1, 2, 2))
    return pixels, back, slopes


def test_interpreted_distortion_gives_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = np.random.default_rng(1).normal(0.0, 0.5, (40, 2))
    points[:3] = (0.0, 0.0), (30.0, 40.0), (np.nan, 1.0)
    monkeypatch.setattr(_jit._CompiledIfOften, "calls_left", 0)
    compiled = there_and_back(distortion, points)
    copy = fresh_copy(distortion)
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.setattr(_jit._CompiledIfOften, "calls_left", 10_000)
    interpreted = there_and_back(copy, points)
    assert 0 < _jit._CompiledIfOften.calls_left < 10_000
    for ours, numbas in zip(interpreted, compiled, strict=True):
        np.testing.assert_array_equal(ours, numbas)
    assert np.isnan(interpreted[1]).any()


def _compiled_functions(path: Path) -> dict[str, ast.FunctionDef]:
    """Return the functions of a file that have one of the decorators of `_jit`, by their names."""
    tree = ast.parse(path.read_text("utf-8"))
    return {
        node.name: node
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and _has(node, *_DECORATORS)
    }


def _called(function: ast.FunctionDef) -> set[str]:
    return {
        node.func.id
        for node in ast.walk(function)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }


def _has(function: ast.FunctionDef, *decorators: str) -> bool:
    return any(isinstance(by, ast.Name) and by.id in decorators for by in function.decorator_list)


@pytest.fixture(scope="module")
def by_file() -> dict[Path, dict[str, ast.FunctionDef]]:
    """Return the compiled functions of every file."""
    return {path: _compiled_functions(path) for path in sorted(_KGCP.rglob("*.py"))}


def test_compiled_functions_call_compiled_ones_of_their_own_file_only(
    by_file: dict[Path, dict[str, ast.FunctionDef]],
) -> None:
    """Of another file they would go on calling an old version that they were compiled with."""
    names = {name for functions in by_file.values() for name in functions}
    assert len(names) > 50
    for path, functions in by_file.items():
        for name, function in functions.items():
            assert _called(function) & names <= functions.keys(), f"{path}: {name}"


def test_functions_with_reordered_sums_are_called_by_python_only(
    by_file: dict[Path, dict[str, ast.FunctionDef]],
) -> None:
    """Else there could be two versions, and a process would get the one that it compiled itself."""
    entries = set()
    for path, functions in by_file.items():
        loose = {name for name, each in functions.items() if _has(each, "fused", "reassociated")}
        entry = {
            name
            for name, each in functions.items()
            if _has(each, "reassociated") or (_called(each) & loose and not _has(each, "fused"))
        }
        callers = [name for name, each in functions.items() if _called(each) & entry]
        assert not callers, f"{path}: {callers} call {entry}"
        entries |= entry
    assert entries == {"render", "weighted_products"}


SMALL_MODULE = """
from kgcp.geometry._jit import compiled


@compiled
def doubled(number):
    return 2 * number
"""


def _small_module(folder: Path) -> ModuleType:
    """Import a module with one function, whose compiled code is stored below the folder."""
    file = folder / "small.py"
    if not file.exists():
        file.write_text(SMALL_MODULE, "utf-8")
    spec = importlib.util.spec_from_file_location("small", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("content", [b"", b"\0" * 600, b"\x80\x04K\x01"])
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_damaged_compiled_code_is_replaced(tmp_path: Path, suffix: str, content: bytes) -> None:
    assert _small_module(tmp_path).doubled(4) == 8
    (file,) = tmp_path.rglob(f"*.{suffix}")
    file.write_bytes(content)
    assert _small_module(tmp_path).doubled(4) == 8
    again = _small_module(tmp_path)
    again.doubled(4)
    assert sum(again.doubled.stats.cache_hits.values()) == 1


def test_folder_of_compiled_code_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(IndexDataCacheFile, "save", save)
    with pytest.raises(KgcpError, match=r"__pycache__: compiled code cannot be stored \(No space"):
        _small_module(tmp_path).doubled(4)
