"""Rings so large that means over squares of pixels are measured."""

from __future__ import annotations

import functools
import math
import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pixel_grid import normalised_grid
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.fit_target import fit_problem_of
from kgcp.measurement.adjustment.residual_image import residual_image_of
from kgcp.measurement.image_model.plate import circles_of
from kgcp.measurement.image_model.window import contour_px, cut_window
from kgcp.measurement.records import Measurement
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.plane_raster import PixelWindow
from kgcp.simulation.plate import image_plate
from kgcp.simulation.point_spread import Aberration
from kgcp.simulation.regions import rectangle
from tests.measurement.jpeg import compressed

CAMERA = Camera(753, 610, 1206.0, 1202.0, 381.3, 296.8, k1=-0.072, k2=0.055, p1=0.0004, p2=-0.0003)
RADIUS_M = 0.5 * TARGET_PLATE.target.ring.outer_diameter_m
SENSORS = {
    Response.LINEAR: Sensor(),
    Response.SRGB: Sensor(tone=ToneCurve.SRGB),
    Response.UNKNOWN: Sensor(tone=ToneCurve.FILM, sharpening=0.6, sharpening_px=1.1),
}
TURN = Rotation.from_euler("z", 71.0, degrees=True)


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    camera: Camera
    pose: Pose
    psf_px: float
    grey: GreyArray

    def measured(self) -> Measurement:
        settings = DetectSettings()
        outcome = measure_frame(self.grey, self.camera, (TARGET_PLATE.target,), settings)[0]
        assert isinstance(outcome, Measurement)
        return outcome


def shoot(response: Response, gain: float, rng: np.random.Generator) -> Shot:
    camera = replace(CAMERA, response=response)
    radius_px, psf_px = rng.uniform(160.0, 215.0), rng.uniform(0.6, 1.1)
    centre_px = np.array([376.0, 304.0]) + rng.uniform(-20.0, 20.0, 2)
    tilt, way = np.radians(rng.uniform(4.0, 20.0)), rng.uniform(0.0, 2.0 * np.pi)
    rotation = Rotation.from_rotvec(tilt * np.array([math.cos(way), math.sin(way), 0.0])) * TURN
    ray = np.append(camera.undistort(centre_px), 1.0)
    pose = Pose(rotation.as_matrix(), ray * RADIUS_M * camera.mean_focal_px / radius_px)
    light = irradiance(camera, pose, math.hypot(psf_px, 12**-0.5))
    return Shot(camera, pose, psf_px, SENSORS[response].expose(light, gain, rng))


def irradiance(camera: Camera, pose: Pose, spread_px: float) -> FloatArray:
    """Blur every edge across itself: exact where straight, and to 1e-4 px on these circles."""
    unknown = replace(camera, response=Response.UNKNOWN)  # light does not depend on it
    return _light_of(pickle.dumps((unknown, pose, spread_px)))


@functools.lru_cache(maxsize=16)
def _light_of(scene: bytes) -> FloatArray:
    """The same scene is exposed by several sensors, and in and out of shade."""
    camera, pose, spread_px = pickle.loads(scene)  # noqa: S301 - made here
    columns, rows = np.arange(float(camera.width)), np.arange(float(camera.height))
    rays = np.stack((*normalised_grid(camera, columns, rows), np.ones((len(rows), len(columns)))))
    depth_m = (pose.normal @ pose.translation_m) / np.tensordot(pose.normal, rays, 1)
    off_m = rays * depth_m - pose.translation_m[:, None, None]
    x, y = np.tensordot(pose.rotation[:, :2].T, off_m, 1)
    steps = np.stack((np.gradient(x), np.gradient(y)))  # plate axes by frame axes
    circles = circles_of(TARGET_PLATE.target.rings)
    share = np.ones_like(x)
    for (a, b), radius_m, sign in zip(
        circles.centres_m.T, circles.radii_m, circles.signs, strict=True
    ):
        near = np.hypot(x - a, y - b) < 1.1 * radius_m + 0.02
        away = np.stack((x[near] - a, y[near] - b))
        rho_m = np.hypot(*away) + 1e-12
        across = np.hypot(*(away[:, None] / rho_m * steps[:, :, near]).sum(axis=0))
        spread_m = spread_px * across
        share[near] += sign * ndtr((radius_m - rho_m) / spread_m - 0.5 * spread_m / radius_m)
    is_plate = np.maximum(np.abs(x), np.abs(y)) < 0.61
    light = np.where(is_plate, 0.05 + 0.83 * np.clip(share, 0.0, 1.0), 0.25)
    light.setflags(write=False)
    return light


