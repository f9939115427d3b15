"""Draft of a flight.toml for a folder that has none, and a report of what was found and missing."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from kgcp.errors import KgcpError
from kgcp.io.files.atomic import write_bytes
from kgcp.io.files.csv_text import csv_text
from kgcp.io.files.time_text import format_time
from kgcp.io.flight.flight import read_target_tables
from kgcp.io.flight.folder import FolderContents, survey_folder
from kgcp.io.flight.target_table import target_lines
from kgcp.io.flight.toml_draft import MISSING, DraftKey, DraftText
from kgcp.io.formats.frame_times import read_times
from kgcp.io.formats.name_times import times_of_names
from kgcp.io.formats.point_table import PointTable, require_one_place
from kgcp.io.images.exif import read_frame_header
from kgcp.io.images.frames import FLIGHT_TOML
from kgcp.pipeline.init_camera import camera_section
from kgcp.pipeline.init_records import Gap, InitFinding, InitOptions, Part, Section
from kgcp.pipeline.init_vehicle import crs_parts, vehicle_section
from kgcp.quality.checks.clock import time_span
from kgcp.quality.checks.frame_header import FrameHeader
from kgcp.targets.code_design import new_targets
from kgcp.targets.layout import Target

_FRAMES_CSV = "frames.csv"
_NO_OPTIONS = InitOptions()
_SHOWN_NAMES = 4  # of surveyed points
_HEAD = (
    '# Written by kgcp init from the files of this folder. Lines "# key = value" are comments and',
    f"# set nothing; fill in those marked {MISSING}. docs/flight_toml.md explains every key.",
)
_UNKNOWN_POSITION = DraftKey(
    "position_m", None, "if the target is static", "[689412.0, 5336208.0, 545.0]", is_missing=True
)
_SD_POSITION = DraftKey(
    "sd_position_m", None, "how well it is surveyed, 1 σ", "[0.01, 0.01, 0.015]"
)
_EXAMPLE_TARGET = (
    "",
    "# [[target]]",
    f"# {MISSING}: copy the tables of targets.toml, which kgcp target writes, for example:",
    '# name = "A"',
    "# outer_diameter_m = 0.9",
    "# inner_diameter_m = 0.45",
    "# code_diameter_m = 0.642857",
    "# dot_diameter_m = 0.128571",
    "# code_deg = [0, 43, 78, 180]",
)


@dataclass(frozen=True, slots=True)
class FlightDraft:
    """A flight.toml that is not written yet, with the origin of its values and what is missing."""

    toml_text: str
    # text of a frames.csv if the frames' names contain times; None: they are in another file, or
    # unknown
    frames_csv: str | None
    findings: tuple[InitFinding, ...]  # information found in the folder, with its source
    gaps: tuple[Gap, ...]  # what is missing, and what to do about it


def draft_flight(folder: Path, options: InitOptions = _NO_OPTIONS) -> FlightDraft:
    """Draft the flight.toml of a folder of frames.

    Raises
    ------
    KgcpError
        If the folder does not exist, has a flight.toml already or no frames, or an option is wrong.
    """
    _require_new(folder)
    contents = survey_folder(folder)
    headers = [
        read_frame_header(contents.frames_folder / frame, frame) for frame in contents.frames
    ]
    times = _times(contents, headers)
    frames = Section.of("[frames]", (*_frames_parts(contents), *times.parts))
    vehicle = vehicle_section(contents, times.time_s, options)
    targets, surveyed = _targets_section(contents, options)
    crs = crs_parts(contents, headers, surveyed, options)
    top = Section.of("", (DraftKey("name", _name_of(folder)), *crs))
    camera = camera_section(contents, headers)
    reference = Section.of("[reference]", _reference_parts(contents))
    written = (top, frames, camera, targets, vehicle, reference)
    reported = (frames, camera, targets, top, vehicle, reference)
    blocks = (block for section in written for block in section.blocks)
    lines = [*_HEAD, *(line for block in blocks for line in block.lines())]
    return FlightDraft(
        "\n".join(lines) + "\n",
        times.frames_csv,
        tuple(finding for section in reported for finding in section.findings),
        tuple(gap for section in reported for gap in section.gaps),
    )


def write_draft(draft: FlightDraft, folder: Path) -> list[Path]:
    """Write the files of a draft, and return them.

    Raises
    ------
    KgcpError
        If one of them exists already, or cannot be written.
    """
    _require_new(folder)
    contents = {folder / FLIGHT_TOML: draft.toml_text}
    if draft.frames_csv is not None:
        contents = {folder / _FRAMES_CSV: draft.frames_csv, **contents}
    for path, text in contents.items():
        if path.exists():
            raise KgcpError(f"{path}: exists and is not replaced; move it away")
        write_bytes(path, text.encode())
    return [*contents]


def _require_new(folder: Path) -> None:
    path = folder / FLIGHT_TOML
    if os.path.lexists(path):
        raise KgcpError(
            f"{path}: exists and is not replaced; edit it, or move it away and repeat 'kgcp init'"
        )


def _name_of(folder: Path) -> str:
    name = "".join(letter if letter.isprintable() else "_" for letter in folder.resolve().name)
    return name.strip()[:100] or "flight"


def _frames_parts(contents: FolderContents) -> Iterator[Part]:
    suffixes = Counter(PurePosixPath(frame).suffix.lower() for frame in contents.frames)
    kinds = ", ".join(f"{count} {suffix}" for suffix, count in suffixes.most_common())
    folder = contents.relative(contents.frames_folder)
    yield DraftKey("folder", folder, kinds)
    yield InitFinding("frames", f"{kinds} in {'this folder' if folder == '.' else f'{folder}/'}")


@dataclass(frozen=True, slots=True)
class _Times:
    """Times of the frames and their source."""

    time_s: Mapping[str, float]  # Unix UTC [s]
    parts: tuple[Part, ...]
    frames_csv: str | None = None  # a table of the times where the frames' names have them


def _times(contents: FolderContents, headers: Sequence[FrameHeader]) -> _Times:
    """Return the frames' times from the first source that has any: a file, names, or EXIF."""
    unreadable = []
    for path in (*contents.times, *contents.marks, *contents.events):
        name = contents.relative(path)
        try:
            known = read_times(path, contents.frames).time_s
        except KgcpError as error:
            unreadable.append(Gap("times", str(error).removeprefix(f"{path}: "), f"correct {name}"))
            continue
        time_s = {frame: known[frame] for frame in contents.frames if frame in known}
        if time_s:
            lacking = len(contents.frames) - len(time_s)
            gap = Gap("times", f"{lacking} frames are not in {name}", "complete it, or remove them")
            key = DraftKey("times", name, f"{len(time_s)} of {len(contents.frames)} frames")
            found = InitFinding("times", f"{_span(time_s)}, from {name}")
            return _Times(time_s, (key, found, *((gap,) if lacking else ())))
    if (by_name := times_of_names(contents.frames)) is not None:
        rows = [(frame, format_time(moment)) for frame, moment in by_name.items()]
        key = DraftKey("times", _FRAMES_CSV, "made by kgcp init from the frames' names")
        text = f"{_span(by_name)}, from the frames' names, as {_FRAMES_CSV}"
        csv = csv_text(("frame", "time"), rows)
        return _Times(by_name, (key, InitFinding("times", text)), csv)
    time_s = {each.frame: each.time_s for each in headers if each.time_s is not None}
    parts = _exif_time_parts(time_s, len(contents.frames), is_moving=bool(contents.trajectories))
    return _Times(time_s, (*unreadable, *parts))


