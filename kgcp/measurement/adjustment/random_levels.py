"""Levels of ink and plate that vary over the plate, adjusted with pose, blur and light.

They are random effects: values at knots, with a prior of zero mean whose variance is estimated from
the frame itself. docs/method/uneven_light.md says why.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.covariance import pose_covariance
from kgcp.measurement.adjustment.level_equations import (
    AtKnots,
    LevelEquations,
    eliminate_levels,
    gather,
)
from kgcp.measurement.adjustment.normal_equations import (
    TILT_LIKE_DISTANCE,
    Unknowns,
    normal_matrix,
    scaled_rows,
    solve_damped,
)
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.pixels import NEAR_SIGMAS, Sample, select_pixels
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.solver import (
    PredictedImage,
    TargetFit,
    linearise,
    minimise,
    moved_to,
    noise_of,
)
from kgcp.measurement.image_model.light_field import (
    LEVEL_OFFSET_PRECISION,
    SPAN,
    LightField,
    lay_knots,
)
from kgcp.measurement.image_model.noise import Misfit
from kgcp.measurement.image_model.photometry import (
    PARAM_COUNT,
    Param,
    apply_tone,
    encoded,
    light_after_step,
    plateau_levels,
)
from kgcp.measurement.image_model.shadow_edges import ANGLE, EDGE_PRECISION, NO_EDGES, OFFSET

# Tuning of the levels, by the light flights of `benchmarks.accuracy.evaluate`. The number of phases
# is enough: three more phases move the distance by 0.05 σ or less in dirt, under highlights and in
# mixtures, and by 0.1 σ under shadows (RMS).
_ROUNDS, _PHASES, _STEPS = 2, 3, 8
_ALL_BUT_ZERO = 1e-6  # start of a parameter whose derivatives are needed: at 0 they are left out
_LEAST_GAIN = 0.05  # in log-likelihood: a step that gains less is the last
# Log-likelihood by which the other pose is so much worse that its fit is given up. After two steps:
# of 240 fits, 90 are worse by so much, and all of these ended worse by 4300 or more after all their
# steps; one that was worse by 1600 became the better one. Before the first step: of 178 fits, 60
# are worse by so much, and these too ended worse by 4300 or more.
_HOPELESS, _HOPELESS_AT_ONCE = 5000.0, 15000.0
# If a step promises a larger gain in log-likelihood, the Jacobian is computed anew after it. Levels
# and tone curve have nearly the same effect, so that a Jacobian that is off by some per cent
# promises gains that no step can make: steps gained a tenth of what they promised, until their
# number was used up.
_LARGE_GAIN = 1.0
_SETTLED_PX = 0.1  # a round that moves the target less is the last
_LEAST_SD, _MOST_SD, _FIRST_SD = 1e-4, 1.0, 0.1  # of the levels' prior, as shares of the contrast
# Knots of the fine grid: least spacing [px], and how many per radius; spacing of the coarse grid in
# radii
_FINEST_PX, _FINE, _COARSE = 8.0, 6.0, 0.8
_SLACK_PX = 0.4
_PLATEAU_PIXELS = 1200
# On rings from this radius on (four knots of the finest grid), a wider band around edges is used;
# its half width is in σ of the blur. If the pixels just beside edges are left out, nothing ties the
# levels at an edge to those of the plateaus: errors in three flights of phones, R ≥ 26 px, were 1.4
# to 1.8 times as large. Smaller rings hardly have pixels so far from all edges, and with the wider
# band their errors under highlights grew.
_NEAR_SIGMAS, _NEAR_FROM_PX = 3.3, 4.0 * _FINEST_PX
_LEAST_CONTRAST = 0.05
# Precision of an edge's direction [1/rad²] and offset [1/px²] below which no pixel sees it. Edges
# that are seen have more than 1.
_LEAST_EDGE_PRECISION = 1e-6
# The excess is the mean square of the residuals' sums over cells, relative to that of independent
# residuals. If it is larger than this, the levels vary; in even light it is about 1. Bins have
# little noise and a limit of their own: of rings of R 150 to 310 px, 19 in even light had 0.9 to
# 5.6; of 30 in uneven light, one had 6.4 and the others 25 to 60.
_UNEVEN_EXCESS, _UNEVEN_EXCESS_OF_BINS = 1.9, 3.0
# In small rings, edges tell more of uneven light than cells do. So levels also vary if the excess
# is above the first limit and residuals that agree along edges inflate the covariance by more than
# the second. Of 58 simulated frames with dirt, one with R 15 px had an excess of 1.3, an inflation
# of 6.5, and an error of 4.6 σ without levels that vary. In even light, fits with an excess above
# 1.2 have an inflation of at most 3.5 (in the flight of a coarse renderer).
#
# Rings below `SMALL_RING_PX` hardly fill a cell, and burnt white does not vary. So there the
# inflation alone decides, and levels that vary must be likelier besides. Two rings under
# highlights, 5 and 6 σ off with even light, had excesses of 0.6 and 0.8 and inflations of 1.8 and
# 2.2. Two that were burnt and half in shade, 7 σ off, had excesses of 0.3 and 0.4 and inflations of
# 3.3 and 2.7. The price: of 159 such rings that are burnt in even light, two are refused.
_DOUBTFUL, _DOUBTFUL_INFLATION_OF_SMALL_RING = (1.2, 4.0), 1.6
_TELLING_POWER = 0.05  # cells with less weight, relative to the largest, are left out


def even_field(problem: FitProblem) -> LightField:
    """Return a field of zeros on a fine grid, and on a coarse one if that is clearly coarser."""
    radius, window = problem.outer_radius_px, problem.window
    fine, coarse = max(_FINEST_PX, radius / _FINE), _COARSE * radius
    spacings_px = (coarse, fine) if coarse > 1.5 * fine else (fine,)
    knots = lay_knots(
        (window.x0, window.x0 + window.width - 1),
        (window.y0, window.y0 + window.height - 1),
        problem.centre_px,
        spacings_px,
    )
    count = sum(knots.counts)
    return LightField(
        knots=knots,
        values=np.zeros((2, count)),
        precision=np.full((2, count), _FIRST_SD**-2),
        offsets=np.zeros(2),
        shadows=NO_EDGES,
        centre_px=problem.centre_px,
    )


def excess_of_cells(fit: TargetFit) -> float:
    """Return the mean square of the residuals' sums over cells; 1 if residuals are independent."""
    sample, light = fit.sample, fit.parameters.light
    field = even_field(sample.problem)
    knots, weights = field.knots.weights(sample.pixels)
    finest = AtKnots.of(knots[:, -SPAN * SPAN :], weights[:, -SPAN * SPAN :])
    contrast = light.white - light.black
    by_level = contrast * fit.jacobian[[int(Param.BLACK), int(Param.WHITE)]] / fit.sd
    count = field.values.shape[1]
    sums = gather(finest, by_level, fit.misfit.score, count)
    squares = finest._replace(weights=finest.weights**2)
    power = gather(squares, by_level**2, fit.misfit.weight, count)
    telling = power > _TELLING_POWER * power.max()
    return float(np.mean(sums[telling] ** 2 / power[telling]))


