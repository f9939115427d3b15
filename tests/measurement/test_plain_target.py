"""Plain targets in one rendered frame: found at the predicted place, and refused elsewhere."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from kgcp.errors import Reason
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.adjustment.covariance import propagate
from kgcp.measurement.image_model.srgb import srgb_encoded
from kgcp.measurement.plain_pose import (
    CircleMoments,
    circles_about,
    fit_circles,
    pose_towards,
)
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plain_target import measure_plain
from kgcp.measurement.plate_prior import NormalPrior, SceneRotation
from kgcp.measurement.records import Measurement, Miss, Outcome
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.plate import PlainPlate, image_plate
from kgcp.targets.plain import PlainPolarity, PlainTarget, Shape
from tests.measurement.jpeg import compressed

CAMERA = Camera(200, 160, 900.0, 900.0, 101.3, 78.4, k1=-0.08, response=Response.LINEAR)
NORMAL = np.array([math.sin(0.4), 0.0, math.cos(0.4)])
DISC = PlainTarget("W", (0.4,), PlainPolarity.BRIGHT, (0.0, 0.0, 0.0), border_m=0.4)
RING = replace(DISC, diameters_m=(0.8, 0.4), polarity=PlainPolarity.DARK)
RADIUS_PX = 10.0


def pose_at(x_px: float, y_px: float, target: PlainTarget = DISC) -> Pose:
    """The pose of a target seen at a pixel, with its radius in the image as given."""
    ray = np.append(CAMERA.undistort(np.array([[x_px, y_px]]))[0], 1.0)
    distance_m = CAMERA.fx * target.radii_m[0] / RADIUS_PX
    return pose_towards(ray / np.linalg.norm(ray) * distance_m, NORMAL)


def frame_with(*placed: tuple[PlainTarget, Pose], seed: int = 1) -> GreyArray:
    light: FloatArray = np.full((CAMERA.height, CAMERA.width), 0.3)
    for target, pose in placed:
        image_plate(CAMERA, PlainPlate(target), pose, Optics(0.6)).paste(light)
    return Sensor().expose(light, 1.0, np.random.default_rng(seed))


def prediction_of(
    pose: Pose, off_px: tuple[float, float] = (0.0, 0.0), size: float = 1.0
) -> PlainPrediction:
    """A prediction with a deviation of 3 px and an error of this size."""
    centre_px = CAMERA.project(pose.translation_m[None])[0] + off_px
    return PlainPrediction(
        centre_px,
        9.0 * np.eye(2),
        pose.translation_m * size,
        0.003,
        NormalPrior(NORMAL, 3.0),
        RADIUS_PX / size,
        "a test",
    )


def looked(
    grey: GreyArray, prediction: PlainPrediction | None, target: PlainTarget = DISC
) -> Outcome:
    return measure_plain(grey, CAMERA, target, prediction)


@pytest.mark.parametrize("target", [DISC, RING], ids=["disc", "ring"])
def test_the_centre_is_right_within_its_deviations(target: PlainTarget) -> None:
    pose = pose_at(90.4, 71.7, target)
    outcome = looked(frame_with((target, pose)), prediction_of(pose, (5.0, -4.0)), target)
    assert isinstance(outcome, Measurement)
    assert outcome.uncertainty is not None
    off_px = outcome.centre_px - CAMERA.project(pose.translation_m[None])[0]
    sd_px = np.sqrt(np.diag(outcome.uncertainty.centre_cov_px2))
    assert np.all(np.abs(off_px) < 4.0 * sd_px)
    assert np.all((sd_px > 0.001) & (sd_px < 0.02))
    off_m = outcome.distance_m - pose.distance_m
    assert abs(off_m) < 4.0 * outcome.uncertainty.sd_distance_m
    assert outcome.uncertainty.sd_distance_m < 0.003 * pose.distance_m
    assert outcome.uncertainty.sd_heading_deg > 90.0
    assert math.isnan(outcome.score)


@pytest.mark.parametrize("target", [DISC, RING], ids=["disc", "ring"])
def test_without_a_border_deviations_cover_the_texture_of_the_ground(target: PlainTarget) -> None:
    """On the same grass, a wrongly stated border would make the ground count as even."""
    bare, rng = replace(target, border_m=None), np.random.default_rng(4)
    grass = cv2.GaussianBlur(rng.standard_normal((CAMERA.height, CAMERA.width)), (0, 0), 1.0)
    off_px, sd_px = [], []
    for x_px in (70.4, 80.1, 90.7, 101.2, 110.9, 120.3):
        pose = pose_at(x_px, 71.7, bare)
        light = np.asarray(0.3 + 0.15 * grass, dtype=np.float64)
        image_plate(CAMERA, PlainPlate(bare), pose, Optics(0.6)).paste(light)
        outcome = looked(Sensor().expose(light, 1.0, rng), prediction_of(pose), bare)
        assert isinstance(outcome, Measurement)
        assert outcome.uncertainty is not None
        off_px.append(outcome.centre_px - CAMERA.project(pose.translation_m[None])[0])
        sd_px.append(np.sqrt(np.diag(outcome.uncertainty.centre_cov_px2)))
    assert 0.005 < float(np.mean(sd_px)) < 0.03
    assert 0.6 < float(np.sqrt(np.mean(np.square(np.array(off_px) / sd_px)))) < 1.4


def shaded_frame(target: PlainTarget, pose: Pose, aside_px: float, turn_rad: float) -> GreyArray:
    """A frame in which a shadow begins so far from the target's centre, and takes 55 %."""
    light: FloatArray = np.full((CAMERA.height, CAMERA.width), 0.3)
    image_plate(CAMERA, PlainPlate(target), pose, Optics(0.6)).paste(light)
    x, y = CAMERA.project(pose.translation_m[None])[0]
    rows, columns = np.indices(light.shape)
    across_px = (columns - x) * math.cos(turn_rad) + (rows - y) * math.sin(turn_rad) - aside_px
    light *= 0.45 + 0.55 * np.clip(0.5 + 0.25 * across_px, 0.0, 1.0)
    return Sensor().expose(light, 1.0, np.random.default_rng(1))


