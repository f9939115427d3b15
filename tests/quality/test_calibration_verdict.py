"""The verdict on calibrations from photographs of which only the discs' moments are simulated."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_images
from kgcp.geometry.pose import rotation_about
from kgcp.io.tables.calibration import FIELD_COLUMNS, field_csv, field_discs
from kgcp.io.tables.columns import row_of
from kgcp.network.calibration import calibrate_camera, missing_discs
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    LensModel,
    NamedView,
    PointModel,
)
from kgcp.network.camera_network import AdjustedNetwork, CalibrationProblem, NetworkUnknowns
from kgcp.network.focal_changes import FocalChanges
from kgcp.network.photographs_apart import _view_misfits_px
from kgcp.network.records import CalibrationPrior
from kgcp.network.sheet_bends import bend_shapes
from kgcp.quality.calibration_verdict import calibration_numbers, change_if_neglected, judge
from kgcp.quality.checks.calibration import CalibrationGrade
from kgcp.quality.disc_light import DiscLight
from kgcp.quality.frame_rays import compare_cameras
from kgcp.targets.fields.layout import Field, FieldBar, GridKind, Mark

CAMERA = Camera(1600, 1200, 1500.0, 1500.0, 811.0, 583.0, -0.11)
FIELD = Field("f", GridKind.SQUARE, 6, 5, 0.04, 0.024, marks=(Mark(1, 1, 0.024, 0.01),))
OTHER_ZOOM = replace(CAMERA, fx=1545.0, fy=1545.0)
SD_PX = 0.01
TURNS = (0.0, 1.6, 0.2, 3.0, 1.5, 0.1)


def views(
    tilt: float = 0.5,
    bend_m: FloatArray | None = None,
    noise_px: float = SD_PX,
    camera: Camera = CAMERA,
    distance_m: float = 0.33,
    turns: Sequence[float] = TURNS,
) -> list[NamedView]:
    """Photographs of the field from six sides, with exact moments and noise."""
    rng = np.random.default_rng(18)
    points = FIELD.points_m() if bend_m is None else FIELD.points_m() + bend_m
    made = []
    for index, turn in enumerate(turns):
        angle = 2.0 * np.pi * index / len(turns)
        about = np.array([np.cos(angle), np.sin(angle), 0.0])
        rotation = rotation_about(tilt * about) @ rotation_about(np.array([0.0, 0.0, turn]))
        middle = [0.03 * np.cos(angle), 0.02 * np.sin(angle), distance_m]
        own = points if points.ndim == 2 else points[index]  # bent otherwise in each photograph
        centres = (own - own.mean(axis=0)) @ rotation.T + middle
        axes = np.broadcast_to(rotation[:, :2], (len(centres), 3, 2))
        circles = Circles3D(centres, axes, FIELD.radii_m())
        vectors = circle_images(camera, circles).moments
        vectors[:, :2] += noise_px * rng.standard_normal((len(vectors), 2))
        cov = np.diag([SD_PX**2, SD_PX**2, 1.0, 1.0, 1.0])
        covs = np.broadcast_to(cov, (len(vectors), 5, 5))
        point = np.arange(len(vectors))
        made.append(NamedView(f"p{index}", point, vectors, covs, is_symmetric=False))
    return made


def calibrated(
    made: list[NamedView], points: PointModel = PointModel.FIXED, lens: LensModel = LensModel.RADIAL
) -> CameraCalibration:
    return calibrate_camera(made, FIELD, (1600, 1200), CalibrationSettings(points, lens))


@functools.cache
def good_calibration() -> CameraCalibration:
    """The calibration of exact photographs of the stated field, by a lens that is chosen."""
    return calibrated(views(), lens=LensModel.AUTO)


@pytest.fixture
def _none_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the search for photographs that stand apart, which finds none and takes long."""
    monkeypatch.setattr("kgcp.network.calibration.photographs_apart", lambda *_: ())


def test_a_good_calibration_is_called_good() -> None:
    """The eccentricity of large discs leaves nothing in focal length and principal point."""
    result = good_calibration()
    numbers = calibration_numbers(result)
    verdict = judge(result, numbers)
    assert verdict.grade is CalibrationGrade.GOOD, verdict.sentence
    assert result.dropped == ()
    errors = [result.camera.fx - 1500.0, result.camera.cx - 811.0, result.camera.cy - 583.0]
    sd = numbers.sd[[0, 2, 3]]
    assert np.all(np.abs(errors) < 4.0 * sd)
    assert np.all(sd < 0.5)
    assert result.camera.k1 == pytest.approx(-0.11, abs=0.002)
    assert result.insignificant == ("k2", "p1", "p2", "k3")
    assert result.undetermined == result.tangled == ()
    assert result.radius_scale == pytest.approx(1.0, abs=0.001)
    assert 0.0 < np.nanmin(numbers.ray_sd_px) < np.nanmax(numbers.ray_sd_px) < 1.0