def needs_varying_levels(fit: TargetFit) -> bool:
    """Tell whether levels vary: residuals agree within cells of the finest grid, or along edges."""
    excess, is_binned = excess_of_cells(fit), fit.sample.problem.window.binning > 1
    if excess > (_UNEVEN_EXCESS_OF_BINS if is_binned else _UNEVEN_EXCESS):
        return True
    if is_binned:
        return False
    if fit.sample.problem.is_ring_small:
        return pose_covariance(fit).inflation > _DOUBTFUL_INFLATION_OF_SMALL_RING
    doubtful, inflation = _DOUBTFUL
    return excess > doubtful and pose_covariance(fit).inflation > inflation


def fit_levels(problem: FitProblem, starts: list[Parameters], unknowns: Unknowns) -> TargetFit:
    """Adjust with a field of levels, from the first start that succeeds.

    Raises
    ------
    Rejection
        `POOR_FIT`, or as `select_pixels`, if the fits from all starts fail.
    """
    for start in starts[:-1]:
        with contextlib.suppress(Rejection):
            return _with_all_edges(_adjust_levels(problem, start, unknowns))
    return _with_all_edges(_adjust_levels(problem, starts[-1], unknowns))


def _with_all_edges(fit: TargetFit) -> TargetFit:
    """Return a fit whose pixels see all of its shadows' edges.

    An edge that has left the pixels has no direction and no place. Its equations are singular, but
    for rounding, and the covariance cannot be computed.

    Raises
    ------
    Rejection
        `POOR_FIT` if an edge has left them.
    """
    count = _field_of(fit.parameters).shadows.rows.size
    equations = np.diag(_equations_of(fit).normal)
    of_edges = equations[len(equations) - count :].reshape(-1, len(EDGE_PRECISION))
    if np.any(of_edges[:, [ANGLE, OFFSET]] < _LEAST_EDGE_PRECISION):
        raise Rejection(Reason.POOR_FIT, "the edge of a shadow is seen by no pixel")
    return fit


def fit_other_pose(first: TargetFit, other: Pose) -> tuple[TargetFit, TargetFit]:
    """Adjust another pose, from the levels of a fit, on its pixels and with its noise.

    Returns
    -------
    best, other : TargetFit
        The better and the worse one.
    """
    unadjusted = moved_to(first, other)
    if unadjusted.total > first.total + _HOPELESS_AT_ONCE:
        return first, unadjusted
    second = _minimise(
        first.sample,
        unadjusted.parameters,
        first.sd,
        first.unknowns,
        _equations_of(first).at_knots,
        hopeless_total=first.total + _HOPELESS,
    )
    return (second, first) if second.total < first.total else (first, second)