def _exif_time_parts(
    time_s: Mapping[str, float], frames: int, *, is_moving: bool
) -> Iterator[Part]:
    remedy = "give the camera's Timestamp.MRK, or frames.csv with the columns frame and time"
    is_missing = is_moving and not time_s
    yield DraftKey(
        "times", None, "without it, EXIF times are used", '"frames.csv"', is_missing=is_missing
    )
    why = "no file states the times of the frames, nor does EXIF together with a time zone"
    if time_s:
        which = f"{len(time_s)} of {frames}" if len(time_s) < frames else str(frames)
        yield InitFinding("times", f"{_span(time_s)}, from EXIF ({which} frames)")
        why = "EXIF times are rarely good to a millisecond, in which a vehicle moves a centimetre"
        if all(moment.is_integer() for moment in time_s.values()):
            why = "EXIF times are in whole seconds, in which a vehicle moves metres"
        if len(time_s) < frames:
            lacking = frames - len(time_s)
            why = f"EXIF has no time with a zone in {lacking} of {frames} frames; {why}"
    elif not is_moving:
        yield InitFinding("times", f"none: {why}; static targets need none")
    if is_moving:
        yield Gap("times", why, remedy, is_assumed=len(time_s) == frames)


def _span(time_s: Mapping[str, float]) -> str:
    return f"{time_span(np.array(sorted(time_s.values())))} UTC"


