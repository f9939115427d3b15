"""`kgcp check`, on the sample flight and on slips that need no measurement."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from tests.systems import share

SAMPLE = Path(__file__).resolve().parents[2] / "sample_flight"


def check(flight: Path, *options: str) -> Result:
    return CliRunner().invoke(main, ["check", str(flight), *options], catch_exceptions=False)


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """The sample flight, with its own text files."""
    folder = tmp_path / "flight"
    shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("frames", "kgcp"))
    share(SAMPLE / "frames", folder / "frames")
    return folder


def change(flight: Path, name: str, old: str, new: str) -> None:
    text = (flight / name).read_text(encoding="utf-8")
    assert old in text
    (flight / name).write_text(text.replace(old, new), encoding="utf-8")


def test_the_page_of_a_correct_flight(flight: Path) -> None:
    result = check(flight)
    assert result.exit_code == 0
    assert result.stderr == ""
    page = " ".join(result.stdout.split())
    for words in (
        "frames 24 in frames/, 1200 x 900 px",
        "24 of 24 frames, from frames.csv: 2026-06-16 08:15:05 to 08:15:39 UTC",
        "891 epochs, 20 Hz",
        "24 of 24 frames with a time lie within the trajectory",
        "48.1509° N 11.5491° E; EPSG:25832 is for: Europe between 6°E and 12°E",
        "0.80 m behind, 0.15 m to the right, 1.95 m above",
        "0.5° from the course while driving",
        "24 of 24 frames have a pose, σ 0.4/0.4/0.4 cm",
        "A in 21 frames, 9.4 … 94.8 m away, radius 91 … 9 px",
        "nothing is in doubt",
    ):
        assert words in page
    assert max(map(len, result.stdout.splitlines())) <= 100
    assert not (flight / "kgcp").exists()
    stored = CliRunner().invoke(main, ["check", f"file://{flight}"], catch_exceptions=False)
    assert stored.stdout == result.stdout


def test_the_worst_of_uneven_deviations_is_named(flight: Path) -> None:
    """GNSS without ambiguities for a second, and a receiver without corrections."""
    text = (flight / "vehicle.csv").read_text(encoding="utf-8")
    header, *lines = text.splitlines()
    cells = [line.split(",") for line in lines]
    for row in cells[200:220]:
        row[7:10] = ["0.8", "0.8", "1.5"]
    (flight / "vehicle.csv").write_text("\n".join([header, *map(",".join, cells)]) + "\n")
    assert "σ 1/1/1.8 cm, at worst 150 cm" in " ".join(check(flight).stdout.split())
    for row in cells:
        row[7:10] = ["1.2", "1.2", "2.5"]
    (flight / "vehicle.csv").write_text("\n".join([header, *map(",".join, cells)]) + "\n")
    assert "σ 120/120/250 cm\n" in check(flight).stdout.replace("\n              ", " ")


def test_what_a_flight_lacks_is_on_the_page(flight: Path) -> None:
    """Standard deviations, and, for a plain target, what would predict its place."""
    change(flight, "flight.toml", "[frames]\n", "[frames]\nexif_fallback = true\n")
    lines = (flight / "reference.csv").read_text(encoding="utf-8").splitlines()
    poses = [",".join(line.split(",")[:7]) for line in lines]
    (flight / "reference.csv").write_text("\n".join(poses), encoding="utf-8")
    page = " ".join(check(flight).stdout.split())
    assert "24 of 24 frames, from frames.csv or EXIF: " in page
    assert "24 of 24 frames have a pose, no standard deviations" in page
    text = (flight / "flight.toml").read_text(encoding="utf-8")
    plain = ('name = "P"', 'shape = "disc"', 'polarity = "dark"', "diameter_m = 0.4")
    place = "position_m = [689590.0, 5336240.0, 545.0]"
    lines = [text.partition("[[target]]")[0], "[[target]]", *plain, place]
    (flight / "flight.toml").write_text("\n".join(lines), encoding="utf-8")
    page = " ".join(check(flight).stdout.split())
    assert "(3 px) if [reference] poses, coded targets or marks (--places) predict its" in page


def test_json_has_facts_and_doubts(flight: Path) -> None:
    change(flight, "flight.toml", "fx = 1903.0", "fx = 8.8")
    result = check(flight, "--json")
    assert result.exit_code == 1
    page = json.loads(result.stdout)
    assert page["name"] == "sample"
    assert page["facts"]["frames"] == "24 in frames/, 1200 x 900 px"
    (doubt,) = page["doubts"]
    assert doubt["code"] == "focal_length"
    assert doubt["severity"] == "grave"
    assert doubt["figures"] == {"fx_px": 8.8, "fy_px": 1901.0}
    assert doubt["remedy"].startswith("divide the focal length in mm")


def _exchange_columns(flight: Path) -> None:
    lines = (flight / "vehicle.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines[1:]]
    swapped = [",".join([row[0], row[2], row[1], *row[3:]]) for row in rows]
    (flight / "vehicle.csv").write_text("\n".join([lines[0], *swapped]), encoding="utf-8")


@pytest.mark.parametrize(
    ("slip", "words", "code"),
    [
        (_exchange_columns, "with x and y exchanged it fits", 1),
        (
            lambda flight: change(flight, "frames.csv", "T08:", "T10:"),
            "2 h earlier, all would lie inside",
            1,
        ),
        (
            lambda flight: change(flight, "vehicle.csv", "time,", "when,"),
            "vehicle.csv, line 1: lacks the columns time",
            1,
        ),
        (
            lambda flight: change(flight, "flight.toml", "-1.95", "1.95"),
            "1.95 m below the trajectory point",
            0,
        ),
        (
            lambda flight: (flight / "reference.csv").unlink(),
            "reference.csv: does not exist; [reference] poses names it",
            0,
        ),
    ],
)
def test_a_slip_is_named_with_its_remedy(
    flight: Path, slip: Callable[[Path], object], words: str, code: int
) -> None:
    slip(flight)
    result = check(flight)
    assert words in " ".join(result.stdout.split())
    assert " → " in result.stdout
    assert result.exit_code == code


@pytest.mark.parametrize("text", ["", "frame;time\n", "frame,time\nframe_0000.jpg,8:15\n"])
def test_a_times_file_that_cannot_be_read_is_all_that_is_said(flight: Path, text: str) -> None:
    (flight / "frames.csv").write_text(text, encoding="utf-8")
    (doubt,) = json.loads(check(flight, "--json").stdout)["doubts"]
    assert doubt["code"] == "unreadable"
    result = CliRunner().invoke(main, ["detect", str(flight)], catch_exceptions=False)
    assert result.exit_code == 1
    assert "have no time" not in result.stderr


def test_detect_prints_the_doubts_before_it_measures(flight: Path, tmp_path: Path) -> None:
    (flight / "frames").rename(tmp_path / "all frames")
    (flight / "frames").mkdir()
    shutil.copy(SAMPLE / "frames" / "frame_0015.jpg", flight / "frames")
    change(flight, "flight.toml", "-1.95", "1.95")
    arguments = ["detect", str(flight), "--jobs", "0", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "kgcp: doubt: the lever arm puts the target 1.95 m below" in result.stderr


def test_an_unusable_flight_is_a_known_error(tmp_path: Path) -> None:
    result = check(tmp_path)
    assert result.exit_code == 1
    assert result.stderr.startswith("kgcp: error: ")
    assert result.stdout == ""
