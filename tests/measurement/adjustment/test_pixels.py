"""Which pixels are used: those of the plate only, whatever its shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.pixels import NEAR_SIGMAS, Sample, select_pixels
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.solver import predict
from kgcp.measurement.image_model.blur import Blur, find_edge_incidence
from kgcp.measurement.image_model.blurred_plate import white_share_without_derivatives
from kgcp.measurement.image_model.photometry import PhotometricModel, Tone, light_of_levels
from kgcp.measurement.image_model.plate import ISOTROPIC, plate_points
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import PlateImage, PrintedPlate, image_plate
from kgcp.simulation.regions import ConvexPolygon, regular_polygon
from kgcp.targets.layout import Target

PlacePlate = Callable[..., Pose]
ImagingOf = Callable[..., FitProblem]
PSF_PX = 0.7
BLUR = Blur(PSF_PX**2 + 1.0 / 12.0, PSF_PX**2 + 1.0 / 12.0, 0.0)
WHITE, BLACK = 0.8, 0.06
LIGHT = light_of_levels(BLACK, WHITE, Tone.UNKNOWN)
WIDE, NARROW = regular_polygon(8, 0.60), regular_polygon(4, 0.51)
BORDER_PX = 2.4


def photograph(
    camera: Camera, target: Target, pose: Pose, outline: ConvexPolygon, ground: float
) -> tuple[GreyArray, PlateImage]:
    image = image_plate(camera, PrintedPlate(target, outline, WHITE, BLACK), pose, Optics(PSF_PX))
    irradiance = np.full((camera.height, camera.width), ground)
    image.paste(irradiance)
    return Sensor().expose(irradiance, 1.0, np.random.default_rng(5)), image


def opacity_of(sample: Sample, image: PlateImage) -> FloatArray:
    window = sample.problem.window
    x, y = window.pixels(sample.index).astype(int)
    return np.asarray(image.opacity[y - image.window.row, x - image.window.column])


def beyond_px(sample: Sample, pose: Pose) -> FloatArray:
    """How far the pixels are beyond the outer circle."""
    problem = sample.problem
    points = plate_points(pose, sample.rays)
    beyond = np.hypot(*points) / problem.outer_radius_m - 1.0
    return np.asarray(beyond * problem.outer_radius_px)


@pytest.mark.parametrize("ground", [0.05, 0.35])
@pytest.mark.parametrize("corners", [4, 5, 8])
@pytest.mark.parametrize("radius_px", [14.0, 40.0])
def test_pixels_mixed_with_the_surroundings_are_left_out(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    imaging_of: ImagingOf,
    ground: float,
    corners: int,
    radius_px: float,
) -> None:
    """On a plate whose border is nowhere narrower than BORDER_PX."""
    pose = place_plate((205.4, 190.7), radius_px, tilt_deg=20.0, way_deg=200.0, turn_deg=31.0)
    outline = regular_polygon(corners, 0.45 * (1.0 + BORDER_PX / radius_px))
    grey, image = photograph(camera, target, pose, outline, ground)
    problem = imaging_of(grey, camera, target, pose)
    sample = select_pixels(problem, pose, BLUR, LIGHT)
    everything = select_pixels(problem, pose, BLUR, None)
    mixed, unfiltered = (
        (WHITE - ground) * (1.0 - opacity_of(each, image)) for each in (sample, everything)
    )
    assert mixed.max() < 0.05
    assert np.mean(mixed > 0.02) < 0.015
    assert len(sample.levels) > 0.75 * len(everything.levels)
    assert unfiltered.max() > 0.05, "without levels nothing is known to be foreign"


@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
def test_where_a_streak_carries_the_surroundings_to_the_ring_nothing_is_used(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    imaging_of: ImagingOf,
    turn_deg: float,
) -> None:
    """Along the streak, the plate never reaches its full level, because it ends within the blur."""
    streak = (5.6, 2.0)
    pose = place_plate((205.4, 190.7), 13.0, turn_deg=turn_deg)
    image = image_plate(
        camera,
        PrintedPlate(target, regular_polygon(4, 0.58), WHITE, BLACK),
        pose,
        Optics(1.1, streak),
    )
    irradiance = np.full((camera.height, camera.width), 0.2)
    image.paste(irradiance)
    grey = Sensor().expose(irradiance, 1.0, np.random.default_rng(5))
    problem = imaging_of(grey, camera, target, pose)
    blur = Blur(1.1**2 + 1.0 / 12.0, 1.1**2 + 1.0 / 12.0, 0.0, *streak)
    sample, everything = (select_pixels(problem, pose, blur, light) for light in (LIGHT, None))
    mixed, unfiltered = (
        (WHITE - 0.2) * (1.0 - opacity_of(each, image)) for each in (sample, everything)
    )
    assert unfiltered.max() > 0.15
    assert mixed.max() < 0.05
    assert np.mean(mixed > 0.02) < 0.03
    assert len(sample.levels) > 0.6 * len(everything.levels)


def test_surroundings_as_bright_as_the_plate_are_not_masked(
    target: Target, camera: Camera, place_plate: PlacePlate, imaging_of: ImagingOf
) -> None:
    pose = place_plate((205.4, 190.7), 20.0, turn_deg=31.0)
    grey, _ = photograph(camera, target, pose, NARROW, WHITE)
    problem = imaging_of(grey, camera, target, pose)
    found, everything = (select_pixels(problem, pose, BLUR, light) for light in (LIGHT, None))
    np.testing.assert_array_equal(found.index, everything.index)


@pytest.mark.parametrize(("near_sigmas", "within_sigmas"), [(NEAR_SIGMAS, 1.5), (3.3, 3.0)])
def test_all_pixels_near_edges_are_used(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    imaging_of: ImagingOf,
    near_sigmas: float,
    within_sigmas: float,
) -> None:
    """On a wide plate: all pixels so near to a circle, and levels beyond the ring."""
    pose = place_plate((205.4, 190.7), 40.0, tilt_deg=20.0, turn_deg=31.0)
    grey, _ = photograph(camera, target, pose, WIDE, 0.2)
    problem = imaging_of(grey, camera, target, pose)
    sample = select_pixels(problem, pose, BLUR, LIGHT, near_sigmas=near_sigmas)
    window = problem.window
    everywhere = plate_points(pose, window.rays)
    near = np.zeros(everywhere.shape[1], bool)
    px_per_m = problem.outer_radius_px / problem.outer_radius_m
    for centre, radius in zip(problem.circles.centres_m.T, problem.circles.radii_m, strict=True):
        off_edge = np.hypot(*(everywhere - centre[:, None])) - radius
        near |= np.abs(off_edge) * px_per_m < within_sigmas * BLUR.largest_sd_px
    assert set(np.flatnonzero(near)) <= set(sample.index)
    assert 1.5 < beyond_px(sample, pose).max() < 4.0
    np.testing.assert_array_equal(sample.levels, window.levels[sample.index])


def test_a_target_outside_its_window_has_lost_its_edges(
    target: Target, camera: Camera, place_plate: PlacePlate, imaging_of: ImagingOf
) -> None:
    pose, elsewhere = place_plate((205.4, 190.7), 20.0), place_plate((300.0, 250.0), 20.0)
    grey, _ = photograph(camera, target, pose, NARROW, 0.05)
    problem = imaging_of(grey, camera, target, pose)
    with pytest.raises(Rejection) as caught:
        select_pixels(problem, elsewhere, BLUR, LIGHT)
    assert caught.value.reason is Reason.EDGES_LOST


def test_sharpening_depends_on_the_far_tails_of_edges(
    target: Target, camera: Camera, place_plate: PlacePlate, imaging_of: ImagingOf
) -> None:
    """These pixels are not adjusted themselves. Compared with the window sharpened by OpenCV."""
    pose = place_plate((205.4, 190.7), 12.0, tilt_deg=20.0, turn_deg=31.0)
    grey, _ = photograph(camera, target, pose, WIDE, WHITE)
    problem = replace(imaging_of(grey, camera, target, pose), sharpening_px=1.2)
    light = replace(LIGHT, tone_1=0.3, tone_2=-0.1, sharpening=0.6)
    sample = select_pixels(problem, pose, BLUR, light)
    seen = predict(sample, Parameters.of(pose, BLUR, light)).levels

    window = problem.window
    points_m, px_m = plate_points(pose, window.rays), 0.45 / 12.0
    incidence = find_edge_incidence(points_m, 1.07 * px_m, problem.circles, BLUR, ISOTROPIC)
    share = white_share_without_derivatives(pose.matrix, window.rays, BLUR.vector, incidence).value
    plain = PhotometricModel(np.zeros((2, len(share))), problem.tone, None).levels(share, light)
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / 1.2) ** 2)
    kernel /= kernel.sum()
    smooth = cv2.sepFilter2D(plain.reshape(window.height, -1), cv2.CV_64F, kernel, kernel).ravel()
    expected = (plain + 0.6 * (plain - smooth))[sample.index]
    assert len(sample.index) < 0.8 * len(share)
    np.testing.assert_allclose(seen, expected, rtol=0.0, atol=2e-5)
