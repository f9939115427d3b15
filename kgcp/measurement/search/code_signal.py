"""The code on the black ring: identity and heading of a plate, §2.3 of Cucci (2016)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.search.correlation import Bank, bank_of, correlate
from kgcp.measurement.search.sampling import sample_grey
from kgcp.targets.layout import Ring

_SAMPLES = 360
CODE_ANGLES_RAD = np.linspace(0.0, 2.0 * math.pi, _SAMPLES, endpoint=False)
CODE_CIRCLE = np.stack((np.cos(CODE_ANGLES_RAD), np.sin(CODE_ANGLES_RAD)), axis=-1)
_BLURS_RAD = np.array([0.03, 0.1, 0.18, 0.28])  # edge spreads that the code is tried with
_DOT_REACH_PX = 3.0  # samples reach 1.5 px inwards, blur as far again
_MIN_CLEAR = 0.55  # of an edge
_FREQUENCIES = 120  # of a code with a known heading: the least blur leaves 2e-3 of higher ones
_LAGS_AT_HEADING = np.arange(-6, 7)  # degrees that a replica's heading may be off


@dataclass(frozen=True, slots=True)
class CodeMatch:
    """A ring in the frame that carries the code of a target's."""

    ring: Ring  # whose code it is
    outer: Ellipse  # preliminary outer ellipse [px]
    score: float  # normalised cross-correlation of the code, -1…1
    lag_deg: float  # heading of the plate's +x axis as an angle of `Ellipse.points` [deg]
    # grey levels of ring and plate, in grey values
    black: float
    white: float


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

    The score is reported, and the lag turns the pose that the adjustment starts from. Hence all
    frequencies and double precision, unlike `kgcp.measurement.search.correlation.correlate`.

    Parameters
    ----------
    signals : (m, 360) array
        Grey values along code circles, one per degree.
    ring : Ring
        Whose code is looked for.

    Returns
    -------
    scores, lags_deg : (m,) arrays
        The lag is refined between samples by a parabola.
    """
    by_blur = np.fft.irfft(np.fft.rfft(signals)[:, None] * _reference_spectra(ring), _SAMPLES)
    scores, lags_deg = np.empty(len(signals)), np.empty(len(signals))
    _find_peaks(signals, by_blur, scores, lags_deg)
    return scores, lags_deg


@lru_cache(maxsize=64)
def _reference_spectra(ring: Ring) -> npt.NDArray[np.complex128]:
    """Return the conjugate spectra of the reference signals, less their means, of norm 1."""
    signals = reference_signals(ring)
    centred = signals - signals.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(centred, axis=1, keepdims=True)
    return np.conj(np.fft.rfft(centred / np.where(norm > 0.0, norm, 1.0)))


@compiled
def _find_peaks(
    signals: FloatArray, by_blur: FloatArray, scores: FloatArray, lags_deg: FloatArray
) -> None:
    """Fill in the largest value by blur and lag of each signal, and its lag between samples."""
    for i in range(len(signals)):
        correlation, peak = by_blur[i, 0], 0
        for candidate in by_blur[i]:
            best = candidate.argmax()
            if candidate[best] > correlation[peak]:
                correlation, peak = candidate, best
        before, after = correlation[peak - 1], correlation[(peak + 1) % _SAMPLES]
        bend = min(before - 2.0 * correlation[peak] + after, -1e-12)
        shift = min(max(0.5 * (before - after) / bend, -0.5), 0.5)
        lags_deg[i] = (peak + shift) * (360.0 / _SAMPLES) % 360.0
        norm = np.sqrt(np.sum((signals[i] - signals[i].mean()) ** 2))
        scores[i] = correlation[peak] / norm if norm > 0.0 else 0.0


def fixed_lag_score(grey: GreyArray, points: FloatArray, visible: BoolArray, ring: Ring) -> float:
    """Return the correlation of a code where its heading is known, to a few degrees.

    Parameters
    ----------
    points : (360, 2) array
        The code circle in the frame, from the plate's +x axis on [px].
    visible : (360,) array
        Which of them count.
    """
    scores = correlate(sample_grey(grey, points[None]), _code_circle(ring), visible)
    return float(scores.take(_LAGS_AT_HEADING, axis=2, mode="wrap").max())


@lru_cache(maxsize=64)
def _code_circle(ring: Ring) -> Bank:
    return bank_of(reference_signals(ring)[:, None], np.ones(1), _FREQUENCIES)


def points_of_code(camera: Camera, pose: Pose, ring: Ring) -> FloatArray:
    """Return raw pixels (360, 2) of a ring's code circle where a pose puts it, one per degree."""
    radius_m = np.array([0.5 * ring.code_diameter_m])
    circles = camera.project_circles(pose.rotation, pose.translation_m, radius_m, CODE_CIRCLE)
    return circles.reshape(-1, 2)


def clear_of_dots(
    angles_rad: FloatArray, ring: Ring, edge_diameter_m: float, lag_deg: float, px_per_m: float
) -> BoolArray:
    """Return for each angle (n,) on an edge whether the blur of all dots stays away from it.

    On a small ring with many dots no angle may be clear: then those farthest from dots are taken.
    """
    dots_rad = np.radians(np.add(ring.code_deg, lag_deg))
    gap_m = np.empty(len(angles_rad))
    _measure_gaps(angles_rad, 0.5 * edge_diameter_m, dots_rad, 0.5 * ring.code_diameter_m, gap_m)
    gap_m -= 0.5 * ring.dot_diameter_m
    fewest = math.ceil((1.0 - _MIN_CLEAR) * (len(gap_m) - 1))
    reach_m = min(_DOT_REACH_PX / px_per_m, float(np.partition(gap_m, fewest)[fewest]))
    return np.asarray(gap_m >= reach_m)


@compiled
def _measure_gaps(
    angles_rad: FloatArray,
    radius: float,
    others_rad: FloatArray,
    other_radius: float,
    gaps: FloatArray,
) -> None:
    """Fill in how far points of one circle are from the nearest of some points of another."""
    for i in range(len(angles_rad)):
        nearest = -1.0
        for other_rad in others_rad:
            nearest = max(nearest, math.cos(angles_rad[i] - other_rad))
        square = radius**2 + other_radius**2 - 2.0 * radius * other_radius * nearest
        gaps[i] = math.sqrt(max(square, 0.0))
