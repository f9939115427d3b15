"""Masked normalised cross-correlation of polar patches with polar templates, at all rotations.

The same score is used for whole rings, for partly hidden rings, and for code circles alone;
docs/method/search.md, "The code", derives it. With ⟨…⟩ the mean over the visible samples, weighted
by row, the score of a template i against a patch p is

    (⟨i p⟩ − ⟨i⟩⟨p⟩) / √((⟨i²⟩ − ⟨i⟩²) (⟨p²⟩ − ⟨p⟩²))

Templates are standardised: over all samples ⟨i⟩ is 0 and ⟨i²⟩ is 1. If nothing is hidden, the score
is therefore ⟨i p⟩ over the patch's standard deviation, and the sums over hidden angles are skipped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, SingleArray


@dataclass(frozen=True, slots=True, eq=False)
class TemplateBank:
    """A set of t polar templates, prepared for `correlate`."""

    images: FloatArray  # (t, rows, angles)
    weights: FloatArray  # (rows,): weight of a sample in each row; the sum over all samples is 1
    # (t, rows, 2 frequencies): weighted Fourier coefficients of the standardised images along the
    # angle, real parts before imaginary ones
    spectra: SingleArray
    # (2 t, 2 angles): weighted sums over the rows of the standardised images, then of their
    # squares. They are stored backwards and repeated, so that the values at angle a for the lags 0,
    # 1, … are the slice that begins at angles − a.
    moments: SingleArray
    to_spectrum: SingleArray  # (angles, 2 frequencies): maps samples to Fourier coefficients
    to_lags: SingleArray  # (2 frequencies, angles): maps Fourier coefficients to samples


def build_bank(images: FloatArray, row_weights: FloatArray, frequencies: int) -> TemplateBank:
    """Prepare polar templates for `correlate`.

    Parameters
    ----------
    images : (t, rows, angles) array
        The templates. The number of angles must be even.
    row_weights : (rows,) array
        Weights of the rows, in any unit.
    frequencies : int
        Number of the lowest frequencies that are compared, including the constant; less than angles
        / 2. Blurred images contain no higher ones, and the cost is proportional to this number.
    """
    angles = images.shape[2]
    weights = row_weights / (angles * np.sum(row_weights))
    centred = images - np.einsum("tra,r->t", images, weights)[:, None, None]
    centred /= np.sqrt(np.einsum("tra,tra,r->t", centred, centred, weights))[:, None, None]
    to_spectrum, to_lags = _fourier(angles, frequencies)
    moments = np.concatenate([np.einsum("tra,r->ta", centred**k, weights) for k in (1, 2)])
    backwards = np.tile(np.roll(moments[:, ::-1], 1, axis=1), 2)
    return TemplateBank(
        images=images,
        weights=weights,
        spectra=((centred * weights[:, None]) @ to_spectrum).astype(np.float32),
        moments=backwards.astype(np.float32),
        to_spectrum=to_spectrum.astype(np.float32),
        to_lags=to_lags.astype(np.float32),
    )


@lru_cache(maxsize=8)
def _fourier(angles: int, frequencies: int) -> tuple[FloatArray, FloatArray]:
    """Return the matrices from samples to Fourier coefficients and back.

    Coefficients are real parts, then imaginary parts. For so few frequencies, matrix products are
    faster than fast Fourier transforms.
    """
    angles_rad = np.linspace(0.0, 2.0 * np.pi, angles, endpoint=False)
    phases = np.arange(frequencies)[:, None] * angles_rad
    waves = np.vstack((np.cos(phases), -np.sin(phases)))
    multiplicity = np.where(np.arange(frequencies) == 0, 1.0, 2.0)  # 2: counts the conjugate, too
    return waves.T.copy(), waves * np.tile(multiplicity, 2)[:, None] / angles


def correlate(
    patch: FloatArray, bank: TemplateBank, visible: BoolArray | None = None
) -> SingleArray:
    """Score a polar patch against all templates, at all radial shifts and rotations.

    Parameters
    ----------
    patch : (rows + shifts − 1, angles) array
        Grey values. Shift s compares the template with the rows from s on.
    visible : (angles,) array of bool, optional
        Which angles of the patch are compared; all by default.

    Returns
    -------
    (t, shifts, angles) array of float32
        Scores, −1…1, by template, shift and lag. The lag is the rotation of the template in
        samples.
    """
    templates, _, angles = bank.images.shape
    share = 1.0 if visible is None else np.count_nonzero(visible) / angles
    masked = patch if visible is None else patch * visible
    spectrum = masked.astype(np.float32) @ bank.to_spectrum
    products, levels = _multiply(masked, spectrum, share, bank.weights, bank.spectra)
    scores = products @ bank.to_lags
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

    σ² is ⟨p²⟩ − ⟨p⟩². The patch is 0 at hidden angles, and `share` of its angles are visible. By
    the correlation theorem, the coefficients are the template's conjugate ones times the patch's,
    summed over the rows.
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
    """Return 1 / (share · σ) and ⟨p⟩ / σ for each shift."""
    sums = np.zeros((2, len(patch)))
    for r in range(len(patch)):
        for a in range(0, patch.shape[1], 2):  # two at a time: independent additions are faster
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
    """Convert ⟨i p⟩ / σ (templates · shifts, lags) to scores, if parts are hidden.

    ⟨i⟩ and ⟨i²⟩ over the visible angles depend on the lag. They are computed by subtracting the
    hidden angles from the sums over all angles, which are 0 and 1.
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
