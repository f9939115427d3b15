"""Places of plain targets between frames: measured there, or told by the poses of these frames."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.plain_neighbours import PlainTracks
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.measurement.records import ExposureSettings, FrameResult
from kgcp.targets.plain import PlainPolarity, PlainTarget

CAMERA = Camera(640, 480, 900.0, 900.0, 321.0, 243.0, k1=-0.05)
TARGET = PlainTarget("W", (0.4,), PlainPolarity.BRIGHT, (0.0, 0.0, 0.0))
FRAMES, LACKING = 9, 7
NOTHING = FrameResult("", None, ExposureSettings(), ())


def sight_m(row: int) -> FloatArray:
    """The target in a frame's camera axes: it leaves the frame after row 7."""
    return np.array([0.4 * row - 2.0, 1.0 * row - 4.25 + 0.02 * (row % 2), 12.0])


def by_pose(row: int, sd_px: float) -> PlainPrediction:
    centre_px = CAMERA.project(sight_m(row)[None])[0]
    normal = NormalPrior(np.array([0.0, 0.0, 1.0]), 3.0)
    cov = sd_px**2 * np.eye(2)
    return PlainPrediction(centre_px, cov, sight_m(row), 0.002, normal, 15.0, "a test")


@pytest.mark.parametrize("sd_px", [0.5, 6.0])
def test_poses_tell_places_beyond_the_frames_border(sd_px: float) -> None:
    after = by_pose(FRAMES - 1, sd_px)
    assert after.is_outside(CAMERA)
    assert not by_pose(LACKING, sd_px).is_outside(CAMERA)
    for last in (FRAMES, FRAMES - 1):  # frames with a pose end after the lacking one, or before
        tracks = PlainTracks([TARGET], np.arange(float(FRAMES)))
        for row in range(last):
            posed = {} if row == LACKING else {"W": by_pose(row, sd_px)}
            tracks.add(row, NOTHING, posed)
        made = tracks.predictions(CAMERA, {LACKING: ["W"]})
        assert bool(made) is (last == FRAMES)
        for predictions in made.values():
            prediction = predictions["W"]
            off_px = prediction.centre_px - CAMERA.project(sight_m(LACKING)[None])[0]
            assert np.linalg.norm(off_px) < 3.0 * prediction.sd_px
            assert sd_px < prediction.sd_px < sd_px + 4.0
            assert prediction.position_m == pytest.approx(sight_m(LACKING), rel=0.01)


def test_places_that_are_not_sure_tell_nothing() -> None:
    tracks = PlainTracks([TARGET], np.arange(float(FRAMES)))
    for row in range(FRAMES):
        tracks.add(row, NOTHING, {} if row == LACKING else {"W": by_pose(row, 300.0)})
    assert tracks.predictions(CAMERA, {LACKING: ["W"]}) == {}