@pytest.mark.parametrize(("aside_px", "turn_rad"), [(-1.0, 2.0), (0.0, 0.3), (1.0, 4.0)])
def test_the_edge_of_a_shadow_on_a_small_disc_is_in_its_deviations(
    aside_px: float, turn_rad: float
) -> None:
    """With linear light, such centres were off by 0.3 px, 5 to 9 standard deviations."""
    radius_px = 3.5
    pose = pose_at(90.4, 71.7)
    pose = pose_towards(pose.translation_m * RADIUS_PX / radius_px, NORMAL)
    grey = shaded_frame(DISC, pose, aside_px, turn_rad)
    outcome = looked(grey, replace(prediction_of(pose), radius_px=radius_px))
    assert isinstance(outcome, Measurement)
    assert outcome.uncertainty is not None
    error_px = outcome.centre_px - CAMERA.project(pose.translation_m[None])[0]
    assert np.linalg.norm(error_px) < 0.1
    z = np.linalg.solve(np.linalg.cholesky(outcome.uncertainty.centre_cov_px2), error_px)
    assert np.linalg.norm(z) < 3.0
    off_m = outcome.distance_m - pose.distance_m
    assert abs(off_m) < 3.0 * outcome.uncertainty.sd_distance_m


def test_a_disturbed_shape_enlarges_the_deviations_of_the_centre() -> None:
    """A hard shadow displaces the centre by 0.6 px, 9.5 deviations by the grey values alone."""
    radius_px = 4.0
    pose = pose_towards(pose_at(90.4, 71.7).translation_m * RADIUS_PX / radius_px, NORMAL)
    light: FloatArray = np.full((CAMERA.height, CAMERA.width), 0.35)
    image_plate(CAMERA, PlainPlate(DISC), pose, Optics(0.7)).paste(light)
    x, _ = CAMERA.project(pose.translation_m[None])[0]
    light *= 1.0 - 0.65 * ndtr((np.arange(CAMERA.width) - x - 1.0) / 0.9)
    grey = Sensor().expose(light, 1.0, np.random.default_rng(1))
    outcome = looked(grey, replace(prediction_of(pose), radius_px=radius_px))
    assert isinstance(outcome, Measurement)
    assert outcome.uncertainty is not None
    error_px = outcome.centre_px - CAMERA.project(pose.translation_m[None])[0]
    z = np.linalg.solve(np.linalg.cholesky(outcome.uncertainty.centre_cov_px2), error_px)
    assert np.linalg.norm(z) < 3.0


