"""Targets in visiona's configuration files, of which the first has the flips of Cucci (2016)."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.targets.layout import Ring
from kgcp.targets.validation import codes_coincide

PAPER = """\
camera = { f = 2909.0; pp = [1020.3, 1027.8]; TD = [0.0003, -0.0002]; RD = [-0.085, 0.11, 0.02]; };
target = {
    d = 0.9;                             // outer diameter
    id = 0.45;
    signalRadiusPercentage = 0.714286;
    signalStartsWith = 1.0;
    signal = [0.031884, 0.087561, 0.151329, 0.184782, 0.248551, 0.468116, 0.531884, 0.968116];
};
debug = { contours = false; };
"""
TWO = """\
targets = {
    d = 0.6; id = 0.3; signalRadiusPercentage = 0.75;
    targetModels = (
        { id = 1; signalStartsWith = -1.0; signal = [0.05, 0.11, 0.30, 0.36, 0.52, 0.58]; },
        { id = 7; signalStartsWith = 1.0; signal = [0.02, 0.22, 0.28, 0.47, 0.53, 0.96]; }
    );
};
"""
CONTRACT = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
FLIGHT = """\
[camera]
width = 2048
height = 2048
{camera}
[[target]]
name = "A"
{target}
"""
INLINE = "fx = 2909.0\nfy = 2909.0\ncx = 1020.3\ncy = 1027.8"

Read = Callable[[str, str], Ring]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    (tmp_path / "frames").mkdir()

    def read_ring(content: str, keys: str = "") -> Ring:
        (tmp_path / "sample.cfg").write_text(content, encoding="utf-8")
        target = f'file = "sample.cfg"\n{keys}'
        toml = FLIGHT.format(camera=INLINE, target=target)
        (tmp_path / "flight.toml").write_text(toml, encoding="utf-8")
        return read_flight(tmp_path).targets[0].ring

    return read_ring


def test_the_code_of_the_paper_gives_the_target_of_the_paper(read: Read) -> None:
    ring = read(PAPER, "sd_outer_diameter_m = 0.0005")
    assert ring.code_deg == pytest.approx(CONTRACT.code_deg, abs=0.001)
    assert (ring.outer_diameter_m, ring.inner_diameter_m) == (0.9, 0.45)
    assert ring.code_diameter_m == pytest.approx(CONTRACT.code_diameter_m, abs=1e-6)
    assert ring.dot_diameter_m == pytest.approx(CONTRACT.dot_diameter_m, abs=1e-6)
    assert (ring.name, ring.sd_outer_diameter_m) == ("A", 0.0005)
    assert codes_coincide(ring, CONTRACT)


def test_a_mirrored_code_is_another_target(read: Read) -> None:
    flips = [float(flip) for flip in PAPER.partition("signal = [")[2].partition("]")[0].split(",")]
    mirrored = ", ".join(f"{1.0 - flip:.6f}" for flip in reversed(flips))
    original = PAPER.partition("signal = [")[2].partition("]")[0]
    ring = read(PAPER.replace(original, mirrored), "")
    assert ring.code_deg == pytest.approx([0.0, 180.0, 282.0, 317.0], abs=0.001)
    assert not codes_coincide(ring, CONTRACT)


def test_files_may_have_several_targets(read: Read) -> None:
    first, second = read(TWO, "id = 1"), read(TWO, "id = 7\nposition_m = [1.0, 2.0, 3.0]")
    assert first.code_deg == pytest.approx([28.8, 118.8, 198.0])
    assert second.code_deg == pytest.approx([90.0, 180.0, 356.4])
    assert first.dot_diameter_m == pytest.approx(0.9 * math.sin(math.radians(0.5 * 10.8)))
    one = TWO.replace("},\n", "}\n").replace(TWO.splitlines()[4] + "\n", "")
    assert read(one, "").code_deg == first.code_deg
    at_the_seam = TWO.replace("0.52, 0.58]", "0.94, 1.0]")
    assert read(at_the_seam, "id = 1").code_deg == pytest.approx([28.8, 118.8, 349.2])
    own_circle = one.replace("id = 1;", "id = 1; signalRadiusPercentage = 0.7;")
    assert read(own_circle, "id = 1").code_diameter_m == pytest.approx(0.42)


@pytest.mark.parametrize(
    ("content", "keys", "problem"),
    [
        (PAPER, "id = 1", "has one target only, without an id; delete id from flight.toml"),
        (PAPER, "code_deg = [0, 90]", "code_deg: is given beside a file; delete one of the two"),
        (PAPER, "sd_outer_diameter_m = -1", "sd_outer_diameter_m: -1 m is out of range"),
        (PAPER.replace("0.9;", "0.4;"), "", "is not a ring with dots (inner_diameter_m: 0.45"),
        (PAPER.replace("id = 0.45;", ""), "", "target: has no 'id'; correct the file"),
        (
            PAPER.replace("0.031884, ", ""),
            "",
            "has 7 places where the colour changes; give an even",
        ),
        (PAPER.replace("0.151329", "0.0853"), "", "target: 'signal' does not ascend from 0 to 1"),
        (PAPER.replace("0.968116", "1.968116"), "", "'signal' does not ascend from 0 to 1"),
        (PAPER.replace("[0.031884", "[-0.031884"), "", "'signal' does not ascend from 0 to 1"),
        (PAPER + TWO, "id = 1", "has both a group target and a group targets; delete one of"),
        (PAPER.replace("[0.031884", "[0.042"), "", "white pieces of 23.0 to 26.6 deg; kgcp"),
        (PAPER.replace("[0.031884", "[0.02"), "", "white pieces of 18.7 to 23.0 deg; kgcp"),
        (PAPER.replace("signal = [", "signal = []; rest = ["), "", "has 0 places where the colour"),
        (PAPER, "outer_diameter_m = 0.9", "outer_diameter_m: is given beside a file"),
        (PAPER.replace("With = 1.0", "With = 0.5"), "", "'signalStartsWith' is 0.5; give 1.0 for"),
        (PAPER.replace("With = 1.0", "With = -1.0"), "", "white pieces of 12.0 to 157.0 deg; kgcp"),
        (
            PAPER.replace("target = {", "target = {{"),
            "",
            "line 2 has '{' where one of } should be, which is not",
        ),
        (PAPER.replace("target = {", "goal = {"), "", "has no group target or targets"),
        (TWO, "", "targets: has several targets: 1, 7; choose one of them with id"),
        (TWO, "id = 3", "targets: has no target 3: 1, 7; choose one of them with id"),
        (TWO.replace("id = 7", "id = 1"), "id = 1", "does not have targetModels of different ids"),
        (TWO.replace("d = 0.6;", ""), "id = 1", "targets: has no 'd'; correct the file"),
    ],
)
def test_wrong_files_are_a_one_line_error(
    read: Read, content: str, keys: str, problem: str
) -> None:
    with pytest.raises(KgcpError) as error:
        read(content, keys)
    assert problem in str(error.value)
    assert "\n" not in str(error.value)


def test_an_id_needs_a_file(read: Read, tmp_path: Path) -> None:
    read(PAPER, "")
    toml = FLIGHT.format(camera=INLINE, target="id = 1")
    (tmp_path / "flight.toml").write_text(toml, encoding="utf-8")
    with pytest.raises(KgcpError, match="id: needs a file; give file as well, or delete it"):
        read_flight(tmp_path)


def test_its_camera_is_opencvs_with_one_focal_length(read: Read, tmp_path: Path) -> None:
    read(PAPER, "")
    listed = PAPER.replace("[1020.3, 1027.8]", "(1020.3, 1027.8)")
    (tmp_path / "sample.cfg").write_text(listed, encoding="utf-8")
    toml = FLIGHT.format(camera='file = "sample.cfg"', target='file = "sample.cfg"')
    (tmp_path / "flight.toml").write_text(toml, encoding="utf-8")
    camera = read_flight(tmp_path).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (2909.0, 2909.0, 1020.3, 1027.8)
    assert (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3) == (
        *(-0.085, 0.11),
        *(0.0003, -0.0002),
        0.02,
    )
