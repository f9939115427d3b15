"""Wrong settings for the sample flight's rendered frames, and what export-gcp says about them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from kgcp.cli import main
from kgcp.io.flight import read_flight
from kgcp.settings import DetectSettings
from kgcp.survey import detect_flight

SAMPLE = Path(__file__).resolve().parents[1] / "sample_flight"
Corrections = dict[str, dict[str, float | bool | None]]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample") / "flight"
    shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("kgcp"))
    detect_flight(read_flight(folder), DetectSettings(), folder / "kgcp", jobs=0)
    return folder


def corrections(flight: Path, old: str, new: str) -> tuple[Corrections, list[str]]:
    """Export with other words in flight.toml; return the corrections by name, and the advice."""
    toml = flight / "flight.toml"
    right = toml.read_text(encoding="utf-8")
    assert right.count(old) == 1
    toml.write_text(right.replace(old, new), encoding="utf-8")
    try:
        result = CliRunner().invoke(main, ["export-gcp", str(flight), "--format", "csv", "--json"])
    finally:
        toml.write_text(right, encoding="utf-8")
    assert result.exit_code == 0, result.output
    found = json.loads((flight / "kgcp" / "consistency.json").read_text(encoding="utf-8"))
    by_name = {one["name"]: one for one in found["corrections"]}
    return by_name, json.loads(result.stdout)["advice"]


@pytest.mark.parametrize(
    ("old", "new", "name", "missing", "key", "sd_simulated"),
    [
        (
            "[vehicle]\n",
            "[vehicle]\ntime_offset_s = -0.025\n",
            "time_offset_s",
            0.025,
            "[vehicle] time_offset_s",
            0.001,
        ),
        (
            "[-0.8, 0.15, -1.95]",
            "[-0.8, 0.07, -1.95]",
            "lever_arm_right_m",
            0.08,
            "[vehicle] lever_arm_m[1]",
            0.003,
        ),
        ("[camera]\n", "[camera]\nreadout_s = 0.03\n", "readout_s", -0.03, "[camera] readout_s", 0),
    ],
)
def test_what_is_wrong_in_flight_toml_is_named_with_its_amount(
    flight: Path, old: str, new: str, name: str, missing: float, key: str, sd_simulated: float
) -> None:
    before, no_advice = corrections(flight, "[vehicle]\n", "[vehicle]\n")
    assert no_advice == []
    after, (line,) = corrections(flight, old, new)
    assert key in line
    value, sd = after[name]["value"], after[name]["sd"]
    assert isinstance(value, float)
    assert isinstance(sd, float)
    assert abs(value - missing) < 3.0 * (sd**2 + sd_simulated**2) ** 0.5
    assert sd < 0.1 * abs(missing)
    already = before[name]["value"]  # by the errors that the flight was simulated with
    assert isinstance(already, float)
    assert abs(value - already - missing) < sd
    assert [other for other, one in after.items() if one["is_significant"]] == [name]
