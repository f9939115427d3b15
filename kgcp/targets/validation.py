"""Validation of a flight's targets: replicas must nest, and codes must be distinguishable."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.targets.layout import Ring, Target

_SAME_SHAPE = 0.1  # relative difference; ellipses of small targets do not show smaller ones


def check_targets(targets: Sequence[Target]) -> None:
    """Refuse targets that no image can distinguish, or that overlap on one plate.

    Raises
    ------
    SettingError
        If two rings share a name, two codes of rings of one shape are rotations of each other,
        or the replicas of a plate do not nest.
    """
    rings = [ring for target in targets for ring in target.rings]
    for first, second in combinations(rings, 2):
        if first.name == second.name:
            problem = f"{first.name!r} is the name of two targets"
            raise SettingError("name", problem, "give each target and replica a name of its own")
        if same_shape(first, second) and codes_coincide(first, second):
            raise SettingError(
                "code_deg",
                f"the codes of {first.name!r} and {second.name!r} are rotations of each other",
                "give one of them another code",
            )
    for target in targets:
        _check_nesting(target)


def same_shape(first: Ring, second: Ring) -> bool:
    """Tell whether two rings have the same proportions, apart from size and code."""
    pairs = zip(_proportions(first), _proportions(second), strict=True)
    return all(abs(a - b) <= _SAME_SHAPE * max(a, b) for a, b in pairs)


def codes_coincide(first: Ring, second: Ring) -> bool:
    """Tell whether some rotation puts every dot of one code at least half onto one of the other."""
    half_deg = min(first.dot_half_angle_deg, second.dot_half_angle_deg)
    codes, other = np.array([first.code_deg]), np.array(second.code_deg)
    return bool(rotations_coincide(codes, other, half_deg)[0])


def rotations_coincide(codes: FloatArray, other: FloatArray, half_deg: float) -> BoolArray:
    """Return which codes (m,) coincide with another one, as `codes_coincide`.

    Parameters
    ----------
    codes, other : (m, n) and (k,) array
        Directions of the dots, ascending [deg].
    half_deg : float
        Half the angle that a dot subtends at the ring's centre.
    """
    count = codes.shape[1]
    if len(other) != count:
        return np.zeros(len(codes), dtype=np.bool_)
    turned = other[np.add.outer(np.arange(count), np.arange(count)) % count]
    offsets = turned - codes[:, None, :]
    # relative to the offset of the first dot
    offsets = np.mod(offsets - offsets[..., :1] + 180.0, 360.0) - 180.0
    return np.asarray(np.ptp(offsets, axis=2).min(axis=1) <= 2.0 * half_deg)


def _proportions(ring: Ring) -> tuple[float, ...]:
    inner = (ring.inner_diameter_m, ring.code_diameter_m, ring.dot_diameter_m)
    return tuple(length / ring.outer_diameter_m for length in inner)


def _check_nesting(target: Target) -> None:
    for outer, inner in pairwise(target.rings):
        if inner.outer_diameter_m > outer.inner_diameter_m:
            raise SettingError(
                "scale",
                f"{inner.name!r} ({inner.outer_diameter_m:g} m) does not fit into {outer.name!r}"
                f" ({outer.inner_diameter_m:g} m inside)",
                "make the replica smaller",
            )
