"""Numbers and lists as text: signs, plurals, digits by the standard deviation."""

from __future__ import annotations

import math
from collections.abc import Sequence


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless it is 1."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def listed(names: Sequence[str], most: int) -> str:
    """Return names in a row; if there are more than `most`, the others are counted."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def minus(number: str) -> str:
    """Return a number with a typographic minus, and without a sign if it is zero."""
    return number.replace("-", "−") if float(number) else number.lstrip("+-")


def rounded(value: float) -> str:
    """Return a number with two significant digits, from 100 on as a whole number."""
    return f"{value:.2g}" if abs(value) < 99.5 else f"{value:.0f}"


def amount(value: float, sd: float | None, sign: str = "") -> str:
    """Return value ± standard deviation, both rounded to the second digit of the latter.

    Parameters
    ----------
    sd : float or None
        None or 0: not known.
    sign : str
        As in a format specification: "+" prints the sign of positive values, too.
    """
    if sd is None or not sd > 0.0:
        return f"{value:{sign}.3g}"
    decimals = min(6, max(0, 1 - math.floor(math.log10(sd))))
    return f"{value:{sign}.{decimals}f} ± {sd:.{decimals}f}"
