"""Comparison of the positions of static targets: which one is wrong, and when none is."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.frame_poses import UNSTATED_SCALE_SD, FramePose
from kgcp.network.ground.point_images import CameraPose
from kgcp.network.ground.position_check import (
    FastCamera,
    WrongCamera,
    WrongPosition,
    wrong_input,
)
from kgcp.network.ground.target_moves import MovedTarget
from tests.ground_flight import CAMERA, GroundFlight

SD_PX, SD_DISTANCE = 0.005, 2e-4


def checked(
    targets: int,
    seed: int,
    *,
    off_m: float = 0.0,
    sd_m: float = 0.01,
    noise: float = 1.0,
    move_m: float = 0.0,
    motion_px: float = 0.0,
    left_out: int | None = None,
) -> tuple[str, WrongPosition | MovedTarget | None]:
    """The target with a wrong height, and the result of the check; noise in stated deviations.

    It is `move_m` further north in the second half of the frames. In each frame, the image moves by
    some `motion_px` from the first row to the last. All frames leave out the target so many after
    the wrong one, if any.
    """
    rng = np.random.default_rng(seed)
    names = tuple("ABCDEF"[:targets])
    offsets_m = rng.uniform(-4.0, 4.0, (targets, 3)) * [1.0, 1.0, 0.2]
    flight = GroundFlight(names, offsets_m, frames=6, seed=seed)
    sightings, poses = [], []
    for row, frame in enumerate(flight.frame_names):
        places = flight.positions.copy()
        places[seed % targets, 1] += move_m * (row >= flight.frames // 2)
        seen = (places - flight.centres[row]) @ flight.rotations[row]
        pixels = CAMERA.project(seen) + noise * SD_PX * rng.standard_normal((targets, 2))
        if motion_px:
            rows = pixels[:, 1:] / CAMERA.height - 0.5
            pixels = pixels + rows * motion_px * rng.standard_normal(2)
        far_m = np.linalg.norm(seen, axis=1)
        far_m = far_m * (1.0 + noise * SD_DISTANCE * rng.standard_normal(targets))
        sightings += [
            Sighting(
                frame=frame,
                number=row + 1,
                target=name,
                instance=0,
                time_s=None,
                centre_px=pixel,
                centre_cov_px2=SD_PX**2 * np.eye(2),
                distance_m=distance_m,
                sd_distance_m=SD_DISTANCE * distance_m,
                sd_common_distance_m=None,
            )
            for name, pixel, distance_m in zip(names, pixels, far_m.tolist(), strict=True)
        ]
        pose = CameraPose(flight.centres[row], flight.rotations[row])
        zeros = np.zeros((targets, 3))
        out = None if left_out is None else names[(seed + left_out) % targets]
        used = tuple(name for name in names if name != out)
        poses.append(FramePose(frame, names, pose, np.eye(6), used, "", residuals=zeros))
    places_m = flight.positions + sd_m * rng.standard_normal((targets, 3))
    wrong = seed % targets
    places_m[wrong, 2] += off_m
    cov_m2 = sd_m**2 * np.eye(3)
    positions = {
        name: TargetPosition(place, cov_m2) for name, place in zip(names, places_m, strict=True)
    }
    found = wrong_input(poses, sightings, positions, CAMERA, UNSTATED_SCALE_SD)
    assert not isinstance(found, (WrongCamera, FastCamera))
    return names[wrong], found


@pytest.mark.parametrize(("targets", "named"), [(4, (2.2, 3.6)), (6, (1.05, 2.0))])
def test_the_wrong_position_is_named_among_few_others(
    targets: int, named: tuple[float, float]
) -> None:
    """Four targets hardly show which of them is wrong, six do."""
    found = [checked(targets, seed, off_m=0.1) for seed in range(40)]
    found_wrong = [(true, wrong) for true, wrong in found if isinstance(wrong, WrongPosition)]
    assert len(found_wrong) >= 28
    assert all(true in wrong.targets for true, wrong in found_wrong)
    assert named[0] < float(np.mean([len(wrong.targets) for _, wrong in found_wrong])) < named[1]
    off_m = [wrong.off_m for true, wrong in found_wrong if wrong.targets[0] == true]
    assert float(np.median(off_m)) == pytest.approx(0.1, rel=0.25)


@pytest.mark.parametrize("targets", [4, 5])
@pytest.mark.parametrize("left_out", [0, 1])
def test_a_right_target_that_frames_leave_out_is_not_blamed_alone(
    targets: int, left_out: int
) -> None:
    """Three others that agree with a wrong height leave out a right one."""
    found = [checked(targets, seed, off_m=0.1, left_out=left_out) for seed in range(12)]
    found_wrong = [(true, wrong) for true, wrong in found if isinstance(wrong, WrongPosition)]
    assert len(found_wrong) >= 7
    assert all(true in wrong.targets for true, wrong in found_wrong)
    right = [checked(targets, seed, left_out=left_out)[1] for seed in range(12)]
    assert right == [None] * 12


@pytest.mark.parametrize("sd_m", [0.0003, 0.01])
@pytest.mark.parametrize("noise", [0.1, 1.0, 10.0])
def test_image_noise_other_than_stated_contradicts_no_position(sd_m: float, noise: float) -> None:
    """Residuals that no position explains enlarge the covariances of the images."""
    found = [checked(6, seed, sd_m=sd_m, noise=noise)[1] for seed in range(12)]
    assert found == [None] * 12


def test_a_wrong_position_is_found_with_images_worse_than_stated() -> None:
    found = [checked(6, seed, off_m=0.1, noise=10.0) for seed in range(12)]
    found_wrong = [(true, wrong) for true, wrong in found if isinstance(wrong, WrongPosition)]
    assert len(found_wrong) >= 11
    assert all(wrong.targets[0] == true for true, wrong in found_wrong)
    assert float(np.median([wrong.off_m for _, wrong in found_wrong])) == pytest.approx(
        0.1, rel=0.15
    )


@pytest.mark.parametrize("targets", [4, 5])
def test_a_move_of_three_deviations_is_found(targets: int) -> None:
    """Frames show it, though they agree with the positions before and after."""
    for seed in range(4):
        target, found = checked(targets, seed, move_m=0.03)
        assert isinstance(found, MovedTarget)
        assert (found.target, found.frame) == (target, "f_003.png")
        assert found.off_m == pytest.approx(0.03, abs=0.003)


def test_a_moving_image_is_no_moved_target() -> None:
    """A rolling shutter that is not declared looks like moves of all targets."""
    found = [checked(5, seed, motion_px=3.0)[1] for seed in range(12)]
    assert not any(isinstance(each, MovedTarget) for each in found)
