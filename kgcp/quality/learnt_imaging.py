"""Properties of the camera from all frames of a flight: tone curve, sharpening, noise.

An unknown tone curve is modelled as a modification of a known curve, its base. Two bases are tried
in each frame. A single frame may prefer the wrong one, but all frames come from one camera;
therefore their log-likelihoods are added. For a given base, each frame keeps its own tone and
sharpening, because knowing them beforehand would improve distances by only 2 % of their standard
deviations. Smoothing along contours is learnt from all frames (docs/method/shared_imaging.md).
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

_MAX_FRAME_ADVANTAGE = 30.0  # of log-likelihood, so that no single frame decides
# Largest sum of advantages against the chosen base, as share of the sum for it. In simulated
# frames it is below 0.01 with a film-like curve (40 frames) and 0.1 with sRGB's curve (40 frames).
# It is 0.5 with a film-like curve, sharpening and JPEG (54 frames), and as much against the right
# base in flights of sRGB cameras with dirt.
_MAX_SHARE_AGAINST = 0.2
# Least sum of advantages with which the first frames decide for all others: at least 5 clear ones.
_CLEAR_ADVANTAGE = 5.0 * _MAX_FRAME_ADVANTAGE
# The base does not matter if this quantile of the distances' differences between both bases is
# below this share of a standard deviation, in at least this many frames. The quantile is 0.02 in
# flights with rolling shutters and 0.2 to 0.3 with film-like curves; it is 0.5 to 1.3 with
# highlights, phones or dirt.
_SAME_DISTANCE_SIGMAS, _SAME_DISTANCE_QUANTILE, _MIN_FRAMES = 0.35, 0.8, 12
# A measurement whose own base has a larger advantage over the common one keeps its base. With dirt,
# distances over the common base were often wrong by up to 3 σ.
_MAX_OVERRULED_ADVANTAGE = 100.0
_STEPS = 64  # of the curve, over the whole range of grey values
_ROUNDS = 3  # of scaling curves to their median
_PERCENTILES = (16.0, 50.0, 84.0)  # median and ±1σ
_MIN_MEASUREMENTS = 3  # at a grey value


@dataclass(frozen=True, slots=True, eq=False)
class LearntImaging:
    """Properties of the camera from all frames of a flight."""

    # the base of the tone curve that is likelier for all measurements together; None if these do
    # not agree, because the curve is near neither base
    base: ToneBase | None
    # sum over frames of the log-likelihood ratio in favour of each base, at most 30 per frame
    advantages: Mapping[ToneBase, float]
    measurements: int  # those made over both bases, in the frames that decided
    # measurements that by themselves prefer another base
    overruled: int  # those of them that take the common base
    kept_own_base: int  # those of them that keep their own, because it is far likelier
    grey: FloatArray  # (n,): grey values, 0…1 of their range
    # (3, n): light of these grey values; 1 is that of sRGB at full scale. Percentiles 16, 50 and 84
    # of the measurements; NaN: fewer than three measurements have such grey values
    light: FloatArray
    sharpening: FloatArray  # (3,): the same percentiles of the unsharp mask's strength
    noise: FloatArray  # (m, 2): grey value and standard deviation of ink and plate
    smoothing: CameraSmoothing  # along contours


def clearly_agreed_base(results: Iterable[FrameResult]) -> ToneBase | None:
    """Return the base that frames agree on so clearly that others need not be tried; else None."""
    advantages = _advantages(results)
    base = _agreed(advantages)
    return None if base is None or advantages[base] < _CLEAR_ADVANTAGE else base


def base_if_distances_agree(results: Iterable[FrameResult]) -> ToneBase | None:
    """Return the likelier base if distances over both bases are nearly the same; else None."""
    compared: list[FrameResult] = []
    differences = []
    for result in results:
        frame_differences = [
            abs(each.distance_m - each.rival.measurement.distance_m) / each.sd_distance_m
            for each in _of_unknown_tone(result)
            if each.rival is not None
        ]
        if frame_differences:
            compared.append(result)
            differences.append(max(frame_differences))
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
    """Return the camera's properties by all measurements; None if no tone curve is unknown.

    Parameters
    ----------
    results : iterable of FrameResult
        Of all frames, in any order.
    base : ToneBase, optional
        Base of the tone curve, if it is already decided.  [default: all measurements decide]
    deciding_frames : collection of str, optional
        Frames that have decided it.  [default: all]
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
        sharpening=np.percentile(strengths, _PERCENTILES),
        noise=np.array([pair for imaging in images for pair in _noise_of(imaging)]),
        smoothing=camera_smoothing([each.smoothing for each in learnt if each.smoothing]),
    )


