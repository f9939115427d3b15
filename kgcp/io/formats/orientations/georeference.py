"""From the frame of a file of poses to the flight's map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, opk_from_rotation
from kgcp.georef.crs import CRS_KEY, MAX_HEIGHT, geographic_of, parse_crs
from kgcp.georef.local_frame import CrsTransform, LocalFrame
from kgcp.io.files.safe_read import is_number
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.records import (
    OrientationFileOptions,
    SourcePoses,
    from_geocentric,
    from_level,
)

REFERENCE_CRS = "flight.toml: [reference] crs"
_REMEDY = "align it to a map and give [reference] crs, that of its coordinates"


def on_the_map(
    file: ForeignFile,
    source: SourcePoses,
    frames: tuple[str, ...],
    options: OrientationFileOptions,
    crs: str | None,
) -> ReferencePoses:
    """Return poses in the flight's CRS, attitudes relative to its grid.

    Parameters
    ----------
    frames : tuple of str
        Their names in the flight.

    Raises
    ------
    KgcpError
        If the coordinates are in no known map, flight.toml names one for a file that names
        its own, no exact way leads from there to the flight's CRS, or a pose lies far from
        the Earth's surface.
    """
    placed = _placed(file, _shifted(file, source, options), options.crs)
    if placed.crs is not None and not _is_same(placed.crs, crs):
        where = f"{file.path}: crs" if options.crs is None else REFERENCE_CRS
        placed = _moved(file, placed, LocalFrame.at(placed.crs, placed.position[0], where), crs)
    high = np.flatnonzero(np.abs(placed.position[:, 2]) > MAX_HEIGHT)
    if high.size:
        raise file.error_at(
            f"pose of {source.names[high[0]]!r}",
            f"has a height of {placed.position[high[0], 2]:.0f}",
            "correct [reference] crs, that of the file's coordinates",
        )
    return ReferencePoses(
        frames=frames,
        position_map=placed.position,
        opk_deg=opk_from_rotation(placed.frame_from_photo).reshape(-1, 3),
        sd_position_m=placed.sd_position_m,
        sd_angle_deg=placed.sd_angle_deg,
    )


def _shifted(
    file: ForeignFile, source: SourcePoses, options: OrientationFileOptions
) -> SourcePoses:
    if options.offset_file is None:
        return source
    if source.crs is not None:
        raise file.error("is georeferenced already", "delete [reference] offset")
    if options.crs is None and (source.level or source.unreferenced):
        raise file.error(
            "is not in map coordinates, to which an offset could lead",
            "give [reference] crs as well",
        )
    return replace(source, position=source.position + read_offset(options.offset_file))


def read_offset(path: Path) -> FloatArray:
    """Return what was subtracted from coordinates (3,): Pix4D's offset.xyz, ODM's coords.txt.

    It is the first line of two or three numbers alone; without a third, heights are whole.

    Raises
    ------
    KgcpError
        If the file has no such line.
    """
    file = ForeignFile(path, "[reference] offset")
    for _, row in file.rows:
        words = row.replace(",", " ").split()
        if len(words) in (2, 3) and all(map(is_number, words)):
            return np.array([*map(float, words), 0.0][:3])
    raise file.error("has no line of two or three numbers", "give the project's offset file")


def _placed(file: ForeignFile, source: SourcePoses, stated: str | None) -> SourcePoses:
    """Return the poses with the CRS of their coordinates; None: the flight's."""
    if stated is not None:
        if source.crs is not None:
            raise file.error("names its CRS already", "delete [reference] crs")
        return _stated(source, stated)
    if source.unreferenced is not None and source.crs is None:
        raise file.error(source.unreferenced, _REMEDY)
    if source.level is not None:
        return from_level(source.names, source.position, source.frame_from_photo, source.level)
    return source


def _stated(source: SourcePoses, crs: str) -> SourcePoses:
    """Return poses whose coordinates are of a CRS that flight.toml states."""
    parsed = parse_crs(crs, REFERENCE_CRS)
    if parsed.is_geocentric:
        return from_geocentric(
            source.names, source.position, source.frame_from_photo, geographic_of(parsed)
        )
    if parsed.is_geographic and source.unreferenced is not None:
        raise KgcpError(
            f"{REFERENCE_CRS} {crs!r} counts degrees, but the poses are in a Cartesian frame;"
            " give the projected or geocentric CRS that they are aligned to"
        )
    return replace(source, crs=crs, level=None)


def _is_same(crs: str, flight_crs: str | None) -> bool:
    return flight_crs is not None and (
        crs == flight_crs
        or parse_crs(crs, REFERENCE_CRS).equals(parse_crs(flight_crs), ignore_axis_order=True)
    )


def _moved(
    file: ForeignFile, source: SourcePoses, local_frame: LocalFrame, crs: str | None
) -> SourcePoses:
    """Bring poses from their map, that of `local_frame`, to the flight's."""
    if crs is None:
        raise file.error(
            "has coordinates of its own CRS, but flight.toml has none",
            'name the flight\'s, for example crs = "EPSG:25831"',
        )
    transform = CrsTransform.to(crs, local_frame, source.position[0], CRS_KEY)
    turn = np.array([transform.axes(point) for point in source.position])
    sd = source.sd_position_m
    if sd is not None:  # the axes turn; what correlates then is left out
        sd = np.sqrt(np.einsum("nij,nj->ni", turn**2, sd**2))
    return replace(
        source,
        position=transform.positions(source.position),
        frame_from_photo=turn @ source.frame_from_photo,
        sd_position_m=sd,
    )
