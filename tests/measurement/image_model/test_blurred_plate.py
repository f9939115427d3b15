"""The blurred plate: derivatives, and its levels against a brute-force blur of the exact plate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.blur import Blur, EdgeIncidence, find_edge_incidence
from kgcp.measurement.image_model.blurred_plate import (
    kurtosis_row,
    white_share,
    white_share_without_derivatives,
)
from kgcp.measurement.image_model.edge_terms import smoothing_row
from kgcp.measurement.image_model.plate import (
    ISOTROPIC,
    Circles,
    blur_on_plate,
    circles_of,
    largest_metres_per_px,
    plate_points,
)
from kgcp.measurement.image_model.quadrature import Quadrature
from kgcp.measurement.image_model.ray_plate import plate_views
from kgcp.targets.layout import Ring

CAMERA = Camera(1100, 800, 2300.0, 2310.0, 560.3, 391.8, k1=-0.06, k2=0.05, p1=-4e-4, p2=6e-4)
RING = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
RINGS = (RING, RING.scaled("A-inner", 0.2, (10.0, 80.0, 150.0, 250.0, 290.0)))
POSE = Pose(
    Rotation.from_euler("xyz", [17.0, -12.0, 70.0], degrees=True).as_matrix(),
    np.array([6.0, -3.0, 47.0]),
)
BLUR = Blur(0.6, 0.8, 0.15)


def pixels_around(centre: FloatArray, half: int) -> FloatArray:
    """Whole pixels about a centre, (n, 2), row by row."""
    column, row = np.round(centre)
    x, y = np.meshgrid(
        np.arange(column - half, column + half + 1), np.arange(row - half, row + half + 1)
    )
    return np.column_stack((x.ravel(), y.ravel()))


def rays_of(pixels: FloatArray) -> FloatArray:
    """Normalised coordinates and their derivatives, (6, n)."""
    normalised = CAMERA.undistort(pixels)
    inverse = np.asarray(np.linalg.inv(CAMERA.distort_jacobian(normalised)), dtype=np.float64)
    return np.vstack((normalised.T, inverse.reshape(-1, 4).T))


def pairs_of(pose: Pose, rays: FloatArray, blur: Blur) -> EdgeIncidence:
    scale = largest_metres_per_px(pose, rays)
    return find_edge_incidence(plate_points(pose, rays), scale, CIRCLES, blur, ISOTROPIC)


CIRCLES = circles_of(RINGS)
PIXELS = pixels_around(CAMERA.project(POSE.translation_m[None])[0], 30)
RAYS = rays_of(PIXELS)


def moved(step: FloatArray) -> tuple[Pose, Blur]:
    blur = Blur(
        BLUR.xx + step[6] + step[7],
        BLUR.yy + step[6] - step[7],
        BLUR.xy + step[8],
        1.4 + step[9],
        -0.9 + step[10],
    )
    return POSE.moved(step[:6]), blur


@pytest.mark.parametrize("index", range(11))
def test_white_share_jacobian_equals_finite_differences(index: int) -> None:
    blur = moved(np.zeros(11))[1]
    incidence = pairs_of(POSE, RAYS, blur)
    share = white_share(POSE.matrix, RAYS, blur.vector, incidence)
    assert np.allclose(
        white_share_without_derivatives(POSE.matrix, RAYS, blur.vector, incidence).value,
        share.value,
        atol=1e-12,
    )
    assert np.allclose(share.points_m, plate_points(POSE, RAYS), rtol=0.0, atol=1e-12)
    step = np.zeros(11)
    step[index] = 1e-5
    levels = []
    for sign in (1.0, -1.0):
        pose, other = moved(sign * step)
        levels.append(
            white_share_without_derivatives(pose.matrix, RAYS, other.vector, incidence).value
        )
    numeric = (levels[0] - levels[1]) / 2e-5
    # rotations and streaks leave out how they change the blur on the plate: second order; and all
    # leave out derivatives of the term of oblique blur
    tolerance = 0.06 if index in {3, 4, 5} else 0.03
    assert np.abs(numeric - share.jacobian[index]).max() < tolerance * np.abs(numeric).max()


def exact_plate(points_m: FloatArray, circles: Circles) -> FloatArray:
    """1 on white, 0 on black, for points (2, n) on the plate."""
    share = np.ones(points_m.shape[1])
    for centre, radius, sign in zip(
        circles.centres_m.T, circles.radii_m, circles.signs, strict=True
    ):
        share += sign * (np.hypot(*(points_m - centre[:, None])) < radius)
    return share


@pytest.mark.parametrize("distance_m", [45.0, 75.0, 160.0])
def test_levels_are_those_of_a_finely_sampled_blurred_plate(distance_m: float) -> None:
    pose = Pose(POSE.rotation, POSE.translation_m * (distance_m / POSE.distance_m))
    centre = np.round(CAMERA.project(pose.translation_m[None])[0])
    half = int(0.6 * 2300.0 / distance_m) + 4
    pixels = pixels_around(centre, half)
    fine = 16
    offsets = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    x, y = np.meshgrid(centre[0] + offsets, centre[1] + offsets)
    fine_rays = rays_of(np.column_stack((x.ravel(), y.ravel())))
    exact = exact_plate(plate_points(pose, fine_rays), CIRCLES).reshape(x.shape)
    blurred = gaussian_filter(exact, 0.75 * fine, truncate=6.0)
    size = 2 * half + 1
    expected = blurred.reshape(size, fine, size, fine).mean(axis=(1, 3)).ravel()
    blur = Blur(0.75**2 + 1.0 / 12.0, 0.75**2 + 1.0 / 12.0, 0.0)
    rays = rays_of(pixels)
    seen = white_share_without_derivatives(
        pose.matrix, rays, blur.vector, pairs_of(pose, rays, blur)
    )
    difference = (seen.value - expected)[np.hypot(*seen.points_m) < 0.6]
    assert np.abs(difference).max() < 0.02  # 16 × 16 samples know an edge to 1/32 px
    assert abs(difference.mean()) < 5e-4


@pytest.mark.parametrize(
    ("radius_px", "distance_m", "share_left"),
    [(1.5, 60.0, 0.65), (2.0, 60.0, 0.4), (2.0, 120.0, 0.45)],
)
def test_kurtosis_explains_most_of_the_difference_of_defocus_from_a_gaussian(
    radius_px: float, distance_m: float, share_left: float
) -> None:
    pose = Pose(POSE.rotation, POSE.translation_m * (distance_m / POSE.distance_m))
    centre, fine, sd_px = np.round(CAMERA.project(pose.translation_m[None])[0]), 8, 0.75
    half = int(0.6 * 2300.0 / distance_m) + 6
    offsets = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    x, y = np.meshgrid(centre[0] + offsets, centre[1] + offsets)
    fine_rays = rays_of(np.column_stack((x.ravel(), y.ravel())))
    exact = exact_plate(plate_points(pose, fine_rays), CIRCLES).reshape(x.shape)
    reach = int(radius_px * fine) + 1
    across = np.arange(-reach, reach + 1) / fine
    disc = (np.hypot(across[None, :], across[:, None]) < radius_px).astype(float)
    blurred = gaussian_filter(exact, sd_px * fine, truncate=6.0)
    blurred = fftconvolve(blurred, disc / disc.sum(), mode="same")
    size = 2 * half + 1
    expected = blurred.reshape(size, fine, size, fine).mean(axis=(1, 3)).ravel()
    variance = sd_px**2 + 1.0 / 12.0 + radius_px**2 / 4.0
    blur, rays = Blur(variance, variance, 0.0), rays_of(pixels_around(centre, half))
    incidence = pairs_of(pose, rays, blur)
    seen = white_share_without_derivatives(pose.matrix, rays, blur.vector, incidence)
    row = kurtosis_row(seen.value, pose.matrix, rays, blur.vector, incidence)
    kurtosis = -(radius_px**4 / 16.0 + 1.0 / 120.0) / variance**2  # of the disc, and of a pixel
    on_plate = np.hypot(*seen.points_m) < 0.5
    without = (seen.value - expected)[on_plate]
    left = without + kurtosis * row[on_plate]
    assert np.abs(without).max() > 0.015
    assert np.sqrt(np.mean(left**2)) < share_left * np.sqrt(np.mean(without**2))


@pytest.mark.parametrize("streak", [(0.0, 0.0), (3.0, -2.0)])
def test_quadrature_rules_hold_on_a_strongly_tilted_plate(streak: tuple[float, float]) -> None:
    """Where a pixel spans half as much again along the tilt as across it."""
    turn = Rotation.from_euler("xyz", [40.0, 25.0, 70.0], degrees=True).as_matrix()
    pose = Pose(turn, POSE.translation_m * 1.6)
    rays = rays_of(pixels_around(CAMERA.project(pose.translation_m[None])[0], 24))
    blur = Blur(0.5, 0.5, 0.0, *streak)
    scale = largest_metres_per_px(pose, rays)
    middle = rays[:, rays.shape[1] // 2].copy()
    spread = blur_on_plate(pose, middle, blur.total_covariance, blur.largest_sd_px * scale)
    incidence = find_edge_incidence(plate_points(pose, rays), scale, CIRCLES, blur, spread)
    closest = incidence.circles.copy()
    closest[closest[:, 4] < Quadrature.EDGE, 4] = Quadrature.CHORDS_70
    chosen, exact = (
        white_share_without_derivatives(pose.matrix, rays, blur.vector, each).value
        for each in (incidence, replace(incidence, circles=closest))
    )
    assert np.abs(chosen - exact).max() < 4e-4


def test_smoothing_along_contours_is_half_the_second_derivative_along_them() -> None:
    """Applied to a blurred disc, whose blur is small compared with its radius."""
    sharp = Blur(0.3, 0.36, 0.04)
    circles = circles_of((RING,)).part(slice(0, 2))
    rays = rays_of(PIXELS)
    scale = largest_metres_per_px(POSE, rays)
    incidence = find_edge_incidence(plate_points(POSE, rays), scale, circles, sharp, ISOTROPIC)

    def share_at(pixels: FloatArray) -> FloatArray:
        return white_share_without_derivatives(
            POSE.matrix, rays_of(pixels), sharp.vector, incidence
        ).value

    step = 0.05
    along_x, along_y = np.array([step, 0.0]), np.array([0.0, step])
    middle = share_at(PIXELS)
    right, left = share_at(PIXELS + along_x), share_at(PIXELS - along_x)
    down, up = share_at(PIXELS + along_y), share_at(PIXELS - along_y)
    slope = np.stack((right - left, down - up)) / (2.0 * step)
    edge = np.hypot(*slope) > 0.2
    tangents = np.stack((-slope[1], slope[0])).T[edge] / np.hypot(*slope)[edge, None]
    ahead, behind = np.array(PIXELS, float), np.array(PIXELS, float)
    ahead[edge] += step * tangents
    behind[edge] -= step * tangents
    second = (share_at(ahead) + share_at(behind) - 2.0 * middle)[edge] / step**2
    row = smoothing_row(plate_views(POSE.matrix, rays), sharp.total_covariance, incidence)[edge]
    assert edge.sum() > 100
    assert np.abs(second).max() > 0.02
    assert np.sqrt(np.mean((row - 0.5 * second) ** 2)) < 0.06 * np.sqrt(np.mean(row**2))
