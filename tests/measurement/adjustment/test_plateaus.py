"""Light on the flat parts of a plate: even light, edges of shadows, and dots of another code."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.plateaus import (
    Plateaus,
    as_if_burnt,
    is_white_without_noise,
    look_at_plateaus,
    shadows_across,
)
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.targets.layout import Target

CENTRE_PX, LEFT, OFF_PX = (205.4, 190.7), 0.5, 12.0
WAY = math.radians(25.0)


@pytest.fixture(scope="module")
def look(
    target: Target,
    camera: Camera,
    place_plate: Callable[..., Pose],
    draw_frame: Callable[..., GreyArray],
    imaging_of: Callable[..., FitProblem],
) -> Callable[..., tuple[FitProblem, Plateaus]]:
    def at(
        shown: Target, shade: Callable[[FloatArray], FloatArray] | None = None
    ) -> tuple[FitProblem, Plateaus]:
        pose = place_plate(CENTRE_PX, 60.0, tilt_deg=10.0)
        grey = draw_frame((shown, pose))
        if shade is not None:
            y, x = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(float)
            along = (x - CENTRE_PX[0]) * math.cos(WAY) + (y - CENTRE_PX[1]) * math.sin(WAY)
            grey = np.rint(grey * shade(along)).astype(np.uint8)
        problem = imaging_of(grey, camera, target, pose)
        plateaus = look_at_plateaus(problem, pose, 0.8)
        assert plateaus is not None
        return problem, plateaus

    return at


def test_even_light_is_recognised_as_even(
    look: Callable[..., tuple[FitProblem, Plateaus]], target: Target
) -> None:
    problem, plateaus = look(target)
    assert not plateaus.is_uneven
    assert plateaus.typical == pytest.approx((0.08, 0.75), abs=0.006)
    assert shadows_across(problem, plateaus) == []


def test_levels_come_from_distant_plateaus_if_none_is_near(
    look: Callable[..., tuple[FitProblem, Plateaus]],
    target: Target,
    place_plate: Callable[..., Pose],
) -> None:
    problem, _ = look(target)
    third = replace(problem, visible=np.arange(72) < 24)
    plateaus = look_at_plateaus(third, place_plate(CENTRE_PX, 60.0, tilt_deg=10.0), 0.8)
    assert plateaus is not None
    typical = np.array(plateaus.typical)
    assert np.abs(plateaus.levels - typical[:, None]).max() < 0.05


@pytest.mark.parametrize("way", [WAY, WAY + math.pi], ids=["beyond", "before"])
@pytest.mark.parametrize("off_px", [OFF_PX, 45.0], ids=["half", "a little"])
def test_a_shadow_s_edge_is_found_where_it_lies(
    look: Callable[..., tuple[FitProblem, Plateaus]], target: Target, off_px: float, way: float
) -> None:
    """Levels are those of either side, whatever share of the plate is in shade."""
    sign = round(math.cos(way - WAY))
    problem, plateaus = look(target, lambda along: np.where(sign * along > off_px, LEFT, 1.0))
    assert plateaus.is_uneven
    (seen,) = shadows_across(problem, plateaus)
    ((angle, offset_px, _, *step),) = seen.edges.rows.tolist()
    turn = (angle - way + math.pi) % (2.0 * math.pi) - math.pi
    assert turn == pytest.approx(0.0, abs=math.radians(2.0))
    assert offset_px == pytest.approx(off_px, abs=1.0)
    assert seen.sunlit_levels == pytest.approx((0.08, 0.75), abs=0.01)
    assert step == pytest.approx([-0.08 * (1.0 - LEFT), -0.75 * (1.0 - LEFT)], abs=0.01)


def test_a_step_that_only_plate_shows_leaves_ink_as_it_is(
    look: Callable[..., tuple[FitProblem, Plateaus]], target: Target
) -> None:
    problem, plateaus = look(target, lambda along: np.where(along > 56.0, LEFT, 1.0))
    ink, plate = plateaus.flat
    along = (problem.window.pixels(ink) - problem.centre_px[:, None]).T @ (
        math.cos(WAY),
        math.sin(WAY),
    )
    (seen,) = shadows_across(problem, replace(plateaus, flat=(ink[along < 52.0], plate)))
    assert seen.sunlit_levels[0] == pytest.approx(0.08, abs=0.01)
    assert seen.edges.rows[0, 3:] == pytest.approx([0.0, -0.75 * (1.0 - LEFT)], abs=0.04)


@pytest.mark.parametrize(
    ("on_ink", "on_plate", "is_light"),
    [
        (0.0, -0.3, True),
        (-0.05, -0.3, True),
        (0.1, 0.3, True),
        (0.2, 0.1, False),
        (0.1, -0.3, False),
    ],
    ids=["shade", "shade on both", "glare", "mostly on ink", "against each other"],
)
def test_steps_that_neither_shade_nor_glare_can_cause_are_rejected(
    look: Callable[..., tuple[FitProblem, Plateaus]],
    target: Target,
    *,
    on_ink: float,
    on_plate: float,
    is_light: bool,
) -> None:
    problem, plateaus = look(target)
    smooth, right = problem.window.smooth.copy(), problem.centre_px[0] + OFF_PX
    for flat, step in zip(plateaus.flat, (on_ink, on_plate), strict=True):
        smooth[flat[problem.window.pixels(flat)[0] > right]] += step
    stepped = replace(problem, window=replace(problem.window, smooth=smooth))
    assert bool(shadows_across(stepped, plateaus)) == is_light


def test_ink_under_glare_is_not_taken_for_plate(
    target: Target,
    camera: Camera,
    place_plate: Callable[..., Pose],
    draw_frame: Callable[..., GreyArray],
    imaging_of: Callable[..., FitProblem],
) -> None:
    """Ink under glare is nearly as bright as half of the plate elsewhere."""
    pose = place_plate(CENTRE_PX, 60.0)
    grey = draw_frame((target, pose), white=0.55)
    glare_px = CENTRE_PX[0] + 15.0
    grey[:, round(glare_px) :] += np.uint8(64)
    problem = imaging_of(grey, camera, target, pose)
    plateaus = look_at_plateaus(problem, pose, 0.8)
    assert plateaus is not None
    ink, _ = plateaus.flat
    assert 0.2 < np.mean(problem.window.pixels(ink)[0] > glare_px + 5.0) < 0.4


def test_dots_of_another_code_are_not_taken_for_uneven_light(
    look: Callable[..., tuple[FitProblem, Plateaus]], target: Target
) -> None:
    more = replace(target.ring, code_deg=(*target.ring.code_deg, 230.0))
    _, plateaus = look(Target(more, target.replicas))
    assert not plateaus.is_uneven


def noisy(problem: FitProblem, plate: float, of_ink: float, of_plate: float) -> FitProblem:
    """Give a plate another level of white, and noise [grey values], and round it to grey values."""
    window, rng = problem.window, np.random.default_rng(3)
    share = np.clip((window.levels - 0.12) / (0.70 - 0.12), 0.0, 1.0)  # without its own noise
    sd = np.where(share > 0.5, of_plate, of_ink) / 255.0
    levels = 0.08 + (plate - 0.08) * share + sd * rng.standard_normal(len(share))
    levels = np.rint(255.0 * np.minimum(levels, 1.0)) / 255.0
    return replace(problem, window=replace(window, levels=levels, smooth=levels))


@pytest.mark.parametrize(
    ("of_ink", "of_plate", "is_burnt"),
    [
        (1.0, 0.0, True),
        (1.0, 0.5, False),  # it shows noise as ink does
        (0.0, 0.0, False),  # an image without noise cannot show burnt white
    ],
)
def test_burnt_white_has_no_noise(
    look: Callable[..., tuple[FitProblem, Plateaus]],
    target: Target,
    place_plate: Callable[..., Pose],
    *,
    of_ink: float,
    of_plate: float,
    is_burnt: bool,
) -> None:
    problem = noisy(look(target)[0], 0.92, of_ink, of_plate)
    plateaus = look_at_plateaus(problem, place_plate(CENTRE_PX, 60.0, tilt_deg=10.0), 0.8)
    assert plateaus is not None
    assert is_white_without_noise(problem, plateaus) == is_burnt


@pytest.mark.parametrize(
    ("plate", "may_be_burnt"),
    [
        (0.92, True),
        (0.75, False),  # too dark
        (1.0, False),  # seen clipped
    ],
)
def test_white_below_the_end_of_the_range_may_be_burnt(
    look: Callable[..., tuple[FitProblem, Plateaus]],
    target: Target,
    place_plate: Callable[..., Pose],
    *,
    plate: float,
    may_be_burnt: bool,
) -> None:
    problem = noisy(look(target)[0], plate, 1.0, 0.0)
    plateaus = look_at_plateaus(problem, place_plate(CENTRE_PX, 60.0, tilt_deg=10.0), 0.8)
    assert plateaus is not None
    seen = as_if_burnt(problem, plateaus)
    assert (seen is not None) == may_be_burnt
    if seen is None:
        return
    limit = 0.08 + 0.8 * (plate - 0.08)
    assert seen.brightest == seen.burnt_white == pytest.approx(plate, abs=0.003)
    assert seen.censoring.high == pytest.approx(limit, abs=0.004)
    assert seen.window.levels.max() == seen.censoring.high
    np.testing.assert_array_equal(
        seen.censoring.at_high, problem.window.levels >= seen.censoring.high
    )
    np.testing.assert_array_equal(seen.window.smooth, problem.window.smooth)
    for told_too_little in (
        replace(problem, outer_radius_px=12.0),
        replace(problem, window=replace(problem.window, binning=2)),
    ):
        assert as_if_burnt(told_too_little, plateaus) is None


def test_burnt_white_is_recognised_beside_shade(
    look: Callable[..., tuple[FitProblem, Plateaus]],
    target: Target,
    place_plate: Callable[..., Pose],
) -> None:
    """The plate in shade has noise and is not clipped."""
    problem = noisy(look(target)[0], 0.92, 1.0, 0.0)
    window = problem.window
    columns = window.pixels(np.arange(len(window.levels)))[0]
    shaded = np.random.default_rng(5).normal(0.55 * window.levels, 1.0 / 255.0)
    levels = np.where(columns > CENTRE_PX[0], shaded, window.levels)
    problem = replace(problem, window=replace(window, levels=levels, smooth=levels))
    plateaus = look_at_plateaus(problem, place_plate(CENTRE_PX, 60.0, tilt_deg=10.0), 0.8)
    assert plateaus is not None
    assert is_white_without_noise(problem, plateaus)
    seen = as_if_burnt(problem, plateaus)
    assert seen is not None
    assert seen.burnt_white == pytest.approx(0.92, abs=0.01)
    assert not np.any(seen.censoring.at_high & (columns > CENTRE_PX[0]))
