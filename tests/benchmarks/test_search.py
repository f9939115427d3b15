"""The benchmark of the search: its frames show what they promise, its judge is fair."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.search import false_alarms, hard_frames
from benchmarks.search.plates import DECOYS, TARGET_A, TARGETS
from benchmarks.search.scene import Shot, radius_px, stream, tilt_deg
from benchmarks.search.sets import SETS, SETS_BY_NAME
from benchmarks.search.verdict import judge_frame, wilson
from kgcp.errors import Reason
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.measurement.records import Appearance, Measurement, Miss
from kgcp.simulation.scene import PlatePose
from kgcp.targets.validation import codes_coincide, same_shape

SHOTS = 60


def shots(name: str) -> list[Shot]:
    return [SETS_BY_NAME[name].shot(1, index) for index in range(SHOTS)]


def circle_px(shot: Shot, seen: PlatePose, diameter_m: float) -> FloatArray:
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    circle = 0.5 * diameter_m * np.column_stack((np.cos(angles), np.sin(angles)))
    return shot.camera.project(seen.pose.transform(circle))


def share_in_frame(shot: Shot, seen: PlatePose, diameter_m: float) -> float:
    x, y = circle_px(shot, seen, diameter_m).T
    inside = (x >= 0) & (y >= 0) & (x < shot.camera.width) & (y < shot.camera.height)
    return float(inside.mean())


@pytest.mark.parametrize(
    ("name", "low", "high"), [("small", 6.0, 9.0), ("middle", 9.0, 150.0), ("two_targets", 10, 60)]
)
def test_rings_have_the_promised_radii_and_are_in_the_frame(
    name: str, low: float, high: float
) -> None:
    for shot in shots(name):
        for placed in shot.wanted:
            assert low <= radius_px(shot.camera, placed) <= high * 1.0001
            ring = placed.plate.target.ring
            assert share_in_frame(shot, placed, ring.outer_diameter_m) == 1.0


def test_oblique_plates_are_tilted_against_their_rays() -> None:
    tilts = [tilt_deg(placed.pose) for shot in shots("oblique") for placed in shot.wanted]
    assert 30.0 <= min(tilts) < 33.0
    assert 42.0 < max(tilts) <= 45.0


def test_cut_rings_leave_the_frame_and_their_replicas_do_not() -> None:
    for name in ("cut", "larger"):
        for shot in shots(name):
            (seen,) = shot.wanted
            assert share_in_frame(shot, seen, 0.9) < 0.95
            assert share_in_frame(shot, seen, 0.18) == 1.0


def test_up_to_a_quarter_of_the_ring_is_hidden() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    hidden = []
    for shot in shots("hidden"):
        (obstacle,) = shot.obstacles
        x, y = 0.45 * np.cos(angles), 0.45 * np.sin(angles)
        hidden.append(float(np.mean(obstacle.shape.signed_distance(x, y) < 0.0)))
    assert 0.19 < min(hidden) < 0.21
    assert 0.24 < max(hidden) < 0.26


def test_decoys_are_not_the_targets_but_for_the_one_that_hardly_differs() -> None:
    rng = np.random.default_rng(8)
    for kind, make in DECOYS.items():
        ring = make(rng).target.ring
        if ring.name != "decoy":
            continue
        alike = [
            same_shape(ring, target.ring) and codes_coincide(ring, target.ring)
            for target in TARGETS
        ]
        assert any(alike) == (kind == "dot moved by 10°")


def test_frames_are_the_same_each_time_and_differ() -> None:
    frame_set = SETS_BY_NAME["hidden"]
    first, again, other = (hard_frames.picture(frame_set, 1, index) for index in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or np.any(first != other)


def observed(shot: Shot, seen: PlatePose, pose: Pose | None = None) -> Measurement:
    pose = pose or seen.pose
    return Measurement(
        target=seen.plate.target.name,
        ring=seen.plate.target.name,
        instance=0,
        score=0.97,
        pose=pose,
        centre_px=shot.camera.project(pose.translation_m),
        heading_deg=image_heading_deg(shot.camera, pose),
        appearance=Appearance(radius_px(shot.camera, seen), 0.1, 0.8, 0.0),
        alternative=None,
        uncertainty=None,
    )


def test_the_judge_tells_found_missed_off_and_wrong_apart() -> None:
    shot = next(shot for shot in shots("two_targets") if len(shot.wanted) == 2)
    first, second = shot.wanted
    right = judge_frame(0, shot, [observed(shot, first), observed(shot, second)])
    assert (right.wanted, right.found, right.wrong) == (2, 2, ())
    reason = Reason.NO_CANDIDATE
    missed = judge_frame(0, shot, [observed(shot, first), Miss(second.plate.target.name, reason)])
    assert (missed.found, missed.missed[0][0]) == (1, "no_candidate")
    far = Pose(first.pose.rotation, 1.03 * first.pose.translation_m)
    for badly in (far, first.pose.turned(35.0)):
        off = judge_frame(0, shot, [observed(shot, first, badly), observed(shot, second)])
        assert (off.found, len(off.off), off.wrong) == (1, 1, ())
    swapped = observed(shot, first, second.pose)
    wrong = judge_frame(0, shot, [swapped, observed(shot, second)])
    assert (wrong.found, len(wrong.missed), len(wrong.wrong)) == (1, 1, 1)
    assert wrong.wrong[0][0] == second.plate.target.name
    twice = judge_frame(
        0, shot, [observed(shot, first), observed(shot, first), observed(shot, second)]
    )
    assert (twice.found, len(twice.wrong)) == (2, 1)


def test_intervals_are_wilson_s() -> None:
    """Of Newcombe, Statistics in Medicine 17 (1998), 857–872, Table I."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


