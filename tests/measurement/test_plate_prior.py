"""The prior on the plate's normal chooses one of two poses and changes no other value."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import expit

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.frame import examine
from kgcp.measurement.plate_prior import NormalPrior, PlatePrior
from kgcp.measurement.records import Alternative, Measurement
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import image_plate
from kgcp.targets.layout import Target

CAMERA = Camera(1600, 1200, 2306.0, 2302.0, 792.6, 603.9, response=Response.LINEAR)
DOWN = np.array([0.0, 0.0, 1.0])
SD_DEG = 1.5
PRIOR = NormalPrior(DOWN, SD_DEG)
FRAMES = 12
SENSOR = Sensor(full_well_e=2000.0, read_noise_e=20.0)


def far_pose(rng: np.random.Generator) -> Pose:
    """A plate that lies level but for SD_DEG, 120 m away and off the axis: R = 9 px."""
    ray = np.array([*rng.choice((-1.0, 1.0), 2) * rng.uniform((0.06, 0.06), (0.2, 0.2)), 1.0])
    tilt = Rotation.from_rotvec(np.radians([*rng.normal(0.0, SD_DEG, 2), 0.0]))
    turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True)
    return Pose((tilt * turn).as_matrix(), ray * 120.0 / float(np.linalg.norm(ray)))


def photograph(pose: Pose, rng: np.random.Generator) -> GreyArray:
    irradiance = np.full((CAMERA.height, CAMERA.width), 0.2)
    image_plate(CAMERA, TARGET_PLATE, pose, Optics(1.0)).paste(irradiance)
    return SENSOR.expose(irradiance, 0.9, rng)


def measure(
    grey: GreyArray, prior: NormalPrior | None, target: Target = TARGET_PLATE.target
) -> Measurement:
    priors = {target.name: PlatePrior(prior)}
    (outcome,) = examine(grey, CAMERA, (target,), DetectSettings(), priors).outcomes
    assert isinstance(outcome, Measurement)
    return outcome


@cache
def frame(number: int) -> tuple[Pose, GreyArray, Measurement]:
    """The true pose, the image, and the measurement from the image alone."""
    rng = np.random.default_rng(number)
    pose = far_pose(rng)
    grey = photograph(pose, rng)
    return pose, grey, measure(grey, None)


def angle_deg(one: Pose, other: Pose) -> float:
    return math.degrees(math.acos(min(1.0, float(one.normal @ other.normal))))


def other_pose(seen: Measurement) -> Alternative:
    assert seen.alternative is not None
    return seen.alternative


def is_right(seen: Measurement, truth: Pose) -> bool:
    return angle_deg(seen.pose, truth) < angle_deg(other_pose(seen).pose, truth)


def test_the_prior_chooses_the_right_pose_if_the_image_cannot() -> None:
    by_image = [other_pose(frame(i)[2]).ambiguity for i in range(FRAMES)]
    assert np.median(by_image) < 4.0, "the image alone is not sure"
    corrected = [measure(frame(i)[1], PRIOR) for i in range(FRAMES)]
    assert all(is_right(seen, frame(i)[0]) for i, seen in enumerate(corrected))
    assert min(other_pose(seen).ambiguity for seen in corrected) > 10.0


def test_a_reversed_choice_exchanges_the_poses_and_nothing_else() -> None:
    for number in range(5):
        _, grey, before = frame(number)
        after = measure(grey, NormalPrior(other_pose(before).pose.normal, SD_DEG))
        assert angle_deg(after.pose, other_pose(before).pose) < 1.0
        assert angle_deg(other_pose(after).pose, before.pose) < 1.0
        assert before.uncertainty is not None
        assert abs(after.pose.distance_m - before.pose.distance_m) < (
            2.0 * before.uncertainty.sd_distance_m
        )
        assert other_pose(after).ambiguity >= 0.0


def test_a_confirmed_choice_keeps_every_value() -> None:
    _, grey, before = frame(0)
    after = measure(grey, NormalPrior(before.pose.normal, SD_DEG))
    assert np.array_equal(after.pose.rotation, before.pose.rotation)
    assert np.array_equal(after.pose.translation_m, before.pose.translation_m)
    assert other_pose(after).ambiguity > other_pose(before).ambiguity


def test_confirming_a_pose_removes_the_covariance_of_the_other_pose() -> None:
    """The covariance of the other pose is its probability times its squared difference."""
    _, grey, before = frame(0)
    after = measure(grey, NormalPrior(before.pose.normal, SD_DEG))
    assert before.uncertainty is not None
    assert after.uncertainty is not None
    often, hardly = (expit(-0.5 * other_pose(seen).ambiguity) for seen in (before, after))
    assert hardly < 0.01
    assert often > 0.05
    off_m = other_pose(before).pose.translation_m - before.pose.translation_m
    less = (before.uncertainty.pose_cov - after.uncertainty.pose_cov)[:3, :3]
    expected = (often - hardly) * np.outer(off_m, off_m)
    np.testing.assert_allclose(less, expected, rtol=0.0, atol=1e-3 * np.abs(expected).max())


def test_a_vague_prior_does_not_decide() -> None:
    _, grey, before = frame(0)
    after = measure(grey, NormalPrior(DOWN, 5000.0))
    assert np.array_equal(after.pose.rotation, before.pose.rotation)
    assert other_pose(after).ambiguity == pytest.approx(other_pose(before).ambiguity, abs=1e-3)


def test_chi2_counts_prior_and_measurement() -> None:
    pose = Pose(Rotation.from_euler("x", 3.0, degrees=True).as_matrix(), 10.0 * DOWN)
    exact = np.zeros((3, 3))
    assert NormalPrior(DOWN, 1.5).chi2(pose, exact) == pytest.approx(4.0)
    noisy = math.radians(2.0) ** 2 * np.eye(3)
    assert NormalPrior(DOWN, 1.5).chi2(pose, noisy) == pytest.approx(9.0 / (1.5**2 + 2.0**2))
    about_z = np.diag([0.0, 0.0, 1.0])  # a heading that is not known does not excuse a tilt
    upright = Pose(np.eye(3), 10.0 * DOWN)
    assert NormalPrior(pose.normal, 1.5).chi2(upright, about_z) == pytest.approx(4.0)
    assert NormalPrior(pose.normal, 1.5).chi2(pose, noisy) == pytest.approx(0.0, abs=1e-12)
