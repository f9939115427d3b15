"""Every transformer is created with x = easting or longitude first."""

from __future__ import annotations

import ast
from pathlib import Path

import kgcp

_MAKERS = {"Transformer.from_crs", "TransformerGroup"}


def _transformers(path: Path) -> list[ast.Call]:
    calls = [
        node
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
    ]
    return [call for call in calls if ast.unparse(call.func) in _MAKERS]


def test_every_transformer_has_x_first() -> None:
    modules = [*Path(kgcp.__file__).parent.rglob("*.py")]
    found = [(path.name, call) for path in modules for call in _transformers(path)]
    assert len(found) >= 3  # the search finds them
    for name, call in found:
        keywords = {one.arg: ast.unparse(one.value) for one in call.keywords}
        assert keywords.get("always_xy") == "True", f"{name}, line {call.lineno}"
