"""The sample flight, measured once per session. Tests change copies of it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main

SAMPLE = Path(__file__).resolve().parents[2] / "sample_flight"
FRAMES = tuple(f"frame_{number:04d}.jpg" for number in (0, 2, 6, 11, 15))


@dataclass(frozen=True)
class SampleFlight:
    """A copy of the sample flight with few frames."""

    path: Path

    @property
    def out(self) -> Path:
        return self.path / "kgcp"

    def edit(self, *changes: tuple[str, str], name: str = "flight.toml") -> None:
        """Replace pieces of a file, each of which it has exactly once."""
        file = self.path / name
        text = file.read_text(encoding="utf-8")
        for old, new in changes:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        file.write_text(text, encoding="utf-8")

    def run(self, command: str, *options: str) -> Result:
        return CliRunner().invoke(main, [command, str(self.path), *options], catch_exceptions=False)

    def fails(self, command: str, *options: str) -> str:
        """Return the one line of error that a command ends with."""
        result = self.run(command, *options)
        assert result.exit_code == 1, result.output
        assert result.stderr.count("kgcp: error: ") == 1, result.stderr
        line = result.stderr.splitlines()[-1]
        assert line.startswith("kgcp: error: ")
        assert "; " in line, "the remedy follows a semicolon"
        return line


def copied_sample(folder: Path) -> SampleFlight:
    """Copy the sample flight with the frames above, and without results."""
    (folder / "frames").mkdir(parents=True)
    for name in ("flight.toml", "vehicle.csv", "reference.csv"):
        shutil.copy(SAMPLE / name, folder)
    head, *lines = (SAMPLE / "frames.csv").read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if line.startswith(FRAMES)]
    (folder / "frames.csv").write_text("\n".join([head, *kept, ""]), encoding="utf-8")
    for name in FRAMES:
        shutil.copy(SAMPLE / "frames" / name, folder / "frames")
    return SampleFlight(folder)


@pytest.fixture(scope="session")
def measured_sample(tmp_path_factory: pytest.TempPathFactory) -> SampleFlight:
    """The flight after `kgcp detect`; nobody changes it."""
    flight = copied_sample(tmp_path_factory.mktemp("measured") / "sample")
    assert flight.run("detect", "--jobs", "0").exit_code == 0
    return flight


@pytest.fixture
def unmeasured(tmp_path: Path) -> SampleFlight:
    """A copy of the flight before `kgcp detect`."""
    return copied_sample(tmp_path / "sample")


@pytest.fixture
def measured(measured_sample: SampleFlight, tmp_path: Path) -> SampleFlight:
    """A copy of the flight after `kgcp detect`."""
    return SampleFlight(shutil.copytree(measured_sample.path, tmp_path / "sample"))
