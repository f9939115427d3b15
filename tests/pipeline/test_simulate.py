from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.io.formats.frame_times import read_times
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.trajectories import read_trajectory
from kgcp.io.images.exif import read_exif
from kgcp.io.images.frames import list_frames, read_grey
from kgcp.pipeline.simulate import new_folder, write_simulated_flight
from kgcp.simulation.effects import Effects, with_effects
from kgcp.simulation.flight import (
    CRS,
    TARGET_PLATE,
    FlightPlan,
    grow_ground,
    plan_flight,
    render_frame,
)
from kgcp.simulation.presets import SimulationSettings, preset

SMALL = replace(
    preset("sample"),
    camera=replace(
        preset("sample").camera, width=330, height=250, fx=520.0, fy=519.0, cx=163.2, cy=127.9
    ),
    distance_m=(4.0, 30.0),
    jpeg_quality=None,
    frames=4,
)


def write(settings: SimulationSettings, out: Path, jobs: int = 1) -> FlightPlan:
    plan = plan_flight(settings, 3)
    write_simulated_flight(plan, out, jobs=jobs, on_frame=lambda: None)
    return plan


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[FlightPlan, Path]:
    out = tmp_path_factory.mktemp("simulated") / "flight"
    return write(SMALL, out), out


def test_the_simulated_folder_is_a_valid_flight(flight: tuple[FlightPlan, Path]) -> None:
    plan, out = flight
    read = read_flight(out)
    assert read.camera == SMALL.camera
    assert read.vehicle is not None
    assert read.vehicle.settings == plan.vehicle
    assert read.reference is not None
    assert read.times_file is not None
    (target,) = read.targets
    assert target.name == "A"
    for ring, printed in zip(target.rings, TARGET_PLATE.target.rings, strict=True):
        assert ring.code_deg == printed.code_deg
        assert ring.outer_diameter_m == pytest.approx(printed.outer_diameter_m, abs=1e-12)
        assert ring.dot_diameter_m == pytest.approx(printed.dot_diameter_m, abs=1e-12)
    names = list_frames(read.frames_folder)
    times = read_times(read.times_file, ()).time_s
    assert_allclose([times[name] for name in names], plan.recorded_times_s, atol=1e-6)
    poses = read_reference_poses(read.reference.file)
    assert poses.frames == tuple(names)
    assert_allclose(poses.position_map, plan.reference.position_map, atol=1e-5)
    assert_allclose(poses.opk_deg, plan.reference.opk_deg, atol=1e-7)
    trajectory = read_trajectory(read.vehicle.trajectory_file, CRS)
    assert_allclose(trajectory.position_map, plan.trajectory.position_map, atol=1e-5)
    assert_allclose(trajectory.attitude_deg, plan.trajectory.attitude_deg, atol=1e-6)
    assert trajectory.sd_attitude_deg is not None
    assert_allclose(trajectory.sd_attitude_deg[0], SMALL.sd_attitude_deg)


def test_png_frames_are_what_was_rendered(flight: tuple[FlightPlan, Path]) -> None:
    plan, out = flight
    grey = read_grey(out / "frames/frame_0002.png", SMALL.camera)
    assert_array_equal(grey, render_frame(plan, grow_ground(3), 2))


def test_exif_has_exposure_and_time(flight: tuple[FlightPlan, Path]) -> None:
    plan, out = flight
    for frame in plan.frames:
        exif = read_exif(out / f"frames/frame_{frame.index:04d}.png")
        assert exif.exposure.exposure_time_s == pytest.approx(frame.gain / 1250.0, rel=1e-3)
        assert exif.exposure.iso == 100.0
        assert exif.exposure.f_number == pytest.approx(5.6)
        assert exif.time_s == pytest.approx(plan.recorded_times_s[frame.index], abs=2e-6)


def test_truth_is_consistent(flight: tuple[FlightPlan, Path]) -> None:
    plan, out = flight
    truth = pd.read_csv(out / "truth.csv")
    assert list(truth["frame"]) == list_frames(out / "frames")
    centre = truth[["cx", "cy", "cz"]].to_numpy()
    assert_allclose(truth["distance"], np.linalg.norm(centre, axis=1), atol=1e-8)
    assert_allclose(truth[["x", "y"]], SMALL.camera.project(centre), atol=1e-5)
    assert_allclose(truth[["X", "Y", "Z"]], plan.target_map, atol=1e-8)
    assert_allclose(truth["radius_px"], SMALL.camera.fx * 0.45 / truth["distance"], rtol=1e-8)
    assert_allclose(truth["white"], np.minimum(truth["gain"] * TARGET_PLATE.white, 1.0), atol=1e-8)


def test_any_number_of_processes_writes_the_same_bytes(tmp_path: Path) -> None:
    effects = Effects(
        shadow=0.5,
        stripes=1,
        dirt=0.05,
        stains=3,
        glare=0.4,
        astigmatism=1.3,
        coma=0.1,
        phone=True,
        rolling=0.02,
    )
    settings = with_effects(replace(SMALL, frames=2), effects)
    for jobs in (1, 2):
        write(settings, tmp_path / f"jobs_{jobs}", jobs)
    assert contents(tmp_path / "jobs_1") == contents(tmp_path / "jobs_2")
    assert read_flight(tmp_path / "jobs_1").camera.readout_s == 0.02


def test_jpeg_frames_are_close_to_what_was_rendered(tmp_path: Path) -> None:
    plan = write(replace(SMALL, jpeg_quality=92, frames=1), tmp_path / "flight")
    grey = read_grey(tmp_path / "flight/frames/frame_0000.jpg", SMALL.camera)
    rendered = render_frame(plan, grow_ground(3), 0)
    assert np.std(grey.astype(float) - rendered) < 2.0
    assert read_exif(tmp_path / "flight/frames/frame_0000.jpg").exposure.iso == 100.0


def test_a_folder_with_content_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "flight").mkdir()
    (tmp_path / "flight/note.txt").write_text("mine")
    with pytest.raises(KgcpError, match="choose a new folder"):
        write(SMALL, tmp_path / "flight")
    assert contents(tmp_path) == {"flight/note.txt": b"mine"}


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "flight").mkdir()
    write(replace(SMALL, frames=1), tmp_path / "flight")
    assert (tmp_path / "flight/flight.toml").is_file()


def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_simulated_flight(plan_flight(SMALL, 3), tmp_path / "flight", jobs=1, on_frame=stop)
    assert contents(tmp_path) == {}


def test_a_folder_that_cannot_be_created_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(KgcpError, match="cannot be written"):
        write(SMALL, tmp_path / "file" / "flight")


def test_two_runs_do_not_write_one_folder(tmp_path: Path) -> None:
    with new_folder(tmp_path / "new" / "flight") as partial:
        (partial / "file").touch()
        with (
            pytest.raises(KgcpError, match=r"flight: another kgcp is writing it; wait"),
            new_folder(tmp_path / "new" / "flight"),
        ):
            pass
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["flight"]
    assert (tmp_path / "new" / "flight" / "file").exists()
