"""What was learnt from a flight about its camera, as metadata of the table of detections."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.adjustment.smoothing import CameraSmoothing
from kgcp.measurement.records import ToneBase
from kgcp.quality.learnt_imaging import LearntImaging

LEARNT_IMAGING = "learnt_imaging"
"""Key of the metadata."""

_DIGITS = 6


def learnt_text(learnt: LearntImaging) -> str:
    """Return what was learnt as JSON; unknown values are null."""
    return json.dumps(
        {
            "tone_base": None if learnt.base is None else learnt.base.value,
            "advantages": {base.value: round(x, 3) for base, x in learnt.advantages.items()},
            "measurements": learnt.measurements,
            "overruled": learnt.overruled,
            "kept_other": learnt.kept_own_base,
            "grey": _plain(learnt.grey),
            "light": [_plain(percentile) for percentile in learnt.light],
            "sharpening": _plain(learnt.sharpening),
            "noise": [_plain(pair) for pair in learnt.noise],
            "smoothing": {name: round(x, _DIGITS) for name, x in asdict(learnt.smoothing).items()},
        }
    )


def learnt_from_text(text: str) -> LearntImaging:
    """Return what `learnt_text` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the text is anything else.
    """
    parts = json.loads(text)
    return LearntImaging(
        base=None if parts["tone_base"] is None else ToneBase(parts["tone_base"]),
        advantages={ToneBase(base): each for base, each in parts["advantages"].items()},
        measurements=parts["measurements"],
        overruled=parts["overruled"],
        kept_own_base=parts.get("kept_other", 0),  # older tables lack it
        grey=np.array(parts["grey"], dtype=np.float64),
        light=np.array(parts["light"], dtype=np.float64),
        sharpening=np.array(parts["sharpening"], dtype=np.float64),
        noise=np.array(parts["noise"], dtype=np.float64).reshape(-1, 2),
        smoothing=CameraSmoothing(**parts["smoothing"]),
    )


def _plain(values: FloatArray) -> list[float | None]:
    return [round(value, _DIGITS) if np.isfinite(value) else None for value in values.tolist()]
