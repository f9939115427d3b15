"""Another calibration of the same camera, to compare with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera
from kgcp.io.flight.camera_table import read_camera_file
from kgcp.io.formats.calibrations import ErrorWords, read_calibration
from kgcp.io.images.exif import read_frame_header
from kgcp.pipeline.calibration.photographs import Photo

_WORDS = ErrorWords(
    named_by="the other calibration",
    other_size="but the photographs have",
    no_size="give a file that states it",
    several_cameras="give a file of one camera",
    other_format="convert it or write the values to a camera.toml",
)


@dataclass(frozen=True, slots=True)
class OtherCalibration:
    """A camera and the name of its file."""

    name: str
    camera: Camera


def read_other(path: Path, photos: Sequence[Photo]) -> OtherCalibration:
    """Read a camera.toml, or another program's calibration, of the camera that took photographs.

    Raises
    ------
    KgcpError
        Naming the file and the remedy, also if its frames have another size than most photographs.
    """
    headers = [read_frame_header(photo.path, photo.name).size_px for photo in photos]
    sizes = Counter(size for size in headers if size is not None)
    usual = max(sizes, key=lambda size: (sizes[size], size)) if sizes else (None, None)
    if path.suffix != ".toml":
        return OtherCalibration(path.name, read_calibration(path, usual, words=_WORDS))
    camera = read_camera_file(path).camera
    if sizes and usual != (camera.width, camera.height):
        raise KgcpError(
            f"{path}: is for frames of {camera.width} x {camera.height} px, but the photographs"
            f" have {usual[0]} x {usual[1]} px; give a calibration of the same frames",
            option="against",
        )
    return OtherCalibration(path.name, camera)
