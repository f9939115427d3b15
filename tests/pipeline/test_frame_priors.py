"""Priors of a frame from trajectory and reference poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight, read_flight
from kgcp.measurement.plate_prior import NormalPrior, PlatePrior
from kgcp.pipeline.detect import RunOptions, _prepared_task
from kgcp.pipeline.frame_priors import priors_of_frames
from kgcp.settings import DetectSettings
from kgcp.targets.plain import PlainPolarity, PlainTarget

SAMPLE = Path(__file__).parents[2] / "sample_flight"


def priors(flight: Flight) -> dict[str, dict[str, PlatePrior]]:
    frames = sorted(path.name for path in flight.frames_folder.iterdir())
    known = priors_of_frames(flight, FlightData(flight, frames), frames)
    return {frame: dict(each) for frame, each in zip(frames, known, strict=True)}


def test_priors_of_normals_follow_from_attitudes() -> None:
    known = priors(read_flight(SAMPLE))
    normals = [prior.normal for each in known.values() for prior in each.values()]
    assert len(normals) == len(known)
    assert all(isinstance(normal, NormalPrior) for normal in normals)
    directions = np.array([normal.direction_camera for normal in normals if normal is not None])
    assert (directions[:, 2] > np.cos(np.radians(30.0))).all()
    assert all(prior.rotation is None for each in known.values() for prior in each.values())


def test_priors_of_chosen_frames_are_those_of_a_whole_run() -> None:
    """How the camera turned while a frame was read follows from frames that were not chosen."""
    flight = read_flight(SAMPLE)
    flight = replace(flight, camera=replace(flight.camera, readout_s=0.03))
    whole = _prepared_task(flight, DetectSettings(), RunOptions()).inputs
    chosen = RunOptions(frame_patterns=("*_0004.jpg", "*_0010.jpg"))
    few = _prepared_task(flight, DetectSettings(), chosen).inputs
    rotations = {each.frame: each.priors["A"].rotation for each in whole}
    assert [each.frame for each in few] == ["frame_0004.jpg", "frame_0010.jpg"]
    assert all(each.priors["A"].rotation is not None for each in few)
    assert [each.priors["A"].rotation for each in few] == [rotations[each.frame] for each in few]


def test_a_target_that_stands_still_is_not_taken_for_the_vehicle_s() -> None:
    flight = read_flight(SAMPLE)
    static = tuple(replace(target, position_m=(0.0, 0.0, 0.0)) for target in flight.targets)
    assert not any(priors(replace(flight, targets=static)).values())


def test_unreadable_files_give_no_priors(tmp_path: Path) -> None:
    flight = read_flight(SAMPLE)
    assert flight.reference is not None
    bad = tmp_path / "reference.csv"
    bad.write_text("not,a,table\n", encoding="utf-8")
    assert not any(priors(replace(flight, reference=replace(flight.reference, file=bad))).values())
    assert not any(priors(replace(flight, reference=None)).values())


def test_a_plate_stated_to_be_level_needs_no_trajectory(tmp_path: Path) -> None:
    flight = read_flight(SAMPLE)
    assert flight.vehicle is not None
    bad = tmp_path / "vehicle.csv"
    bad.write_text("not,a,table\n", encoding="utf-8")
    vehicle = replace(flight.vehicle, trajectory_file=bad)
    assert not any(priors(replace(flight, vehicle=vehicle)).values())
    level = replace(vehicle, settings=replace(vehicle.settings, level_sd_deg=1.5))
    known = priors(replace(flight, vehicle=level))
    assert all(prior.normal is not None for each in known.values() for prior in each.values())
    assert all(known.values())


@pytest.mark.parametrize("sd_deg_s", [5.0, 40.0])
def test_neighbouring_frames_determine_the_motion_during_readout(sd_deg_s: float) -> None:
    flight = read_flight(SAMPLE)
    camera = replace(flight.camera, readout_s=0.02, motion_sd_deg_s=sd_deg_s)
    known = priors(replace(flight, camera=camera))
    rotations = [prior.rotation for each in known.values() for prior in each.values()]
    sds = np.degrees([rotation.sd_rad_s for rotation in rotations if rotation is not None])
    assert len(sds) == len(known)
    assert (sds <= sd_deg_s).all()
    assert (sds < sd_deg_s).sum() > len(known) // 2


def test_the_motion_is_also_known_for_plain_targets() -> None:
    flight = read_flight(SAMPLE)
    camera = replace(flight.camera, readout_s=0.02)
    plain = PlainTarget(
        "W", (0.4,), PlainPolarity.BRIGHT, (692000.0, 5336000.0, 545.0), border_m=0.4
    )
    flight = replace(flight, camera=camera, plain_targets=(plain,))
    known = priors(flight)
    assert all(each["W"].normal is None for each in known.values())
    sds = [each["W"].rotation.sd_rad_s for each in known.values() if each["W"].rotation]
    assert len(sds) == len(known)
    assert min(sds) < np.radians(camera.motion_sd_deg_s)


def test_rates_in_the_times_file_are_those_of_the_camera(tmp_path: Path) -> None:
    flight = read_flight(SAMPLE)
    assert flight.times_file is not None
    head, *rows = flight.times_file.read_text(encoding="utf-8").splitlines()
    rates = ",rate_x_deg_s,rate_y_deg_s,rate_z_deg_s,sd_rate_deg_s"
    times = tmp_path / "frames.csv"
    times.write_text("\n".join([head + rates, *(f"{row},3,-2,1,0.01" for row in rows)]), "utf-8")
    camera = replace(flight.camera, readout_s=0.02)
    flight = replace(flight, camera=camera, times_file=times)
    for each in priors(replace(flight, reference=None)).values():
        for prior in each.values():
            assert prior.rotation is not None
            rate_deg_s = np.degrees(prior.rotation.velocity_rad_s)
            assert rate_deg_s == pytest.approx((-3.0, 2.0, -1.0))
            # how camera and target shift is not known
            assert np.degrees(prior.rotation.sd_rad_s) == pytest.approx(5.0, rel=0.01)
    assert all(
        prior.rotation is None
        for each in priors(replace(flight, camera=replace(camera, readout_s=0.0))).values()
        for prior in each.values()
    )
