"""Covariance of a pose, and the reported deviations compared with samples of poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.measurement.adjustment.covariance import (
    common_displacement_px,
    pose_covariance,
    propagate,
    unevenness_factor,
)
from kgcp.measurement.adjustment.normal_equations import normal_matrix
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.solver import TargetFit, noise_of
from kgcp.measurement.adjustment.two_poses import fit_both_poses
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.noise import misfit
from kgcp.measurement.image_model.photometry import Param
from kgcp.targets.layout import Target

PlacePlate = Callable[..., Pose]
DRAWS = 4000


def some_covariance(seed: int) -> FloatArray:
    """Centimetres along the ray, millimetres across, tenths of a degree; all correlated."""
    root = np.random.default_rng(seed).normal(size=(6, 6))
    scale = np.array([0.002, 0.003, 0.02, 0.004, 0.003, 0.002])
    scaled = scale[:, None] * root
    return np.asarray(scaled @ scaled.T)


@pytest.mark.parametrize(
    ("radius_px", "inflation", "is_even", "expected"),
    [
        (11.0, 1.0, True, 1.0),  # even light
        (11.0, 1.5, True, math.sqrt(1.4)),
        (11.0, 6.0, True, 1.4),  # dirt that cells of a small ring do not show
        (13.0, 6.0, True, 1.0),  # levels could have varied, and did not need to
        (11.0, 1.0, False, 1.8),  # levels that vary on a small ring
        (30.0, 6.0, False, 1.0),  # residuals show it all
    ],
)
def test_uneven_light_makes_variances_larger_than_residuals_show(
    *, radius_px: float, inflation: float, is_even: bool, expected: float
) -> None:
    field = None if is_even else SimpleNamespace()
    fit: Any = SimpleNamespace(
        parameters=SimpleNamespace(field=field),
        sample=SimpleNamespace(problem=SimpleNamespace(is_ring_small=radius_px < 12.5)),
    )
    assert unevenness_factor(fit, inflation) == pytest.approx(expected)


@pytest.mark.parametrize("turn_deg", [31.0, 179.9])
def test_deviations_equal_the_scatter_of_poses_drawn_from_the_covariance(
    camera: Camera, place_plate: PlacePlate, turn_deg: float
) -> None:
    pose = place_plate((80.0, 290.0), 25.0, tilt_deg=30.0, way_deg=70.0, turn_deg=turn_deg)
    cov = some_covariance(3)
    reported = propagate(camera, pose, cov)
    steps = np.random.default_rng(4).multivariate_normal(np.zeros(6), cov, DRAWS)
    drawn = [
        Pose(
            Rotation.from_rotvec(step[3:]).as_matrix() @ pose.rotation,
            pose.translation_m + step[:3],
        )
        for step in steps
    ]
    band = 4.0 / np.sqrt(2.0 * DRAWS)
    for sd, values in (
        (reported.sd_distance_m, [each.distance_m for each in drawn]),
        (reported.sd_roll_deg, [each.roll_deg for each in drawn]),
        (reported.sd_pitch_deg, [each.pitch_deg for each in drawn]),
    ):
        assert sd == pytest.approx(np.std(values), rel=band)
    headings = np.array([image_heading_deg(camera, each) for each in drawn])
    off = (headings - image_heading_deg(camera, pose) + 180.0) % 360.0 - 180.0
    assert reported.sd_heading_deg == pytest.approx(off.std(), rel=band)
    centres = camera.project(np.array([each.translation_m for each in drawn]))
    scatter = np.cov(centres.T)
    size = np.sqrt(np.outer(np.diag(scatter), np.diag(scatter)))
    np.testing.assert_allclose(reported.centre_cov_px2 / size, scatter / size, atol=2.0 * band)
    np.testing.assert_array_equal(reported.pose_cov, cov)


@pytest.fixture(scope="module")
def fit(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: Callable[..., GreyArray],
    imaging_of: Callable[..., FitProblem],
) -> TargetFit:
    pose = place_plate((205.4, 190.7), 25.0, tilt_deg=20.0, way_deg=200.0, turn_deg=31.0)
    grey = draw_frame((target, pose))
    return fit_both_poses(imaging_of(grey, camera, target, pose), pose, Blur(0.5, 0.5, 0.0)).best


def of_independent_pixels(fit: TargetFit) -> FloatArray:
    return np.asarray(
        np.linalg.inv(normal_matrix(fit.scaled_jacobian, fit.misfit, fit.unknowns))[:6, :6]
    )


def test_a_pose_is_about_as_well_known_as_its_pixels_allow(fit: TargetFit) -> None:
    covariance = pose_covariance(fit)
    ratios = eigh(covariance.pose_cov, of_independent_pixels(fit), eigvals_only=True)
    assert 0.7 < ratios.min() < 3.0
    np.testing.assert_allclose(covariance.pose_cov, covariance.pose_cov.T, rtol=1e-6)
    assert 1.0 <= covariance.inflation < 3.0


def test_residuals_that_cancel_within_arcs_reduce_variances(fit: TargetFit) -> None:
    """Sharpened noise cancels; few arcs may agree by chance, so that the ratio is drawn to 1."""
    pixels = np.rint(fit.sample.problem.window.pixels(fit.sample.index)).astype(int)
    score = np.where(pixels.sum(axis=0) % 2, 1.0, -1.0) * np.abs(fit.misfit.score)
    covariance = pose_covariance(replace(fit, misfit=replace(fit.misfit, score=score)))
    ratios = eigh(covariance.pose_cov, of_independent_pixels(fit), eigvals_only=True)
    assert 0.1 < ratios.min() < 0.6
    assert covariance.inflation == 1.0


def test_residuals_correlated_along_edges_enlarge_variances(fit: TargetFit) -> None:
    """The same residuals, constant over stripes: there are fewer independent ones."""
    x = fit.prediction.points_m[0] * fit.sample.problem.outer_radius_px / 0.45
    stripe = (x // 5.0).astype(int) - int(x.min() // 5.0)
    sign = np.random.default_rng(1).choice((-1.0, 1.0), stripe.max() + 1)[stripe]
    score = sign * np.abs(fit.misfit.score)
    striped = replace(fit, misfit=replace(fit.misfit, score=score))
    assert pose_covariance(striped).inflation > 3.0 * pose_covariance(fit).inflation


def with_noisy_edges(fit: TargetFit, sign: FloatArray) -> TargetFit:
    """Return a fit whose residuals at edges, of these signs, are ten times those of plateaus."""
    light, share = fit.parameters.light, fit.prediction.share
    size = np.where((share > 0.05) & (share < 0.95), 0.05, 0.005) * (light.white - light.black)
    levels = fit.prediction.levels + size * sign
    sample = replace(fit.sample, levels=levels)
    sd = noise_of(sample, fit.prediction).sd
    residuals = misfit(levels, fit.prediction.levels, sd, sample.censoring)
    return replace(fit, sample=sample, sd=sd, misfit=residuals)


@pytest.mark.parametrize(("run_px", "least", "most"), [(0.0, 0.4, 1.6), (5.0, 8.0, 60.0)])
def test_noise_of_edges_is_common_if_it_is_correlated_along_them(
    fit: TargetFit, run_px: float, least: float, most: float
) -> None:
    """That of compression averages out; that of a coarse print may displace a whole edge."""
    rng, points_m = np.random.default_rng(5), fit.prediction.points_m
    sign = rng.choice((-1.0, 1.0), len(fit.sd))
    if run_px:
        run_rad = run_px / fit.sample.problem.outer_radius_px
        run = (np.arctan2(points_m[1], points_m[0]) // run_rad).astype(int)
        sign = rng.choice((-1.0, 1.0), np.ptp(run) + 1)[run - run.min()]
    noisy = with_noisy_edges(fit, sign)
    ray = fit.parameters.pose.translation_m / fit.parameters.pose.distance_m
    of_distance = ray @ pose_covariance(noisy).pose_cov[:3, :3] @ ray
    assert least < of_distance / (ray @ of_independent_pixels(noisy)[:3, :3] @ ray) < most


@pytest.mark.parametrize(("share", "part"), [(0.25, 0.5), (1.0, 1.0)])
def test_a_quarter_of_noise_correlated_along_an_edge_is_common(
    fit: TargetFit, share: float, part: float
) -> None:
    sign = np.random.default_rng(5).choice((-1.0, 1.0), len(fit.sd))
    noisy = with_noisy_edges(fit, sign)
    slope_per_px = 1.0 / (math.sqrt(2.0 * math.pi) * fit.parameters.blur.mean_sd_px)
    of_edges_px = math.sqrt(0.05**2 - 0.005**2) / slope_per_px
    assert common_displacement_px(noisy, share) == pytest.approx(
        0.25 * part * of_edges_px, rel=0.15
    )
    of_nothing = with_sharpening(noisy, 0.0, 0.0)
    assert common_displacement_px(of_nothing, 0.0) == 0.0005


def with_sharpening(fit: TargetFit, behind: float, before: float) -> TargetFit:
    """Return a fit with sharpening of these strengths behind and before the tone curve."""
    vector = fit.parameters.vector.copy()
    vector[[Param.SHARPENING, Param.LINEAR_SHARPENING]] = behind, before
    return replace(fit, parameters=replace(fit.parameters, vector=vector))


@pytest.mark.parametrize(("behind", "before"), [(0.6, 0.0), (0.0, 0.3), (0.7, 0.3)])
def test_edges_of_cameras_that_sharpen_may_be_displaced_where_levels_vary(
    fit: TargetFit, behind: float, before: float
) -> None:
    """In even light, the scatter along arcs covers the effects of processing."""
    sharpened = with_sharpening(fit, behind, before)
    assert common_displacement_px(sharpened, 0.0) == 0.0005
    equations: Any = SimpleNamespace()
    displaced_px = common_displacement_px(replace(sharpened, level_equations=equations), 0.0)
    assert displaced_px == pytest.approx(math.hypot(0.0005, 0.003 * (behind + before)))


@pytest.mark.parametrize(("radius_px", "is_counted"), [(31.0, True), (33.0, False)])
def test_scatter_that_many_long_arcs_show_is_not_counted_again(
    fit: TargetFit, radius_px: float, *, is_counted: bool
) -> None:
    sign = np.random.default_rng(5).choice((-1.0, 1.0), len(fit.sd))
    noisy = with_noisy_edges(fit, sign)
    problem = replace(fit.sample.problem, outer_radius_px=radius_px)
    equations: Any = SimpleNamespace()
    uneven = replace(
        noisy, sample=replace(noisy.sample, problem=problem), level_equations=equations
    )
    assert (common_displacement_px(uneven, 1.0) > 0.005) == is_counted
