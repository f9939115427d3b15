"""Every fault in a file of manual marks is a one-line error with a remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera
from kgcp.io.formats.marks import read_marks

CAMERA = Camera(480, 360, 700.0, 700.0, 240.0, 180.0)
HEADER = "frame,target,x_px,y_px,sd_px\n"
SOUND = "a/f.png,A,0,359,3\na/f.png,B,479,0,0.5\n"


def read(path: Path, text: str) -> object:
    path.write_text(text, encoding="utf-8")
    return read_marks(path, {"a/f.png", "b/f.png"}, {"A", "B"}, CAMERA)


def test_frames_may_be_named_with_backslashes(tmp_path: Path) -> None:
    marks = read(tmp_path / "m.csv", HEADER + SOUND)
    assert read(tmp_path / "m.csv", HEADER + SOUND.replace("a/f.png", ".\\a\\f.png")) == marks


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ("", "marks no target"),
        ("a/f.png,A,1,1,3\n", "has one mark"),
        (SOUND + "b/f.png,A,1,1,3\nb/f.png,B,1,1,3\n", "two marks at one place"),
        (SOUND + ".\\a\\f.png,A,7,7,3\n", "line 4: 'A' is marked twice"),
        (SOUND + "f.png,A,1,1,3\n", "line 4: 'f.png' is not a frame"),
        (SOUND + "b/f.png,C,1,1,3\n", "line 4: 'C' is not a static target"),
        (SOUND + "b/f.png,A,480,1,3\n", r"line 4: \(480, 1\) is outside the frame"),
        (SOUND + "b/f.png,A,1,-0.1,3\n", "line 4: .* is outside the frame"),
        (SOUND + "b/f.png,A,1,nan,3\n", "line 4: y_px is 'nan'"),
        (SOUND + "b/f.png,A,1,1,0\n", "line 4: sd_px is 0; give .* of 0.001 or more"),
        (SOUND + "b/f.png,A,1,1,1e-300\n", "line 4: sd_px is 1e-300; give .* of 0.001 or more"),
    ],
)
def test_wrong_marks_are_a_one_line_error(tmp_path: Path, rows: str, problem: str) -> None:
    with pytest.raises(KgcpError, match=problem) as caught:
        read(tmp_path / "m.csv", HEADER + rows)
    assert "\n" not in str(caught.value)
