"""How many discs of a photograph the tone curve is learned from: more of small ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from kgcp.geometry.camera import Response
from kgcp.measurement.discs import camera_tone
from kgcp.measurement.discs.adjust_disc import DiscTask
from kgcp.measurement.discs.fit_disc import DiscFit
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.image_model.photometry import Tone


def tasks(radius_px: float, count: int = 60) -> list[DiscTask]:
    """Dark discs of one size, drawn with grey edges."""
    pitch = int(2 * radius_px + 16)
    grey = np.full((6 * pitch, 10 * pitch), 200.0)
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]]
    for number in range(count):
        row, column = divmod(number, 10)
        off = np.hypot(x - (column + 0.5) * pitch, y - (row + 0.5) * pitch) - radius_px
        grey -= 150.0 * np.clip(0.5 - off / 2.0, 0.0, 1.0)
    photo = grey.astype(np.uint8)
    return [DiscTask(photo, outline, []) for outline in find_outlines(photo)]


@pytest.mark.parametrize(
    ("radius_px", "least", "most"), [(3.5, 29, 32), (6.0, 17, 20), (14.0, 9, 9)]
)
def test_more_discs_are_learned_from_if_they_are_small(
    radius_px: float, least: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of discs below 5 px, nine as of large ones: more would not separate tone from blur."""
    seen: list[int] = []

    def first_fits(chosen: Sequence[DiscTask], tone: Tone) -> list[DiscFit]:
        assert tone is Tone.UNKNOWN
        seen.append(len(chosen))
        return []

    monkeypatch.setattr(camera_tone, "_first_fits", first_fits)
    found = tasks(radius_px)
    assert len(found) == 60
    camera_tone.learn_tone([found], Response.UNKNOWN)
    assert least <= seen[0] <= most
