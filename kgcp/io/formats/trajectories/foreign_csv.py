"""CSV trajectories of other programs: their columns in the names of docs/foreign_files.md."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from kgcp.io.files.csv_sniff import SniffedTable, sniff_table
from kgcp.io.files.gps_time import TimeSystem
from kgcp.io.files.sniff import ForeignFile

# Names of columns in other programs, without blanks, marks and units. Longitude and latitude are
# separate from easting and northing: one pair must be complete.
_TIMES = (
    *("time", "utc", "utctime", "timeutc", "gpstime", "timegps", "gpst", "timestamp", "datetime"),
    *("unixtime", "epoch", "t", "zeit", "zeitstempel", "uhrzeit", "sow", "tow", "secondsofweek"),
    *("gpstow", "gpssow", "gpsseconds", "weekseconds", "timeofweek", "datum", "isotime"),
)
_GRID: Mapping[str, Sequence[str]] = {
    "x": ("x", "e", "east", "easting", "ostwert", "rechtswert", "utmeast", "utmeasting", "est"),
    "y": ("y", "n", "north", "northing", "nordwert", "hochwert", "utmnorth", "utmnorthing", "nord"),
}
_ANGLES: Mapping[str, Sequence[str]] = {
    "x": ("longitude", "lon", "long", "lng", "laenge", "länge", "lambda"),
    "y": ("latitude", "lat", "breite", "phi"),
}
_HEIGHT = (
    *("z", "h", "u", "height", "alt", "altitude", "elevation", "up", "hell", "ellh", "ellheight"),
    *("ellipsoidalheight", "heightell", "hoehe", "höhe", "ellipsoidhoehe", "hae"),
)
_DEVIATIONS: Mapping[str, Sequence[str]] = {
    "sd_x": ("sdx", "sde", "sdeast", "stde", "stdeast", "stdx", "sigmae", "sigmaeast", "sigmax"),
    "sd_y": ("sdy", "sdn", "sdnorth", "stdn", "stdnorth", "stdy", "sigman", "sigmanorth", "sigmay"),
    "sd_z": (
        *("sdz", "sdu", "sdup", "sdh", "sdheight", "stdu", "stdup", "stdh", "stdheight", "stdz"),
        *("sigmau", "sigmaup", "sigmah", "sigmaheight", "sigmaz"),
    ),
    "sd_roll_deg": ("sdroll", "stdroll", "sigmaroll"),
    "sd_pitch_deg": ("sdpitch", "stdpitch", "sigmapitch"),
    "sd_heading_deg": ("sdheading", "stdheading", "sigmaheading", "sdyaw", "stdyaw", "sigmayaw"),
}
_ATTITUDE: Mapping[str, Sequence[str]] = {
    "roll_deg": ("roll", "rolldeg", "rollen"),
    "pitch_deg": ("pitch", "pitchdeg", "nicken"),
    "heading_deg": ("heading", "headingdeg", "hdg", "yaw", "yawdeg", "azimuth", "azimut", "kurs"),
}
_GROUPS = (
    tuple(_ATTITUDE),
    ("sd_x", "sd_y", "sd_z"),
    ("sd_roll_deg", "sd_pitch_deg", "sd_heading_deg"),
)
_GPS, _UTC = re.compile(r"gps|tow|sow|week", re.IGNORECASE), re.compile(r"utc", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class ForeignTable:
    """A trajectory's table."""

    table: SniffedTable
    # whether x, y are longitude and latitude [deg] by their names; small numbers may be metres
    is_geographic: bool

    @property
    def has_attitude(self) -> bool:
        """Whether it has roll, pitch and heading."""
        return "heading_deg" in self.table.cells

    @property
    def time_system(self) -> TimeSystem | None:
        """Time system by the name of the time column; None: the name does not say."""
        name = self.table.name_of("time")
        if _GPS.search(name):
            return TimeSystem.GPS
        return TimeSystem.UTC if _UTC.search(name) else None


def recognised_table(file: ForeignFile) -> ForeignTable | None:
    """Return the table of a trajectory in a file; None if it lacks time or position.

    Incomplete groups (a heading without roll, deviations of two axes) are left out.
    """
    for positions, is_geographic in ((_ANGLES, True), (_GRID, False)):
        known = {"time": _TIMES, **positions, "z": _HEIGHT, **_ATTITUDE, **_DEVIATIONS}
        table = sniff_table(file, known)
        if table is not None and {"time", "x", "y", "z"} <= table.cells.keys():
            is_named_so = is_geographic and table.name_of("x") != "x"
            return ForeignTable(_whole_groups(table), is_named_so)
    return None


def _whole_groups(table: SniffedTable) -> SniffedTable:
    partial = {name for group in _GROUPS if not table.cells.keys() >= set(group) for name in group}
    columns = {ours: name for ours, name in table.layout.columns.items() if ours not in partial}
    return replace(
        table,
        layout=replace(table.layout, columns=columns),
        cells={name: cell for name, cell in table.cells.items() if name not in partial},
    )
