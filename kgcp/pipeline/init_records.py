"""Records of `kgcp init`: what it found in a folder, what is missing, parts of flight.toml."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from kgcp.io.flight.toml_draft import DraftKey, DraftTable, DraftText


@dataclass(frozen=True, slots=True)
class InitFinding:
    """One piece of information in the folder, and where it was found."""

    heading: str
    text: str


@dataclass(frozen=True, slots=True)
class Gap:
    """One missing piece of information, and what to do about it."""

    heading: str
    text: str
    remedy: str
    is_assumed: bool = False  # whether flight.toml gets a value that nothing confirms


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
    """What the user states in addition to the files in the folder; None or empty: nothing."""

    targets_file: Path | None = None  # a flight.toml, or the targets.toml of `kgcp target`
    # directions of the dots of targets, separated by commas [deg]; they need `diameter_m`
    codes: tuple[str, ...] = ()
    diameter_m: float | None = None  # their outer diameter [m]
    # trajectory point → target centre: forward, right, down [m]
    lever_arm_m: tuple[float, float, float] | None = None
    crs: str | None = None  # of the flight, for pyproj
