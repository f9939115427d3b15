"""The code on the black ring: identity and heading of a plate, §2.3 of Cucci (2016)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.settings import DetectSettings
from kgcp.target.circles import Cluster
from kgcp.target.layout import Ring

_SAMPLES = 360
CODE_ANGLES_RAD = np.linspace(0.0, 2.0 * math.pi, _SAMPLES, endpoint=False)
_BLURS_RAD = np.array([0.03, 0.1, 0.18, 0.28])  # edge spreads that the code is tried with
_MAX_MISFIT = 0.45  # of the dots' contrast, over the width of a dot
_MIN_SURROUND = 0.4  # contrast of the plate around the ring, relative to that inside it
_MIN_CONTRAST = 0.02  # of the grey values' range
_HEADING_SLACK = 6  # degrees that a replica's heading may be off
_GAP_PX = 1.5  # distance from an edge at which the plate is seen without the ring


@dataclass(frozen=True, slots=True)
class CodeMatch:
    """A cluster whose representative carries the code of a ring.

    Attributes
    ----------
    ring : Ring
        Whose code it is.
    outer : Ellipse
        Preliminary outer ellipse [px].
    cluster : Cluster
        The concentric circles around it.
    score : float
        Normalised cross-correlation of the code, -1…1.
    lag_deg : float
        Heading of the plate's +x axis as an angle of `Ellipse.points` [deg].
    black, white : float
        Grey levels of ring and plate, in grey values.
    """

    ring: Ring
    outer: Ellipse
    cluster: Cluster
    score: float
    lag_deg: float
    black: float
    white: float


def sample_grey(grey: GreyArray, points: FloatArray) -> FloatArray:
    """Sample a frame bilinearly at points (m, n, 2) [px]; beyond its border it repeats itself."""
    maps = points.astype(np.float32)
    values = cv2.remap(
        grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return values.astype(np.float64)


def code_signals(grey: GreyArray, ellipses: tuple[Ellipse, ...], ratio: float) -> FloatArray:
    """Return grey values (m, 360) along the code circles of m outer ellipses, one per degree.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame.
    ellipses : tuple of m Ellipse
        Outer ellipses [px].
    ratio : float
        Diameter of the code circle relative to the outer one.
    """
    points = np.stack([ellipse.points(CODE_ANGLES_RAD, ratio) for ellipse in ellipses])
    return sample_grey(grey, points)


@lru_cache(maxsize=64)
def reference_signals(ring: Ring) -> FloatArray:
    """Return a ring's code (4, 360) at heading 0: 1 in dots, 0 between, four degrees of blur."""
    degrees = np.degrees(CODE_ANGLES_RAD)
    offset = np.abs((degrees[:, None] - np.array(ring.code_deg) + 180.0) % 360.0 - 180.0)
    sharp = np.clip(ring.dot_half_angle_deg + 0.5 - offset.min(axis=1), 0.0, 1.0)
    frequency = np.arange(_SAMPLES // 2 + 1)
    damping = np.exp(-0.5 * (frequency * _BLURS_RAD[:, None]) ** 2)
    return np.fft.irfft(np.fft.rfft(sharp) * damping, _SAMPLES)


def match_code(signals: FloatArray, ring: Ring) -> tuple[FloatArray, FloatArray]:
    """Return the best normalised cross-correlation over all lags, and the lag (§2.3).

    Parameters
    ----------
    signals : (m, 360) array
        As from `code_signals`.
    ring : Ring
        Whose code is looked for.

    Returns
    -------
    scores, lags_deg : (m,) arrays
        The lag is refined between samples by a parabola.
    """
    wanted = np.conj(np.fft.rfft(_standardised(reference_signals(ring))))
    spectrum = np.fft.rfft(_standardised(signals))[:, None] * wanted
    by_blur = np.fft.irfft(spectrum, _SAMPLES)
    best = by_blur.max(axis=2).argmax(axis=1)
    correlation = by_blur[np.arange(len(best)), best]
    peak = correlation.argmax(axis=1)
    before, top, after = (
        correlation[np.arange(len(peak)), (peak + shift) % _SAMPLES] for shift in (-1, 0, 1)
    )
    bend = np.minimum(before - 2.0 * top + after, -1e-12)
    shift = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return top, (peak + shift) * (360.0 / _SAMPLES) % 360.0


def fixed_lag_score(
    grey: GreyArray,
    points: FloatArray,
    visible: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    ring: Ring,
) -> float:
    """Return the correlation of a code where its heading is known, to a few degrees.

    Parameters
    ----------
    points : (360, 2) array
        The code circle in the frame, from the plate's +x axis on [px].
    visible : (360,) array
        Which of them count.
    """
    signal = sample_grey(grey, points[None])[0][visible]
    lags = np.arange(-_HEADING_SLACK, _HEADING_SLACK + 1)
    references = np.stack([np.roll(reference_signals(ring), lag, axis=1) for lag in lags])
    return float(np.max(_standardised(references[..., visible]) @ _standardised(signal)))


def _standardised(signals: FloatArray) -> FloatArray:
    centred = signals - signals.mean(axis=-1, keepdims=True)
    norm = np.linalg.norm(centred, axis=-1, keepdims=True)
    return np.asarray(centred / np.where(norm > 0.0, norm, 1.0))


def find_code(
    grey: GreyArray, clusters: tuple[Cluster, ...], ring: Ring, settings: DetectSettings
) -> tuple[tuple[CodeMatch, ...], float | None]:
    """Look for a ring's code in all clusters.

    The paper tests the largest circle of each cluster. A shadow or the plate's own outline can be
    concentric and larger, so that here every member is tested and the best one counts.

    Returns
    -------
    matches : tuple of CodeMatch
        Best first, at most one per place.
    best_score : float or None
        The best correlation seen anywhere, None without any cluster.
    """
    owners = [cluster for cluster in clusters for _ in cluster.ellipses]
    ellipses = tuple(ellipse for cluster in clusters for ellipse in cluster.ellipses)
    if not ellipses:
        return (), None
    signals = code_signals(grey, ellipses, ring.code_diameter_m / ring.outer_diameter_m)
    scores, lags = match_code(signals, ring)
    matches: list[CodeMatch] = []
    for index in np.argsort(-scores, kind="stable"):
        if scores[index] < settings.min_score:
            break
        outer, score, lag = ellipses[index], float(scores[index]), float(lags[index])
        if any(_overlap(outer, match.outer) for match in matches):
            continue
        levels = ring_levels(grey, outer, ring, signals[index], lag)
        if levels is not None:
            matches.append(CodeMatch(ring, outer, owners[index], score, lag, *levels))
    return tuple(matches), float(scores.max())


def _overlap(one: Ellipse, other: Ellipse) -> bool:
    reach = max(one.a, other.a)
    return math.hypot(one.x - other.x, one.y - other.y) < reach


def ring_levels(
    grey: GreyArray, outer: Ellipse, ring: Ring, signal: FloatArray, lag_deg: float
) -> tuple[float, float] | None:
    """Return the levels (black, white) of a matching ring, None for another code or no ring.

    Codes that share dots correlate well with each other. Here each dot must be bright and each
    gap dark on its own: over the width of a dot the signal may not differ from the reference by
    more than a share of the dots' contrast. And the ring must be dark against both its disc and
    the plate around it, most of the way round.
    """
    contrast, black, misfit = _code_misfit(signal, ring, lag_deg)
    whites = _surround(grey, outer, ring)
    white = float(np.median(whites))
    full_range = float(np.iinfo(grey.dtype).max)
    dark_enough = white - black > max(_MIN_SURROUND * contrast, _MIN_CONTRAST * full_range)
    bright_around = np.quantile(whites, 0.25, axis=1) - black > _MIN_SURROUND * (white - black)
    if misfit > _MAX_MISFIT or not dark_enough or not bright_around.all():
        return None
    return black, white


def _code_misfit(signal: FloatArray, ring: Ring, lag_deg: float) -> tuple[float, float, float]:
    """Fit contrast and black level; return them and the largest misfit over a dot's width."""
    frequency = np.arange(_SAMPLES // 2 + 1)
    turn = np.exp(-1j * frequency * math.radians(lag_deg))
    turned = np.fft.irfft(np.fft.rfft(reference_signals(ring)) * turn, _SAMPLES)
    centred = turned - turned.mean(axis=1, keepdims=True)
    contrasts = centred @ signal / np.sum(centred**2, axis=1)
    blacks = signal.mean() - contrasts * turned.mean(axis=1)
    residuals = signal - blacks[:, None] - contrasts[:, None] * turned
    best = int(np.argmin(np.sum(residuals**2, axis=1)))
    contrast, black = float(contrasts[best]), float(blacks[best])
    misfit = _smoothed(residuals[best], ring.dot_half_angle_deg)
    return contrast, black, float(np.abs(misfit).max() / contrast)


def _smoothed(signal: FloatArray, half_width_deg: float) -> FloatArray:
    """Average a periodic signal (360,) over ± half_width_deg."""
    half = max(1, round(half_width_deg * _SAMPLES / 360.0))
    window = np.zeros(_SAMPLES)
    window[np.arange(-half, half + 1)] = 1.0 / (2 * half + 1)
    return np.fft.irfft(np.fft.rfft(signal) * np.fft.rfft(window), _SAMPLES)


def _surround(grey: GreyArray, outer: Ellipse, ring: Ring) -> FloatArray:
    """Grey values (2, 360) of the plate just outside the ring and just inside it."""
    gap = _GAP_PX / outer.mean_radius
    factors = (1.0 + max(gap, 0.1), ring.inner_ratio - min(max(gap, 0.1), 0.5 * ring.inner_ratio))
    return sample_grey(grey, np.stack([outer.points(CODE_ANGLES_RAD, f) for f in factors]))
