"""What flight.toml says about how a trajectory's file is to be understood."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from enum import StrEnum
from pathlib import Path

from kgcp.io.gpstime import TimeSystem


class TrajectoryFormat(StrEnum):
    """A notation of trajectories, by its name in flight.toml."""

    CSV = "csv"
    SBET = "sbet"
    RTKLIB = "rtklib"
    TUM = "tum"


class Wander(StrEnum):
    """What makes the true heading of the heading and the wander angle of an SBET record."""

    IGNORE = "ignore"
    SUBTRACT = "subtract"
    ADD = "add"


@dataclass(frozen=True, slots=True)
class TrajectoryNotation:
    """The keys of [vehicle] about its trajectory's file.

    Attributes
    ----------
    format : TrajectoryFormat or None
        None: the content tells.
    crs : str or None
        Of the file's positions, for pyproj; None: the format's default.
    time_system : TimeSystem or None
        Of the file's times; None: as the format has it.
    first_day : date or None
        When the trajectory begins, by its own clock; given, the file's numbers are seconds of the
        week.
    accuracies_file : Path or None
        With SBET: smrmsg file of its standard deviations.
    wander : Wander or None
        With SBET: what to do with the wander angle; None: it has to be zero.
    course_sd_deg : tuple of float or None
        Given, the attitude is that of the course over ground, level, with these standard
        deviations of roll, pitch and heading; None: the file has the attitude.
    """

    format: TrajectoryFormat | None = None
    crs: str | None = None
    time_system: TimeSystem | None = None
    first_day: date | None = None
    accuracies_file: Path | None = None
    wander: Wander | None = None
    course_sd_deg: tuple[float, float, float] | None = None
