"""Photographs of a field without a mark, one of them with another zoom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.network.calibration import calibrate_camera
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    LensModel,
    PointModel,
)
from kgcp.quality.calibration_verdict import calibration_numbers
from tests.quality.test_calibration_verdict import CAMERA, FIELD, views


def calibrated(zooms: dict[int, float], turned: tuple[int, ...] = ()) -> CameraCalibration:
    """Twelve photographs of a field with a shape of its own, some zoomed, some named turned."""
    shape_m = np.random.default_rng(2).normal(0.0, 1.0, (30, 3)) * [1e-4, 1e-4, 3e-4]
    made = []
    for row in range(12):
        zoom, distance_m = zooms.get(row, 1.0), 0.45 if row < 6 else 0.36
        camera = replace(CAMERA, fx=1500.0 * zoom, fy=1500.0 * zoom)
        view = views(bend_m=shape_m, camera=camera, distance_m=distance_m)[row % 6]
        point = view.point[::-1] if row in turned else view.point
        made.append(replace(view, photo=f"p{row}", point=point, is_symmetric=True))
    settings = CalibrationSettings(PointModel.STIFF, LensModel.RADIAL)
    return calibrate_camera(made, replace(FIELD, marks=()), (1600, 1200), settings)


def test_photographs_of_another_zoom_take_no_part() -> None:
    """They hide how the field lies in others, and errors of the field as stated hide them."""
    result = calibrated(dict.fromkeys((0, 3), 1.2), turned=(8,))
    assert result.dropped == ("p0", "p3")
    assert result.points_used is PointModel.STIFF
    assert not result.is_turn_unclear
    assert abs(result.camera.fx - 1500.0) < 4.0 * calibration_numbers(result).sd[0] < 1.0


def test_discs_keep_their_names_if_it_is_unclear_how_the_field_lies() -> None:
    result = calibrated(dict.fromkeys((0, 2, 3, 5), 1.2), turned=(8, 10))
    assert result.is_turn_unclear
    named = np.concatenate([view.point for view in result.views])
    np.testing.assert_array_equal(named, result.network.observations.point)
