"""The target as a geometric object: coded rings of exact circles, in metres on the plate.

Plate axes as in docs/conventions.md: seen from the front x right, y down, angles from +x to +y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.settings import require_range

_MAX_DOTS = 100  # codes are compared in steps of a degree


@dataclass(frozen=True, slots=True)
class Ring:
    """One black ring with white dots as a code; a target is one ring and its replicas.

    Attributes
    ----------
    name : str
        As in flight.toml.
    outer_diameter_m, inner_diameter_m : float
        Diameters of the black ring's edges [m].
    code_diameter_m, dot_diameter_m : float
        Diameters of the circle through the dots' centres, and of the dots [m].
    code_deg : tuple of float
        Directions of the dots' centres, in [0, 360), sorted [deg].
    sd_outer_diameter_m : float
        Standard deviation of the printed outer diameter [m].
    """

    name: str
    outer_diameter_m: float
    inner_diameter_m: float
    code_diameter_m: float
    dot_diameter_m: float
    code_deg: tuple[float, ...]
    sd_outer_diameter_m: float = 0.0

    def __post_init__(self) -> None:
        for key in ("outer_diameter_m", "inner_diameter_m", "code_diameter_m", "dot_diameter_m"):
            require_range(key, getattr(self, key), 0.0, 100.0, unit="m", open_low=True)
        require_range("sd_outer_diameter_m", self.sd_outer_diameter_m, 0.0, 1.0, unit="m")
        if self.inner_diameter_m >= self.outer_diameter_m:
            raise SettingError(
                "inner_diameter_m",
                f"{self.inner_diameter_m:g} m is not below outer_diameter_m"
                f" = {self.outer_diameter_m:g} m",
                "give the diameters of the black ring's two edges",
            )
        self._check_dots()

    def _check_dots(self) -> None:
        if (
            self.code_diameter_m + self.dot_diameter_m >= self.outer_diameter_m
            or self.code_diameter_m - self.dot_diameter_m <= self.inner_diameter_m
        ):
            raise SettingError(
                "dot_diameter_m",
                f"dots of {self.dot_diameter_m:g} m on a circle of {self.code_diameter_m:g} m"
                " leave the black ring",
                "make code_diameter_m ± dot_diameter_m lie between the ring's diameters",
            )
        if np.ndim(self.code_deg) != 1:
            raise SettingError(
                "code_deg", f"{self.code_deg!r} is not a list", "list the angles of all dots"
            )
        if len(self.code_deg) == 0:  # it may be an array
            raise SettingError("code_deg", "is empty", "give the direction of at least one dot")
        if len(self.code_deg) > _MAX_DOTS:
            problem = f"has {len(self.code_deg)} dots"
            raise SettingError("code_deg", problem, f"give at most {_MAX_DOTS}")
        for angle in self.code_deg:
            require_range("code_deg", angle, -360.0, 360.0, unit="deg")
        angles = np.sort(np.mod(self.code_deg, 360.0))
        gaps = np.diff(np.append(angles, angles[0] + 360.0))
        touching = math.degrees(2.0 * math.asin(self.dot_diameter_m / self.code_diameter_m))
        if len(angles) > 1 and gaps.min() < touching:
            first = angles[int(gaps.argmin())]
            raise SettingError(
                "code_deg",
                f"the dots at {first:g} and {(first + gaps.min()) % 360.0:g} deg overlap",
                f"leave at least {touching:.1f} deg between dots of this size",
            )
        object.__setattr__(self, "code_deg", tuple(float(angle) for angle in angles))

    @property
    def inner_ratio(self) -> float:
        """k: inner over outer diameter."""
        return self.inner_diameter_m / self.outer_diameter_m

    @property
    def dot_half_angle_deg(self) -> float:
        """Half the angle that a dot subtends at the ring's centre [deg]."""
        return math.degrees(math.asin(self.dot_diameter_m / self.code_diameter_m))

    def dot_centres_m(self) -> FloatArray:
        """Centres (n, 2) of the dots on the plate [m]."""
        angles = np.radians(self.code_deg)
        radius = 0.5 * self.code_diameter_m
        return radius * np.column_stack((np.cos(angles), np.sin(angles)))

    def scaled(self, name: str, scale: float, code_deg: tuple[float, ...]) -> Ring:
        """Return a concentric replica: all lengths times `scale`, with its own code."""
        require_range("scale", scale, 0.0, self.inner_ratio, open_low=True)
        return Ring(
            name=name,
            outer_diameter_m=scale * self.outer_diameter_m,
            inner_diameter_m=scale * self.inner_diameter_m,
            code_diameter_m=scale * self.code_diameter_m,
            dot_diameter_m=scale * self.dot_diameter_m,
            code_deg=code_deg,
            sd_outer_diameter_m=scale * self.sd_outer_diameter_m,
        )


@dataclass(frozen=True, slots=True)
class Target:
    """A plate with its main ring, concentric replicas inside, and its position if it is static.

    Attributes
    ----------
    ring : Ring
        The main ring; its name is the target's name.
    replicas : tuple of Ring
        Smaller concentric rings, largest first.
    position_m : tuple of float or None
        Position of a static target in the flight's CRS [m]; None for one on the vehicle.
    sd_position_m : tuple of float
        Its standard deviations [m]; zeros: unknown.
    """

    ring: Ring
    replicas: tuple[Ring, ...] = ()
    position_m: tuple[float, float, float] | None = None
    sd_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def name(self) -> str:
        """Name of the target, that of its main ring."""
        return self.ring.name

    @property
    def diameters_m(self) -> tuple[float, float]:
        """Diameters of the main ring's edges [m]."""
        return self.ring.outer_diameter_m, self.ring.inner_diameter_m

    @property
    def outer_diameter_m(self) -> float:
        """Outer diameter of its main ring [m]."""
        return self.ring.outer_diameter_m

    @property
    def sd_outer_diameter_m(self) -> float:
        """Standard deviation of the outer diameter [m]."""
        return self.ring.sd_outer_diameter_m

    @property
    def rings(self) -> tuple[Ring, ...]:
        """All rings, the main one first."""
        return (self.ring, *self.replicas)
