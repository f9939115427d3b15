"""The vehicle of a folder: its trajectory, by whose clock and in which CRS that is."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np

from kgcp.errors import SettingError
from kgcp.georef.crs import WGS84_3D, longitude_latitude, parse_crs
from kgcp.georef.crs_guess import is_geographic_place, projected_crs_near, utm_crs
from kgcp.io.files.gps_time import TimeSystem, first_day_near
from kgcp.io.files.time_text import NUMBER, parse_time
from kgcp.io.flight.folder import FolderContents
from kgcp.io.flight.toml_draft import DraftKey, DraftTable
from kgcp.io.formats.point_table import PointTable
from kgcp.io.formats.trajectories.first_epoch import FirstEpoch, TrajectoryFile, first_epoch
from kgcp.pipeline.init_records import Gap, InitFinding, InitOptions, Section
from kgcp.quality.checks.frame_header import FrameHeader

_WORDS = {
    "sbet": "SBET",
    "rtklib": "RTKLIB solution",
    "csv": "CSV table",
    "tum": "TUM trajectory",
}
_WEEK_S = 2e6  # seconds of a week are below, Unix seconds far above
_SHOWN_CRS = 3
_CRS_REMEDY = "write crs = … into flight.toml: the CRS of the surveyed coordinates"
_LEVER_ARM = "forward, right, down [m] to the target"


def vehicle_section(
    contents: FolderContents, times_s: Mapping[str, float], options: InitOptions
) -> Section:
    """Return [vehicle] of the one trajectory that lies in a folder.

    Parameters
    ----------
    times_s : mapping
        Times of the frames, Unix UTC [s]: they tell the week of a trajectory that has seconds of
        the week.
    """
    if len(contents.trajectories) != 1:
        return _no_trajectory(contents)
    file = contents.trajectories[0]
    start = first_epoch(file)
    name = contents.relative(file.path)
    layout_keys, layout_text = _layout(file)
    time_keys, time_gaps = _time_keys(file, start, times_s)
    attitude_keys, attitude_text = _attitude(file)
    lever_keys, lever_findings, lever_gaps = _lever_arm(options)
    accuracies = [contents.relative(path) for path in contents.accuracies]
    keys = (
        DraftKey("trajectory", name, f"{_WORDS[file.format]}, by its content"),
        *layout_keys,
        *_file_crs(start, file.format),
        *time_keys,
        *([DraftKey("accuracies", accuracies[0])] if file.format == "sbet" and accuracies else []),
        *attitude_keys,
        *lever_keys,
        DraftKey("sd_time_s", None, "synchronisation of frames and trajectory, 1 σ", "0.001"),
        DraftKey("level_sd_deg", None, "if the plate is level within this, 1 σ", "1.0"),
    )
    text = f"{name}: {_WORDS[file.format]}{layout_text}{attitude_text}"
    return Section(
        (DraftTable("[vehicle]", keys),),
        (InitFinding("trajectory", text), *lever_findings),
        (*_unreadable(name, start), *time_gaps, *lever_gaps),
    )


def _unreadable(name: str, start: FirstEpoch | None) -> tuple[Gap, ...]:
    if start is not None:
        return ()
    return (Gap("trajectory", f"{name} cannot be read", "see what kgcp check says of it"),)


def crs_key(
    contents: FolderContents,
    headers: Sequence[FrameHeader],
    surveyed: Sequence[PointTable],
    options: InitOptions,
) -> tuple[DraftKey, tuple[InitFinding, ...], tuple[Gap, ...]]:
    """Return the flight's crs: as said, or by surveyed points or trajectory, or what it may be.

    Parameters
    ----------
    surveyed : sequence of PointTable
        Whose coordinates flight.toml takes over.

    Raises
    ------
    KgcpError
        If the given CRS is none.
    """
    if options.crs is not None:
        parse_crs(options.crs, "crs")
        return DraftKey("crs", options.crs, "as given"), (InitFinding("crs", options.crs),), ()
    file = contents.trajectories[0] if len(contents.trajectories) == 1 else None
    start = None if file is None else first_epoch(file)
    place = _place(start, headers)
    if surveyed and surveyed[0].first_xy is not None:
        return _crs_by_place(contents.relative(surveyed[0].path), surveyed[0].first_xy, place)
    source = "" if file is None else contents.relative(file.path)
    if start is None:
        why = f"{source} cannot be read" if source else "nothing in the folder has coordinates"
        return _unknown_crs(why)
    if start.crs is not None and place is None:
        return _unknown_crs(f"{source} begins nowhere on Earth")
    if start.crs is None or place is None:
        return _crs_by_place(source, (start.x, start.y), place)
    crs = utm_crs(*place)
    return (
        DraftKey("crs", crs, f"UTM zone of {source}; heights are ellipsoidal"),
        (InitFinding("crs", f"{crs}, the UTM zone of {source}; any other may be written instead"),),
        (),
    )


def _place(start: FirstEpoch | None, headers: Sequence[FrameHeader]) -> tuple[float, float] | None:
    """Return longitude and latitude of the flight [deg], by its trajectory or by a frame."""
    if start is not None and start.crs is not None:
        place = longitude_latitude(start.crs, np.array([[start.x, start.y]]))[0]
        if np.isfinite(place).all() and is_geographic_place(*place):
            return float(place[0]), float(place[1])
    for each in headers:
        if each.longitude_deg is not None and each.latitude_deg is not None:
            return each.longitude_deg, each.latitude_deg
    return None


def _crs_by_place(
    source: str, xy: tuple[float, float], place: tuple[float, float] | None
) -> tuple[DraftKey, tuple[InitFinding, ...], tuple[Gap, ...]]:
    """Return the CRS in which coordinates lie where the flight was."""
    if is_geographic_place(*xy):
        comment = f"longitude, latitude and ellipsoidal height in {source}"
        found = (InitFinding("crs", f"{WGS84_3D}: {comment}"),)
        return DraftKey("crs", WGS84_3D, comment), found, ()
    silent = f"{source} does not say in which CRS its coordinates are"
    if place is None:
        return _unknown_crs(silent)
    near = projected_crs_near(*xy, *place)
    if not near:
        return _unknown_crs(f"{silent}, and in none of EPSG's do they lie where the flight was")
    if len(near) == 1:
        text = f"{near[0]}: in it {source} lies where the flight was"
        return (
            DraftKey("crs", near[0], f"of {source}, by its place"),
            (InitFinding("crs", text),),
            (),
        )
    shown = " or ".join(near[:_SHOWN_CRS])
    return _unknown_crs(f"{silent}; by the flight's place it may be {shown}", near[0])


def _unknown_crs(
    why: str, likely: str = "EPSG:25832"
) -> tuple[DraftKey, tuple[InitFinding, ...], tuple[Gap, ...]]:
    key = DraftKey(
        "crs", None, "of all coordinates; heights ellipsoidal", f'"{likely}"', is_missing=True
    )
    return key, (), (Gap("crs", why, _CRS_REMEDY),)


def _no_trajectory(contents: FolderContents) -> Section:
    """Return a table to be filled in."""
    names = [contents.relative(file.path) for file in contents.trajectories]
    keys = (
        DraftKey("trajectory", None, "the rover's file", '"rover.pos"'),
        DraftKey("lever_arm_m", None, _LEVER_ARM, "[-0.8, 0.15, -1.95]"),
    )
    note = "Only if a vehicle carries the target."
    if not names:
        return Section((DraftTable("[vehicle]", keys, note),), (), ())
    gap = Gap(
        "trajectory",
        f"several files may be it: {', '.join(names)}",
        "leave one of them in the folder, or fill in [vehicle]",
    )
    return Section((DraftTable("[vehicle]", keys, note),), (), (gap,))


def _layout(file: TrajectoryFile) -> tuple[tuple[DraftKey, ...], str]:
    """Return the layout of a CSV file where it differs from kgcp's own."""
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


