"""OpenSfM's ground_control_points.json, and camera positions in exif_overrides.json.

By OpenSfM's io.py, gcp.rst, using.rst and geometry.rst: positions are latitude, longitude and
ellipsoidal altitude in WGS 84; image coordinates are normalised by the longer side, from the middle
of the frame, with (0, 0) px in the centre of the top-left pixel.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.georef.crs import wgs84_from_map
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import MapPoints, by_id, image_names, largest_sd

_FOLDER = "opensfm"
_HOWTO = """\
OpenSfM

Copy ground_control_points.json into the data set's folder, and in config.yaml:

  bundle_use_gcp: yes
  gcp_horizontal_sd: 0.02    # of all points alike [m]; see kgcps.csv for what they have
  gcp_vertical_sd: 0.03
  bundle_use_gps: yes        # needed to align the block: a point seen in one image does not help
                             # there, it enters in the bundle adjustment

exif_overrides.json, if it is here, has camera positions from the plate and its vehicle's attitude,
for the images that show the target. They are weak (dop is their standard deviation in metres, the
same for all axes); copy it only where the images' own positions are worse.

Do not give OpenSfM the gcp_list.txt of OpenDroneMap: with an EPSG code in its first line the two
programs disagree about the order of the axes. This file says latitude and longitude by name.

OpenSfM ignores: standard deviations of single points and marks, distances. Points kept for checking
are not in the file. Coordinates are WGS 84, longitude and latitude in degrees, height above
the ellipsoid in metres.
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return the files of OpenSfM.

    Raises
    ------
    KgcpError
        If the CRS has no known way to WGS 84, or two images have the same name.
    """
    places = [group[0].position_map for group in by_id(points.controls).values()]
    cameras = [prior.position_map for prior in points.priors]
    geodetic = wgs84_from_map(points.crs, [*places, *cameras], _FOLDER).tolist()
    texts = {
        "ground_control_points.json": _control(points, geodetic[: len(places)]),
        "HOWTO.txt": _HOWTO,
    }
    if points.priors:
        texts["exif_overrides.json"] = _overrides(points, geodetic[len(places) :])
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _control(points: MapPoints, geodetic: Sequence[Sequence[float]]) -> str:
    """Return the points; `geodetic` is longitude, latitude [deg] and height [m] of each."""
    names = image_names((point.frame for point in points.gcps), _FOLDER, "")
    groups = by_id(points.controls)
    entries = [
        {
            "id": point_id,
            "position": {"latitude": lat, "longitude": lon, "altitude": height},
            "observations": [
                {"shot_id": names[point.frame], "projection": _normalised(point, points.camera)}
                for point in group
            ],
        }
        for (point_id, group), (lon, lat, height) in zip(groups.items(), geodetic, strict=True)
    ]
    return json.dumps({"points": entries}, indent=1, ensure_ascii=False) + "\n"


def _normalised(point: Gcp, camera: Camera) -> list[float]:
    middle = 0.5 * (np.array([camera.width, camera.height]) - 1.0)
    projection: list[float] = (
        (point.centre_px - middle) / max(camera.width, camera.height)
    ).tolist()
    return projection


def _overrides(points: MapPoints, geodetic: Sequence[Sequence[float]]) -> str:
    """Return the priors' positions; `geodetic` as in `_control`."""
    names = image_names((prior.frame for prior in points.priors), _FOLDER, "")
    entries = {}
    for prior, (lon, lat, height) in zip(points.priors, geodetic, strict=True):
        gps = {"latitude": lat, "longitude": lon, "altitude": height}
        if prior.cov is not None:
            gps["dop"] = largest_sd(prior.cov[:3, :3])
        entries[names[prior.frame]] = {"gps": gps}
    return json.dumps(entries, indent=1, ensure_ascii=False) + "\n"
