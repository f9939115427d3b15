"""The page of a calibration with discs of several normals, and z towards the camera."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_images, plane_axes
from kgcp.geometry.pose import rotation_about
from kgcp.network.calibration import calibrate_camera
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    LensModel,
    NamedView,
    PointModel,
)
from kgcp.report.calibration.figures import side_of_cameras
from kgcp.report.calibration.page import _eccentricity, datum_words, fit_words
from kgcp.targets.fields.layout import FieldBar
from kgcp.targets.fields.points import FieldPoint, PointField

CAMERA = Camera(1600, 1200, 1500.0, 1500.0, 811.0, 583.0, -0.11)
SD_PX = 0.01
LEFT, RIGHT = (-0.6, 0.0, 0.8), (0.6, 0.0, 0.8)  # normals of two planes that meet at x = 0
TILTS = ((0.4, 0.0), (0.0, 0.4), (-0.4, 0.1), (0.1, -0.4), (0.3, 0.3), (-0.3, 0.2))


def corner() -> PointField:
    """Discs on two planes like an open book seen from inside, y up and z towards the camera."""
    points = [
        FieldPoint(
            f"p{column}{row}",
            (0.04 * column, 0.05 * row, -0.03 * abs(column)),
            0.02,
            normal=LEFT if column < 0 else RIGHT,
        )
        for column in (-3, -2, -1, 1, 2, 3)
        for row in (-2, -1, 0, 1, 2)
    ]
    return PointField("corner", tuple(points))


@pytest.fixture(scope="module")
def calibration() -> CameraCalibration:
    """Six photographs of the corner, with exact moments and noise."""
    rng, field, views = np.random.default_rng(18), corner(), []
    points, upright = field.points_m(), np.diag([1.0, -1.0, -1.0])
    for index, tilt in enumerate(TILTS):
        turn = rotation_about(np.array([0.0, 0.0, 0.5 * np.pi * (index % 2)]))
        rotation = rotation_about(np.array([*tilt, 0.0])) @ turn @ upright
        centres = points @ rotation.T + [0.0, 0.0, 0.36]
        circles = Circles3D(centres, rotation @ plane_axes(field.normals()), field.radii_m())
        vectors = circle_images(CAMERA, circles).moments
        vectors[:, :2] += SD_PX * rng.standard_normal((len(points), 2))
        cov = np.diag([SD_PX**2, SD_PX**2, 1.0, 1.0, 1.0])
        covs = np.broadcast_to(cov, (len(points), 5, 5))
        views.append(
            NamedView(f"p{index}", np.arange(len(points)), vectors, covs, is_symmetric=False)
        )
    settings = CalibrationSettings(PointModel.STIFF, LensModel.RADIAL)
    return calibrate_camera(views, field, (CAMERA.width, CAMERA.height), settings)


def test_eccentricities_use_the_individual_normals_of_discs(
    calibration: CameraCalibration,
) -> None:
    estimate = calibration.solution.estimate
    normals = np.einsum("vij,mj->vmi", estimate.rotations, calibration.field.normals())
    rays = np.einsum("vij,mj->vmi", estimate.rotations, estimate.points)
    rays += estimate.translations[:, None]
    cosines = np.abs(np.sum(normals * rays, axis=2)) / np.linalg.norm(rays, axis=2)
    summary = _eccentricity(calibration)
    assert summary.tilt_deg.median == pytest.approx(np.degrees(np.median(np.arccos(cosines))), 1e-3)
    perspective_px = np.linalg.norm(calibration.eccentricity.perspective_px, axis=1)
    assert summary.perspective_px.median == pytest.approx(np.median(perspective_px), rel=0.02)


def test_heights_are_drawn_towards_the_camera_on_either_side(
    calibration: CameraCalibration,
) -> None:
    estimate = calibration.solution.estimate
    assert side_of_cameras(estimate) == 1.0
    mirrored = np.diag([1.0, -1.0, -1.0])  # half a turn about x, which lattices are seen in
    turned = replace(
        estimate, rotations=estimate.rotations @ mirrored, points=estimate.points @ mirrored
    )
    assert side_of_cameras(turned) == -1.0


def test_a_good_fit_is_reported_with_what_it_does_not_determine(
    calibration: CameraCalibration,
) -> None:
    words = fit_words(calibration)
    assert re.fullmatch(
        r"The RMS of the residuals is 0\.01\d px, the standard deviation of a measured disc"
        r" 0\.014 px; all parameters are determined\.",
        words,
    )
    weak = replace(calibration, undetermined=("k2",), tangled=("cx", "p1"))
    said = "k2 not determined by these photographs; cx, p1 cannot be separated."
    assert fit_words(weak).endswith(said)


def test_a_disc_that_is_measured_badly_is_not_all_that_is_said_of_the_fit(
    calibration: CameraCalibration,
) -> None:
    (first, *others), residuals = calibration.views, calibration.solution.residuals.copy()
    covs = first.covs.copy()
    covs[0] *= 200.0**2
    residuals[0] = 200.0 * calibration.operator_sd_px
    worse = replace(
        calibration,
        views=(replace(first, covs=covs), *others),
        solution=replace(calibration.solution, residuals=residuals),
    )
    assert re.search(r" px \(0\.01\d px if discs measured worse than most count", fit_words(worse))


@pytest.mark.parametrize(
    ("points", "has_bar", "words"),
    [
        (PointModel.STIFF, False, ""),
        (PointModel.STIFF, True, "The scale comes from the bars."),
        (PointModel.FREE, False, "Shift, rotation and scale are those of the nominal field."),
        (
            PointModel.FREE,
            True,
            "The scale comes from the bars. Shift and rotation are those of the nominal field.",
        ),
    ],
)
def test_the_source_of_the_field_s_scale_is_reported(
    calibration: CameraCalibration, points: PointModel, *, has_bar: bool, words: str
) -> None:
    bars = (FieldBar("p-30", "p-31", 0.05, 0.00001),) if has_bar else ()
    field = replace(calibration.field, bars=bars)
    assert datum_words(replace(calibration, field=field, points_used=points)) == words