@pytest.mark.parametrize("seed", range(2))
def test_standard_deviations_include_terms_that_are_not_significant(seed: int) -> None:
    """Left out, p1 and p2 would displace the principal point, and k2 and k3 would change k1."""
    p1, p2, k2 = np.random.default_rng(seed).normal(0.0, [0.0002, 0.0002, 0.01])
    lens = replace(CAMERA, p1=p1, p2=p2, k2=k2)
    result = calibrated(views(camera=lens), PointModel.STIFF, LensModel.AUTO)
    numbers = calibration_numbers(result)
    sd = dict(zip(CALIBRATION_PARAMETERS, numbers.sd, strict=True))
    z = {n: (getattr(result.camera, n) - getattr(lens, n)) / sd[n] for n in ("cx", "cy", "k1")}
    assert np.abs([*z.values()]).max() < 3.5, z
    off_px = compare_cameras(result.camera, lens).rms_px
    assert off_px < 2.5 * np.sqrt(np.mean(numbers.ray_sd_px**2))


def test_terms_that_are_not_significant_absorb_no_errors_of_a_field() -> None:
    """A print that is stretched unevenly, by more than it states, would displace the centre."""
    x, y, zero = FIELD.points_m().T
    shape = np.column_stack((x * y, y**2 - np.mean(y**2), zero))
    stretch_m = 0.0015 / np.abs(shape).max() * shape
    result = calibrated(views(bend_m=stretch_m), PointModel.STIFF, LensModel.AUTO)
    deviation = calibration_numbers(result).field
    assert deviation is not None
    assert "in its plane" in deviation.doubt
    assert result.insignificant == ()
    assert result.camera.p1 == result.camera.p2 == 0.0
    assert result.camera.cx == pytest.approx(811.0, abs=1.0)
    assert result.camera.cy == pytest.approx(583.0, abs=1.0)


@pytest.mark.parametrize(
    ("points", "lens"),
    [(PointModel.STIFF, LensModel.AUTO), (PointModel.FREE, LensModel.RADIAL)],
)
def test_the_only_disc_with_wrong_coordinates_is_named(points: PointModel, lens: LensModel) -> None:
    errors_m = np.zeros((len(FIELD.names()), 3))
    errors_m[13] = 0.002, 0.001, 0.0
    result = calibrated(views(bend_m=errors_m), points, lens)
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is CalibrationGrade.LOOK
    assert re.search(rf"disc {FIELD.names()[13]} alone by 2\.\d+ mm", verdict.sentence)


def test_two_focal_lengths_are_estimated_where_they_differ() -> None:
    wider = calibrated(views(camera=replace(CAMERA, fy=1503.0)), lens=LensModel.AUTO)
    assert wider.camera.fy - wider.camera.fx == pytest.approx(3.0, abs=0.2)
    assert "fy" not in wider.tangled


@pytest.mark.usefixtures("_none_apart")
def test_two_focal_lengths_are_advised_where_one_fits_badly_and_two_were_not_tried() -> None:
    hint = "If that does not help, estimate two focal lengths: the pixels may not be square."
    made = views(camera=replace(CAMERA, fy=1530.0))
    radial = calibrated(made)
    assert hint in judge(radial, calibration_numbers(radial)).advice
    chosen = calibrated(made, lens=LensModel.AUTO)
    assert hint not in judge(chosen, calibration_numbers(chosen)).advice


@pytest.mark.usefixtures("_none_apart")
@pytest.mark.parametrize("lens", [LensModel.RADIAL, LensModel.AUTO])
def test_where_a_stretched_field_is_taken_as_exact_it_is_blamed_before_the_pixels(
    lens: LensModel,
) -> None:
    result = calibrated(views(bend_m=0.003 * FIELD.points_m() * [1.0, 0.0, 0.0]), lens=lens)
    advice = judge(result, calibration_numbers(result)).advice
    blamed = [line for line in advice if "stretched" in line or "focal lengths" in line]
    assert blamed[0].startswith("Let the field deviate from its description")
    assert len(blamed) == (2 if lens is LensModel.RADIAL else 1)  # it has tried the pixels itself


@pytest.mark.parametrize("is_turned", [True, False])
def test_two_focal_lengths_of_an_unturned_camera_may_be_a_stretched_field(
    *, is_turned: bool
) -> None:
    """Both fit as well, and fx is wrong by 0.16 % if it is the field."""
    turns = TURNS if is_turned else (0.0, 0.0, 0.05, 3.14, 0.02, 0.01)
    made = views(camera=replace(CAMERA, fy=1504.5), turns=turns)
    settings = CalibrationSettings(PointModel.FIXED, LensModel.BROWN, is_same_aspect=False)
    result = calibrate_camera(made, FIELD, (1600, 1200), settings)
    verdict = judge(result, calibration_numbers(result))
    assert ("fx and fy differ by 0.30 %, which may as well" in verdict.sentence) is not is_turned
    assert (verdict.grade is CalibrationGrade.GOOD) is is_turned