def _targets_section(
    contents: FolderContents, options: InitOptions
) -> tuple[Section, tuple[PointTable, ...]]:
    """Return the [[target]] tables, and the tables of points from which positions were taken.

    The targets come from the options or a targets.toml. Those that a table of points names are
    static; the vehicle carries the others.
    """
    targets, source = _targets(contents, options)
    if not targets:
        gap = Gap(
            "targets",
            "there is no targets.toml in the folder",
            "copy the targets.toml of kgcp target there, or give the target's diameters and code",
        )
        return Section((DraftText(_EXAMPLE_TARGET),), (), (gap,)), ()
    positions_m, surveyed = _surveyed_positions(contents, targets)
    names = ", ".join(f"{each.name} ({each.ring.outer_diameter_m:g} m)" for each in targets)
    found = [InitFinding("targets", f"{names}, from {source}")]
    if positions_m:
        files = ", ".join(contents.relative(points.path) for points in surveyed)
        found.append(InitFinding("positions", f"of {', '.join(sorted(positions_m))}, from {files}"))
    found += [_unused(points, contents) for points in contents.points if points not in surveyed]
    is_carried = bool(contents.trajectories)
    unplaced = [
        each.name
        for each in targets
        if each.name not in positions_m and each.position_m is None and not is_carried
    ]
    blocks = tuple(
        _block(each, positions_m.get(each.name), is_unplaced=each.name in unplaced)
        for each in targets
    )
    why = "no trajectory is recognised" if contents.unknown else "there is no trajectory"
    gap = Gap(
        "positions",
        f"nothing says where {', '.join(unplaced)} {'is' if len(unplaced) == 1 else 'are'}: {why},"
        " and no table of surveyed points with that name",
        "write position_m = [x, y, z] below the target, or put the vehicle's trajectory or a table"
        " with the columns name, x, y, z into the folder before kgcp init",
    )
    return Section(blocks, tuple(found), (gap,) if unplaced else ()), surveyed


def _unused(points: PointTable, contents: FolderContents) -> InitFinding:
    """Say that no target has the name of a point: 001 is not 1."""
    shown = ", ".join(points.names[:_SHOWN_NAMES])
    more = " …" if len(points.names) > _SHOWN_NAMES else ""
    return InitFinding(
        "not used", f"{contents.relative(points.path)}: no target has its names, {shown}{more}"
    )


def _block(
    target: Target, position_m: tuple[float, float, float] | None, *, is_unplaced: bool
) -> DraftText:
    """Return the tables of a target and its replicas; its position is in the first of them."""
    placed = target if position_m is None else replace(target, position_m=position_m)
    plate = tuple(target_lines(replace(placed, replicas=())))
    replicas = tuple(target_lines(placed))[len(plate) :]
    unknown = (_UNKNOWN_POSITION.line(),) if is_unplaced else ()
    is_static = is_unplaced or placed.position_m is not None
    sd = (_SD_POSITION.line(),) if is_static and not any(placed.sd_position_m) else ()
    return DraftText((*plate, *unknown, *sd, *replicas))


def _targets(contents: FolderContents, options: InitOptions) -> tuple[tuple[Target, ...], str]:
    """Return the flight's targets, and their source."""
    if options.targets_file is not None:
        return read_target_tables(options.targets_file), str(options.targets_file.name)
    if options.codes or options.diameter_m is not None:
        return new_targets(
            (), options.diameter_m, options.codes, 0, 0
        ), "the diameter and code given"
    if contents.targets:
        path = contents.targets[0]
        return read_target_tables(path), contents.relative(path)
    return (), ""


def _surveyed_positions(
    contents: FolderContents, targets: Sequence[Target]
) -> tuple[dict[str, tuple[float, float, float]], tuple[PointTable, ...]]:
    """Return the surveyed positions of targets by name, and the tables of points that have them."""
    positions_m: dict[str, tuple[float, float, float]] = {}
    used: list[PointTable] = []
    names = {target.name for target in targets}
    for points in contents.points:
        own = points.positions(names)
        for name in own.keys() & positions_m.keys():
            files = f"{used[-1].path}, {points.path}"
            require_one_place(name, positions_m[name], own[name], files)
        if own:
            used.append(points)
            positions_m |= own
    return positions_m, tuple(used)


def _reference_parts(contents: FolderContents) -> Iterator[Part]:
    names = [*map(contents.relative, contents.references)]
    if len(names) == 1:
        yield DraftKey("poses", names[0])
        yield InitFinding("reference", f"poses of the camera, from {names[0]}")
    else:
        if names:
            yield Gap(
                "reference",
                f"several files have poses of the camera: {', '.join(names)}",
                "leave one of them in the folder, or fill in [reference]",
            )
        comment = "poses of the camera from an adjustment"
        yield DraftKey("poses", None, comment, '"reference.csv"', is_missing=bool(names))
