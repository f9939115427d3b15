from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.deviations import (
    check_deviations,
    check_pose_deviations,
    check_target_deviations,
    check_vehicle_deviations,
)
from kgcp.quality.checks.doubt import Cause
from kgcp.settings import VehicleSettings
from kgcp.targets.layout import Ring, Target

_SD = np.full((5, 3), 0.02)
_MOTION = Motion(np.arange(5.0), np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)), _SD, _SD)
_POSES = ReferencePoses(tuple("abcde"), np.zeros((5, 3)), np.zeros((5, 3)), _SD, _SD[:, 0])


def test_deviations_that_are_missing_are_doubted() -> None:
    (position,) = check_deviations(
        replace(_MOTION, sd_position_m=None, sd_attitude_deg=None), "csv"
    )
    (attitude,) = check_deviations(replace(_MOTION, sd_attitude_deg=None), "csv")
    assert (position.code, position.is_grave) == (Cause.STANDARD_DEVIATIONS, False)
    assert position.sentence.endswith("of its positions: points will have none")
    assert attitude.sentence.endswith("of its attitudes: the lever arm's direction counts as exact")


@pytest.mark.parametrize(
    ("form", "of_positions", "of_attitudes"),
    [
        ("csv", "them, as sd_x, sd_y, sd_z", "them, as sd_roll_deg, sd_pitch_deg, sd_heading_deg"),
        ("sbet", "[vehicle] accuracies", "[vehicle] accuracies"),
        ("tum", "a CSV file with sd_x, sd_y, sd_z", "sd_roll_deg, sd_pitch_deg, sd_heading_deg"),
        ("waypoint", "export the trajectory with them", "export the trajectory with them"),
    ],
)
def test_the_remedy_for_missing_deviations_is_that_of_the_format(
    form: str, of_positions: str, of_attitudes: str
) -> None:
    (position,) = check_deviations(replace(_MOTION, sd_position_m=None), form)
    (attitude,) = check_deviations(replace(_MOTION, sd_attitude_deg=None), form)
    assert position.remedy.endswith(of_positions)
    assert attitude.remedy.endswith(of_attitudes)


def test_deviations_that_are_known_raise_no_doubt() -> None:
    assert not [*check_deviations(_MOTION, "csv")]
    level = _SD * [0.0, 0.0, 1.0]  # a flat yard, and heading by two antennas
    assert not [*check_deviations(replace(_MOTION, sd_attitude_deg=level), "csv")]


def test_deviations_of_zero_are_doubted() -> None:
    position, attitude = check_deviations(
        replace(_MOTION, sd_position_m=0.0 * _SD, sd_attitude_deg=0.0 * _SD), "csv"
    )
    assert (position.code, position.is_grave) == (Cause.STANDARD_DEVIATIONS, False)
    assert "positions are 0 for all epochs" in position.sentence
    assert "attitudes are 0 for all epochs" in attitude.sentence
    (heights,) = check_deviations(replace(_MOTION, sd_position_m=_SD * [1.0, 1.0, 0.0]), "csv")
    assert "positions are 0 for all epochs" in heights.sentence


def test_epochs_with_deviations_of_zero_are_counted() -> None:
    sd = _SD.copy()
    sd[2:4] = 0.0
    (doubt,) = check_deviations(replace(_MOTION, sd_position_m=sd), "csv")
    assert "are 0 for 2 of 5 epochs" in doubt.sentence
    assert doubt.figures == {"epochs": 2.0}
    (of_attitude,) = check_deviations(replace(_MOTION, sd_attitude_deg=sd), "csv")
    assert "attitudes are 0 for 2 of 5 epochs" in of_attitude.sentence


