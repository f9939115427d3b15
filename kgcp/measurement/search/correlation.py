"""Masked normalised cross-correlation: how alike polar patches and templates are, at every turn.

The same measure serves whole rings, rings of which something hides a part, and single code
circles; docs/method.md, "The code", derives it. With the weights w of the rows, and ⟨…⟩ the
weighted mean over the visible samples, a template i scores against a patch p

    (⟨i p⟩ − ⟨i⟩⟨p⟩) / √((⟨i²⟩ − ⟨i⟩²) (⟨p²⟩ − ⟨p⟩²))

Where nothing is hidden ⟨i⟩ is 0 and ⟨i²⟩ is 1 for a standardised template, and the score is ⟨i p⟩
over the patch's standard deviation: the unmasked correlation is the special case that skips the
sums over hidden angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, SingleArray


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """Polar templates, prepared for `correlate`: t of them."""

    images: FloatArray  # (t, rows, angles)
    weights: FloatArray  # (rows,): of each row's samples; they sum to 1 over all samples
    # (t, rows, 2 frequencies): of the standardised images along the angle, weighted: real parts,
    # then imaginary ones
    spectra: SingleArray
    # (2 t, 2 angles): weighted sums over the rows, of the standardised images and then of their
    # squares, as functions of the turn: backwards and twice around, so that the turns by 0, 1, … of
    # what is at the angle a are the slice that begins at angles − a
    moments: SingleArray
    # (angles, 2 frequencies): takes samples along the angle to their Fourier coefficients
    to_spectrum: SingleArray
    to_turns: SingleArray  # (2 frequencies, angles): takes Fourier coefficients back to samples


def bank_of(images: FloatArray, row_weights: FloatArray, frequencies: int) -> Bank:
    """Prepare templates (t, rows, angles), given the weights of their rows (rows,).

    Parameters
    ----------
    images : (t, rows, angles) array
        The number of angles is even.
    row_weights : (rows,) array
    frequencies : int
        How many of the lowest, the constant included, are compared; less than angles / 2. What is
        blurred has no others, and the costs are proportional to them.
    """
    angles = images.shape[2]
    weights = row_weights / (angles * np.sum(row_weights))
    centred = images - np.einsum("tra,r->t", images, weights)[:, None, None]
    centred /= np.sqrt(np.einsum("tra,tra,r->t", centred, centred, weights))[:, None, None]
    to_spectrum, to_turns = _fourier(angles, frequencies)
    moments = np.concatenate([np.einsum("tra,r->ta", centred**k, weights) for k in (1, 2)])
    backwards = np.tile(np.roll(moments[:, ::-1], 1, axis=1), 2)
    return Bank(
        images=images,
        weights=weights,
        spectra=((centred * weights[:, None]) @ to_spectrum).astype(np.float32),
        moments=backwards.astype(np.float32),
        to_spectrum=to_spectrum.astype(np.float32),
        to_turns=to_turns.astype(np.float32),
    )


@lru_cache(maxsize=8)
def _fourier(angles: int, frequencies: int) -> tuple[FloatArray, FloatArray]:
    """Return the matrices to Fourier coefficients, real parts before imaginary ones, and back.

    For so few frequencies products with matrices are faster than fast transforms.
    """
    angles_rad = np.linspace(0.0, 2.0 * np.pi, angles, endpoint=False)
    phases = np.arange(frequencies)[:, None] * angles_rad
    waves = np.vstack((np.cos(phases), -np.sin(phases)))
    multiplicity = np.where(np.arange(frequencies) == 0, 1.0, 2.0)  # each has a conjugate
    return waves.T.copy(), waves * np.tile(multiplicity, 2)[:, None] / angles


def correlate(patch: FloatArray, bank: Bank, visible: BoolArray | None = None) -> SingleArray:
    """Score a polar patch against all templates, at all radial shifts and turns.

    Parameters
    ----------
    patch : (rows + shifts − 1, angles) array
        Grey values. Shift s compares the template with the rows from s on.
    visible : (angles,) array of bool, optional
        Which angles of the patch are compared; by default all.

    Returns
    -------
    (t, shifts, angles) array of float32
        Scores, −1…1, by template, shift and lag: the turn of the template, in samples.
    """
    templates, _, angles = bank.images.shape
    share = 1.0 if visible is None else np.count_nonzero(visible) / angles
    masked = patch if visible is None else patch * visible
    spectrum = masked.astype(np.float32) @ bank.to_spectrum
    products, levels = _multiply(masked, spectrum, share, bank.weights, bank.spectra)
    scores = products @ bank.to_turns
    if visible is not None:
        _normalise(scores, bank.moments, visible, levels)
    return np.asarray(scores.reshape(templates, -1, angles))


@compiled
def _multiply(
    patch: FloatArray,
    spectrum: SingleArray,
    share: float,
    weights: FloatArray,
    spectra: SingleArray,
) -> tuple[SingleArray, FloatArray]:
    """Return the Fourier coefficients of ⟨i p⟩ / σ (templates · shifts, parts), and ⟨p⟩ / σ.

    σ² = ⟨p²⟩ − ⟨p⟩², of a patch that is 0 outside a share of its angles. By the theorem of
    correlation, the coefficients are the template's conjugate times the patch's, summed over rows.
    """
    factors, levels = _weigh(patch, share, weights)
    shifts, frequencies = len(factors), spectra.shape[2] // 2
    products = np.zeros((len(spectra) * shifts, 2 * frequencies), np.float32)
    for t in range(len(spectra)):
        for r in range(len(weights)):
            for s in range(shifts):
                product = products[t * shifts + s]
                for f in range(frequencies):
                    real, imaginary = spectrum[s + r, f], spectrum[s + r, frequencies + f]
                    a, b = spectra[t, r, f], spectra[t, r, frequencies + f]
                    product[f] += a * real + b * imaginary
                    product[frequencies + f] += a * imaginary - b * real
        for s in range(shifts):
            for f in range(2 * frequencies):
                products[t * shifts + s, f] *= factors[s]
    return products, levels


@compiled
def _weigh(patch: FloatArray, share: float, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return by shift 1 / (share · σ), and ⟨p⟩ / σ."""
    sums = np.zeros((2, len(patch)))
    for r in range(len(patch)):
        for a in range(0, patch.shape[1], 2):  # two sums each, which do not wait for each other
            left, right = patch[r, a], patch[r, a + 1]
            sums[0, r] += left + right
            sums[1, r] += left * left + right * right
    shifts = len(patch) - len(weights) + 1
    factors, levels = np.empty(shifts), np.empty(shifts)
    for s in range(shifts):
        mean = power = 0.0
        for r in range(len(weights)):
            mean += weights[r] * sums[0, s + r] / share
            power += weights[r] * sums[1, s + r] / share
        deviation = math.sqrt(max(power - mean * mean, 1e-9))
        factors[s], levels[s] = 1.0 / (share * deviation), mean / deviation
    return factors, levels


