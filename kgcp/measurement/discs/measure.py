"""Discs measured from their grey values: centroid and second moments, with their covariance."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Response
from kgcp.measurement.discs.adjust_disc import (
    DiscRejection,
    DiscTask,
    adjust_disc_in_any_light,
    check_disc_fit,
    geometry_of,
    outline_geometry,
)
from kgcp.measurement.discs.affine_model import NO_INNER, Geometry
from kgcp.measurement.discs.camera_tone import (
    CameraTone,
    first_blur_px,
    learn_tone,
    unknowns_of_disc,
)
from kgcp.measurement.discs.comparison import measure_by_centroid, measure_by_gaussian
from kgcp.measurement.discs.compressed_fit import CompressedFit, adjust_to_intervals
from kgcp.measurement.discs.covariance import (
    DiscScatter,
    inflations,
    moments_by_stretch,
    scatter_of,
)
from kgcp.measurement.discs.fit_disc import DiscFit, NoFit
from kgcp.measurement.discs.outlines import tree_of
from kgcp.measurement.discs.pixel_choice import cut_disc_window
from kgcp.measurement.discs.records import (
    Disc,
    DiscMiss,
    DiscOutline,
    DiscReason,
    Operator,
    Polarity,
    moments_of_ellipse,
)
from kgcp.measurement.discs.ring_unknowns import RingUnknowns
from kgcp.measurement.discs.textured_ground import fit_on_texture
from kgcp.measurement.image_model.compression import quantisation_steps
from kgcp.measurement.image_model.noise import find_smear

_Result = TypeVar("_Result")

_LARGEST_SD_PX = 1.0  # of the centre, and of the moments divided by the radius
# A disc's window reaches no farther beyond its outline than the smaller of these
_NEIGHBOUR_RADII, _NEIGHBOUR_PX = 4.0, 40.0
_DISCS_OF_SMEAR, _BESIDE_PX = 100, 4.0  # that tell smeared pixels, with their surroundings


def measure_discs(
    grey: GreyArray,
    outlines: Sequence[DiscOutline],
    *,
    response: Response = Response.UNKNOWN,
    operator: Operator = Operator.MODEL,
    camera: CameraTone | None = None,
    ground: float = math.inf,
) -> list[Disc | DiscMiss]:
    """Measure many discs of one photograph: one outcome for each outline, in their order.

    Parameters
    ----------
    grey : (height, width) array
        Grey values of 8 or 16 bits.
    outlines : sequence of DiscOutline
        By `find_outlines` or `follow_outlines`. Each disc's pixels are kept clear of the others.
    response : Response
        How grey values follow light.
    camera : CameraTone, optional
        Tone curve, sharpening and focus of the camera, by `learn_camera`; by default, they are
        learned from the largest of these discs.
    ground : float
        How far the bare ground around a disc reaches from its middle, in radii, if a ring of code
        follows.
    """
    tasks = _tasks(grey, outlines, ground)
    steps = quantisation_steps(grey) if operator is Operator.MODEL and tasks else None
    return _measured(tasks, response, operator, camera, steps)


def learn_camera(
    photographs: Iterable[tuple[GreyArray, Sequence[DiscOutline]]],
    response: Response,
    *,
    ground: float = math.inf,
) -> CameraTone:
    """Learn tone curve, sharpening and focus of a camera from photographs with their outlines.

    Parameters
    ----------
    photographs : iterable of (array, sequence of DiscOutline)
        Grey values of 8 or 16 bits, and outlines by `find_outlines`.
    response : Response
        How grey values follow light.
    ground : float
        As for `measure_discs`.
    """
    tasks = [_tasks(grey, outlines, ground) for grey, outlines in photographs]
    return learn_tone(tasks, response)


def measure_disc(
    grey: GreyArray,
    outline: DiscOutline,
    *,
    neighbours: Sequence[DiscOutline] = (),
    inner: FloatArray = NO_INNER,
    response: Response = Response.UNKNOWN,
    operator: Operator = Operator.MODEL,
    is_ground_even: bool = True,
    has_border: bool = False,
) -> Disc | DiscMiss:
    """Measure one disc, or one edge of a ring, or a ring as a whole.

    Parameters
    ----------
    grey, response
        As for `measure_discs`.
    neighbours : sequence of DiscOutline
        Other edges that may be near: their pixels are left out.
    inner : (k, 3) array
        Circles within the outline of a ring that is measured as a whole, from the outside to the
        inside: centre and radius, where the outline is the unit circle. They move and grow with it.
    is_ground_even : bool
        False: its ground has a texture, as grass and gravel have. This has no effect on a ring that
        is measured as a whole, or with another operator than the image model.
    has_border : bool
        True: the ground around it is known to be even, so that residuals show uneven light on small
        discs, too.
    """
    others = _others(outline, neighbours)
    task = DiscTask(grey, outline, others, inner, is_ground_even, has_border)
    return _measured([task], response, operator, None)[0]


def _tasks(grey: GreyArray, outlines: Sequence[DiscOutline], ground: float) -> list[DiscTask]:
    tasks, smear = [], _smear_of(grey, outlines)
    for outline, near in zip(outlines, _neighbours(outlines), strict=True):
        others = _others(outline, [outlines[j] for j in near])
        if math.isfinite(ground):
            others.append(outline_geometry(outline) * np.array((1.0, 1.0, *[ground] * 3)))
        tasks.append(DiscTask(grey, outline, others, smear=smear))
    return tasks


def _smear_of(grey: GreyArray, outlines: Sequence[DiscOutline]) -> tuple[int, int]:
    """Return over how many grey values clipped pixels are smeared, by `find_smear`."""
    some = outlines[:: max(len(outlines) // _DISCS_OF_SMEAR, 1)]
    windows = [cut_disc_window(grey, outline_geometry(each), _BESIDE_PX) for each in some]
    seen = [each for each in windows if len(each.levels)]  # predictions may lie outside
    if not seen:
        return 0, 0
    return find_smear([(each.levels, each.width) for each in seen], seen[0].levels_per_count)


def _measured(
    tasks: Sequence[DiscTask],
    response: Response,
    operator: Operator,
    camera: CameraTone | None,
    steps: FloatArray | None = None,
) -> list[Disc | DiscMiss]:
    """Measure discs; `steps` (8, 8): with which their photograph was compressed, if it was."""
    if operator is not Operator.MODEL:
        measure = measure_by_centroid if operator is Operator.CENTROID else measure_by_gaussian
        return [_refuse_uncertain(measure(task)) for task in tasks]
    camera = learn_tone([tasks], response) if camera is None else camera
    adjusted = [_or_miss(task, partial(_adjusted, task, camera)) for task in tasks]
    compressed = {} if steps is None else _adjusted_to_intervals(adjusted, steps)
    outcomes = [
        each
        if isinstance(each, DiscMiss)
        else _or_miss(task, partial(_with_scatter, task, each, compressed.get(index)))
        for index, (task, each) in enumerate(zip(tasks, adjusted, strict=True))
    ]
    fits = [each for each in outcomes if not isinstance(each, DiscMiss)]
    factors = iter(inflations([scatter for _, scatter in fits]).tolist())
    return [
        each
        if isinstance(each, DiscMiss)
        else _refuse_uncertain(_disc(*each, task.outline, next(factors)))
        for task, each in zip(tasks, outcomes, strict=True)
    ]


def _or_miss(task: DiscTask, step: Callable[[], _Result]) -> _Result | DiscMiss:
    """Return the result of a step of the measurement, or why there is none."""
    try:
        return step()
    except DiscRejection as rejection:
        return DiscMiss(task.outline, rejection.reason, rejection.detail)
    except (NoFit, np.linalg.LinAlgError):
        return DiscMiss(task.outline, DiscReason.POOR_FIT, "singular equations")


def _adjusted(task: DiscTask, camera: CameraTone) -> DiscFit:
    fit = adjust_disc_in_any_light(
        task, unknowns_of_disc(task, camera), first_blur_px(task, camera)
    )
    check_disc_fit(fit, task.outline)
    return fit


def _adjusted_to_intervals(
    outcomes: Sequence[DiscFit | DiscMiss], steps: FloatArray
) -> dict[int, CompressedFit]:
    """Return, by their indices, the discs that the intervals of rounded coefficients determine.

    Burnt discs are left out: most of their blocks have no certain coefficients.
    """
    fits = {
        index: each
        for index, each in enumerate(outcomes)
        if not isinstance(each, DiscMiss) and not each.sample.is_burnt
    }
    if not fits:
        return {}
    refined = zip(fits, adjust_to_intervals(list(fits.values()), steps), strict=True)
    return {index: fit for index, fit in refined if fit is not None}


def _with_scatter(
    task: DiscTask, fit: DiscFit, compressed: CompressedFit | None
) -> tuple[DiscFit, DiscScatter]:
    """Return the final fit of a disc, and what its residuals say of the covariance.

    Parameters
    ----------
    compressed : CompressedFit, optional
        The same disc, adjusted to the intervals of rounded coefficients.
    """
    if compressed is not None:
        with suppress(np.linalg.LinAlgError):
            return compressed.fit, scatter_of(compressed)
    if len(task.inner):
        return _with_ring_unknowns(fit)
    scatter = scatter_of(fit)
    return (fit, scatter) if task.is_ground_even else fit_on_texture(fit, scatter, task.others)


def _with_ring_unknowns(fit: DiscFit) -> tuple[DiscFit, DiscScatter]:
    """Return a ring that was adjusted as a whole, corrected by its `RingUnknowns`.

    Raises
    ------
    DiscRejection
        `POOR_FIT`.
    """
    unknowns, scatter = RingUnknowns.of(fit), scatter_of(fit)
    if not unknowns.is_seen:
        detail = f"inner circles missing, or of {unknowns.ratio:.0%} of the outer one's contrast"
        raise DiscRejection(DiscReason.POOR_FIT, detail)
    to_moments = moments_by_stretch(fit.state.geometry)
    common = scatter.common + to_moments @ unknowns.cov @ to_moments.T
    return replace(fit, state=unknowns.corrected(fit.state)), replace(scatter, common=common)


def _refuse_uncertain(outcome: Disc | DiscMiss) -> Disc | DiscMiss:
    """Refuse a disc whose place or size is hardly determined: it is clutter, or noise."""
    if isinstance(outcome, DiscMiss):
        return outcome
    ellipse = outcome.outline.ellipse
    scale = np.array((1.0, 1.0, *[ellipse.mean_radius] * 3))
    if not np.isfinite(outcome.cov).all():
        return DiscMiss(outcome.outline, DiscReason.POOR_FIT, "singular equations")
    sd_px = np.sqrt(np.abs(np.diag(outcome.cov))) / scale
    xx, xy, yy = outcome.vector[2:].tolist()
    is_ellipse = xx > 0.0 and xx * yy > xy * xy
    least = np.linalg.eigvalsh(outcome.cov / np.outer(scale, scale))[0]
    if is_ellipse and least > 0.0 and float(sd_px.max()) < _LARGEST_SD_PX:
        return replace(outcome, cov=0.5 * (outcome.cov + outcome.cov.T))
    return DiscMiss(outcome.outline, DiscReason.POOR_FIT, f"uncertain by {sd_px.max():.1f} px")


def _others(outline: DiscOutline, neighbours: Sequence[DiscOutline]) -> list[Geometry]:
    """Return the edges whose pixels are left out: the neighbours, and the outline's own hole."""
    others = [outline_geometry(each) for each in neighbours]
    if outline.hole is not None:
        others.append(geometry_of(moments_of_ellipse(outline.hole)))
    return others


