"""The measurement: a model of the image fitted to the grey values around all circles.

Started by the closed-form pose of an outline, good to a per cent or so. Both poses of the circle
are adjusted; the one that fits better is reported, the other one kept with how much worse it fits.
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
from kgcp.measurement.adjustment.covariance import ambiguity_cov, pose_covariance, propagate
from kgcp.measurement.adjustment.extensions import (
    UnevenLightInBins,
    fit_in_any_light,
    with_untried_base,
)
from kgcp.measurement.adjustment.problem import FitProblem, apparent_tone
from kgcp.measurement.adjustment.random_levels import even_field, fit_levels
from kgcp.measurement.adjustment.smoothing import contour_smoothing, with_smoothing
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
_SHARP_PX2, _LARGEST_START_BLUR = 0.5, 0.15  # of the radius
_LARGEST_RADIUS_PX = 150.0  # enough for the last digit that calibrations can tell
# All that bins know of a tone curve or of clipping is how far they displace edges, which in uneven
# light is not the same everywhere. Distances of 30 simulated rings of R 150 to 275 px half in
# shade, with dirt, or under highlights were off by up to 0.03 %. So many single pixels, spread over
# them, leave up to 0.0045 %, and take 0.1 to 1.2 s. Compression, too, makes bins seem to be in
# uneven light: 20 of 40 rings of R 150 to 450 px in JPEGs. Still larger rings are seen in bins
# again, which bounds the memory.
_MOST_PIXELS, _LARGEST_UNEVEN_PX = 6000, 450.0
_DOUBTFUL_SIDE = 10.0  # Δχ² of the other pose below which more than this frame is asked
_NOTHING_KNOWN = PlatePrior()
# Enlargement of the covariance by residuals that agree, where levels vary: of 480 simulated plates
# in uneven light, three under highlights have more. One of them was 4.1 σ off.
_UNEXPLAINED = 8.0
_SHARPENING_PX = 1.2  # usual in cameras; 0.7 … 1.7 change little, see docs/method.md


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
        Its normal only helps to choose between the two poses, whose values remain those of the
        image. Its base of the tone curve is the only one that is tried, unless it leads nowhere.
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
    may_be_finer = problem.tone is Tone.OF_BINS  # other bins are as good as single pixels
    problem = replace(problem, visible=visible, may_be_finer=may_be_finer)
    blur = _start_blur(start.blur_px, outlined_px, problem.window.binning)
    try:
        fits = fit_in_any_light(problem, pose, blur, prior.tone_base)
    except UnevenLightInBins:
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
    """Choose between the two poses, and make the measurement of a fit that may be believed."""
    if prior is not None:
        poses = choose_by_prior(poses.best.sample.problem, poses, prior)
    check_fit(poses.best)
    check_code(poses.best)
    measurement = _measurement(camera, target, start, poses, prior)
    check_precision(measurement)
    return measurement


def _outlined_radius_px(start: InitialPose, target: Target) -> float:
    """Return the outer radius of the ring that the start was found by: a replica, perhaps."""
    (outlined,) = (ring for ring in target.rings if ring.name == start.ring)
    return start.radius_px * outlined.outer_diameter_m / target.ring.outer_diameter_m


def _without_edge_shift(start: InitialPose, outlined_px: float) -> Pose:
    """Return the pose that the start would have if the outer edge were not displaced.

    Its distance is from the outer circle alone, of which the radius is short by δ.
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
    """Collect what the adjustment starts from: the main ring, or a replica where that is cut.

    Parameters
    ----------
    rotation : SceneRotation, optional
        Of the scene during the readout; None: `SceneRotation.unknown`.
    largest_radius_px : float
        Of a larger ring, squares of pixels are taken together in bins, such that none is left.
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
    """Do what `fit_problem_of` does, for uneven light: on smaller bins, or some single pixels."""
    finer = fit_problem_of(grey, camera, target, pose, rotation, _LARGEST_UNEVEN_PX)
    return replace(finer, most_pixels=_MOST_PIXELS)


def _measured_count(camera: Camera, target: Target, contour: FloatArray) -> int:
    """Return how many of a target's circles are measured: the main ring's, or all if it is cut.

    A whole main ring, which has this contour, leaves its replicas little to add to the distance, at
    twice the time.
    """
    (left, top), (right, bottom) = contour.min(axis=0), contour.max(axis=0)
    whole = min(left, top) > 0.0 and right < camera.width - 1.0 and bottom < camera.height - 1.0
    rings = (target.ring,) if whole else target.rings
    return sum(2 + len(ring.code_deg) for ring in rings)


def _start_blur(blur_px: float, outlined_px: float, binning: int) -> Blur:
    """Return the blur that the start has seen, in bins; that of a sharp frame at least."""
    seen_px = min(blur_px, _LARGEST_START_BLUR * outlined_px)
    variance = variance_in_bins(max(_SHARP_PX2, seen_px * seen_px), binning)
    return Blur(variance, variance, 0.0)


def _measurement(
    camera: Camera,
    target: Target,
    start: InitialPose,
    poses: TwoPoses,
    prior: NormalPrior | None,
) -> Measurement:
    best, other = poses.best, poses.other
    pose = best.parameters.pose
    covariance = pose_covariance(best)
    ambiguity = max(0.0, advantage(poses, covariance, prior))
    pose_cov = covariance.pose_cov.copy()
    pose_cov[:3, :3] += ambiguity_cov(pose, other.parameters.pose, ambiguity)
    if best.level_equations is not None and covariance.inflation > _UNEXPLAINED:
        pose_cov[:3, :3] += _spread_over_starts(best)
    of_other = pose_covariance(other).pose_cov if ambiguity < _DOUBTFUL_SIDE else None
    measurement = Measurement(
        target=target.name,
        ring=start.ring,
        instance=0,
        score=start.score,
        pose=pose,
        centre_px=camera.project(pose.translation_m[None])[0],
        heading_deg=image_heading_deg(camera, pose),
        appearance=appearance_of(camera, target, best),
        imaging=imaging_of(best),
        alternative=Alternative(other.parameters.pose, ambiguity, of_other),
        uncertainty=propagate(camera, pose, pose_cov),
        smoothing=contour_smoothing(best, covariance.inflation),
    )
    return with_smoothing(camera, measurement)


def _spread_over_starts(best: TargetFit) -> FloatArray:
    """Return what another start adds to the covariance of the translation (3, 3) [m²].

    Where the levels do not explain the light, it decides where the fit comes to rest. The other one
    is even light.

    Raises
    ------
    Rejection
        If that leads nowhere: then nothing tells how far off the pose may be.
    """
    problem, pose = best.sample.problem, best.parameters.pose
    even = replace(best.parameters, field=even_field(problem))
    again = fit_levels(problem, [even], best.unknowns)
    apart_m = again.parameters.pose.translation_m - pose.translation_m
    return np.asarray(np.outer(apart_m, apart_m))
