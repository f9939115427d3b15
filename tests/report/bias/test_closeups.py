"""Close-ups and re-exposure of frames of the sample flight, by their truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.pose import Pose
from kgcp.georef.sighting import Sighting
from kgcp.io.flight.flight import Flight, read_flight
from kgcp.io.images.frames import read_grey
from kgcp.pipeline.bias_report import _ring_view
from kgcp.report.bias.numbers import evenly, largest
from kgcp.report.bias.reexposure import GAINS, Reexposed, measure_again, reexposed
from kgcp.report.ring_picture import CLOSEUP_PX, draw_closeup
from kgcp.settings import DetectSettings, Method

SAMPLE = Path(__file__).resolve().parents[3] / "sample_flight"


@pytest.fixture(scope="module")
def flight() -> Flight:
    return read_flight(SAMPLE)


def seen_in(flight: Flight, frame: str) -> tuple[GreyArray, Sighting, float]:
    rows = pd.read_csv(SAMPLE / "truth.csv").query("frame == @frame")
    rotation = rows[[f"r{i}{j}" for i in range(3) for j in range(3)]].to_numpy(float)
    pose = Pose(rotation.reshape(3, 3), rows[["cx", "cy", "cz"]].to_numpy(float)[0])
    at, radius_px = rows[["x", "y"]].to_numpy(float)[0], rows["radius_px"].to_numpy(float)[0]
    seen = Sighting(frame, 1, "A", 0, None, at, None, pose.distance_m, None, None, pose)
    return read_grey(flight.frames_folder / frame, flight.camera), seen, float(radius_px)


def test_the_fitted_circles_lie_on_the_edges_of_the_picture(flight: Flight) -> None:
    grey, seen, _ = seen_in(flight, "frame_0001.jpg")
    assert seen.pose is not None
    view = _ring_view(flight.camera, flight.targets[0], seen.pose, seen.centre_px)
    jpeg, curves = draw_closeup(grey, view)
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (CLOSEUP_PX, CLOSEUP_PX)
    outer, inner, centre = curves
    for circle, ink_inside in ((outer, True), (inner, False)):
        radial = circle - centre
        for scale, is_ink in ((0.93, ink_inside), (1.07, not ink_inside)):
            x, y = (centre + scale * radial - 0.5).astype(np.float32).T
            values = cv2.remap(picture, x[None], y[None], cv2.INTER_LINEAR)
            assert np.mean((values < 128) == is_ink) > 0.9  # dots are near


def again(flight: Flight, frame: str, method: Method) -> list[Reexposed]:
    grey, seen, radius_px = seen_in(flight, frame)
    settings = DetectSettings(method=method)
    target = flight.targets[0]
    return measure_again(grey, flight.camera, target, settings, seen.centre_px, radius_px, 3)


def test_other_grey_values_do_not_move_the_model(flight: Flight) -> None:
    found = again(flight, "frame_0005.jpg", Method.MODEL)
    assert tuple(result.gain for result in found) == GAINS
    for result in found:
        assert result.row == 3
        assert result.change_percent is not None
        assert result.sd_percent is not None
        assert abs(result.change_percent) < 3.0 * result.sd_percent < 0.1
    darker, brighter = found
    assert darker.saturated == 0.0
    assert brighter.saturated is not None
    assert brighter.saturated > 0.1


def test_clipping_moves_the_one_edge_of_the_paper(flight: Flight) -> None:
    darker, brighter = again(flight, "frame_0005.jpg", Method.PAPER)
    assert darker.change_percent is not None
    assert brighter.change_percent is not None
    assert abs(darker.change_percent) < 0.05
    assert brighter.change_percent > 0.3  # the ring shrinks: it seems farther away


def test_frames_whose_target_is_not_found_unchanged_are_left_out(flight: Flight) -> None:
    grey, seen, radius_px = seen_in(flight, "frame_0005.jpg")
    blank = np.full_like(grey, 120)
    target, settings = flight.targets[0], DetectSettings()
    assert measure_again(blank, flight.camera, target, settings, seen.centre_px, radius_px, 0) == []


def test_grey_values_are_rounded_and_clipped() -> None:
    grey = np.array([[0, 1, 100, 200]], dtype=np.uint8)
    assert reexposed(grey, 1.6).tolist() == [[0, 2, 160, 255]]
    assert reexposed(grey, 0.6).tolist() == [[0, 1, 60, 120]]
    assert reexposed(grey.astype(np.uint16) * 256, 1.6).max() == 65535


def test_frames_are_chosen_from_near_to_far_and_by_size() -> None:
    distance = np.array([50.0, 10.0, 30.0, 20.0, 40.0])
    assert evenly(distance, 3) == [1, 2, 0]
    assert evenly(distance, 99) == [1, 3, 2, 4, 0]
    assert evenly(distance, 0) == []
    assert largest(np.array([0.1, -3.0, 2.0]))[:2] == [1, 2]