def test_a_far_ring_is_measured_as_a_whole() -> None:
    target = replace(RING, border_m=0.9)
    pose = pose_towards(2.5 * pose_at(90.4, 71.7, RING).translation_m, NORMAL)
    expected = replace(prediction_of(pose, (5.0, -4.0)), radius_px=4.0)
    outcome = looked(frame_with((target, pose)), expected, target)
    assert isinstance(outcome, Measurement)
    assert outcome.uncertainty is not None
    off_px = outcome.centre_px - CAMERA.project(pose.translation_m[None])[0]
    sd_px = np.sqrt(np.diag(outcome.uncertainty.centre_cov_px2))
    assert np.all(np.abs(off_px) < 4.0 * sd_px)
    assert np.all((sd_px > 0.002) & (sd_px < 0.02))
    disc, other = (replace(target, diameters_m=diameters) for diameters in ((0.8,), (0.8, 0.64)))
    for shown, wanted in ((disc, target), (target, disc), (other, target), (target, other)):
        outcome = looked(frame_with((shown, pose)), expected, wanted)
        assert isinstance(outcome, Miss), (shown, wanted)
    of_disc, of_ring = (frame_with((each, pose)).astype(np.float64) for each in (disc, target))
    for ratio in (0.7, 0.9):  # how bright its hole is
        grey = np.rint((1.0 - ratio) * of_disc + ratio * of_ring).astype(np.uint8)
        outcome = looked(grey, expected, target)
        assert isinstance(outcome, Measurement) is (ratio == 0.9)
        if isinstance(outcome, Miss):
            assert re.search(r"of (6|7)\d% of the outer one", outcome.detail)
    assert isinstance(outcome, Measurement)
    assert outcome.uncertainty is not None
    off_m = outcome.distance_m - pose.distance_m
    assert abs(off_m) < 2.0 * outcome.uncertainty.sd_distance_m < 0.01 * pose.distance_m


@pytest.mark.parametrize(("radius_px", "least", "most"), [(5.0, 0.0005, 0.006), (3.0, 0.015, 0.06)])
def test_an_unknown_tone_curve_does_not_change_the_size_of_a_far_ring(
    radius_px: float, least: float, most: float
) -> None:
    """Its two edges determine the spread of the ink, unless they are only 1.5 px apart."""
    target = replace(RING, border_m=0.9)
    near = pose_at(90.4, 71.7, RING).translation_m
    pose = pose_towards(RADIUS_PX / radius_px * near, NORMAL)
    light = frame_with((target, pose)).astype(np.float64) / 255.0
    grey = np.rint(255.0 * srgb_encoded(light.ravel()).reshape(light.shape)).astype(np.uint8)
    expected = replace(prediction_of(pose, (5.0, -4.0)), radius_px=radius_px)
    camera = replace(CAMERA, response=Response.UNKNOWN)
    outcome = measure_plain(grey, camera, target, expected)
    assert isinstance(outcome, Measurement)
    assert outcome.uncertainty is not None
    sd = outcome.uncertainty.sd_distance_m / pose.distance_m
    assert least < sd < most
    assert abs(outcome.distance_m / pose.distance_m - 1.0) < 3.0 * sd


@pytest.mark.parametrize("polarity", PlainPolarity)
def test_deviations_of_small_discs_cover_curves_that_one_disc_does_not_tell(
    polarity: PlainPolarity,
) -> None:
    """Film's curve, sharpening and JPEG: RMS errors were 3.9 (bright) and 1.9 deviations (dark)."""
    target = replace(DISC, polarity=polarity, border_m=1.2)
    pose = pose_towards(RADIUS_PX / 3.0 * pose_at(90.4, 71.7).translation_m, NORMAL)
    expected = replace(prediction_of(pose, (2.0, -2.0)), radius_px=3.0)
    camera = replace(CAMERA, response=Response.UNKNOWN)
    sensor, errors, sds = Sensor(tone=ToneCurve.FILM, sharpening=0.6), [], []
    light: FloatArray = np.full((CAMERA.height, CAMERA.width), 0.3)
    image_plate(CAMERA, PlainPlate(target, 0.7, 0.06), pose, Optics(0.6)).paste(light)
    for seed in range(4):
        grey = compressed(sensor.expose(light, 1.0, np.random.default_rng(seed)), 92)
        outcome = measure_plain(grey, camera, target, expected)
        assert isinstance(outcome, Measurement)
        assert outcome.uncertainty is not None
        errors.append(outcome.distance_m / pose.distance_m - 1.0)
        sds.append(outcome.uncertainty.sd_distance_m / pose.distance_m)
    assert np.linalg.norm(errors) < 2.5 * np.linalg.norm(sds)