def test_well_seen_plates_are_found_and_decoys_are_not() -> None:
    """A coarse guard; `make bench-search` has the numbers."""
    for name in ("middle", "cut", "two_targets", "decoys"):
        (verdict,) = hard_frames.run_set(SETS_BY_NAME[name], 1, 1, 1)
        assert verdict.found == verdict.wanted
        assert not verdict.wrong


def test_the_command_prints_a_line_per_set_and_one_frame_alone(tmp_path: Path) -> None:
    runner = CliRunner()
    arguments = ["--only", "middle", "--frames", "2", "--jobs", "1"]
    table = runner.invoke(hard_frames.main, arguments, catch_exceptions=False).stdout
    assert re.search(r"middle +2 +2/2 +100\.0 ", table)
    saved = tmp_path / "frame.png"
    arguments = ["--only", "shadow", "--frame", "1", "--save", str(saved)]
    told = runner.invoke(hard_frames.main, arguments, catch_exceptions=False).stdout
    assert "wanted: A at" in told
    shot = SETS_BY_NAME["shadow"].shot(1, 1)
    frame = cv2.imread(str(saved), cv2.IMREAD_GRAYSCALE)
    assert frame is not None
    assert frame.shape == (shot.camera.height, shot.camera.width)


def test_every_set_can_be_planned() -> None:
    for frame_set in SETS:
        shot = frame_set.shot(5, 7)
        assert shot.wanted or shot.decoys


def test_photographs_without_targets_raise_no_alarm(tmp_path: Path) -> None:
    rng = stream(1, "noise", 0, "test")
    texture = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (700, 900)), (0, 0), 3.0)
    texture = 128.0 + 8.0 * (texture - 128.0)
    cv2.imwrite(str(tmp_path / "noise.png"), np.clip(texture, 0, 255).astype(np.uint8))
    runner = CliRunner()
    arguments = [str(tmp_path), "--variants", "3", "--jobs", "1"]
    told = runner.invoke(false_alarms.main, arguments, catch_exceptions=False).stdout
    assert "3 pictures of 1 photographs, 5 layouts: 0 with a false alarm" in told
    absent = runner.invoke(false_alarms.main, [str(tmp_path / "none")], catch_exceptions=False)
    assert "nothing was searched" in absent.stdout


def test_variants_are_the_same_each_time(tmp_path: Path) -> None:
    ramp = np.add.outer(np.arange(800) % 251, np.arange(1000) % 5).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "ramp.png"), ramp)
    path = tmp_path / "ramp.png"
    np.testing.assert_array_equal(false_alarms.picture(path, 1, 0), ramp)
    first, again = (false_alarms.picture(path, 1, 5) for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_a_real_target_among_photographs_would_be_seen(tmp_path: Path) -> None:
    grey = hard_frames.picture(SETS_BY_NAME["middle"], 1, 0)
    cv2.imwrite(str(tmp_path / "target.png"), grey)
    alarm = false_alarms.alarm_of((tmp_path / "target.png", 1, 0))
    assert len(alarm.accepted) == 1
    assert alarm.accepted[0].startswith(TARGET_A.name)
