"""OpenDroneMap's gcp_list.txt and geo.txt.

Grammar and behaviour by ODM's opendm/gcp.py, geo.py and photo.py, and OpenSfM's geometry.rst: the
header names the horizontal CRS; columns x y z im_x im_y image_name gcp_name, separated by white
space; points are grouped by equal x, y, z; heights are metres and are never transformed; (0, 0) px
is the centre of the top-left pixel, as in kgcp; images are known by file name, without their
folder. geo.txt: image_name x y z yaw pitch roll horizontal_accuracy vertical_accuracy.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from pyproj import CRS
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.camera_priors import CameraPrior
from kgcp.georef.trajectory import ENU_FROM_NED
from kgcp.io.exporters.local_frame import local_cameras, local_points
from kgcp.io.exporters.points import (
    METRE_DECIMALS,
    MapPoints,
    decimals,
    deviations,
    image_names,
    labels,
    largest_sd,
    pixel,
)

_FOLDER = "odm"
_LIST = "gcp_list.txt"
_WGS84_UTM = re.compile(r"32([67])(0[1-9]|[1-5]\d|60)")
_NOTE = """\
# x (easting or longitude), y, height [m], pixel x, y, image, point
# from kgcp: each moving point is seen in one image only; run ODM with --force-gps"""
_CAMERA_FROM_BODY: FloatArray = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""ODM's body: x towards the top of the image, y to its right, z along the view."""

_HOWTO = """\
OpenDroneMap

Copy gcp_list.txt into the project's folder; ODM finds it there. Or name it:
--gcp PATH/gcp_list.txt

  --force-gps        needed. Each moving point is seen in one image only. ODM aligns the block
                     by points that are seen in two or more images; without them and without
                     --force-gps the block has no place and no scale before the adjustment.
  --gps-accuracy M   how well the positions in the images' EXIF are known [m]; 3 by default.

geo.txt, if it is here, has camera positions from the plate and its vehicle's attitude, for
the images that show the target, with their accuracies. Use it with --geo PATH only where the
images' own positions are worse; other images keep their own.

z is {heights}, written in metres. ODM uses it as it is, and the
images' own heights, too: where these are of another kind, the two are tens of metres apart.

ODM ignores: standard deviations of points and of marks (all points weigh the same), distances,
the CRS's vertical part. Of the two accuracies in geo.txt it takes the larger one for all three
axes. Points kept for checking are not in the list.
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return `gcp_list.txt`, HOWTO.txt and, if there are priors, geo.txt.

    Raises
    ------
    KgcpError
        If the CRS has no form that ODM reads, an image's name has white space, or two images in
        different folders have the same name.
    """
    texts = {_LIST: _gcp_list(points), "HOWTO.txt": _HOWTO.format(heights=points.heights)}
    if points.priors:
        texts["geo.txt"] = _geo(points)
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _gcp_list(points: MapPoints) -> str:
    names = image_names((point.frame for point in points.gcps), _LIST, r"\s")
    label = labels(points.gcps, _LIST)
    height_factor = _metres_per_height_unit(points.parsed_crs)
    lines = [_header(points), _NOTE]
    owners: dict[tuple[str, str, str], str] = {}
    for point in points.controls:
        xyz = points.xyz(point.position_map, height_factor=height_factor)
        while owners.setdefault(xyz, point.id) != point.id:
            above = float(xyz[2]) + 10.0**-METRE_DECIMALS  # ODM would merge the two points
            xyz = (xyz[0], xyz[1], decimals(above, METRE_DECIMALS))
        lines.append(" ".join((*xyz, *pixel(point), names[point.frame], label[point.id])))
    return "\n".join(lines) + "\n"


def _geo(points: MapPoints) -> str:
    names = image_names((prior.frame for prior in points.priors), "geo.txt", r"\s")
    height_factor = _metres_per_height_unit(points.parsed_crs)
    lines = [_header(points)]
    for prior, angles in zip(points.priors, _yaw_pitch_roll_deg(points), strict=True):
        xyz = points.xyz(prior.position_map, height_factor=height_factor)
        cells = (names[prior.frame], *xyz, *map(decimals, angles), *_accuracies(prior))
        lines.append(" ".join(cells))
    return "\n".join(lines) + "\n"


def _accuracies(prior: CameraPrior) -> tuple[str, ...]:
    if prior.cov is None:
        return ()
    return decimals(largest_sd(prior.cov[:2, :2])), decimals(float(deviations(prior.cov)[2]))


def _yaw_pitch_roll_deg(points: MapPoints) -> FloatArray:
    """Return yaw, pitch, roll (n, 3) [deg] against true north and the level, as ODM takes them.

    R(body → NED) = Rz(yaw) Ry(pitch) Rx(roll) with the body's x towards the image's top: yaw 0 has
    north there, pitch 0 looks straight down (opendm/photo.py, after Bäumker).
    """
    position_m, enu_from_map = local_cameras(points)
    map_from_camera = np.array([prior.map_from_camera for prior in points.priors])
    level = local_points(points).local_frame.level_rotations(position_m)
    level_from_camera = np.swapaxes(level, -1, -2) @ enu_from_map @ map_from_camera
    ned_from_body = ENU_FROM_NED.T @ level_from_camera @ _CAMERA_FROM_BODY
    angles: FloatArray = Rotation.from_matrix(ned_from_body).as_euler("ZYX", degrees=True)
    return angles


def _header(points: MapPoints) -> str:
    """Return the first line; `WGS84 UTM` where it applies, since no reader mistakes its axes."""
    code = points.horizontal_epsg
    if code is None:
        if "+proj" in points.crs:
            return points.crs
        raise KgcpError(
            f"{_LIST}: crs {points.crs!r} has no EPSG code, which ODM needs;"
            " give crs in flight.toml as 'EPSG:code' or a PROJ string, or leave out the format odm"
        )
    utm = _WGS84_UTM.fullmatch(str(code))
    if utm is None:
        return f"EPSG:{code}"
    return f"WGS84 UTM {int(utm[2])}{'N' if utm[1] == '6' else 'S'}"


def _metres_per_height_unit(crs: CRS) -> float:
    """ODM takes z as metres, whatever unit the CRS has."""
    return float(crs.axis_info[2].unit_conversion_factor) if len(crs.axis_info) > 2 else 1.0
