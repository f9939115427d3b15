"""The camera against OpenCV's projection, and distortion against its inverse."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera, Response

DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
PLAIN = Camera(1600, 1100, 2306.0, 2302.0, 792.6, 543.9)
LENSES = {
    "plain": PLAIN,
    "radial": replace(PLAIN, k1=-0.18, k2=0.07, k3=-0.01),
    "tangential": replace(PLAIN, k1=-0.07, p1=2e-3, p2=-1e-3),
    "rational": replace(
        PLAIN, k1=0.21, k2=-0.12, p1=4e-4, p2=-3e-4, k3=0.02, k4=0.28, k5=-0.15, k6=0.03
    ),
}


def opencv_pixels(camera: Camera, points: FloatArray) -> FloatArray:
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    distortion = np.array([getattr(camera, name) for name in DISTORTION])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(pixels[:, 0])


@pytest.mark.parametrize("lens", LENSES)
def test_projection_equals_opencv(lens: str) -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform((-3.0, -2.0, 9.0), (3.0, 2.0, 30.0), (200, 3))
    camera = LENSES[lens]
    np.testing.assert_allclose(
        camera.project(points), opencv_pixels(camera, points), rtol=0.0, atol=1e-9
    )


MATRIX = np.array([[2306.0, 0.0, 792.6], [0.0, 2302.0, 543.9], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_from_opencv_projects_as_opencv_does(count: int) -> None:
    rng = np.random.default_rng(count)
    distortion = np.zeros(count)
    distortion[:8] = (0.21, -0.12, 4e-4, -3e-4, 0.02, 0.28, -0.15, 0.03)[:count]
    points = rng.uniform((-3.0, -2.0, 9.0), (3.0, 2.0, 30.0), (200, 3))
    for numbers in (distortion, distortion[None], distortion[:, None]):  # as versions return them
        camera = Camera.from_opencv(MATRIX, numbers, (1600, 1100))
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, numbers)
        np.testing.assert_allclose(camera.project(points), expected[:, 0], rtol=0.0, atol=1e-9)
    assert (camera.width, camera.height) == (1600, 1100)


def test_from_opencv_takes_response_and_readout() -> None:
    camera = Camera.from_opencv(
        MATRIX.tolist(), [0.0] * 5, (1600, 1100), response=Response.LINEAR, readout_s=0.02
    )
    assert camera == replace(PLAIN, response=Response.LINEAR, readout_s=0.02)


def changed(row: int, column: int, value: float) -> FloatArray:
    matrix = MATRIX.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "distortion", "words"),
    [
        (changed(0, 1, 0.3), [0.0] * 5, "camera_matrix: has a skew of 0.3; calibrate without"),
        (changed(1, 0, 0.3), [0.0] * 5, "is not of the form fx 0 cx"),
        (changed(2, 2, 2.0), [0.0] * 5, "is not of the form fx 0 cx"),
        (changed(0, 0, -1.0), [0.0] * 5, "fx: "),
        (changed(0, 2, np.nan), [0.0] * 5, "cx: "),
        (MATRIX[:2], [0.0] * 5, "is not of the form fx 0 cx"),
        (MATRIX, [0.0] * 6, "distortion: has 6 numbers; give 4, 5 or 8"),
        (MATRIX, [0.1], "distortion: has 1 numbers"),
        (MATRIX, [0.0] * 11 + [1e-4], "thin prism or a tilted sensor"),
        (MATRIX, [0.0] * 12 + [0.1, 0.0], "thin prism or a tilted sensor"),
        (MATRIX, [0.0, np.inf, 0.0, 0.0], "k2: is not a finite number"),
    ],
)
def test_from_opencv_rejects_other_models(
    matrix: FloatArray, distortion: list[float], words: str
) -> None:
    with pytest.raises(SettingError, match=words):
        Camera.from_opencv(matrix, distortion, (1600, 1100))


@pytest.mark.parametrize("lens", LENSES)
def test_projected_circles_equal_projected_points(lens: str) -> None:
    axes = Rotation.from_euler("xyz", (0.4, -0.3, 1.1)).as_matrix()
    centre, radii, angles = np.array([0.8, -0.5, 7.0]), np.array([0.1, 0.45]), np.arange(7.0)
    circle = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    points = (radii[:, None, None] * circle).reshape(-1, 2) @ axes[:, :2].T + centre
    pixels = LENSES[lens].project_circles(axes, centre, radii, circle)
    assert pixels.shape == (2, 7, 2)
    expected = opencv_pixels(LENSES[lens], points)
    np.testing.assert_allclose(pixels.reshape(-1, 2), expected, rtol=0.0, atol=1e-9)


@given(lens=st.sampled_from(sorted(LENSES)), x=st.floats(-0.5, 1599.5), y=st.floats(-0.5, 1099.5))
def test_distort_inverts_undistort(lens: str, x: float, y: float) -> None:
    pixel = np.array([[x, y]])
    camera = LENSES[lens]
    np.testing.assert_allclose(camera.distort(camera.undistort(pixel)), pixel, rtol=0.0, atol=1e-8)


@given(lens=st.sampled_from(sorted(LENSES)), x=st.floats(-0.35, 0.35), y=st.floats(-0.25, 0.25))
def test_distort_jacobian_equals_finite_differences(lens: str, x: float, y: float) -> None:
    camera, step = LENSES[lens], 1e-6
    analytic = camera.distort_jacobian(np.array([[x, y]]))[0]
    for column, axis in enumerate(np.eye(2)):
        high, low = (camera.distort(np.array([[x, y]]) + sign * step * axis) for sign in (1, -1))
        np.testing.assert_allclose(analytic[:, column], (high - low)[0] / (2.0 * step), atol=1e-4)


def test_only_pixels_beyond_the_fold_are_nan() -> None:
    """With k1 = −0.5 the distorted radius r − r³/2 never exceeds 0.544."""
    camera = replace(PLAIN, k1=-0.5)
    farthest = 2.0 / 3.0 * np.sqrt(2.0 / 3.0)
    pixels = camera.cx + camera.fx * farthest * np.array([0.99, 1.01]), np.full(2, camera.cy)
    inside, beyond = camera.undistort(np.column_stack(pixels))
    assert np.isnan(beyond).all()
    np.testing.assert_allclose(camera.distort(inside), (pixels[0][0], camera.cy), atol=1e-8)
    assert inside[0] < np.sqrt(2.0 / 3.0), "the branch that holds the optical axis"


FOLDED: dict[str, dict[str, Any]] = {
    "one term": {"k1": -0.3},
    "three terms": {"k1": -0.28, "k2": 0.07, "k3": -0.008},
    "turned twice": {"k1": -0.5, "k2": 0.1},
    "turned twice, far out": {"k1": -0.45, "k2": 0.09, "k3": -0.002},
    "rational": {"k1": 0.6, "k2": 0.05, "k3": 0.001, "k4": 0.9, "k5": 0.2, "k6": 0.01},
    "infinite": {"k1": -0.3, "k4": -0.4},
}


@pytest.mark.parametrize("tangential", [0.0, 2e-3])
@pytest.mark.parametrize("lens", FOLDED)
def test_exactly_the_rays_before_the_fold_are_found(lens: str, tangential: float) -> None:
    plain = Camera(4000, 3000, 1800.0, 1790.0, 2010.0, 1490.0)
    camera = replace(plain, p1=tangential, p2=-0.5 * tangential, **FOLDED[lens])
    # rays from the axis outwards, up to where the distortion turns
    radii, angles = np.arange(0.0, 4.0, 0.002), np.radians(np.arange(0.0, 360.0, 5.0))
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    rays = radii[:, None, None] * directions
    slopes = camera.distort_jacobian(rays) / camera.mean_focal_px
    is_before = np.logical_and.accumulate(np.linalg.det(slopes) > 1e-4)
    before = rays[is_before]
    pixels = camera.distort(before)
    is_seen = np.all((pixels > -0.5) & (pixels < (3999.5, 2999.5)), axis=1)
    np.testing.assert_allclose(camera.undistort(pixels[is_seen]), before[is_seen], atol=1e-6)

    x, y = np.meshgrid(np.arange(0.0, 4000.0, 50.0), np.arange(0.0, 3000.0, 50.0))
    found = camera.undistort(np.column_stack((x.ravel(), y.ravel())))
    found = found[np.isfinite(found[:, 0])]
    angle = np.degrees(np.arctan2(found[:, 1], found[:, 0])) % 360.0
    reach = np.max(np.where(is_before, radii[:, None], 0.0), axis=0)
    largest = np.interp(angle, np.append(np.degrees(angles), 360.0), np.append(reach, reach[0]))
    assert len(found) > 100
    assert (np.hypot(*found.T) <= largest + 0.03).all()


def test_the_shape_of_point_arrays_is_kept() -> None:
    camera = LENSES["rational"]
    grid = np.stack(np.meshgrid(np.linspace(0.0, 1500.0, 5), np.linspace(0.0, 1000.0, 3)), axis=-1)
    assert camera.undistort(grid).shape == grid.shape
    np.testing.assert_array_equal(
        camera.undistort(grid)[1, 2], camera.undistort(grid[1, 2][None])[0]
    )


@pytest.mark.parametrize("count", [2, 3, 4, 8])
def test_a_binned_camera_has_the_same_rays_and_delays(count: int) -> None:
    camera = replace(LENSES["rational"], width=1608, height=1104, readout_s=0.03)
    bins = np.array([[0.0, 0.0], [131.0, 20.0], [200.0, 137.0]])
    pixels = count * bins + 0.5 * (count - 1)
    binned = camera.binned(count)
    np.testing.assert_allclose(binned.undistort(bins), camera.undistort(pixels), atol=1e-12)
    np.testing.assert_allclose(binned.delay_s(bins), camera.delay_s(pixels), atol=1e-12)


@pytest.mark.parametrize(
    ("key", "value"),
    [("fx", 0.0), ("fy", -1.0), ("width", 1), ("cx", 5000.0), ("cy", float("nan")),
     ("k2", float("inf")), ("readout_s", -30.0)],
)  # fmt: skip
def test_invalid_cameras_are_rejected_naming_the_key(key: str, value: float) -> None:
    with pytest.raises(SettingError) as caught:
        Camera(**{**asdict(PLAIN), key: value})
    assert caught.value.key == key


def test_rows_may_be_read_from_the_last_to_the_first() -> None:
    """Frames of a camera that hangs upside down are often turned by 180°."""
    camera = Camera(1600, 1201, 1700.0, 1700.0, 799.5, 600.0, readout_s=-0.03)
    np.testing.assert_allclose(
        camera.delay_s(np.array([[0.0, 0.0], [0.0, 600.0], [0.0, 1200.0]])), [0.015, 0.0, -0.015]
    )
    assert camera.binned(2).readout_s < 0.0
