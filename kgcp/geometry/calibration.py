"""Covariance of a camera's calibration, and its effect on the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry._jit import compiled_if_often
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera

CALIBRATION_PARAMETERS = (
    *("fx", "fy", "cx", "cy"),
    *("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
)
"""Fields of `Camera` that a calibration estimates, in OpenCV's order."""

_MAX_ASYMMETRY = 1e-9  # relative: allows for separate rounding of the two halves
# Smallest eigenvalue of the correlation matrix that is accepted, negated: rounding to six digits
# may make zero negative by as much.
_MAX_NEGATIVE_EIGENVALUE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationCovariance:
    """Covariance of the calibration, whose error all frames of a flight share."""

    # (12, 12): in the order and units of `CALIBRATION_PARAMETERS`; zeros for parameters that are
    # taken as exact
    cov: FloatArray

    @classmethod
    def of(cls, names: tuple[str, ...], cov: FloatArray) -> CalibrationCovariance:
        """Return the covariance of all parameters, given that of the named ones (n, n).

        Raises
        ------
        SettingError
            With key `cov_of` if a name is unknown or repeated. With key `cov` if the matrix does
            not have one row and column per name, is not symmetric, or is not positive semidefinite.
        """
        listed = ", ".join(CALIBRATION_PARAMETERS)
        if not names or len(set(names)) < len(names) or not {*names} <= {*CALIBRATION_PARAMETERS}:
            raise SettingError(
                "cov_of", f"{list(names)} are not parameters", f"name each once of {listed}"
            )
        if cov.shape != (len(names), len(names)):
            raise SettingError(
                "cov",
                f"has {cov.size} numbers for {len(names)} parameters",
                f"give the {len(names)} x {len(names)} numbers row by row",
            )
        _check_covariance(cov)
        places = [CALIBRATION_PARAMETERS.index(name) for name in names]
        whole = np.zeros((len(CALIBRATION_PARAMETERS),) * 2)
        whole[np.ix_(places, places)] = cov
        return cls(whole)


def _check_covariance(cov: FloatArray) -> None:
    if not np.allclose(cov, cov.T, rtol=_MAX_ASYMMETRY, atol=0.0):
        raise SettingError("cov", "is not symmetric", "give both halves of the matrix")
    sd = np.sqrt(np.maximum(np.diag(cov), 0.0))
    scale = np.where(sd > 0.0, sd, 1.0)
    correlation = cov / np.outer(scale, scale)
    is_valid = np.all(np.diag(cov) >= 0.0) and not np.any(cov[sd == 0.0])
    if not is_valid or np.linalg.eigvalsh(correlation)[0] < -_MAX_NEGATIVE_EIGENVALUE:
        raise SettingError(
            "cov",
            "is not a covariance: some combination has a negative variance",
            "give the calibration's matrix with all its digits",
        )


def distort_jacobian_by_calibration(camera: Camera, normalised: FloatArray) -> FloatArray:
    """Return the derivatives of `Camera.distort` by the calibration.

    Parameters
    ----------
    normalised : (n, 2) array
        Where they are evaluated: normalised coordinates.

    Returns
    -------
    (n, 2, 12) array
        Rows x, y [px], columns `CALIBRATION_PARAMETERS`.
    """
    slopes = np.zeros((len(normalised), 2, len(CALIBRATION_PARAMETERS)))
    lens = (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3, camera.k4, camera.k5, camera.k6)
    _fill_in_slopes(lens, (float(camera.fx), float(camera.fy)), normalised, slopes)
    return slopes


@compiled_if_often
def _fill_in_slopes(
    lens: tuple[float, float, float, float, float, float, float, float],
    focals_px: tuple[float, float],
    normalised: FloatArray,
    slopes: FloatArray,
) -> None:
    """Fill in the derivatives (n, 2, 12) by the calibration, in zeros."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens
    fx, fy = focals_px
    for i in range(len(normalised)):
        x, y = normalised[i, 0], normalised[i, 1]
        r2 = x * x + y * y
        above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        factor, xy2 = above / below, 2.0 * x * y
        by_p1, by_p2 = r2 + 2.0 * y * y, r2 + 2.0 * x * x
        slopes[i, 0, 0] = x * factor + p1 * xy2 + p2 * by_p2
        slopes[i, 1, 1] = y * factor + p1 * by_p1 + p2 * xy2
        slopes[i, 0, 2] = slopes[i, 1, 3] = 1.0
        radial_x, radial_y = fx * x * (r2 / below), fy * y * (r2 / below)
        for k_above, k_below in ((4, 9), (5, 10), (8, 11)):  # of r², r⁴, r⁶
            slopes[i, 0, k_above], slopes[i, 1, k_above] = radial_x, radial_y
            slopes[i, 0, k_below] = -factor * radial_x
            slopes[i, 1, k_below] = -factor * radial_y
            radial_x, radial_y = radial_x * r2, radial_y * r2
        slopes[i, 0, 6], slopes[i, 1, 6] = fx * xy2, fy * by_p1
        slopes[i, 0, 7], slopes[i, 1, 7] = fx * by_p2, fy * xy2