def over_base(measurement: Measurement, base: ToneBase) -> Measurement:
    """Return the measurement over a base, unless it has none or its own base is far likelier."""
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
    """Return the measurements with an unknown tone curve, by target and instance."""
    measured = [each for each in result.outcomes if isinstance(each, Measurement)]
    toned = [each for each in measured if each.imaging is not None]
    return sorted(toned, key=lambda each: (each.target, each.instance))


def _over_both_bases(result: FrameResult) -> list[Measurement]:
    return [each for each in _of_unknown_tone(result) if each.rival is not None]


def _agreed(advantages: Mapping[ToneBase, float]) -> ToneBase | None:
    """Return the likelier base; None if too much of the evidence contradicts it."""
    base = max(advantages, key=lambda each: advantages[each])
    is_agreed = sum(advantages.values()) <= (1.0 + _MAX_SHARE_AGAINST) * advantages[base]
    return base if is_agreed else None


def _advantages(results: Iterable[FrameResult]) -> dict[ToneBase, float]:
    """Return the sums of the frames' log-likelihood ratios in favour of each base."""
    total = dict.fromkeys(ToneBase, 0.0)
    for result in results:
        by_frame = dict.fromkeys(ToneBase, 0.0)
        for each in _over_both_bases(result):
            if each.rival is not None and each.imaging is not None:
                by_frame[each.imaging.base] += each.rival.advantage
        for base, advantage in by_frame.items():
            total[base] += min(advantage, _MAX_FRAME_ADVANTAGE)
    return total


def _noise_of(imaging: Imaging) -> FloatArray:
    levels = encoded(np.array((imaging.black, imaging.white)), TONE_OF_BASE[imaging.base])
    noise = np.stack((levels, (imaging.noise_black, imaging.noise_white)), axis=1)
    return np.asarray(noise[levels < 1.0])  # clipped white shows no noise


def _common_curve(images: list[Imaging], grey: FloatArray) -> FloatArray:
    """Return percentiles (3, n) of the light of grey values.

    A frame determines the curve only between the levels of its ink and its plate, and only up to a
    factor and an offset. These are chosen for the best agreement with the other frames.
    """
    curves = np.array([_light_of_grey(imaging, grey) for imaging in images])
    middle = decoded(grey, Tone.SRGB)
    for _ in range(_ROUNDS):
        scaled = _scaled_to(middle, curves)
        is_known = np.sum(np.isfinite(scaled), axis=0) >= _MIN_MEASUREMENTS
        percentiles = np.full((len(_PERCENTILES), len(grey)), np.nan)
        percentiles[:, is_known] = np.nanpercentile(scaled[:, is_known], _PERCENTILES, axis=0)
        middle = np.where(is_known, percentiles[1], middle)
    return percentiles


def _light_of_grey(imaging: Imaging, grey: FloatArray) -> FloatArray:
    """Return the light (n,) of grey values, 0 for ink and 1 for plate; NaN outside these."""
    share = np.linspace(0.0, 1.0, 4 * _STEPS + 1)
    tone_1, tone_2, tone_3 = imaging.tone
    light = Light(imaging.black, imaging.white, tone_1=tone_1, tone_2=tone_2, tone_3=tone_3)
    toned = apply_tone_uncompiled(share, light)
    levels = np.maximum.accumulate(encoded(toned, TONE_OF_BASE[imaging.base]))
    return np.interp(grey, levels, share, left=np.nan, right=np.nan)


def _scaled_to(middle: FloatArray, curves: FloatArray) -> FloatArray:
    """Return curves (m, n), each with the factor and offset that fit it to the middle (n,).

    A curve with too few known values is NaN.
    """
    is_known = np.isfinite(curves)
    count = np.maximum(is_known.sum(axis=1, keepdims=True), 1)
    x, y = np.where(is_known, curves, 0.0), np.where(is_known, middle, 0.0)
    mean_x, mean_y = (each.sum(axis=1, keepdims=True) / count for each in (x, y))
    centred_x = np.where(is_known, curves - mean_x, 0.0)
    squares = np.sum(centred_x * centred_x, axis=1, keepdims=True)
    is_determined = (count >= _MIN_MEASUREMENTS) & (squares > 0.0)
    factor = np.sum(centred_x * (y - mean_y), axis=1, keepdims=True) / np.where(
        is_determined, squares, np.nan
    )
    return np.asarray(mean_y + factor * (curves - mean_x))
