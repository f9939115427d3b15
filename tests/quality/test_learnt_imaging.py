"""The base of an unknown tone curve, and the curve itself, learnt from many frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import Reason
from kgcp.geometry.pose import Pose
from kgcp.io.tables.learnt_imaging import learnt_from_text, learnt_text
from kgcp.measurement.image_model.srgb import srgb_decoded
from kgcp.measurement.records import (
    Appearance,
    ExposureSettings,
    FrameResult,
    Imaging,
    Measurement,
    Miss,
    RivalTone,
    ToneBase,
    Uncertainty,
)
from kgcp.quality.learnt_imaging import (
    base_if_distances_agree,
    clearly_agreed_base,
    learn_imaging,
    over_base,
)

SRGB, LINE = ToneBase.SRGB, ToneBase.LINE


def imaging(base: ToneBase, white: float) -> Imaging:
    return Imaging(base, 0.05 * white, white, (0.0, 0.0, 0.0), 0.4, 0.004, 0.006)


def frame(name: str, base: ToneBase, advantage: float, white: float = 0.8) -> FrameResult:
    """A target 10 m away by the likelier base, and 11 m away by the other."""
    plate = Measurement(
        target="A",
        ring="A",
        instance=0,
        score=0.9,
        pose=Pose(np.eye(3), np.array([0.0, 0.0, 10.0])),
        centre_px=np.zeros(2),
        heading_deg=0.0,
        appearance=Appearance(30.0, 0.05, 0.8, 0.0),
        alternative=None,
        uncertainty=None,
        imaging=imaging(base, white),
    )
    other = replace(
        plate,
        pose=Pose(np.eye(3), np.array([0.0, 0.0, 11.0])),
        imaging=imaging(LINE if base is SRGB else SRGB, white),
    )
    plate = replace(plate, rival=RivalTone(other, advantage), is_guided=True)
    return FrameResult(name, 0.0, ExposureSettings(), (plate, Miss("B", Reason.CUT)))


def uncertainty(sd_distance_m: float) -> Uncertainty:
    return Uncertainty(np.eye(6), np.eye(2), sd_distance_m, 1.0, 1.0, 1.0)


def first_of(result: FrameResult) -> Measurement:
    outcome = result.outcomes[0]
    assert isinstance(outcome, Measurement)
    return outcome


def test_the_base_with_most_of_the_likelihood_is_used_for_all() -> None:
    results = [frame(f"f{k}", SRGB, 20.0 + k) for k in range(5)] + [frame("odd", LINE, 12.0)]
    learnt = learn_imaging(results)
    assert learnt is not None
    assert (learnt.base, learnt.measurements, learnt.overruled) == (SRGB, 6, 1)
    odd = first_of(results[-1])
    turned = over_base(odd, SRGB)
    assert turned.distance_m == 11.0
    assert turned.is_guided
    assert over_base(turned, LINE).distance_m == 10.0
    assert over_base(first_of(results[0]), SRGB) is first_of(results[0])


@pytest.mark.parametrize("against", [[1e6], [15.0, 15.0]])
def test_one_frame_alone_never_decides(against: list[float]) -> None:
    results = [frame(f"f{k}", SRGB, 30.0) for k in range(6)]
    results += [frame(f"g{k}", LINE, each) for k, each in enumerate(against)]
    learnt = learn_imaging(results)
    assert learnt is not None
    assert learnt.base is SRGB


def test_if_frames_disagree_each_keeps_its_own_base() -> None:
    results = [frame(f"f{k}", SRGB if k % 2 else LINE, 25.0) for k in range(7)]
    learnt = learn_imaging(results)
    assert learnt is not None
    assert learnt.base is None
    assert learnt.overruled == 0


@pytest.mark.parametrize(
    ("clear", "against", "base"),
    [(5, 0.0, LINE), (4, 0.0, None), (5, 29.0, LINE), (5, 31.0, None), (9, 60.0, None)],
)
def test_the_first_frames_decide_only_if_they_are_clear(
    clear: int, against: float, base: ToneBase | None
) -> None:
    results = [frame(f"f{k}", LINE, 1e3) for k in range(clear)]
    results += [frame(f"g{k}", SRGB, 0.5 * against) for k in range(2)]
    assert clearly_agreed_base(results) is base


def test_several_plates_of_one_frame_count_once() -> None:
    (plate, _) = frame("a", LINE, 1e3).outcomes
    assert isinstance(plate, Measurement)
    plates = tuple(replace(plate, instance=k) for k in range(9))
    crowded = FrameResult("a", 0.0, ExposureSettings(), plates)
    assert clearly_agreed_base([crowded]) is None
    assert clearly_agreed_base([replace(crowded, frame=f"f{k}") for k in range(5)]) is LINE


def test_a_frame_that_is_far_from_the_base_of_the_others_keeps_its_own() -> None:
    results = [frame(f"f{k}", SRGB, 30.0) for k in range(11)]
    results += [frame("near", LINE, 99.0), frame("far", LINE, 101.0)]
    learnt = learn_imaging(results)
    assert learnt is not None
    assert (learnt.base, learnt.overruled, learnt.kept_own_base) == (SRGB, 1, 1)
    near, far = (first_of(result) for result in results[-2:])
    assert over_base(near, SRGB).distance_m == 11.0
    assert over_base(far, SRGB) is far


@pytest.mark.parametrize(
    ("frames", "alike", "base"), [(12, 10, SRGB), (12, 9, None), (11, 11, None)]
)
def test_the_choice_of_the_base_hardly_matters_if_most_distances_agree(
    frames: int, alike: int, base: ToneBase | None
) -> None:
    results = [frame(f"f{k}", SRGB if k % 3 else LINE, 2.0) for k in range(frames)]
    sds_m = [5.0 if k < alike else 1.0 for k in range(frames)]  # both bases are 1 m apart
    with_sds = [
        replace(result, outcomes=(replace(first_of(result), uncertainty=uncertainty(sd_m)),))
        for result, sd_m in zip(results, sds_m, strict=True)
    ]
    assert clearly_agreed_base(with_sds) is None
    assert base_if_distances_agree(with_sds) is base


def test_frames_measured_over_one_base_take_part_in_what_is_learnt() -> None:
    both = [frame(f"f{k}", SRGB, 30.0) for k in range(6)]
    one = replace(first_of(frame("g", SRGB, 1.0)), rival=None)
    alone = FrameResult("g", 0.0, ExposureSettings(), (one,))
    stray = frame("h", LINE, 300.0)
    asked = {result.frame for result in both}
    learnt = learn_imaging([stray, *both, alone], SRGB, asked)
    assert learnt is not None
    assert (learnt.base, learnt.measurements, learnt.kept_own_base) == (SRGB, 6, 1)
    assert learnt.advantages == {SRGB: 180.0, LINE: 0.0}
    assert learnt.noise.shape == (16, 2)


def test_nothing_is_learnt_where_the_tone_is_known() -> None:
    known = first_of(frame("a", SRGB, 5.0))
    known = replace(known, rival=None, imaging=None)
    assert learn_imaging([FrameResult("a", 0.0, ExposureSettings(), (known,))]) is None


def test_the_common_curve_is_that_of_all_frames_and_order_does_not_matter() -> None:
    whites = np.linspace(0.3, 0.9, 9)
    results = [frame(f"f{k}", SRGB, 20.0, white) for k, white in enumerate(whites)]
    learnt = learn_imaging(results)
    assert learnt is not None
    known = np.isfinite(learnt.light[1])
    assert 0.6 < np.mean(known) < 0.95, "neither the deepest shade nor burnt white was seen"
    np.testing.assert_allclose(
        learnt.light[:, known], np.tile(srgb_decoded(learnt.grey)[known], (3, 1)), atol=2e-3
    )
    np.testing.assert_allclose(learnt.sharpening, 0.4)
    assert learnt.noise.shape == (18, 2)
    assert learnt_text(learn_imaging(results[::-1]) or learnt) == learnt_text(learnt)
    again = learnt_from_text(learnt_text(learnt))
    assert learnt_text(again) == learnt_text(learnt)
