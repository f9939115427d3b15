"""The start of an adjustment, and when its choice of pixels is final."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.pixels import Sample, select_pixels
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.solver import adjust
from kgcp.measurement.adjustment.unknowns import _streak_of, unknowns_of
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.photometry import Light
from kgcp.simulation.flight import TARGET_PLATE

WIDE = Camera(480, 340, 330.0, 331.0, 238.2, 171.7, response=Response.LINEAR)


def streaked_edge(at_px: FloatArray, sd_px: float, length_px: float) -> FloatArray:
    """Mean of the edges that a uniform motion leaves behind each other."""
    places = (np.arange(2000) + 0.5) / 2000 - 0.5
    return np.asarray(ndtr((at_px[:, None] - places * length_px) / sd_px).mean(axis=1))


@pytest.mark.parametrize("length_px", [2.5, 4.0, 7.0])
@pytest.mark.parametrize("angle_deg", [-64.0, 21.0])
def test_the_start_of_a_streak_follows_from_the_gaussian_fitted_to_its_edges(
    length_px: float, angle_deg: float
) -> None:
    sd_px, at_px = 0.9, np.linspace(-14.0, 14.0, 561)
    edge = streaked_edge(at_px, sd_px, length_px)

    def misfit(gaussian_px: float) -> float:
        return float(np.sum((ndtr(at_px / gaussian_px) - edge) ** 2))

    along = minimize_scalar(misfit, bounds=(0.5, 6.0), method="bounded").x ** 2
    assert math.sqrt(12.0 * (along - sd_px**2)) > 1.01 * length_px, "it looks longer"
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    excess = along - sd_px**2
    blur = Blur(sd_px**2 + excess * cosine**2, sd_px**2 + excess * sine**2, excess * cosine * sine)
    streak = _streak_of(blur)
    assert streak is not None
    assert (streak.streak_x, streak.streak_y) == pytest.approx(
        (length_px * cosine, length_px * sine), abs=0.005 * length_px
    )
    assert (streak.xx, streak.yy, streak.xy) == pytest.approx((sd_px**2, sd_px**2, 0.0))


@pytest.mark.parametrize(("growth_px", "rounds"), [(0.005, 1), (0.6, 2)])
def test_pixels_are_chosen_anew_only_if_the_target_moves_in_the_image(
    photograph: Callable[..., GreyArray],
    imaging_of: Callable[..., FitProblem],
    monkeypatch: pytest.MonkeyPatch,
    growth_px: float,
    rounds: int,
) -> None:
    """Off the axis, a change of distance moves the target sideways in metres, but not in pixels."""
    radius_px, ray = 18.0, np.append(WIDE.undistort(np.array([52.3, 41.8])), 1.0)
    pose = Pose(np.eye(3), ray * 0.45 * WIDE.mean_focal_px / radius_px).tilted_across(0.2)
    grey = photograph(WIDE, pose, np.random.default_rng(3))
    problem = imaging_of(grey, WIDE, TARGET_PLATE.target, pose)
    chosen: list[Sample] = []

    def choose(*asked: Any, **more: Any) -> Sample:  # noqa: ANN401 - whatever it is asked
        chosen.append(select_pixels(*asked, **more))
        return chosen[-1]

    monkeypatch.setattr("kgcp.measurement.adjustment.solver.select_pixels", choose)
    off = Pose(pose.rotation, (1.0 + growth_px / radius_px) * pose.translation_m)
    start = Parameters.of(off, Blur(0.57, 0.57, 0.0), Light(0.05, 0.75))
    fit = adjust(problem, start, unknowns_of(problem, has_streak=False))
    assert fit.parameters.pose.distance_m == pytest.approx(pose.distance_m, rel=2e-3)
    assert len(chosen) == rounds
