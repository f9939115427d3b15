"""Pictures of rings: contours where they belong, residuals in their colours."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.measurement.adjustment.residual_image import ResidualImage
from kgcp.report.ring_picture import FULL_SCALE, PICTURE_PX, THUMBNAIL_PX, RingView, draw_ring

TURN = np.linspace(0.0, 2.0 * np.pi, 97)
CENTRE = np.array([83.3, 41.8])
RADIUS = 20.0

_Picture = np.ndarray[tuple[int, ...], np.dtype[np.int16]]


def frame(dtype: type = np.uint8) -> GreyArray:
    grey: GreyArray = np.full((90, 160), 100, dtype=dtype)
    grey[::2] = 140
    return grey


def circle(radius: float) -> FloatArray:
    return CENTRE + radius * np.column_stack((np.cos(TURN), np.sin(TURN)))


def decoded(content: bytes) -> _Picture:
    read = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    return read.astype(np.int16)


def residuals(value: float) -> ResidualImage:
    """A patch of 31 pixels around the centre, all alike."""
    x, y = np.rint(CENTRE).astype(int).tolist()
    return ResidualImage(x - 15, y - 15, np.full((31, 31), value), 0.01)


def test_contours_lie_where_they_were_fitted() -> None:
    view = RingView(CENTRE, RADIUS, (circle(RADIUS),), residuals(0.0))
    seen = decoded(draw_ring(frame(), view).picture)
    assert seen.shape == (PICTURE_PX, 2 * PICTURE_PX, 3)
    left = seen[:, :PICTURE_PX]
    blue = left[:, :, 0] - left[:, :, 2]
    side = 2 * 28 + 1  # 1.4 radii either way, and the centre's own pixel
    scale = PICTURE_PX / side
    at = scale * (CENTRE - np.rint(CENTRE) + 28 + 0.5) - 0.5
    rows, columns = np.nonzero(blue > 60)
    distance = np.hypot(columns - at[0], rows - at[1]) / scale
    assert len(rows) > 500
    assert np.median(distance) == pytest.approx(RADIUS, abs=0.15)
    assert np.abs(distance - RADIUS).max() < 0.6


@pytest.mark.parametrize(
    ("value", "colour"),
    [
        (FULL_SCALE, (0, 94, 213)),  # vermilion: the model is brighter
        (-FULL_SCALE, (178, 114, 0)),  # blue: the frame is
        (0.0, (255, 255, 255)),
        (-9.0, (178, 114, 0)),
        (np.nan, (226, 226, 226)),
    ],
)
def test_residuals_have_their_colours(value: float, colour: tuple[int, int, int]) -> None:
    view = RingView(CENTRE, RADIUS, (), residuals(value))
    pictures = draw_ring(frame(), view)
    for content, size in ((pictures.picture, PICTURE_PX), (pictures.thumbnail, THUMBNAIL_PX)):
        right = decoded(content)[:, size:]
        np.testing.assert_allclose(right[size // 2, size // 2], colour, atol=6)
        np.testing.assert_allclose(right[4, 4], (226, 226, 226), atol=6)


def test_a_dropped_ring_is_shown_twice_once_without_its_outline() -> None:
    seen = decoded(draw_ring(frame(), RingView(CENTRE, RADIUS, (circle(RADIUS),), None)).picture)
    left, right = seen[:, :PICTURE_PX], seen[:, PICTURE_PX:]
    assert np.ptp(left, axis=2).max() > 100
    assert np.ptp(right, axis=2).max() < 12


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    ("centre", "radius"), [((-5.0, 88.0), 20.0), ((150.0, 3.0), 150.0), ((80.0, 40.0), 0.4)]
)
def test_rings_of_any_size_and_place_can_be_drawn(
    centre: tuple[float, float], radius: float, dtype: type
) -> None:
    view = RingView(np.array(centre), radius, (circle(radius),), residuals(0.05))
    pictures = draw_ring(frame(dtype), view)
    assert decoded(pictures.thumbnail).shape == (THUMBNAIL_PX, 2 * THUMBNAIL_PX, 3)
    assert pictures == draw_ring(frame(dtype), view), "the same bytes each time"


def test_uneven_light_has_a_third_part() -> None:
    left = residuals(0.0)
    white = np.full((31, 31), np.nan)
    white[5:26, 5:16], white[5:26, 16:26] = 1.0, 0.4
    pictures = draw_ring(frame(), RingView(CENTRE, RADIUS, (), replace(left, white=white)))
    picture = decoded(pictures.picture)
    assert picture.shape == (PICTURE_PX, 3 * PICTURE_PX, 3)
    third = picture[PICTURE_PX // 2, 2 * PICTURE_PX :, 0]
    lit, shaded = third[int(0.45 * PICTURE_PX)], third[int(0.6 * PICTURE_PX)]
    assert lit == pytest.approx(255, abs=6)
    assert shaded == pytest.approx(0.4 * 255, abs=6)
    thumbnail = decoded(pictures.thumbnail)
    assert thumbnail.shape == (THUMBNAIL_PX, 2 * THUMBNAIL_PX, 3)
