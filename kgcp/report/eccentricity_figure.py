"""Figures of the eccentricity of discs: over the viewing angle, and over the frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from kgcp.geometry.camera import Camera
from kgcp.quality.eccentricity import displacement_over_frame, eccentricity_over_angle
from kgcp.report.style import BLUE, GREEN, GREY, VERMILION, Picture, picture, sheet

_COLOURS = (BLUE, VERMILION, GREEN)
_ARROW_SHARE = 0.07  # of the frame's width, that the longest displacement is drawn long
_NOTHING_PX = 1e-6


def draw_eccentricity(camera: Camera, radii_px: Sequence[float]) -> Picture:
    """Draw eccentricity by perspective over the angle, and distortion in the marker over the frame.

    Parameters
    ----------
    radii_px : sequence of float
        Of discs' images, at most three; the last one for the frame.
    """
    with sheet(7.6) as figure:
        above, below = figure.subplots(2, 1, height_ratios=(1.0, 1.3))
        for radius_px, colour in zip(radii_px, _COLOURS, strict=False):
            angles_deg, px = eccentricity_over_angle(camera, radius_px)
            above.plot(angles_deg, px, color=colour, label=f"R = {radius_px:.0f} px")
        above.set_xlabel("angle between normal and viewing ray [deg]")
        above.set_ylabel("eccentricity [px]")
        above.set_ylim(bottom=0.0)
        above.legend()
        _draw_frame(below, camera, radii_px[-1])
        return picture(figure)


def _draw_frame(axes: Axes, camera: Camera, radius_px: float) -> None:
    places, shifts = displacement_over_frame(camera, radius_px)
    largest = float(np.linalg.norm(shifts, axis=1).max())
    scale = largest / (_ARROW_SHARE * camera.width)
    if largest > _NOTHING_PX:
        axes.quiver(
            *places.T,
            *shifts.T,
            color=BLUE,
            angles="xy",
            scale_units="xy",
            scale=scale,
            width=0.004,
        )
    axes.plot(*places.T, ".", color=GREY, markersize=3.0)
    axes.set_xlim(0.0, camera.width)
    axes.set_ylim(camera.height, 0.0)
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set_xlabel(f"distortion within discs of R = {radius_px:.0f} px: longest {largest:.3f} px")
