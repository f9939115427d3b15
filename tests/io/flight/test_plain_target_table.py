"""[[target]] tables of plain targets."""

from __future__ import annotations

from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.targets.plain import PlainPolarity, PlainTarget
from tests.flight_toml import RING_A

_HEAD = f"""\
crs = "EPSG:25832"
[camera]
width = 480
height = 360
fx = 700
fy = 700
cx = 240
cy = 180
{RING_A}"""
_DISC = """\
[[target]]
name = "W"
shape = "disc"
polarity = "bright"
diameter_m = 0.3
position_m = [1.0, 2.0, 3.0]
"""


def read(folder: Path, *tables: str) -> tuple[PlainTarget, ...]:
    (folder / "frames").mkdir(exist_ok=True)
    (folder / "flight.toml").write_text("\n".join(tables), encoding="utf-8")
    return read_flight(folder).plain_targets


def test_a_disc_has_defaults(tmp_path: Path) -> None:
    assert read(tmp_path, _HEAD, _DISC) == (
        PlainTarget("W", (0.3,), PlainPolarity.BRIGHT, (1.0, 2.0, 3.0)),
    )
    assert [each.name for each in read_flight(tmp_path).all_targets] == ["A", "W"]


def test_a_flight_may_have_plain_targets_only(tmp_path: Path) -> None:
    (target,) = read(tmp_path, _HEAD.partition("[[target]]")[0], _DISC)
    assert target.name == "W"
    assert read_flight(tmp_path).targets == ()


def test_a_ring_is_read_with_every_key(tmp_path: Path) -> None:
    ring = """
[[target]]
name = "R"
shape = "ring"
polarity = "dark"
diameter_m = 0.8
inner_diameter_m = [0.6, 0.3]
sd_diameter_m = 0.001
position_m = [1, 2, 3]
sd_position_m = [0.01, 0.01, 0.02]
normal = [0, -1, 0]
level_sd_deg = 5
border_m = 0.2
thickness_m = 0.03
"""
    assert read(tmp_path, _HEAD, ring) == (
        PlainTarget(
            name="R",
            diameters_m=(0.8, 0.6, 0.3),
            polarity=PlainPolarity.DARK,
            position_m=(1.0, 2.0, 3.0),
            sd_position_m=(0.01, 0.01, 0.02),
            sd_diameter_m=0.001,
            normal_enu=(0.0, -1.0, 0.0),
            sd_normal_deg=5.0,
            border_m=0.2,
            thickness_m=0.03,
        ),
    )


@pytest.mark.parametrize(("written", "normal"), [("level", (0.0, 0.0, 1.0)), ("free", None)])
def test_a_normal_may_be_given_in_words(
    tmp_path: Path, written: str, normal: tuple[float, float, float] | None
) -> None:
    (target,) = read(tmp_path, _HEAD, f'{_DISC}normal = "{written}"\n')
    assert target.normal_enu == normal


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('name = "W"', 'name = "A"'), "name: 'A' is the name of two targets"),
        (("position_m = [1.0, 2.0, 3.0]", ""), "position_m: is missing"),
        (("diameter_m = 0.3", "diameter_m = 0.3\ninner_diameter_m = 0.1"), "is of a disc"),
        (('"disc"', '"ring"'), "inner_diameter_m: is missing"),
        (('"disc"', '"square"'), "shape: 'square' is not known"),
        (('"bright"', '"white"'), "polarity: 'white' is not known"),
        (("diameter_m = 0.3", "outer_diameter_m = 0.3"), "outer_diameter_m: is not a known key"),
        (("diameter_m = 0.3", 'diameter_m = 0.3\nnormal = "up"'), "normal: is a text"),
        (("diameter_m = 0.3", "diameter_m = nan"), "not a finite number"),
        (
            ("diameter_m = 0.3", 'diameter_m = 0.3\nnormal = "free"\nlevel_sd_deg = 5'),
            "level_sd_deg: is given of a normal that is free",
        ),
        (
            ("diameter_m = 0.3", 'diameter_m = 0.3\nnormal = "free"\nthickness_m = 0.1'),
            "thickness_m: needs a normal",
        ),
    ],
)
def test_wrong_values_are_a_one_line_error(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    with pytest.raises(KgcpError) as caught:
        read(tmp_path, _HEAD, _DISC.replace(*change))
    line = str(caught.value)
    assert message in line
    assert line.startswith(f"{tmp_path / 'flight.toml'}: [[target]] ")
    assert "; " in line
