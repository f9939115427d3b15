"""Differences of heights that a geoid explains."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from kgcp.georef.local_frame import LocalFrame
from kgcp.quality.checks import causes
from kgcp.quality.checks.encounters import Encounters


@pytest.mark.parametrize(
    ("geoid_m", "up_m", "whose"),
    [
        (47.0, -46.4, "heights in the trajectory seem to be above the geoid"),
        (47.0, 46.4, "heights in the file of reference poses seem to be above the geoid"),
        (-30.0, 30.5, "heights in the trajectory seem to be above the geoid"),
        (47.0, -20.0, "geoids are up to 107 m from the ellipsoid"),
    ],
)
def test_heights_above_the_geoid_are_those_that_are_too_low_by_it(
    monkeypatch: pytest.MonkeyPatch, geoid_m: float, up_m: float, whose: str
) -> None:
    """A point that is h above the ellipsoid is h - N above a geoid of the height N."""
    monkeypatch.setattr(causes, "geoid_height_m", lambda *_: geoid_m)
    frame = LocalFrame.at("EPSG:25832", np.array([689_412.0, 5_336_208.0, 545.0]))
    flight = SimpleNamespace(vehicle=SimpleNamespace(local_frame=frame))
    words, _ = causes._height_words(cast("Encounters", flight), up_m)
    assert words.endswith(whose) or f"; {whose}" in words
