import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from PIL import Image

from kgcp.cli import main
from kgcp.cli.simulate import PRESET_NAMES
from kgcp.geometry.camera import Camera, Response
from kgcp.io.flight.flight import read_flight
from kgcp.simulation.effects import Effects, with_effects
from kgcp.simulation.presets import PRESETS, preset


@pytest.fixture
def _small_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let all presets have frames of a tenth of their pixels, as rendering takes most time."""
    for name, settings in list(PRESETS.items()):
        camera = replace(
            settings.camera, width=512, height=384, fx=738.0, fy=736.6, cx=253.3, cy=192.9
        )
        monkeypatch.setitem(PRESETS, name, replace(settings, camera=camera))


def test_every_preset_can_be_chosen() -> None:
    assert tuple(PRESETS) == PRESET_NAMES


@pytest.mark.usefixtures("_small_frames")
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


@pytest.mark.usefixtures("_small_frames")
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


def test_a_reversed_range_is_a_one_line_error(tmp_path: Path) -> None:
    arguments = ["simulate", str(tmp_path / "flight"), "--gain", "2", "1", "--frames", "1"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1
    assert "gain: 1 is out of range" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "flight").exists()


def test_a_folder_with_content_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("")
    result = CliRunner().invoke(main, ["simulate", str(tmp_path), "--frames", "1", "--jobs", "1"])
    assert result.exit_code == 1
    assert "is not empty" in result.stderr


def test_the_current_folder_is_refused_before_anything_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, ["simulate", ".", "--frames", "1", "--jobs", "1"])
    assert result.exit_code == 1
    assert "is the current folder; choose a new folder" in result.stderr
    assert tmp_path.exists()


EFFECTS: dict[str, Any] = {
    "gain": (1.2, 2.0),
    "shadow": 0.6,
    "stripes": 2,
    "dirt": 0.03,
    "stains": 4,
    "glare": 0.3,
    "astigmatism": 1.4,
    "defocus": 1.5,
    "coma": 0.1,
    "sharpening": (0.5, 2.0),
    "phone": True,
    "rolling": 0.02,
    "motion": (30.0, -40.0),
}


@pytest.mark.parametrize("name", PRESET_NAMES)
@pytest.mark.parametrize("effect", EFFECTS)
def test_every_effect_can_be_added_to_every_preset(name: str, effect: str) -> None:
    before = Effects.of(preset(name))
    if effect == "coma":
        before = replace(before, astigmatism=1.0)
    if effect == "phone" and not before.phone:  # it sharpens in its own way
        before = replace(before, sharpening=Effects.of(preset("phone")).sharpening)
    wanted = replace(before, **{effect: EFFECTS[effect]})
    assert Effects.of(with_effects(preset(name), wanted)) == wanted
    assert with_effects(preset(name), Effects.of(preset(name))) == preset(name)


def test_a_camera_that_sharpens_is_not_stated_to_be_linear() -> None:
    settings = preset("clean")
    assert settings.camera.response is Response.LINEAR
    sharpened = with_effects(settings, replace(Effects.of(settings), sharpening=(0.5, 2.0)))
    assert sharpened.camera.response is Response.UNKNOWN


@pytest.mark.usefixtures("_small_frames")
def test_options_of_effects_reach_the_flight_and_its_readme(tmp_path: Path) -> None:
    out = tmp_path / "flight"
    options = [
        *("--gain", "1.2", "2", "--shadow", "0.6", "--stripes", "2"),
        *("--dirt", "0.03", "--stains", "4"),
        *("--glare", "0.3", "--astigmatism", "1.4", "--coma", "0.1"),
        *("--defocus", "1.5", "--sharpening", "0.7", "2", "--phone"),
        *("--rolling", "0.02", "--motion", "30", "-40"),
    ]
    only = ["--preset", "sample", "--frames", "1"]
    arguments = ["simulate", str(out), *only, "--jobs", "1", *options]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    command = f"kgcp simulate OUT --preset sample --frames 1 --seed 1 {' '.join(options)}\n"
    assert command in (out / "README.md").read_text(encoding="utf-8")
    camera = read_flight(out).camera
    assert camera.readout_s == 0.02
    assert camera.response is Response.UNKNOWN
    with Image.open(out / "frames" / "frame_0000.jpg") as frame:
        assert frame.mode == "RGB"


@pytest.mark.usefixtures("_small_frames")
@pytest.mark.parametrize(
    "options", ["--phone", "--sharpening 0 1 --phone", "--sharpening 0.8 1.2 --no-phone"]
)
def test_sharpening_is_the_phones_unless_it_is_given(tmp_path: Path, options: str) -> None:
    """The README's command makes the same flight, also with the settings of its preset."""
    name = "phone" if "--no-phone" in options else "clean"
    out = tmp_path / "flight"
    arguments = ["--preset", name, "--frames", "1", "--jobs", "1", *options.split()]
    assert CliRunner().invoke(main, ["simulate", str(out), *arguments]).exit_code == 0
    kept = options.replace("--sharpening 0.8 1.2 ", "")  # the preset's own
    command = f"kgcp simulate OUT --preset {name} --frames 1 --seed 1 {kept}\n"
    assert command in (out / "README.md").read_text(encoding="utf-8")


