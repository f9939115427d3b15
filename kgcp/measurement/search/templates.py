"""What a coded ring looks like around its centre, for every blur and exposure: polar templates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray
from kgcp.targets.layout import Ring

SingleArray = npt.NDArray[np.float32]

ANGLES = 120
_FREQUENCIES = 24  # a dot is wider than a wave of the highest
ANGLES_RAD: FloatArray = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
# Between samples and the frequencies' real and imaginary parts: 24 of 61 of `rfft`, and back.
_PHASES = np.arange(_FREQUENCIES)[:, None] * ANGLES_RAD
_SAMPLES: FloatArray = np.vstack((np.cos(_PHASES), -np.sin(_PHASES)))
_SAMPLES *= np.tile(np.where(np.arange(_FREQUENCIES) == 0, 1.0, 2.0), 2)[:, None] / ANGLES
_TO_SAMPLES: SingleArray = _SAMPLES.astype(np.float32)
_TO_FREQUENCIES: FloatArray = np.vstack((np.cos(_PHASES), -np.sin(_PHASES))).T.copy()
_TO_FREQUENCIES_SINGLE: SingleArray = _TO_FREQUENCIES.astype(np.float32)
CIRCLE: FloatArray = np.stack((np.cos(ANGLES_RAD), np.sin(ANGLES_RAD)), axis=-1)
_ROWS = 20
_LOG_STEP = 0.06
_OUTERMOST = 1.15  # of the outer radius: the plate's margin is hardly wider
SHIFTS = 4  # the edge that is seen may be up to so many steps off the true one, either way
_PX = 64  # per outer radius, of the drawing
_REACH = 1.4  # of the drawing, in outer radii
_SUB_PIXEL_BITS = 6
# Blur (σ of the edges, of the outer radius) and where the brightest grey value lies between black
# and white.
LOOKS = (
    *((0.03, 1.0), (0.03, 0.55), (0.03, 0.3)),
    *((0.07, 1.0), (0.07, 0.55), (0.07, 0.3)),
    *((0.11, 1.0), (0.11, 0.55), (0.11, 0.35)),
    *((0.16, 1.0), (0.16, 0.6)),
    *((0.22, 1.0), (0.22, 0.75)),
    (0.30, 1.0),
)

# Radii at which a frame is sampled, of the outer radius that is seen; inwards to outwards.
SAMPLED_RADII: FloatArray = _OUTERMOST * np.exp(
    _LOG_STEP * np.arange(1 - _ROWS - SHIFTS, 1 + SHIFTS)
)
_TEMPLATE_RADII = SAMPLED_RADII[SHIFTS : SHIFTS + _ROWS]


@dataclass(frozen=True, slots=True, eq=False)
class Templates:
    """Polar images of one ring at heading 0, white 1 and black 0: t of them.

    Attributes
    ----------
    images : (t, rows, angles) array
    spectra : (t, rows, 2 frequencies) array of float32
        Of the standardised images along the angle, weighted: real parts, then imaginary ones.
    moments : (2 t, 2 angles) array of float32
        Weighted sums over the rows, of the standardised images and then of their squares, by
        `twice_backwards`.
    weights : (rows,) array
        Of each row's samples, by its area; they sum to 1 over all samples.
    """

    images: FloatArray
    spectra: SingleArray
    moments: SingleArray
    weights: FloatArray


@lru_cache(maxsize=64)
def templates_of(ring: Ring) -> Templates:
    """Draw the ring's templates for all `LOOKS`."""
    drawing = _draw(ring)
    points = _PX * (_REACH + _TEMPLATE_RADII[:, None, None] * CIRCLE).astype(np.float32)
    images = []
    for blur, clip in LOOKS:
        blurred = cv2.GaussianBlur(drawing, (0, 0), _PX * blur)
        polar = cv2.remap(blurred, points[..., 0], points[..., 1], cv2.INTER_LINEAR)
        images.append(np.minimum(polar, clip) / clip)
    stack = np.array(images, dtype=np.float64)
    weights = _TEMPLATE_RADII**2 / (ANGLES * np.sum(_TEMPLATE_RADII**2))
    centred = stack - np.einsum("tra,r->t", stack, weights)[:, None, None]
    centred /= np.sqrt(np.einsum("tra,tra,r->t", centred, centred, weights))[:, None, None]
    spectra = ((centred * weights[:, None]) @ _TO_FREQUENCIES).astype(np.float32)
    moments = np.concatenate([np.einsum("tra,r->ta", centred**k, weights) for k in (1, 2)])
    return Templates(stack, spectra, twice_backwards(moments).astype(np.float32), weights)


def twice_backwards(signals: FloatArray) -> FloatArray:
    """Return signals (…, angles) as (…, 2 angles), such that turns by all lags are slices.

    At the angle a, the signal turned by the lags 0, 1, … is what begins at angles − a.
    """
    return np.tile(np.roll(signals[..., ::-1], 1, axis=-1), 2)


