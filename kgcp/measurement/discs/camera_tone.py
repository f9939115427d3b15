"""The tone curve and the sharpening of a camera, learned from the largest discs of a photograph.

A disc alone tells little of them, and takes errors of the curve for a displacement where the light
falls off. All discs of a photograph share them. Each of some large ones is adjusted with all of the
curve's parameters free; what they say together is the prior for all.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.measurement.discs.adjust_disc import DiscRejection, DiscTask, adjust_disc, check_fit
from kgcp.measurement.discs.fit_disc import CAMERA_ROWS, DiscFit, FreeParameters, NoFit
from kgcp.measurement.image_model.photometry import Tone

_MOST_DISCS = 9
_LEAST_RADIUS_PX = 5.0  # of discs to learn from, if there are any
# From there on, the two levels fall off differently enough to tell, but for an unknown curve.
_LARGE_RADIUS_PX = 20.0
_MOST_CLIPPED = 0.05  # share of pixels
_LARGEST_BLUR = 0.3  # of the radius, to start from
_LEAST_SD = 0.03  # of each parameter, however many discs agree
_MEDIAN_SQUARE, _OF_MEDIAN = 0.455, 1.57  # median of χ²₁; variance of a median over that of a mean


@dataclass(frozen=True, slots=True)
class CameraTone:
    """What the camera does to the light of all discs of a photograph."""

    tone: Tone
    sharpens: bool = False
    camera: tuple[tuple[float, float], ...] = ()  # as of `FreeParameters`
    blur_px: float = 0.0  # median of those that it was learned from; 0: none


def learn_tone(tasks: Sequence[DiscTask], response: Response) -> CameraTone:
    """Return the tone to use for discs of one photograph.

    An unknown curve is shaped from sRGB's, and from a straight line; the one that is likelier for
    most of the discs is kept.
    """
    tone = Tone.of(response)
    if tone is Tone.LINEAR:
        return CameraTone(tone)
    chosen = _to_learn_from(tasks)
    if tone is Tone.SRGB:
        return _pooled(tone, _fits(chosen, Tone.SRGB, Tone.SRGB))
    curved = _fits(chosen, Tone.SRGB, Tone.UNKNOWN)
    straight = _fits(chosen, Tone.LINEAR, Tone.UNKNOWN_FROM_LINE)
    both = curved.keys() & straight.keys()
    gain = sum(
        (curved[i].loss_per_pixel - straight[i].loss_per_pixel) * len(curved[i].sd)
        for i in sorted(both)
    )
    if gain > 0.0:
        return _pooled(Tone.UNKNOWN_FROM_LINE, straight)
    return _pooled(Tone.UNKNOWN, curved)


def parameters_of(task: DiscTask, camera: CameraTone) -> FreeParameters:
    """Return what is estimated of a disc."""
    return FreeParameters(
        camera.tone,
        sharpens=camera.sharpens,
        has_ink_slope=not camera.tone.is_shaped and task.radius_px >= _LARGE_RADIUS_PX,
        camera=camera.camera,
        blur_px=min(camera.blur_px, _LARGEST_BLUR * task.radius_px),
    )


def _to_learn_from(tasks: Sequence[DiscTask]) -> list[DiscTask]:
    """Return the tasks of some large discs of high contrast, evenly drawn from the larger half."""
    large = [task for task in tasks if task.radius_px >= _LEAST_RADIUS_PX] or list(tasks)
    worth = [task.radius_px * task.outline.contrast for task in large]
    order = sorted(range(len(large)), key=lambda i: (-worth[i], i))
    half = order[: max(len(order) // 2, min(len(order), _MOST_DISCS))]
    step = max(len(half) // _MOST_DISCS, 1)
    return [large[i] for i in half[::step][:_MOST_DISCS]]


def _fits(tasks: Sequence[DiscTask], first: Tone, then: Tone) -> dict[int, DiscFit]:
    """Adjust discs by a known curve, and from there with all free; those that lead anywhere."""
    fits = {}
    for number, task in enumerate(tasks):
        with contextlib.suppress(DiscRejection, NoFit, np.linalg.LinAlgError):
            fit = adjust_disc(task, FreeParameters(first, sharpens=True))
            if then is not first:
                fit = adjust_disc(task, FreeParameters(then, sharpens=True), fit.state)
            check_fit(fit, task.outline)
            fits[number] = fit
    return fits


def _pooled(tone: Tone, fits: dict[int, DiscFit]) -> CameraTone:
    """Return what the discs together say of the camera: medians, and how far each may be off.

    Levels differ from disc to disc, and with them the part of the curve that is between. So the
    scatter beyond the noise counts as well as the uncertainty of the median.
    """
    rows = [row for row in CAMERA_ROWS if tone.is_shaped or row == CAMERA_ROWS[-1]]
    clean = [fit for fit in fits.values() if fit.sample.censoring.share <= _MOST_CLIPPED]
    learned = clean or list(fits.values())
    if not learned:
        return CameraTone(tone, sharpens=True)
    values = np.array([fit.state.vector[rows] for fit in learned])
    medians = np.median(values, axis=0)
    scatter = np.median(np.square(values - medians), axis=0) / _MEDIAN_SQUARE
    noise = np.median([_variances(fit, rows) for fit in learned], axis=0)
    variances = np.maximum(scatter - noise, 0.0) + _LEAST_SD**2
    variances += _OF_MEDIAN * np.maximum(scatter, noise) / len(learned)
    known = dict(
        zip(rows, zip(medians.tolist(), np.sqrt(variances).tolist(), strict=True), strict=True)
    )
    return CameraTone(
        tone,
        sharpens=True,
        camera=tuple(known.get(row, (0.0, 1.0)) for row in CAMERA_ROWS),
        blur_px=float(np.median([fit.state.blur.mean_sd_px for fit in learned])),
    )


def _variances(fit: DiscFit, rows: list[int]) -> FloatArray:
    """Return the variances of some parameters of a fit."""
    return np.asarray(np.diag(np.linalg.inv(fit.normal))[np.searchsorted(fit.free.rows, rows)])
