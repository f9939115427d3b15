from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from benchmarks.accuracy import disturbed, evaluate, flights, presets, processed, sampling
from benchmarks.accuracy.bands import join_truth, summarise, table_lines
from benchmarks.accuracy.bound import frame_bound
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.pipeline.detect import RunOptions
from kgcp.settings import DetectSettings
from kgcp.simulation.crlb import (
    Shot,
    bound_of,
    censored_information,
    equations_of,
    pose_bound,
    propagated,
)
from kgcp.simulation.flight import TARGET_PLATE, FramePlan, plan_flight
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.presets import SimulationSettings, preset

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

SMALL = Camera(
    width=480, height=360, fx=1800.0, fy=1797.0, cx=243.1, cy=176.2, k1=-0.05,
    response=preset("clean").camera.response,
)  # fmt: skip


@pytest.mark.parametrize("margin", [-2.0, -0.5, 0.0, 1.0, 2.5])
def test_censored_information_is_the_variance_of_the_score(margin: float) -> None:
    draws = np.random.default_rng(3).standard_normal(400_000)
    hazard = math.exp(-0.5 * margin**2) / math.sqrt(2.0 * math.pi) / np.mean(draws > margin)
    score = np.where(draws > margin, hazard, draws)
    assert censored_information(np.array([margin]))[0] == pytest.approx(score.var(), rel=0.02)


def test_far_from_clipping_all_is_seen_and_far_beyond_nothing() -> None:
    seen = censored_information(np.array([-40.0, -6.0, 6.0, 40.0]))
    np.testing.assert_allclose(seen, [0.0, 0.0, 1.0, 1.0], atol=1e-6)


def test_unknowns_of_no_interest_cost_what_the_whole_inverse_says() -> None:
    rng = np.random.default_rng(4)
    pose, nuisances = rng.standard_normal((200, 6)), rng.standard_normal((200, 3))
    pose[:, 2] *= 1e-4
    whole = np.column_stack((pose, nuisances))
    expected = np.linalg.inv(whole.T @ whole)[:6, :6]
    with_idle = np.column_stack((nuisances, np.zeros(200)))
    np.testing.assert_allclose(pose_bound(pose, with_idle), expected, rtol=1e-8)


def frame_of_even_noise(distance_m: float) -> tuple[SimulationSettings, FramePlan]:
    """Return a frame whose noise is 1 % of white everywhere."""
    sensor = Sensor(full_well_e=1e6, read_noise_e=1e4)
    settings = replace(preset("clean"), camera=SMALL, sensor=sensor, frames=2)
    tilt = Rotation.from_euler("zxy", [40.0, 19.0, -16.0], degrees=True).as_matrix()
    pose = Pose(tilt, distance_m * np.array([0.03, -0.02, 1.0]))
    frame = plan_flight(settings, 1).frames[0]
    return settings, replace(frame, target=pose, optics=Optics(0.7), gain=0.8, present=True)


def circles_m() -> list[tuple[np.ndarray, float]]:
    """Return centres and radii of all printed circles."""
    circles = []
    for ring in TARGET_PLATE.target.rings:
        circles += [(np.zeros(2), 0.5 * d) for d in (ring.outer_diameter_m, ring.inner_diameter_m)]
        circles += [(centre, 0.5 * ring.dot_diameter_m) for centre in ring.dot_centres_m()]
    return circles


def edge_information(frame: FramePlan, radius_px: float) -> np.ndarray:
    """Return the information (6, 6) in all edges, levels and spread known.

    An edge of contrast c, spread σ and noise s that moves along its normal tells
    c² / (2 √π σ s²) per pixel of length. What is small against the spread tells nearly nothing.
    """
    spread_px, noise = math.sqrt(0.7**2 + 1.0 / 12.0), math.hypot(0.01, 12.0**-0.5 / 255.0)
    contrast = frame.gain * (TARGET_PLATE.white - TARGET_PLATE.black)
    density = contrast**2 / (2.0 * math.sqrt(math.pi) * spread_px * noise**2)
    angles = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    information = np.zeros((6, 6))
    for centre, radius_m in circles_m():
        if radius_m / 0.45 * radius_px < 2.5 * spread_px:
            continue
        points = centre + radius_m * np.column_stack((np.cos(angles), np.sin(angles)))

        def moved(step: np.ndarray, points: np.ndarray = points) -> np.ndarray:
            return SMALL.project(frame.target.moved(1e-5 * step).transform(points))

        pixels = moved(np.zeros(6))
        along = 0.5 * (np.roll(pixels, -1, axis=0) - np.roll(pixels, 1, axis=0))
        length = np.linalg.norm(along, axis=1)
        normal = np.column_stack((along[:, 1], -along[:, 0])) / length[:, None]
        slopes = [np.sum((moved(e) - moved(-e)) / 2e-5 * normal, axis=1) for e in np.eye(6)]
        information += density * np.einsum("in,n,jn->ij", slopes, length, slopes)
    return information


