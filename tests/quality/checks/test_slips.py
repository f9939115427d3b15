"""Parts of the search for causes that the tests with wrong flights do not cover."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.georef.trajectory import Motion
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.detections import read_attempts
from kgcp.quality.checks.causes import causes_of
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.encounters import Encounters, misfit_of
from kgcp.quality.checks.measured import _of_encounters
from kgcp.quality.checks.mount import check_mount
from kgcp.quality.checks.patterns import check_lone_frames, patterns, unexplained
from kgcp.quality.checks.slips import remeasured, slips, without_distortion
from tests.wrong_flights.flights import CAMERA, changed, flight


@pytest.fixture(scope="module")
def encounters(tmp_path_factory: pytest.TempPathFactory) -> Encounters:
    """Those of the sample flight, without any slip."""
    return of(tmp_path_factory.mktemp("right") / "flight", CAMERA)


def of(folder: Path, camera: Mapping[str, float]) -> Encounters:
    found = Encounters.of(*inputs_of(folder, camera))
    assert found is not None
    return found


def inputs_of(
    folder: Path, camera: Mapping[str, float]
) -> tuple[list[Sighting], TargetPositions, ReferencePoses, Camera]:
    replace(flight(), camera=camera).write(folder)
    read = read_flight(folder)
    attempts = read_attempts(folder / "kgcp" / "detections.parquet", read)
    data = FlightData(read, [attempt.frame for attempt in attempts])
    sightings = [attempt.sighting for attempt in attempts if attempt.sighting is not None]
    return sightings, data.target_positions, data.reference_poses, read.camera


def test_a_correct_flight_fits_and_needs_no_cause(encounters: Encounters) -> None:
    assert 0.1 < encounters.misfit < 2.0
    assert causes_of(encounters) == ()
    assert not [*check_mount(encounters)]
    assert not [*check_lone_frames(encounters)]


def test_interpolated_cubics_equal_the_motion(encounters: Encounters) -> None:
    times = encounters.time_s + 0.0123
    states = encounters.vehicle.motion.states(times)
    moved = encounters.at(times)
    assert np.abs(moved.position_m - states.position_m).max() < 0.005
    assert np.abs(moved.frame_from_body - states.frame_from_body).max() < 1e-4


def test_times_outside_the_trajectory_have_no_position(encounters: Encounters) -> None:
    early = encounters.at(encounters.time_s - 20.0)
    outside = early.time_s < encounters.vehicle.motion.time_s[0]
    assert 0 < np.count_nonzero(outside) < len(outside)
    assert (np.isnan(early.position_m).all(axis=1) == outside).all()
    assert not encounters.is_covered(encounters.time_s - 40.0)
    assert encounters.at(encounters.time_s - 40.0).misfit == np.inf


def test_the_misfit_is_one_where_variances_are_right() -> None:
    rng = np.random.default_rng(1)
    offsets = rng.standard_normal((20_000, 3)) * 0.3
    assert misfit_of(offsets, np.full(20_000, 0.09)) == pytest.approx(1.0, abs=0.03)
    assert misfit_of(offsets[:4], np.full(4, 0.09)) == np.inf


@pytest.mark.parametrize(
    "camera",
    [
        changed(CAMERA, k1=0.081, k2=-0.064),
        changed(CAMERA, fx=1950.0, fy=1948.0),
        changed(CAMERA, cx=620.0, cy=430.0),
    ],
)
def test_converting_to_another_camera_equals_measuring_with_it(
    encounters: Encounters, camera: dict[str, float], tmp_path: Path
) -> None:
    """Measured with a wrong camera and again with the right one: as if it had never been wrong."""
    wrong = of(tmp_path / "flight", camera)
    assert wrong.apart_m > 0.1
    again = remeasured(wrong, encounters.camera)
    distance = np.linalg.norm(encounters.in_camera_m, axis=1)
    off = np.linalg.norm(again.in_camera_m - encounters.in_camera_m, axis=1) / distance
    assert np.median(off) < 5e-4
    assert off.max() < 3e-3


def test_every_slip_changes_the_misfit_and_has_a_remedy(encounters: Encounters) -> None:
    named = [*slips(encounters)]
    assert len({slip.words for slip in named}) == len(named) > 30
    for slip in named:
        with np.errstate(all="ignore"):
            undone = slip.undone(encounters)
        assert undone.misfit > encounters.misfit
        assert slip.remedy


def moved(encounters: Encounters, shift: FloatArray) -> Encounters:
    return replace(encounters, centre_m=encounters.centre_m - shift)


@pytest.mark.parametrize(
    ("shift", "words"),
    [
        (lambda _: np.array([0.0, 0.0, 1.3]), "up and down only, by 1.32 m"),
        (
            lambda one: 0.02 * np.einsum("nij,nj->ni", one.enu_from_camera, one.in_camera_m),
            "in proportion to the distance, by 1.98%",
        ),
        (
            lambda one: 2.0 * (one.at(one.time_s + 0.25).position_m - one.position_m),
            "along the track, by 0.50",
        ),
        (
            lambda one: one.frame_from_body @ np.array([0.0, 0.7, 0.0]),
            "constant in the vehicle's axes, by 0.7",
        ),
        (lambda _: np.array([0.8, -0.6, 0.0]), "constant on the ground, by 0.99 m"),
    ],
)
def test_the_pattern_of_a_disagreement_is_reported(
    encounters: Encounters, shift: object, words: str
) -> None:
    assert callable(shift)
    found = patterns(moved(encounters, shift(encounters)))
    assert found[0].share > 0.9
    names = [pattern.words for pattern in found if pattern.share > found[0].share - 0.05]
    assert any(name.startswith(words) for name in names), found


def test_a_disagreement_without_a_pattern_is_reported_as_unexplained(
    encounters: Encounters,
) -> None:
    noise = np.random.default_rng(5).standard_normal(encounters.centre_m.shape)
    doubt = unexplained(moved(encounters, noise))
    assert "no single cause explains this" in doubt.sentence
    assert causes_of(moved(encounters, noise)) == ()


def along(encounters: Encounters, motion: Motion) -> Encounters:
    vehicle = replace(encounters.vehicle, motion=motion)
    return replace(encounters, vehicle=vehicle).at(encounters.time_s)


def test_few_frames_inside_a_trajectory_give_no_cause(encounters: Encounters) -> None:
    motion = encounters.vehicle.motion
    rows = motion.time_s < np.quantile(encounters.time_s, 0.45)
    short = replace(
        motion,
        time_s=motion.time_s[rows],
        position_m=motion.position_m[rows],
        frame_from_body=motion.frame_from_body[rows],
    )
    cut = moved(along(encounters, short), np.array([0.0, 0.0, 0.2]))
    assert cut.misfit == np.inf
    assert causes_of(cut) == ()
    assert not [*_of_encounters(cut, None)]


def test_a_clock_that_moves_most_frames_outside_is_still_named(encounters: Encounters) -> None:
    motion = encounters.vehicle.motion
    late = along(encounters, replace(motion, time_s=motion.time_s + 18.0))
    assert late.misfit == np.inf
    (doubt,) = causes_of(late)
    assert doubt.code is Cause.CLOCK
    assert np.isfinite([*doubt.figures.values()]).all()


def test_a_single_contradicting_frame_is_reported(encounters: Encounters) -> None:
    shift = np.zeros_like(encounters.centre_m)
    shift[4, 0] = 3.0
    (doubt,) = check_lone_frames(moved(encounters, shift))
    assert doubt.figures["frames"] == 1.0
    assert "up to 3.0 m apart" in doubt.sentence


def test_a_single_frame_during_a_gnss_outage_within_its_deviations_is_accepted(
    tmp_path: Path,
) -> None:
    flight_inputs = inputs_of(tmp_path / "flight", CAMERA)
    sightings, positions, poses, camera = flight_inputs
    vehicle = positions.vehicle
    assert vehicle is not None
    assert vehicle.motion.sd_position_m is not None
    usual = Encounters.of(*flight_inputs)
    assert usual is not None
    is_out = np.abs(vehicle.motion.time_s - usual.time_s[4]) < 0.5
    sd_m = np.where(is_out[:, None], 2.0, vehicle.motion.sd_position_m)
    motion = replace(vehicle.motion, sd_position_m=sd_m)
    outage = replace(positions, vehicle=replace(vehicle, motion=motion))
    found = Encounters.of(sightings, outage, poses, camera)
    assert found is not None
    shift = np.zeros_like(found.centre_m)
    shift[4, 0] = 3.0
    assert [*check_lone_frames(moved(usual, shift))]
    assert not [*check_lone_frames(moved(found, shift))]


def test_a_mount_between_right_angles_is_reported_as_estimated(encounters: Encounters) -> None:
    settings = replace(encounters.vehicle.settings, mount_deg=33.0)
    (doubt,) = check_mount(
        replace(encounters, vehicle=replace(encounters.vehicle, settings=settings))
    )
    assert "set [vehicle] mount_deg = 0, unless headings are wrong" in doubt.remedy
    assert doubt.figures["mount_deg"] == pytest.approx(0.0, abs=2.0)


def test_rectified_frames_are_recognised(encounters: Encounters) -> None:
    """Distances are then wrong by an amount that grows towards the corners."""
    barrel = replace(encounters.camera, k1=-0.2)
    rectified = replace(encounters, camera=without_distortion(barrel))
    (doubt,) = causes_of(remeasured(rectified, barrel))
    assert doubt.code is Cause.DISTORTION
    assert "the frames seem to be rectified" in doubt.sentence
    assert "if not, look k1, k2 … up" in doubt.remedy  # coefficients that are far too large


def test_a_missing_distortion_is_recognised(encounters: Encounters) -> None:
    barrel = replace(without_distortion(encounters.camera), k1=-0.2)
    (doubt,) = causes_of(remeasured(replace(encounters, camera=barrel), without_distortion(barrel)))
    assert doubt.code is Cause.DISTORTION
    assert "but the camera has none" in doubt.sentence
    (k1,) = re.findall(r"only k1 is given, (-0\.\d+) fits best", doubt.remedy)
    assert float(k1) == pytest.approx(-0.2, abs=0.02)
