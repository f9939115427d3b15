"""Codes of the rings of sectors around discs.

The ellipse of a disc gives the affine map from the plane of its ring to the photograph, up to a
rotation. The code does not depend on that rotation.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.grey_range import brightest_level
from kgcp.measurement.discs.records import DiscOutline
from kgcp.targets.fields.points import CodeRing

_PER_SECTOR = 16  # samples along the ring
_MIDDLE = slice(_PER_SECTOR // 4, 3 * _PER_SECTOR // 4)  # samples used: blur mixes a sector's ends
_ACROSS = (0.35, 0.5, 0.65)  # where across the ring it is sampled, in its widths
_LEAST_MARGIN = 0.2  # of a sector's level from 0.5, midway between the ground and the disc
_LEAST_CONTRAST = 0.02  # of what is white in the photograph
_MOST_UNEVEN = 0.35  # variation of the ground, of the contrast; around a letter it is larger


def read_codes(
    grey: GreyArray, outlines: Sequence[DiscOutline], ring: CodeRing
) -> list[int | None]:
    """Return the code around each disc, as the least number over all its rotations; None: no code.

    Parameters
    ----------
    grey : (height, width) array
        Grey values of 8 or 16 bits.
    outlines : sequence of DiscOutline
    """
    values = grey.astype(np.float32) / brightest_level(grey)
    return [_read(values, outline, ring) for outline in outlines]


def _read(values: np.ndarray, outline: DiscOutline, ring: CodeRing) -> int | None:
    """Read the sectors around a disc; None: the ring is not clear, or not within the frame."""
    count = ring.bits * _PER_SECTOR
    angles = 2.0 * np.pi / count * np.arange(count)
    ellipse = outline.ellipse
    around = np.stack((np.cos(angles), np.sin(angles)), axis=1) @ ellipse.stretch.T
    centre = np.array(ellipse.centre)
    reach = centre + ring.outer * around
    height, width = values.shape
    if not np.all((reach >= 0.0) & (reach <= (width - 1, height - 1))):
        return None

    def at(radius: float) -> FloatArray:
        x, y = (centre + radius * around).astype(np.float32).T
        return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR), dtype=np.float64).ravel()

    hole = outline.hole
    within = 0.5 if hole is None else 0.5 + 0.5 * hole.mean_radius / ellipse.mean_radius
    ground, disc = at(0.5 * (1.0 + ring.inner)), float(at(within).mean())
    contrast = disc - float(ground.mean())
    is_even = np.abs(ground - np.median(ground)).max() < _MOST_UNEVEN * abs(contrast)
    if abs(contrast) < _LEAST_CONTRAST or not is_even:
        return None
    width_of_ring = ring.outer - ring.inner
    level = np.mean([at(ring.inner + share * width_of_ring) for share in _ACROSS], axis=0)
    share = (level - ground) / contrast
    sectors = np.array(
        [
            np.roll(share, -phase).reshape(ring.bits, _PER_SECTOR)[:, _MIDDLE].mean(axis=1)
            for phase in range(_PER_SECTOR)
        ]
    )
    margins = np.abs(sectors - 0.5).min(axis=1)
    best = int(margins.argmax())
    bits = sectors[best] > 0.5
    if margins[best] < _LEAST_MARGIN or bits.all() or not bits.any():
        return None
    return ring.canonical(int("".join("1" if bit else "0" for bit in bits), 2))
