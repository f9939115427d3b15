import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from kgcp.cli import main
from kgcp.cli.simulate import PRESET_NAMES
from kgcp.simulation.presets import PRESETS


def test_every_preset_can_be_chosen() -> None:
    assert tuple(PRESETS) == PRESET_NAMES


def test_a_flight_is_written_and_summarised(tmp_path: Path) -> None:
    out = tmp_path / "flight"
    arguments = ["simulate", str(out), "--preset", "far", "--frames", "2", "--jobs", "1", "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert (summary["preset"], summary["frames"], summary["seed"]) == ("far", 2, 1)
    assert len(list((out / "frames").iterdir())) == 2
    command = "kgcp simulate OUT --preset far --frames 2 --seed 1\n"
    assert command in (out / "README.md").read_text(encoding="utf-8")


def test_survey_errors_can_be_left_out(tmp_path: Path) -> None:
    out = tmp_path / "flight"
    arguments = ["simulate", str(out), "--frames", "1", "--jobs", "1", "--no-survey-errors"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    last = (out / "vehicle.csv").read_text(encoding="utf-8").splitlines()[-1]
    assert last.split(",")[7:] == ["0"] * 6
    assert "--no-survey-errors" in (out / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("option", [["--preset", "moon"], ["--frames", "0"], ["--seed", "-1"]])
def test_wrong_options_are_usage_errors(tmp_path: Path, option: list[str]) -> None:
    result = CliRunner().invoke(main, ["simulate", str(tmp_path / "flight"), *option])
    assert result.exit_code == 2


def test_a_used_folder_ends_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("")
    result = CliRunner().invoke(main, ["simulate", str(tmp_path), "--frames", "1", "--jobs", "1"])
    assert result.exit_code == 1
    assert "holds something already" in result.stderr
