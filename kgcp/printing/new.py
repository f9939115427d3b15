"""Which targets to print: those of a flight, or new ones beside them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

from kgcp.errors import SettingError
from kgcp.printing.codes import check_new_codes, propose_codes
from kgcp.target.family import same_shape
from kgcp.target.layout import Ring, Target

# The proportions of Cucci's target: inner and code circle and dots, of the outer diameter.
_INNER, _CODE, _DOT = 1.0 / 2.0, 1.0 / 1.4, 1.0 / 7.0


def chosen_targets(known: Sequence[Target], names: Sequence[str]) -> tuple[Target, ...]:
    """Return the targets of these names, or all.

    Raises
    ------
    SettingError
        For a name that no target has.
    """
    listed = [target.name for target in known]
    for name in names:
        if name not in listed:
            problem = f"{name!r} is not in flight.toml"
            raise SettingError("target", problem, f"give one of {', '.join(listed)}")
    return tuple(target for target in known if not names or target.name in names)


def new_targets(
    known: Sequence[Target],
    diameter_m: float | None,
    codes: Sequence[str],
    count: int,
    dots: int,
) -> tuple[Target, ...]:
    """Return new targets, first those with given codes, then those with proposed ones.

    Parameters
    ----------
    known : sequence of Target
        From which they must differ; they have the proportions of the first of them.
    diameter_m : float or None
        Outer diameter; None: that of the first known target.
    codes : sequence of str
        Directions of dots [deg], separated by commas.
    count, dots : int
        How many codes to propose, of how many dots.

    Raises
    ------
    SettingError
        If a code is none, or could be confused, or there is no diameter.
    """
    ring = _model(known, diameter_m)
    names = _free_names({one.name for target in known for one in target.rings})
    given = [Target(replace(ring, name=next(names), code_deg=_angles(code))) for code in codes]
    check_new_codes(given, known)
    if not count:
        return tuple(given)
    others = [target.ring for target in (*known, *given) if same_shape(target.ring, ring)]
    proposed = [
        Target(replace(ring, name=next(names), code_deg=code))
        for code in propose_codes(ring, count, dots, others)
    ]
    check_new_codes([*given, *proposed], known)
    return (*given, *proposed)


def _model(known: Sequence[Target], diameter_m: float | None) -> Ring:
    """Return a ring of the size and proportions that are wanted."""
    if known:
        first = known[0].ring
        scale = 1.0 if diameter_m is None else diameter_m / first.outer_diameter_m
    elif diameter_m is None:
        raise SettingError("diameter", "is missing", "give it in metres, or a FLIGHT to take it of")
    else:
        first, scale = Ring("new", 1.0, _INNER, _CODE, _DOT, (0.0,)), diameter_m
    return replace(
        first,
        outer_diameter_m=_rounded(scale * first.outer_diameter_m),
        inner_diameter_m=_rounded(scale * first.inner_diameter_m),
        code_diameter_m=_rounded(scale * first.code_diameter_m),
        dot_diameter_m=_rounded(scale * first.dot_diameter_m),
        sd_outer_diameter_m=0.0,
    )


def _rounded(length_m: float) -> float:
    """Return a length to the micrometre: what is printed is what flight.toml says."""
    return round(length_m, 6)


def _free_names(taken: Collection[str]) -> Iterator[str]:
    numbers = itertools.count(1)
    return (name for name in (f"T{number}" for number in numbers) if name not in taken)


def _angles(code: str) -> tuple[float, ...]:
    try:
        angles = tuple(float(word) for word in code.split(","))
    except ValueError:
        angles = (math.nan,)
    if not all(map(math.isfinite, angles)):
        raise SettingError("code", f"{code!r} is no list of angles", "give them as 0,43,78,180")
    return angles
