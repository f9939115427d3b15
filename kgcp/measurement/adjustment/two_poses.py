"""The two poses that explain a circle's image, adjusted one after the other.

The start is first fitted roughly, on few pixels, and so is its mirror image about the viewing ray.
The better one of the two is then adjusted on all pixels, and the other one after it.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace

from kgcp.errors import Rejection
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.acceptance import edge_noise
from kgcp.measurement.adjustment.covariance import PoseCovariance, pose_covariance
from kgcp.measurement.adjustment.masks import first_levels
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.pixels import select_pixels
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.solver import TargetFit, adjust, approach, minimise, moved_to
from kgcp.measurement.adjustment.unknowns import adjust_with_streak, unknowns_of
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.plate_prior import NormalPrior

_START_SLACK_PX = 1.5
# Start of the sharpening: half of the usual strength, and the blur that goes with it, relative to
# the blur of a fit without sharpening
_HALF_SHARPENED, _WIDENED = 0.25, 1.12
_DOUBTFUL_EDGE_NOISE = 0.12  # of the contrast: more than a true pose leaves in most frames
_SPILT_PX = (0.7, 1.4, -0.7)  # tried displacements of the outer edge beyond that of the start
# Tilts, by how much they shorten the semi-minor axis
_SLIGHT_TILT_PX, _TRIED_TILT_PX, _ACROSS_STEPS = 0.06, 0.2, 6
_MIRRORED_STEPS, _MIRRORED_GAIN = (1, 5), 0.5
# A mirrored pose that is worse by so much log-likelihood after one step is not fitted any better:
# after the rough fit (the second), and later. Before that step, blur, tone and distance are those
# of other pixels, and it may seem worse by more (the third): with 200 there, too, a ring of R 25 px
# out of focus kept a normal that was wrong by 18°, although the right one was likelier by 45.
_HOPELESS, _ROUGHLY_HOPELESS, _HOPELESS_UNADJUSTED = 200.0, 40.0, 2000.0


@dataclass(frozen=True, slots=True, eq=False)
class TwoPoses:
    """The two poses of a circle, adjusted."""

    # the better and the worse one, on the same pixels with the same noise
    best: TargetFit
    other: TargetFit


def fit_both_poses(problem: FitProblem, pose: Pose, blur: Blur) -> TwoPoses:
    """Adjust the better of a start pose and its mirror image about the ray, then the other one."""
    rough = _off_the_saddle(_rough_fit(problem, pose, blur))
    other = _mirrored_fit(rough, _ROUGHLY_HOPELESS)
    near, far = (other, rough) if other.total < rough.total else (rough, other)
    best = adjust_with_streak(problem, _with_sharpening(problem, near.parameters))
    other = fit_at(best, far.parameters.pose)
    if other.total < best.total:
        best = adjust(problem, other.parameters, best.unknowns)
        other = _mirrored_fit(best)
    return TwoPoses(best, other) if best.total <= other.total else TwoPoses(other, best)


def _off_the_saddle(rough: TargetFit) -> TargetFit:
    """Try a tilt about the perpendicular axis, if the tilt that was found is slight.

    A start that is tilted the wrong way ends near the tilt of 0. The gradient vanishes there, and
    nothing pulls it to the right tilt.
    """
    parameters, radius_px = rough.parameters, rough.sample.problem.outer_radius_px
    pose = parameters.pose
    if radius_px * (1.0 - pose.normal @ pose.translation_m / pose.distance_m) > _SLIGHT_TILT_PX:
        return rough
    turned = pose.tilted_across(math.acos(max(0.0, 1.0 - _TRIED_TILT_PX / radius_px)))
    other = minimise(
        rough.sample,
        parameters.at(turned),
        rough.sd,
        rough.unknowns,
        steps=_ACROSS_STEPS,
        least_gain=_MIRRORED_GAIN,
    )
    return other if other.total < rough.total else rough


def _with_sharpening(problem: FitProblem, parameters: Parameters) -> Parameters:
    """Start from half of the usual sharpening, which rough fits leave out, if there may be any."""
    if not problem.sharpening_px:
        return parameters
    light = replace(parameters.light, sharpening=_HALF_SHARPENED)
    return Parameters.of(parameters.pose, parameters.blur.scaled(_WIDENED), light)


def _rough_fit(problem: FitProblem, pose: Pose, blur: Blur) -> TargetFit:
    """Fit roughly; from other distances, too, if the fit from the start pose is poor.

    The light of a burnt plate spills over the edges, so that the start may be far off.
    """
    rough = _approach(problem, pose, blur)
    for shift_px in _SPILT_PX:
        if edge_noise(rough) <= _DOUBTFUL_EDGE_NOISE:
            break
        closer = problem.outer_radius_px / (problem.outer_radius_px + shift_px)
        with contextlib.suppress(Rejection):
            other = _approach(problem, Pose(pose.rotation, closer * pose.translation_m), blur)
            rough = min(rough, other, key=edge_noise)
    return rough


def _approach(problem: FitProblem, pose: Pose, blur: Blur) -> TargetFit:
    """Fit few pixels, without sharpening: that would need all pixels, and displaces little."""
    light = first_levels(problem, pose)
    plain = replace(problem, sharpening_px=0.0)
    few = plain.few_pixels
    sample = select_pixels(plain, pose, blur, light, max_pixels=few, slack_px=_START_SLACK_PX)
    unknowns = unknowns_of(problem, has_streak=False)
    return approach(sample, Parameters.of(pose, blur, light), unknowns)


def choose_by_prior(
    problem: FitProblem, poses: TwoPoses, prior: NormalPrior
) -> tuple[TwoPoses, PoseCovariance]:
    """Exchange the poses if the prior outweighs the image, and adjust the new best one.

    Returns
    -------
    TwoPoses, PoseCovariance
        The covariance is that of the best one.
    """
    covariance = pose_covariance(poses.best)
    if advantage(poses, covariance, prior) >= 0.0:
        return poses, covariance
    if poses.best.level_equations is None:
        best = adjust(problem, poses.other.parameters, poses.best.unknowns)
        turned = TwoPoses(best, _mirrored_fit(best))
    else:
        turned = TwoPoses(poses.other, poses.best)
    turned_covariance = pose_covariance(turned.best)
    if advantage(turned, turned_covariance, prior) >= 0.0:
        return turned, turned_covariance
    return poses, covariance


def advantage(poses: TwoPoses, covariance: PoseCovariance, prior: NormalPrior | None) -> float:
    """Return the Δχ² by which the other pose is worse: that of the image plus that of the prior.

    The Δχ² of the image is divided by the inflation of the covariance, since correlated residuals
    count less. Where levels vary, it is divided by it once more: what they leave is correlated over
    whole edges, as the difference of both poses is. Both normals are taken to have the covariance
    of the better pose.
    """
    best, other = poses.best, poses.other
    of_image = 2.0 * (other.total - best.total) / covariance.inflation
    if best.level_equations is not None:
        of_image /= covariance.inflation
    if prior is None:
        return of_image
    rotation_cov = covariance.pose_cov[3:, 3:]
    return of_image + prior.preference(best.parameters.pose, other.parameters.pose, rotation_cov)


def _mirrored_fit(fit: TargetFit, hopeless: float = _HOPELESS) -> TargetFit:
    """Fit from the mirrored pose; a fit that is hopeless after the first step ends there."""
    parameters = fit.parameters
    return _fit_from(fit, parameters.at(parameters.pose.mirrored()), hopeless)


def _fit_from(fit: TargetFit, parameters: Parameters, hopeless: float) -> TargetFit:
    """Fit from other parameters to the pixels of a fit; one step, if that is hopeless then."""
    linear = None
    for steps in _MIRRORED_STEPS:
        other = minimise(
            fit.sample,
            parameters,
            fit.sd,
            fit.unknowns,
            steps=steps,
            least_gain=_MIRRORED_GAIN,
            linear=linear,
        )
        if other.total - fit.total > hopeless:
            break
        parameters, linear = other.parameters, (other.prediction, other.jacobian)
    return other


def fit_at(fit: TargetFit, pose: Pose) -> TargetFit:
    """Fit another pose to the pixels of a fit; if that is hopeless, return it as it is."""
    unadjusted = moved_to(fit, pose)
    if unadjusted.total - fit.total > _HOPELESS_UNADJUSTED:
        return unadjusted
    return _fit_from(fit, unadjusted.parameters, _HOPELESS)
