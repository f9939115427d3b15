"""Targets without a code: plain discs, and rings of concentric circles.

Many other things look like them, so that they are identified by their place: a plain target is
static, its position is known, and it is measured only where a frame must show it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import ClassVar

from kgcp.errors import SettingError
from kgcp.settings import require_range
from kgcp.targets.layout import Target

_MAX_CIRCLES = 8
_MAX_RATIO = 0.95  # of an inner circle to the next outer one
_MIN_NORMAL_LENGTH = 1e-6  # a shorter normal has no direction


class Shape(StrEnum):
    """Shape of a target."""

    CODED = "coded"  # ring with dots, which identify it
    DISC = "disc"
    RING = "ring"  # concentric circles without dots


class PlainPolarity(StrEnum):
    """Whether the area within the outer circle is darker or brighter than the ground."""

    DARK = "dark"
    BRIGHT = "bright"


@dataclass(frozen=True, slots=True)
class PlainTarget:
    """A disc, or concentric circles with alternating dark and bright areas.

    Attributes
    ----------
    name : str
        As in flight.toml.
    diameters_m : tuple of float
        Diameters of its circles, the outermost first [m]: one for a disc, more for a ring.
    polarity : PlainPolarity
        Of the area directly within the outer circle, relative to the ground.
    position_m, sd_position_m : tuple of float
        Position in the flight's CRS, and its standard deviations [m]; zeros: unknown.
    sd_diameter_m : float
        Standard deviation of the outer diameter [m]; the others are wrong by the same factor.
    normal_enu : (3,) tuple of float, or None
        Unit normal, out of its front, in local axes east, north, up; None: unknown.
    sd_normal_deg : float
        Standard deviation of the normal about each axis perpendicular to it [deg].
    border_m : float or None
        Width of uniform ground around it [m]; None: nothing is known of the ground.
    thickness_m : float
        Distance of its face from `position_m` along the normal [m].

    Raises
    ------
    SettingError
        On construction, if the target is impossible.
    """

    SD_NORMAL_DEG: ClassVar[float] = 3.0  # for a target laid on the ground by hand

    name: str
    diameters_m: tuple[float, ...]
    polarity: PlainPolarity
    position_m: tuple[float, float, float]
    sd_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sd_diameter_m: float = 0.0
    normal_enu: tuple[float, float, float] | None = (0.0, 0.0, 1.0)
    sd_normal_deg: float = SD_NORMAL_DEG
    border_m: float | None = None
    thickness_m: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= len(self.diameters_m) <= _MAX_CIRCLES:
            raise SettingError(
                "inner_diameter_m",
                f"makes {len(self.diameters_m)} circles",
                f"give at most {_MAX_CIRCLES}",
            )
        for diameter in self.diameters_m:
            require_range("diameter_m", diameter, 0.0, 100.0, unit="m", open_low=True)
        for outer, inner in pairwise(self.diameters_m):
            if inner > _MAX_RATIO * outer:
                raise SettingError(
                    "inner_diameter_m",
                    f"{inner:g} m is not below {_MAX_RATIO:.0%} of the next circle's {outer:g} m",
                    "give diameters from the outside to the inside",
                )
        require_range("sd_diameter_m", self.sd_diameter_m, 0.0, 1.0, unit="m")
        require_range("level_sd_deg", self.sd_normal_deg, 0.0, 90.0, unit="deg", open_low=True)
        if self.border_m is not None:
            require_range("border_m", self.border_m, 0.0, 100.0, unit="m", open_low=True)
        require_range("thickness_m", self.thickness_m, 0.0, 100.0, unit="m")
        if self.normal_enu is None:
            if self.thickness_m:
                problem, remedy = "needs a normal", "give that, or the position of the face itself"
                raise SettingError("thickness_m", problem, remedy)
            return
        length = math.hypot(*self.normal_enu)
        if length < _MIN_NORMAL_LENGTH:
            remedy = 'give [east, north, up], "level" or "free"'
            raise SettingError("normal", "has no direction", remedy)
        x, y, z = (component / length for component in self.normal_enu)
        object.__setattr__(self, "normal_enu", (x, y, z))

    @property
    def shape(self) -> Shape:
        """Disc or ring."""
        return Shape.DISC if len(self.diameters_m) == 1 else Shape.RING

    @property
    def outer_diameter_m(self) -> float:
        """Diameter of the outer circle [m]."""
        return self.diameters_m[0]

    @property
    def sd_outer_diameter_m(self) -> float:
        """Standard deviation of the outer diameter [m]."""
        return self.sd_diameter_m

    @property
    def radii_m(self) -> tuple[float, ...]:
        """Radii of its circles, the outermost first [m]."""
        return tuple(0.5 * diameter for diameter in self.diameters_m)


AnyTarget = Target | PlainTarget
"""A target with or without a code."""


def shape_of(target: AnyTarget) -> Shape:
    """Return the shape of a target."""
    return target.shape if isinstance(target, PlainTarget) else Shape.CODED