@compiled
def _normalise(
    products: SingleArray, moments: SingleArray, visible: BoolArray, levels: FloatArray
) -> None:
    """Turn ⟨i p⟩ / σ (templates · shifts, lags) into scores, where parts are hidden.

    ⟨i⟩ and ⟨i²⟩ over the visible angles depend on the lag: what the hidden angles hold is taken
    from the sums all around, which are 0 and 1.
    """
    templates, shifts, angles = len(moments) // 2, len(levels), len(visible)
    sums = np.zeros((2 * templates, angles), np.float32)
    sums[templates:] = 1.0
    for k in range(2 * templates):
        total = sums[k]
        for a in range(angles):
            if not visible[a]:
                hidden = moments[k, angles - a : 2 * angles - a]
                for lag in range(angles):
                    total[lag] -= hidden[lag]
    share = np.float32(visible.sum() / angles)
    for t in range(templates):
        for lag in range(angles):
            mean, power = sums[t, lag] / share, sums[templates + t, lag] / share
            sums[t, lag] = mean
            sums[templates + t, lag] = 1.0 / math.sqrt(max(power - mean * mean, 1e-12))
        means, factors = sums[t], sums[templates + t]
        for s in range(shifts):
            row, level = products[t * shifts + s], np.float32(levels[s])
            for lag in range(angles):
                row[lag] = (row[lag] - level * means[lag]) * factors[lag]
