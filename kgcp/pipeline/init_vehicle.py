"""The vehicle of a folder: its trajectory, with the time system and CRS."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from kgcp.errors import SettingError
from kgcp.georef.crs import WGS84_3D, longitude_latitude, parse_crs
from kgcp.georef.crs_guess import crs_near, is_geographic_place, utm_crs
from kgcp.io.files.gps_time import TimeSystem, first_day_near
from kgcp.io.files.time_text import NUMBER, half_of_time, names_zone, parse_time
from kgcp.io.flight.folder import FolderContents
from kgcp.io.flight.toml_draft import DraftKey
from kgcp.io.formats.point_table import PointTable
from kgcp.io.formats.trajectories.first_epoch import FirstEpoch, TrajectoryFile, first_epoch
from kgcp.pipeline.init_records import Gap, InitFinding, InitOptions, Part, Section
from kgcp.quality.checks.frame_header import FrameHeader

_WORDS = {
    "sbet": "SBET",
    "rtklib": "RTKLIB solution",
    "waypoint": "Waypoint export",
    "csv": "CSV table",
    "tum": "TUM trajectory",
}
_GEOGRAPHIC = frozenset({"sbet", "rtklib", "waypoint"})  # formats that need no crs
_WEEK_S = 2e6  # seconds of a week are less than this; Unix seconds are far larger
_USUAL_CRS = "EPSG:25832"  # of an example to be filled in
_SHOWN_CRS = 3
_SHOWN_FILES = 5
_CRS_REMEDY = "write crs = … into flight.toml: the CRS of the surveyed coordinates"
_LEVER_ARM = "forward, right, down [m] to the target"


def vehicle_section(
    contents: FolderContents, times_s: Mapping[str, float], options: InitOptions
) -> Section:
    """Return the [vehicle] table: for the only trajectory of a folder, or to be filled in.

    Parameters
    ----------
    times_s : mapping
        Times of the frames, Unix UTC [s]: they determine the week of a trajectory whose times are
        seconds of the week.
    """
    if len(contents.trajectories) == 1:
        return Section.of("[vehicle]", _trajectory_parts(contents, times_s, options))
    note = "Only if a vehicle carries the target."
    return Section.of("[vehicle]", _missing_trajectory_parts(contents), note)


def _trajectory_parts(
    contents: FolderContents, times_s: Mapping[str, float], options: InitOptions
) -> Iterator[Part]:
    file = contents.trajectories[0]
    start = first_epoch(file)
    name = contents.relative(file.path)
    layout_keys, layout_text = _layout(file)
    attitude_keys, attitude_text = _attitude(start)
    text = f"{name}: {_WORDS[file.format]}{layout_text}{attitude_text}"
    yield InitFinding("trajectory", text)
    yield DraftKey("trajectory", name, f"{_WORDS[file.format]}, recognised by its content")
    yield from layout_keys
    if start is None:
        yield Gap("trajectory", f"{name} cannot be read", "run kgcp check, which says why")
    elif start.crs is not None and file.format not in _GEOGRAPHIC:
        yield DraftKey("crs", start.crs, "x, y are longitude and latitude")
    yield from _time_parts(file, start, times_s)
    if file.format == "sbet" and contents.accuracies:
        yield DraftKey("accuracies", contents.relative(contents.accuracies[0]))
    yield from attitude_keys
    yield from _lever_arm_parts(options)
    yield DraftKey("sd_time_s", None, "synchronisation of frames and trajectory, 1 σ", "0.001")
    yield DraftKey("level_sd_deg", None, "if the plate is level: standard deviation", "1.0")


def _missing_trajectory_parts(contents: FolderContents) -> Iterator[Part]:
    """Yield the keys to be filled in, and the files that may be or are not a trajectory."""
    yield DraftKey("trajectory", None, "the rover's file", '"rover.pos"')
    yield DraftKey("lever_arm_m", None, _LEVER_ARM, "[-0.8, 0.15, -1.95]")
    if contents.trajectories:
        names = ", ".join(contents.relative(file.path) for file in contents.trajectories)
        yield Gap(
            "trajectory",
            f"several files may be the trajectory: {names}",
            "leave one of them in the folder, or fill in [vehicle]",
        )
    elif contents.unknown:
        shown = ", ".join(contents.relative(path) for path in contents.unknown[:_SHOWN_FILES])
        more = " …" if len(contents.unknown) > _SHOWN_FILES else ""
        yield InitFinding(
            "not recognised",
            f"{shown}{more}; a table is recognised as a trajectory if its first line names time,"
            " and x, y, z or longitude, latitude, height, in degrees and metres, and as one of"
            " surveyed points if it names name, x, y, z; in UTF-8",
        )


def crs_parts(
    contents: FolderContents,
    headers: Sequence[FrameHeader],
    surveyed: Sequence[PointTable],
    options: InitOptions,
) -> Iterator[Part]:
    """Yield the flight's crs: as given, or found by surveyed points or trajectory, or unknown.

    Parameters
    ----------
    surveyed : sequence of PointTable
        Tables whose coordinates are written to flight.toml.

    Raises
    ------
    KgcpError
        If pyproj cannot read the given CRS.
    """
    if options.crs is not None:
        parse_crs(options.crs, "crs")
        yield DraftKey("crs", options.crs, "as given")
        yield InitFinding("crs", options.crs)
        return
    file = contents.trajectories[0] if len(contents.trajectories) == 1 else None
    start = None if file is None else first_epoch(file)
    place = _place(start, headers)
    source = "" if file is None else contents.relative(file.path)
    if surveyed and surveyed[0].first_xy is not None:
        path = contents.relative(surveyed[0].path)
        if surveyed[0].is_geographic:
            comment = f"longitude, latitude and ellipsoidal height in {path}"
            yield DraftKey("crs", WGS84_3D, comment)
            yield InitFinding("crs", f"{WGS84_3D}: {comment}")
        else:
            yield from _crs_parts_by_place(path, surveyed[0].first_xy, place)
    elif start is None:
        why = f"{source} cannot be read" if source else "nothing in the folder has coordinates"
        yield from _unknown_crs_parts(why)
    elif start.crs is None:
        yield from _crs_parts_by_place(source, (start.x, start.y), place)
    elif place is None:
        yield from _unknown_crs_parts(f"the first position of {source} is not on Earth")
    else:
        crs = utm_crs(*place)
        yield DraftKey("crs", crs, f"UTM zone of {source}; heights are ellipsoidal")
        text = f"{crs}, the UTM zone of {source}; any other may be written instead"
        yield InitFinding("crs", text)


def _place(start: FirstEpoch | None, headers: Sequence[FrameHeader]) -> tuple[float, float] | None:
    """Return longitude and latitude of the flight [deg], from its trajectory or a frame's EXIF."""
    if start is not None and start.crs is not None:
        place = longitude_latitude(start.crs, np.array([[start.x, start.y]]))[0]
        if np.isfinite(place).all() and is_geographic_place(*place):
            return float(place[0]), float(place[1])
    for each in headers:
        if each.longitude_deg is not None and each.latitude_deg is not None:
            return each.longitude_deg, each.latitude_deg
    return None


