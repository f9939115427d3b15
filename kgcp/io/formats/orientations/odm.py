"""OpenDroneMap's odm_report/shots.geojson.

By opendm/shots.py: a point of WGS 84 per image, with the properties `rotation`, axis times angle
from the axes of the UTM grid to the camera (x right, y down, z forward), and `translation`, which
is not a translation but the projection centre in UTM. The zone is not stated: it is the one in
which the point has these coordinates.
"""

from __future__ import annotations

import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.sniff import ForeignFile, NamedValues, vectors
from kgcp.io.formats.orientations.records import SourcePoses, photo_rotations

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
    """Return the poses, in the UTM zone of the file."""
    features = NamedValues.of(file, "", file.document).children("features")
    properties = [feature.child("properties") for feature in features]
    centre = vectors(properties, "translation")
    points = vectors([feature.child("geometry") for feature in features], "coordinates")
    rotation = Rotation.from_rotvec(vectors(properties, "rotation")).as_matrix()
    places = [each.where for each in properties]
    return SourcePoses(
        tuple(each.text("filename") for each in properties),
        centre,
        photo_rotations(file, places, np.swapaxes(rotation, 1, 2)),
        crs=_zone(file, points, centre),
    )


def _zone(file: ForeignFile, points: FloatArray, centre: FloatArray) -> str:
    """Return the UTM zone of WGS 84 in which the points have the coordinates of the centres."""
    longitude, latitude = points[:1, 0], points[:1, 1]
    middle = int(np.floor((longitude[0] + 180.0) / 6.0)) if points.size else 0
    for zone in ((middle + step) % 60 + 1 for step in (0, -1, 1, -2, 2)):
        for family in (326, 327):
            crs = f"EPSG:{family}{zone:02d}"
            utm = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
            projected = np.column_stack(utm.transform(points[:, 0], points[:, 1]))
            if np.all(np.abs(projected - centre[:, :2]) < _ZONE_TOLERANCE_M):
                return crs
    raise file.error(
        f"has translations that fit no UTM zone near {longitude[0]:.4f}, {latitude[0]:.4f}",
        "give the reconstruction.topocentric.json of the same project",
    )
