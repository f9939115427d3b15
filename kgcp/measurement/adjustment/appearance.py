"""What the image looked like at a target, from the fit."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.measurement.adjustment.solver import TargetFit, noise_of
from kgcp.measurement.image_model.blur import variance_in_pixels
from kgcp.measurement.image_model.photometry import (
    Tone,
    apply_tone,
    encoded,
    plateau_levels,
    share_at_level,
    undo_edge_tone,
)
from kgcp.measurement.image_model.window import contour_px, semi_major_axis_px
from kgcp.measurement.records import Appearance, Imaging, ToneBase
from kgcp.targets.layout import Target

TONE_OF_BASE = {ToneBase.SRGB: Tone.UNKNOWN, ToneBase.LINE: Tone.UNKNOWN_OVER_LINE}
"""The tone of a fit, by the base of its tone curve."""
_BASE_OF_TONE = {tone: base for base, tone in TONE_OF_BASE.items()}
_NEAR_EDGE = 0.3  # pixels near an edge have a white share of 0.5 ± this
_LEAST_SHARE, _LEAST_CONTRAST = 1e-3, 0.05  # keep places and quotients finite
_CURVE_POINTS = 400  # at which the tone curve is tabulated


def appearance_of(camera: Camera, target: Target, fit: TargetFit) -> Appearance:
    """Return levels, clipping, blur and edge displacement of a fitted target."""
    problem = fit.sample.problem
    black, white = plateau_levels(fit.parameters.light, problem.tone)
    x, y = fit.prediction.points_m
    inside = x * x + y * y < problem.outer_radius_m**2
    binning, clipped = problem.window.binning, fit.sample.clipped
    blur_px, shift_px = fit.parameters.blur.mean_sd_px, _edge_shift_px(fit)
    if binning > 1:
        blur_px = math.sqrt(variance_in_pixels(blur_px * blur_px, binning))
        shift_px *= binning
    contour = contour_px(camera, fit.parameters.pose, 0.5 * target.ring.outer_diameter_m)
    return Appearance(
        radius_px=semi_major_axis_px(contour),
        black=min(max(black, 0.0), 1.0),
        white=min(max(white, 0.0), problem.brightest),
        saturated=float(np.mean(clipped[inside])),
        edge_shift_px=shift_px,
        blur_px=blur_px,
    )


def _edge_shift_px(fit: TargetFit) -> float:
    """Return the mean displacement of a straight edge towards the dark side.

    The apparent edge is where the grey value passes midway between the plateaus as they are seen,
    clipped. The true edge is where half the light comes from either side.
    """
    return -float(np.mean(places_across_edges_px(fit, None)))


def places_across_edges_px(fit: TargetFit, level: float | None) -> FloatArray:
    """Return where across a straight edge a grey value is reached (n,) [px], towards white.

    In even light there is one place (n = 1), otherwise one for every pixel near an edge.

    Parameters
    ----------
    level : float or None
        Grey value; None: midway between both sides of the edge as they are seen, clipped.
    """
    light, problem, field = fit.parameters.light, fit.sample.problem, fit.parameters.field
    tone, high = problem.tone, problem.brightest
    if field is None:
        black, white = plateau_levels(light, tone)
        wanted = 0.5 * (black + min(white, high)) if level is None else level
        shares = np.array([share_at_level(wanted, light, tone)])
    else:
        off = np.abs(fit.prediction.share - 0.5)
        near = off <= max(_NEAR_EDGE, float(off.min()))
        ink, plate = np.array([[0.0], [1.0]]) + field.added(fit.sample.pixels[:, near])
        lights = np.linspace(float(ink.min()), float(plate.max()), _CURVE_POINTS)
        rising = np.maximum.accumulate(encoded(apply_tone(lights, light.values), tone))
        dark, bright = (np.interp(side, lights, rising) for side in (ink, plate))
        midway = 0.5 * (dark + np.minimum(bright, high))
        reached = np.interp(midway if level is None else level, rising, lights)
        bent = (reached - ink) / np.maximum(plate - ink, _LEAST_CONTRAST)
        shares = undo_edge_tone(np.clip(bent, 0.0, 1.0), light)
    shares = np.clip(shares, _LEAST_SHARE, 1.0 - _LEAST_SHARE)
    return np.asarray(fit.parameters.blur.mean_sd_px * ndtri(shares))


def imaging_of(fit: TargetFit) -> Imaging | None:
    """Return what a fit says of the camera; None if the tone is known, or in bins."""
    problem, light = fit.sample.problem, fit.parameters.light
    if problem.tone not in _BASE_OF_TONE:
        return None
    noise = noise_of(fit.sample, fit.prediction)
    ink, plate = (int(find(fit.prediction.share)) for find in (np.argmin, np.argmax))
    return Imaging(
        base=_BASE_OF_TONE[problem.tone],
        black=light.black,
        white=light.white,
        tone=(light.tone_1, light.tone_2, light.tone_3),
        sharpening=light.sharpening,
        noise_black=float(noise.plateau_sd[ink]),
        noise_white=float(noise.plateau_sd[plate]),
    )
