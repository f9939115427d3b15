"""Exterior orientations of the camera with their covariance, as CSV."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from kgcp.errors import KgcpError
from kgcp.georef.camera_priors import opk_covs, opk_deg
from kgcp.io.exporters.points import MapPoints, covariance_cells, decimals
from kgcp.io.files.csv_text import DEGREE_DECIMALS, csv_text

_PARAMETERS = ("x", "y", "z", "omega_deg", "phi_deg", "kappa_deg")
COLUMNS = (
    "frame",
    *_PARAMETERS,
    *(f"sd_{name}" for name in _PARAMETERS),
    *(f"cov_{first}_{second}" for first, second in combinations(_PARAMETERS, 2)),
    "crs",
)
"""sd_x, sd_y, sd_z in metres along the map's axes, angles in degrees, covariances in their
products."""

_HOWTO = """\
Camera orientations

camera_priors.csv: for every image in which the plate on the vehicle was measured and its two
possible poses can be told apart, the position of the projection centre in {crs}
(x is easting or longitude; z {heights}) and omega, phi, kappa in
degrees against the map's axes: R(camera > map) = Rx(omega) Ry(phi) Rz(kappa), camera axes x right,
y up, z backward. sd_ and cov_ are the covariance of all six, metres and degrees; empty where the
trajectory or the measurement has no standard deviations.

They are priors, for packages that take no points or to start an adjustment with. They come from
the vehicle's attitude and how the plate lies in the image, and an error of 0.5 degrees moves the
camera by 0.7 m at 80 m. Do not use them together with the points and distances as if they were
independent. Errors that all images share are in every single covariance.
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return `camera_priors.csv`.

    Raises
    ------
    KgcpError
        If there is no prior.
    """
    if not points.priors:
        raise KgcpError(
            "camera-priors: no camera can be oriented. This needs poses of a plate on a vehicle"
            " with a trajectory, and [vehicle] level_sd_deg with [camera] plumb_sd_deg or reference"
            " poses to choose between the two poses of a circle; give these, or leave this format"
            " out"
        )
    rows = []
    every = zip(points.priors, opk_deg(points.priors), opk_covs(points.priors), strict=True)
    for prior, opk, cov in every:
        angles = (decimals(angle, DEGREE_DECIMALS) for angle in opk)
        xyz = points.xyz(prior.position_map)
        rows.append((prior.frame, *xyz, *angles, *covariance_cells(cov, 6, 9), points.crs))
    return {
        "camera_priors/camera_priors.csv": csv_text(COLUMNS, rows),
        "camera_priors/HOWTO.txt": _HOWTO.format(crs=points.crs, heights=points.heights),
    }
