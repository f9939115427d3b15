"""Smoothing along contours: an unknown that all measurements of a camera estimate together.

It is small and acts linearly. So it is estimated after all other unknowns, at their minimum, and
kept with its effect on the pose. A camera smooths all frames nearly alike, apart from effects of
light and focus: the values of frames scatter about a mean of the camera. Mean and scatter are
estimated from all measurements (empirical Bayes). For a single measurement, they are those of
cameras in general.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.measurement.adjustment.covariance import nearest_edges, propagate, unevenness_factor
from kgcp.measurement.adjustment.normal_equations import normal_matrix
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.image_model.edge_terms import smoothing_row
from kgcp.measurement.image_model.ray_plate import plate_views
from kgcp.measurement.records import ContourSmoothing, Measurement

# In eight flights rendered by other programs, the smoothing had means of −0.07 to 0.09 px², with
# scatters of 0 to 0.08 px² about them (docs/method/shared_imaging.md, "Smoothing along contours").
_SD_OF_CAMERAS_PX2, _SCATTER_PX2 = 0.1, 0.05
# A circle's growth beyond this is no small unknown: one step does not reach it.
_LARGEST_GROWTH = 0.3
_SCATTERS_PX2 = np.linspace(0.0, 4.0 * _SCATTER_PX2, 41)


def contour_smoothing(fit: TargetFit, inflation: float) -> ContourSmoothing | None:
    """Return a fit's estimate of smoothing along contours; None if none is expected.

    Cameras of unknown tone process their pictures, and may smooth. In bins no contour is curved
    enough to show it.

    Parameters
    ----------
    inflation : float
        Ratio of variances to those of independent residuals.
    """
    if not fit.sample.problem.tone.is_unknown:
        return None
    seen_px2, precision, moves = _added_unknown(fit, _by_smoothing(fit))
    return ContourSmoothing(
        seen_px2=seen_px2,
        sd_seen_px2=math.sqrt(inflation * unevenness_factor(fit, inflation) / precision),
        pose_by_smoothing=moves[:6],
    )


def growth_of_print(fit: TargetFit) -> tuple[float | None, float | None]:
    """Return by how much the image shows inner circle and code larger than stated, as shares.

    It is what the inner circle, and the circle through the dots' centres with the dots, have to
    grow, relative to the outer circle, to fit best. What comes nearer by a share of its distance
    grows by the same share. None where no pixel tells: if an edge is hidden, or so far from its
    place that its pixels are outliers.
    """
    edge, _ = nearest_edges(fit)
    return _growth(fit, edge == 1), _growth(fit, edge >= 2)


def _growth(fit: TargetFit, is_at_edge: BoolArray) -> float | None:
    """Return by how much edges have to move away from the target's centre, as a share.

    Parameters
    ----------
    is_at_edge : (n,) array
        Whether a pixel's nearest edge is one of those that move.
    """
    approach = -(fit.parameters.pose.translation_m @ fit.jacobian[:3])
    by_growth = np.where(is_at_edge, approach, 0.0)
    if not np.any(by_growth * fit.misfit.weight):
        return None
    growth = _added_unknown(fit, by_growth)[0]
    return growth if abs(growth) < _LARGEST_GROWTH else None


def _added_unknown(fit: TargetFit, by_unknown: FloatArray) -> tuple[float, float, FloatArray]:
    """Estimate one more unknown at the minimum of all others, whose value is 0 in the fit.

    Parameters
    ----------
    by_unknown : (n,) array
        Derivative of the grey values.

    Returns
    -------
    value, precision : float
    moves : (p,) array
        Derivatives of the other unknowns by this one.
    """
    row, weight = by_unknown / fit.sd, fit.misfit.weight
    own, score = float(row @ (row * weight)), float(row @ fit.misfit.score)
    if fit.level_equations is None:
        scaled = fit.scaled_jacobian
        normal = normal_matrix(scaled, fit.misfit, fit.unknowns)
    else:
        scaled, normal = fit.level_equations.rows(), fit.level_equations.normal
        own -= fit.level_equations.square_explained(row, weight)
    mixed = scaled @ (row * weight)
    moves = np.asarray(-np.linalg.solve(normal, mixed), np.float64)
    precision = own + float(mixed @ moves)
    return score / precision, precision, moves


def _by_smoothing(fit: TargetFit) -> FloatArray:
    """Return the derivative (n,) of the grey values by smoothing along contours."""
    sample, parameters, share = fit.sample, fit.parameters, fit.prediction.share
    views = plate_views(parameters.matrix, sample.rays)
    row = smoothing_row(views, parameters.blur.total_covariance, sample.incidence)
    field = parameters.field
    added = None if field is None else field.added(sample.pixels)
    changes = sample.photometry.level_changes(share, parameters.light, row[None], added)
    return np.asarray(changes[0])


@dataclass(frozen=True, slots=True)
class CameraSmoothing:
    """Smoothing along contours by all measurements together."""

    mean_px2: float
    sd_mean_px2: float
    scatter_px2: float  # standard deviation of single measurements about the mean

    def in_measurement(self, smoothing: ContourSmoothing) -> tuple[float, float]:
        """Return the smoothing in one of the measurements, and its standard deviation [px²]."""
        variance, scatter = smoothing.sd_seen_px2**2, self.scatter_px2**2
        own = scatter / (scatter + variance)
        value = own * smoothing.seen_px2 + (1.0 - own) * self.mean_px2
        return value, math.sqrt(own * variance + ((1.0 - own) * self.sd_mean_px2) ** 2)


def camera_smoothing(smoothings: Sequence[ContourSmoothing]) -> CameraSmoothing:
    """Estimate mean and scatter from all measurements, with a prior from cameras in general.

    The scatter is the root mean square of its posterior distribution, computed over a grid. Given
    the scatter, the mean has a normal distribution.
    """
    seen = np.array([each.seen_px2 for each in smoothings])
    variance = np.array([each.sd_seen_px2**2 for each in smoothings])
    spread = variance + _SCATTERS_PX2[:, None] ** 2
    precision = np.sum(1.0 / spread, axis=1) + _SD_OF_CAMERAS_PX2**-2
    pull = np.sum(seen / spread, axis=1)
    log_density = 0.5 * (
        pull * pull / precision
        - np.log(precision)
        - np.sum(np.log(spread) + seen * seen / spread, axis=1)
        - (_SCATTERS_PX2 / _SCATTER_PX2) ** 2
    )
    density = np.exp(log_density - log_density.max())
    scatter2 = float(density @ _SCATTERS_PX2**2 / density.sum())
    precise = float(np.sum(1.0 / (variance + scatter2))) + _SD_OF_CAMERAS_PX2**-2
    mean = float(np.sum(seen / (variance + scatter2))) / precise
    return CameraSmoothing(mean, 1.0 / math.sqrt(precise), math.sqrt(scatter2))


def with_smoothing(
    camera: Camera, measurement: Measurement, learnt: CameraSmoothing | None = None
) -> Measurement:
    """Return a measurement corrected for smoothing along contours.

    It is corrected by what all measurements tell (`learnt`); None: by its own estimate alone. The
    other pose is moved by the same translation.
    """
    smoothing, uncertainty = measurement.smoothing, measurement.uncertainty
    if smoothing is None or uncertainty is None:
        return measurement
    learnt = camera_smoothing([smoothing]) if learnt is None else learnt
    value, sd = learnt.in_measurement(smoothing)
    step = (value - smoothing.taken_px2) * smoothing.pose_by_smoothing
    added_cov = (sd**2 - smoothing.sd_taken_px2**2) * np.outer(
        smoothing.pose_by_smoothing, smoothing.pose_by_smoothing
    )
    pose, other = measurement.pose.moved(step), measurement.alternative
    if other is not None:
        other = replace(
            other,
            pose=Pose(other.pose.rotation, other.pose.translation_m + step[:3]),
            pose_cov=None if other.pose_cov is None else other.pose_cov + added_cov,
        )
    return replace(
        measurement,
        pose=pose,
        centre_px=camera.project(pose.translation_m[None])[0],
        heading_deg=image_heading_deg(camera, pose),
        alternative=other,
        uncertainty=propagate(camera, pose, uncertainty.pose_cov + added_cov),
        smoothing=replace(smoothing, taken_px2=value, sd_taken_px2=sd),
    )