def test_reference_poses_with_deviations_of_zero_are_doubted() -> None:
    assert not [*check_pose_deviations(_POSES)]
    assert not [*check_pose_deviations(replace(_POSES, sd_position_m=None, sd_angle_deg=None))]
    angles = np.array([0.0, 0.01, 0.01, 0.0, 0.01])
    position, angle = check_pose_deviations(
        replace(_POSES, sd_position_m=_SD * [1.0, 1.0, 0.0], sd_angle_deg=angles)
    )
    assert {position.code, angle.code} == {Cause.STANDARD_DEVIATIONS}
    assert "reference poses' positions are 0 for all poses" in position.sentence
    assert "reference poses' angles are 0 for 2 of 5 poses" in angle.sentence


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        (1000.0, "are 20 m (median), which suggests millimetres"),
        (0.02, "are 0.0004 m (median), which suggests variances, or"),
        ([1e-5, 1e-5, 1.0], "are 2e-07 m (median), which suggests variances, or"),
    ],
)
def test_deviations_of_another_unit_are_doubted(factors: FloatArray, words: str) -> None:
    (doubt,) = check_deviations(replace(_MOTION, sd_position_m=_SD * factors), "csv")
    assert words in doubt.sentence
    assert (doubt.code, doubt.is_grave) == (Cause.STANDARD_DEVIATIONS, False)


def _driven(rate_hz: float) -> Motion:
    """A bend at 9 m/s; 2 cm are stated, and errors are 1 cm."""
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    angle = 0.3 * time_s
    position = np.column_stack((30.0 * np.cos(angle), 30.0 * np.sin(angle), 0.1 * time_s))
    position += np.random.default_rng(2).normal(0.0, 0.01, position.shape)
    turns = np.broadcast_to(np.eye(3), (len(time_s), 3, 3)).copy()
    sd = np.full_like(position, 0.02)
    return Motion(time_s, position, turns, sd, sd)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 20.0, 100.0])
def test_positions_that_scatter_by_less_than_is_stated_raise_no_doubt(rate_hz: float) -> None:
    driven = _driven(rate_hz)
    assert not [*check_deviations(driven, "csv")]
    gap = replace(driven, time_s=driven.time_s + (driven.time_s > 20.0) * 100.0)
    assert not [*check_deviations(gap, "csv")]


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 100.0])
def test_positions_that_scatter_by_more_than_is_stated_are_doubted(rate_hz: float) -> None:
    driven = _driven(rate_hz)
    noise = np.random.default_rng(3).normal(0.0, 0.1, driven.position_m.shape)
    (noisy,) = check_deviations(replace(driven, position_m=driven.position_m + noise), "csv")
    assert (noisy.code, noisy.is_grave) == (Cause.STANDARD_DEVIATIONS, False)
    assert noisy.figures["scatter_m"] == pytest.approx(np.sqrt(3.0) * 0.1, rel=0.15)
    assert noisy.figures["sd_m"] == pytest.approx(np.sqrt(3.0) * 0.02)
    (coarse,) = check_deviations(replace(driven, position_m=np.round(driven.position_m)), "csv")
    assert coarse.remedy.startswith("export the trajectory again with all digits")


def test_deviations_of_the_vehicle_in_thousandths_are_doubted() -> None:
    usual = VehicleSettings(sd_lever_arm_m=(0.005, 0.005, 0.01), sd_time_s=0.02)
    assert not [*check_vehicle_deviations(usual)]
    wrong = VehicleSettings(sd_lever_arm_m=(3.0, 3.0, 5.0), sd_time_s=1.0)
    arm, time = check_vehicle_deviations(wrong)
    assert arm.sentence.startswith(
        "[vehicle] sd_lever_arm_m is 5 m, which makes all points very unc"
    )
    assert arm.remedy == "give it in m, not in mm"
    assert time.sentence.startswith("[vehicle] sd_time_s is 1 s")


def test_deviations_of_static_targets_in_millimetres_are_doubted() -> None:
    usual = Target(Ring("A", 0.9, 0.45, 0.64, 0.13, (0, 43, 78, 180)), (), (1.0, 2.0, 3.0))
    rough = replace(usual, sd_position_m=(3.0, 3.0, 5.0))
    assert not [*check_target_deviations([usual, rough])]
    wrong = replace(usual, sd_position_m=(10.0, 10.0, 20.0))
    (doubt,) = check_target_deviations([usual, wrong, wrong])
    assert doubt.sentence.startswith("sd_position_m of A is 20 m, and that of 1 other target")
    assert (doubt.code, doubt.remedy) == (Cause.STANDARD_DEVIATIONS, "give it in m, not in mm")