@pytest.mark.usefixtures("_none_apart")
@pytest.mark.parametrize("points", [PointModel.FIXED, PointModel.STIFF])
def test_a_rational_model_keeps_its_terms_small_on_a_field_with_errors(points: PointModel) -> None:
    """The errors must not drive k1 and k4 against each other, to a pole between the discs."""
    errors_m = 0.0002 * np.random.default_rng(3).standard_normal((len(FIELD.names()), 3))
    result = calibrated(views(bend_m=errors_m, noise_px=0.2 * SD_PX), points, LensModel.RATIONAL)
    assert np.abs([result.camera.k1, result.camera.k4]).max() < 0.3
    assert result.camera.fx == pytest.approx(1500.0, abs=3.0)
    assert set(result.undetermined) >= {"k1", "k4"}  # which can hardly be separated


def test_the_stated_effect_of_neglected_eccentricity_equals_that_of_an_adjustment() -> None:
    made = views(noise_px=0.0)
    stated = change_if_neglected(calibrated(made))
    tiny = replace(FIELD, diameter_m=1e-5, marks=())  # whose centroids count as centres
    radial = CalibrationSettings(PointModel.FIXED, LensModel.RADIAL)
    lost = calibrate_camera(made, tiny, (1600, 1200), radial)
    assert abs(stated["fx"]) > 0.05
    assert stated["fx"] == pytest.approx(lost.camera.fx - 1500.0, rel=0.25)


def test_a_field_that_is_not_flat_is_noticed_and_estimated() -> None:
    rng = np.random.default_rng(7)
    bend_m = 0.0002 * rng.standard_normal((len(FIELD.names()), 3))
    result = calibrated(views(bend_m=bend_m), PointModel.FREE)
    numbers = calibration_numbers(result)
    verdict = judge(result, numbers)
    assert verdict.grade is CalibrationGrade.LOOK
    assert "the field is not as stated: discs are off by 0.1" in verdict.sentence
    assert re.search(r"mm in its plane, \d+\.\d times as much as stated", verdict.sentence)
    assert numbers.field is not None
    drawn_m = np.sqrt(np.mean((bend_m - bend_m.mean(axis=0))[:, :2] ** 2))
    assert numbers.field.in_plane_m == pytest.approx(drawn_m, rel=0.1)
    assert "in height" not in verdict.sentence  # 0.3 mm are stated
    assert 0.005 < numbers.rms_px < 0.03
    assert 0.1 < numbers.rms_fixed_px < 3.0
    assert numbers.flatness_m == pytest.approx(0.0002, rel=0.4)
    assert abs(result.camera.fx - 1500.0) < 4.0 * numbers.sd[0]


