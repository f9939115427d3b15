"""The guess of a camera from EXIF."""

from __future__ import annotations

from pathlib import Path

import pytest

from kgcp.io.flight.folder import FolderContents
from kgcp.io.flight.toml_draft import DraftTable
from kgcp.pipeline.init_camera import camera_section
from kgcp.quality.checks.frame_header import FrameHeader


def guessed_fx(header: FrameHeader) -> object:
    folder = Path("nowhere")
    none: tuple[()] = ()
    contents = FolderContents(
        folder=folder,
        frames_folder=folder,
        frames=(header.frame,),
        marks=none,
        events=none,
        times=none,
        trajectories=none,
        accuracies=none,
        calibrations=none,
        targets=none,
        points=none,
        references=none,
        unknown=none,
    )
    (table,) = camera_section(contents, [header]).blocks
    assert isinstance(table, DraftTable)
    values = {key.key: key.value for key in table.keys}
    assert values.get("guessed") is (True if values["fx"] else None)
    return values["fx"]


@pytest.mark.parametrize(
    ("header", "fx"),
    [
        # a Phantom 3, 3.61 mm on pixels of 1.56 µm: 2314 px, also where 16:9 is cut out of 4:3
        (FrameHeader("a.jpg", (4000, 3000), focal_35_mm=20.0), 2314.0),
        (FrameHeader("a.jpg", (4000, 2250), focal_35_mm=20.0), 2314.0),
        (FrameHeader("a.jpg", (2250, 4000), focal_35_mm=20.0), 2314.0),
        # small format, 3:2
        (FrameHeader("a.jpg", (6000, 4000), focal_35_mm=36.0), 6000.0),
        # a Canon SX260: 4.5 mm on a sensor 6.17 mm wide
        (FrameHeader("a.jpg", (4000, 3000), focal_mm=4.5, focal_px=2904.4), 2917.0),
    ],
)
def test_guessed_focal_lengths_are_near_those_of_the_makers(header: FrameHeader, fx: float) -> None:
    assert guessed_fx(header) == pytest.approx(fx, rel=0.005)


def test_without_a_focal_length_nothing_is_guessed() -> None:
    assert guessed_fx(FrameHeader("a.jpg", (4000, 3000), focal_mm=4.5)) is None
