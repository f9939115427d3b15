"""What several exporters share: attributes, notes on distances, XML text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from xml.etree import ElementTree as ET

from pyproj.enums import WktVersion
from pyproj.exceptions import CRSError

from kgcp.errors import KgcpError
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.weights import ASSUMED_SHARE, distance_share
from kgcp.io.files.time_text import format_time
from kgcp.io.tables.columns import ColumnType
from kgcp.io.tables.gcps import GCP_COLUMNS

_COLUMNS = {column.name: column for column in GCP_COLUMNS}
_NAMES = (
    *("id", "frame", "target", "time", "role", "x", "y", "z", "sd_x", "sd_y", "sd_z"),
    *("x_px", "y_px", "distance_m", "sd_distance_m"),
)
ATTRIBUTES: Mapping[str, str] = {
    name: "DOUBLE" if _COLUMNS[name].type is ColumnType.NUMBER else "TEXT" for name in _NAMES
}
"""Names and their types in SQL, in order."""

_NOTE = """\
Distances and the focal length: kgcp measures with the calibration of flight.toml. If its focal
length is wrong by 0.1 %, all distances are wrong by 0.1 %, 8 cm at 80 m. The same holds for the
printed diameter. {known}
The package has no place for an error that all distances share: their accuracies here are
sqrt(measured^2 + (share x distance)^2). kgcps.csv has the measured ones. Leave the calibration free
in the adjustment. If the adjusted focal length is different, put the new calibration into
flight.toml and begin again with kgcp detect.
"""


def attributes(point: Gcp) -> dict[str, object]:
    """Return the attributes of a point, as in `kgcps.parquet`; None where unknown."""
    cells = {name: _COLUMNS[name].get(point) for name in _NAMES}
    return {**cells, "time": None if point.time_s is None else format_time(point.time_s)}


def focal_length_note(gcps: Iterable[Gcp]) -> str:
    """Return lines for a HOWTO: how distances depend on the focal length, and by how much here."""
    shares = [distance_share(point) for point in gcps if point.sd_common_distance_m]
    if not shares:
        known = (
            "flight.toml does not say how well they are known (sd_fx, sd_outer_diameter_m): a\n"
            f"share of {100.0 * ASSUMED_SHARE:.2g} % is assumed."
        )
    else:
        percent = 100.0 * max(shares)
        known = f"By flight.toml (sd_fx, sd_outer_diameter_m) the share is {percent:.2g} % here."
    return _NOTE.format(known=known)


def marks_note(points: MapPoints) -> str:
    """Return lines for a HOWTO: that marks are weighted less than they were measured."""
    return (
        f"Marks: no standard deviation is below {points.mark_floor_px:g} px (kgcp export-gcp"
        " --mark-floor-px). They are\nmeasured better (kgcps.csv), but no calibration is that good"
        " everywhere, and with thousandths of\na pixel each would weigh as much as thousands of"
        " tie points."
    )


def well_known_text(points: MapPoints, where: str, program: str) -> str:
    """Return the points' CRS as well-known text 1, without heights unless it is compound.

    Raises
    ------
    KgcpError
        If the CRS has no such form.
    """
    try:
        return points.written_crs.to_wkt(WktVersion.WKT1_GDAL)
    except CRSError:
        raise KgcpError(
            f"{where}: crs {points.crs!r} has no form that {program} reads; export in another CRS"
            " or leave this format out"
        ) from None


def xml_text(root: ET.Element) -> str:
    """Return a document of one element, indented, with a declaration and a line end."""
    ET.indent(root, "  ")
    body = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n{body}\n'


def add_text(parent: ET.Element, tag: str, text: str) -> None:
    """Append an element that holds text."""
    ET.SubElement(parent, tag).text = text
