"""Times of EXIF: those in whole seconds are counted, and those of a times file compared."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.check import check_flight
from kgcp.pipeline.detect import RunOptions, detect_flight
from kgcp.quality.checks.doubt import Cause
from tests.flight_toml import RING_A

EXIF_IFD, DATE_TIME, OFFSET, SUBSEC = 0x8769, 0x9003, 0x9011, 0x9291
FLIGHT = f"""\
[camera]
width = 64
height = 48
fx = 90
fy = 90
cx = 31
cy = 24

{RING_A}"""


def frame(folder: Path, name: str, subsec: str, offset: str = "+02:00") -> None:
    exif = Image.Exif()
    exif.get_ifd(EXIF_IFD).update(
        {DATE_TIME: f"2026:05:04 11:30:0{name[0]}", SUBSEC: subsec, OFFSET: offset}
    )
    Image.new("L", (64, 48), 200).save(folder / "frames" / name, exif=exif.tobytes())


@pytest.mark.parametrize(
    ("subsecs", "times", "count"),
    [
        (("", ""), "", 2),
        (("000", "0"), "", 2),
        (("", "5"), "", 0),
        (("", "5"), "2.png,2026-05-04T09:30:02.5Z\n", 1),
        (("", ""), "1.png,2026-05-04T09:30:01Z\n2.png,2026-05-04T09:30:02Z\n", 0),
    ],
)
def test_only_exif_times_that_are_used_count_as_whole_seconds(
    tmp_path: Path, subsecs: tuple[str, str], times: str, count: int
) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "flight.toml").write_text(f"[frames]\nexif_fallback = true\n{FLIGHT}")
    for name, subsec in zip(("1.png", "2.png"), subsecs, strict=True):
        frame(tmp_path, name, subsec)
    if times:
        (tmp_path / "frames.csv").write_text(f"frame,time\n{times}")
    summary = detect_flight(read_flight(tmp_path), options=RunOptions(jobs=0))
    assert summary.exif_times_in_whole_seconds == count
    assert summary.frames_without_time == 0


def test_times_are_compared_with_exif_of_an_unknown_zone(tmp_path: Path) -> None:
    """As most drones write it: the differences must be the same in all frames."""
    (tmp_path / "frames").mkdir()
    (tmp_path / "flight.toml").write_text(FLIGHT)
    times = [f"{number}.png,2026-05-04T09:30:0{number}.4Z" for number in range(1, 7)]
    for line in times:
        frame(tmp_path, line.partition(",")[0], "", offset="")
    file = tmp_path / "frames.csv"
    file.write_text("\n".join(["frame,time", *times]))
    flight = read_flight(tmp_path)
    assert Cause.FRAME_ORDER not in {doubt.code for doubt in check_flight(flight).doubts}
    file.write_text("\n".join(["frame,time", *times[:-1], "6.png,2026-05-04T09:40:06.4Z"]))
    (doubt,) = (each for each in check_flight(flight).doubts if each.code is Cause.FRAME_ORDER)
    assert "the times of 1 of 6 frames, such as 6.png" in doubt.sentence
