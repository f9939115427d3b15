"""When the residuals of a fit require an extension of the plain model, and which one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kgcp.errors import Reason, Rejection
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment import extensions, random_levels
from kgcp.measurement.adjustment.normal_equations import Unknowns
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.random_levels import needs_varying_levels
from kgcp.measurement.adjustment.unknowns import unknowns_of
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.light_field import LightField, lay_knots
from kgcp.measurement.image_model.photometry import PARAM_COUNT, Param, Tone, encoded
from kgcp.measurement.image_model.shadow_edges import NO_EDGES, ShadowEdges
from kgcp.measurement.image_model.shadow_search import FoundShadows
from kgcp.measurement.records import ToneBase


def stand_in(**members: object) -> Any:  # noqa: ANN401 - for whichever record has these members
    return SimpleNamespace(**members)


def problem_of_unknown_tone() -> FitProblem:
    return FitProblem(
        window=stand_in(),
        ring=stand_in(),
        circles=stand_in(),
        measured_count=2,
        outer_radius_m=0.45,
        outer_radius_px=30.0,
        centre_px=np.array([160.0, 120.0]),
        focal_px=900.0,
        censoring=stand_in(),
        tone=Tone.UNKNOWN,
        sharpening_px=1.2,
    )


@pytest.mark.parametrize(
    ("has_levels", "inflation", "tones"),
    [
        (False, 10.0, [Tone.UNKNOWN_OVER_LINE]),
        (True, 2.9, [Tone.UNKNOWN_OVER_LINE]),
        (True, 3.9, [Tone.UNKNOWN_OVER_LINE, Tone.UNKNOWN]),  # of fits beside the minimum, 3.9…5.7
    ],
)
def test_the_other_base_is_tried_if_levels_leave_correlated_residuals(
    monkeypatch: pytest.MonkeyPatch, *, has_levels: bool, inflation: float, tones: list[Tone]
) -> None:
    tried = []

    def fit(problem: FitProblem, *_: object) -> object:
        tried.append(problem.tone)
        return stand_in(best=stand_in(level_equations=object() if has_levels else None))

    monkeypatch.setattr(extensions, "_fit_in_any_light", fit)
    monkeypatch.setattr(extensions, "pose_covariance", lambda _: stand_in(inflation=inflation))
    monkeypatch.setattr(extensions, "_is_curve_plausible", lambda _: True)
    monkeypatch.setattr(extensions, "advantage_over", lambda *_: 2.0)
    problem = problem_of_unknown_tone()
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))
    fits = extensions.fit_in_any_light(problem, pose, Blur(0.5, 0.5, 0.0), ToneBase.LINE)
    assert tried == tones
    assert fits.untried_base == (None if len(tones) == 2 else ToneBase.SRGB)
    assert (fits.rival is None) == (len(tones) == 1)


@pytest.mark.parametrize("settled", [None, ToneBase.LINE, ToneBase.SRGB])
def test_white_that_is_burnt_is_taken_for_clipped_over_all_bases(
    monkeypatch: pytest.MonkeyPatch, settled: ToneBase | None
) -> None:
    def fit(problem: FitProblem, *_: object) -> object:
        if (
            problem.burnt_white is None and problem.tone is Tone.UNKNOWN
        ):  # the other base finds no burnt white
            raise extensions.WhiteIsBurnt(replace(problem, burnt_white=0.92))
        return stand_in(best=stand_in(level_equations=None, sample=stand_in(problem=problem)))

    monkeypatch.setattr(extensions, "_fit_in_any_light", fit)
    monkeypatch.setattr(extensions, "advantage_over", lambda *_: 2.0)
    pose, blur = Pose(np.eye(3), np.array([0.0, 0.0, 9.0])), Blur(0.5, 0.5, 0.0)
    fits = extensions.fit_in_any_light(problem_of_unknown_tone(), pose, blur, settled)
    fits = extensions.with_untried_base(fits, pose, blur)
    assert fits.rival is not None
    for poses in (fits.likelier, fits.rival):
        assert poses.best.sample.problem.burnt_white == 0.92


@pytest.mark.parametrize(
    ("has_noise", "white", "explains", "advantage", "is_burnt"),
    [
        (False, 0.85, False, 0.0, True),
        (True, 0.91, True, 90.0, False),
        (True, 0.93, True, 90.0, True),
        (True, 0.93, True, 30.0, False),
        (True, 0.93, True, None, True),  # the fit with the white that is seen has failed
        (True, 0.93, False, 90.0, False),  # levels would vary with clipped white, too
    ],
)
def test_white_is_burnt_if_it_has_no_noise_or_if_even_light_is_then_likelier(
    monkeypatch: pytest.MonkeyPatch,
    *,
    has_noise: bool,
    white: float,
    explains: bool,
    advantage: float | None,
    is_burnt: bool,
) -> None:
    problem = stand_in(burnt_white=None, censoring=stand_in(high=1.0))
    plain, burnt = stand_in(), stand_in(brightest=white)
    monkeypatch.setattr(extensions, "as_if_burnt", lambda *_: burnt)
    monkeypatch.setattr(extensions, "is_white_without_noise", lambda *_: not has_noise)
    monkeypatch.setattr(extensions, "_fit_in_even_light", lambda *_: stand_in(best=stand_in()))
    monkeypatch.setattr(extensions, "needs_varying_levels", lambda _: not explains)
    monkeypatch.setattr(
        extensions,
        "advantage_on_own_pixels",
        lambda fit, other: advantage if other is plain and fit is not plain else None,
    )
    pose, blur = Pose(np.eye(3), np.array([0.0, 0.0, 9.0])), Blur(0.5, 0.5, 0.0)
    tried = None if advantage is None else plain
    if not is_burnt:
        extensions._raise_if_burnt(problem, pose, blur, stand_in(), tried)
        return
    with pytest.raises(extensions.WhiteIsBurnt) as burns:
        extensions._raise_if_burnt(problem, pose, blur, stand_in(), tried)
    assert burns.value.problem is burnt


@pytest.mark.parametrize(("inflation", "is_start"), [(2.9, True), (3.9, False)])
def test_only_a_fit_at_its_minimum_is_the_start_over_the_other_base(
    monkeypatch: pytest.MonkeyPatch, *, inflation: float, is_start: bool
) -> None:
    poses, starts = stand_in(best=stand_in(level_equations=object())), []

    def fit(*given: object) -> object:
        starts.append(given[-1])
        return poses

    monkeypatch.setattr(extensions, "_fit_in_any_light", fit)
    monkeypatch.setattr(extensions, "pose_covariance", lambda _: stand_in(inflation=inflation))
    monkeypatch.setattr(extensions, "_is_curve_plausible", lambda _: True)
    monkeypatch.setattr(extensions, "advantage_over", lambda *_: 2.0)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))
    extensions.fit_in_any_light(problem_of_unknown_tone(), pose, Blur(0.5, 0.5, 0.0))
    assert starts == [None, poses if is_start else None]


def test_a_fit_without_a_determined_pose_is_not_at_its_minimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_covariance(_: object) -> object:
        raise Rejection(Reason.POOR_FIT)

    monkeypatch.setattr(extensions, "pose_covariance", no_covariance)
    monkeypatch.setattr(extensions, "_is_curve_plausible", lambda _: True)
    fit = stand_in(level_equations=object())
    assert not extensions._is_at_minimum(fit)


@pytest.mark.parametrize(
    ("of_srgb", "of_line", "inflation", "is_srgb_likelier", "has_rival"),
    [
        ((0.8, 0.3, -0.6), (1.2, -0.5, 0.0), 1.4, False, True),
        ((2.2, -1.5, 2.2), (1.2, -0.5, 0.0), 1.4, False, False),  # 8.7 σ off
        ((0.8, 0.3, -0.6), (1.2, -0.5, 4.4), 1.4, True, False),
        ((0.8, 0.3, -0.6), (1.2, -0.5, 4.4), 8.0, False, True),  # the other is beside its minimum
        ((2.2, -1.5, 2.2), (1.2, -0.5, 4.4), 1.4, False, True),
    ],
)
def test_a_fit_with_an_implausible_curve_gives_way_to_the_other_base(
    monkeypatch: pytest.MonkeyPatch,
    *,
    of_srgb: tuple[float, float, float],
    of_line: tuple[float, float, float],
    inflation: float,
    is_srgb_likelier: bool,
    has_rival: bool,
) -> None:
    def fit(shapes: tuple[float, float, float], tone: Tone) -> Any:  # noqa: ANN401 - a stand-in
        vector = np.zeros(PARAM_COUNT)
        vector[[Param.TONE_1, Param.TONE_2, Param.TONE_3]] = shapes
        unknowns = unknowns_of(stand_in(tone=tone), has_streak=False)
        parameters = stand_in(vector=vector)
        best = stand_in(level_equations=object(), parameters=parameters, unknowns=unknowns)
        return stand_in(best=best)

    monkeypatch.setattr(extensions, "advantage_over", lambda *_: 50.0)  # of the line

    def covariance(fit: Any) -> Any:  # noqa: ANN401 - stand-ins
        is_plausible = fit.parameters.vector[Param.TONE_3] < 1.0
        return stand_in(inflation=inflation if is_plausible else 2.5)

    monkeypatch.setattr(extensions, "pose_covariance", covariance)
    srgb, line = fit(of_srgb, Tone.UNKNOWN), fit(of_line, Tone.UNKNOWN_OVER_LINE)
    fits = extensions._by_likelihood({ToneBase.SRGB: srgb, ToneBase.LINE: line})
    assert fits.likelier is (srgb if is_srgb_likelier else line)
    assert (fits.rival is not None) == has_rival
    assert extensions._is_at_minimum(srgb.best) == (of_srgb[2] < 1.0 and inflation < 3.0)


@pytest.mark.parametrize(
    ("excess", "inflation", "radius_px", "binning", "is_asked"),
    [
        (1.0, 6.5, 30.0, 1, False),  # even light with other misfits
        (1.3, 3.5, 30.0, 1, False),  # of a coarse renderer in even light
        (1.3, 6.5, 30.0, 1, True),  # dirt on a ring of 15 px
        (1.8, 1.0, 30.0, 1, False),
        (2.0, 1.0, 30.0, 1, True),
        (2.0, 6.5, 90.0, 2, False),  # bins: a tone curve within them displaces edges
        (3.1, 1.0, 90.0, 2, True),
        (0.6, 1.8, 10.0, 1, True),  # a highlight on a ring of 8 px
        (0.6, 1.4, 10.0, 1, False),
        (0.3, 3.3, 10.0, 1, True),  # a burnt ring of 8 px, half in shade
        (0.3, 1.4, 10.0, 1, False),
    ],
)
def test_levels_vary_by_cells_or_by_edges_where_cells_are_doubtful(
    monkeypatch: pytest.MonkeyPatch,
    *,
    excess: float,
    inflation: float,
    radius_px: float,
    binning: int,
    is_asked: bool,
) -> None:
    monkeypatch.setattr(random_levels, "excess_of_cells", lambda _: excess)
    monkeypatch.setattr(random_levels, "pose_covariance", lambda _: stand_in(inflation=inflation))
    window = stand_in(binning=binning)
    problem = stand_in(window=window, is_ring_small=radius_px < 12.5)
    fit = stand_in(sample=stand_in(problem=problem))
    assert needs_varying_levels(fit) == is_asked


@pytest.mark.parametrize(
    ("radius_px", "advantage", "is_even"),
    [
        (10.0, 8.9, True),
        (10.0, 24.9, True),
        (10.0, 25.1, False),
        (10.0, -0.1, False),  # a fit that has ended beside its minimum
        (12.6, 8.9, False),
    ],
)
def test_small_rings_keep_even_light_if_levels_that_vary_gain_little(
    monkeypatch: pytest.MonkeyPatch, *, radius_px: float, advantage: float, is_even: bool
) -> None:
    problem = stand_in(is_ring_small=radius_px < 12.5, may_be_finer=False, tone=Tone.LINEAR)
    plain, varying = (stand_in(best=stand_in(sample=stand_in(problem=problem))) for _ in range(2))
    monkeypatch.setattr(extensions, "fit_both_poses", lambda *_: plain)
    monkeypatch.setattr(extensions, "_with_shape", lambda _, poses: poses)
    monkeypatch.setattr(extensions, "needs_varying_levels", lambda _: True)
    monkeypatch.setattr(extensions, "_with_varying_levels", lambda *_: varying)
    monkeypatch.setattr(extensions, "_with_edge_tone", lambda _, poses: poses)
    monkeypatch.setattr(extensions, "advantage_over", lambda *_: advantage)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))
    chosen = extensions._best_in_any_light(problem, pose, Blur(0.5, 0.5, 0.0), lambda: None, None)
    assert chosen is (plain if is_even else varying)


@pytest.mark.parametrize(("tone", "starts_from_seen"), [(Tone.UNKNOWN, True), (Tone.BINNED, False)])
def test_bins_in_nearly_even_light_keep_the_levels_that_they_were_fitted_with(
    monkeypatch: pytest.MonkeyPatch, *, tone: Tone, starts_from_seen: bool
) -> None:
    problem = stand_in(is_ring_small=False, may_be_finer=False, burnt_white=0.9, tone=tone)
    plain = stand_in(best=stand_in(sample=stand_in(problem=problem)))
    seen, started_from = stand_in(is_uneven=False), []

    def with_levels(_: object, poses: object, plateaus: object) -> object:
        started_from.append(plateaus)
        return poses

    monkeypatch.setattr(extensions, "fit_both_poses", lambda *_: plain)
    monkeypatch.setattr(extensions, "_with_shape", lambda _, poses: poses)
    monkeypatch.setattr(extensions, "needs_varying_levels", lambda _: True)
    monkeypatch.setattr(extensions, "_with_varying_levels", with_levels)
    monkeypatch.setattr(extensions, "_with_edge_tone", lambda _, poses: poses)
    monkeypatch.setattr(extensions, "_may_be_even", lambda *_: True)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))
    extensions._best_in_any_light(problem, pose, Blur(0.5, 0.5, 0.0), lambda: seen, None)
    assert started_from == [seen if starts_from_seen else None]


@pytest.mark.parametrize(
    ("levels_vary", "is_uneven", "fitted_from"),
    [
        (False, True, ["evened"]),  # the other base has no levels to start from
        (True, True, ["other base"]),
        (True, False, ["plain", "other base"]),  # by this base the light may be even
    ],
)
def test_levels_over_a_second_base_start_from_those_over_the_first(
    monkeypatch: pytest.MonkeyPatch, *, levels_vary: bool, is_uneven: bool, fitted_from: list[str]
) -> None:
    problem = stand_in(is_ring_small=False, may_be_finer=False, burnt_white=0.9, tone=Tone.UNKNOWN)
    sample = stand_in(problem=problem)
    parameters = stand_in(pose=Pose(np.eye(3), np.array([0.0, 0.0, 9.0])))
    plain = stand_in(best=stand_in(sample=sample, level_equations=None))
    varying = stand_in(
        best=stand_in(sample=sample, level_equations=object()),
        other=stand_in(parameters=parameters),
    )
    over_first_base = stand_in(best=stand_in(level_equations=object() if levels_vary else None))
    fits: list[str] = []

    def fit_plain(*_: object) -> object:
        fits.append("plain")
        return plain

    def fit_evened(*_: object) -> object:
        fits[-1] = "evened"
        return varying

    def fit_over_another(_: object, poses: object) -> object:
        assert poses is over_first_base
        fits.append("other base")
        return varying

    monkeypatch.setattr(extensions, "fit_both_poses", fit_plain)
    monkeypatch.setattr(extensions, "_fit_from_plateaus", fit_evened)
    monkeypatch.setattr(extensions, "_fit_over_other_base", fit_over_another)
    monkeypatch.setattr(extensions, "_with_shape", lambda _, poses: poses)
    monkeypatch.setattr(extensions, "_with_edge_tone", lambda _, poses: poses)
    monkeypatch.setattr(extensions, "_with_kurtosis", lambda _, poses: poses)
    monkeypatch.setattr(extensions, "needs_varying_levels", lambda _: True)
    monkeypatch.setattr(extensions, "fit_other_pose", lambda best, _: (best, None))
    seen = stand_in(is_uneven=is_uneven)
    poses = extensions._fit_in_any_light(
        problem, parameters.pose, Blur(0.5, 0.5, 0.0), lambda: seen, over_first_base
    )
    assert fits == fitted_from
    assert poses.best is varying.best


@pytest.mark.parametrize(
    ("tone", "clipped", "asks", "freed"),
    [
        (Tone.UNKNOWN, 2, {}, []),
        (Tone.UNKNOWN, 2, {Param.EDGE_TONE: 101.0, Param.KURTOSIS: 39.0}, [Param.EDGE_TONE]),
        (Tone.UNKNOWN, 2, {Param.EDGE_TONE: 99.0, Param.KURTOSIS: 41.0}, []),
        (
            Tone.UNKNOWN_OVER_LINE,
            2,
            {Param.EDGE_TONE: 101.0, Param.KURTOSIS: 41.0},
            [Param.EDGE_TONE, Param.KURTOSIS],
        ),
        (Tone.UNKNOWN, 3, {Param.EDGE_TONE: 101.0}, []),  # burnt
        (Tone.LINEAR, 2, {Param.EDGE_TONE: 101.0}, []),  # nothing is processed
    ],
)
def test_edges_have_a_tone_of_their_own_beside_levels_if_its_score_test_says_so(
    monkeypatch: pytest.MonkeyPatch,
    tone: Tone,
    clipped: int,
    asks: dict[Param, float],
    freed: list[Param],
) -> None:
    free = np.array([0, 1, 2, int(Param.SKEW_YYY)])
    start = Unknowns(free, np.zeros(PARAM_COUNT), np.ones(PARAM_COUNT), np.ones(4))

    def fitted(unknowns: Unknowns) -> Any:  # noqa: ANN401 - stands for two poses
        vector = np.zeros(PARAM_COUNT)
        vector[unknowns.free] = 0.5
        has = {"has_edge_tone": Param.EDGE_TONE, "has_kurtosis": Param.KURTOSIS}
        has_it = {name: bool(vector[of]) for name, of in has.items()}
        parameters = stand_in(pose=None, **has_it)
        best = stand_in(
            level_equations=object(),
            parameters=parameters,
            unknowns=unknowns,
            sample=stand_in(censoring=stand_in(is_clipped=np.arange(100) < clipped)),
        )
        return stand_in(best=best, other=stand_in(parameters=parameters))

    monkeypatch.setattr(
        extensions, "chi2_with_levels", lambda _, __, param: asks.get(Param(param), 0.0)
    )
    monkeypatch.setattr(extensions, "_fit_shaped", lambda _, __, ___, unknowns: fitted(unknowns))
    poses = extensions._with_edge_tone(stand_in(tone=tone), fitted(start))
    found = poses.best.unknowns
    assert set(found.free) == {*free, *freed}
    assert np.all(np.diff(found.free) > 0)
    np.testing.assert_array_equal(found.free_precision, found.precision[found.free])


STEP, STRIP = [0.9, 4.0, 0.8], [[2.5, 8.0, 0.3], [2.5, 16.0, 0.3]]


def started_under(
    monkeypatch: pytest.MonkeyPatch, tone: Tone, lit: tuple[float, float], rows: list[list[float]]
) -> Parameters:
    knots = lay_knots((0.0, 63.0), (0.0, 47.0), np.array([32.0, 24.0]), (8.0,))
    nothing = np.zeros((2, sum(knots.counts)))
    even = LightField(knots, nothing, nothing, np.zeros(2), NO_EDGES, np.zeros(2))
    monkeypatch.setattr(extensions, "even_field", lambda _: even)
    first = stand_in(pose=Pose(np.eye(3), np.array([0.0, 0.0, 9.0])), blur=Blur(0.5, 0.5, 0.0))
    problem = stand_in(tone=tone, censoring=stand_in(high=0.998))
    single_count = len(rows) % 2
    seen = FoundShadows(np.array(lit), ShadowEdges(np.array(rows), single_count))
    return extensions._under_shadows(problem, first, seen)


@pytest.mark.parametrize("tone", [Tone.LINEAR, Tone.SRGB])
def test_fits_start_from_the_light_of_visible_shadows(
    monkeypatch: pytest.MonkeyPatch, tone: Tone
) -> None:
    """The steps of edges are relative to the contrast of the light, which is half in shade."""
    light = np.array(((0.06, 0.7), (0.03, 0.35)))
    lit, shade = encoded(light[0], tone), encoded(light[1], tone)
    step = (shade - lit).tolist()
    rows = [[*STEP, *step], [*STRIP[0], *step], [*STRIP[1], *(lit - shade).tolist()]]
    start = started_under(monkeypatch, tone, tuple(lit.tolist()), rows)
    assert (start.light.black, start.light.white) == pytest.approx((0.06, 0.7))
    assert start.field is not None
    added = (light[1] - light[0]) / (0.7 - 0.06)
    assert start.field.shadows.rows[:, 3:] == pytest.approx(np.array([added, added, -added]))
    assert start.field.shadows.single_count == 1


@pytest.mark.parametrize(
    ("tone", "plate_in_shade", "white"),
    [
        (Tone.LINEAR, 0.75, 1.5),  # half of ink is left, so half of the plate
        (Tone.LINEAR, 1.0, 2.0),
        (Tone.UNKNOWN_OVER_LINE, 0.75, 1.0),  # the white that is seen is the scale
    ],
)
def test_the_step_on_ink_gives_the_start_value_of_burnt_white(
    monkeypatch: pytest.MonkeyPatch, tone: Tone, plate_in_shade: float, white: float
) -> None:
    rows = [[*STEP, -0.05, plate_in_shade - 1.0]]
    start = started_under(monkeypatch, tone, (0.1, 1.0), rows)
    assert start.light.white == pytest.approx(white)
    assert start.field is not None
    shade = start.light.white + (white - 0.1) * start.field.shadows.rows[0, 4]
    assert shade == pytest.approx(plate_in_shade)
