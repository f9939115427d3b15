"""What `kgcp init` has found in a folder, what is missing, and what that makes of flight.toml."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from kgcp.io.flight.toml_draft import DraftKey, DraftTable, DraftText


@dataclass(frozen=True, slots=True)
class InitFinding:
    """One thing that the folder tells, and where it stands."""

    heading: str
    text: str


@dataclass(frozen=True, slots=True)
class Gap:
    """One thing that the folder does not tell, and what to do about it."""

    heading: str
    text: str
    remedy: str
    is_assumed: bool = False  # flight.toml has a value for it, which nothing confirms


Part = DraftKey | InitFinding | Gap
"""One line of a table, or a reason for its lines."""


@dataclass(frozen=True, slots=True)
class Section:
    """A part of flight.toml, with the reasons for it."""

    blocks: tuple[DraftTable | DraftText, ...]
    findings: tuple[InitFinding, ...]
    gaps: tuple[Gap, ...]

    @classmethod
    def of(cls, heading: str, parts: Iterable[Part], note: str = "") -> Section:
        """Sort the parts of one table, each kind in its order."""
        parts = tuple(parts)
        keys = tuple(part for part in parts if isinstance(part, DraftKey))
        return cls(
            (DraftTable(heading, keys, note),),
            tuple(part for part in parts if isinstance(part, InitFinding)),
            tuple(part for part in parts if isinstance(part, Gap)),
        )


@dataclass(frozen=True, slots=True)
class InitOptions:
    """What the user says, beside what lies in the folder; None or empty: nothing."""

    targets_file: Path | None = None  # a flight.toml, or the targets.toml of `kgcp target`
    # directions of the dots of targets, separated by commas [deg]; they need `diameter_m`
    codes: tuple[str, ...] = ()
    diameter_m: float | None = None  # their outer diameter [m]
    # trajectory point → target centre: forward, right, down [m]
    lever_arm_m: tuple[float, float, float] | None = None
    crs: str | None = None  # of the flight, for pyproj
