from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.errors import SettingError
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import Measurement
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.outlook import (
    FOUND,
    GAIN,
    LARGEST_SHARE,
    SURE_PX,
    TILT_DEG,
    Conditions,
    Outlook,
    chance_to_find,
    least_plain_px,
    look_ahead,
    usual_heights,
)
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster
from kgcp.targets.layout import Target
from kgcp.targets.plain import PlainPolarity, PlainTarget

CAMERA = Camera(130, 120, 1000.0, 1002.0, 66.3, 58.2, k1=-0.05, response=Response.LINEAR)
TARGET = TARGET_PLATE.target
CONDITIONS = Conditions(blur_px=0.8, exposure_s=0.002)
_FINE = 3
HEIGHTS_M = (20.0, 37.0)  # R of 22 and 12 px


@pytest.fixture(scope="module")
def outlooks() -> tuple[Outlook, ...]:
    calibration = CalibrationCovariance.of(("fx", "fy"), np.full((2, 2), 0.5**2))
    return look_ahead(CAMERA, calibration, TARGET, (*HEIGHTS_M, 3.0, 1.0, 100.0), CONDITIONS)


def measured(height_m: float, rng: np.random.Generator) -> tuple[Measurement, Pose]:
    """Photograph the target as the plan supposes it, and measure it."""
    way, turn, motion = rng.uniform(0.0, 2.0 * math.pi, 3)
    tilt = math.radians(TILT_DEG) * np.array([math.cos(way), math.sin(way), 0.0])
    rotation = Rotation.from_rotvec(tilt) * Rotation.from_euler("z", turn)
    x, y = rng.uniform(-2.0, 2.0, 2) / CAMERA.fx
    pose = Pose(rotation.as_matrix(), height_m * np.array([x, y, 1.0]) / math.hypot(x, y, 1.0))
    streak = CONDITIONS.blur_px * math.cos(motion), CONDITIONS.blur_px * math.sin(motion)
    patch = PlaneRaster.of(CAMERA, pose, PixelWindow(0, 0, CAMERA.width, CAMERA.height), _FINE)
    light = np.full_like(patch.x_m, TARGET_PLATE.white)
    for shape, radiance in TARGET_PLATE.print_layers():
        patch.paint(light, shape, radiance)
    spread = Optics(CONDITIONS.psf_px, streak).spread(light, _FINE)
    grey = Sensor().expose(spread, GAIN, rng)
    (outcome,) = measure_frame(grey, CAMERA, (TARGET,), DetectSettings())
    assert isinstance(outcome, Measurement)
    return outcome, pose


@pytest.mark.parametrize("index", [0, 1])
def test_measurements_scatter_as_planned(index: int, outlooks: tuple[Outlook, ...]) -> None:
    outlook = outlooks[index]
    assert outlook.sd_distance_m is not None
    assert outlook.sd_centre_px is not None
    rng = np.random.default_rng(11)
    pairs = [measured(outlook.height_m, rng) for _ in range(18)]
    errors_m = [seen.pose.distance_m - pose.distance_m for seen, pose in pairs]
    off_px = [seen.centre_px - CAMERA.project(pose.translation_m) for seen, pose in pairs]
    # 18 errors give their deviation to 17 %, 36 to 12 %.
    assert 0.55 < np.std(errors_m, ddof=1) / outlook.sd_distance_m < 1.5
    assert 0.7 < np.sqrt(np.mean(np.square(off_px))) / outlook.sd_centre_px < 1.4
    reported_m = [seen.uncertainty.sd_distance_m for seen, _ in pairs if seen.uncertainty]
    assert 0.7 < np.median(reported_m) / outlook.sd_distance_m < 1.6
    assert outlook.radius_px == pytest.approx(
        np.mean([seen.appearance.radius_px for seen, _ in pairs]), rel=0.01
    )


def test_accuracy_follows_its_laws(outlooks: tuple[Outlook, ...]) -> None:
    near, far = outlooks[:2]
    assert near.sd_distance_m is not None
    assert far.sd_distance_m is not None
    slope = math.log(far.sd_distance_m / near.sd_distance_m) / math.log(37.0 / 20.0)
    assert 2.4 < slope < 3.0  # 5/2 by the number of edge pixels, more where rings are small


def test_common_errors_are_those_of_the_calibration(outlooks: tuple[Outlook, ...]) -> None:
    assert outlooks[0].sd_common_distance_m == pytest.approx(20.0 * 0.5 / 1001.0, rel=0.01)
    printed = Target(replace(TARGET.ring, sd_outer_diameter_m=0.0009))
    (outlook,) = look_ahead(CAMERA, None, printed, [15.0], CONDITIONS)
    assert outlook.sd_common_distance_m == pytest.approx(0.015)


