"""The dots that a ring shows, whatever its code, and whose code they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.measurement.search.code_signal import CODE_CIRCLE
from kgcp.measurement.search.sampling import sample_ellipses
from kgcp.targets.layout import Ring, Target

_RADII = np.array([-0.2, 0.0, 0.2])  # about the code circle, of the dots' diameter
_SMALLEST_PX = 8.0  # radius of a ring whose dots can be told apart
_INK, _BRIGHT = 0.2, 0.98  # quantiles along the code circle: most of it is ink
_LEAST_CONTRAST = 0.25  # of dots, of that of ink and plate
_NARROWEST = 0.4  # of a dot's width: less is noise
_PLATE = 1.1  # of the outer radius
_MOST_MORE = 4  # dots than the code has: more of them are a texture
_SAME_PLACE = 0.3  # of half a dot's width; dots are read to a tenth of it


@dataclass(frozen=True, slots=True)
class DotReading:
    """The dots on a ring, turned so that they lie as close to a code as they can."""

    dots_deg: tuple[float, ...]  # directions of their centres, ascending [deg]
    is_code: bool  # whether they are that code


def read_dots(grey: GreyArray, outline: Ellipse, ring: Ring) -> FloatArray:
    """Return the directions of the dots on a ring, as angles of `Ellipse.points` [deg].

    Parameters
    ----------
    outline : Ellipse
        Its outer circle [px].
    ring : Ring
        Of this geometry, with whatever code.

    Returns
    -------
    (n,) array
        Ascending; empty where the dots do not stand out.
    """
    if outline.b < _SMALLEST_PX:
        return np.empty(0)
    radii = (ring.code_diameter_m + 2.0 * _RADII * ring.dot_diameter_m) / ring.outer_diameter_m
    along = sample_ellipses(grey, (outline,), np.append(radii, _PLATE), CODE_CIRCLE)[0]
    signal, plate = along[:-1].mean(axis=0), float(np.median(along[-1]))
    ink, bright = np.quantile(signal, (_INK, _BRIGHT))
    if bright - ink < _LEAST_CONTRAST * (plate - ink):
        return np.empty(0)
    return _centres_of_runs(signal > 0.5 * (ink + bright), 2.0 * ring.dot_half_angle_deg)


def _centres_of_runs(is_bright: BoolArray, dot_deg: float) -> FloatArray:
    """Return the centres of runs on a circle [deg]; runs as wide as several dots are as many."""
    count = len(is_bright)
    step_deg = 360.0 / count
    starts = np.flatnonzero(is_bright & ~np.roll(is_bright, 1))
    ends = np.flatnonzero(is_bright & ~np.roll(is_bright, -1))
    if not starts.size:  # nothing is bright, or everything
        return np.empty(0)
    centres = []
    for start in starts:
        length = int((ends - start).min(where=ends >= start, initial=count))
        if length == count:  # the run crosses the end of the circle
            length = int(ends[0]) + count - int(start)
        width_deg = (length + 1) * step_deg
        if width_deg < _NARROWEST * dot_deg:
            continue
        dots = max(1, round(width_deg / dot_deg))
        places = (np.arange(dots) + 0.5) / dots * width_deg - 0.5 * step_deg
        centres.append(start * step_deg + places)
    return np.sort(np.concatenate(centres) % 360.0) if centres else np.empty(0)


def turned_to(dots_deg: FloatArray, code_deg: Iterable[float], half_deg: float) -> DotReading:
    """Turn dots (n,) so that as many as possible lie on those of a code.

    Parameters
    ----------
    half_deg : float
        Half the angle that a dot takes.
    """
    code = np.array([*code_deg])
    best, off = _offsets(dots_deg, code, 0.0), 0.0
    for turn_deg in (dots_deg[:, None] - code).ravel():
        offsets = _offsets(dots_deg, code, turn_deg)
        if _rank(offsets, half_deg) < _rank(best, half_deg):
            best, off = offsets, turn_deg
    near = np.abs(best) < half_deg
    off += float(np.median(best[near])) if near.any() else 0.0
    final = _offsets(dots_deg, code, off)
    is_code = len(dots_deg) == len(code) and bool(np.all(np.abs(final) < _SAME_PLACE * half_deg))
    return DotReading(tuple(np.sort((dots_deg - off) % 360.0).tolist()), is_code)


def _offsets(dots_deg: FloatArray, code_deg: FloatArray, turn_deg: float) -> FloatArray:
    """Return how far each dot is from the nearest one of a code that is turned [deg]."""
    differences = (dots_deg[:, None] - turn_deg - code_deg + 180.0) % 360.0 - 180.0
    nearest = np.abs(differences).argmin(axis=1)
    return np.asarray(np.take_along_axis(differences, nearest[:, None], axis=1)[:, 0])


def _rank(offsets_deg: FloatArray, half_deg: float) -> tuple[int, float]:
    """Return what is less, the better dots fit: how many do not, and how far off the others are."""
    near = np.abs(offsets_deg) < half_deg
    return int(np.sum(~near)), float(np.sum(np.abs(offsets_deg[near])))


def describe_dots(
    dots_deg: FloatArray, ring: Ring, target: Target, targets: Iterable[Target]
) -> str | None:
    """Return in words which dots are on a ring that should carry a code, and whose they are.

    Parameters
    ----------
    dots_deg : (n,) array
        By `read_dots`.
    ring : Ring
        Whose code was expected, one of the target's.
    targets : iterable of Target
        All of the flight.

    Returns
    -------
    str or None
        None if they are the expected ones, or none are seen, or more than a code may have.
    """
    if not 0 < len(dots_deg) <= len(ring.code_deg) + _MOST_MORE:
        return None
    half_deg = ring.dot_half_angle_deg
    reading = turned_to(dots_deg, ring.code_deg, half_deg)
    if reading.is_code:
        return None
    text = (
        f"dots at {_listed(reading.dots_deg)} deg, flight.toml has {_listed(ring.code_deg)} for"
        f" {ring.name}"
    )
    mirrored = [-angle for angle in ring.code_deg]
    if turned_to(dots_deg, mirrored, half_deg).is_code:
        return f"{text}: these are its mirror image"
    for other in (target, *(each for each in targets if each is not target)):
        for carrier in other.rings:
            if carrier is not ring and turned_to(dots_deg, carrier.code_deg, half_deg).is_code:
                kind = "its replica" if other is target else "target"
                return f"{text}: these are those of {kind} {carrier.name}"
    return text


def _listed(angles_deg: Iterable[float]) -> str:
    return ", ".join(f"{angle:g}" for angle in sorted(round(angle) % 360 for angle in angles_deg))
