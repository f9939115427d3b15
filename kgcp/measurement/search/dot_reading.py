"""The dots on a ring with an unknown code, and which target they belong to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.measurement.search.code_signal import CODE_CIRCLE
from kgcp.measurement.search.sampling import sample_ellipses
from kgcp.targets.layout import Ring, Target

# Of the sampled circles from the code circle, in dot diameters.
_RADIAL_OFFSETS = np.array([-0.2, 0.0, 0.2])
_MIN_RADIUS_PX = 8.0  # of a ring whose dots can be told apart
# Quantiles of the grey values along the code circle that count as ink and as dots; most of the
# circle is ink.
_INK_QUANTILE, _DOT_QUANTILE = 0.2, 0.98
_MIN_DOT_CONTRAST = 0.25  # relative to the contrast of ink and plate
_MIN_WIDTH = 0.4  # relative to a dot's width; narrower runs are noise
_PLATE_RADIUS = 1.1  # where the plate is sampled, relative to the outer radius
_MAX_EXTRA_DOTS = 4  # compared with the code; if there are more, it is a texture
# Distance up to which two dots coincide, relative to half a dot's width. Dots are read to a tenth
# of half a width.
_MAX_OFFSET = 0.3


@dataclass(frozen=True, slots=True)
class DotReading:
    """The dots on a ring, rotated to agree with a code as well as possible."""

    dots_deg: tuple[float, ...]  # directions of their centres, ascending [deg]
    is_code: bool  # whether they are that code


def read_dots(grey: GreyArray, outline: Ellipse, ring: Ring) -> FloatArray:
    """Return the directions of the dots on a ring, as angles of `Ellipse.points` [deg].

    Parameters
    ----------
    outline : Ellipse
        Outer circle of the ring in the frame [px].
    ring : Ring
        Gives the geometry of the ring; its code does not matter.

    Returns
    -------
    (n,) array
        Ascending. Empty if the ring is too small or the dots do not stand out.
    """
    if outline.b < _MIN_RADIUS_PX:
        return np.empty(0)
    radii = (
        ring.code_diameter_m + 2.0 * _RADIAL_OFFSETS * ring.dot_diameter_m
    ) / ring.outer_diameter_m
    along = sample_ellipses(grey, (outline,), np.append(radii, _PLATE_RADIUS), CODE_CIRCLE)[0]
    signal, plate = along[:-1].mean(axis=0), float(np.median(along[-1]))
    ink, dots = np.quantile(signal, (_INK_QUANTILE, _DOT_QUANTILE))
    if dots - ink < _MIN_DOT_CONTRAST * (plate - ink):
        return np.empty(0)
    return _centres_of_runs(signal > 0.5 * (ink + dots), 2.0 * ring.dot_half_angle_deg)


def _centres_of_runs(is_bright: BoolArray, dot_deg: float) -> FloatArray:
    """Return the directions [deg] of dots from runs of bright samples around a circle.

    A run as wide as several dots counts as that many dots.
    """
    count = len(is_bright)
    step_deg = 360.0 / count
    starts = np.flatnonzero(is_bright & ~np.roll(is_bright, 1))
    ends = np.flatnonzero(is_bright & ~np.roll(is_bright, -1))
    if not starts.size:  # no sample is bright, or all are
        return np.empty(0)
    centres = []
    for start in starts:
        length = int((ends - start).min(where=ends >= start, initial=count))
        if length == count:  # the run continues at the start of the array
            length = int(ends[0]) + count - int(start)
        width_deg = (length + 1) * step_deg
        if width_deg < _MIN_WIDTH * dot_deg:
            continue
        dots = max(1, round(width_deg / dot_deg))
        places = (np.arange(dots) + 0.5) / dots * width_deg - 0.5 * step_deg
        centres.append(start * step_deg + places)
    return np.sort(np.concatenate(centres) % 360.0) if centres else np.empty(0)


def align_dots(dots_deg: FloatArray, code_deg: Iterable[float], half_deg: float) -> DotReading:
    """Rotate dots (n,) so that as many as possible coincide with those of a code.

    Parameters
    ----------
    half_deg : float
        Half the angle that a dot subtends.
    """
    code = np.array([*code_deg])
    best, best_turn_deg = _offsets(dots_deg, code, 0.0), 0.0
    for turn_deg in (dots_deg[:, None] - code).ravel():
        offsets = _offsets(dots_deg, code, turn_deg)
        if _misalignment(offsets, half_deg) < _misalignment(best, half_deg):
            best, best_turn_deg = offsets, turn_deg
    near = np.abs(best) < half_deg
    best_turn_deg += float(np.median(best[near])) if near.any() else 0.0
    final = _offsets(dots_deg, code, best_turn_deg)
    is_code = len(dots_deg) == len(code) and bool(np.all(np.abs(final) < _MAX_OFFSET * half_deg))
    return DotReading(tuple(np.sort((dots_deg - best_turn_deg) % 360.0).tolist()), is_code)


def _offsets(dots_deg: FloatArray, code_deg: FloatArray, turn_deg: float) -> FloatArray:
    """Return the angle of each dot from the nearest dot of a code rotated by `turn_deg` [deg]."""
    differences = (dots_deg[:, None] - turn_deg - code_deg + 180.0) % 360.0 - 180.0
    nearest = np.abs(differences).argmin(axis=1)
    return np.asarray(np.take_along_axis(differences, nearest[:, None], axis=1)[:, 0])


def _misalignment(offsets_deg: FloatArray, half_deg: float) -> tuple[int, float]:
    """Return how many dots do not coincide with the code, and the sum of the others' offsets."""
    near = np.abs(offsets_deg) < half_deg
    return int(np.sum(~near)), float(np.sum(np.abs(offsets_deg[near])))


def describe_dots(
    dots_deg: FloatArray, ring: Ring, target: Target, targets: Iterable[Target]
) -> str | None:
    """Describe dots that differ from the expected code, and the ring they belong to.

    Parameters
    ----------
    dots_deg : (n,) array
        Result of `read_dots`.
    ring : Ring
        The ring of the target whose code was expected.
    targets : iterable of Target
        All targets of the flight.

    Returns
    -------
    str or None
        None if the dots are the expected ones, if there are none, or if there are too many for a
        code.
    """
    if not 0 < len(dots_deg) <= len(ring.code_deg) + _MAX_EXTRA_DOTS:
        return None
    half_deg = ring.dot_half_angle_deg
    reading = align_dots(dots_deg, ring.code_deg, half_deg)
    if reading.is_code:
        return None
    text = (
        f"dots at {_listed(reading.dots_deg)} deg, flight.toml has {_listed(ring.code_deg)} for"
        f" {ring.name}"
    )
    mirrored = [-angle for angle in ring.code_deg]
    if align_dots(dots_deg, mirrored, half_deg).is_code:
        return f"{text}: these are its mirror image"
    for other in (target, *(each for each in targets if each is not target)):
        for carrier in other.rings:
            if carrier is not ring and align_dots(dots_deg, carrier.code_deg, half_deg).is_code:
                kind = "its replica" if other is target else "target"
                return f"{text}: these are those of {kind} {carrier.name}"
    return text


def _listed(angles_deg: Iterable[float]) -> str:
    return ", ".join(f"{angle:g}" for angle in sorted(round(angle) % 360 for angle in angles_deg))