@pytest.mark.parametrize("radius_px", [15.0, 40.0, 90.0])
def test_bound_is_that_of_blurred_edges(radius_px: float) -> None:
    distance_m = SMALL.fx * 0.45 / radius_px
    settings, frame = frame_of_even_noise(distance_m)
    ideal = np.linalg.inv(edge_information(frame, radius_px))
    ray = frame.target.translation_m / frame.target.distance_m
    bound = frame_bound(settings, frame)
    centre = frame.target.translation_m
    slopes = [(SMALL.project(centre + 1e-5 * e) - SMALL.project(centre)) / 1e-5 for e in np.eye(3)]
    ideal_px = math.sqrt(np.einsum("ik,ij,jk->", slopes, ideal[:3, :3], slopes))
    assert bound.centre_px == pytest.approx(ideal_px, rel=0.1)
    across = np.eye(3) - np.outer(frame.target.normal, frame.target.normal)
    ideal_deg = math.degrees(math.sqrt(np.trace(across @ ideal[3:, 3:] @ across)))
    assert bound.normal_deg == pytest.approx(ideal_deg, rel=0.1)
    ideal_percent = 100.0 * math.sqrt(ray @ ideal[:3, :3] @ ray) / frame.target.distance_m
    assert 0.95 < bound.distance_percent / ideal_percent < 1.3  # levels and spread cost something


def far_shot() -> Shot:
    """Return a view of a ring of some 14 px, through a camera of unknown tone."""
    camera = replace(SMALL, response=preset("consumer").camera.response)
    tilt = Rotation.from_euler("zxy", [40.0, 9.0, -6.0], degrees=True).as_matrix()
    pose = Pose(tilt, 58.0 * np.array([0.03, -0.02, 1.0]))
    sensor = Sensor(tone=ToneCurve.SRGB)
    return Shot(camera, TARGET_PLATE, pose, Optics(0.8), sensor, 0.8, has_unknown_streak=False)


def test_unknown_levels_are_eliminated_as_if_their_prior_were_observed() -> None:
    shot, levels_sd = far_shot(), (0.01, 0.03)
    equations = equations_of(shot)
    weight = equations.weight[:, None]
    more = [each.ravel() for each in disturbed.disturbances(equations, has_skew=True)]
    contrast = TARGET_PLATE.white - TARGET_PLATE.black
    levels = contrast * disturbed.levels_of(equations, levels_sd).toarray()
    smoothing = 0.05 * contrast * disturbed.by_smoothing(equations).ravel()
    random = weight * np.column_stack((levels, smoothing))
    count = random.shape[1]
    known = np.column_stack((equations.nuisances, weight * np.column_stack(more)))
    seen = np.column_stack((known, random))
    prior = np.column_stack((np.zeros((count, known.shape[1])), np.eye(count)))
    pose = np.vstack((equations.pose, np.zeros((count, 6))))
    expected = propagated(shot, pose_bound(pose, np.vstack((seen, prior))))
    disturbance = disturbed.Disturbance(levels_sd, has_skew=True, jpeg_quality=None)
    even, found = disturbed.disturbed_bound(shot, disturbance)
    assert found == pytest.approx(expected.distance_percent, rel=1e-4)
    assert even == pytest.approx(bound_of(shot).distance_percent)
    assert 1.2 < found / even < 3.0


def test_what_is_known_of_a_frame_makes_its_bound_smaller() -> None:
    def bound(
        levels_sd: float = 0.0, quality: int | None = None, *, has_skew: bool = False
    ) -> float:
        disturbance = disturbed.Disturbance((levels_sd, 2.0 * levels_sd), has_skew, quality)
        return disturbed.disturbed_bound(far_shot(), disturbance)[1]

    least = bound()
    assert least < bound(has_skew=True) < 1.2 * least
    assert least < bound(0.005) < bound(0.02)
    assert 1.1 * least < bound(quality=93) < bound(quality=80)


def test_levels_at_knots_add_up_to_ink_and_plate() -> None:
    equations = equations_of(far_shot())
    levels = disturbed.levels_of(equations, (0.5, 2.0)).toarray()
    of_ink, of_plate = (part.sum(axis=1) for part in np.split(levels, 2, axis=1))
    share = equations.share.ravel()
    np.testing.assert_allclose(of_ink, 0.5 * (1.0 - share), atol=1e-12)
    np.testing.assert_allclose(of_plate, 2.0 * share, atol=1e-12)


