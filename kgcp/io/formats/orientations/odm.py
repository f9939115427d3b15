"""OpenDroneMap's odm_report/shots.geojson.

By opendm/shots.py: a point of WGS 84 per image, with the properties `rotation`, axis times angle
from the axes of the UTM grid to the camera (x right, y down, z forward), and `translation`, which
is no translation but the projection centre in UTM. Which zone that is, is not said: it is the one
in which the point has these coordinates.
"""

from __future__ import annotations

import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.sniff import ForeignFile, JsonObject
from kgcp.io.formats.orientations.source import SourcePoses, photo_rotation

_ZONE_TOLERANCE_M = 0.05


def matches(file: ForeignFile) -> bool:
    """Whether the content is a collection of such points."""
    if not isinstance(file.document, dict) or file.document.get("type") != "FeatureCollection":
        return False
    features = file.document.get("features")
    first = features[0] if isinstance(features, list) and features else None
    properties = first.get("properties") if isinstance(first, dict) else None
    return isinstance(properties, dict) and {"filename", "rotation"} <= properties.keys()


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses, in the UTM zone that the file is in.

    Raises
    ------
    KgcpError
        Naming the feature that lacks something; or if the translations are of no UTM zone.
    """
    features = JsonObject.of(file, "", file.document).children("features")
    properties = [feature.child("properties") for feature in features]
    rotvec = np.array([one.vector("rotation", 3) for one in properties]).reshape(-1, 3)
    centre = np.array([one.vector("translation", 3) for one in properties]).reshape(-1, 3)
    points = [feature.child("geometry").vector("coordinates", 3) for feature in features]
    grid_from_camera = np.swapaxes(Rotation.from_rotvec(rotvec).as_matrix(), 1, 2)
    turned = [
        photo_rotation(file, one.where, matrix)
        for one, matrix in zip(properties, grid_from_camera, strict=True)
    ]
    return SourcePoses(
        tuple(one.text("filename") for one in properties),
        centre,
        np.array(turned).reshape(-1, 3, 3),
        crs=_zone(file, np.array(points).reshape(-1, 3), centre),
    )


def _zone(file: ForeignFile, points: FloatArray, centre: FloatArray) -> str:
    """Return the UTM zone of WGS 84 that leads from the points to the centres."""
    longitude, latitude = points[:1, 0], points[:1, 1]
    middle = int(np.floor((longitude[0] + 180.0) / 6.0)) if points.size else 0
    for zone in ((middle + step) % 60 + 1 for step in (0, -1, 1, -2, 2)):
        for family in (326, 327):
            crs = f"EPSG:{family}{zone:02d}"
            utm = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
            found = np.column_stack(utm.transform(points[:, 0], points[:, 1]))
            if np.all(np.abs(found - centre[:, :2]) < _ZONE_TOLERANCE_M):
                return crs
    raise file.error(
        "",
        f"has translations of no UTM zone about {longitude[0]:.4f}, {latitude[0]:.4f}",
        "give the reconstruction.topocentric.json of the same project",
    )
