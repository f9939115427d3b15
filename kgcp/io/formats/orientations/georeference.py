"""Transformation of poses from the frame of their file to the flight's map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, opk_from_rotation, turned_covariance
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
        If the coordinates are in no known map, if flight.toml names a CRS though the file has its
        own, if that cannot be transformed exactly to the flight's CRS, or if a pose is higher than
        `MAX_HEIGHT`.
    """
    georeferenced = _placed(file, _shifted(file, source, options), options.crs)
    if georeferenced.crs is not None and not _is_same(georeferenced.crs, crs):
        where = f"{file.path}: crs" if options.crs is None else REFERENCE_CRS
        georeferenced = _on_flight_map(
            file,
            georeferenced,
            LocalFrame.at(georeferenced.crs, georeferenced.position[0], where),
            crs,
        )
    too_high = np.flatnonzero(np.abs(georeferenced.position[:, 2]) > MAX_HEIGHT)
    if too_high.size:
        raise file.error_at(
            f"pose of {source.names[too_high[0]]!r}",
            f"has a height of {georeferenced.position[too_high[0], 2]:.0f}",
            "correct [reference] crs, that of the file's coordinates",
        )
    return ReferencePoses(
        frames=frames,
        position_map=georeferenced.position,
        opk_deg=opk_from_rotation(georeferenced.frame_from_photo).reshape(-1, 3),
        sd_position_m=georeferenced.sd_position_m,
        sd_angle_deg=georeferenced.sd_angle_deg,
        cov=georeferenced.cov,
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

    It is the first line of only two or three numbers. Without a third, nothing was subtracted from
    heights.

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


def _placed(file: ForeignFile, source: SourcePoses, stated_crs: str | None) -> SourcePoses:
    """Return the poses with the CRS of their coordinates; None stands for the flight's."""
    if stated_crs is not None:
        if source.crs is not None:
            raise file.error("names its CRS already", "delete [reference] crs")
        return _in_stated_crs(source, stated_crs)
    if source.unreferenced is not None and source.crs is None:
        raise file.error(source.unreferenced, _REMEDY)
    if source.level is not None:
        return from_level(source.names, source.position, source.frame_from_photo, source.level)
    return source


def _in_stated_crs(source: SourcePoses, crs: str) -> SourcePoses:
    """Return poses whose coordinates are in a CRS that flight.toml states."""
    parsed = parse_crs(crs, REFERENCE_CRS)
    if parsed.is_geocentric:
        return from_geocentric(
            source.names, source.position, source.frame_from_photo, geographic_of(parsed)
        )
    if parsed.is_geographic and source.unreferenced is not None:
        raise KgcpError(
            f"{REFERENCE_CRS} {crs!r} is in degrees, but the poses are in a Cartesian frame;"
            " give the projected or geocentric CRS that they are aligned to"
        )
    return replace(source, crs=crs, level=None)


def _is_same(crs: str, flight_crs: str | None) -> bool:
    return flight_crs is not None and (
        crs == flight_crs
        or parse_crs(crs, REFERENCE_CRS).equals(parse_crs(flight_crs), ignore_axis_order=True)
    )


def _on_flight_map(
    file: ForeignFile, source: SourcePoses, local_frame: LocalFrame, crs: str | None
) -> SourcePoses:
    """Transform poses from the map of `local_frame` to the flight's."""
    if crs is None:
        raise file.error(
            "has coordinates in its own CRS, but flight.toml names none",
            'name the flight\'s, for example crs = "EPSG:25831"',
        )
    transform = CrsTransform.to(crs, local_frame, source.position[0], CRS_KEY)
    flight_from_source = np.array([transform.axes(point) for point in source.position])
    sd, cov = source.sd_position_m, source.cov
    if cov is not None:
        cov = turned_covariance(flight_from_source, cov)
        sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2)[:, :3])
    elif sd is not None:  # the axes turn; the resulting covariances are left out
        sd = np.sqrt(np.einsum("nij,nj->ni", flight_from_source**2, sd**2))
    return replace(
        source,
        position=transform.positions(source.position),
        frame_from_photo=flight_from_source @ source.frame_from_photo,
        sd_position_m=sd,
        cov=cov,
    )