def _draw(ring: Ring) -> npt.NDArray[np.float32]:
    """Draw the ring on white, `_PX` pixels to its outer radius."""
    size = round(2.0 * _REACH * _PX) + 1
    drawing = np.ones((size, size), dtype=np.float32)
    unit = 2.0 / ring.outer_diameter_m
    _disc(drawing, (0.0, 0.0), 1.0, 0.0)
    _disc(drawing, (0.0, 0.0), ring.inner_ratio, 1.0)
    for x, y in unit * ring.dot_centres_m():
        _disc(drawing, (float(x), float(y)), 0.5 * unit * ring.dot_diameter_m, 1.0)
    return drawing


def _disc(
    drawing: npt.NDArray[np.float32], centre: tuple[float, float], radius: float, value: float
) -> None:
    scale = _PX * 2**_SUB_PIXEL_BITS
    x, y = (round((_REACH + c) * scale) for c in centre)
    cv2.circle(drawing, (x, y), round(radius * scale), value, -1, cv2.LINE_8, _SUB_PIXEL_BITS)


@lru_cache(maxsize=64)
def code_rows(ring: Ring) -> tuple[int, int]:
    """Return the first and last row that the dots reach to."""
    radii = SAMPLED_RADII[SHIFTS:-SHIFTS] * ring.outer_diameter_m
    rows = np.flatnonzero(np.abs(radii - ring.code_diameter_m) < ring.dot_diameter_m)
    return int(rows[0]), int(rows[-1])


def best_template(patch: FloatArray, templates: Templates) -> tuple[float, int, int, int]:
    """Return score, template, shift and lag (in samples) that fit a polar patch best.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    """
    spread = levels_by_shift(patch, 1.0, templates.weights)[1]
    products = cross_correlation(patch, templates, 1.0 / spread)
    place, lag = divmod(int(products.argmax()), ANGLES)
    template, shift = divmod(place, len(spread))
    return float(products[place, lag]), template, shift, lag


def cross_correlation(patch: FloatArray, templates: Templates, factors: FloatArray) -> SingleArray:
    """Correlate a polar patch with the standardised templates, at all shifts and lags.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
    templates : Templates
    factors : (shifts,) array
        For the values of each shift.

    Returns
    -------
    (templates · shifts, lags) array of float32
    """
    products = np.zeros((len(LOOKS) * len(factors), 2 * _FREQUENCIES), dtype=np.float32)
    spectrum = patch.astype(np.float32) @ _TO_FREQUENCIES_SINGLE
    _multiply(spectrum, templates.spectra, factors, products)
    return np.asarray(products @ _TO_SAMPLES)


def levels_by_shift(patch: FloatArray, share: float, weights: FloatArray) -> FloatArray:
    """Return mean and standard deviation (2, shifts) of what a template is compared with.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        0 where it is not compared.
    share : float
        Of the angles, that are compared.
    weights : (rows,) array
        Of a template.
    """
    levels = np.empty((2, len(patch) - len(weights) + 1))
    _weigh(patch, share, weights, levels)
    return levels


@compiled
def _weigh(patch: FloatArray, share: float, weights: FloatArray, levels: FloatArray) -> None:
    """Fill in mean and standard deviation of what a template is compared with."""
    sums = np.zeros((2, len(patch)))
    for r in range(len(patch)):
        for a in range(0, ANGLES, 2):  # two sums each, which do not wait for each other
            one, two = patch[r, a], patch[r, a + 1]
            sums[0, r] += one + two
            sums[1, r] += one * one + two * two
    for s in range(levels.shape[1]):
        mean = power = 0.0
        for r in range(len(weights)):
            mean += weights[r] * sums[0, s + r] / share
            power += weights[r] * sums[1, s + r] / share
        levels[0, s], levels[1, s] = mean, math.sqrt(max(power - mean * mean, 1e-9))


@compiled
def _multiply(
    patch: SingleArray, spectra: SingleArray, factors: FloatArray, products: SingleArray
) -> None:
    """Add up the spectra (templates · shifts, parts) of the correlations along the angle."""
    for t in range(spectra.shape[0]):
        for r in range(spectra.shape[1]):
            for s in range(len(factors)):
                product = products[t * len(factors) + s]
                for f in range(_FREQUENCIES):
                    real, imaginary = patch[s + r, f], patch[s + r, _FREQUENCIES + f]
                    a, b = spectra[t, r, f], spectra[t, r, _FREQUENCIES + f]
                    product[f] += a * real + b * imaginary
                    product[_FREQUENCIES + f] += a * imaginary - b * real
    for t in range(spectra.shape[0]):
        for s in range(len(factors)):
            for f in range(2 * _FREQUENCIES):
                products[t * len(factors) + s, f] *= factors[s]
