from __future__ import annotations

import json
import math
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner, Result
from PIL import Image

from kgcp.cli import main
from tests.flight_toml import RING_A

FLIGHT = f"""
[camera]
width = 1200
height = 900
fx = 1902.0
fy = 1902.0
cx = 606.2
cy = 446.1
sd_fx = 1.0
sd_fy = 1.0
response = "linear"

{RING_A}"""


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """A folder without frames."""
    (tmp_path / "flight.toml").write_text(FLIGHT, encoding="utf-8")
    return tmp_path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["plan", *map(str, arguments)])


def test_the_table_has_a_line_per_height_and_its_conditions(flight: Path) -> None:
    result = run(flight, "--height", "200", "--height", "40", "--exposure", "0.0005")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[1].split()[:4] == ["height", "ring", "R", "found"]
    near, far = lines[3].split(), lines[4].split()
    assert near[:3] == ["40", "A", "21.4"]
    # 1 px is 40 m / 1902 on the ground, in half a millisecond
    assert near[-2:] == ["42.1", "0.379"]
    assert far[:4] == ["200", "A", "4.3", "0"]
    assert "–" in far
    assert "1 px in 0.0005 s" in result.stdout
    assert max(map(len, lines)) <= 100


def test_a_layout_that_is_hard_to_find_causes_a_warning(flight: Path) -> None:
    text = FLIGHT.replace(f"inner_diameter_m = {0.45}", "inner_diameter_m = 0.3")
    assert text != FLIGHT
    (flight / "flight.toml").write_text(text, encoding="utf-8")
    result = run(flight, "--height", "40")
    assert result.exit_code == 0
    assert result.stderr.startswith("kgcp: doubt: the inner diameter of 'A' is 0.33 times the")
    assert result.stderr.count("\n") == 1


def test_json_has_the_same_numbers(flight: Path) -> None:
    result = run(flight, "--json", "--accuracy", "0.01")
    assert result.exit_code == 0, result.output
    plan = json.loads(result.stdout)
    assert plan["conditions"]["accuracy_percent"] == 0.01
    heights = [row["height_m"] for row in plan["heights"]]
    assert heights == sorted(heights)
    assert heights[-1] == 100.0
    sd_m = [row["sd_distance_m"] for row in plan["heights"]]
    assert sd_m == sorted(sd_m)


def test_the_ground_has_a_table_of_its_own(flight: Path) -> None:
    """A pixel, the image's sides, and how often the whole target is in a frame of a pass."""
    result = run(flight, "--height", "40", "--speed", "5", "--interval", "0.5")
    rows = result.stdout.splitlines()
    head = next(i for i, line in enumerate(rows) if "GSD" in line)
    assert rows[head].split() == ["height", "GSD", "footprint", "frames", "eccentricity"]
    # 40 m / 1902 px; 1200 x 900 px; (900 px - 0.9 m) over 2.5 m per frame
    assert rows[head + 2].split() == ["40", "21.0", "25", "×", "19", "7.2", "0.104"]
    assert "at 5 m/s along the image's height, one every 0.5 s" in rows[head + 3]
    plan = json.loads(run(flight, "--height", "40", "--json").stdout)["heights"][0]
    assert plan["gsd_m"] == pytest.approx(40 / 1902)
    assert plan["footprint_m"] == pytest.approx([1200 * 40 / 1902, 900 * 40 / 1902])
    expected_px = 0.5 * plan["radius_px"] ** 2 / 1902 * math.sin(math.radians(60.0))
    assert plan["eccentricity_px"] == pytest.approx(expected_px, rel=0.05)
    assert plan["frames_per_pass"] == pytest.approx((900 * 40 / 1902 - 0.9) / 10.0)


def test_a_ring_that_reaches_behind_the_camera_has_no_eccentricity(flight: Path) -> None:
    plan = json.loads(
        run(flight, "--height", "0.1", "--json").stdout,
        parse_constant=lambda word: pytest.fail(f"{word} is not JSON"),
    )
    assert plan["heights"][0]["eccentricity_px"] is None
    assert "nan" not in run(flight, "--height", "0.1").stdout