@pytest.mark.parametrize("points", [PointModel.STIFF, PointModel.FREE])
def test_a_sheet_that_bends_between_photographs_is_reported_if_it_is_free(
    points: PointModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    if points is PointModel.STIFF:  # the free sheet shows that no photograph is left out for it
        monkeypatch.setattr("kgcp.network.calibration.photographs_apart", lambda *_: ())
    rng = np.random.default_rng(9)
    amounts = 0.0001 * rng.standard_normal((len(TURNS), 3))
    result = calibrated(views(bend_m=_heights_m(amounts)), points)
    numbers = calibration_numbers(result)
    verdict = judge(result, numbers)
    if points is PointModel.STIFF:
        assert numbers.bending is None
        assert abs(result.camera.fx - 1500.0) < 4.0 * numbers.sd[0]
        return
    assert numbers.bending is not None
    assert 0.00005 < numbers.bending.height_m < 0.0003
    assert "the field bends from photograph to photograph, by 0.1" in verdict.sentence
    assert "Mount the sheet on a stiff plate, or let it lie and move the camera." in verdict.advice
    assert numbers.rms_px < 1.5 * SD_PX * np.sqrt(2.0)
    assert abs(result.camera.fx - 1500.0) < 4.0 * numbers.sd[0] < 4.0


def _heights_m(amounts_m: FloatArray) -> FloatArray:
    """Return the displacements (v, m, 3) of a sheet that is bent so much in each photograph."""
    heights = amounts_m @ bend_shapes(FIELD.points_m()).T
    return np.asarray(heights[:, :, None] * [0.0, 0.0, 1.0])


def test_a_field_as_flat_as_it_is_stated_is_good() -> None:
    rng = np.random.default_rng(8)
    bend_m = FIELD.point_sds_m() * rng.standard_normal((len(FIELD.names()), 3))
    result = calibrated(views(bend_m=bend_m), PointModel.STIFF, LensModel.AUTO)
    numbers = calibration_numbers(result)
    assert judge(result, numbers).sentence == "The calibration is good."
    assert numbers.rms_fixed_px > 10.0 * numbers.rms_px  # its shape is seen, and is as stated
    assert numbers.field is not None
    assert 0.7 < numbers.field.in_plane_ratio < 1.3
    assert 0.7 < numbers.field.height_ratio < 1.3


@pytest.mark.parametrize("points", [PointModel.STIFF, PointModel.FREE])
@pytest.mark.parametrize(("grow", "ratio"), [(1.01, 0.0), (1.0, 5.0)])
def test_a_bowed_sheet_is_reported_and_a_larger_one_is_not(
    points: PointModel, grow: float, ratio: float
) -> None:
    """Photographs do not tell how large a field is."""
    nominal = FIELD.points_m()
    x = (nominal[:, 0] - nominal[:, 0].mean()) / np.ptp(nominal[:, 0])
    bow = x**2 - np.mean(x**2)
    bend_m = (grow - 1.0) * nominal
    bend_m[:, 2] = ratio * 0.0003 * bow / np.sqrt(np.mean(bow**2))
    result = calibrated(views(bend_m=bend_m), points)
    field = calibration_numbers(result).field
    assert field is not None
    assert field.in_plane_ratio < 1.0
    assert field.height_ratio == pytest.approx(ratio, abs=0.3)
    assert ("in height" in field.doubt) == (ratio > 0.0)


@pytest.mark.parametrize(("stated_m", "is_reported"), [(0.024, False), (0.0205, True)])
def test_a_wrong_stated_diameter_is_reported_and_does_no_harm(
    stated_m: float,
    is_reported: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    marks = (Mark(1, 1, stated_m, 0.01 * stated_m / 0.024),)
    field = replace(FIELD, diameter_m=stated_m, marks=marks)
    result = calibrate_camera(views(), field, (CAMERA.width, CAMERA.height), CalibrationSettings())
    verdict = judge(result, calibration_numbers(result))
    assert ("discs are 17 % larger than stated" in verdict.sentence) == is_reported
    measure = "Measure the diameter and the pitch of the print"
    assert any(measure in each for each in verdict.advice) == is_reported
    sd_px = float(np.sqrt(result.covariance.cov[0, 0]))
    assert abs(result.camera.fx - CAMERA.fx) < 3.0 * sd_px


def test_a_larger_field_is_reported_if_a_distance_was_measured() -> None:
    larger = 0.01 * FIELD.points_m()
    names = FIELD.names()
    bar = FieldBar(names[0], names[-1], 1.01 * float(np.hypot(0.2, 0.16)), 0.00002)
    made = views(bend_m=larger)
    settings = CalibrationSettings(PointModel.FREE, LensModel.RADIAL)
    result = calibrate_camera(made, replace(FIELD, bars=(bar,)), (1600, 1200), settings)
    field = calibration_numbers(result).field
    assert field is not None
    assert field.in_plane_m == pytest.approx(0.01 * np.sqrt(np.mean(_about_middle() ** 2)), rel=0.1)
    assert "in its plane" in field.doubt


def barred(*lengths: float, points: PointModel = PointModel.STIFF) -> CameraCalibration:
    """Return a calibration of the field with bars along its first row and its first column."""
    ends = (("r0c0", "r0c5", 0.2), ("r0c0", "r4c0", 0.16))
    bars = tuple(
        FieldBar(first, last, share * length_m, 0.00002)
        for share, (first, last, length_m) in zip(lengths, ends, strict=False)
    )
    settings = CalibrationSettings(points, LensModel.RADIAL)
    return calibrate_camera(views(), replace(FIELD, bars=bars), (1600, 1200), settings)


def test_a_stiff_field_has_the_length_that_was_measured() -> None:
    result = barred(1.0005)
    (residual_m,) = result.bar_residuals_m
    assert abs(residual_m) < 0.00002
    assert judge(result, calibration_numbers(result)).grade is CalibrationGrade.GOOD


def test_bars_that_contradict_each_other_are_named() -> None:
    result = barred(1.005, 0.995)
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is CalibrationGrade.LOOK
    assert re.search(r"the bar from r0c0 to r0c5 is \d\.\d+ mm longer than", verdict.sentence)
    assert re.search(r"the bar from r0c0 to r4c0 is \d\.\d+ mm shorter than", verdict.sentence)


def test_unused_bars_of_a_fixed_field_are_reported() -> None:
    result = barred(1.005, points=PointModel.FIXED)
    verdict = judge(result, calibration_numbers(result))
    assert "the field is taken as stated, so that its bars are not used" in verdict.sentence


def _about_middle() -> FloatArray:
    flat = FIELD.points_m()[:, :2]
    return np.asarray(flat - flat.mean(axis=0))


def nine_views() -> list[NamedView]:
    """Of which a quarter are two; of six to eight, all pairs would be tried."""
    farther = [replace(view, photo=f"{view.photo}b") for view in views(distance_m=0.4)]
    return views() + farther[:3]


def upside_down(view: NamedView) -> NamedView:
    """Return a photograph whose file was turned by half a turn."""
    vectors = view.vectors.copy()
    vectors[:, :2] = np.array([CAMERA.width, CAMERA.height]) - 1.0 - vectors[:, :2]
    return replace(view, vectors=vectors)


@pytest.mark.parametrize(
    ("zoom", "points", "lens"),
    [(1.05, PointModel.FIXED, LensModel.AUTO), (1.01, PointModel.STIFF, LensModel.RADIAL)],
)
def test_a_photograph_of_another_zoom_takes_no_part(
    zoom: float, points: PointModel, lens: LensModel
) -> None:
    """Its pose takes up most of the zoom: all of its discs fit to less than a pixel."""
    made = views()
    focal_px = 1500.0 * zoom
    made[3] = views(camera=replace(CAMERA, fx=focal_px, fy=focal_px))[3]
    result = calibrated(made, points, lens)
    assert result.dropped == ("p3",)
    numbers = calibration_numbers(result)
    assert abs(result.camera.fx - 1500.0) < 4.0 * numbers.sd[0] < 1.0
    verdict = judge(result, numbers)
    assert "1 photograph does not fit the others" in verdict.sentence
    assert any("Keep zoom, focus and crop" in sentence for sentence in verdict.advice)


def from_two_distances(
    lens_m: float, noise_px: float = SD_PX, by: Camera = CAMERA
) -> list[NamedView]:
    """Twelve photographs by a lens that is focused on the field; zero: its focus is fixed."""
    made = []
    for distance_m in (0.3, 0.4):
        focal_px = by.fx * (1.0 + lens_m / distance_m)
        camera = replace(by, fx=focal_px, fy=focal_px)
        those = views(camera=camera, distance_m=distance_m, noise_px=noise_px)
        made += [replace(view, photo=f"{view.photo} {distance_m}") for view in those]
    return made


@pytest.mark.usefixtures("_none_apart")
def test_a_focal_length_that_changes_with_the_distance_is_reported() -> None:
    """Poses absorb the change so well that the discs fit: nothing else shows it."""
    result = calibrated(from_two_distances(0.004), PointModel.STIFF)
    numbers = calibration_numbers(result)
    assert numbers.misfit_px < 3.0 * numbers.operator_sd_px
    assert numbers.focal_changes.trend is not None
    assert numbers.focal_changes.trend.lens_m == pytest.approx(0.004, rel=0.25)
    assert numbers.focal_changes.trend.change_px == pytest.approx(5.0, rel=0.25)
    verdict = judge(result, numbers)
    assert verdict.grade is CalibrationGrade.LOOK
    assert "changes with the distance: in the nearest photograph it is" in verdict.sentence
    assert any("Switch the autofocus off" in sentence for sentence in verdict.advice)


@pytest.mark.usefixtures("_none_apart")
@pytest.mark.parametrize(
    ("points", "noise_px"), [(PointModel.FIXED, SD_PX), (PointModel.STIFF, 4.0 * SD_PX)]
)
def test_a_fixed_focal_length_is_not_said_to_change(points: PointModel, noise_px: float) -> None:
    result = calibrated(from_two_distances(0.0, noise_px), points)
    numbers = calibration_numbers(result)
    assert numbers.focal_changes.trend is not None
    assert numbers.focal_changes.trend.p_value > 0.001
    assert abs(numbers.focal_changes.trend.lens_m) < 0.002
    assert "the focal length" not in judge(result, numbers).sentence


def test_a_focal_length_that_changes_during_the_session_is_reported() -> None:
    """All discs fit, with a focal length between the two: nothing else shows it."""
    made = []
    for camera, tilt in ((CAMERA, 0.5), (replace(CAMERA, fx=1503.0, fy=1503.0), 0.6)):
        near, far = (
            views(tilt, camera=camera, distance_m=distance_m) for distance_m in (0.31, 0.38)
        )
        session = near[:3] + far[3:]
        made += [replace(view, photo=f"{camera.fx:.0f} {view.photo}") for view in session]
    result = calibrated(made)
    assert result.dropped == ()
    numbers = calibration_numbers(result)
    assert numbers.focal_changes.step is not None
    assert numbers.focal_changes.step.change_px == pytest.approx(3.0, rel=0.1)
    verdict = judge(result, numbers)
    assert verdict.grade is CalibrationGrade.LOOK
    assert "from 1503 p0 on, the focal length is" in verdict.sentence
    assert any(
        "Calibrate the photographs before and from" in sentence for sentence in verdict.advice
    )


def test_photographs_from_few_places_tell_no_change_of_the_focal_length() -> None:
    result = calibrated(views()[:4])
    assert calibration_numbers(result).focal_changes == FocalChanges(None, None)


def test_a_photograph_of_another_zoom_is_found_if_another_one_fits_worst() -> None:
    """Its pose and the camera take up so much that a right one has the largest residuals."""
    made = views(distance_m=0.45)
    made[4] = views(camera=replace(CAMERA, fx=1515.0, fy=1515.0), distance_m=0.45)[4]
    result = calibrated(made, PointModel.STIFF)
    assert result.dropped == ("p4",)
    assert abs(result.camera.fx - 1500.0) < 3.0 * calibration_numbers(result).sd[0] < 1.0


def test_more_than_a_quarter_of_another_zoom_is_not_partly_left_out() -> None:
    """Without three of these four, the others would fit well enough not to look bad."""
    other, made = replace(CAMERA, fx=1515.0, fy=1515.0), []
    for distance_m, wrong in ((0.45, (0, 1, 2)), (0.4, (2,))):
        right = views(distance_m=distance_m)
        for index in wrong:
            right[index] = views(camera=other, distance_m=distance_m)[index]
        made += [replace(view, photo=f"{view.photo} {distance_m}") for view in right]
    result = calibrated(made)
    assert result.dropped == ()
    verdict = judge(result, calibration_numbers(result))
    assert "times worse" in verdict.sentence
    assert any("models do not describe" in sentence for sentence in verdict.advice)


def test_a_photograph_without_any_kept_disc_is_the_worst() -> None:
    result = calibrated(views())
    used = result.solution.is_used & (result.network.observations.view < 5)
    state = SimpleNamespace(
        network=result.network,
        solution=replace(result.solution, is_used=used),
        estimate=result.solution.estimate,
    )
    problem = SimpleNamespace(views=result.views)
    misfits_px = _view_misfits_px(
        cast("CalibrationProblem", problem), cast("AdjustedNetwork", state)
    )
    assert np.argmax(misfits_px) == 5
    assert np.all((misfits_px[:5] > 0.003) & (misfits_px[:5] < 0.03))


def partly_covered(view: NamedView, discs: tuple[int, ...]) -> NamedView:
    """Return a photograph of which some discs are measured 40 times worse, and state it."""
    vectors, covs = view.vectors.copy(), view.covs.copy()
    for disc, sign in zip(discs, (1.0, -1.0, 1.0), strict=False):
        vectors[disc, :2] += sign * 40.0 * SD_PX
        covs[disc, :2, :2] *= 40.0**2
    return replace(view, vectors=vectors, covs=covs)


def test_discs_that_state_how_badly_they_are_measured_cast_no_doubt() -> None:
    """Fingers cover a part of some discs, whose residuals are as large as stated."""
    made = [partly_covered(view, (3, 11, 22)) for view in views()]
    result = calibrated(made)
    assert result.dropped == ()
    assert result.rms_px > 3.0 * result.operator_sd_px
    assert result.misfit_px < 1.2 * result.operator_sd_px
    assert judge(result, calibration_numbers(result)).grade is CalibrationGrade.GOOD


def test_a_photograph_with_a_badly_measured_disc_takes_part() -> None:
    made = nine_views()
    made[4] = partly_covered(made[4], (3, 11))
    result = calibrated(made, lens=LensModel.AUTO)
    assert result.dropped == ()


def test_photographs_whose_files_are_turned_by_half_a_turn_take_no_part() -> None:
    made = nine_views()
    made[2], made[7] = upside_down(made[2]), upside_down(made[7])
    result = calibrated(made)
    assert set(result.dropped) == {"p2", "p1b"}
    errors = [result.camera.cx - 811.0, result.camera.cy - 583.0]
    assert np.all(np.abs(errors) < 4.0 * calibration_numbers(result).sd[2:4])
    assert result.rms_px < 2.0 * result.operator_sd_px


def test_photographs_that_were_turned_and_fit_nearly_are_named() -> None:
    """More than a quarter: none is left out, though the principal point is wrong."""
    made = from_two_distances(0.0, noise_px=0.3 * SD_PX)
    turned = (1, 4, 7, 10)
    names = tuple(made[index].photo for index in turned)
    for index in turned:
        made[index] = upside_down(made[index])
    result = calibrated(made)
    assert result.dropped == ()
    numbers = calibration_numbers(result)
    assert numbers.turned == names
    verdict = judge(result, numbers)
    assert "would fit the others much better if turned by 180°" in verdict.sentence
    assert any("as the camera stored them" in sentence for sentence in verdict.advice)
    assert any("stabilisation may have moved" in sentence for sentence in verdict.advice)


def test_photographs_that_were_not_turned_are_not_said_to_be() -> None:
    result = calibrated(from_two_distances(0.0), PointModel.FREE)
    numbers = calibration_numbers(result)
    assert numbers.turned == numbers.other_camera == ()


def test_photographs_by_another_camera_of_the_model_are_named() -> None:
    """Both kinds fit well enough, but the principal point is that of neither."""
    made = from_two_distances(0.0)
    other = replace(CAMERA, fx=1500.5, fy=1500.5, cx=815.0, cy=581.0)
    for index, view in enumerate(from_two_distances(0.0, by=other)):
        if index % 2:
            made[index] = view
    result = calibrated(made, PointModel.STIFF)
    numbers = calibration_numbers(result)
    assert set(numbers.other_camera) in [{v.photo for v in made[k::2]} for k in (0, 1)]
    verdict = judge(result, numbers)
    assert "they seem to be by another camera" in verdict.sentence
    assert any("Calibrate each camera by itself" in sentence for sentence in verdict.advice)


def test_with_two_halves_of_two_zooms_none_is_left_out() -> None:
    other = [replace(view, photo=f"{view.photo}b") for view in views(camera=OTHER_ZOOM)]
    result = calibrated(views() + other)
    assert result.dropped == ()
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is not CalibrationGrade.GOOD
    assert "worse" in verdict.sentence
    assert any("Keep zoom, focus and crop" in sentence for sentence in verdict.advice)
    assert any("switch off the stabilisation" in sentence for sentence in verdict.advice)


def test_two_of_six_photographs_of_another_zoom_are_left_out_together() -> None:
    """One after the other, the wrong one would go first."""
    made, by_other_zoom = views(), views(camera=OTHER_ZOOM)
    others = (0, 3)
    for other in others:
        made[other] = by_other_zoom[other]
    result = calibrated(made)
    assert result.dropped == tuple(f"p{other}" for other in others)
    assert result.camera.fx == pytest.approx(1500.0, abs=1.0)
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is CalibrationGrade.LOOK
    assert "2 photographs do not fit the others" in verdict.sentence


@pytest.mark.parametrize(("larger", "is_reported"), [(1.15, True), (1.05, False)])
def test_photographs_of_another_field_are_recognised_by_their_discs(
    larger: float, *, is_reported: bool
) -> None:
    """Its pitch is taken for a distance: the camera is right, and nothing else shows it."""
    made = views()
    for k in (1, 4):
        vectors = made[k].vectors.copy()
        vectors[:, 2:] *= larger**2
        made[k] = replace(made[k], vectors=vectors)
    result = calibrated(made)
    assert result.radius_scales == pytest.approx(
        np.where(np.isin(range(6), (1, 4)), larger, 1.0), abs=1e-3
    )
    verdict = judge(result, calibration_numbers(result))
    assert ("discs in p1, p4 have another size than in most" in verdict.sentence) == is_reported
    assert (verdict.grade is CalibrationGrade.GOOD) != is_reported


def test_one_photograph_of_four_is_not_excluded() -> None:
    made = views()[:4]
    made[3] = views(camera=OTHER_ZOOM)[3]
    assert calibrated(made, PointModel.STIFF).dropped == ()


def test_the_verdict_reports_that_frontal_photographs_determine_little() -> None:
    result = calibrated(views(tilt=0.005))
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is CalibrationGrade.UNUSABLE
    assert any("Tilt the field" in sentence for sentence in verdict.advice)
    assert 0.0 < result.camera.cx < 1600.0
    assert 0.0 < result.camera.cy < 1200.0


@pytest.mark.parametrize("cx", [-90.0, 1690.0])
def test_the_principal_point_of_cropped_photographs_is_found_outside_them(cx: float) -> None:
    result = calibrated(views(camera=replace(CAMERA, cx=cx)))
    assert abs(result.camera.cx - cx) < 5.0 * calibration_numbers(result).sd[2] < 1.0
    assert result.undetermined == ()
    assert result.camera.fx == pytest.approx(1500.0, abs=0.2)


@pytest.mark.usefixtures("_none_apart")
def test_a_diverging_principal_point_is_held_at_the_border_and_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, border = views(camera=replace(CAMERA, cx=2399.9)), 1599.0
    result = calibrated(made)
    assert result.camera.cx == border
    assert "cx" in result.undetermined
    assert judge(result, calibration_numbers(result)).grade is CalibrationGrade.UNUSABLE
    known_prior = CalibrationProblem.camera_prior

    def prior_at_border(
        problem: CalibrationProblem, unknowns: NetworkUnknowns, camera: Camera
    ) -> CalibrationPrior:
        prior = known_prior(problem, unknowns, camera)
        at = unknowns.model(camera).names.index("cx")
        values, sd = prior.values.copy(), prior.sd.copy()
        values[0, at], sd[0, at] = border, 1e-3
        return CalibrationPrior(values, sd)

    monkeypatch.setattr(CalibrationProblem, "camera_prior", prior_at_border)
    fixed = calibrated(made).camera
    assert result.camera.fx == pytest.approx(fixed.fx, rel=1e-4)
    assert result.camera.k1 == pytest.approx(fixed.k1, rel=1e-2)


def test_a_photograph_with_wrong_names_is_left_out() -> None:
    made = views()
    wrong = np.random.default_rng(1).permutation(made[3].point)
    result = calibrated([*made[:3], replace(made[3], point=wrong), *made[4:]])
    assert result.dropped == ("p3",)
    assert result.camera.fx == pytest.approx(1500.0, abs=1.0)


def test_discs_that_were_not_measured_are_expected_where_they_are() -> None:
    made = views()
    part = replace(
        made[0], point=made[0].point[4:], vectors=made[0].vectors[4:], covs=made[0].covs[4:]
    )
    point, vectors = missing_discs(calibrated([part, *made[1:]]))["p0"]
    assert point.tolist() == [0, 1, 2, 3]
    assert np.abs(vectors[:, :2] - made[0].vectors[:4, :2]).max() < 0.1
    assert vectors[:, 2:] == pytest.approx(made[0].vectors[:4, 2:], rel=0.01)


def test_a_displaced_disc_is_rejected_everywhere() -> None:
    made = []
    for view in views():
        vectors = view.vectors.copy()
        vectors[7, 0] += 3.0
        made.append(replace(view, vectors=vectors))
    result = calibrated(made)
    rejected = result.network.observations.point[~result.solution.is_used]
    assert rejected.tolist() == [7] * 6
    assert result.camera.fx == pytest.approx(1500.0, abs=0.5)


def test_discs_that_fit_in_no_photograph_are_named_and_left_out() -> None:
    made = []
    for view in views():
        vectors = view.vectors.copy()
        vectors[[13, 14], 0] += 30.0, -30.0
        made.append(replace(view, vectors=vectors))
    result = calibrated(made, PointModel.STIFF)
    verdict = judge(result, calibration_numbers(result))
    assert verdict.reasons == ("discs r2c1, r2c2 do not fit in any photograph",)
    assert any("Correct the places or codes" in sentence for sentence in verdict.advice)
    discs = field_discs(result)
    assert [disc.name for disc in discs if disc.adjusted is None] == ["r2c1", "r2c2"]
    text = field_csv(discs)
    assert "r2c0," in text
    assert "r2c1," not in text
    row = row_of(FIELD_COLUMNS, discs[13])
    assert (row["rays"], row["x_m"], row["sd_x_m"], row["change_x_m"]) == (0, None, None, None)


def test_more_than_a_tenth_of_wrong_discs_make_it_unusable() -> None:
    rng = np.random.default_rng(4)
    made = []
    for view in views():
        vectors = view.vectors.copy()
        wrong = rng.choice(len(vectors), 5, replace=False)
        vectors[wrong, :2] += 8.0 * rng.standard_normal((5, 2))
        made.append(replace(view, vectors=vectors))
    result = calibrated(made)
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is CalibrationGrade.UNUSABLE
    assert "% of the discs do not fit" in verdict.sentence


def test_a_fisheye_is_reported() -> None:
    """Rays by r = f θ, at up to 60° from the axis."""
    wide = Camera(1600, 1200, 500.0, 500.0, 811.0, 583.0)
    made = []
    for view in views(camera=wide, distance_m=0.1)[:4]:
        vectors = view.vectors.copy()
        across = vectors[:, :2] - [811.0, 583.0]
        radius = np.linalg.norm(across, axis=1, keepdims=True)
        vectors[:, :2] = [811.0, 583.0] + across / radius * 500.0 * np.arctan(radius / 500.0)
        made.append(replace(view, vectors=vectors))
    result = calibrated(made, lens=LensModel.RADIAL)
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is CalibrationGrade.UNUSABLE
    assert "fisheye" in verdict.sentence


def test_negatives_are_reported_for_checking() -> None:
    result = good_calibration()
    verdict = judge(result, calibration_numbers(result, DiscLight(0.07, 0.01, 0.0)))
    assert verdict.grade is CalibrationGrade.LOOK
    assert "they are negatives" in verdict.sentence
    assert any("not negatives" in text and "matt" in text for text in verdict.advice)


def in_burst(made: list[NamedView]) -> list[NamedView]:
    return made + [replace(view, photo=f"{view.photo}b") for view in made]


def test_a_burst_counts_as_one_place() -> None:
    result = calibrated(in_burst(views()))
    numbers = calibration_numbers(result)
    assert (numbers.views, numbers.places) == (12, 6)
    verdict = judge(result, numbers)
    assert verdict.grade is CalibrationGrade.GOOD
    assert any("12 places or more" in text for text in verdict.advice)


def test_bursts_from_three_places_are_too_few() -> None:
    result = calibrated(in_burst(views()[:3]))
    verdict = judge(result, calibration_numbers(result))
    assert verdict.grade is CalibrationGrade.UNUSABLE
    assert "6 photographs from 3 places only, fewer than 4" in verdict.sentence


def test_one_photograph_three_times_causes_no_traceback() -> None:
    once = views()[0]
    copies = [replace(once, photo=f"copy{index}") for index in range(3)]
    with pytest.raises(KgcpError, match="the photographs do not determine a camera"):
        calibrated(copies, PointModel.STIFF)


def test_a_field_that_is_never_tilted_causes_no_traceback() -> None:
    straight = [replace(view, covs=1e-4 * view.covs) for view in views(0.0, noise_px=0.01 * SD_PX)]
    with pytest.raises(KgcpError, match="tilt the field by 25° to 40°"):
        calibrated(straight)


def test_two_photographs_are_too_few() -> None:
    with pytest.raises(KgcpError, match="2 of the photographs show the field, and 3 are needed"):
        calibrated(views()[:2])


def test_photographs_with_wrong_names_are_named_where_too_few_others_are_left() -> None:
    made = views()[:4]
    shuffled = np.random.default_rng(1).permutation(len(made[0].point))
    wrong = [replace(view, point=view.point[shuffled]) for view in made[2:]]
    with pytest.raises(KgcpError, match=r"2 of the photographs .*: discs do not lie .* in p2, p3;"):
        calibrated([*made[:2], *wrong])
