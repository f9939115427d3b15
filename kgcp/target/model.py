"""The measurement: a model of the image fitted to the grey values around all circles.

Started by the closed-form pose of an outline, good to a per cent or so. Both poses of the circle
are adjusted; the one that fits better is reported, the other one kept with how much worse it fits.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.target.adjust import Fit, adjust, approach, minimise, predict
from kgcp.target.appearance import appearance_of
from kgcp.target.covariance import PoseCovariance, pose_covariance, propagate
from kgcp.target.foreign import first_levels
from kgcp.target.imaging import Imaging
from kgcp.target.layout import Target
from kgcp.target.light import Parameters
from kgcp.target.noise import BoolArray, find_censoring, misfit
from kgcp.target.nuisance import adjust_with_streak, unknowns_of
from kgcp.target.observation import Alternative, Observation
from kgcp.target.pairs import Blur
from kgcp.target.plate import circles_of
from kgcp.target.prior import NormalPrior
from kgcp.target.sample import choose_sample
from kgcp.target.verify import check_code, check_fit, check_precision, edge_noise
from kgcp.target.window import contour_px, cut_window, semi_major_axis_px

_MARGIN_PX = 12.0
_SHARP_PX2, _LARGEST_START_BLUR = 0.5, 0.15  # of the radius
_START_SLACK_PX = 1.5
_SHARPENING_PX = 1.2  # usual in cameras; 0.7 … 1.7 change little, see docs/method.md
_HALF_SHARPENED, _NARROWED = 0.25, 1.12  # strength, and blur as a share of what seems to be
_DOUBTFUL_EDGE_NOISE = 0.07  # of the contrast: more than a true pose leaves in most frames
_SPILT_PX = (0.7, 1.4, -0.7)  # by which edges may be displaced beyond what the start says
_MIRRORED_STEPS, _MIRRORED_GAIN = (1, 5), 0.5
_HOPELESS, _UNLIKELY = 200.0, 40.0  # of log-likelihood: so bad a mirrored pose is fitted no better


@dataclass(frozen=True, slots=True, eq=False)
class TwoPoses:
    """The two poses of a circle, adjusted.

    Attributes
    ----------
    best, other : Fit
        The better and the worse one, on the same pixels with the same noise.
    """

    best: Fit
    other: Fit


def measure_by_model(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    start: Observation,
    prior: NormalPrior | None = None,
    visible: BoolArray | None = None,
) -> Observation:
    """Measure a target that the search has found.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame.
    camera : Camera
    target : Target
        Its layout.
    start : Observation
        By `kgcp.target.start`.
    prior : NormalPrior, optional
        Of the plate's normal. It only helps to choose between the two poses, whose values remain
        those of the image.
    visible : (m,) array of bool, optional
        Where the target is seen, in equal steps about its normal from its +x axis on.

    Raises
    ------
    Rejection
        `CUT`, `EDGES_LOST`, `NO_CONTRAST`, `POOR_FIT` or `OTHER_CODE`.
    """
    pose = _without_edge_shift(start)
    imaging = replace(imaging_of(grey, camera, target, pose), visible=visible)
    poses = fit_both_poses(imaging, pose, _start_blur(start))
    if prior is not None:
        poses = _choose_by_prior(imaging, poses, prior)
    check_fit(poses.best)
    check_code(poses.best, target.ring)
    observation = _observation(camera, target, start, poses, prior)
    check_precision(observation)
    return observation


def _without_edge_shift(start: Observation) -> Pose:
    """Return the pose that the start would have if the outer edge were not displaced.

    Its distance is from the outer circle alone, of which the radius is short by δ.
    """
    radius_px = start.appearance.radius_px
    shrink = radius_px / (radius_px + (start.appearance.edge_shift_px or 0.0))
    return Pose(start.pose.rotation, shrink * start.pose.translation_m)


def imaging_of(grey: GreyArray, camera: Camera, target: Target, pose: Pose) -> Imaging:
    """Collect what the adjustment starts from: the main ring, or a replica where that is cut."""
    for ring in target.rings:
        radius_m = 0.5 * ring.outer_diameter_m
        contour = contour_px(camera, pose, radius_m)
        try:
            window = cut_window(grey, camera, contour, _MARGIN_PX)
        except Rejection as rejection:
            cut = rejection
            continue
        return Imaging(
            window=window,
            circles=circles_of(target.rings),
            measured_count=_measured_count(camera, target, pose),
            outer_radius_m=radius_m,
            outer_radius_px=semi_major_axis_px(contour),
            centre_px=camera.project(pose.translation_m[None])[0],
            focal_px=camera.mean_focal_px,
            censoring=find_censoring(window.levels, window.levels_per_count),
            response=camera.response,
            sharpening_px=0.0 if camera.response is Response.LINEAR else _SHARPENING_PX,
        )
    raise cut


def _measured_count(camera: Camera, target: Target, pose: Pose) -> int:
    """Return how many of a target's circles are measured: the main ring's, or all if it is cut.

    A whole main ring leaves its replicas little to add to the distance, at twice the time.
    """
    contour = contour_px(camera, pose, 0.5 * target.ring.outer_diameter_m)
    whole = np.all((contour > 0.0) & (contour < (camera.width - 1.0, camera.height - 1.0)))
    rings = (target.ring,) if whole else target.rings
    return sum(2 + len(ring.code_deg) for ring in rings)


def _start_blur(start: Observation) -> Blur:
    """Return the blur that the start has seen; that of a sharp frame at least."""
    appearance = start.appearance
    seen_px = min(appearance.blur_px or 0.0, _LARGEST_START_BLUR * appearance.radius_px)
    variance = max(_SHARP_PX2, seen_px * seen_px)
    return Blur(variance, variance, 0.0)


def fit_both_poses(imaging: Imaging, pose: Pose, blur: Blur) -> TwoPoses:
    """Adjust the better one of a start pose and its mirror image about the ray, then the other."""
    rough = _rough_fit(imaging, pose, blur)
    other = _mirrored_fit(rough, _UNLIKELY)
    near, far = (other, rough) if other.total < rough.total else (rough, other)
    best = adjust_with_streak(imaging, _with_sharpening(imaging, near.parameters))
    other = _fit_at(best, far.parameters.pose)
    if other.total < best.total:
        best = adjust(imaging, other.parameters, best.unknowns)
        other = _mirrored_fit(best)
    return TwoPoses(best, other) if best.total <= other.total else TwoPoses(other, best)


def _with_sharpening(imaging: Imaging, parameters: Parameters) -> Parameters:
    """Go half the way to what usual sharpening does, if there may be any: it was left out."""
    if not imaging.sharpening_px:
        return parameters
    light = replace(parameters.light, sharpening=_HALF_SHARPENED)
    return Parameters(parameters.pose, parameters.blur.scaled(_NARROWED), light)


def _rough_fit(imaging: Imaging, pose: Pose, blur: Blur) -> Fit:
    """Come near the minimum; from other distances if there is none near the start pose.

    Where the plate is burnt white its light spills over the edges, and the start may be far off.
    """
    rough = _approach(imaging, pose, blur)
    for shift_px in _SPILT_PX:
        if edge_noise(rough) <= _DOUBTFUL_EDGE_NOISE:
            break
        closer = imaging.outer_radius_px / (imaging.outer_radius_px + shift_px)
        with contextlib.suppress(Rejection):
            other = _approach(imaging, Pose(pose.rotation, closer * pose.translation_m), blur)
            rough = min(rough, other, key=edge_noise)
    return rough


def _approach(imaging: Imaging, pose: Pose, blur: Blur) -> Fit:
    """Fit few pixels, without an unsharp mask: that would need all, and displaces little."""
    light = first_levels(imaging, pose)
    plain = replace(imaging, sharpening_px=0.0)
    few = plain.few_pixels
    sample = choose_sample(plain, pose, blur, light, most=few, slack_px=_START_SLACK_PX)
    unknowns = unknowns_of(imaging.response, has_streak=False)
    return approach(sample, Parameters(pose, blur, light), unknowns)


def _choose_by_prior(imaging: Imaging, poses: TwoPoses, prior: NormalPrior) -> TwoPoses:
    """Let the poses change places where the prior outweighs the image; adjust the new best one."""
    if _advantage(poses, pose_covariance(poses.best), prior) >= 0.0:
        return poses
    best = adjust(imaging, poses.other.parameters, poses.best.unknowns)
    turned = TwoPoses(best, _mirrored_fit(best))
    is_better = _advantage(turned, pose_covariance(best), prior) >= 0.0
    return turned if is_better else poses


def _advantage(poses: TwoPoses, covariance: PoseCovariance, prior: NormalPrior | None) -> float:
    """Return the Δχ² by which the other pose is worse: of the image, and of the prior.

    That of the image counts as much as its residuals are independent; both normals are known
    about equally well.
    """
    best, other = poses.best, poses.other
    of_image = 2.0 * (other.total - best.total) / covariance.inflation
    if prior is None:
        return of_image
    rotation_cov = covariance.pose_cov[3:, 3:]
    worse, better = (prior.chi2(fit.parameters.pose, rotation_cov) for fit in (other, best))
    return of_image + worse - better


def _mirrored_fit(fit: Fit, hopeless: float = _HOPELESS) -> Fit:
    parameters = fit.parameters
    mirrored = Parameters(parameters.pose.mirrored(), parameters.blur, parameters.light)
    linear = None
    for steps in _MIRRORED_STEPS:
        other = minimise(
            fit.sample,
            mirrored,
            fit.sd,
            fit.unknowns,
            steps=steps,
            enough=_MIRRORED_GAIN,
            linear=linear,
        )
        if other.total - fit.total > hopeless:
            break
        mirrored, linear = other.parameters, (other.prediction, other.jacobian)
    return other


def _fit_at(fit: Fit, pose: Pose) -> Fit:
    """Fit another pose to the pixels of a fit, unless it is hopeless."""
    parameters = Parameters(pose, fit.parameters.blur, fit.parameters.light)
    prediction = predict(fit.sample, parameters)
    current = misfit(fit.sample.levels, prediction.levels, fit.sd, fit.sample.censoring)
    there = replace(fit, parameters=parameters, prediction=prediction, misfit=current)
    if there.total - fit.total > _HOPELESS:
        return there
    steps = _MIRRORED_STEPS[-1]
    return minimise(
        fit.sample, parameters, fit.sd, fit.unknowns, steps=steps, enough=_MIRRORED_GAIN
    )


def _observation(
    camera: Camera,
    target: Target,
    start: Observation,
    poses: TwoPoses,
    prior: NormalPrior | None,
) -> Observation:
    best, other = poses.best, poses.other
    pose = best.parameters.pose
    covariance = pose_covariance(best)
    ambiguity = max(0.0, _advantage(poses, covariance, prior))
    return Observation(
        target=target.name,
        ring=start.ring,
        instance=start.instance,
        score=start.score,
        pose=pose,
        centre_px=camera.project(pose.translation_m[None])[0],
        heading_deg=image_heading_deg(camera, pose),
        appearance=appearance_of(camera, target, best),
        alternative=Alternative(other.parameters.pose, ambiguity),
        uncertainty=propagate(camera, pose, covariance.pose_cov),
    )