def chi2_with_levels(fit: TargetFit, unknowns: Unknowns, param: Param) -> float:
    """Return the χ² of a score test for one more parameter in a fit with levels that vary.

    `unknowns` are those of the fit and the parameter, which is zero so far.
    """
    vector = fit.parameters.vector.copy()
    vector[param] = _ALL_BUT_ZERO
    parameters = replace(fit.parameters, vector=vector)
    _, jacobian = linearise(fit.sample, parameters)
    at_knots = _equations_of(fit).at_knots
    reduced = _equations(fit.sample, parameters, jacobian, fit.sd, unknowns, fit.misfit, at_knots)
    moved, _ = _WithLevels(reduced, unknowns).proposed(fit.misfit, parameters, 0.0)
    k = int(np.searchsorted(unknowns.free, param))
    variance = float(np.linalg.inv(reduced.normal)[k, k])
    return float(moved.vector[param] - vector[param]) ** 2 / variance


def _adjust_levels(problem: FitProblem, start: Parameters, unknowns: Unknowns) -> TargetFit:
    """Adjust with a field of levels, in rounds that each choose their pixels."""
    parameters = start if start.field is not None else replace(start, field=even_field(problem))
    is_large = problem.outer_radius_px >= _NEAR_FROM_PX
    for _ in range(_ROUNDS):
        sample = select_pixels(
            _evened(problem, parameters),
            parameters.pose,
            parameters.blur,
            parameters.light,
            slack_px=_SLACK_PX,
            near_sigmas=_NEAR_SIGMAS if is_large else NEAR_SIGMAS,
            plateau_pixels=_PLATEAU_PIXELS,
        )
        fit = _adjust_on(replace(sample, problem=problem), parameters, unknowns)
        before, parameters = parameters.matrix[:, 3], fit.parameters
        shift = np.linalg.norm(parameters.matrix[:, 3] - before) / parameters.matrix[2, 3]
        if shift * problem.focal_px < _SETTLED_PX:
            break
    return fit


def _evened(problem: FitProblem, parameters: Parameters) -> FitProblem:
    """Return a problem whose smooth image, which masks are made from, is as in even light."""
    field, window = parameters.field, problem.window
    if field is None:
        return problem
    added = field.added(window.pixels(np.arange(len(window.levels))))
    light = parameters.light
    black, white = plateau_levels(light, problem.tone)
    ink, plate = (
        encoded(apply_tone(x, light.values), problem.tone) for x in (added[0], 1.0 + added[1])
    )
    white, plate = min(white, problem.brightest), np.minimum(plate, problem.brightest)
    contrast = np.maximum(plate - ink, _LEAST_CONTRAST * (white - black))
    smooth = black + (window.smooth - ink) * (white - black) / contrast
    return replace(problem, window=replace(window, smooth=smooth))


def _adjust_on(sample: Sample, parameters: Parameters, unknowns: Unknowns) -> TargetFit:
    """Adjust on a sample in phases; each takes noise and prior of the levels from the last."""
    field = _field_of(parameters)
    at_knots = AtKnots.of(*field.knots.weights(sample.pixels))
    linear = linearise(sample, parameters)
    for phase in range(_PHASES):
        sd = noise_of(sample, linear[0], is_even=False).sd
        fit = _minimise(sample, parameters, sd, unknowns, at_knots, linear)
        linear = (fit.prediction, fit.jacobian)
        parameters = fit.parameters
        if phase < _PHASES - 1:
            parameters = replace(parameters, field=_with_variances(fit))
    return fit


def _with_variances(fit: TargetFit) -> LightField:
    """Return the field with the prior estimated from its own values (MacKay's fixed point).

    The variance of a group of values c is Σ c² / γ, where γ is the number of values that the pixels
    determine. Each grid has a group for ink and one for plate.
    """
    field, equations = _field_of(fit.parameters), _equations_of(fit)
    grid = np.repeat(np.arange(len(field.knots.counts)), field.knots.counts)
    group = np.append(grid, grid + len(field.knots.counts))
    determined = 1.0 - equations.precision * equations.variances()
    precision, values = np.empty(len(group)), field.values.ravel()
    for g in range(group.max() + 1):
        number = float(np.sum(determined[group[equations.used] == g]))
        sd = math.sqrt(float(np.sum(values[group == g] ** 2)) / max(number, 0.5))
        precision[group == g] = min(max(sd, _LEAST_SD), _MOST_SD) ** -2
    return replace(field, precision=precision.reshape(2, -1))