def _neighbours(outlines: Sequence[DiscOutline]) -> list[list[int]]:
    """Return, for each outline, the numbers of the others that may be in its window.

    Outlines beside it count only if they have the same polarity. If they have the other one, they
    are ground between discs that happens to look like a disc.
    """
    if not outlines:
        return []
    centres = np.array([each.ellipse.centre for each in outlines])
    radii = np.array([each.ellipse.a for each in outlines])
    tree, near = tree_of(centres), []
    for i, outline in enumerate(outlines):
        reach = min(_NEIGHBOUR_PX, _NEIGHBOUR_RADII * radii[i]) + radii[i] + radii.max()
        near.append(
            [
                j
                for j in sorted(tree.query_ball_point(centres[i], reach))
                if j != i
                and (
                    outlines[j].polarity is outline.polarity
                    or math.dist(centres[i], centres[j]) < max(radii[i], radii[j])
                )
            ]
        )
    return near


def _disc(fit: DiscFit, scatter: DiscScatter, outline: DiscOutline, inflation: float) -> Disc:
    x, y, xx, xy, yy = fit.state.geometry.tolist()
    moments = 0.25 * np.array((xx * xx + xy * xy, xy * (xx + yy), xy * xy + yy * yy))
    blur = fit.state.blur
    gradient = fit.state.slope / fit.sample.radius_px
    # The light falls on the scene, which is then blurred: with the blur's covariance B, a gradient
    # g displaces the whole image of the disc by −B g.
    spread = np.array(((blur.xx, blur.xy), (blur.xy, blur.yy)))
    centre = np.array((x, y)) + spread @ gradient
    black, white = fit.state.plateaus(fit.free.tone)
    inside, outside = (black, white) if outline.polarity is Polarity.DARK else (white, black)
    return Disc(
        outline=outline,
        vector=np.concatenate((centre, moments)),
        cov=scatter.cov(inflation),
        inside=inside,
        outside=outside,
        gradient=gradient,
        blur_px=blur.mean_sd_px,
        clipped=fit.sample.censoring.share,
        inflation=inflation,
        pixels=len(fit.levels),
    )
