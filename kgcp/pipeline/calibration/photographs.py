"""Tasks for one photograph of a field: read, search and measure; measure missing discs later."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError, Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.io.images.exif import read_frame_header
from kgcp.io.images.frames import read_grey
from kgcp.measurement.discs.camera_tone import CameraTone
from kgcp.measurement.field_photograph import (
    PhotoDiscs,
    PhotoMiss,
    PhotoTask,
    learn_from_fields,
    measure_field,
    measure_more,
)
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.quality.checks.frame_header import FrameHeader

_LARGEST_PX = 100_000


@dataclass(frozen=True, slots=True)
class Photo:
    """A photograph and its name in all tables."""

    name: str
    path: Path


@dataclass(frozen=True, slots=True, eq=False)
class SecondLook:
    """A photograph in which missing discs are searched for at predicted places."""

    photo: Photo
    first: PhotoDiscs  # of the first pass
    predicted: FloatArray  # (k, 5): predicted centroids and moments of the missing discs
    point: FloatArray  # (k,): their indices in the field


@single_threaded()
def learn_from_photos(task: PhotoTask, count: int, photos: tuple[Photo, ...]) -> CameraTone | None:
    """Learn the camera's tone curve and processing from the first `count` readable photographs."""
    return learn_from_fields(islice(_readable(photos), count), task)


def _readable(photos: Iterable[Photo]) -> Iterator[GreyArray]:
    for photo in photos:
        with suppress(Rejection):
            yield _read(photo)[0]


@single_threaded()
def measure_photo(task: PhotoTask, photo: Photo) -> PhotoDiscs | PhotoMiss:
    """Find, identify and measure the discs; errors of the photograph become its result."""
    try:
        grey, header = _read(photo)
    except Rejection as rejection:
        return PhotoMiss(photo.name, 0, 0, rejection.reason.value, rejection.detail)
    return measure_field(grey, task, photo.name, header.exif_camera)


@single_threaded()
def measure_photo_again(task: PhotoTask, look: SecondLook) -> PhotoDiscs | PhotoMiss:
    """Measure the discs of a photograph that the first pass did not find."""
    try:
        grey, _ = _read(look.photo)
    except Rejection as rejection:
        raise KgcpError(
            f"{look.photo.path}: was readable before, but is not any more ({rejection.detail});"
            " restore it and repeat the command, which resumes"
        ) from rejection
    return measure_more(grey, task, look.first, look.predicted, look.point.astype(np.intp))


def _read(photo: Photo) -> tuple[GreyArray, FrameHeader]:
    """Return grey values and header of a photograph of any size."""
    header = read_frame_header(photo.path, photo.name)
    size = header.size_px
    if size is None:
        raise Rejection(Reason.DECODE_FAILED, "does not begin like an image")
    width, height = size
    if not 2 <= min(size) <= max(size) <= _LARGEST_PX:
        raise Rejection(Reason.DECODE_FAILED, f"{width} x {height} px")
    focal = float(max(size))  # arbitrary: the reader compares only sizes
    camera = Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)
    return read_grey(photo.path, camera), header