def standardised(shot: Shot) -> FloatArray:
    found = shot.measured()
    assert found.uncertainty is not None
    off_m = found.pose.distance_m - shot.pose.distance_m
    off_px = found.centre_px - shot.camera.project(shot.pose.translation_m[None])[0]
    sd_px = np.sqrt(np.diag(found.uncertainty.centre_cov_px2))
    assert abs(off_m) < 5e-5 * shot.pose.distance_m
    # one of film's curve is measured by single pixels, whose blur and sharpening make up for each
    # other; of bins it is right to a quarter
    assert found.appearance.blur_px == pytest.approx(math.hypot(shot.psf_px, 12**-0.5), rel=0.3)
    return np.append(off_px / sd_px, off_m / found.uncertainty.sd_distance_m)


@pytest.mark.parametrize(
    ("response", "gain"),
    [(Response.LINEAR, 0.9), (Response.LINEAR, 1.4), (Response.SRGB, 0.8), (Response.UNKNOWN, 0.9)],
)
def test_errors_of_large_rings_are_those_that_are_reported(response: Response, gain: float) -> None:
    rng = np.random.default_rng(5)
    errors = np.array([standardised(shoot(response, gain, rng)) for _ in range(4)])
    assert 0.51 < np.sqrt(np.mean(errors**2)) < 1.54  # 99 % of 12 values


def photographed(response: Response, gain: float, optics: Optics, rng: np.random.Generator) -> Shot:
    """Photograph a ring of 158 px through any lens; there is nothing but the plate in the frame."""
    camera = replace(CAMERA, width=480, height=470, cx=240.3, cy=230.8, response=response)
    turn = Rotation.from_euler("xyz", rng.uniform((-0.2, -0.2, 0.0), (0.2, 0.2, 6.0)))
    ray = np.append(camera.undistort(np.array([238.0, 236.0]) + rng.uniform(-3.0, 3.0, 2)), 1.0)
    pose = Pose(turn.as_matrix(), ray * RADIUS_M * camera.mean_focal_px / 158.0)
    plate = replace(TARGET_PLATE, outline=rectangle((0.0, 0.0), 4.0, 4.0))
    window = PixelWindow(0, 0, camera.width, camera.height)
    light = image_plate(camera, plate, pose, optics, window).irradiance
    return Shot(camera, pose, optics.psf_px, SENSORS[response].expose(light, gain, rng))


@pytest.mark.parametrize(
    ("response", "gain", "optics"),
    [
        (Response.LINEAR, 0.8, Optics(1.2, aberration=Aberration(coma=0.15, coma_deg=25.0))),
        (Response.SRGB, 0.8, Optics(1.0, aberration=Aberration(coma=0.15, coma_deg=25.0))),
        (Response.SRGB, 0.25, Optics(1.0, streak_px=(5.0, 3.0))),
    ],
    ids=["comatic, linear", "comatic, sRGB", "moved, sRGB"],
)
def test_point_spreads_that_bins_show_do_not_move_large_rings(
    response: Response, gain: float, optics: Optics
) -> None:
    """By bins without a skew, χ² of the centres was 77, 15, 7, and distances 11, 34, 66 ppm off."""
    shot = photographed(response, gain, optics, np.random.default_rng(4))
    found = shot.measured()
    assert found.uncertainty is not None
    off_px = found.centre_px - shot.camera.project(shot.pose.translation_m[None])[0]
    off_m = found.distance_m - shot.pose.distance_m
    assert off_px @ np.linalg.solve(found.uncertainty.centre_cov_px2, off_px) < 6.0
    assert abs(off_m) < 2.6 * found.uncertainty.sd_distance_m
    assert abs(off_m) < 1.5e-5 * shot.pose.distance_m


def half_in_shade(response: Response, turn: float, rng: np.random.Generator) -> Shot:
    shot = shoot(response, 0.8, rng)
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    across_px = (columns - 376.0) * math.cos(turn) + (rows - 304.0) * math.sin(turn)
    lit = irradiance(shot.camera, shot.pose, math.hypot(shot.psf_px, 12**-0.5))
    shaded = lit * (1.0 - 0.55 * ndtr((across_px - 20.0) / 6.0))
    return replace(shot, grey=SENSORS[response].expose(shaded, 0.8, rng))