@pytest.mark.parametrize(
    ("off_px", "size"), [((25.0, 0.0), 1.0), ((0.0, 0.0), 1.2), ((0.0, 0.0), 0.8)]
)
def test_a_disc_of_another_place_or_size_is_refused(
    off_px: tuple[float, float], size: float
) -> None:
    pose = pose_at(90.4, 71.7)
    outcome = looked(frame_with((DISC, pose)), prediction_of(pose, off_px, size))
    assert isinstance(outcome, Miss)
    assert outcome.reason in {Reason.UNLIKE_PREDICTION, Reason.NO_CANDIDATE}


def test_another_polarity_or_shape_is_refused() -> None:
    pose = pose_at(90.4, 71.7)
    grey = frame_with((DISC, pose))
    for other in (
        replace(DISC, polarity=PlainPolarity.DARK),
        replace(DISC, diameters_m=(0.4, 0.2)),
    ):
        outcome = looked(grey, prediction_of(pose), other)
        assert isinstance(outcome, Miss), other
    upright = replace(prediction_of(pose), normal=NormalPrior(np.array([0.0, 0.0, 1.0]), 2.0))
    outcome = looked(frame_with((DISC, pose_tilted(pose))), upright)
    assert isinstance(outcome, Miss)
    assert outcome.reason is Reason.UNLIKE_PREDICTION


def pose_tilted(pose: Pose) -> Pose:
    return pose_towards(pose.translation_m, np.array([math.sin(0.9), 0.0, math.cos(0.9)]))


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 40.0, 55.0])
@pytest.mark.parametrize("target", [DISC, RING], ids=["disc", "ring"])
def test_a_free_normal_allows_two_centres(target: PlainTarget, tilt_deg: float) -> None:
    """The reported centre is their mean, whose deviation covers half of their difference.

    Circles that are each measured by themselves tell which of the two it is.
    """
    target = replace(target, normal_enu=None)
    along = pose_at(90.4, 71.7, target).translation_m
    axis = np.cross(along, [0.3, 0.8, 0.1])
    turn = rotation_about(math.radians(tilt_deg) * axis / np.linalg.norm(axis))
    pose = pose_towards(along, turn @ along / np.linalg.norm(along))
    prediction = replace(prediction_of(pose, (5.0, -4.0)), normal=None)
    outcome = looked(frame_with((target, pose)), prediction, target)
    assert isinstance(outcome, Measurement)
    assert outcome.uncertainty is not None
    off_px = outcome.centre_px - CAMERA.project(along[None])[0]
    cov_px2 = outcome.uncertainty.centre_cov_px2
    assert off_px @ np.linalg.solve(cov_px2, off_px) < 12.0
    tilt_rad = math.radians(tilt_deg)
    half_px = RADIUS_PX**2 / CAMERA.fx * 0.5 * math.sin(2.0 * tilt_rad)
    is_separable = target.shape is Shape.RING and tilt_deg == 20.0
    least_px, most_px = (0.0, 0.005) if is_separable else (half_px, 1.2 * half_px + 0.015)
    assert least_px**2 < np.trace(cov_px2) < most_px**2
    assert outcome.image is not None
    centroid, *_ = circle_images(CAMERA, circles_about(pose, np.array(target.radii_m))).moments
    error = outcome.image.moments - centroid
    assert error @ np.linalg.solve(outcome.image.cov, error) < 20.5  # 99.9 % of five
    off_m = outcome.distance_m - pose.distance_m
    assert abs(off_m) < 4.0 * outcome.uncertainty.sd_distance_m < 0.02 * pose.distance_m
    if tilt_deg:
        assert outcome.alternative is not None
        assert (outcome.alternative.ambiguity > 20.0) is is_separable
        assert (outcome.alternative.ambiguity < 0.5) is not is_separable
        normals = (outcome.pose.normal, outcome.alternative.pose.normal)
        assert max(float(each @ pose.normal) for each in normals) > math.cos(math.radians(1.5))