def _crs_parts_by_place(
    source: str, xy: tuple[float, float], place: tuple[float, float] | None
) -> Iterator[Part]:
    """Yield the CRS in which some coordinates are near the place of the flight."""
    silent = f"{source} does not say in which CRS its coordinates are"
    if place is None:
        likely = WGS84_3D if is_geographic_place(*xy) else _USUAL_CRS
        yield from _unknown_crs_parts(silent, likely)
    elif not (near := crs_near(*xy, *place)):
        why = f"{silent}, and in no CRS of EPSG are they near the place of the flight"
        yield from _unknown_crs_parts(why)
    elif len(near) == 1:
        yield DraftKey("crs", near[0], f"the CRS in which {source} is near the place of the flight")
        yield InitFinding(
            "crs", f"{near[0]}: in this CRS, {source} is near the place of the flight"
        )
    else:
        shown = " or ".join(near[:_SHOWN_CRS])
        yield from _unknown_crs_parts(f"{silent}; by the flight's place it may be {shown}", near[0])


def _unknown_crs_parts(why: str, likely: str = _USUAL_CRS) -> Iterator[Part]:
    comment = "CRS of all coordinates; heights are ellipsoidal"
    yield DraftKey("crs", None, comment, f'"{likely}"', is_missing=True)
    yield Gap("crs", why, _CRS_REMEDY)


def _layout(file: TrajectoryFile) -> tuple[tuple[DraftKey, ...], str]:
    """Return keys and words for the layout of a CSV file where it differs from kgcp's own."""
    if file.table is None:
        return (), ""
    table = file.table.table
    layout = table.layout
    keys, words = [], []
    if layout.separator != ",":
        keys.append(DraftKey("separator", layout.separator))
        words.append(f"cells separated by {json.dumps(layout.separator)}")
    if layout.decimal != ".":
        keys.append(DraftKey("decimal", layout.decimal))
        words.append("decimal commas")
    if layout.columns:
        keys.append(DraftKey("columns", layout.columns, "name here = name in the file"))
        words.append(", ".join(f"{ours} = {theirs!r}" for ours, theirs in layout.columns.items()))
    used = {table.name_of(column) for column in table.cells}
    unused = [name for name in table.header if name and name not in used]
    if unused:
        words.append(f"not used: {', '.join(unused)}")
    return tuple(keys), "".join(f"; {word}" for word in words)