@pytest.mark.parametrize("response", [Response.LINEAR, Response.SRGB])
def test_large_rings_half_in_shade_are_measured_as_well_as_in_even_light(
    response: Response,
) -> None:
    """Bins are used for linear light; under sRGB's curve, they would have 0.013 to 0.019 %."""
    rng = np.random.default_rng(11)
    for turn in (0.4, 2.1, 3.9):
        shot = half_in_shade(response, turn, rng)
        found = shot.measured()
        assert found.uncertainty is not None
        off = found.pose.distance_m / shot.pose.distance_m - 1.0
        sd = found.uncertainty.sd_distance_m / shot.pose.distance_m
        assert sd < 3e-5
        assert abs(off) < 3.5 * sd


def test_compression_of_large_rings_is_not_taken_for_uneven_light() -> None:
    """Bins with varying levels would have deviations of 0.004 to 0.011 %."""
    rng = np.random.default_rng(8)
    for _ in range(4):
        shot = shoot(Response.UNKNOWN, 1.1, rng)
        found = replace(shot, grey=compressed(shot.grey, 90)).measured()
        assert found.uncertainty is not None
        off = found.pose.distance_m / shot.pose.distance_m - 1.0
        sd = found.uncertainty.sd_distance_m / shot.pose.distance_m
        assert sd < 3e-5
        assert abs(off) < 3.5 * sd


@pytest.mark.parametrize("response", [Response.LINEAR, Response.SRGB])
def test_the_fitted_light_on_a_large_ring_half_in_shade_can_be_shown(response: Response) -> None:
    shot = half_in_shade(response, 0.4, np.random.default_rng(11))
    left = residual_image_of(shot.grey, shot.camera, TARGET_PLATE.target, shot.pose, shot.psf_px)
    assert left.white is not None
    assert np.nanquantile(left.white, 0.05) == pytest.approx(0.45, abs=0.1)  # of the light
    assert np.nanmedian(np.abs(left.share)) < 0.02


@pytest.mark.parametrize("count", [2, 3, 7])
def test_the_binned_camera_has_bins_as_pixels(count: int) -> None:
    points = np.array([[0.1, -0.2, 1.0], [-0.3, 0.15, 1.1]])
    seen, bins = CAMERA.project(points), CAMERA.binned(count).project(points)
    np.testing.assert_allclose(count * bins + 0.5 * (count - 1), seen, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("count", [2, 3])
def test_bins_are_means_with_their_clipped_share(count: int, dtype: type) -> None:
    full = np.iinfo(dtype).max
    frame = np.random.default_rng(4).integers(0, full, (610, 753), dtype)
    frame[frame > 0.7 * full] = full
    camera = CAMERA.binned(count)
    pose = Pose(np.eye(3), np.array([0.02, -0.01, 2.5]))
    window = cut_window(frame, camera, contour_px(camera, pose, RADIUS_M), 12.0, count)
    rows = slice(count * window.y0, count * (window.y0 + window.height))
    columns = slice(count * window.x0, count * (window.x0 + window.width))
    part = frame[rows, columns]
    clipped = (part == full) | (part == 0)
    assert window.clipped is not None
    for values, bins in ((part / full, window.levels), (clipped, window.clipped)):
        shape = (window.height, count, window.width, count)
        expected = values.reshape(shape).mean(axis=(1, 3))
        np.testing.assert_allclose(bins.reshape(expected.shape), expected, atol=1e-12)
    np.testing.assert_allclose(
        camera.distort(window.rays[:2, :3].T),
        [[window.x0 + i, window.y0] for i in range(3)],
        atol=1e-5,
    )


def test_residuals_of_bins_lie_where_their_pixels_are() -> None:
    shot = shoot(Response.LINEAR, 0.9, np.random.default_rng(2))
    assert (
        fit_problem_of(shot.grey, shot.camera, TARGET_PLATE.target, shot.pose).window.binning == 2
    )
    left = residual_image_of(shot.grey, shot.camera, TARGET_PLATE.target, shot.pose, shot.psf_px)
    rows, columns = np.nonzero(np.isfinite(left.share))
    centre = np.array([left.x0 + columns.mean(), left.y0 + rows.mean()])
    seen = shot.camera.project(shot.pose.translation_m[None])[0]
    np.testing.assert_allclose(centre, seen, atol=0.02 * np.ptp(columns))
    assert np.nanmedian(np.abs(left.share)) < 0.01
