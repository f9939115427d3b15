"""Detection of targets that were moved during a flight, by the frames that they orient.

Stated positions hide a move that is not much larger than their standard deviations. Frames show it
to a few millimetres: those before and after it give the target two places among the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.network.ground.moved_circle import LEAST_SIDE

_FALSE_ALARM = 1e-7  # probability that one split of one target's frames seems to show two places
# Smallest move that is reported. What is left of other errors looks like smaller ones.
_MIN_OFF_M = 0.01
# What a move must leave: images nearly as good as stated, or a small share of the misfit before. A
# moving camera with a rolling shutter, for example, makes all targets seem to move a little.
_LOW_VARIANCE, _MOST = 4.0, 0.75
# Singular values below this share count as zero: the frames do not determine such a direction.
_MIN_DETERMINED = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class MovedTarget:
    """A target that earlier and later frames see at two places.

    Attributes
    ----------
    target : str
    frame : str
        The first frame that shows the second place.
    off_m : float
        Distance of the two places.
    chi2 : float
        Decrease of χ² by the second place.
    """

    target: str
    frame: str
    off_m: float
    chi2: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameEquations:
    """Normal equations of one frame, for m of the k unknowns of a flight.

    Attributes
    ----------
    frame : str
    used : tuple of str
        Its targets. The first three unknowns are the coordinates of the first, and so on.
    at : (m,) array
        Rows of the unknowns among those of the flight.
    normal, right : (m, m) array, (m,) array
    """

    frame: str
    used: tuple[str, ...]
    at: IndexArray
    normal: FloatArray
    right: FloatArray


def moved_target(
    frames: Sequence[FrameEquations],
    normal: FloatArray,
    right: FloatArray,
    squares: float,
    freedom: int,
) -> MovedTarget | None:
    """Return the target that was moved most significantly; None: none was.

    Parameters
    ----------
    frames : sequence of FrameEquations
        In the order in which they were taken.
    normal, right : (k, k) array, (k,) array
        Sums of the frames' equations. Nothing is assumed of their unknowns.
    squares : float
        Weighted squares of all residuals without corrections.
    freedom : int
        Number of observations less that of unknowns.
    """
    freedom -= 3  # of the move
    if freedom < 1:
        return None
    inverse = np.asarray(
        np.linalg.pinv(normal, rcond=_MIN_DETERMINED, hermitian=True), dtype=np.float64
    )
    squares -= float(right @ inverse @ right)
    decrease, target, frame, off_m = max(
        _splits(frames, inverse, inverse @ right), default=(0.0, "", "", 0.0)
    )
    variance = max(1.0, (squares - decrease) / freedom)
    chi2 = decrease / variance
    by_chance = 3.0 * float(fdtri(3, freedom, 1.0 - _FALSE_ALARM))
    is_explained = variance < _LOW_VARIANCE or decrease > _MOST * squares
    if chi2 < by_chance or off_m < _MIN_OFF_M or not is_explained:
        return None
    return MovedTarget(target, frame, off_m, chi2)


def _splits(
    frames: Sequence[FrameEquations], inverse: FloatArray, corrections: FloatArray
) -> Iterator[tuple[float, str, str, float]]:
    """Yield decrease of squares, target, first frame of the second place, and distance [m]."""
    for target in dict.fromkeys(name for each in frames for name in each.used):
        seeing = [each for each in frames if target in each.used]
        # of three more unknowns, the move, which counts in the later frames
        by_all, right = np.zeros((3, len(inverse))), np.zeros(3)
        own = np.zeros((3, 3))
        for count, each in enumerate(reversed(seeing), 1):
            first = 3 * each.used.index(target)
            rows = slice(first, first + 3)
            by_all[:, each.at] += each.normal[rows]
            own += each.normal[rows, rows]
            right += each.right[rows]
            if LEAST_SIDE <= count <= len(seeing) - LEAST_SIDE:
                reduced = own - by_all @ inverse @ by_all.T
                rest = right - by_all @ corrections
                move = np.linalg.lstsq(reduced, rest, rcond=_MIN_DETERMINED)[0]
                yield float(rest @ move), target, each.frame, float(np.linalg.norm(move))
