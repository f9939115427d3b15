"""Wrong settings for the sample flight's rendered frames, and the advice of export-gcp."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner

from kgcp.cli import main
from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.detect import RunOptions, detect_flight

SAMPLE = Path(__file__).resolve().parents[2] / "sample_flight"
Corrections = dict[str, dict[str, float | bool | None]]


def corrections(flight: Path, old: str, new: str) -> tuple[Corrections, list[str]]:
    """Export with other words in flight.toml; return the corrections by name, and the advice."""
    toml = flight / "flight.toml"
    right = toml.read_text(encoding="utf-8")
    assert right.count(old) == 1
    toml.write_text(right.replace(old, new), encoding="utf-8")
    try:
        if "readout_s" in new:  # part of what is measured
            detect_flight(read_flight(flight), options=RunOptions(jobs=0))
        result = CliRunner().invoke(main, ["export-gcp", str(flight), "--format", "csv", "--json"])
    finally:
        toml.write_text(right, encoding="utf-8")
    assert result.exit_code == 0, result.output
    found = json.loads((flight / "kgcp" / "consistency.json").read_text(encoding="utf-8"))
    by_name = {one["name"]: one for one in found["corrections"]}
    return by_name, json.loads(result.stdout)["advice"]


@dataclass(frozen=True)
class Injection:
    """Text of flight.toml, its replacement, and the expected name of the error."""

    old: str
    new: str
    name: str
    missing: float
    key: str
    sd_simulated: float


INJECTIONS = (
    Injection(
        "[vehicle]\n",
        "[vehicle]\ntime_offset_s = -0.025\n",
        "time_offset_s",
        0.025,
        "[vehicle] time_offset_s",
        0.001,
    ),
    Injection(
        "[-0.8, 0.15, -1.95]",
        "[-0.8, 0.07, -1.95]",
        "lever_arm_right_m",
        0.08,
        "[vehicle] lever_arm_m[1]",
        0.003,
    ),
    Injection(
        "[camera]\n",
        # in no two frames is this camera near the same place: its motion is what is stated here
        "[camera]\nreadout_s = 0.03\nmotion_sd_deg_s = 0.1\n",
        "readout_s",
        -0.03,
        "[camera] readout_s",
        0.0,
    ),
)


def test_errors_in_flight_toml_are_named_with_their_amount(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    shutil.copytree(SAMPLE, flight, ignore=shutil.ignore_patterns("kgcp"))
    detect_flight(read_flight(flight), options=RunOptions(jobs=0))
    before, no_advice = corrections(flight, "[vehicle]\n", "[vehicle]\n")
    assert no_advice == []
    for one in INJECTIONS:
        after, (line,) = corrections(flight, one.old, one.new)
        assert one.key in line
        value, sd = after[one.name]["value"], after[one.name]["sd"]
        assert isinstance(value, float)
        assert isinstance(sd, float)
        assert abs(value - one.missing) < 3.0 * (sd**2 + one.sd_simulated**2) ** 0.5
        assert sd < 0.1 * abs(one.missing)
        already = before[one.name]["value"]  # by the errors that the flight was simulated with
        assert isinstance(already, float)
        assert abs(value - already - one.missing) < sd
        assert [name for name, found in after.items() if found["is_significant"]] == [one.name]
