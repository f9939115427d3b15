from __future__ import annotations

import subprocess
import sys
import tomllib
from importlib.metadata import metadata, version
from pathlib import Path

import kgcp

ROOT = Path(__file__).resolve().parents[1]


def test_the_version_has_one_source() -> None:
    assert version("kgcp") == kgcp.__version__


def test_the_changelog_describes_this_version() -> None:
    assert f"\n## {kgcp.__version__} " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_metadata_states_licence_and_python() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    installed = metadata("kgcp")
    assert installed["License-Expression"] == project["license"] == "BSD-3-Clause"
    assert installed["Requires-Python"] == project["requires-python"]
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").startswith("BSD 3-Clause License")


def test_importing_the_package_imports_the_standard_library_alone() -> None:
    program = (
        "import sys; before = set(sys.modules); import kgcp; print(*(set(sys.modules) - before))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    imported = set(done.stdout.split())
    assert {name for name in imported if name.partition(".")[0] == "kgcp"} == {"kgcp"}
    assert {name.partition(".")[0] for name in imported} <= sys.stdlib_module_names | {"kgcp"}