def test_with_a_free_normal_size_and_least_width_are_tested() -> None:
    target = replace(DISC, normal_enu=None)
    for size, tilt_rad in ((1.2, 0.3), (0.8, 0.3), (1.0, 1.2)):
        pose = pose_towards(
            pose_at(90.4, 71.7).translation_m,
            np.array([math.sin(tilt_rad), 0.0, math.cos(tilt_rad)]),
        )
        prediction = replace(prediction_of(pose, size=size), normal=None)
        assert isinstance(looked(frame_with((target, pose)), prediction, target), Miss)


@pytest.mark.parametrize("uneven_px", [0.0, 0.35])
def test_a_stone_of_the_right_size_is_refused(uneven_px: float) -> None:
    radius_px = 4.5
    sight_m = RADIUS_PX / radius_px * pose_at(90.0, 70.0).translation_m
    pose = pose_towards(sight_m, np.array([0.0, 0.0, 1.0]))
    rows, columns = np.indices((CAMERA.height, CAMERA.width))
    around = np.arctan2(rows - 70.0, columns - 90.0)
    edge_px = radius_px + uneven_px * np.cos(3.0 * around + 0.4)
    inside = np.clip(edge_px - np.hypot(rows - 70.0, columns - 90.0) + 0.5, 0.0, 1.0)
    light = cv2.GaussianBlur(0.2 + 0.5 * inside, (0, 0), 0.6)
    grey = Sensor().expose(np.asarray(light), 1.0, np.random.default_rng(1))
    normal = NormalPrior(np.array([0.0, 0.0, 1.0]), 3.0)
    level = replace(prediction_of(pose), normal=normal, radius_px=radius_px)
    outcome = looked(grey, level, replace(DISC, border_m=None))
    assert isinstance(outcome, Miss if uneven_px else Measurement)
    if isinstance(outcome, Miss):
        assert outcome.reason is Reason.POOR_FIT
        assert "uneven edge" in outcome.detail


def test_two_equal_targets_are_ambiguous() -> None:
    small = replace(DISC, border_m=None)
    pose = pose_at(80.0, 70.0)
    grey = frame_with((small, pose), (small, pose_at(110.0, 70.0)))
    outcome = looked(grey, replace(prediction_of(pose, (15.0, 0.0)), cov_px2=36.0 * np.eye(2)))
    assert isinstance(outcome, Miss)
    assert outcome.reason is Reason.AMBIGUOUS_PLACE
    outcome = looked(grey, prediction_of(pose))
    assert isinstance(outcome, Measurement)


def test_a_target_is_searched_only_where_it_is_predicted() -> None:
    pose = pose_at(90.4, 71.7)
    grey = frame_with((DISC, pose))
    sure = prediction_of(pose)
    for prediction, reason in (
        (None, Reason.NO_PREDICTION),
        (replace(sure, cov_px2=1e4 * np.eye(2)), Reason.NO_PREDICTION),
        (prediction_of(pose, (300.0, 0.0)), Reason.OUT_OF_VIEW),
        (replace(sure, normal=NormalPrior(-NORMAL, 3.0)), Reason.OUT_OF_VIEW),
        (replace(sure, radius_px=1.0, cov_px2=np.eye(2)), Reason.TOO_SMALL),
    ):
        outcome = looked(grey, prediction)
        assert isinstance(outcome, Miss)
        assert outcome.reason is reason


@pytest.mark.parametrize(
    ("target", "least_px"),
    [
        (DISC, 2.5),
        (replace(DISC, border_m=None), 3.0),
        (replace(DISC, normal_enu=None), 4.0),
    ],
)
def test_the_smallest_disc_needs_even_ground_and_a_normal(
    target: PlainTarget, least_px: float
) -> None:
    pose = pose_at(90.4, 71.7)
    grey = frame_with((target, pose))
    for radius_px, is_too_small in ((least_px - 0.01, True), (least_px + 0.01, False)):
        outcome = looked(grey, replace(prediction_of(pose), radius_px=radius_px), target)
        is_miss = isinstance(outcome, Miss) and outcome.reason is Reason.TOO_SMALL
        assert is_miss is is_too_small
        if isinstance(outcome, Miss):
            assert f"below {least_px:g} px" in outcome.detail


