"""One camera that files of several formats describe, and helpers of its tests."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera

SILENT = (None, None)
WIDTH, HEIGHT = 1600, 1100
K1, K2, K3, P1, P2 = -0.061, 0.043, -0.009, 0.0007, -0.0011

Project = Callable[[FloatArray], FloatArray]
Check = Callable[[Camera, Project], None]
Brown = Callable[..., FloatArray]


def write(folder: Path, name: str, content: object) -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")
    return path
