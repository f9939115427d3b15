import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import ncx2, norm

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pixel_grid import normalised_grid
from kgcp.geometry.pose import Pose
from kgcp.simulation.imaging import Optics
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster, outline_box
from kgcp.simulation.regions import DiscRegion, Region, rectangle, regular_polygon

PLAIN = Camera(width=640, height=480, fx=1000.0, fy=1000.0, cx=320.3, cy=240.7)
LENS = Camera(
    width=900, height=700, fx=1210.0, fy=1206.0, cx=441.2, cy=361.7,
    k1=-0.09, k2=0.06, p1=0.0008, p2=-0.0006, k3=-0.01,
)  # fmt: skip
WINDOW = PixelWindow(280, 200, 80, 80)


def facing(x_px: float, y_px: float) -> Pose:
    """One pixel of PLAIN is one metre of the plane."""
    return Pose(np.eye(3), np.array([x_px - PLAIN.cx, y_px - PLAIN.cy, 1000.0]))


def render(shape: Region, pose: Pose, oversampling: int, camera: Camera = PLAIN) -> FloatArray:
    patch = PlaneRaster.of(camera, pose, WINDOW, oversampling)
    image = np.zeros_like(patch.x_m)
    patch.paint(image, shape, 1.0)
    return image


def moments(image: FloatArray, window: PixelWindow) -> tuple[float, float, float]:
    area = float(image.sum())
    x = float(image.sum(axis=0) @ (window.column + np.arange(window.width))) / area
    y = float(image.sum(axis=1) @ (window.row + np.arange(window.height))) / area
    return area, x, y


def test_grid_is_undistorted_like_single_pixels() -> None:
    x, y = normalised_grid(LENS, np.arange(-20.0, 920.0), np.arange(700.0))
    rng = np.random.default_rng(3)
    columns, rows = rng.integers(0, 940, 300), rng.integers(0, 700, 300)
    exact = LENS.undistort(np.column_stack((columns - 20.0, rows)))
    assert_allclose(
        np.column_stack((x[rows, columns], y[rows, columns])), exact, atol=1e-9 / LENS.fx
    )


@pytest.mark.parametrize(("radius", "oversampling"), [(1.0, 8), (3.0, 4), (12.0, 3), (30.0, 3)])
def test_discs_keep_area_and_centre(radius: float, oversampling: int) -> None:
    rng = np.random.default_rng(5)
    for x_px, y_px in rng.uniform(319.0, 321.0, (8, 2)) - (0.0, 80.0):
        image = render(DiscRegion((0.0, 0.0), radius), facing(x_px, y_px), oversampling)
        irradiance = Optics(0.6, (1.7, -0.9)).spread(image, oversampling)
        area, x, y = moments(irradiance, WINDOW)
        assert abs(np.sqrt(area / np.pi) - radius) < 0.0005
        assert_allclose((x, y), (x_px, y_px), atol=0.001)


def test_oblique_discs_through_a_lens_agree_with_opencv() -> None:
    distortion = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3])
    matrix = np.array([[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]])
    angles = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    circle = 0.4 * np.column_stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rotation = Rotation.from_euler("xyz", rng.uniform(-40.0, 40.0, 3), degrees=True)
        translation = np.array([-2.0, 1.5, 8.0]) + rng.uniform(-0.5, 0.5, 3)
        pose = Pose(rotation.as_matrix(), translation)
        contour = cv2.projectPoints(circle, rotation.as_rotvec(), translation, matrix, distortion)[
            0
        ][:, 0]
        x, y = contour.T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        area = 0.5 * cross.sum()
        centroid = [((a + np.roll(a, -1)) * cross).sum() / (6.0 * area) for a in (x, y)]
        corner, size = outline_box(LENS, pose, DiscRegion((0.0, 0.0), 0.4))
        column, row = np.floor(corner).astype(int) - 4
        width, height = np.ceil(size).astype(int) + 9
        window = PixelWindow(int(column), int(row), int(width), int(height))
        patch = PlaneRaster.of(LENS, pose, window, 4)
        image = np.zeros_like(patch.x_m)
        patch.paint(image, DiscRegion((0.0, 0.0), 0.4), 1.0)
        rendered = moments(Optics(0.7).spread(image, 4), window)
        assert_allclose(rendered[0], abs(area), rtol=1e-5)
        assert_allclose(rendered[1:], centroid, atol=2e-4)


