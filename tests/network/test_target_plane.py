"""Circles in space from images with known noise: errors, deviations, both normals, wrong frames."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.circles_together import place_circles
from kgcp.network.ground.moved_circle import best_split
from kgcp.network.ground.space_circle import (
    CircleViews,
    ExtraNoise,
    NoCircleError,
    SpaceCircle,
    angle_deg,
    outline_noise,
)
from kgcp.network.ground.target_plane import PlacedCircle, common_covariance, place_circle

CAMERA = Camera(1500, 1000, 2222.0, 2222.0, 749.5, 499.5, k1=-0.08)
NORMAL = np.array([0.05, 0.03, 1.0]) / np.linalg.norm([0.05, 0.03, 1.0])
DISTANCE_M = 10.0


def circle_of(radius_px: float) -> SpaceCircle:
    return SpaceCircle(np.array([0.3, -0.2, 0.1]), NORMAL, radius_px * DISTANCE_M / CAMERA.fx)


def views_of(
    circle: SpaceCircle,
    rng: np.random.Generator,
    *,
    sd_px: float = 0.005,
    stated_px: float | None = None,
    tilt_deg: tuple[float, float] = (25.0, 40.0),
    frames: int = 8,
) -> CircleViews:
    centres, rotations = [], []
    for index in range(frames):
        azimuth = 2.0 * math.pi * index / frames + rng.normal(0.0, 0.1)
        off = math.radians(rng.uniform(*tilt_deg))
        centre = DISTANCE_M * np.array(
            [math.sin(off) * math.cos(azimuth), math.sin(off) * math.sin(azimuth), math.cos(off)]
        )
        look = circle.centre_m + rng.normal(0.0, 0.5, 3) - centre
        z = look / np.linalg.norm(look)
        x = np.cross(z, [0.0, 1.0, 0.3])
        x /= np.linalg.norm(x)
        turn = rotation_about(np.array([0.0, 0.0, rng.uniform(0.0, 6.2)]))
        centres.append(centre)
        rotations.append(np.column_stack((x, np.cross(z, x), z)) @ turn)
    nothing = CircleViews(
        np.array(centres), np.array(rotations), np.zeros((frames, 5)), np.zeros((frames, 5, 5))
    )
    moments = circle_images(CAMERA, circle.in_cameras(nothing)).moments
    unit = outline_noise(moments)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(unit), rng.standard_normal((frames, 5)))
    return CircleViews(
        nothing.camera_m,
        nothing.world_from_camera,
        moments + sd_px * noise,
        (sd_px if stated_px is None else stated_px) ** 2 * unit,
    )


def errors_of(placed: SpaceCircle, truth: SpaceCircle) -> FloatArray:
    turn = -placed.axes.T @ np.cross(placed.normal, truth.normal)
    return np.array([*(placed.centre_m - truth.centre_m), *turn, placed.radius_m - truth.radius_m])


def test_deviations_are_those_of_the_errors() -> None:
    rng, truth, z = np.random.default_rng(3), circle_of(10.0), []
    for _ in range(8):
        fit = place_circle(CAMERA, views_of(truth, rng)).fit
        z.append(errors_of(fit.circle, truth) / np.sqrt(np.diag(fit.cov)))
    assert 0.8 < float(np.sqrt(np.mean(np.square(z)))) < 1.25


def test_errors_of_poses_count_by_their_covariance() -> None:
    rng, truth, z = np.random.default_rng(11), circle_of(10.0), []
    exterior = np.diag([0.02**2, 0.01**2, 0.03**2, *[2e-4**2] * 3])
    for _ in range(6):
        views = views_of(truth, rng)
        errors = rng.standard_normal((len(views), 6)) * np.sqrt(np.diag(exterior))
        turns = np.array([rotation_about(error) for error in errors[:, 3:].copy()])
        wrong = CircleViews(
            views.camera_m + errors[:, :3],
            turns @ views.world_from_camera,
            views.moments,
            views.cov,
            np.repeat(exterior[None], len(views), axis=0),
        )
        fit = place_circle(CAMERA, wrong).fit
        assert fit.is_used.sum() >= 7
        z.append(errors_of(fit.circle, truth) / np.sqrt(np.diag(fit.cov)))
    assert 0.75 < float(np.sqrt(np.mean(np.square(z)))) < 1.3


def test_errors_of_poses_do_not_make_a_circle_larger() -> None:
    """Rays from wrong places meet too far away, unless the equations have the likely places."""
    rng, truth = np.random.default_rng(5), circle_of(10.0)
    exterior = np.diag([0.5**2] * 3 + [1e-3**2] * 3)
    views = views_of(truth, rng, tilt_deg=(5.0, 15.0), frames=40)
    errors = rng.standard_normal((len(views), 6)) * np.sqrt(np.diag(exterior))
    turns = np.array([rotation_about(error) for error in errors[:, 3:].copy()])
    wrong = replace(
        views,
        camera_m=views.camera_m + errors[:, :3],
        world_from_camera=turns @ views.world_from_camera,
        exterior_cov=np.repeat(exterior[None], len(views), axis=0),
    )
    fit = place_circle(CAMERA, wrong).fit
    assert np.abs(errors_of(fit.circle, truth) / np.sqrt(np.diag(fit.cov))).max() < 3.0


def test_a_frame_that_shows_something_else_is_left_out() -> None:
    truth = circle_of(10.0)
    views = views_of(truth, np.random.default_rng(4))
    views.moments[3, 0] += 1.0
    views.moments[5, 2:] *= 1.2
    fit = place_circle(CAMERA, views).fit
    assert np.flatnonzero(~fit.is_used).tolist() == [3, 5]
    assert fit.residuals[3, 0] == pytest.approx(1.0, abs=0.05)
    assert angle_deg(fit.circle.normal, truth.normal) < 0.3


def test_frames_from_one_direction_allow_two_normals() -> None:
    truth = circle_of(10.0)
    around = views_of(truth, np.random.default_rng(5), tilt_deg=(25.0, 26.0))
    one_side = around.chosen(np.arange(8) == 0)
    rng = np.random.default_rng(6)
    jitter = 0.01 * rng.standard_normal((6, 3))
    same = CircleViews(
        one_side.camera_m + jitter,
        np.repeat(one_side.world_from_camera, 6, axis=0),
        np.zeros((6, 5)),
        np.repeat(one_side.cov, 6, axis=0),
    )
    moments = circle_images(CAMERA, truth.in_cameras(same)).moments
    noise = 0.005 * rng.standard_normal((6, 5)) * np.array([1, 1, 5, 5, 5])
    placed = place_circle(
        CAMERA, CircleViews(same.camera_m, same.world_from_camera, moments + noise, same.cov)
    )
    assert placed.other is not None
    normals = (placed.fit.circle.normal, placed.other.circle.normal)
    assert min(angle_deg(normal, truth.normal) for normal in normals) < 3.0
    assert angle_deg(*normals) > 30.0
    assert placed.ambiguity < 20.0
    assert place_circle(CAMERA, around).ambiguity > 200.0


def test_noise_beyond_the_stated_one_is_learnt() -> None:
    rng, truth = np.random.default_rng(7), circle_of(10.0)
    many = [views_of(truth, rng, sd_px=0.02, stated_px=0.005) for _ in range(3)]
    placed, noise = place_circles(CAMERA, many)
    expected = math.sqrt(0.02**2 - 0.005**2)
    assert noise.centre_px == pytest.approx(expected, rel=0.35)
    assert noise.outline_px == pytest.approx(expected, rel=0.35)
    assert all(not isinstance(each, NoCircleError) for each in placed)


def test_errors_common_to_all_frames_are_stated_separately() -> None:
    truth = circle_of(20.0)
    views = views_of(truth, np.random.default_rng(8))
    fit = place_circle(CAMERA, views).fit
    calibration = np.zeros((12, 12))
    calibration[0, 0] = calibration[1, 1] = calibration[0, 1] = calibration[1, 0] = 2.222**2
    focal = common_covariance(CAMERA, views, fit, ExtraNoise(), calibration, 0.0)
    edge = common_covariance(CAMERA, views, fit, ExtraNoise(), None, 0.02)
    # a focal length that is 1 ‰ too long makes the circle 1 ‰ smaller, an edge 0.02 px larger
    assert math.sqrt(focal[5, 5]) == pytest.approx(1e-3 * truth.radius_m, rel=0.3)
    assert math.sqrt(edge[5, 5]) == pytest.approx(0.02 / 20.0 * truth.radius_m, rel=0.2)


def test_rays_that_do_not_meet_give_no_circle() -> None:
    views = views_of(circle_of(10.0), np.random.default_rng(9), frames=3)
    backwards = CircleViews(
        views.camera_m,
        views.world_from_camera @ np.diag([1.0, -1.0, -1.0]),
        views.moments,
        views.cov,
    )
    with pytest.raises(NoCircleError, match="behind the cameras"):
        place_circle(CAMERA, backwards)


@pytest.mark.parametrize(("frames", "steps"), [(8, 20.0), (12, 8.0), (50, 4.0), (120, 4.0)])
def test_a_move_is_found_where_it_happened(frames: int, steps: float) -> None:
    rng, truth, off = np.random.default_rng(12), circle_of(10.0), []
    shift = np.array([steps * 0.005 * DISTANCE_M / CAMERA.fx, 0.0, 0.0])
    elsewhere = SpaceCircle(truth.centre_m + shift, truth.normal, truth.radius_m)
    for _ in range(10):
        views = views_of(truth, rng, frames=frames)
        change = (
            circle_images(CAMERA, elsewhere.in_cameras(views)).moments
            - circle_images(CAMERA, truth.in_cameras(views)).moments
        )
        views.moments[frames // 2 :] += change[frames // 2 :]
        split = best_split(CAMERA, views, truth, views.cov[:, :2, :2])
        assert split is not None
        assert split.gain > 1.0
        assert split.larger_side(frames).sum() == max(split.first, frames - split.first)
        off.append(split.first - frames // 2)
        assert np.linalg.norm(split.off_m) == pytest.approx(np.linalg.norm(shift), rel=1.0)
    assert abs(float(np.mean(off))) < 0.4


@pytest.mark.parametrize("frames", [6, 8, 12, 30])
def test_circles_that_were_not_moved_show_no_move(frames: int) -> None:
    rng, truth, gains = np.random.default_rng(13), circle_of(10.0), []
    for _ in range(40):
        views = views_of(truth, rng, frames=frames)
        views.moments[0, :2] += 3.0  # one frame that shows something else
        split = best_split(CAMERA, views, truth, views.cov[:, :2, :2])
        assert split is not None
        gains.append(split.gain)
    assert max(gains) < 0.9


def test_drifting_poses_are_not_taken_for_a_moved_circle() -> None:
    """Correlated errors of poses displace all circles of a frame alike."""
    rng, truth = np.random.default_rng(14), circle_of(10.0)
    many = [views_of(truth, rng, frames=16) for _ in range(5)]
    drift = np.where(np.arange(16) < 8, 0.0, 0.1)
    for views in many:
        east = np.einsum("nji,j->ni", views.world_from_camera, [1.0, 0.0, 0.0])[:, :2]
        views.moments[:, :2] += drift[:, None] * east
    placed, noise = place_circles(CAMERA, many)
    assert all(isinstance(each, PlacedCircle) and each.move is None for each in placed)
    assert noise.centre_px > 0.03


def with_pose_errors(rng: np.random.Generator, factor: float) -> list[CircleViews]:
    """Three circles in twelve frames, whose poses are `factor` times less accurate than stated."""
    sds = np.repeat([0.05, 0.003], 3)  # m, rad
    exact, steps = views_of(circle_of(10.0), rng, frames=12), sds * rng.standard_normal((12, 6))
    turns = np.array([rotation_about(factor * step[3:]) for step in steps])
    many: list[CircleViews] = []
    for place in ([0.3, -0.2, 0.1], [1.2, 0.4, 0.0], [-0.9, 0.5, 0.2]):
        circle = replace(circle_of(10.0), centre_m=np.array(place))
        moments = circle_images(CAMERA, circle.in_cameras(exact)).moments
        noise = np.linalg.cholesky(exact.cov) @ rng.standard_normal((12, 5, 1))
        many.append(
            CircleViews(
                # at the circle's own row, if the shutter is rolling
                exact.camera_m + factor * steps[:, :3] + 1e-6 * len(many),
                turns @ exact.world_from_camera,
                moments + noise[..., 0],
                exact.cov,
                np.broadcast_to(np.diag(sds**2), (12, 6, 6)),
                frames=np.arange(12),
            )
        )
    return many


def test_errors_that_circles_of_a_frame_share_are_not_taken_for_excessive_noise() -> None:
    rng = np.random.default_rng(16)
    _, noise = place_circles(CAMERA, with_pose_errors(rng, 1.0))
    assert noise.centre_px > 10.0
    assert noise.centre_chance > 1e-3
    assert noise.outline_chance > 1e-3
    _, noise = place_circles(CAMERA, with_pose_errors(rng, 3.0))
    assert noise.centre_chance < 1e-6


def test_a_bad_outline_among_good_ones_has_its_own_larger_deviations() -> None:
    """Its centres are as good as the others', but its shapes are forty times worse than stated."""
    rng, truth = np.random.default_rng(7), circle_of(10.0)
    many = [views_of(truth, rng, frames=5) for _ in range(20)]
    unit = np.linalg.cholesky(outline_noise(many[0].moments))
    noise = 0.2 * np.einsum("nij,nj->ni", unit, rng.standard_normal((5, 5)))
    many[0].moments[:, 2:] += noise[:, 2:]
    placed, common = place_circles(CAMERA, many)
    worst = placed[0]
    assert isinstance(worst, PlacedCircle)
    assert worst.has_own_noise
    assert worst.noise.outline_px == pytest.approx(0.2, rel=0.6)
    assert common.outline_px < 0.07
    z = errors_of(worst.fit.circle, truth) / np.sqrt(np.diag(worst.fit.cov))
    assert 0.3 < float(np.sqrt(np.mean(z**2))) < 2.0


def test_fewer_than_six_frames_show_no_move() -> None:
    truth = circle_of(10.0)
    views = views_of(truth, np.random.default_rng(15), frames=5)
    assert best_split(CAMERA, views, truth, views.cov[:, :2, :2]) is None
