"""Discs of a compressed photograph, adjusted to the coefficients before they were rounded.

The model is compared with the intervals in which JPEG's coefficients were before rounding
(`kgcp.measurement.image_model.compression`), rather than with the grey values that rounding has
left. The equations are the same, with coefficients in the place of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.adjustment.normal_equations import weighted_products
from kgcp.measurement.discs.fit_disc import (
    DiscFit,
    DiscSample,
    DiscState,
    DiscUnknowns,
    NoFit,
    disc_fit_at,
    linearised_at,
    newton_step,
    noise_at,
)
from kgcp.measurement.image_model.compression import (
    CompressedPixels,
    is_compressed_near,
    quantisation_steps,
)
from kgcp.measurement.image_model.noise import Misfit, misfit

_STEPS = 4
_LEAST_PROMISE = 0.005  # a step that promises a smaller gain in log-likelihood is not taken
# Noise before compression that is tried, as shares of the noise after it, and the number of discs
# that tell it
_NOISE_SHARES = np.geomspace(0.3, 1.2, 12)
_DISCS_OF_NOISE = 20
_BLOCK_PX = 8
# Compression is coarse if JPEG's steps in grey values (median over the nine longest waves) reach
# this: they are 2 at quality 92 and 4 at 85. Film's curve is then learned wrongly in half of the
# cases. In light that falls off by 5 % over the radius, centres of dark discs of R 8 px are then
# off by 0.015 px, 1.5 to 2 stated deviations.
_COARSE_STEP = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class ObservedNoise:
    """The noise of what a disc is adjusted to."""

    sd: FloatArray  # (n,): of every pixel, before compression, as level
    pixels: CompressedPixels | None  # None: not compressed
    deviations: FloatArray  # (64 b,): of the coefficients, which they determine

    @classmethod
    def of(cls, sd: FloatArray, pixels: CompressedPixels | None) -> ObservedNoise:
        """Determine the deviations of the coefficients."""
        return cls(sd, pixels, np.empty(0) if pixels is None else pixels.deviations(sd))


@dataclass(frozen=True, slots=True, eq=False)
class CompressedFit:
    """A disc adjusted to intervals of coefficients."""

    fit: DiscFit  # the pixels, compared with the adjusted state
    # The equations of the m observations: the coefficients, and the pixels outside complete blocks.
    misfit: Misfit
    scaled: FloatArray  # (p, m)
    normal: FloatArray  # (p, p): with the priors
    block: IndexArray  # (m,): number of the block that each observation belongs to


def steps_of(fits: Sequence[DiscFit]) -> list[FloatArray | None]:
    """Return JPEG's quantisation steps of each disc's photograph; None: not compressed."""
    photos = {id(fit.sample.window.photo): fit.sample.window.photo for fit in fits}
    steps = {key: quantisation_steps(photo) for key, photo in photos.items()}
    return [steps[id(fit.sample.window.photo)] for fit in fits]


def are_compressed(fits: Sequence[DiscFit]) -> bool:
    """Tell whether any photograph is compressed, by the surroundings of one disc of each."""
    first = {id(fit.sample.window.photo): fit for fit in reversed(fits)}
    return any(
        is_compressed_near(fit.sample.window.photo, fit.state.geometry[:2])
        for fit in first.values()
    )


def are_coarse(steps: Sequence[FloatArray | None]) -> bool:
    """Tell whether the median photograph is compressed so much that curves are learned wrongly."""
    lowest = [0.0 if each is None else float(np.median(each[:3, :3])) for each in steps]
    return float(np.median(lowest)) >= _COARSE_STEP


def adjust_to_intervals(fits: Sequence[DiscFit], steps: FloatArray) -> list[CompressedFit | None]:
    """Adjust the discs of one photograph to the intervals of its rounded coefficients.

    Parameters
    ----------
    fits : sequence of DiscFit
        Adjusted to the grey values: the start.
    steps : (8, 8) array
        Of the photograph, by `quantisation_steps`.

    Returns
    -------
    list of CompressedFit
        None: there are no such intervals, or no better fit to them, and the start counts.
    """
    pixels = [pixels_before_compression(fit.sample, steps) for fit in fits]
    share = _noise_share(fits, pixels)
    return [_adjusted(*of_disc, share) for of_disc in zip(fits, pixels, strict=True)]


def _adjusted(fit: DiscFit, pixels: CompressedPixels, noise_share: float) -> CompressedFit | None:
    if not len(pixels.in_blocks):
        return None
    sd = fit.sd.copy()
    sd[pixels.in_blocks] *= noise_share
    noise = ObservedNoise.of(sd, pixels)
    try:
        now = compressed_fit_at(fit.sample, fit.state, fit.free, noise)
        for _ in range(_STEPS):
            step, promised = newton_step(now, 0.0)
            if promised < _LEAST_PROMISE:
                break
            state = now.state.moved(step, fit.free.tone)
            trial = compressed_fit_at(fit.sample, state, fit.free, noise)
            if not _total(trial) <= _total(now):
                break
            now = trial
        by_pixels = disc_fit_at(fit.sample, now.state, fit.free, fit.sd)
    except NoFit:
        return None
    return CompressedFit(by_pixels, now.misfit, now.scaled, now.normal, _blocks(fit, pixels))


def _total(fit: DiscFit) -> float:
    return fit.misfit.total + fit.free.penalty(fit.state.vector)


def _blocks(fit: DiscFit, pixels: CompressedPixels) -> IndexArray:
    """Return the number (m,) of the block of every coefficient and of every pixel outside."""
    columns, rows = fit.sample.pixels.places_px.astype(np.intp) // _BLOCK_PX
    of_pixels = rows * (fit.sample.window.frame_px // _BLOCK_PX + 1) + columns
    of_blocks = np.zeros(len(pixels.observed), np.intp)
    of_blocks[pixels.places // _BLOCK_PX**2] = of_pixels[pixels.in_blocks]
    numbers = np.concatenate((np.repeat(of_blocks, _BLOCK_PX**2), of_pixels[pixels.outside_blocks]))
    return np.unique(numbers, return_inverse=True)[1]


def _noise_share(fits: Sequence[DiscFit], pixels: Sequence[CompressedPixels]) -> float:
    """Return the noise before compression, as a share of the noise that residuals show after it.

    It is the one with the largest restricted likelihood of all discs together (Patterson &
    Thompson, Biometrika 58, 1971): each unknown that the observations determine takes up one of
    them. The likelihood is interpolated by a parabola over the logarithm of the share.

    It comes out too small for small discs, as pixels of their blocks that are not modelled leave no
    residuals. The scatter over blocks makes up for that. (If such pixels counted as exact here, and
    the scatter as well, deviations of discs of R 3 px would be up to a quarter too large.)
    """
    losses = np.zeros(len(_NOISE_SHARES))
    every = math.ceil(len(fits) / _DISCS_OF_NOISE)
    for fit, of_disc in zip(fits[::every], pixels[::every], strict=True):
        free = fit.free
        of_prior = np.linalg.solve(fit.normal, free.precision[np.ix_(free.rows, free.rows)])
        determined = len(free.rows) - float(np.trace(of_prior))
        losses += [
            of_disc.misfit(fit.levels, of_disc.deviations(share * fit.sd)).total
            for share in _NOISE_SHARES
        ]
        losses -= determined * np.log(_NOISE_SHARES)
    best = int(np.clip(np.argmin(losses), 1, len(losses) - 2))
    left, middle, right = losses[best - 1 : best + 2].tolist()
    bend = left - 2.0 * middle + right
    off = float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0
    ratio = float(_NOISE_SHARES[1] / _NOISE_SHARES[0])
    return float(_NOISE_SHARES[best] * ratio**off)


def pixels_before_compression(sample: DiscSample, steps: FloatArray) -> CompressedPixels:
    """Return what compression left of a disc's pixels.

    Parameters
    ----------
    steps : (8, 8) array
        Of its photograph, by `quantisation_steps`.
    """
    return CompressedPixels.of(sample.window.photo, sample.pixels.places_px, steps)


def compressed_fit_at(
    sample: DiscSample, state: DiscState, free: DiscUnknowns, noise: ObservedNoise
) -> DiscFit:
    """Return a fit linearised at a state, with given noise.

    Misfit and scaled Jacobian are those of the coefficients, followed by those of pixels whose
    block is clipped or not whole.
    """
    pixels, sd, deviations = noise.pixels, noise.sd, noise.deviations
    if pixels is None:
        return disc_fit_at(sample, state, free, sd)
    share, levels, jacobian = linearised_at(sample, state)
    alone, clips = pixels.outside_blocks, sample.censoring
    clips = replace(clips, at_high=clips.at_high[alone], at_low=clips.at_low[alone])
    of_blocks = pixels.misfit(levels, deviations)
    of_alone = misfit(sample.levels[alone], levels[alone], sd[alone], clips)
    both = Misfit(
        of_blocks.total + of_alone.total,
        np.concatenate((of_blocks.score, of_alone.score)),
        np.concatenate((of_blocks.weight, of_alone.weight)),
    )
    rows = jacobian[free.rows]
    by_coefficients = pixels.coefficients(rows) / deviations
    scaled = np.hstack((by_coefficients, rows[:, alone] / sd[alone]))
    normal = weighted_products(scaled, both.weight, np.zeros(len(free.rows)))
    normal += free.precision[np.ix_(free.rows, free.rows)]
    return DiscFit(sample, free, state, share, levels, jacobian, sd, both, scaled, normal)


def noise_before_compression(fit: DiscFit, pixels: CompressedPixels | None) -> FloatArray:
    """Return the noise (n,) as level that the pixels of a fit had before compression.

    It is the noise of the expected values before compression, plus their variance (Dempster, Laird
    & Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977). Pixels whose
    coefficients are not known are compared as they are, and have the noise after compression.
    """
    after = noise_at(fit.sample, fit.state).sd
    if pixels is None:
        return after
    levels, variance = pixels.levels_before(fit.sample.levels, fit.levels, fit.sd)
    sd = np.sqrt(noise_at(replace(fit.sample, levels=levels), fit.state).sd ** 2 + variance)
    sd[pixels.outside_blocks] = after[pixels.outside_blocks]
    return np.asarray(sd)
