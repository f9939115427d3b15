"""Records of `kgcp init`: information found, information missing, and parts of flight.toml."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from kgcp.io.flight.toml_draft import DraftKey, DraftTable, DraftText


@dataclass(frozen=True, slots=True)
class InitFinding:
    """Information that was found in the folder, with its source, as a line of the report."""

    heading: str
    text: str


@dataclass(frozen=True, slots=True)
class Gap:
    """Information that is missing or only assumed, and what to do about it."""

    heading: str
    text: str
    remedy: str
    is_assumed: bool = False  # whether flight.toml has a value that no file confirms


Part = DraftKey | InitFinding | Gap
"""A key of a table, or a line of the report about the table's keys."""


@dataclass(frozen=True, slots=True)
class Section:
    """A part of flight.toml, with the lines of the report about it."""

    blocks: tuple[DraftTable | DraftText, ...]
    findings: tuple[InitFinding, ...]
    gaps: tuple[Gap, ...]

    @classmethod
    def of(cls, heading: str, parts: Iterable[Part], note: str = "") -> Section:
        """Make a section of one table; parts of each kind keep their order."""
        parts = tuple(parts)
        keys = tuple(part for part in parts if isinstance(part, DraftKey))
        return cls(
            (DraftTable(heading, keys, note),),
            tuple(part for part in parts if isinstance(part, InitFinding)),
            tuple(part for part in parts if isinstance(part, Gap)),
        )


@dataclass(frozen=True, slots=True)
class InitOptions:
    """Information from the user besides the files in the folder; None or empty: not given."""

    targets_file: Path | None = None  # a flight.toml, or the targets.toml of `kgcp target`
    # for each target, the directions of its dots, separated by commas [deg]; needs `diameter_m`
    codes: tuple[str, ...] = ()
    diameter_m: float | None = None  # outer diameter of these targets [m]
    # trajectory point → target centre: forward, right, down [m]
    lever_arm_m: tuple[float, float, float] | None = None
    crs: str | None = None  # of the flight, for pyproj