def _minimise(
    sample: Sample,
    parameters: Parameters,
    sd: FloatArray,
    unknowns: Unknowns,
    at_knots: AtKnots,
    linear: tuple[PredictedImage, FloatArray] | None = None,
    hopeless_total: float = math.inf,
) -> TargetFit:
    """Minimise the negative log-likelihood with all priors; the fit keeps its equations."""
    latest: _WithLevels | None = None
    latest_jacobian: FloatArray | None = None

    def equations_of(parameters: Parameters, jacobian: FloatArray, current: Misfit) -> _WithLevels:
        nonlocal latest, latest_jacobian
        equations = _equations(sample, parameters, jacobian, sd, unknowns, current, at_knots)
        latest, latest_jacobian = _WithLevels(equations, unknowns), jacobian
        return latest

    fit = minimise(
        sample,
        parameters,
        sd,
        unknowns,
        steps=_STEPS,
        least_gain=_LEAST_GAIN,
        large_gain=_LARGE_GAIN,
        linear=linear,
        hopeless_total=hopeless_total,
        equations_of=equations_of,
    )
    if latest is None or latest_jacobian is not fit.jacobian:  # computed again after the last step
        latest = equations_of(fit.parameters, fit.jacobian, fit.misfit)
    return replace(fit, level_equations=latest.reduced)


def _field_of(parameters: Parameters) -> LightField:
    """Return the field, which is never None in this module."""
    return cast("LightField", parameters.field)


def _equations_of(fit: TargetFit) -> LevelEquations:
    return cast("LevelEquations", fit.level_equations)


def _equations(
    sample: Sample,
    parameters: Parameters,
    jacobian: FloatArray,
    sd: FloatArray,
    unknowns: Unknowns,
    current: Misfit,
    at_knots: AtKnots,
) -> LevelEquations:
    """Return the equations of pose, blur, light and shadows' edges, with the levels eliminated."""
    field = _field_of(parameters)
    by_level = jacobian[PARAM_COUNT:] / sd
    scaled = np.vstack((scaled_rows(jacobian, unknowns.free, sd), by_level))
    precision = np.append(unknowns.free_precision, (LEVEL_OFFSET_PRECISION,) * 2)
    if len(field.shadows.rows):
        scaled = np.vstack((scaled, field.edge_rows(sample.pixels, by_level)))
        precision = np.append(precision, field.shadows.precision)
    normal = normal_matrix(scaled, current, replace(unknowns, free_precision=precision))
    return eliminate_levels(scaled, normal, at_knots, by_level, current, field.precision)


@dataclass(frozen=True, slots=True, eq=False)
class _WithLevels:
    """The equations of pose, blur, light and shadows' edges, the levels eliminated."""

    reduced: LevelEquations
    unknowns: Unknowns

    def proposed(
        self, current: Misfit, parameters: Parameters, damping: float
    ) -> tuple[Parameters, float]:
        """Return the parameters after a damped step, and the gain that the step promises."""
        reduced, unknowns, field = self.reduced, self.unknowns, _field_of(parameters)
        free = unknowns.free
        level_gradient = reduced.gradient_of_levels(current.score, field.values)
        pull = unknowns.precision[free] * (unknowns.mean[free] - parameters.vector[free])
        offset_pull = -LEVEL_OFFSET_PRECISION * field.offsets
        pulls = np.concatenate((pull, offset_pull, field.shadows.pull))
        gradient = reduced.scaled @ current.score + pulls
        alone = reduced.half_solved(level_gradient)
        gradient -= reduced.half_mixed.T @ alone
        damped = _damped(reduced.normal, parameters, damping)
        solution, promised = solve_damped(damped, gradient, 0.5 * float(alone @ alone))
        values = reduced.step_of_levels(alone, solution)
        of_light, offsets, edges = np.split(solution, (len(free), len(free) + 2))
        moved = parameters.moved(unknowns.step_of(of_light))
        before, after = parameters.light.values, moved.light.values

        def light_after(light: FloatArray, step: FloatArray) -> FloatArray:
            moved_light = light_after_step(light.ravel(), step.ravel(), before, after)
            return moved_light.reshape(light.shape)

        field = field.moved(values, offsets, edges.reshape(-1, 5), light_after)
        return replace(moved, field=field), promised


def _damped(normal: FloatArray, parameters: Parameters, damping: float) -> FloatArray:
    """Damp a normal matrix; tilts are damped like the distance, as in `normal_equations`."""
    stiffness = np.diag(normal).copy()
    reach_m = TILT_LIKE_DISTANCE * float(np.linalg.norm(parameters.matrix[:, 3]))
    stiffness[3:6] = np.maximum(stiffness[3:6], reach_m * reach_m * stiffness[2])
    return np.asarray(normal + np.diag(damping * stiffness))