def test_smoothing_takes_the_same_area_of_every_circle() -> None:
    """r shrinks by β / 2r, π r² by π β: the outer circle's is white's gain, that of others not."""
    equations = equations_of(far_shot())
    tilt_deg = math.hypot(9.0, 6.0)
    area = -4.0 * math.pi * math.cos(math.radians(tilt_deg))
    assert disturbed.by_smoothing(equations).sum() == pytest.approx(area, rel=0.02)


@pytest.mark.parametrize(("count", "low", "high"), [(6, 0.45, 1.55), (16, 0.66, 1.34)])
def test_few_frames_leave_standardised_errors_open(count: int, low: float, high: float) -> None:
    np.testing.assert_allclose(disturbed.chance_of_z(count), (low, high), atol=0.01)
    np.testing.assert_allclose(disturbed.chance_of_rms(np.ones(count)), (low, high), atol=0.02)


def random_flight(count: int, covariance: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return truth and detections of poses that scatter with a covariance."""
    rng = np.random.default_rng(5)
    truths, rows = [], []
    for i in range(count):
        tilt = Rotation.from_rotvec([*rng.uniform(0.2, 0.4, 2), rng.uniform(-3, 3)]).as_matrix()
        pose = Pose(tilt, np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(10.0, 80.0)]))
        seen = pose.moved(-rng.multivariate_normal(np.zeros(6), covariance))
        x, y = SMALL.project(pose.translation_m)
        x_px, y_px = SMALL.project(seen.translation_m)
        truths.append(
            {"frame": f"{i}", "present": 1, "x": x, "y": y, "distance": pose.distance_m}
            | {f"r{j}{k}": pose.rotation[j, k] for j in range(3) for k in range(3)}
            | dict(zip(("cx", "cy", "cz"), pose.translation_m, strict=True))
            | {"radius_px": 810.0 / pose.distance_m}
        )
        ray = pose.translation_m / pose.distance_m
        sd_px = SMALL.fx * math.sqrt(covariance[0, 0]) / pose.translation_m[2]
        rows.append(
            {"frame": f"{i}", "target": "A", "status": "measured", "x_px": x_px, "y_px": y_px}
            | {"distance_m": seen.distance_m, "sd_x_px": sd_px, "sd_y_px": sd_px}
            | {"sd_distance_m": math.sqrt(ray @ covariance[:3, :3] @ ray), "radius_px": 1.0}
            | dict(zip(("tx_m", "ty_m", "tz_m"), seen.translation_m, strict=True))
            | dict(zip(("qw", "qx", "qy", "qz"), seen.quaternion_wxyz, strict=True))
            | {"pose_cov": covariance.ravel()}
        )
    return pd.DataFrame(truths), pd.DataFrame(rows)


COVARIANCE = np.diag([1e-8, 1e-8, 4e-6, 1e-6, 1e-6, 1e-8])
COVARIANCE[0, 4] = COVARIANCE[4, 0] = 5e-8


def test_true_sigmas_are_called_true() -> None:
    truth, rows = random_flight(2000, COVARIANCE)
    for band in summarise(join_truth(rows, truth)):
        if band.present:
            assert band.found == band.present
            assert 0.9 < band.z_distance < 1.1
            assert 0.9 < band.z_centre < 1.15
            assert 2.0 < band.worst_z_distance < 6.0
            assert 4.7 < band.mahalanobis2 < 6.0
            assert band.right_side == 1.0
            assert 0.05 < band.normal_median_deg < 0.09  # Rayleigh: 1.177 · 1e-3 rad
            assert abs(band.mean_percent) < 2.0 * band.mean_2se_percent


def test_mirrored_normals_are_on_the_wrong_side() -> None:
    truth, rows = random_flight(50, COVARIANCE)
    for i in range(0, 50, 2):
        rotation = Rotation.from_quat(
            rows.loc[i, ["qw", "qx", "qy", "qz"]].to_numpy(float), scalar_first=True
        ).as_matrix()
        ray = truth.loc[i, ["cx", "cy", "cz"]].to_numpy(float)
        half_turn = Rotation.from_rotvec(np.pi * ray / np.linalg.norm(ray)).as_matrix()
        mirrored = Pose(half_turn @ rotation, ray)
        rows.loc[i, ["qw", "qx", "qy", "qz"]] = mirrored.quaternion_wxyz
    table = join_truth(rows, truth)
    np.testing.assert_array_equal(table["on_right_side"], np.arange(50) % 2)


def test_wrong_and_missing_targets_are_counted_and_have_no_errors() -> None:
    truth, rows = random_flight(10, COVARIANCE)
    truth["radius_px"] = 30.0
    truth.loc[0, "present"] = 0
    rows["x_px"] += np.where(rows.index == 1, 16.0, 0.0)
    rows.loc[2, "status"] = "not_found"
    table = join_truth(rows, truth)
    band = summarise(table)[0]
    assert (band.present, band.found, band.wrong) == (9, 7, 2)
    assert table["mahalanobis2"].count() == 7


def test_flights_in_which_nothing_is_found_have_no_errors() -> None:
    truth, rows = random_flight(5, COVARIANCE)
    rows["status"] = "not_found"
    table = join_truth(rows, truth)
    assert summarise(table)[0].found == 0
    assert table["mahalanobis2"].count() == 0


def test_methods_without_sigmas_leave_dashes() -> None:
    truth, rows = random_flight(5, COVARIANCE)
    rows[["sd_x_px", "sd_y_px", "sd_distance_m"]] = np.nan
    rows["pose_cov"] = None
    results = summarise(join_truth(rows, truth))
    assert all(math.isnan(band.mahalanobis2) for band in results)
    assert all("–" in line for line in list(table_lines(results))[1:])


@pytest.fixture(autouse=True, scope="module")
def _detections_in_this_process() -> Iterator[None]:
    """To start a worker for three small frames would take longer than to measure them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "RunOptions", lambda **_: RunOptions(jobs=0))
        yield


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    settings = replace(
        preset("clean"), camera=SMALL, frames=3, distance_m=(20.0, 45.0), absent_share=0.0
    )
    plan = plan_flight(settings, 3)
    folder = presets.simulate(plan, tmp_path_factory.mktemp("flights"), 1)
    return folder, presets.compare(plan, folder, DetectSettings(), 1)


