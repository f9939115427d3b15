"""Residuals around a target at its measured pose: the model's grey values less the frame's."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.acceptance import edge_noise
from kgcp.measurement.adjustment.extensions import fit_in_any_light
from kgcp.measurement.adjustment.fit_target import finer_problem_of, fit_problem_of
from kgcp.measurement.adjustment.masks import first_levels
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.pixels import whole_plate
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.random_levels import needs_varying_levels
from kgcp.measurement.adjustment.solver import predict
from kgcp.measurement.adjustment.unknowns import adjust_with_streak, with_pose
from kgcp.measurement.image_model.blur import Blur, variance_in_bins
from kgcp.measurement.image_model.photometry import Tone, plateau_levels
from kgcp.measurement.image_model.plate import circles_of
from kgcp.targets.layout import Target

_ANGLES = np.linspace(0.0, 2.0 * np.pi, 97)
_UNIT_CIRCLE = np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES)))
_USUAL_BLUR_PX = 0.7
# Share of its largest value below which white is no light. In simulated shadow, dirt and highlights
# it is 0.4 or more; what hides a plate is fitted as light of down to -8.
_LEAST_LIGHT = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class ResidualImage:
    """Residuals around one target, in shares of the contrast between plate and ink."""

    # the first pixel's place in the frame [px]
    x0: int
    y0: int
    # (height, width): model minus grey value; NaN outside the ring and its border of plate
    share: FloatArray
    edge_noise: float  # median residual near edges, without hidden pixels
    # (height, width): the fitted level of white relative to its largest value on the plate; NaN
    # where `share` is, and where it is too low to be light; None: the light is even
    white: FloatArray | None = None

    @property
    def may_be_hidden(self) -> bool:
        """Whether a part of the plate is so dark that something seems to hide it."""
        if self.white is None:
            return False
        return bool(np.any(np.isnan(self.white) & np.isfinite(self.share)))


def residual_image_of(
    grey: GreyArray, camera: Camera, target: Target, pose: Pose, blur_px: float | None
) -> ResidualImage:
    """Return the residuals of the grey values around a target at this pose.

    Blur and light are adjusted; the pose is kept, whichever method it is from. Where the light is
    uneven, it is taken from a fit with a free pose.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame.
    pose : Pose
        Target → camera.
    blur_px : float or None
        Approximate edge spread σ [px]; None: not known.

    Raises
    ------
    Rejection
        As `kgcp.measurement.adjustment.fit_target.measure_by_model`.
    """
    problem = fit_problem_of(grey, camera, target, pose)
    start = Parameters.of(pose, _blur_in_bins(blur_px, problem), first_levels(problem, pose))
    fit = adjust_with_streak(problem, start, moves_pose=False)
    # the test for uneven light needs the covariance of the pose: as if the pose were free
    if needs_varying_levels(replace(fit, unknowns=with_pose(fit.unknowns))):
        is_binned = problem.tone is Tone.BINNED
        if is_binned:  # as in a measurement
            problem = finer_problem_of(grey, camera, target, pose)
        blur = _blur_in_bins(blur_px, problem)
        with contextlib.suppress(Rejection):  # if the code is not seen, the residuals show it
            best = fit_in_any_light(problem, pose, blur).likelier.best
            is_even = best.parameters.field is None and best.sample.problem.burnt_white is None
            fit = fit if is_even and not is_binned else best
    problem = fit.sample.problem  # its tone is the base that an unknown curve was fitted over
    binning = problem.window.binning
    parameters = fit.parameters.at(pose)
    light = parameters.light
    sample = whole_plate(problem, pose, parameters.blur, light)
    black, white = plateau_levels(light, problem.tone)
    limits = problem.censoring
    levels = np.clip(predict(sample, parameters).levels, limits.low, limits.high)
    window = problem.window
    share = np.full(window.width * window.height, np.nan)
    share[sample.index] = (levels - np.clip(sample.levels, limits.low, limits.high)) / (
        min(white, limits.high) - black
    )
    shape = (window.height, window.width)
    white_share = None
    if parameters.field is not None:
        white_share = np.full(len(share), np.nan)
        white_share[sample.index] = 1.0 + parameters.field.added(sample.pixels)[1]
        white_share /= np.nanmax(white_share)
        white_share[white_share < _LEAST_LIGHT] = np.nan

    def of_pixels(values: FloatArray) -> FloatArray:
        return np.asarray(np.kron(values.reshape(shape), np.ones((binning, binning))))

    return ResidualImage(
        x0=binning * window.x0,
        y0=binning * window.y0,
        share=of_pixels(share),
        edge_noise=edge_noise(fit),
        white=None if white_share is None else of_pixels(white_share),
    )


def _blur_in_bins(blur_px: float | None, problem: FitProblem) -> Blur:
    """Return a round blur of an edge spread σ [px], in the window's bins."""
    variance = variance_in_bins((blur_px or _USUAL_BLUR_PX) ** 2, problem.window.binning)
    return Blur(variance, variance, 0.0)


def contours_px(camera: Camera, target: Target, pose: Pose) -> FloatArray:
    """Return the images (c, 97, 2) of all circles of a target as closed curves [px]."""
    circles = circles_of(target.rings)
    on_plate = (
        circles.centres_m.T[:, None, :] + circles.radii_m[:, None, None] * _UNIT_CIRCLE[None, :, :]
    )
    points = pose.transform(on_plate.reshape(-1, 2))
    return camera.project(points).reshape(on_plate.shape)
