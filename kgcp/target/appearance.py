"""What the image looked like at a target, from the fit."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from kgcp.geometry.camera import Camera
from kgcp.target.adjust import Fit
from kgcp.target.layout import Target
from kgcp.target.light import Light
from kgcp.target.observation import Appearance
from kgcp.target.pairs import Blur
from kgcp.target.window import semi_major_axis_px


def appearance_of(camera: Camera, target: Target, fit: Fit) -> Appearance:
    """Return levels, clipping, blur and edge displacement of a fitted target."""
    light, blur = fit.parameters.light, fit.parameters.blur
    imaging = fit.sample.imaging
    inside = np.hypot(*fit.prediction.view.points_m) < imaging.outer_radius_m
    clipped = fit.sample.censoring.at_high | fit.sample.censoring.at_low
    return Appearance(
        radius_px=semi_major_axis_px(
            camera, fit.parameters.pose, 0.5 * target.ring.outer_diameter_m
        ),
        black=float(np.clip(light.black, 0.0, 1.0)),
        white=float(np.clip(light.white, 0.0, 1.0)),
        saturated=float(np.mean(clipped[inside])),
        edge_shift_px=_edge_shift_px(light, blur, fit.sample.imaging.censoring.high),
        blur_px=blur.mean_sd_px,
    )


def _edge_shift_px(light: Light, blur: Blur, clip: float) -> float:
    """Return how far a straight edge seems displaced towards the dark side.

    The apparent edge is where the grey value passes midway between the plateaus as they are seen,
    clipped; the true one is where half the light comes from either side.
    """
    share = np.linspace(0.0, 1.0, 401)
    arch = share * (1.0 - share)
    tone = share + arch * (light.tone_1 + light.tone_2 * (2.0 * share - 1.0))
    grey = np.minimum(light.black + (light.white - light.black) * tone, clip)
    middle = 0.5 * (grey[0] + grey[-1])
    crossing = float(np.interp(middle, np.maximum.accumulate(grey), share))
    return float(-blur.mean_sd_px * ndtri(np.clip(crossing, 1e-3, 1.0 - 1e-3)))
