"""What the flight says of its camera: the tone curve with a band, and noise by grey value."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes

from kgcp.measurement.image_model.srgb import srgb_decoded
from kgcp.measurement.records import ToneBase
from kgcp.quality.learnt_imaging import LearntImaging
from kgcp.quality.number_text import minus
from kgcp.report.style import BLUE, GREY, VERMILION, Picture, picture, sheet

_FULL_SCALE = 255.0
_BINS, _FEWEST_OF_BIN = 8, 3
_NOT_AGREED = "Single measurements do not agree on what the curve is near to: each keeps its own."


def learnt_camera(learnt: LearntImaging) -> Picture:
    """Draw light against grey value, and the noise of grey values, both with their scatter."""
    with sheet(6.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        _draw_curve(upper, learnt)
        _draw_noise(lower, learnt)
        lower.set_xlabel("grey value, of 255")
        figure.legend(*upper.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return picture(figure)


def _draw_curve(axes: Axes, learnt: LearntImaging) -> None:
    grey, (low, middle, high) = _FULL_SCALE * learnt.grey, learnt.light
    axes.plot(grey, srgb_decoded(learnt.grey), "--", color=GREY, linewidth=1.4, label="sRGB")
    axes.fill_between(grey, low, high, color=VERMILION, alpha=0.25, linewidth=0.0, label="± 1 sd")
    axes.plot(grey, middle, color=VERMILION, linewidth=2.0, label="learnt")
    axes.set_ylabel("light")


def _draw_noise(axes: Axes, learnt: LearntImaging) -> None:
    grey, sd = (_FULL_SCALE * learnt.noise).T
    axes.plot(grey, sd, ".", color=BLUE, alpha=0.6)
    edges = np.linspace(0.0, _FULL_SCALE, _BINS + 1)
    middles, medians = [], []
    for first, last in pairwise(edges):
        within = (grey >= first) & (grey < last)
        if within.sum() >= _FEWEST_OF_BIN:
            middles.append(0.5 * (first + last))
            medians.append(float(np.median(sd[within])))
    axes.plot(middles, medians, color=VERMILION, linewidth=2.0)
    axes.set_ylabel("noise, grey values")
    axes.set_ylim(bottom=0.0)


def learnt_sentence(learnt: LearntImaging) -> str:
    """Say what was learnt, and how much it has changed."""
    low, middle, high = learnt.sharpening.tolist()
    about = _NOT_AGREED if learnt.base is None else _about_tone(learnt, learnt.base)
    smoothing = learnt.smoothing
    return (
        f"{about} Strength of the camera's sharpening: {middle:.2f} ({low:.2f} to {high:.2f})."
        f" Smoothing along contours: {minus(f'{smoothing.mean_px2:.3f}')} px² ±"
        f" {smoothing.sd_mean_px2:.3f}; single measurements scatter by {smoothing.scatter_px2:.3f}."
    )


def _about_tone(learnt: LearntImaging, base: ToneBase) -> str:
    """Say from how many measurements a tone curve was learnt, and which of them disagree."""
    count = f"{learnt.measurements} measurement{'' if learnt.measurements == 1 else 's'}"
    parts = [f"The tone curve departs from {base.value}, learnt from {count}"]
    if learnt.overruled:
        parts.append(f"{learnt.overruled} alone would suggest another base")
    if learnt.kept_own_base:
        parts.append(f"{learnt.kept_own_base} kept another base, which fits far better")
    return f"{'; '.join(parts)}."
