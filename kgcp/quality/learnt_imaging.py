"""What the frames of a flight say together of their camera: tone curve, sharpening, noise.

An unknown tone curve is fitted over two bases. One frame alone may prefer the wrong one, but all
frames come from one camera: their log-likelihoods are added up. Within a base, each frame keeps its
own tone and sharpening, since knowing them beforehand would improve distances by only 2 % of their
standard deviations. Smoothing along contours is learnt from all frames (docs/method.md, "What a
flight shares").
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.adjustment.appearance import TONE_OF_BASE
from kgcp.measurement.adjustment.smoothing import CameraSmoothing, camera_smoothing
from kgcp.measurement.image_model.photometry import (
    Light,
    Tone,
    apply_tone_uncompiled,
    decoded,
    encoded,
)
from kgcp.measurement.records import FrameResult, Imaging, Measurement, ToneBase

_MAX_FRAME_ADVANTAGE = 30.0  # of log-likelihood: no single frame decides
# Share of the sum for a base that may speak against it. Of simulated frames, 40 with a film-like
# curve have less than 0.01 and 40 with sRGB's curve 0.1; 54 with a film-like curve, sharpening and
# JPEG have 0.5, and so do flights of sRGB cameras with dirt, against the right base.
_MAX_SHARE_AGAINST = 0.2
# Advantage from which the first frames decide for all others: that of 5 clear frames or more.
_CLEAR_ADVANTAGE = 5.0 * _MAX_FRAME_ADVANTAGE
# The base does not matter if four of five distances, in at least so many frames, differ by less
# than this share of their standard deviations. In flights with rolling shutters the share is 0.02,
# with film-like curves 0.2 to 0.3; under highlights, with phones and with dirt 0.5 to 1.3.
_SAME_DISTANCE_SIGMAS, _SAME_DISTANCE_QUANTILE, _MIN_FRAMES = 0.35, 0.8, 12
# A measurement that prefers its own base to that of all by more than this keeps it: with dirt, its
# fit over the common base has often ended up to 3 σ off.
_MAX_OVERRULED_ADVANTAGE = 100.0
_STEPS = 64  # of the curve, over the whole range of grey values
_ROUNDS = 3
_BAND = (16.0, 50.0, 84.0)  # percentiles: ±1σ
_MIN_MEASUREMENTS = 3  # measurements at a grey value


@dataclass(frozen=True, slots=True, eq=False)
class LearntImaging:
    """What a flight says of its camera."""

    # the base of the tone curve that makes all measurements together likelier; None if they do not
    # agree, because the curve is near neither
    base: ToneBase | None
    # sums of the log-likelihoods by which frames prefer a base, each at most 30
    advantages: Mapping[ToneBase, float]
    measurements: int  # those made over both bases, in the frames that decided
    # measurements that by themselves prefer another base: how many take the base of all, and how
    # many keep their own because they are much likelier over it
    overruled: int
    kept_own_base: int
    grey: FloatArray  # (n,): grey values, 0…1 of their range
    # (3, n): light of these grey values, 1 = that of sRGB at full scale: percentiles 16, 50, 84 of
    # the measurements; NaN where fewer than three have such grey values
    light: FloatArray
    sharpening: FloatArray  # (3,): the same of the strength of the unsharp mask
    # (m, 2): grey value and standard deviation of ink and plate of every measurement
    noise: FloatArray
    smoothing: CameraSmoothing  # along contours


def clearly_agreed_base(results: Iterable[FrameResult]) -> ToneBase | None:
    """Return the base that some frames agree on so clearly that the others need not decide.

    None if they do not.
    """
    advantages = _advantages(results)
    base = _agreed(advantages)
    return None if base is None or advantages[base] < _CLEAR_ADVANTAGE else base


def base_if_distances_agree(results: Iterable[FrameResult]) -> ToneBase | None:
    """Return the likelier base if frames have nearly the same distances over both; else None."""
    compared: list[FrameResult] = []
    differences = []
    for result in results:
        of_frame = [
            abs(each.distance_m - each.rival.measurement.distance_m) / each.sd_distance_m
            for each in _of_unknown_tone(result)
            if each.rival is not None
        ]
        if of_frame:
            compared.append(result)
            differences.append(max(of_frame))
    if len(differences) < _MIN_FRAMES:
        return None
    if np.quantile(differences, _SAME_DISTANCE_QUANTILE) > _SAME_DISTANCE_SIGMAS:
        return None
    advantages = _advantages(compared)
    return max(advantages, key=lambda each: advantages[each])


def learn_imaging(
    results: Iterable[FrameResult],
    base: ToneBase | None = None,
    deciding_frames: Collection[str] | None = None,
) -> LearntImaging | None:
    """Return what all measurements say together; None if no tone is unknown.

    Parameters
    ----------
    results : iterable of FrameResult
        Of all frames. Their order does not matter.
    base : ToneBase, optional
        Of the tone curve, if it is already decided; by default, all measurements decide.
    deciding_frames : collection of str, optional
        Those that have decided it; by default, all.
    """
    results = sorted(results, key=lambda result: result.frame)
    deciding = [
        result for result in results if deciding_frames is None or result.frame in deciding_frames
    ]
    over_both = [each for result in deciding for each in _over_both_bases(result)]
    if not over_both:
        return None
    advantages = _advantages(deciding)
    if base is None:
        base = _agreed(advantages)
    chosen = [each for result in results for each in _of_unknown_tone(result)]
    learnt = chosen if base is None else [over_base(each, base) for each in chosen]
    images = [each.imaging for each in learnt if each.imaging is not None]
    grey = np.linspace(0.0, 1.0, _STEPS + 1)
    strengths = [imaging.sharpening for imaging in images]
    return LearntImaging(
        base=base,
        advantages=advantages,
        measurements=len(over_both),
        overruled=sum(after is not before for before, after in zip(chosen, learnt, strict=True)),
        kept_own_base=sum(base is not None and imaging.base is not base for imaging in images),
        grey=grey,
        light=_common_curve(images, grey),
        sharpening=np.percentile(strengths, _BAND),
        noise=np.array([pair for imaging in images for pair in _noise_of(imaging)]),
        smoothing=camera_smoothing([each.smoothing for each in learnt if each.smoothing]),
    )


def over_base(measurement: Measurement, base: ToneBase) -> Measurement:
    """Return a measurement over a base, unless it has none over that or is much worse there."""
    rival, imaging = measurement.rival, measurement.imaging
    if rival is None or imaging is None or imaging.base is base:
        return measurement
    if rival.advantage > _MAX_OVERRULED_ADVANTAGE:
        return measurement
    return replace(
        rival.measurement,
        instance=measurement.instance,
        is_guided=measurement.is_guided,
        rival=replace(rival, measurement=replace(measurement, rival=None)),
    )


def _of_unknown_tone(result: FrameResult) -> list[Measurement]:
    """Return the measurements over a base of the tone curve, by target and instance."""
    measured = [each for each in result.outcomes if isinstance(each, Measurement)]
    toned = [each for each in measured if each.imaging is not None]
    return sorted(toned, key=lambda each: (each.target, each.instance))


def _over_both_bases(result: FrameResult) -> list[Measurement]:
    return [each for each in _of_unknown_tone(result) if each.rival is not None]


def _agreed(advantages: Mapping[ToneBase, float]) -> ToneBase | None:
    """Return the base with the larger likelihood; None if much of the evidence contradicts it."""
    base = max(advantages, key=lambda each: advantages[each])
    is_agreed = sum(advantages.values()) <= (1.0 + _MAX_SHARE_AGAINST) * advantages[base]
    return base if is_agreed else None


def _advantages(results: Iterable[FrameResult]) -> dict[ToneBase, float]:
    """Return the sums of the log-likelihoods by which frames prefer a base, each bounded."""
    total = dict.fromkeys(ToneBase, 0.0)
    for result in results:
        of_frame = dict.fromkeys(ToneBase, 0.0)
        for each in _over_both_bases(result):
            if each.rival is not None and each.imaging is not None:
                of_frame[each.imaging.base] += each.rival.advantage
        for base, advantage in of_frame.items():
            total[base] += min(advantage, _MAX_FRAME_ADVANTAGE)
    return total


def _noise_of(imaging: Imaging) -> FloatArray:
    levels = encoded(np.array((imaging.black, imaging.white)), TONE_OF_BASE[imaging.base])
    noise = np.stack((levels, (imaging.noise_black, imaging.noise_white)), axis=1)
    return np.asarray(noise[levels < 1.0])  # clipped white shows none


def _common_curve(images: list[Imaging], grey: FloatArray) -> FloatArray:
    """Return percentiles (3, n) of the light of grey values.

    A frame shows the curve only between its ink and its plate, and only up to a factor and an
    offset. They are chosen so that it comes nearest to the other frames.
    """
    curves = np.array([_light_of_grey(imaging, grey) for imaging in images])
    middle = decoded(grey, Tone.SRGB)
    for _ in range(_ROUNDS):
        scaled = _scaled_to(middle, curves)
        is_known = np.sum(np.isfinite(scaled), axis=0) >= _MIN_MEASUREMENTS
        percentiles = np.full((len(_BAND), len(grey)), np.nan)
        percentiles[:, is_known] = np.nanpercentile(scaled[:, is_known], _BAND, axis=0)
        middle = np.where(is_known, percentiles[1], middle)
    return percentiles


def _light_of_grey(imaging: Imaging, grey: FloatArray) -> FloatArray:
    """Return the light (n,) of grey values, 0 of ink and 1 of plate; NaN beyond them."""
    share = np.linspace(0.0, 1.0, 4 * _STEPS + 1)
    tone_1, tone_2, tone_3 = imaging.tone
    light = Light(imaging.black, imaging.white, tone_1=tone_1, tone_2=tone_2, tone_3=tone_3)
    toned = apply_tone_uncompiled(share, light)
    levels = np.maximum.accumulate(encoded(toned, TONE_OF_BASE[imaging.base]))
    return np.interp(grey, levels, share, left=np.nan, right=np.nan)


def _scaled_to(middle: FloatArray, curves: FloatArray) -> FloatArray:
    """Return curves (m, n), each by the factor and offset that bring it nearest to the middle (n,).

    All NaN of a curve of which too little is known.
    """
    is_known = np.isfinite(curves)
    count = np.maximum(is_known.sum(axis=1, keepdims=True), 1)
    x, y = np.where(is_known, curves, 0.0), np.where(is_known, middle, 0.0)
    mean_x, mean_y = (each.sum(axis=1, keepdims=True) / count for each in (x, y))
    off_x = np.where(is_known, curves - mean_x, 0.0)
    spread = np.sum(off_x * off_x, axis=1, keepdims=True)
    is_told = (count >= _MIN_MEASUREMENTS) & (spread > 0.0)
    factor = np.sum(off_x * (y - mean_y), axis=1, keepdims=True) / np.where(is_told, spread, np.nan)
    return np.asarray(mean_y + factor * (curves - mean_x))
