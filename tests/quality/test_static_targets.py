"""Comparison of static targets: wrong positions, exchanged names, moves, single frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, ReferencePoses, opk_from_rotation
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition, TargetPositions, Vehicle
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause, Doubt
from kgcp.quality.checks.static_targets import (
    PlainSearch,
    check_overlaps,
    check_places,
    check_searches,
    check_static_targets,
    check_vehicle,
)
from kgcp.settings import VehicleSettings
from kgcp.targets.plain import PlainPolarity, PlainTarget
from tests.ground_flight import CAMERA, GroundFlight

Changed = Callable[[int, str, Pose], tuple[str, Pose]]
SD_M = 0.01


def seen(
    flight: GroundFlight, changed: Changed = lambda _, name, pose: (name, pose)
) -> list[Sighting]:
    """The targets of all frames, some of them changed."""
    sightings = []
    for row, frame in enumerate(flight.frame_names):
        for column, true in enumerate(flight.names):
            pose, cov = flight.measured(row, column)
            name, pose = changed(row, true, pose)
            sightings.append(
                Sighting(
                    frame=frame,
                    number=row + 1,
                    target=name,
                    instance=0,
                    time_s=None,
                    centre_px=CAMERA.project(pose.translation_m[None])[0],
                    centre_cov_px2=None,
                    distance_m=pose.distance_m,
                    sd_distance_m=None,
                    sd_common_distance_m=None,
                    pose=pose,
                    pose_cov=cov,
                )
            )
    return sightings


def stated(flight: GroundFlight, off_m: FloatArray | float = 0.0) -> dict[str, TargetPosition]:
    places = flight.positions + off_m
    cov_m2 = SD_M**2 * np.eye(3)
    return {
        name: TargetPosition(place, cov_m2)
        for name, place in zip(flight.names, places, strict=True)
    }


def check(
    sightings: list[Sighting], positions: dict[str, TargetPosition], camera: Camera = CAMERA
) -> tuple[Doubt, ...]:
    return tuple(check_static_targets(sightings, positions, camera))


def shifted(pose: Pose, off_m: FloatArray) -> Pose:
    return Pose(pose.rotation, pose.translation_m + off_m)


@pytest.mark.parametrize("seed", range(8))
def test_positions_and_prints_as_good_as_stated_raise_no_doubt(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flight = GroundFlight(seed=seed)
    prints = dict(zip(flight.names, 1.0 + 0.005 * rng.standard_normal(4), strict=True))

    def printed(_: int, name: str, pose: Pose) -> tuple[str, Pose]:
        return name, Pose(pose.rotation, prints[name] * pose.translation_m)

    assert check(seen(flight, printed), stated(flight, SD_M * rng.standard_normal((4, 3)))) == ()


def test_a_common_error_of_prints_up_to_two_percent_raises_no_doubt() -> None:
    for permille in (-15.0, 15.0):
        flight = GroundFlight(stated_diameter_m=0.9 * (1.0 + 1e-3 * permille))
        assert check(seen(flight), stated(flight)) == ()
    flight = GroundFlight(stated_diameter_m=0.45)
    (doubt,) = check(seen(flight), stated(flight))
    assert doubt.code is Cause.DISTANCE_SCALE
    assert "50 % closer to each other" in doubt.sentence


@pytest.mark.parametrize("off_m", [0.3, 3.0])
def test_a_wrong_position_is_reported_with_its_target(off_m: float) -> None:
    flight = GroundFlight()
    (doubt,) = check(seen(flight), stated(flight, np.outer([0, 1, 0, 0], [off_m, 0.0, 0.0])))
    assert doubt.code is Cause.STATIC_TARGETS
    assert doubt.is_grave
    assert "B contradicts most others" in doubt.sentence
    assert doubt.figures["frames"] >= 6
    assert 0.6 * off_m < abs(doubt.figures["off_m"]) < 1.1 * off_m


def test_stated_larger_deviations_of_prints_are_allowed_for() -> None:
    flight = GroundFlight()

    def larger(_: int, name: str, pose: Pose) -> tuple[str, Pose]:
        return name, Pose(pose.rotation, (1.2 if name == "A" else 1.0) * pose.translation_m)

    sightings = seen(flight, larger)
    (doubt,) = check(sightings, stated(flight))
    assert "A contradicts" in doubt.sentence
    known = [replace(each, sd_common_distance_m=0.1 * each.distance_m) for each in sightings]
    assert check(known, stated(flight)) == ()


def test_exchanged_names_are_reported() -> None:
    offsets_m = np.vstack((GroundFlight().offsets_m, [[0.5, 1.0, 0.0]]))
    flight = GroundFlight(names=("A", "B", "C", "D", "E"), offsets_m=offsets_m)
    other = {"A": "E", "E": "A"}
    (doubt,) = check(
        seen(flight, lambda _, name, pose: (other.get(name, name), pose)), stated(flight)
    )
    assert "A and E contradict most others" in doubt.sentence


def test_a_moved_target_is_reported() -> None:
    flight = GroundFlight()

    def moved(row: int, name: str, pose: Pose) -> tuple[str, Pose]:
        east = flight.rotations[row].T @ np.array([0.4, 0.0, 0.0])
        return name, shifted(pose, east) if name == "C" and row >= 6 else pose

    (doubt,) = check(seen(flight, moved), stated(flight))
    assert 4 <= doubt.figures["frames"] <= 6
    assert "C contradicts most others" in doubt.sentence


def test_another_target_in_a_single_frame_is_reported_with_the_frame() -> None:
    flight = GroundFlight()

    def taken(row: int, name: str, pose: Pose) -> tuple[str, Pose]:
        return name, shifted(pose, np.array([2.0, 1.0, 0.0])) if (row, name) == (5, "D") else pose

    (doubt,) = check(seen(flight, taken), stated(flight))
    assert doubt.code is Cause.SINGLE_FRAMES
    assert not doubt.is_grave
    assert "D in f_005.png" in doubt.sentence


def test_frames_with_two_plates_of_one_code_raise_no_doubt() -> None:
    flight, beside_m = GroundFlight(), np.array([2.0, 1.0, 0.0])
    spares = seen(flight, lambda _, name, pose: (name, shifted(pose, beside_m)))
    best = [each for each in spares if each.target == "D"]
    second = [replace(each, instance=1) if each.target == "D" else each for each in seen(flight)]
    assert check([*best, *second], stated(flight)) == ()


def test_two_targets_contradict_each_other() -> None:
    flight = GroundFlight(names=("A", "B"), offsets_m=GroundFlight().offsets_m[:2])
    assert check(seen(flight), stated(flight)) == ()
    (doubt,) = check(seen(flight), stated(flight, np.outer([0, 1], [1.0, 0.0, 0.0])))
    assert "A and B contradict most others" in doubt.sentence
    (doubt,) = check(seen(flight), {name: stated(flight)["A"] for name in "AB"})
    assert "8 m farther from each other" in doubt.sentence


@pytest.mark.parametrize("factor", [-1.0, 1.0])
def test_an_error_below_two_percent_of_a_single_distance_is_no_factor(factor: float) -> None:
    offsets_m = np.array([[-10.0, -3.0, 0.0], [10.0, -3.0, 0.5]])
    flight = GroundFlight(names=("A", "B"), offsets_m=offsets_m)
    assert check(seen(flight), stated(flight)) == ()
    (doubt,) = check(seen(flight), stated(flight, np.outer([0, factor], [0.39, 0.0, 0.0])))
    assert doubt.code is Cause.STATIC_TARGETS
    assert abs(doubt.figures["off_m"]) == pytest.approx(0.39, abs=0.1)


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_one_wrong_position_of_three_is_no_factor_of_all_distances(wrong: int) -> None:
    flight = GroundFlight(names=("A", "B", "C"), offsets_m=GroundFlight().offsets_m[:3])
    (doubt,) = check(seen(flight), stated(flight, np.outer(np.arange(3) == wrong, [0.3, 0.0, 0.0])))
    assert doubt.code is Cause.STATIC_TARGETS


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("is_common", [False, True])
def test_prints_and_focal_lengths_off_by_permille_raise_no_doubt(
    count: int, *, is_common: bool
) -> None:
    offsets_m = GroundFlight().offsets_m[:count]
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        flight = GroundFlight(names=tuple("ABCD"[:count]), offsets_m=offsets_m, seed=seed)
        prints = 1.0 + 0.003 * rng.standard_normal(1 if is_common else count)
        factors = dict(zip(flight.names, np.resize(prints, count).tolist(), strict=True))

        def printed(
            _: int, name: str, pose: Pose, factors: dict[str, float] = factors
        ) -> tuple[str, Pose]:
            return name, Pose(pose.rotation, factors[name] * pose.translation_m)

        positions = stated(flight, SD_M * rng.standard_normal((count, 3)))
        assert check(seen(flight, printed), positions) == ()


def test_distortions_by_a_rolling_shutter_raise_no_doubt() -> None:
    flight = GroundFlight()
    rolling = replace(CAMERA, readout_s=0.1)

    def sheared(_: int, name: str, pose: Pose) -> tuple[str, Pose]:
        rows = CAMERA.project(pose.translation_m[None])[0, 1] / (CAMERA.height - 1) - 0.5
        return name, shifted(pose, np.array([0.0, 8.0 * 0.1 * rows, 0.0]))

    assert check(seen(flight, sheared), stated(flight)) != ()
    assert check(seen(flight, sheared), stated(flight), rolling) == ()
    (doubt,) = check(
        seen(flight, sheared), stated(flight, np.outer([0, 1, 0, 0], [2.0, 2.0, 0.0])), rolling
    )
    assert "B contradicts most others" in doubt.sentence


@pytest.mark.parametrize(("off_m", "is_reported"), [(0.009, False), (0.018, True)])
def test_millimetres_between_neighbours_raise_no_doubt(
    off_m: float,
    is_reported: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    """Nobody surveys better, and plates bend: also of positions that are stated as exact."""
    flight = GroundFlight(names=("A", "B"), offsets_m=np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    flight.centres[:, :2] *= 0.01  # from above, prints hardly distort the distance
    exactly = seen(flight, lambda row, name, _: (name, flight.pose(row, "AB".index(name))))
    exactly = [replace(each, pose_cov=None) for each in exactly]
    east_m = off_m * np.array([1.0, 0.0, 0.0])
    positions = {
        name: TargetPosition(place, None)
        for name, place in zip(
            "AB", (flight.positions[0], flight.positions[1] + east_m), strict=True
        )
    }
    assert bool(check(exactly, positions)) == is_reported


@pytest.mark.parametrize(("factor", "is_reported"), [(1.0, False), (10.0, True)])
def test_scatter_beyond_the_stated_deviations_is_reported(
    factor: float,
    is_reported: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    """Small targets, far away: what is measured of them is all there is to contradict."""
    flight, rng, sd_m = GroundFlight(), np.random.default_rng(4), 0.1
    sightings = seen(
        flight, lambda _, name, pose: (name, shifted(pose, factor * sd_m * rng.normal(size=3)))
    )
    cov = np.diag([sd_m**2] * 3 + [1e-6] * 3)
    sightings = [replace(each, pose_cov=cov) for each in sightings]
    assert bool(check(sightings, stated(flight))) == is_reported


@pytest.mark.parametrize(("frames", "cause"), [(2, Cause.SINGLE_FRAMES), (4, Cause.STATIC_TARGETS)])
def test_a_target_elsewhere_in_few_frames_is_a_fault_of_the_frames(
    frames: int, cause: Cause
) -> None:
    """Of twelve frames."""
    flight = GroundFlight()

    def taken(row: int, name: str, pose: Pose) -> tuple[str, Pose]:
        is_elsewhere = name == "D" and row < frames
        return name, shifted(pose, np.array([2.0, 1.0, 0.0])) if is_elsewhere else pose

    (doubt,) = check(seen(flight, taken), stated(flight))
    assert doubt.code is cause


def test_frames_with_one_target_raise_no_doubt() -> None:
    flight = GroundFlight(names=("A",), offsets_m=GroundFlight().offsets_m[:1])
    assert check(seen(flight), stated(flight)) == ()


def test_stated_larger_deviations_of_positions_are_allowed_for() -> None:
    flight, off_m = GroundFlight(), np.outer([0, 1, 0, 0], [0.4, 0.0, 0.0])
    unsure = {
        name: TargetPosition(place.position_m, 0.1**2 * np.eye(3))
        for name, place in stated(flight, off_m).items()
    }
    assert check(seen(flight), stated(flight, off_m)) != ()
    assert check(seen(flight), unsure) == ()


def test_another_plate_with_the_same_code_is_ignored() -> None:
    flight = GroundFlight()
    sightings = seen(flight)
    others = [
        replace(each, instance=1, pose=shifted(each.pose, np.array([2.0, 0.0, 0.0])))
        for each in sightings
        if each.target == "B" and each.pose is not None
    ]
    assert check([*sightings, *others], stated(flight)) == ()


def test_a_contradiction_in_one_of_three_frames_is_no_wrong_position() -> None:
    flight = GroundFlight(frames=3)

    def taken(row: int, name: str, pose: Pose) -> tuple[str, Pose]:
        return name, shifted(pose, np.array([2.0, 1.0, 0.0])) if (row, name) == (1, "D") else pose

    (doubt,) = check(seen(flight, taken), stated(flight))
    assert doubt.code is Cause.SINGLE_FRAMES


def reference(flight: GroundFlight, sd_m: float | None) -> ReferencePoses:
    """Poses as true as their standard deviations say; None: they state none."""
    rng, frame = np.random.default_rng(7), flight.local_frame
    centres = flight.centres + (sd_m or 0.0) * rng.standard_normal(flight.centres.shape)
    to_map = np.swapaxes(frame.grid_rotation(flight.centres), 1, 2)
    return ReferencePoses(
        flight.frame_names,
        frame.map_from_enu(centres),
        opk_from_rotation(to_map @ flight.rotations @ CAMERA_FROM_PHOTO),
        None if sd_m is None else np.full((flight.frames, 3), sd_m),
        None if sd_m is None else np.full(flight.frames, 0.01),
    )


def check_by_poses(
    flight: GroundFlight, off_m: FloatArray | float, sd_m: float | None = 0.02
) -> tuple[Doubt, ...]:
    poses = reference(flight, sd_m)
    positions = stated(flight, off_m)
    return tuple(check_places(seen(flight), positions, poses, CAMERA, flight.local_frame))


@pytest.mark.parametrize("sd_m", [None, 0.02, 0.3])
def test_positions_that_poses_confirm_raise_no_doubt(sd_m: float | None) -> None:
    for seed in range(8):
        rng = np.random.default_rng(200 + seed)
        scale = 1.0 + 0.005 * rng.standard_normal()
        flight = GroundFlight(seed=seed, stated_diameter_m=0.9 * scale)
        assert check_by_poses(flight, SD_M * rng.standard_normal((4, 3)), sd_m) == ()


def test_a_camera_that_moves_while_its_frames_are_read_raises_no_doubt() -> None:
    """It flies down its image: what is read later is displaced outwards."""
    flight, camera = GroundFlight(), replace(CAMERA, readout_s=0.1)
    velocity_m_s = 30.0 * flight.rotations[:, :, 1]
    sightings = [
        replace(one, pose=shifted(one.pose, np.array([0.0, -30.0 * one.delay_s(camera), 0.0])))
        for one in seen(flight)
        if one.pose is not None
    ]
    rest, sds = np.zeros_like(velocity_m_s), np.full(flight.frames, 0.01)
    motions = CameraMotions(velocity_m_s, sds, rest, 0.1 * sds, np.ones(flight.frames, np.bool_))
    inputs = sightings, stated(flight), reference(flight, 0.02), camera, flight.local_frame
    assert [*check_places(*inputs)] != []
    assert [*check_places(*inputs, motions)] == []


@pytest.mark.parametrize("names", ["A", "ABCD"])
def test_heights_or_datum_other_than_those_of_the_poses_are_grave(names: str) -> None:
    """Also of a single target, to which no other can be compared."""
    count = len(names)
    flight = GroundFlight(names=tuple(names), offsets_m=GroundFlight().offsets_m[:count])
    heights_m = np.array([0.0, 0.0, 40.0])
    assert check(seen(flight), stated(flight, heights_m)) == ()
    (doubt,) = check_by_poses(flight, heights_m)
    assert (doubt.code, doubt.is_grave) == (Cause.STATIC_TARGETS, True)
    assert "40 m down from" in doubt.sentence
    assert doubt.figures["targets"] == count
    (doubt,) = check_by_poses(flight, np.array([0.6, -0.5, 0.0]), None)
    assert "0.6 m west and 0.5 m north from" in doubt.sentence
    assert ("all 4 lie alike" in doubt.sentence) == (count == 4)


def test_names_exchanged_between_two_targets_are_grave_by_poses() -> None:
    """Their distance from each other is the same in either case."""
    flight = GroundFlight(names=("A", "B"), offsets_m=GroundFlight().offsets_m[:2])
    exchanged_m = flight.positions[::-1] - flight.positions
    assert check(seen(flight), stated(flight, exchanged_m)) == ()
    (doubt,) = check_by_poses(flight, exchanged_m)
    assert "lies 8 m" in doubt.sentence
    assert "2 of 2 targets do not fit" in doubt.sentence


def beside_vehicle(flight: GroundFlight, sd_m: float | None) -> TargetPositions:
    """The positions if the last target is on a vehicle that stands there."""
    time_s = np.arange(100.0)
    sd = None if sd_m is None else np.full((100, 3), sd_m)
    axes = np.broadcast_to(np.eye(3), (100, 3, 3)).copy()
    motion = Motion(time_s, np.tile(flight.positions[-1], (100, 1)), axes, sd, None)
    vehicle = Vehicle(motion, VehicleSettings(), flight.local_frame)
    static = {name: place for name, place in stated(flight).items() if name != "D"}
    return TargetPositions(flight.local_frame, static, vehicle)


@pytest.mark.parametrize("sd_m", [None, 0.02])
def test_a_vehicle_that_is_not_where_targets_on_the_ground_see_it_is_grave(
    sd_m: float | None,
) -> None:
    flight = GroundFlight()
    places = beside_vehicle(flight, sd_m)
    timed = [replace(each, time_s=10.0 + each.number) for each in seen(flight)]
    assert [*check_vehicle(timed, places, CAMERA)] == []
    for off_m in ([0.0, 0.0, 40.0], [1.2, 0.0, 0.0]):
        static = {
            name: replace(place, position_m=place.position_m + off_m)
            for name, place in places.static.items()
        }
        (doubt,) = check_vehicle(timed, replace(places, static=static), CAMERA)
        assert (doubt.code, doubt.is_grave) == (Cause.STATIC_TARGETS, True)
        assert "D on the vehicle and" in doubt.sentence
    assert [*check_vehicle(timed[:3], places, CAMERA)] == []  # a frame without the vehicle


def searches(share: float, sigmas: float, seed: int = 4) -> list[PlainSearch]:
    """Six targets in ten frames, of which a share is found, by poses that are so far off."""
    rng = np.random.default_rng(seed)
    made = []
    for frame in range(10):
        chi2 = sigmas**2 * float(rng.chisquare(2))  # the same of all targets
        for name in "ABCDEF":
            is_found = rng.uniform() < share
            made.append(PlainSearch(f"f_{frame}.png", name, chi2 if is_found else None))
    return made


def test_poses_that_have_plain_targets_at_wrong_places_are_doubted() -> None:
    (doubt,) = check_searches(searches(0.3, 2.0))
    assert doubt.is_grave
    assert doubt.code is Cause.REFERENCE
    assert "of 60 places where the reference poses have them" in doubt.sentence
    assert not list(check_searches(searches(0.95, 1.0)))
    hidden = [*check_searches(searches(0.4, 1.0))]  # most of them, for another reason
    assert not any(doubt.is_grave for doubt in hidden)


def test_a_plain_target_that_is_hardly_ever_found_is_named() -> None:
    made = [each._replace(chi2=None) if each.target == "C" else each for each in searches(1.0, 1.0)]
    (doubt,) = check_searches(made)
    assert doubt.sentence.startswith("C: found at 0 of 10 places")
    assert not doubt.is_grave
    assert "polarity" in doubt.remedy


@pytest.mark.parametrize(
    ("apart_m", "sd_m", "doubts"), [(0.0, 0.0, 1), (0.2, 0.01, 1), (0.2, 0.3, 0), (0.6, 0.0, 0)]
)
def test_targets_that_would_overlap_are_named(apart_m: float, sd_m: float, doubts: int) -> None:
    """They would if they are closer than the sum of their radii, beyond three deviations."""
    dark, place = PlainPolarity.DARK, (0.0, 0.0, 0.0)
    targets = [PlainTarget(name, (0.5,), dark, position_m=place) for name in "AB"]
    cov_m2 = sd_m**2 * np.eye(3) if sd_m else None
    there = np.array([apart_m, 0.0, 0.0])
    positions = {"A": TargetPosition(0.0 * there, cov_m2), "B": TargetPosition(there, cov_m2)}
    assert len([*check_overlaps(targets, positions)]) == doubts