def test_clean_frames_are_measured_near_the_bound(flight: tuple[Path, pd.DataFrame]) -> None:
    _, table = flight
    everything = table.assign(radius_px_true=30.0)
    band = summarise(everything)[0]
    assert (band.present, band.found, band.wrong) == (3, 3, 0)
    assert 0.3 < band.bound_distance < 2.0
    assert 0.3 < band.bound_centre < 2.0
    assert 0.1 < band.z_distance < 2.1  # 99 % of 3 values: 0.15 to 2.07
    assert 0.3 < band.z_centre < 1.8  # 99 % of 6: 0.34 to 1.76
    assert 1.0 < band.mahalanobis2 < 14.0


def test_the_command_prints_its_table(flight: tuple[Path, pd.DataFrame]) -> None:
    folder, _ = flight
    arguments = [str(folder), str(folder / "truth.csv"), "--method", "paper", "--jobs", "1"]
    evaluated = CliRunner().invoke(evaluate.main, arguments, catch_exceptions=False)
    assert "found/present" in evaluated.stdout
    assert "wrong 0" in evaluated.stdout


def test_flights_have_a_line_each(flight: tuple[Path, pd.DataFrame]) -> None:
    folder, _ = flight
    arguments = [str(folder), "--jobs", "1"]
    printed = CliRunner().invoke(flights.main, arguments, catch_exceptions=False)
    title, line = printed.stdout.splitlines()
    assert "wrong side" in title
    assert line.split()[:2] == [folder.name, "3/3"]
    assert line.split()[-1].startswith("0/")


@pytest.mark.parametrize("shape", [(96, 160), (96, 160, 3)])
def test_processing_changes_pixels_alone(shape: tuple[int, ...]) -> None:
    pixels = np.random.default_rng(0).integers(40, 200, shape).astype(np.uint8)
    for name, process in processed.PROCESSINGS.items():
        changed = process(pixels)
        assert (changed.shape, changed.dtype) == (pixels.shape, pixels.dtype)
        is_same = name == "as it is" or name.startswith("JPEG")
        assert np.array_equal(changed, pixels) == is_same, name


def test_processed_flights_have_a_line_for_each_processing(
    flight: tuple[Path, pd.DataFrame],
) -> None:
    folder, _ = flight
    arguments = [str(folder), "--jobs", "1", "--only", "JPEG 70", "--only", "interlaced"]
    printed = CliRunner().invoke(processed.main, arguments, catch_exceptions=False)
    _, title, compressed, interlaced = printed.stdout.splitlines()
    assert "wrong side" in title
    assert compressed.split()[:3] == ["JPEG", "70", "3/3"]
    assert interlaced.split()[:2] == ["interlaced", "0/3"]


def test_errors_of_the_renderer_widen_the_deviations() -> None:
    truth, rows = random_flight(400, COVARIANCE)
    truth["radius_px"] = 30.0
    table = join_truth(rows, truth)
    table["rendering_percent"] = 0.0
    table["renderer_percent"] = 100.0 * table["sd_distance_m"] / table["distance_m"]
    _, *bands = sampling.lines(table)
    measured, left, with_renderer = map(float, bands[0].split()[-3:])
    assert 0.9 < measured < 1.1
    assert left == measured
    assert with_renderer == pytest.approx(measured / math.sqrt(2.0), abs=0.02)
