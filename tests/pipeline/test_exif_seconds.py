"""Times in whole seconds, which are too coarse to place targets, are counted."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.detect import RunOptions, detect_flight
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


def frame(folder: Path, name: str, subsec: str) -> None:
    exif = Image.Exif()
    exif.get_ifd(EXIF_IFD).update(
        {DATE_TIME: f"2026:05:04 11:30:0{name[0]}", SUBSEC: subsec, OFFSET: "+02:00"}
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
