"""Checks that a measured disc or ring is the plain target: its edge, size, place and shape."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from kgcp.errors import Reason, Rejection
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.discs.adjust_disc import geometry_of
from kgcp.measurement.discs.covariance import moments_by_stretch
from kgcp.measurement.discs.records import Disc
from kgcp.measurement.plain_pose import CircleMoments, CirclesFit
from kgcp.measurement.plain_prediction import SIGMAS, PlainPrediction
from kgcp.targets.plain import PlainTarget

# Tuning; `benchmarks.ground.plain_targets` counts what is found and what is taken for a target.
# Standard deviation of edges of a print in the field: in pixels, since an unknown tone curve
# displaces them, and in radii, since they may be jagged or dirty
_EDGE_PX, _EDGE = 0.1, 0.01
_SIZE_PX, _SIZE = 0.12, 0.015  # the same for the size of an edge as a whole
# Largest edge spread, relative to the smaller semi-axis. With more, a disc cannot be told from a
# smooth blob, of which ground has many. Sharp discs of 2.5 px, tilted by 50°, have 0.38.
_MOST_BLUR = 0.5
_ROUGH_PX = 0.075  # largest displacement of the centre that an uneven edge may cause
_PLACE_PX = 0.1  # standard deviation of a predicted place, at least
_UNLIKELY = 1e-4  # probability with which a true target's shape is refused


def tolerated(images: CircleMoments) -> CircleMoments:
    """Return the circles with the errors of edges in the field added to their covariances."""
    covs = []
    for moments, cov in zip(images.moments, images.covs, strict=True):
        geometry = geometry_of(moments)
        radius_px = math.sqrt(max(float(geometry[2] * geometry[4] - geometry[3] ** 2), 0.0))
        edge_px = math.hypot(_EDGE_PX, _EDGE * radius_px)
        spread = edge_px**2 * np.diag((0.5, 0.5, 1.0, 0.5, 1.0))
        to_moments = moments_by_stretch(geometry)
        covs.append(cov + to_moments @ spread @ to_moments.T)
    return CircleMoments(images.radii_m, images.moments, np.array(covs))


def check_edge(disc: Disc) -> None:
    """Refuse an edge that is uneven, like a stone's, or is hardly an edge, like a shrub's.

    Raises
    ------
    Rejection
    """
    beyond_noise_px = disc.sd_px * math.sqrt(max(0.0, 1.0 - 1.0 / disc.inflation))
    if beyond_noise_px > math.hypot(_ROUGH_PX, _EDGE * disc.ellipse.mean_radius):
        detail = f"an uneven edge, so that the centre is uncertain by {beyond_noise_px:.2f} px"
        raise Rejection(Reason.POOR_FIT, detail)
    if disc.blur_px > _MOST_BLUR * disc.ellipse.b:
        size = f"semi-axes of {disc.ellipse.a:.1f} and {disc.ellipse.b:.1f} px"
        raise Rejection(Reason.TOO_BLURRED, f"an edge spread by {disc.blur_px:.1f} px, at {size}")


def _check_size(target: PlainTarget, prediction: PlainPrediction, pose: Pose) -> None:
    """Refuse a distance that is not the predicted one."""
    expected_m = float(np.linalg.norm(prediction.position_m))
    off = math.log(pose.distance_m / expected_m)
    sd = math.hypot(
        prediction.sd_log_distance,
        _SIZE,
        _SIZE_PX / prediction.radius_px,
        target.sd_diameter_m / target.outer_diameter_m,
    )
    if abs(off) > SIGMAS * sd:
        raise Rejection(Reason.UNLIKE_PREDICTION, f"its size is off by {math.exp(-off) - 1.0:+.0%}")


def check_agreement(
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction,
    fit: CirclesFit,
    circles: int,
) -> None:
    """Refuse a measurement whose size, place or shape differs from the prediction.

    Raises
    ------
    Rejection
    """
    _check_size(target, prediction, fit.pose)
    off_px = camera.project(fit.pose.translation_m[None])[0] - prediction.centre_px
    cov_px2 = prediction.cov_px2 + _PLACE_PX**2 * np.eye(2)
    if float(off_px @ np.linalg.solve(cov_px2, off_px)) > SIGMAS**2:
        detail = f"{float(np.linalg.norm(off_px)):.1f} px off"
        raise Rejection(Reason.UNLIKE_PREDICTION, detail)
    freedom = 5 * circles - (3 if prediction.normal is not None else 5)
    if freedom and fit.chi2 > chdtri(freedom, _UNLIKELY):
        raise Rejection(Reason.UNLIKE_PREDICTION, f"shape: χ² {fit.chi2:.0f} of {freedom}")
