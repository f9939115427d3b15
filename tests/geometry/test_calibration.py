"""The calibration's covariance: valid matrices, and derivatives of the image by the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import (
    CALIBRATION_PARAMETERS,
    CalibrationCovariance,
    distort_jacobian_by_calibration,
)
from kgcp.geometry.camera import Camera

CAMERA = Camera(
    width=1600,
    height=1100,
    fx=2306.0,
    fy=2302.0,
    cx=792.6,
    cy=543.9,
    k1=-0.072,
    k2=0.055,
    p1=4e-4,
    p2=-3e-4,
    k3=0.01,
    k4=0.02,
    k5=-0.03,
    k6=0.01,
)


@pytest.mark.parametrize("name", CALIBRATION_PARAMETERS)
def test_calibration_derivatives_equal_finite_differences(name: str) -> None:
    points = np.array([[0.31, -0.22], [-0.05, 0.11], [0.0, 0.0], [-0.3, -0.2]])
    step = 1e-3 if name in ("fx", "fy", "cx", "cy") else 1e-5
    high, low = (
        replace(CAMERA, **{name: getattr(CAMERA, name) + sign * step}).distort(points)
        for sign in (1.0, -1.0)
    )
    column = CALIBRATION_PARAMETERS.index(name)
    derivative = distort_jacobian_by_calibration(CAMERA, points)[:, :, column]
    assert np.allclose(derivative, (high - low) / (2.0 * step), rtol=1e-5, atol=1e-6)


def test_parameters_not_named_have_zero_covariance() -> None:
    whole = CalibrationCovariance.of(("k2", "fx"), np.array([[4.0, 1.0], [1.0, 9.0]])).cov
    fx, k2 = CALIBRATION_PARAMETERS.index("fx"), CALIBRATION_PARAMETERS.index("k2")
    assert (whole[fx, fx], whole[k2, k2], whole[fx, k2], whole[k2, fx]) == (9.0, 4.0, 1.0, 1.0)
    assert np.count_nonzero(whole) == 4


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 0.5, 1.0])
def test_parameters_of_very_different_scale_are_accepted(correlation: float) -> None:
    sd = np.array([20.0, 1e-7])
    cov = np.outer(sd, sd) * [[1.0, correlation], [correlation, 1.0]]
    assert CalibrationCovariance.of(("fx", "k3"), cov).cov[0, 0] == 400.0


@pytest.mark.parametrize(
    ("names", "cov", "message"),
    [
        (("fx", "skew"), np.eye(2), r"cov_of: .*'skew'.* are not parameters; name each once of fx"),
        (("fx", "fx"), np.eye(2), "name each once"),
        ((), np.zeros((0, 0)), "cov_of"),
        (("fx", "fy"), np.eye(3), "cov: has 9 numbers for 2 parameters; give the 2 x 2"),
        (("fx", "fy"), np.array([[1.0, 0.2], [0.3, 1.0]]), "cov: is not symmetric"),
        (("fx", "fy"), np.array([[1.0, 1.1], [1.1, 1.0]]), "cov: is not a covariance"),
        (("fx", "fy"), np.diag([1.0, -1.0]), "cov: is not a covariance"),
        (("fx", "fy"), np.array([[1.0, 0.5], [0.5, 0.0]]), "cov: is not a covariance"),
    ],
)  # fmt: skip
def test_matrices_that_are_not_covariances_are_rejected(
    names: tuple[str, ...], cov: FloatArray, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        CalibrationCovariance.of(names, cov)
