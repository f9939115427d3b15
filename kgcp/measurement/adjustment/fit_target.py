"""The measurement: a model of the image is fitted to the grey values around all circles.

It starts from the closed-form pose of an outline, good to a per cent or so. Both poses of the
circle are adjusted. The one that fits better is reported; the other one is kept, with how much
worse it fits.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.measurement.adjustment.acceptance import check_code, check_fit, check_precision
from kgcp.measurement.adjustment.appearance import appearance_of, imaging_of
from kgcp.measurement.adjustment.covariance import (
    PoseCovariance,
    ambiguity_cov,
    pose_covariance,
    propagate,
)
from kgcp.measurement.adjustment.extensions import (
    BinsAreTooCoarse,
    fit_in_any_light,
    with_untried_base,
)
from kgcp.measurement.adjustment.problem import FitProblem, apparent_tone
from kgcp.measurement.adjustment.random_levels import even_field, fit_levels
from kgcp.measurement.adjustment.smoothing import (
    contour_smoothing,
    growth_of_print,
    with_smoothing,
)
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.adjustment.two_poses import (
    TwoPoses,
    advantage,
    choose_by_prior,
)
from kgcp.measurement.image_model.blur import Blur, variance_in_bins
from kgcp.measurement.image_model.noise import find_censoring
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.plate import circles_of
from kgcp.measurement.image_model.rolling_shutter import RollingShutter
from kgcp.measurement.image_model.window import contour_px, cut_window, semi_major_axis_px
from kgcp.measurement.plate_prior import NormalPrior, PlatePrior, SceneRotation
from kgcp.measurement.records import Alternative, InitialPose, Measurement, RivalTone
from kgcp.targets.layout import Target

_MARGIN_PX = 12.0
# Start of the blur: at least that of a sharp frame [px²], at most this share of the radius.
_SHARP_PX2, _LARGEST_START_BLUR = 0.5, 0.15
_LARGEST_RADIUS_PX = 150.0  # enough for the last digit that calibrations can tell
# All that a bin shows of a tone curve or of clipping is how far they displace an edge. In uneven
# light that is not the same along a circle: in bins, distances of 30 simulated rings of R 150 to
# 275 px, half in shade, with dirt or under highlights, were off by up to 0.03 %. So single pixels
# are adjusted there instead, this many, spread over the ring: distances are off by up to 0.0045 %,
# in 0.1 to 1.2 s. Compression makes the light in bins seem uneven, too: on 20 of 40 rings of R 150
# to 450 px in JPEGs. Rings above the second limit are binned again, which bounds the memory.
_MOST_PIXELS, _LARGEST_UNEVEN_PX = 6000, 450.0
# Below this ambiguity (Δχ² of the other pose), other frames may choose the other pose: so it gets a
# covariance, too.
_DOUBTFUL_AMBIGUITY = 10.0
_NOTHING_KNOWN = PlatePrior()
# Where levels vary, a larger inflation of the covariance says that they do not explain the light.
# Of 480 simulated plates in uneven light, three have more, all under highlights; one of them was
# 4.1 σ off.
_UNEXPLAINED_INFLATION = 8.0
# usual in cameras; 0.7 to 1.7 change little (docs/method/image_model.md, "Light")
_SHARPENING_PX = 1.2


def measure_by_model(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    start: InitialPose,
    prior: PlatePrior = _NOTHING_KNOWN,
    visible: BoolArray | None = None,
) -> Measurement:
    """Measure a target that the search has found.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame.
    target : Target
        Its layout.
    prior : PlatePrior, optional
        Its normal only helps to choose between the two poses; their values are from the image
        alone. Its base of the tone curve is the only one that is tried, unless that fit fails.
    visible : (m,) array of bool, optional
        Where the target is seen, in equal steps about its normal from its +x axis on.

    Raises
    ------
    Rejection
        `CUT`, `EDGES_LOST`, `NO_CONTRAST`, `POOR_FIT` or `OTHER_CODE`.
    """
    outlined_px = _outlined_radius_px(start, target)
    pose = _without_edge_shift(start, outlined_px)
    problem = fit_problem_of(grey, camera, target, pose, prior.rotation)
    may_be_finer = problem.tone is Tone.BINNED  # other bins are as good as single pixels
    problem = replace(problem, visible=visible, may_be_finer=may_be_finer)
    blur = _start_blur(start.blur_px, outlined_px, problem.window.binning)
    try:
        fits = fit_in_any_light(problem, pose, blur, prior.tone_base)
    except BinsAreTooCoarse:
        finer = finer_problem_of(grey, camera, target, pose, prior.rotation)
        problem = replace(finer, visible=visible)
        blur = _start_blur(start.blur_px, outlined_px, problem.window.binning)
        fits = fit_in_any_light(problem, pose, blur, prior.tone_base)
    try:
        measurement = _checked(camera, target, start, fits.likelier, prior.normal)
    except Rejection:
        if fits.untried_base is None:
            raise
        fits = with_untried_base(fits, pose, blur)
        measurement = _checked(camera, target, start, fits.likelier, prior.normal)
    if fits.rival is not None:
        with contextlib.suppress(Rejection):  # then the likelier one has no rival
            rival = _checked(camera, target, start, fits.rival, prior.normal)
            measurement = replace(measurement, rival=RivalTone(rival, fits.advantage))
    return measurement


def _checked(
    camera: Camera,
    target: Target,
    start: InitialPose,
    poses: TwoPoses,
    prior: NormalPrior | None,
) -> Measurement:
    """Choose between the two poses, test the fit, and make the measurement."""
    covariance = None
    if prior is not None:
        poses, covariance = choose_by_prior(poses.best.sample.problem, poses, prior)
    check_fit(poses.best)
    check_code(poses.best)
    covariance = covariance or pose_covariance(poses.best)
    measurement = _measurement(camera, target, start, poses, covariance, prior)
    check_precision(measurement)
    return measurement


def _outlined_radius_px(start: InitialPose, target: Target) -> float:
    """Return the outer radius of the ring that the search has found, which may be a replica."""
    (outlined,) = (ring for ring in target.rings if ring.name == start.ring)
    return start.radius_px * outlined.outer_diameter_m / target.ring.outer_diameter_m


def _without_edge_shift(start: InitialPose, outlined_px: float) -> Pose:
    """Return the start pose, corrected for the displacement δ of the outer edge.

    The start's distance is from the outer circle alone, whose radius is too small by δ.
    """
    shrink = outlined_px / (outlined_px + start.edge_shift_px)
    return Pose(start.pose.rotation, shrink * start.pose.translation_m)


def fit_problem_of(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    pose: Pose,
    rotation: SceneRotation | None = None,
    largest_radius_px: float = _LARGEST_RADIUS_PX,
) -> FitProblem:
    """Collect what is adjusted: the main ring, or a replica where the main ring is cut.

    Parameters
    ----------
    rotation : SceneRotation, optional
        Of the scene during the readout; None: `SceneRotation.unknown`.
    largest_radius_px : float
        Pixels of a larger ring are averaged in square bins, so that its radius is at most this
        many bins.
    """
    count = 0
    for ring in target.rings:
        radius_m = 0.5 * ring.outer_diameter_m
        contour, seen = contour_px(camera, pose, radius_m), camera
        count = count or _measured_count(camera, target, contour)
        size_px = semi_major_axis_px(contour)
        binning = max(1, math.ceil(size_px / largest_radius_px))
        if binning > 1:
            seen = camera.binned(binning)
            contour = contour_px(seen, pose, radius_m)
            size_px = semi_major_axis_px(contour)
        try:
            window = cut_window(grey, seen, contour, _MARGIN_PX, binning)
        except Rejection as rejection:
            cut = rejection.reason, rejection.detail
            continue
        is_plain = binning > 1 or camera.response is Response.LINEAR
        centre_px = seen.project(pose.translation_m[None])[0]
        shutter = None
        if camera.readout_s:
            rows = window.pixels(np.arange(len(window.levels)))[1]
            shutter = RollingShutter.of(
                seen, rows, centre_px[1], rotation or SceneRotation.unknown(camera)
            )
            window = replace(window, rays=shutter.rays_at_one_moment(window.rays))
        return FitProblem(
            window=window,
            ring=target.ring,
            circles=circles_of(target.rings),
            measured_count=count,
            outer_radius_m=radius_m,
            outer_radius_px=size_px,
            centre_px=centre_px,
            focal_px=seen.mean_focal_px,
            censoring=find_censoring(window.levels, window.levels_per_count, window.width),
            tone=apparent_tone(camera.response, window, size_px),
            sharpening_px=0.0 if is_plain else _SHARPENING_PX,
            shutter=shutter,
        )
    raise Rejection(*cut)


def finer_problem_of(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    pose: Pose,
    rotation: SceneRotation | None = None,
) -> FitProblem:
    """Do what `fit_problem_of` does, with smaller bins or some single pixels, for uneven light."""
    finer = fit_problem_of(grey, camera, target, pose, rotation, _LARGEST_UNEVEN_PX)
    return replace(finer, most_pixels=_MOST_PIXELS)


def _measured_count(camera: Camera, target: Target, contour: FloatArray) -> int:
    """Return how many of a target's circles are measured: the main ring's, or all if it is cut.

    While the main ring is whole, its replicas add little to the distance, at twice the time.
    `contour` is that of the main ring.
    """
    (left, top), (right, bottom) = contour.min(axis=0), contour.max(axis=0)
    is_whole = min(left, top) > 0.0 and right < camera.width - 1.0 and bottom < camera.height - 1.0
    rings = (target.ring,) if is_whole else target.rings
    return sum(2 + len(ring.code_deg) for ring in rings)


def _start_blur(blur_px: float, outlined_px: float, binning: int) -> Blur:
    """Return the blur that the search has found, in bins; at least that of a sharp frame."""
    seen_px = min(blur_px, _LARGEST_START_BLUR * outlined_px)
    variance = variance_in_bins(max(_SHARP_PX2, seen_px * seen_px), binning)
    return Blur(variance, variance, 0.0)


def _measurement(
    camera: Camera,
    target: Target,
    start: InitialPose,
    poses: TwoPoses,
    covariance: PoseCovariance,
    prior: NormalPrior | None,
) -> Measurement:
    """Make the measurement; `covariance` is that of the better pose."""
    best, other = poses.best, poses.other
    pose = best.parameters.pose
    ambiguity = max(0.0, advantage(poses, covariance, prior))
    pose_cov = covariance.pose_cov.copy()
    pose_cov[:3, :3] += ambiguity_cov(pose, other.parameters.pose, ambiguity)
    if best.level_equations is not None and covariance.inflation > _UNEXPLAINED_INFLATION:
        pose_cov[:3, :3] += _spread_over_starts(best)
    other_cov = pose_covariance(other).pose_cov if ambiguity < _DOUBTFUL_AMBIGUITY else None
    inner_growth, dots_growth = growth_of_print(best)
    measurement = Measurement(
        target=target.name,
        ring=start.ring,
        instance=0,
        score=start.score,
        pose=pose,
        centre_px=camera.project(pose.translation_m[None])[0],
        heading_deg=image_heading_deg(camera, pose),
        appearance=replace(
            appearance_of(camera, target, best),
            inner_growth=inner_growth,
            dots_growth=dots_growth,
        ),
        imaging=imaging_of(best),
        alternative=Alternative(other.parameters.pose, ambiguity, other_cov),
        uncertainty=propagate(camera, pose, pose_cov),
        smoothing=contour_smoothing(best, covariance.inflation),
    )
    return with_smoothing(camera, measurement)


def _spread_over_starts(best: TargetFit) -> FloatArray:
    """Return what another start adds to the covariance of the translation (3, 3) [m²].

    Where the levels do not explain the light, the result depends on the start. So the fit is
    repeated from even light, and the difference counts as a deviation.

    Raises
    ------
    Rejection
        If that fit fails: then nothing tells how far off the pose may be.
    """
    problem, pose = best.sample.problem, best.parameters.pose
    even = replace(best.parameters, field=even_field(problem))
    again = fit_levels(problem, [even], best.unknowns)
    apart_m = again.parameters.pose.translation_m - pose.translation_m
    return np.asarray(np.outer(apart_m, apart_m))
