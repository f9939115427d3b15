"""Light on plates, checked by closed forms and by integration on a much finer grid."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics
from kgcp.simulation.light_field import Cloud, Highlight, PlateLight, Shade, Stain
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster
from kgcp.simulation.plate import image_plate
from kgcp.simulation.regions import ConvexPolygon, rectangle

CAMERA = Camera(
    width=900, height=700, fx=1210.0, fy=1206.0, cx=441.2, cy=361.7, k1=-0.09, k2=0.06
)  # fmt: skip
POSE = Pose(
    Rotation.from_euler("zyx", [131.0, 9.0, -14.0], degrees=True).as_matrix(),
    np.array([0.4, -0.3, 9.0]),
)
FLAT = Camera(width=64, height=48, fx=1000.0, fy=1000.0, cx=31.3, cy=23.6)
PIXEL_M = 0.01
FACING = Pose(np.eye(3), np.array([0.0, 0.0, 1000.0 * PIXEL_M]))
WINDOW = PixelWindow(0, 0, 64, 48)


def half_plane(direction_deg: float, edge_m: float, penumbra_m: float) -> Shade:
    """Shade on the side to which the direction points."""
    angle = math.radians(direction_deg)
    return Shade((math.cos(angle), math.sin(angle)), edge_m + 50.0, 100.0, penumbra_m)


def test_uniform_light_changes_nothing() -> None:
    plain = image_plate(CAMERA, TARGET_PLATE, POSE, Optics(0.7))
    far_away = half_plane(30.0, 7.0, 0.1)
    for field in (PlateLight(), PlateLight(0.45, (far_away,), (Stain((5.0, 0.0), 0.1, 0.9),))):
        lit = image_plate(CAMERA, TARGET_PLATE, POSE, Optics(0.7), field=field)
        assert_array_equal(lit.irradiance, plain.irradiance)
        assert_array_equal(lit.opacity, plain.opacity)


def test_full_shade_leaves_the_share_that_was_asked_for() -> None:
    plain = image_plate(CAMERA, TARGET_PLATE, POSE, Optics(0.7))
    field = PlateLight(0.45, (half_plane(30.0, -7.0, 0.1),))
    shaded = image_plate(CAMERA, TARGET_PLATE, POSE, Optics(0.7), field=field)
    assert_allclose(shaded.irradiance, 0.45 * plain.irradiance, atol=1e-12)


@pytest.mark.parametrize("penumbra_m", [0.004, 0.03, 0.15])
@pytest.mark.parametrize("direction_deg", [0.0, 27.0, -45.0])
def test_a_shadow_edge_takes_the_light_of_the_area_behind_it(
    direction_deg: float, penumbra_m: float
) -> None:
    patch = PlaneRaster.of(FLAT, FACING, WINDOW, 4)
    light = PlateLight(0.3, (half_plane(direction_deg, 0.0137, penumbra_m),)).share(patch)
    # Penumbras are symmetric: in every row, light is lost as beyond a sharp edge.
    angle = math.radians(direction_deg)
    edge_m = (0.0137 - math.sin(angle) * patch.y_m[:, 0]) / math.cos(angle)
    border_m = patch.x_m[0, -1] + PIXEL_M / 8.0
    inside = np.abs(edge_m - 0.5 * (border_m + patch.x_m[0, 0])) < 0.3 - penumbra_m
    lost_px = ((1.0 - light) / 0.7).sum(axis=1) / 4.0
    expected_px = (border_m - edge_m) / PIXEL_M
    assert np.count_nonzero(inside) > 60
    assert_allclose(lost_px[inside], expected_px[inside], atol=0.0005)


def test_penumbra_is_the_visible_share_of_the_suns_disc() -> None:
    shade = half_plane(0.0, 0.0, 0.2)
    x_m = np.linspace(-0.13, 0.13, 27)
    rng = np.random.default_rng(4)
    disc = rng.uniform(-1.0, 1.0, (400_000, 2))
    heights = disc[np.hypot(*disc.T) < 1.0, 0]
    visible = [(heights > 10.0 * x).mean() for x in x_m]
    assert_allclose(shade.sunlight(x_m, np.zeros(27)), visible, atol=0.004)


def test_narrow_stripes_never_reach_full_shade() -> None:
    stripe = Shade((1.0, 0.0), 0.0, 0.05, 0.2)
    x_m = np.linspace(-0.3, 0.3, 601)
    hidden = 1.0 - stripe.sunlight(x_m, np.zeros(601))
    assert hidden.max() == pytest.approx(4.0 / math.pi * 0.05 / 0.2, rel=0.02)  # chord / disc
    assert hidden.sum() * 0.001 == pytest.approx(
        0.05, rel=1e-6
    )  # takes as much light as a sharp one


def supersampled(field: PlateLight, edge: ConvexPolygon, factor: int) -> FloatArray:
    """Mean light of sub-pixels by brute force: a plate half black, on a `factor`² finer grid."""
    patch = PlaneRaster.of(FLAT, FACING, WINDOW, 4 * factor)
    painted = np.ones_like(patch.x_m)
    patch.paint(painted, edge, 0.1)
    light = painted * field.share(patch)
    rows, columns = light.shape
    blocks = light.reshape(rows // factor, factor, columns // factor, factor)
    return np.asarray(blocks.mean(axis=(1, 3)))


@pytest.mark.parametrize("direction_deg", [0.0, 17.0, 45.0])
def test_edges_of_the_print_are_shared_by_area_in_a_penumbra(direction_deg: float) -> None:
    ink = rectangle((0.5021, 0.0013), 1.0, 2.0, 33.0)
    field = PlateLight(0.45, (half_plane(33.0 + direction_deg, -0.003, 0.02),))
    patch = PlaneRaster.of(FLAT, FACING, WINDOW, 4)
    painted = np.ones_like(patch.x_m)
    patch.paint(painted, ink, 0.1)
    light = field.shine_on(patch, painted, np.ones_like(painted))
    exact = supersampled(field, ink, 8)
    inner = (slice(8, -8), slice(8, -8))
    shift_px = (light - exact)[inner].sum(axis=1) / (0.9 * 0.45) / 4.0  # of the edge
    assert_allclose(shift_px.reshape(-1, 4).mean(axis=1), 0.0, atol=0.0005)


def test_dirt_has_the_declared_deviation_and_correlation() -> None:
    dirt = Dirt(sd=0.05, correlation_m=0.05, stains=0)
    rng = np.random.default_rng(7)
    x_m, y_m = rng.uniform(-0.6, 0.6, (2, 4000))
    one, near, far = [], [], []
    for _ in range(12):
        cloud = Cloud.drawn(dirt, rng)
        one.append(cloud.reflectance(x_m, y_m) - 1.0)
        near.append(cloud.reflectance(x_m + 0.05, y_m) - 1.0)
        far.append(cloud.reflectance(x_m, y_m - 0.3) - 1.0)
    values = np.concatenate(one)
    assert values.std() == pytest.approx(0.05, rel=0.05)
    assert np.corrcoef(values, np.concatenate(near))[0, 1] == pytest.approx(
        math.exp(-0.5), abs=0.05
    )
    assert abs(np.corrcoef(values, np.concatenate(far))[0, 1]) < 0.08


def test_stains_take_the_light_of_their_area() -> None:
    patch = PlaneRaster.of(FLAT, FACING, WINDOW, 8)
    for radius_m in (0.02, 0.05):
        light = PlateLight(stains=(Stain((0.0131, -0.0072), radius_m, 0.8),)).share(patch)
        lost = (1.0 - light).sum() * (PIXEL_M / 8.0) ** 2
        # The soft outline is symmetric; its second moment adds to the area.
        soft = 1.0 + 0.3**2 * (1.0 - 8.0 / math.pi**2)
        assert lost == pytest.approx(0.8 * math.pi * radius_m**2 * soft, rel=2e-3)
        assert light.min() == pytest.approx(0.2, abs=1e-9)


def test_a_highlight_adds_the_same_to_ink_and_white() -> None:
    highlight = Highlight((0.1, 0.05), 0.2, 0.5)
    plain = image_plate(CAMERA, TARGET_PLATE, POSE, Optics(0.7))
    shiny = image_plate(
        CAMERA, TARGET_PLATE, POSE, Optics(0.7), field=PlateLight(highlight=highlight)
    )
    added = shiny.irradiance - plain.irradiance
    middle = CAMERA.project(POSE.transform(np.array([[0.1, 0.05, 0.0]])))[0]
    row, column = round(middle[1]) - plain.window.row, round(middle[0]) - plain.window.column
    assert added[row, column] == pytest.approx(0.5, rel=2e-3)
    inside = plain.opacity > 1.0 - 1e-9
    assert added[inside].min() > 0.0
    slope = np.abs(np.diff(added, axis=1))[inside[:, 1:] & inside[:, :-1]]
    assert slope.max() < 0.5 / 0.2 * 0.61 / 120.0  # no edge of the print in it


@given(seed=st.integers(0, 2**32), gain=st.floats(0.3, 2.0))
def test_drawn_light_keeps_to_its_settings(seed: int, gain: float) -> None:
    shadow, dirt, glare = Shadow(stripes=2), Dirt(stains=5), Glare()
    field = PlateLight.drawn(shadow, dirt, glare, gain, np.random.default_rng(seed))
    assert field.light_left == 0.45
    assert len(field.shades) == 3
    for shade in field.shades:
        assert 0.03 <= shade.penumbra_m <= 0.25
        assert math.hypot(*shade.normal) == pytest.approx(1.0)
    assert all(0.02 <= shade.width_m <= 0.08 for shade in field.shades[1:])
    assert len(field.stains) == 5
    assert all(0.006 <= stain.radius_m <= 0.016 for stain in field.stains)
    assert all(0.3 <= stain.darkness <= 0.9 for stain in field.stains)
    assert field.highlight is not None
    assert 0.2 <= field.highlight.radiance * gain <= 0.6 + 1e-12
    assert 0.12 <= field.highlight.radius_m <= 0.3


def test_impossible_light_is_refused() -> None:
    for make, key in (
        (lambda: Shadow(light_left=1.2), "light_left"),
        (lambda: Shadow(penumbra_m=(0.2, 0.1)), "penumbra_m"),
        (lambda: replace(Dirt(), sd=-0.1), "sd"),
        (lambda: replace(Dirt(), darkness=(0.0, 1.5)), "darkness"),
        (lambda: Glare(radius_m=(0.0, 1.0)), "radius_m"),
    ):
        with pytest.raises(SettingError, match=key):
            make()
