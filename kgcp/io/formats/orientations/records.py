"""Input of a reader of poses from flight.toml, and its result: poses in the file's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.files.sniff import ForeignFile

_MAX_DISTORTION = 1e-3


@dataclass(frozen=True, slots=True)
class OrientationFileOptions:
    """The keys of [reference] about its file."""

    form: str | None = None  # name of the format; None: the content tells
    # of the file's coordinates, for pyproj, if the file does not give it; None: the flight's, or
    # the format's default
    crs: str | None = None
    # holds what was subtracted from the file's coordinates; None: nothing was
    offset_file: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SourcePoses:
    """Exterior orientations of n frames."""

    names: tuple[str, ...]  # of the frames, as the other program calls them
    position: FloatArray  # (n, 3): projection centres
    # (n, 3, 3): rotations from the axes of photogrammetry (x right, y up, z backward) to those of
    # the file's frame: of a map its x, y and z at the projection centre
    frame_from_photo: FloatArray
    crs: str | None = None  # of the positions, x first; None: the file does not say it
    # if the file's frame is east, north, up in metres at a point that it names
    level: LocalFrame | None = None
    # why the coordinates are in no map unless flight.toml names one; None: they are in the flight's
    unreferenced: str | None = None
    # (n, 3): standard deviations along the map's axes [m]; None: not given
    sd_position_m: FloatArray | None = None
    # (n,): of each of the three angles [deg]; None: not given
    sd_angle_deg: FloatArray | None = None
    # (n, 6, 6): of position [m] and left rotation vector [rad], the map's axes; None: not given
    cov: FloatArray | None = None
    # whether the names are already those of the flight's frames, not of another program
    has_our_names: bool = False


def photo_rotations(
    file: ForeignFile, places: Sequence[str], frame_from_camera: FloatArray
) -> FloatArray:
    """Return the rotations (n, 3, 3) frame ← photo of n frame ← camera (y down, z forward).

    Raises
    ------
    KgcpError
        Naming the place of a matrix that is not a rotation.
    """
    for place, matrix in zip(places, frame_from_camera, strict=True):
        require_rotation(file, place, matrix)
    return np.asarray(frame_from_camera @ CAMERA_FROM_PHOTO)


def require_rotation(file: ForeignFile, where: str, matrix: FloatArray) -> None:
    """Raise `KgcpError` if a matrix (3, 3) is not a rotation."""
    departure = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not departure < _MAX_DISTORTION or np.linalg.det(matrix) < 0.0:
        raise file.error_at(where, "has a matrix that is not a rotation")


def from_geocentric(
    names: tuple[str, ...], ecef_m: FloatArray, ecef_from_photo: FloatArray, geodetic: str
) -> SourcePoses:
    """Transform Earth-centred poses to longitude, latitude and height, and to their local axes.

    Parameters
    ----------
    ecef_m : (n, 3) array
        Projection centres [m].
    geodetic : str
        Three-dimensional geographic CRS of the same datum.
    """
    earth = LocalFrame.at(geodetic, np.zeros(3))
    enu = (ecef_m - earth.origin_ecef_m) @ earth.ecef_from_enu
    return from_level(names, enu, earth.ecef_from_enu.T @ ecef_from_photo, earth)


def from_level(
    names: tuple[str, ...], enu_m: FloatArray, enu_from_photo: FloatArray, local_frame: LocalFrame
) -> SourcePoses:
    """Transform poses in the ENU axes of one point to a geographic CRS and their own local axes.

    Parameters
    ----------
    enu_m : (n, 3) array
        Projection centres in the ENU frame [m].
    local_frame : LocalFrame
        Of a geographic CRS.
    """
    here_from_enu = np.swapaxes(local_frame.level_rotations(enu_m), 1, 2)
    position = local_frame.map_from_enu(enu_m)
    return SourcePoses(names, position, here_from_enu @ enu_from_photo, crs=local_frame.crs)
