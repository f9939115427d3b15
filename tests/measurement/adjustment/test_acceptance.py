"""Tests that a fit must pass before it is reported: code, residuals, precision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.acceptance import check_code, check_fit, check_precision
from kgcp.measurement.adjustment.covariance import propagate
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.adjustment.two_poses import fit_both_poses
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.records import Appearance, Measurement
from kgcp.targets.layout import Target

PlacePlate = Callable[..., Pose]
DrawFrame = Callable[..., GreyArray]
FitPlate = Callable[[tuple[float, ...], float], TargetFit]
CODE = (0.0, 43.0, 78.0, 180.0)


@pytest.fixture(scope="module")
def fit_plate(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    imaging_of: Callable[..., FitProblem],
) -> FitPlate:
    """The target fitted to a plate with dots in these directions, of this radius [px]."""

    def fit(code_deg: tuple[float, ...], radius_px: float) -> TargetFit:
        pose = place_plate((205.4, 190.7), radius_px, tilt_deg=20.0, way_deg=200.0, turn_deg=31.0)
        shown = Target(replace(target.ring, code_deg=code_deg), target.replicas)
        problem = imaging_of(draw_frame((shown, pose)), camera, target, pose)
        return fit_both_poses(problem, pose, Blur(0.5, 0.5, 0.0)).best

    return fit


@pytest.mark.parametrize("radius_px", [12.0, 40.0])
@pytest.mark.parametrize("code_deg", [CODE, (0.0, 43.0, 180.0)], ids=["whole", "one dot dirty"])
def test_the_target_s_own_code_passes(
    fit_plate: FitPlate, code_deg: tuple[float, ...], radius_px: float
) -> None:
    fit = fit_plate(code_deg, radius_px)
    check_fit(fit)
    check_code(fit)


@pytest.mark.parametrize(("outlying", "is_refused"), [(0.25, False), (0.35, True)])
def test_a_fit_with_a_third_of_outliers_is_refused(
    fit_plate: FitPlate, *, outlying: float, is_refused: bool
) -> None:
    """Clipped pixels are no outliers, whatever their weight."""
    fit = fit_plate(CODE, 40.0)
    count = len(fit.sample.levels)
    weight, at_high = np.ones(count), np.arange(count) < 0.4 * count
    weight[at_high] = 0.1
    weight[-round(outlying * (count - at_high.sum())) :] = 0.1
    censoring = replace(fit.sample.censoring, at_high=at_high, at_low=np.zeros(count, np.bool_))
    doubtful = replace(
        fit,
        sample=replace(fit.sample, censoring=censoring),
        misfit=replace(fit.misfit, weight=weight),
    )
    if not is_refused:
        check_fit(doubtful)
        return
    with pytest.raises(Rejection, match="35% outliers") as caught:
        check_fit(doubtful)
    assert caught.value.reason is Reason.POOR_FIT


MORE, ELSEWHERE = (*CODE, 260.0), (0.0, 43.0, 78.0, 210.0)
MISSING, ANOTHER = (0.0, 180.0), (0.0, 60.0, 150.0, 240.0)
MOVED = (0.0, 43.0, 88.0, 180.0)  # by less than half a dot


@pytest.mark.parametrize(
    ("code_deg", "radius_px"),
    [
        (code, radius)
        for code in (MORE, ELSEWHERE, MISSING, ANOTHER, MOVED)
        for radius in (12.0, 40.0)
    ],
)
def test_wrong_dots_are_reported_as_another_code(
    fit_plate: FitPlate, code_deg: tuple[float, ...], radius_px: float
) -> None:
    fit = fit_plate(code_deg, radius_px)
    with pytest.raises(Rejection) as caught:
        check_code(fit)
    assert caught.value.reason is Reason.OTHER_CODE


@pytest.mark.parametrize(("angle_deg", "side"), [(47.0, "larger"), (39.0, "smaller")])
def test_a_moved_dot_is_named(fit_plate: FitPlate, angle_deg: float, side: str) -> None:
    with pytest.raises(Rejection, match=f"beside the dot at 43 deg, at {side} angles"):
        check_code(fit_plate((0.0, angle_deg, 78.0, 180.0), 40.0))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda fit: replace(fit, misfit=replace(fit.misfit, weight=0.1 * fit.misfit.weight)),
        lambda fit: replace(fit, sd=0.3 * np.ones_like(fit.sd)),
    ],
    ids=["outliers", "noise"],
)
def test_a_poor_fit_is_refused(
    fit_plate: FitPlate, spoil: Callable[[TargetFit], TargetFit]
) -> None:
    with pytest.raises(Rejection) as caught:
        check_fit(spoil(fit_plate(CODE, 12.0)))
    assert caught.value.reason is Reason.POOR_FIT


def test_a_distance_uncertain_by_a_per_cent_is_refused(
    camera: Camera, place_plate: PlacePlate
) -> None:
    pose = place_plate((205.4, 190.7), 20.0)
    along = pose.translation_m / pose.distance_m

    def observed(relative_sd: float, radius_px: float = 20.0) -> Measurement:
        cov = 1e-8 * np.eye(6)
        cov[:3, :3] += (relative_sd * pose.distance_m) ** 2 * np.outer(along, along)
        return Measurement(
            target="A",
            ring="A",
            instance=0,
            score=0.9,
            pose=pose,
            centre_px=camera.project(pose.translation_m),
            heading_deg=0.0,
            appearance=Appearance(radius_px, 0.1, 0.8, 0.0),
            alternative=None,
            uncertainty=propagate(camera, pose, cov),
        )

    check_precision(observed(0.009))
    check_precision(observed(0.019, radius_px=12.0))
    check_precision(replace(observed(0.5), uncertainty=None))
    for doubtful in (observed(0.011), observed(0.021, radius_px=12.0)):
        with pytest.raises(Rejection) as caught:
            check_precision(doubtful)
        assert caught.value.reason is Reason.POOR_FIT
