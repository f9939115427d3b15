"""Checks that a measured disc or ring is the plain target: its edge, size, place and shape."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
from kgcp.measurement.records import Measurement, Miss, Outcome
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
# χ² of size and shape per degree of freedom, up to which a target counts as undisturbed. Tolerances
# are wide: it is mostly below 0.05 on even ground, and below this limit on grass.
_UNDISTURBED = 1.0 / 3.0
# Two targets were measured from the same edge if their centres are nearer than this (in radii) and
# the ratio of their radii is smaller than this.
_SAME_PLACE, _SAME_SIZE = 0.35, 1.15


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


def _size_chi2(target: PlainTarget, prediction: PlainPrediction, pose: Pose) -> float:
    """Return the χ² of a distance that is the predicted one; refuse others."""
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
    return (off / sd) ** 2


def disturbance_factor(
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction,
    fit: CirclesFit,
    circles: int,
) -> float:
    """Return the factor by which the covariance of a measurement is to be enlarged, at least 1.

    A shadow or a cover that changes size and shape displaces the centre, too.

    Raises
    ------
    Rejection
        If size, place or shape differ too much from the prediction.
    """
    size_chi2 = _size_chi2(target, prediction, fit.pose)
    off_px = camera.project(fit.pose.translation_m[None])[0] - prediction.centre_px
    cov_px2 = prediction.cov_px2 + _PLACE_PX**2 * np.eye(2)
    if float(off_px @ np.linalg.solve(cov_px2, off_px)) > SIGMAS**2:
        detail = f"{float(np.linalg.norm(off_px)):.1f} px off"
        raise Rejection(Reason.UNLIKE_PREDICTION, detail)
    freedom = 5 * circles - (3 if prediction.normal is not None else 5)
    if freedom and fit.chi2 > chdtri(freedom, _UNLIKELY):
        raise Rejection(Reason.UNLIKE_PREDICTION, f"shape: χ² {fit.chi2:.0f} of {freedom}")
    per_freedom = (size_chi2 + (fit.chi2 if freedom else 0.0)) / (1 + freedom)
    return max(1.0, per_freedom / _UNDISTURBED)


def refuse_shared_edges(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes of a frame's plain targets, without those measured from the same edge.

    If one of two equal targets is hidden, the other one may be where either is predicted. The frame
    does not tell which of them it is.
    """
    measured = [each for each in outcomes if isinstance(each, Measurement)]
    others = {
        each.target: [other.target for other in measured if _share_edge(each, other)]
        for each in measured
    }
    return [
        Miss(each.target, Reason.AMBIGUOUS_PLACE, _shared_words(each, others[each.target]))
        if isinstance(each, Measurement) and others[each.target]
        else each
        for each in outcomes
    ]


def _share_edge(first: Measurement, second: Measurement) -> bool:
    radii_px = first.appearance.radius_px, second.appearance.radius_px
    apart_px = float(np.linalg.norm(first.centre_px - second.centre_px))
    return (
        first.target != second.target
        and apart_px < _SAME_PLACE * min(radii_px)
        and max(radii_px) < _SAME_SIZE * min(radii_px)
    )


def _shared_words(measurement: Measurement, others: Sequence[str]) -> str:
    x, y = measurement.centre_px
    return f"its edge may also be that of {', '.join(others)}; at ({x:.0f}, {y:.0f})"