def _file_crs(start: FirstEpoch | None, form: str) -> tuple[DraftKey, ...]:
    """Return the CRS of the file where that is not what its format says anyway."""
    if start is None or start.crs is None or form in {"sbet", "rtklib"}:
        return ()
    return (DraftKey("crs", start.crs, "x, y are longitude and latitude"),)


def _time_keys(
    file: TrajectoryFile, start: FirstEpoch | None, times_s: Mapping[str, float]
) -> tuple[tuple[DraftKey, ...], tuple[Gap, ...]]:
    """Return the time system of the file, and the day if its times are seconds of a week."""
    if start is None or not start.time:
        return (), ()
    named = None if file.table is None else file.table.time_system
    if NUMBER.fullmatch(start.time):
        seconds = float(start.time)
        return _week_keys(seconds, named, times_s) if seconds < _WEEK_S else ((), ())
    try:
        parse_time(start.time)
    except SettingError:
        return _zone_keys(start.time, named)
    return (), ()


def _week_keys(
    seconds: float, named: TimeSystem | None, times_s: Mapping[str, float]
) -> tuple[tuple[DraftKey, ...], tuple[Gap, ...]]:
    """Return the keys for seconds of the week, which the frames' times place in the calendar."""
    system = named or TimeSystem.GPS
    why = "by the name of its column" if named else "ASSUMED, as most programs write it"
    system_key = DraftKey("time_system", system.value, f'{why}; else "utc"')
    gap = (
        Gap(
            "trajectory",
            "its times are GPS time, as most programs write it",
            'make sure of it, or write time_system = "utc" into [vehicle]',
            is_assumed=True,
        ),
    )
    if times_s:
        day = first_day_near(seconds, min(times_s.values()), system)
        day_key = DraftKey("date", day, "of the first epoch, by the frames' times")
        return (system_key, day_key), () if named else gap
    day_key = DraftKey("date", None, "day of the first epoch", "2026-05-04", is_missing=True)
    lacking = Gap(
        "trajectory",
        f"its times, from {seconds:.1f} s on, are seconds of a week that nothing tells",
        "write date = … into [vehicle]",
    )
    return (system_key, day_key), (lacking, *(() if named else gap))


