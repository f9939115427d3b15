"""GeoJSON for a map: WGS 84, longitude first, as RFC 7946 wants it."""

from __future__ import annotations

import json
from collections.abc import Mapping

from kgcp.georef.crs import wgs84_from_map
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.shared import attributes

_HOWTO = """\
GeoJSON

Open kgcps.geojson in QGIS or any web map. It is for looking at: WGS 84, longitude and latitude in
degrees, height above the ellipsoid in metres, as RFC 7946 prescribes. The properties x, y, z are
the coordinates in the CRS that the property crs names; standard deviations in
metres along its axes; (0, 0) px is the centre of the top-left pixel.
No package for aerial triangulation reads control points from it.
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return `kgcps.geojson`.

    Raises
    ------
    KgcpError
        If the CRS has no known way to WGS 84.
    """
    positions = [point.position_map for point in points.gcps]
    geodetic = wgs84_from_map(points.crs, positions, "geojson")
    features = [
        {
            "type": "Feature",
            "geometry": {
                "type": "Point",
                "coordinates": [round(lon, 12), round(lat, 12), round(height, 7)],
            },
            "properties": {**attributes(point), "crs": points.crs},
        }
        for point, (lon, lat, height) in zip(points.gcps, geodetic.tolist(), strict=True)
    ]
    text = ",\n".join(json.dumps(feature, ensure_ascii=False) for feature in features)
    collection = f'{{"type": "FeatureCollection", "features": [\n{text}\n]}}\n'
    return {"geojson/kgcps.geojson": collection, "geojson/HOWTO.txt": _HOWTO}