def test_too_much_coma_is_a_one_line_error(tmp_path: Path) -> None:
    out = str(tmp_path / "flight")
    result = CliRunner().invoke(main, ["simulate", out, "--preset", "lens", "--coma", "0.4"])
    assert result.exit_code == 1
    assert "give at most 0.24" in result.stderr


def test_photographs_of_a_field_are_written_and_summarised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = Camera(240, 180, 250.0, 250.0, 120.0, 90.0)
    monkeypatch.setitem(PRESETS, "sample", replace(preset("sample"), camera=camera))
    out = tmp_path / "session"
    options = ["--field", "grid:3x2:25mm:12mm", "--preset", "sample", "--frames", "1", "--json"]
    result = CliRunner().invoke(main, ["simulate", str(out), *options, "--jobs", "1"])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert (summary["photographs"], summary["discs"], summary["seed"]) == (1, 6, 1)
    assert [path.name for path in (out / "photos").iterdir()] == ["photo_0000.jpg"]
    command = "kgcp simulate OUT --field field.toml --preset sample --frames 1 --seed 1\n"
    assert command in (out / "README.md").read_text(encoding="utf-8")


def test_lists_of_points_take_a_unit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(240, 180, 250.0, 250.0, 120.0, 90.0)
    monkeypatch.setitem(PRESETS, "sample", replace(preset("sample"), camera=camera))
    path, out = tmp_path / "points.txt", tmp_path / "session"
    path.write_text("".join(f"P{i} {50 * (i % 3)} {40 * (i // 3)} 0\n" for i in range(6)))
    only = ["--preset", "sample", "--frames", "1", "--jobs", "1"]
    arguments = ["simulate", str(out), "--field", str(path), *only]
    assert CliRunner().invoke(main, arguments).stderr.endswith("(--unit)\n")
    result = CliRunner().invoke(main, [*arguments, "--unit", "mm"])
    assert result.exit_code == 0, result.output
    assert "position_m = [0.05, 0.04, 0.0]" in (out / "field.toml").read_text(encoding="utf-8")
    without = CliRunner().invoke(main, ["simulate", str(tmp_path / "flight"), "--unit", "mm"])
    assert without.exit_code == 2


@pytest.mark.parametrize(
    ("options", "words", "code"),
    [
        ("--motion 30 -40", "--motion acts while rows are exposed; give --rolling, too", 2),
        ("--preset rolling --rolling 0 --motion 30 -40", "give --rolling, too", 2),
        ("--rolling 0.02 --motion nan 1", "--motion: nan px/s is out of range", 1),
    ],
)
def test_motion_without_a_rolling_shutter_or_out_of_range_is_refused(
    tmp_path: Path, options: str, words: str, code: int
) -> None:
    result = CliRunner().invoke(main, ["simulate", str(tmp_path / "a"), *options.split()])
    assert result.exit_code == code
    assert words in result.stderr
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("options", "words", "code"),
    [
        (["--no-survey-errors"], "--no-survey-errors concerns flights; leave it out", 2),
        (["--shadow", "0.5"], "without shadows; leave out the option that adds this\n", 1),
        (["--preset", "shadow"], "'shadow' has shadows, which photographs of a field cannot", 1),
        (["--rolling", "0.02"], "simulated without a rolling shutter", 1),
        (["--motion", "30", "-40"], "simulated without motion of the image", 1),
    ],
)
def test_options_of_flights_are_refused_with_a_field_in_one_line(
    tmp_path: Path, options: list[str], words: str, code: int
) -> None:
    arguments = ["simulate", str(tmp_path / "a"), "--field", "grid:3x2:25mm:12mm", *options]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == code
    assert words in result.stderr
