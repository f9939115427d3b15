"""Pictures of what was considered: readable without looking, as far as that can be tested."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from kgcp.errors import KgcpError, Reason
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.measurement.frame import Examination
from kgcp.measurement.guided import Expectation
from kgcp.measurement.records import Considered, Miss
from kgcp.report.debug_picture import write_debug_picture

GREY = np.full((900, 2000), 90, dtype=np.uint8)
MISS = Miss("A", Reason.OTHER_CODE, "ring at (500, 400), a dot off by 0.9 of 0.45", 0.8, 2)
CANDIDATES = (
    Considered("A", "A", Ellipse(500.0, 400.0, 6.0, 5.0, 0.3), 0.8, is_match=False,
               reason=Reason.OTHER_CODE, detail="a dot off by 0.9 of 0.45"),
    Considered("A", "A-inner", Ellipse(1500.0, 800.0, 200.0, 180.0, 0.3), 0.4, is_match=False,
               reason=Reason.CODE_MISMATCH),
)  # fmt: skip


def picture(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.int16]]:
    read = cv2.imread(str(path))
    assert read is not None
    return read.astype(np.int16)


def coloured(image: np.ndarray[tuple[int, ...], np.dtype[np.int16]]) -> bool:
    return bool(np.any(np.ptp(image, axis=2) > 100))


def test_rings_are_marked_enlarged_and_explained(tmp_path: Path) -> None:
    write_debug_picture(tmp_path, "east/a.png", GREY, Examination((MISS,), CANDIDATES))
    drawn = picture(tmp_path / "east" / "a.png.jpg")
    height, width = drawn.shape[:2]
    assert width == 1600
    assert height > 720 + 200, "frame, enlargements and text"
    around = drawn[320 - 25 : 320 + 25, 400 - 25 : 400 + 25]
    assert coloured(around), "a ring too small to be seen is circled"
    assert not coloured(drawn[:200, :300])
    text = drawn[-60:]
    assert text.max() == 255
    assert text.min() < 80


def test_what_was_expected_is_drawn_and_the_first_picture_stays(tmp_path: Path) -> None:
    expected = {"A": Expectation(np.array([1000.0, 450.0]), 2.0, 12.0, 0.04, "its neighbours")}
    write_debug_picture(tmp_path, "a.png", GREY, Examination((MISS,), ()))
    write_debug_picture(tmp_path, "a.png", GREY, Examination((MISS,), ()), expected)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png.guided.jpg", "a.png.jpg"]
    first, second = (picture(tmp_path / f"a.png{end}") for end in (".jpg", ".guided.jpg"))
    assert not coloured(first)
    assert coloured(second[330:390, 770:830])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(60, 80), (3000, 100)])
def test_frames_of_any_size_and_depth_can_be_drawn(
    tmp_path: Path, shape: tuple[int, int], dtype: type
) -> None:
    grey: GreyArray = np.zeros(shape, dtype=dtype)
    write_debug_picture(tmp_path, "a.png", grey, Examination((MISS,), CANDIDATES * 20))
    assert picture(tmp_path / "a.png.jpg").shape[1] == 1600


def test_the_same_frame_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_debug_picture(tmp_path / name, "x.png", GREY, Examination((MISS,), CANDIDATES))
    first, second = ((tmp_path / name / "x.png.jpg").read_bytes() for name in ("a", "b"))
    assert first == second


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(KgcpError, match="cannot be written"):
        write_debug_picture(tmp_path / "file", "a.png", GREY, Examination((MISS,), ()))