@pytest.mark.parametrize("heights", [("50", "100"), ("10",)])
def test_the_figure_has_plain_numbers(flight: Path, heights: tuple[str, ...]) -> None:
    path = flight / "plan.svg"
    options = [word for height in heights for word in ("--height", height)]
    assert run(flight, "--plot", path, *options).exit_code == 0
    text = path.read_text(encoding="utf-8")
    assert "<!-- $" not in text, "no powers of ten"
    for words in ("footprint [m]", "size of a pixel on the ground [mm]", *heights):
        assert f"<!-- {words} -->" in text


def test_the_figure_is_drawn(flight: Path) -> None:
    path = flight / "plan.png"
    result = run(flight, "--plot", path)
    assert result.exit_code == 0, result.output
    with Image.open(path) as picture:
        assert picture.convert("L").getextrema() == (0, 255)
        assert picture.width > 1000


def test_a_long_name_with_dollars_is_drawn_whole_in_several_lines(flight: Path) -> None:
    toml = (flight / "flight.toml").read_text(encoding="utf-8")
    name = "$\\frac{$ 车顶 " + "roof " * 20  # of which the typeface lacks two letters
    assert toml.count('name = "A"') == 1
    text = toml.replace('name = "A"', f"name = '{name}'")
    (flight / "flight.toml").write_text(text, encoding="utf-8")
    path = flight / "plan.svg"
    result = run(flight, "--plot", path)
    assert result.exit_code == 0, result.output
    lines = re.findall(r"<!-- (.*(?:Target|roof).*) -->", path.read_text(encoding="utf-8"))
    assert " ".join(lines) == f"Target {name.strip()}".replace("车顶", "??")
    assert max(map(len, lines)) < 50


def test_the_same_plan_is_the_same_figure(flight: Path) -> None:
    paths = [flight / "first.svg", flight / "second.svg"]
    for path in paths:
        assert run(flight, "--plot", path).exit_code == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()
    root = ET.fromstring(paths[0].read_text(encoding="utf-8"))  # noqa: S314 - our own file
    assert len(list(root.iter("{http://www.w3.org/2000/svg}path"))) > 20


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--height", "-4"], "height: -4 m is out of range"),
        (["--blur", "-1"], "blur: -1 px is out of range"),
        (["--exposure", "0"], "exposure: 0 s is out of range"),
        (["--accuracy", "nan"], "accuracy: nan % is out of range"),
        (["--plot", "plan.pdf"], "plan.pdf is neither .png nor .svg"),
        (["--target", "B"], "'B' is not in flight.toml; give one of A"),
    ],
)
def test_impossible_inputs_are_a_one_line_error(
    flight: Path, arguments: list[str], words: str
) -> None:
    result = run(flight, *arguments)
    assert result.exit_code == 1
    assert words in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_flight_without_camera_is_reported(flight: Path) -> None:
    (flight / "flight.toml").write_text(FLIGHT.partition("[[")[2].join(["[[", ""]), "utf-8")
    result = run(flight)
    assert result.exit_code == 1
    assert "camera: is missing" in result.stderr


PLAIN = """
[[target]]
name = "ring"
shape = "ring"
polarity = "dark"
diameter_m = 0.6
inner_diameter_m = 0.3
position_m = [1.0, 2.0, 3.0]
"""


def test_a_plan_for_a_plain_target_has_its_limit_and_accuracy(flight: Path) -> None:
    text = (flight / "flight.toml").read_text(encoding="utf-8")
    (flight / "flight.toml").write_text(text + PLAIN, encoding="utf-8")
    heights = [option for height in (20, 142, 143) for option in ("--height", str(height))]
    result = CliRunner().invoke(
        main, ["plan", str(flight), "--target", "ring", "--blur", "0", "--json", *heights]
    )
    assert result.exit_code == 0, result.output
    near, far, beyond = json.loads(result.stdout)["heights"]
    # circles 2 px apart, which is a radius of 4 px, at 142.7 m
    assert 0.99 < near["found"] == far["found"]
    assert beyond["found"] == 0.0
    assert beyond["sd_distance_m"] is None
    # R = 28.5 and 4.0 px: the centre improves by R^(1/2), the distance by R^(3/2)
    assert 0.0015 < near["sd_centre_px"] < far["sd_centre_px"] < 0.006
    ratio = far["sd_distance_m"] / 142.0 / (near["sd_distance_m"] / 20.0)
    assert math.isclose(ratio, (142.0 / 20.0) ** 1.5, rel_tol=1e-6)
    shown = CliRunner().invoke(main, ["plan", str(flight), "--target", "ring"])
    assert "a radius of 4 px" in shown.output