def _time_parts(
    file: TrajectoryFile, start: FirstEpoch | None, times_s: Mapping[str, float]
) -> Iterator[Part]:
    """Yield the time system of the file, and the day if its times are seconds of a week."""
    if start is None or not start.time:
        return
    named = None if file.table is None else file.table.time_system
    if NUMBER.fullmatch(start.time):
        if float(start.time) < _WEEK_S:
            yield from _week_parts(float(start.time), named, times_s)
        elif named is TimeSystem.GPS:
            yield from _gps_seconds_parts()
        return
    if names_zone(start.time) is False:
        yield from _zone_parts(start.time, named)
        return
    try:
        parse_time(start.time)
    except SettingError as error:
        is_half = half_of_time(start.time) is not None
        why = ": date and time seem to stand in two columns" if is_half else ""
        remedy = f"{error.remedy}; then repeat kgcp init without this flight.toml"
        yield Gap("trajectory", f"times of the trajectory: {error.problem}{why}", remedy)


def _week_parts(
    seconds: float, named: TimeSystem | None, times_s: Mapping[str, float]
) -> Iterator[Part]:
    """Yield the keys for seconds of the week; the frames' times tell which week it is."""
    system = named or TimeSystem.GPS
    why = "by the name of its column" if named else "ASSUMED, since most programs write it"
    yield DraftKey("time_system", system.value, f'{why}; otherwise "utc"')
    if times_s:
        day = first_day_near(seconds, min(times_s.values()), system)
        yield DraftKey("date", day, "day of the first epoch, found from the frames' times")
    else:
        yield DraftKey("date", None, "day of the first epoch", "2026-05-04", is_missing=True)
        yield Gap(
            "trajectory",
            f"its times, from {seconds:.1f} s on, are seconds of a week, and no file says which",
            "write date = … into [vehicle]",
        )
    if not named:
        yield Gap(
            "trajectory",
            "its times are GPS time, as most programs write it",
            'make sure of it, or write time_system = "utc" into [vehicle]',
            is_assumed=True,
        )


def _gps_seconds_parts() -> Iterator[Part]:
    """Yield the key for seconds since 1970 in a column named after GPS, which may still be UTC."""
    yield DraftKey("time_system", "gps", 'ASSUMED, by the name of its column; otherwise "utc"')
    yield Gap(
        "trajectory",
        "its times are GPS time, 18 s ahead of UTC, by the name of their column",
        'make sure of it, or write time_system = "utc" into [vehicle]',
        is_assumed=True,
    )


def _zone_parts(text: str, named: TimeSystem | None) -> Iterator[Part]:
    """Yield the key for times without a time zone."""
    if named is not None:
        yield DraftKey("time_system", named.value, "by the name of its column")
        return
    comment = 'or "utc": its times have no zone'
    yield DraftKey("time_system", None, comment, '"gps"', is_missing=True)
    yield Gap(
        "trajectory",
        f"its times, such as {text!r}, have no time zone",
        'write time_system = "gps" or "utc" into [vehicle]',
    )


def _attitude(start: FirstEpoch | None) -> tuple[tuple[DraftKey, ...], str]:
    if start is None:
        return (), ""
    if start.has_attitude:
        return (), "; with attitude"
    keys = (
        DraftKey(
            "attitude", "course", "the file has none: heading from the course, roll and pitch 0"
        ),
        DraftKey("sd_attitude_deg", (2.0, 2.0, 3.0), "your estimate: roll, pitch, heading, 1 σ"),
    )
    return keys, "; without attitude: its heading is the course over ground"


def _lever_arm_parts(options: InitOptions) -> Iterator[Part]:
    if options.lever_arm_m is not None:
        yield DraftKey("lever_arm_m", options.lever_arm_m, _LEVER_ARM)
        yield InitFinding("lever arm", f"{list(options.lever_arm_m)} m, as given")
    else:
        yield DraftKey("lever_arm_m", None, _LEVER_ARM, "[-0.8, 0.15, -1.95]", is_missing=True)
        yield Gap(
            "lever arm",
            "no file states where the target is relative to the trajectory's point",
            "measure it and write lever_arm_m = [forward, right, down] in metres into [vehicle]",
        )
    yield DraftKey("sd_lever_arm_m", None, "how well it is known, 1 σ", "[0.005, 0.005, 0.005]")
