"""Which normal the frames before and after make likelier, and how a measurement changes by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.neighbouring_normals import preferences_of_neighbours
from kgcp.measurement.adjustment.covariance import ambiguity_cov, propagate
from kgcp.measurement.other_pose import with_preference
from kgcp.measurement.records import (
    Alternative,
    Appearance,
    ExposureSettings,
    FrameResult,
    Measurement,
    Uncertainty,
)

CAMERA = Camera(1200, 900, 1900.0, 1905.0, 590.0, 455.0)
COV = np.diag([1e-6, 1e-6, 4e-4, 3e-4, 3e-4, 1e-5])
OTHER_COV = np.diag([1e-6, 1e-6, 4e-4, 5e-4, 2e-4, 1e-5])


def plate(number: int, *, is_sure: bool, is_turned: bool = False) -> FrameResult:
    """A plate that is always tilted by about 20° to the same side; turned: by the other pose."""
    rng = np.random.default_rng(number)
    tilt = np.radians([20.0, 3.0, 0.0] + rng.normal(0.0, 1.5, 3) * [1.0, 1.0, 0.0])
    true = Pose(Rotation.from_rotvec(tilt).as_matrix(), np.array([3.0, -2.0, 40.0]))
    pose, other = (true.mirrored(), true) if is_turned else (true, true.mirrored())
    measurement = Measurement(
        target="A",
        ring="A",
        instance=0,
        score=0.9,
        pose=pose,
        centre_px=CAMERA.project(pose.translation_m[None])[0],
        heading_deg=0.0,
        appearance=Appearance(20.0, 0.05, 0.8, 0.0),
        alternative=Alternative(other, 60.0 if is_sure else 1.2, OTHER_COV),
        uncertainty=Uncertainty(COV, np.diag([1e-4, 1e-4]), 0.02, 1.0, 1.0, 0.2),
    )
    return FrameResult(f"f{number:02d}.jpg", 100.0 + number, ExposureSettings(), (measurement,))


def test_neighbours_correct_or_confirm_an_ambiguous_normal() -> None:
    results = [plate(k, is_sure=k not in {4, 7}, is_turned=k == 7) for k in range(12)]
    preferences = preferences_of_neighbours(results)
    assert preferences.keys() == {("f04.jpg", "A", 0), ("f07.jpg", "A", 0)}
    assert 15.0 < preferences["f04.jpg", "A", 0] <= 25.0
    assert -25.0 <= preferences["f07.jpg", "A", 0] < -15.0
    assert preferences_of_neighbours(results[::-1]) == preferences


@pytest.mark.parametrize("sure", [range(0), range(5), (0, 1, 2, 3, 30, 31, 32)])
def test_too_few_or_distant_neighbours_give_no_preference(sure: range | tuple[int, ...]) -> None:
    doubtful = FrameResult("x", 116.0, ExposureSettings(), plate(9, is_sure=False).outcomes)
    assert preferences_of_neighbours([*(plate(k, is_sure=True) for k in sure), doubtful]) == {}


def test_exchanged_poses_exchange_all_values_that_follow_from_them() -> None:
    (before,) = plate(3, is_sure=False).outcomes
    assert isinstance(before, Measurement)
    assert before.alternative is not None
    kept = with_preference(CAMERA, before, 4.0)
    assert kept.pose is before.pose
    assert kept.alternative is not None
    assert kept.alternative.ambiguity == pytest.approx(5.2)
    turned = with_preference(CAMERA, before, -8.0)
    assert turned.pose is before.alternative.pose
    assert turned.alternative is not None
    assert turned.alternative.pose is before.pose
    assert turned.alternative.ambiguity == pytest.approx(6.8)
    np.testing.assert_array_equal(
        turned.centre_px, CAMERA.project(turned.pose.translation_m[None])[0]
    )
    assert turned.uncertainty is not None
    np.testing.assert_allclose(turned.uncertainty.pose_cov[3:, 3:], OTHER_COV[3:, 3:])
    unknown = replace(before, alternative=replace(before.alternative, pose_cov=None))
    held = with_preference(CAMERA, unknown, -8.0)
    assert held.pose is before.pose
    assert held.alternative is not None
    assert held.alternative.ambiguity == 0.0


def plate_of_two_places(ambiguity: float) -> Measurement:
    """A plate whose two poses are 11 cm apart, with the covariance that a fit reports."""
    (seen,) = plate(3, is_sure=False).outcomes
    assert isinstance(seen, Measurement)
    apart_m = np.array([0.05, 0.0, 0.1])
    other = Pose(seen.pose.mirrored().rotation, seen.pose.translation_m + apart_m)
    pose_cov = COV.copy()
    pose_cov[:3, :3] += ambiguity_cov(seen.pose, other, ambiguity)
    return replace(
        seen,
        alternative=Alternative(other, ambiguity, OTHER_COV),
        uncertainty=propagate(CAMERA, seen.pose, pose_cov),
    )


def assert_same(measurement: Measurement, expected: Measurement) -> None:
    ours, theirs = measurement.uncertainty, expected.uncertainty
    assert ours is not None
    assert theirs is not None
    np.testing.assert_allclose(ours.pose_cov, theirs.pose_cov, atol=1e-15)
    np.testing.assert_allclose(ours.centre_cov_px2, theirs.centre_cov_px2, rtol=1e-6)
    assert ours.sd_distance_m == pytest.approx(theirs.sd_distance_m)
    assert measurement.alternative is not None
    assert expected.alternative is not None
    assert measurement.alternative.ambiguity == pytest.approx(expected.alternative.ambiguity)
    assert measurement.alternative.pose_cov is not None
    assert expected.alternative.pose_cov is not None
    np.testing.assert_allclose(
        measurement.alternative.pose_cov, expected.alternative.pose_cov, atol=1e-15
    )


@pytest.mark.parametrize("preference", [-8.9, -2.0, 0.0, 20.0])
def test_the_covariance_follows_how_probable_the_other_pose_is(preference: float) -> None:
    weighed = with_preference(CAMERA, plate_of_two_places(9.0), preference)
    assert_same(weighed, plate_of_two_places(9.0 + preference))


@given(st.floats(0.0, 9.9), st.floats(-30.0, 30.0), st.floats(-30.0, 30.0))
def test_preferences_add_up(ambiguity: float, first: float, second: float) -> None:
    assume(abs(abs(ambiguity + first) + second) > 1e-6)  # of equal poses, either is reported
    before = plate_of_two_places(ambiguity)
    twice = with_preference(CAMERA, with_preference(CAMERA, before, first), second)
    is_turned = ambiguity + first < 0.0
    # a preference is for the pose that is reported: once they have changed places, for the other
    at_once = with_preference(CAMERA, before, first - second if is_turned else first + second)
    assert twice.pose is at_once.pose
    assert_same(twice, at_once)
    for each in (twice, at_once):
        assert each.uncertainty is not None
        assert each.alternative is not None
        assert each.alternative.pose_cov is not None
        assert np.linalg.eigvalsh(each.uncertainty.pose_cov).min() > 0.0
        assert np.linalg.eigvalsh(each.alternative.pose_cov).min() > 0.0