def test_straight_edges_have_the_exact_profile() -> None:
    sigma = 0.6
    edge_px = 320.37
    image = render(rectangle((-100.0, 0.0), 200.0, 200.0), facing(edge_px, 240.0), 8)
    row = Optics(sigma).spread(image, 8)[40]

    def integral(x: FloatArray) -> FloatArray:
        return np.asarray(x * norm.cdf(x / sigma) + sigma * norm.pdf(x / sigma))

    columns: FloatArray = np.arange(WINDOW.width, dtype=np.float64)
    distance = edge_px - WINDOW.column - columns
    expected = integral(distance + 0.5) - integral(distance - 0.5)
    error = (row - expected)[np.abs(distance) < 30.0]
    assert np.abs(error).max() < 0.001  # aliasing of the sub-pixels
    assert abs(error.sum()) < 1e-9  # which does not move the edge


def test_half_level_of_blurred_discs_lies_inside_by_half_of_sigma_squared_over_radius() -> None:
    radius, psf = 9.0, 0.8
    image = Optics(psf).spread(render(DiscRegion((0.0, 0.0), radius), facing(320.4, 239.8), 8), 8)
    y, x = np.mgrid[200:280, 280:360]
    distance = np.hypot(x - 320.4, y - 239.8)
    near = np.abs(distance - radius) < 0.5
    slope, offset = np.polyfit(distance[near] - radius, norm.ppf(image[near]), 1)
    expected = -(psf**2 + 1.0 / 12.0) / (2.0 * radius)
    assert -offset / slope == pytest.approx(expected, abs=0.002)


def test_blurred_dots_follow_the_noncentral_chi_square_law() -> None:
    radius, psf = 1.5, 1.1
    image = Optics(psf).spread(render(DiscRegion((0.0, 0.0), radius), facing(320.4, 239.8), 8), 8)
    y, x = np.mgrid[200:280, 280:360]
    variance = psf**2 + 1.0 / 12.0
    distance2 = (x - 320.4) ** 2 + (y - 239.8) ** 2
    expected = ncx2.cdf(radius**2 / variance, 2, distance2 / variance)
    assert_allclose(image, expected, atol=0.001)  # the pixel is a square, not a Gaussian


def test_streaks_widen_along_their_direction_only() -> None:
    image = render(DiscRegion((0.0, 0.0), 3.0), facing(320.0, 240.0), 8)
    y, x = np.mgrid[200.0:280.0, 280.0:360.0]

    def spread(optics: Optics) -> FloatArray:
        irradiance = optics.spread(image, 8)
        weights = irradiance / irradiance.sum()
        points = np.stack((x - 320.0, y - 240.0))
        return np.asarray(np.einsum("iyx,jyx,yx->ij", points, points, weights))

    streak = np.array([2.4, 1.8])
    wider = spread(Optics(0.6, (2.4, 1.8))) - spread(Optics(0.6))
    assert_allclose(wider, np.outer(streak, streak) / 12.0, atol=1e-4)


def test_polygons_keep_their_area() -> None:
    shape = regular_polygon(5, 7.3)
    image = render(shape, facing(321.1, 238.6), 4)
    exact = 5.0 * 7.3**2 * np.tan(np.pi / 5.0) * 16.0
    assert image.sum() == pytest.approx(exact, rel=2e-4)


def test_shapes_outside_the_window_paint_nothing() -> None:
    assert not render(DiscRegion((0.0, 0.0), 5.0), facing(100.0, 100.0), 3).any()
