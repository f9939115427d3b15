"""OpenDroneMap's gcp_list.txt.

Grammar and behaviour by ODM's opendm/gcp.py and OpenSfM's geometry.rst: the header names the
horizontal CRS; columns x y z im_x im_y image_name gcp_name, separated by white space; points are
grouped by equal x, y, z; heights are metres and are never transformed; (0, 0) px is the centre of
the top-left pixel, as in kgcp; images are known by file name, without their folder.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import PurePosixPath

from pyproj import CRS

from kgcp.errors import KgcpError
from kgcp.io.exporters.points import MapPoints

FILE_NAME = "gcp_list.txt"
_WGS84_UTM = re.compile(r"32([67])(\d\d)")
_NOTE = "# from kgcp: each moving point is seen in one image only; run ODM with --force-gps"


def files(points: MapPoints) -> Mapping[str, str]:
    """Return `gcp_list.txt`.

    Raises
    ------
    KgcpError
        If the CRS has no form that ODM reads, an image's name has white space, or two images in
        different folders have the same name.
    """
    crs = points.parsed_crs
    names = _image_names(point.frame for point in points.kgcps)
    height_factor = _metres_per_height_unit(crs)
    lines = [_header(points.crs, crs), _NOTE]
    for point in points.kgcps:
        x, y, z = points.coordinates(point, height_factor=height_factor)
        pixel_x, pixel_y = point.centre_px
        label = re.sub(r"\s+", "_", point.id)
        lines.append(f"{x} {y} {z} {pixel_x:.4f} {pixel_y:.4f} {names[point.frame]} {label}")
    return {FILE_NAME: "\n".join(lines) + "\n"}


def _header(text: str, crs: CRS) -> str:
    """Return the first line; `WGS84 UTM` where it applies, since no reader mistakes its axes."""
    while crs.is_bound and crs.source_crs is not None:
        crs = crs.source_crs
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
    code = horizontal.to_epsg()
    if code is None:
        if "+proj" in text:
            return text
        raise KgcpError(
            f"{FILE_NAME}: crs {text!r} has no EPSG code, which ODM needs;"
            " give crs in flight.toml as 'EPSG:code' or a PROJ string, or leave out --format odm"
        )
    utm = _WGS84_UTM.fullmatch(str(code))
    if utm is None:
        return f"EPSG:{code}"
    return f"WGS84 UTM {int(utm[2])}{'N' if utm[1] == '6' else 'S'}"


def _metres_per_height_unit(crs: CRS) -> float:
    """ODM takes z as metres, whatever unit the CRS has."""
    return float(crs.axis_info[2].unit_conversion_factor) if len(crs.axis_info) > 2 else 1.0


def _image_names(frames: Iterable[str]) -> dict[str, str]:
    names: dict[str, str] = {}
    owners: dict[str, str] = {}
    for frame in frames:
        name = PurePosixPath(frame).name
        if re.search(r"\s", name):
            raise KgcpError(
                f"{FILE_NAME}: frame {frame!r} has white space in its name, which separates the"
                " columns; rename the frames or leave out --format odm"
            )
        if owners.setdefault(name, frame) != frame:
            raise KgcpError(
                f"{FILE_NAME}: frames {owners[name]!r} and {frame!r} have the same file name, and"
                " ODM knows images by that; rename one or leave out --format odm"
            )
        names[frame] = name
    return names