@pytest.mark.parametrize("tilt_deg", [0.0, 50.0])
@pytest.mark.parametrize("share", [0.3, 0.42, 0.58, 0.9])
def test_a_smooth_blob_is_refused(share: float, tilt_deg: float) -> None:
    """The limit of the spread is half the smaller semi-axis, which a tilt shortens."""
    radius_px, tilt_rad = 4.5, math.radians(tilt_deg)
    along = RADIUS_PX / radius_px * pose_at(90.0, 70.0).translation_m
    toward = along / np.linalg.norm(along)
    across = np.cross(toward, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    pose = pose_towards(along, math.cos(tilt_rad) * toward + math.sin(tilt_rad) * across)
    target = replace(DISC, border_m=0.8)
    light: FloatArray = np.full((CAMERA.height, CAMERA.width), 0.3)
    blur_px = share * radius_px * math.cos(tilt_rad)
    image_plate(CAMERA, PlainPlate(target), pose, Optics(blur_px)).paste(light)
    grey = Sensor().expose(light, 1.0, np.random.default_rng(1))
    normal = NormalPrior(pose.normal, 3.0)
    prediction = replace(prediction_of(pose), normal=normal, radius_px=radius_px)
    outcome = looked(grey, prediction, target)
    assert isinstance(outcome, Measurement) is (share < 0.5)
    if isinstance(outcome, Miss) and share < 0.6:  # far beyond the limit it has no edge at all
        assert outcome.reason is Reason.TOO_BLURRED


def test_the_fit_recovers_the_projected_circles() -> None:
    pose = pose_at(150.0, 30.0, RING)
    radii = np.array(RING.radii_m)
    moments = circle_images(CAMERA, circles_about(pose, radii)).moments
    images = CircleMoments(radii, moments, np.array([1e-4 * np.eye(5)] * 2))
    begin = np.array([math.sin(0.3), 0.0, math.cos(0.3)])
    start = pose_towards(1.03 * pose.translation_m + 0.01, begin)
    fit = fit_circles(CAMERA, images, start, NormalPrior(NORMAL, 3.0))
    assert np.allclose(fit.pose.translation_m, pose.translation_m, atol=1e-8)
    assert np.allclose(fit.pose.normal, NORMAL, atol=1e-8)
    assert fit.chi2 < 1e-10


@pytest.mark.parametrize("sd_deg", [0.3, 3.0])
def test_unknown_normal_widens_the_centre(sd_deg: float) -> None:
    """By (R²/f) σ, the displacement of the centre relative to the ellipse, seen from the front."""
    along = pose_at(100.0, 80.0).translation_m
    normal = along / np.linalg.norm(along)
    pose, radii = pose_towards(along, normal), np.array(DISC.radii_m)
    moments = circle_images(CAMERA, circles_about(pose, radii)).moments
    # the place of the outline is known, its shape hardly
    images = CircleMoments(radii, moments, np.array([np.diag([1e-12, 1e-12, 9.0, 9.0, 9.0])]))
    fit = fit_circles(CAMERA, images, pose, NormalPrior(normal, sd_deg))
    sd_px = propagate(CAMERA, fit.pose, fit.pose_cov).centre_cov_px2[0, 0] ** 0.5
    assert sd_px == pytest.approx(RADIUS_PX**2 / CAMERA.fx * math.radians(sd_deg), rel=0.02)


ROLLING = replace(CAMERA, readout_s=0.03)


def read_row_by_row(pose: Pose, radius_m: float, rate_rad_s: FloatArray) -> FloatArray:
    """Return the moments (5,) of a circle's image while the scene turns about the camera."""
    angles = np.linspace(0.0, 2.0 * math.pi, 400, endpoint=False)
    circle = pose.transform(radius_m * np.stack((np.cos(angles), np.sin(angles)), axis=1))
    centre_px = ROLLING.project(pose.translation_m[None])[0]
    outline = ROLLING.project(circle)
    for _ in range(4):
        delays_s = ROLLING.readout_s * (outline[:, 1] - centre_px[1]) / (ROLLING.height - 1)
        turned = [
            rotation_about(delay * rate_rad_s) @ point
            for delay, point in zip(delays_s, circle, strict=True)
        ]
        outline = ROLLING.project(np.array(turned))
    off = cv2.moments((outline - centre_px).astype(np.float32)[:, None])
    second = np.array((off["mu20"], off["mu11"], off["mu02"])) / off["m00"]
    first = np.array((off["m10"], off["m01"])) / off["m00"]
    return np.concatenate((centre_px + first, second))


@pytest.mark.parametrize("target", [DISC, RING], ids=["disc", "ring"])
def test_deviations_cover_unknown_motion_under_a_rolling_shutter(target: PlainTarget) -> None:
    """Forty images of R 20 px, twice as near as in other tests."""
    rng, radii = np.random.default_rng(6), np.array(target.radii_m)
    cov = 1e-5 * np.diag([1.0, 1.0, 100.0, 100.0, 100.0])
    off: dict[Camera, list[float]] = {ROLLING: [], CAMERA: []}
    for _ in range(40):
        x_px, y_px = rng.uniform((70.0, 60.0), (120.0, 90.0)).tolist()
        pose = pose_towards(0.5 * pose_at(x_px, y_px, target).translation_m, NORMAL)
        rate_rad_s = rng.normal(0.0, math.radians(ROLLING.motion_sd_deg_s), 3)
        seen = np.array([read_row_by_row(pose, radius, rate_rad_s) for radius in radii.tolist()])
        seen += rng.multivariate_normal(np.zeros(5), cov, len(radii))
        images = CircleMoments(radii, seen, np.array([cov] * len(radii)))
        turn = rotation_about(rng.normal(0.0, math.radians(3.0), 3))
        prior = NormalPrior(turn @ NORMAL, 3.0)
        for camera, errors in off.items():
            fit = fit_circles(camera, images, pose, prior)
            sd_m = propagate(camera, fit.pose, fit.pose_cov).sd_distance_m
            errors.append((fit.pose.distance_m - pose.distance_m) / sd_m)
    z, z_still = (float(np.sqrt(np.mean(np.square(errors)))) for errors in off.values())
    assert 0.75 < z < 1.3
    assert z_still > 10.0


def test_known_motion_is_corrected() -> None:
    rng, radii = np.random.default_rng(8), np.array(RING.radii_m)
    cov = 1e-5 * np.diag([1.0, 1.0, 100.0, 100.0, 100.0])
    percent, z = [], []
    for _ in range(40):
        pose = pose_towards(0.5 * pose_at(95.2, 74.1, RING).translation_m, NORMAL)
        x, y, about_z = rng.normal(0.0, math.radians(5.0), 3).tolist()
        sd_rad_s = math.radians(0.1)
        off = rng.normal(0.0, sd_rad_s, 3)
        rate_rad_s = np.array((x, y, about_z)) + off
        seen = np.array([read_row_by_row(pose, radius, rate_rad_s) for radius in radii.tolist()])
        seen += rng.multivariate_normal(np.zeros(5), cov, len(radii))
        images = CircleMoments(radii, seen, np.array([cov] * len(radii)))
        turn = rotation_about(rng.normal(0.0, math.radians(0.5), 3))
        rotation = SceneRotation((x, y, about_z), sd_rad_s)
        fit = fit_circles(ROLLING, images, pose, NormalPrior(turn @ NORMAL, 0.5), rotation)
        off_m = fit.pose.distance_m - pose.distance_m
        percent.append(100.0 * off_m / pose.distance_m)
        z.append(off_m / propagate(ROLLING, fit.pose, fit.pose_cov).sd_distance_m)
    assert float(np.sqrt(np.mean(np.square(percent)))) < 0.1
    assert 0.7 < float(np.sqrt(np.mean(np.square(z)))) < 1.4


def test_a_rolling_shutter_enlarges_the_reported_deviations() -> None:
    pose = pose_at(90.4, 71.7)
    grey, prediction = frame_with((DISC, pose)), prediction_of(pose)
    still = measure_plain(grey, CAMERA, DISC, prediction)
    rolling = measure_plain(grey, ROLLING, DISC, prediction)
    assert isinstance(still, Measurement)
    assert isinstance(rolling, Measurement)
    assert still.uncertainty is not None
    assert rolling.uncertainty is not None
    assert rolling.uncertainty.sd_distance_m > 5.0 * still.uncertainty.sd_distance_m
    assert still.image is not None
    assert rolling.image is not None
    assert np.all(rolling.image.moments == still.image.moments)
    widened = np.diag(rolling.image.cov) / np.diag(still.image.cov)
    assert np.all(widened[:2] == 1.0)
    assert widened[4] > 25.0
