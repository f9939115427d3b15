"""Steps of the adjustment never lead to an impossible blur."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.photometry import PARAM_COUNT, Light, Param

POSE = Pose(np.eye(3), np.array([0.1, -0.2, 9.0]))
START = Parameters.of(POSE, Blur(0.5, 0.5, 0.0), Light(0.1, 0.8))
TURN = math.radians(70.0)


def stepped(**steps: float) -> Blur:
    step = np.zeros(PARAM_COUNT)
    for name, value in steps.items():
        step[Param[name]] = value
    return START.moved(step).blur


@pytest.mark.parametrize(
    ("elongation", "is_kept"), [(0.0, True), (0.4, True), (0.47, True), (0.5, False), (5.0, False)]
)
def test_the_covariance_of_a_blur_stays_positive_definite(
    elongation: float, *, is_kept: bool
) -> None:
    blur = stepped(BLUR_DIFFERENCE=elongation * math.cos(TURN), BLUR_XY=elongation * math.sin(TURN))
    covariance = np.array([[blur.xx, blur.xy], [blur.xy, blur.yy]])
    least, most = np.linalg.eigvalsh(covariance)
    assert 0.01 < least <= 0.5
    assert least + most == pytest.approx(1.0)
    assert (most - least == pytest.approx(2.0 * elongation)) == is_kept
    if elongation:
        assert math.atan2(2.0 * blur.xy, blur.xx - blur.yy) == pytest.approx(TURN)


def test_a_blur_is_never_sharper_than_a_pixel() -> None:
    blurs = [stepped(BLUR_MEAN=step) for step in (-0.1, -0.5, -5.0, -500.0)]
    variances = [blur.xx for blur in blurs]
    assert variances == sorted(variances, reverse=True)
    assert 0.4 < variances[0] < 0.5
    assert 1.0 / 15.0 < variances[-1] < 1.0 / 12.0