def _zone_keys(text: str, named: TimeSystem | None) -> tuple[tuple[DraftKey, ...], tuple[Gap, ...]]:
    """Return the key for times without a zone."""
    if named is not None:
        return (DraftKey("time_system", named.value, "by the name of its column"),), ()
    key = DraftKey(
        "time_system", None, 'or "utc": its times have no zone', '"gps"', is_missing=True
    )
    gap = Gap(
        "trajectory",
        f"its times, such as {text!r}, have no time zone",
        'write time_system = "gps" or "utc" into [vehicle]',
    )
    return (key,), (gap,)


def _attitude(file: TrajectoryFile) -> tuple[tuple[DraftKey, ...], str]:
    has_attitude = file.format in {"sbet", "tum"} or (
        file.table is not None and file.table.has_attitude
    )
    if has_attitude:
        return (), "; with attitude"
    keys = (
        DraftKey("attitude", "course", "it has none: heading of the course, roll and pitch 0"),
        DraftKey("sd_attitude_deg", (2.0, 2.0, 3.0), "your estimate: roll, pitch, heading, 1 σ"),
    )
    return keys, "; without attitude: its heading is the course over ground"


def _lever_arm(
    options: InitOptions,
) -> tuple[tuple[DraftKey, ...], tuple[InitFinding, ...], tuple[Gap, ...]]:
    sd_key = DraftKey("sd_lever_arm_m", None, "how well it is known, 1 σ", "[0.005, 0.005, 0.005]")
    if options.lever_arm_m is not None:
        finding = InitFinding("lever arm", f"{list(options.lever_arm_m)} m, as given")
        return (DraftKey("lever_arm_m", options.lever_arm_m, _LEVER_ARM), sd_key), (finding,), ()
    key = DraftKey("lever_arm_m", None, _LEVER_ARM, "[-0.8, 0.15, -1.95]", is_missing=True)
    gap = Gap(
        "lever arm",
        "no file tells where the target is, seen from the trajectory's point",
        "measure it and write lever_arm_m = [forward, right, down] in metres into [vehicle]",
    )
    return (key, sd_key), (), (gap,)
