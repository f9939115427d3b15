"""What a coded ring looks like around its centre, for every blur and exposure: polar templates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import FloatArray
from kgcp.target.layout import Ring

ANGLES = 120
_FREQUENCIES = 24  # a dot is wider than a wave of the highest
ANGLES_RAD: FloatArray = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
# From real and imaginary parts of the frequencies to samples: `irfft` of 24 of 61 frequencies.
_PHASES = ANGLES_RAD[:, None] * np.arange(_FREQUENCIES)
_WAVES: FloatArray = (
    np.hstack((np.cos(_PHASES), -np.sin(_PHASES)))
    * np.tile(np.where(np.arange(_FREQUENCIES) == 0, 1.0, 2.0), 2)
    / ANGLES
)
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
    spectra : (frequencies, t, rows) array of complex
        Of the standardised images along the angle, weighted, conjugated.
    weights : (rows,) array
        Of each row's samples, by its area; they sum to 1 over all samples.
    """

    images: FloatArray
    spectra: np.ndarray[tuple[int, ...], np.dtype[np.complex128]]
    weights: FloatArray


@lru_cache(maxsize=64)
def templates_of(ring: Ring) -> Templates:
    """Draw the ring's templates for all `LOOKS`."""
    drawing = _draw(ring)
    circle = np.stack((np.cos(ANGLES_RAD), np.sin(ANGLES_RAD)), axis=-1)
    points = _PX * (_REACH + _TEMPLATE_RADII[:, None, None] * circle).astype(np.float32)
    images = []
    for blur, clip in LOOKS:
        blurred = cv2.GaussianBlur(drawing, (0, 0), _PX * blur)
        polar = cv2.remap(blurred, points[..., 0], points[..., 1], cv2.INTER_LINEAR)
        images.append(np.minimum(polar, clip) / clip)
    stack = np.array(images, dtype=np.float64)
    weights = _TEMPLATE_RADII**2 / (ANGLES * np.sum(_TEMPLATE_RADII**2))
    centred = stack - np.einsum("tra,r->t", stack, weights)[:, None, None]
    centred /= np.sqrt(np.einsum("tra,tra,r->t", centred, centred, weights))[:, None, None]
    spectra = np.conj(np.fft.rfft(centred * weights[:, None], axis=2)[..., :_FREQUENCIES])
    spectra = spectra.transpose(2, 0, 1).copy()
    return Templates(stack, spectra, weights)


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


def best_template(patch: FloatArray, templates: Templates) -> tuple[float, int, int, int]:
    """Return score, template, shift and lag (in samples) that fit a polar patch best.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    """
    rows = templates.images.shape[1]
    window = np.arange(len(patch) - rows + 1)[:, None] + np.arange(rows)
    sums = np.stack((patch.sum(axis=1), np.einsum("ra,ra->r", patch, patch)))
    mean, power = sums[:, window] @ templates.weights
    sd = np.sqrt(np.maximum(power - mean**2, 1e-9))
    spectrum = np.fft.rfft(patch, axis=1)[:, :_FREQUENCIES].T
    products = (templates.spectra @ spectrum[:, window.T]).reshape(_FREQUENCIES, -1)
    correlation = (_WAVES @ np.concatenate((products.real, products.imag))).reshape(
        ANGLES, len(templates.images), -1
    )
    correlation /= sd
    top = int(correlation.argmax())
    lag, template, shift = np.unravel_index(top, correlation.shape)
    return float(correlation.ravel()[top]), int(template), int(shift), int(lag)