def test_speed_and_diameter_are_simple_geometry(outlooks: tuple[Outlook, ...]) -> None:
    far = outlooks[1]
    # 0.8 px are 0.8 · 37 m / 1001 on the ground, in 2 ms.
    assert far.largest_speed_mps == pytest.approx(0.8 * 37.0 / 1001.0 / 0.002)
    assert far.smallest_diameter_m == pytest.approx(2.0 * SURE_PX * 37.0 / 1001.0)
    wanted = replace(CONDITIONS, accuracy_percent=0.01)
    (finer,) = look_ahead(CAMERA, None, TARGET, [37.0], wanted)
    resized = replace(
        TARGET.ring,
        outer_diameter_m=finer.smallest_diameter_m,
        inner_diameter_m=finer.smallest_diameter_m / 2.0,
        code_diameter_m=finer.smallest_diameter_m / 1.4,
        dot_diameter_m=finer.smallest_diameter_m / 7.0,
    )
    (enough,) = look_ahead(CAMERA, None, Target(resized), [37.0], wanted)
    assert enough.sd_distance_m == pytest.approx(0.0001 * 37.0, rel=0.02)


def test_replicas_are_used_where_the_ring_is_cut(outlooks: tuple[Outlook, ...]) -> None:
    close, too_close, far = outlooks[2:]
    assert close.ring == "A-inner"
    assert close.radius_px == pytest.approx(0.09 * 1001.0 / 3.0)
    assert (too_close.ring, too_close.found, too_close.sd_distance_m) == (None, 0.0, None)
    assert (far.ring, far.found, far.sd_centre_px) == ("A", 0.0, None)


def test_chances_of_detection_are_those_of_the_benchmark() -> None:
    assert chance_to_find(5.9) == (0.0, 0.0, 0.0)
    share, low, high = chance_to_find(6.5)
    assert share == FOUND[0][1] / FOUND[0][2]
    assert low < share <= high <= 1.0
    assert chance_to_find(400.0)[0] == 1.0
    assert 0.98 < chance_to_find(400.0)[1] < 0.99  # Wilson: 300 of 300


def test_default_heights_are_round_and_useful() -> None:
    heights = usual_heights(CAMERA, TARGET)
    assert heights == (2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0, 70.0)
    assert 0.09 * 1001.0 / heights[0] <= LARGEST_SHARE * 120
    assert 0.45 * 1001.0 / heights[-1] >= 6.0


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"blur_px": -1.0}, "blur"),
        ({"exposure_s": 0.0}, "exposure"),
        ({"psf_px": 0.0}, "psf"),
        ({"accuracy_percent": math.nan}, "accuracy"),
    ],
)
def test_impossible_conditions_are_refused(values: dict[str, float], word: str) -> None:
    with pytest.raises(SettingError, match=word):
        Conditions(**values)


@pytest.mark.parametrize("heights_m", [(0.0,), (math.inf,), (math.nan,), ()])
def test_impossible_heights_are_refused(heights_m: tuple[float, ...]) -> None:
    with pytest.raises(SettingError, match="height"):
        look_ahead(CAMERA, None, TARGET, heights_m, CONDITIONS)


@pytest.mark.parametrize(
    ("border_m", "diameters_m", "least_px"),
    [
        (0.1, (0.4,), 2.5),
        (None, (0.4,), 3.0),
        (0.1, (0.4, 0.3), 8.0),  # circles 2 px apart
        (0.1, (0.4, 0.02), 20.0),  # a hole of 1 px
    ],
)
def test_circles_of_the_smallest_plain_target_can_be_separated(
    border_m: float | None, diameters_m: tuple[float, ...], least_px: float
) -> None:
    position_m = (0.0, 0.0, 0.0)
    target = PlainTarget("T", diameters_m, PlainPolarity.DARK, position_m, border_m=border_m)
    assert least_plain_px(target) == pytest.approx(least_px)


def test_rings_whose_dots_are_blurred_away_are_not_found() -> None:
    """Of six rendered rings of 10 px, none was measured at σ = 4 px, nor at 8 px of motion."""
    heights = [
        0.5 * TARGET.ring.outer_diameter_m * CAMERA.mean_focal_px / px for px in (30.0, 10.0)
    ]
    for blurred in (Conditions(psf_px=4.0, blur_px=0.0), Conditions(blur_px=8.0)):
        near, far = look_ahead(CAMERA, None, TARGET, heights, blurred)
        assert near.found > 0.98
        assert near.sd_centre_px is not None
        assert (far.found, far.sd_distance_m, far.sd_centre_px) == (0.0, None, None)
        assert far.smallest_diameter_m > 1.5 * TARGET.ring.outer_diameter_m


def test_plain_discs_blurred_to_smooth_blobs_are_not_found() -> None:
    disc = PlainTarget("T", (0.4,), PlainPolarity.DARK, (0.0, 0.0, 0.0), border_m=0.1)
    height_m = 0.2 * CAMERA.mean_focal_px / 6.0
    for psf_px, is_found in ((2.5, True), (3.5, False)):
        (outlook,) = look_ahead(CAMERA, None, disc, [height_m], Conditions(psf_px=psf_px))
        assert (outlook.found > 0.0) == is_found


def test_blur_too_large_for_a_known_accuracy_is_refused() -> None:
    with pytest.raises(SettingError, match="blur: 30 px and a point spread of 10 px leave too"):
        look_ahead(CAMERA, None, TARGET, [30.0], Conditions(psf_px=10.0, blur_px=30.0))
