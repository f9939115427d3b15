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

_MOST_DISCS = 12
_LEAST_RADIUS_PX = 5.0  # of discs to learn from, if there are any
_LARGE_RADIUS_PX = 20.0  # from there on, the two levels fall off differently enough to tell
_MOST_CLIPPED = 0.05  # share of pixels
# Of each parameter, whatever many discs say: levels differ a little from disc to disc, and with
# them the part of the curve that is between.
_LEAST_SD = 0.03
_SCATTER = 2.0  # variances of single discs are too small by about this: the model is not perfect


@dataclass(frozen=True, slots=True)
class CameraTone:
    """What the camera does to the light of all discs of a photograph."""

    tone: Tone
    sharpens: bool = False
    camera: tuple[tuple[float, float], ...] = ()  # as of `FreeParameters`


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
        has_ink_slope=task.radius_px >= _LARGE_RADIUS_PX,
        camera=camera.camera,
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
        has_ink_slope = task.radius_px >= _LARGE_RADIUS_PX
        with contextlib.suppress(DiscRejection, NoFit, np.linalg.LinAlgError):
            fit = adjust_disc(
                task, FreeParameters(first, sharpens=True, has_ink_slope=has_ink_slope)
            )
            if then is not first:
                shaped = FreeParameters(then, sharpens=True, has_ink_slope=has_ink_slope)
                fit = adjust_disc(task, shaped, fit.state)
            check_fit(fit, task.outline)
            fits[number] = fit
    return fits


def _pooled(tone: Tone, fits: dict[int, DiscFit]) -> CameraTone:
    """Return the weighted mean of what some fits say of the camera, without their priors."""
    rows = [row for row in CAMERA_ROWS if tone.is_shaped or row == CAMERA_ROWS[-1]]
    clean = [fit for fit in fits.values() if fit.sample.censoring.share <= _MOST_CLIPPED]
    said = [_said(fit, rows) for fit in clean or fits.values()]
    if not said:
        return CameraTone(tone, sharpens=True)
    own = said[0][2]
    information = np.sum([each[0] for each in said], axis=0) / _SCATTER
    pull = np.sum([each[1] for each in said], axis=0) / _SCATTER
    inverse = np.linalg.inv(information + np.diag(own))
    means, sds = inverse @ pull, np.sqrt(np.diag(inverse) + _LEAST_SD**2)
    known = dict(zip(rows, zip(means.tolist(), sds.tolist(), strict=True), strict=True))
    return CameraTone(
        tone, sharpens=True, camera=tuple(known.get(row, (0.0, 1.0)) for row in CAMERA_ROWS)
    )


def _said(fit: DiscFit, rows: list[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a fit alone says of some parameters: information, that times values, prior."""
    places = np.searchsorted(fit.free.rows, rows)
    mean, precision = fit.free.prior
    inverse = np.linalg.inv(fit.normal)[np.ix_(places, places)]
    information = np.linalg.inv(inverse) - np.diag(precision[rows])
    values = fit.state.vector[rows]
    # the estimate is between the prior's mean and the disc's own: take the prior out again
    pull = np.linalg.inv(inverse) @ values - precision[rows] * mean[rows]
    return information, pull, precision[rows]
