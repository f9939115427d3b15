"""The code on the black ring: identity and heading of the plate (§2.3 of Cucci 2016)."""

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
from kgcp.measurement.search.correlation import TemplateBank, build_bank, correlate
from kgcp.measurement.search.sampling import sample_grey
from kgcp.targets.layout import Ring

_SAMPLES = 360
CODE_ANGLES_RAD = np.linspace(0.0, 2.0 * math.pi, _SAMPLES, endpoint=False)
CODE_CIRCLE = np.stack((np.cos(CODE_ANGLES_RAD), np.sin(CODE_ANGLES_RAD)), axis=-1)
_BLURS_RAD = np.array([0.03, 0.1, 0.18, 0.28])  # σ of the edges of the reference codes
# Distance from a dot up to which its blur disturbs an edge: samples reach 1.5 px inwards, and blur
# as far again.
_DOT_REACH_PX = 3.0
_MIN_CLEAR = 0.55  # share of an edge that counts as clear of dots in any case
# Frequencies that are compared where the heading is known. The smallest blur reduces higher ones to
# 2e-3.
_FREQUENCIES = 120
_LAGS_AT_HEADING = np.arange(-6, 7)  # by how many degrees a replica's heading may be off


@dataclass(frozen=True, slots=True)
class CodeMatch:
    """A ring in the frame that carries the code of a target's ring."""

    ring: Ring  # the target's ring
    outer: Ellipse  # preliminary outer ellipse in the frame [px]
    score: float  # normalised cross-correlation of the code, -1…1
    lag_deg: float  # direction of the plate's +x axis, as an angle of `Ellipse.points` [deg]
    # levels of ink and plate, in grey values
    black: float
    white: float


@lru_cache(maxsize=64)
def reference_signals(ring: Ring) -> FloatArray:
    """Return a ring's code (4, 360) at heading 0, with four blurs: 1 in dots, 0 between them."""
    degrees = np.degrees(CODE_ANGLES_RAD)
    offset = np.abs((degrees[:, None] - np.array(ring.code_deg) + 180.0) % 360.0 - 180.0)
    sharp = np.clip(ring.dot_half_angle_deg + 0.5 - offset.min(axis=1), 0.0, 1.0)
    frequency = np.arange(_SAMPLES // 2 + 1)
    damping = np.exp(-0.5 * (frequency * _BLURS_RAD[:, None]) ** 2)
    return np.fft.irfft(np.fft.rfft(sharp) * damping, _SAMPLES)


def match_code(signals: FloatArray, ring: Ring) -> tuple[FloatArray, FloatArray]:
    """Return the best normalised cross-correlation over all lags, and its lag (§2.3).

    The score is reported, and the lag determines the heading that the adjustment starts from.
    Therefore all frequencies and double precision are used here, unlike in
    `kgcp.measurement.search.correlation.correlate`.

    Parameters
    ----------
    signals : (m, 360) array
        Grey values along code circles, one per degree.
    ring : Ring
        The ring whose code is compared.

    Returns
    -------
    scores, lags_deg : (m,) arrays
        Lags are interpolated between samples by a parabola.
    """
    by_blur = np.fft.irfft(np.fft.rfft(signals)[:, None] * _reference_spectra(ring), _SAMPLES)
    scores, lags_deg = np.empty(len(signals)), np.empty(len(signals))
    _find_peaks(signals, by_blur, scores, lags_deg)
    return scores, lags_deg


@lru_cache(maxsize=64)
def _reference_spectra(ring: Ring) -> npt.NDArray[np.complex128]:
    """Return the conjugate spectra of the reference signals with mean 0 and norm 1."""
    signals = reference_signals(ring)
    centred = signals - signals.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(centred, axis=1, keepdims=True)
    return np.conj(np.fft.rfft(centred / np.where(norm > 0.0, norm, 1.0)))


@compiled
def _find_peaks(
    signals: FloatArray, by_blur: FloatArray, scores: FloatArray, lags_deg: FloatArray
) -> None:
    """Fill in each signal's highest score over blurs and lags, and the interpolated lag [deg]."""
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
    """Return the score of a code whose heading is known to a few degrees.

    Parameters
    ----------
    points : (360, 2) array
        The code circle in the frame, starting at the plate's +x axis [px].
    visible : (360,) array
        Which of the points are compared.
    """
    scores = correlate(sample_grey(grey, points[None]), _code_circle(ring), visible)
    return float(scores.take(_LAGS_AT_HEADING, axis=2, mode="wrap").max())


@lru_cache(maxsize=64)
def _code_circle(ring: Ring) -> TemplateBank:
    return build_bank(reference_signals(ring)[:, None], np.ones(1), _FREQUENCIES)


def points_of_code(camera: Camera, pose: Pose, ring: Ring) -> FloatArray:
    """Return the code circle that a pose predicts, one point per degree: raw pixels (360, 2)."""
    radius_m = np.array([0.5 * ring.code_diameter_m])
    circles = camera.project_circles(pose.rotation, pose.translation_m, radius_m, CODE_CIRCLE)
    return circles.reshape(-1, 2)


def clear_of_dots(
    angles_rad: FloatArray, ring: Ring, edge_diameter_m: float, lag_deg: float, px_per_m: float
) -> BoolArray:
    """Return for each angle (n,) on an edge whether it is out of reach of all blurred dots.

    On a small ring with many dots no angle may be clear. Then the angles farthest from dots count
    as clear.
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
    """Fill in the distance of each point on one circle from the nearest of the points on another.

    The circles are concentric; their points are given by angles.
    """
    for i in range(len(angles_rad)):
        nearest = -1.0
        for other_rad in others_rad:
            nearest = max(nearest, math.cos(angles_rad[i] - other_rad))
        square = radius**2 + other_radius**2 - 2.0 * radius * other_radius * nearest
        gaps[i] = math.sqrt(max(square, 0.0))
