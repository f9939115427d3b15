"""Frames: their names and their grey values. The EXIF orientation is never applied."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any

import cv2
import numpy as np
import simplejpeg

from kgcp.errors import KgcpError, KgcpWarning, Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.io.files.portable import scratch_file
from kgcp.io.files.safe_read import is_file, is_folder
from kgcp.io.images.exif import read_exif
from kgcp.io.images.header import (
    JPEG_END,
    JPEG_START,
    image_size,
    is_cut_png,
    misread_pixels,
    with_stored_pixels,
)

__all__ = ["list_frames", "read_exif", "read_grey"]

FRAME_SUFFIXES = frozenset(
    {".bmp", ".jp2", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"}
)

FLIGHT_TOML = "flight.toml"

RESULTS_NAME = "kgcp"
"""Name of the results folder in the flight's folder."""

_RAW_SUFFIXES = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".dng", ".erf", ".fff", ".iiq", ".mef", ".nef", ".nrw"}
    | {".orf", ".pef", ".raf", ".raw", ".rw2", ".srw", ".x3f"}
)
_VIDEO_SUFFIXES = frozenset({".avi", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mts", ".webm"})
_PHONE_SUFFIXES = frozenset({".avif", ".heic", ".heif"})

# Pixels as they are stored: raw orientation, full depth, one channel.
_RAW_GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

_UNDECODED = re.compile("[\\udc80-\\udcff]")  # stand for bytes that are not UTF-8

# Limits of a file's size. Text takes most space, ten characters for a colour of 16 bits. Metadata
# are added.
_MAX_BYTES_PER_PIXEL = 32
_MAX_METADATA_BYTES = 1 << 26

CORRECT_FOLDER = "correct [frames] folder in flight.toml"

# Messages of libjpeg that do not concern pixels. All others are errors, or about data that it had
# to guess.
_UNUSUAL_IN_JPEG = (
    "Invalid SOS parameters for sequential JPEG",
    "Unknown Adobe color transform code",
    "Warning: unknown JFIF revision number",
)
# Messages on stderr about data that decoders had to guess; they do not stop decoding. Those of
# libjpeg may come through libtiff, whose own errors OpenCV prints after "TIFF_Error". OpenCV for
# Windows is linked with a C library of its own, whose stderr does not follow Python's: there,
# damage to a compressed TIFF goes unnoticed.
_GUESSED_PIXELS = re.compile(
    r"(Corrupt JPEG data|Premature end of JPEG file|PackBitsDecode|(?<=TIFF_Error )).*"
)
_LOGGING: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 4 has its functions elsewhere
_WARNINGS = 3  # the level that OpenCV 5 calls LOG_LEVEL_WARNING
_STDERR_LOCK = Lock()  # a process has only one stderr


def list_frames(folder: Path, remedy: str = CORRECT_FOLDER) -> list[str]:
    """List the images below a folder, as sorted relative paths with `/`.

    Hidden files and folders are skipped. Images are recognised by their suffix, in upper or lower
    case. Links to files are followed; links to folders below `folder` are not, as they may be
    circular. If the frames are in the flight's own folder, its results folder is skipped. So are
    folders of other flights. `remedy` says what to do if this is not the right folder.

    Raises
    ------
    KgcpError
        If the folder is missing or unreadable, holds no image, or a name is not UTF-8.
    """
    if not is_folder(folder):
        raise KgcpError(f"{folder}: is not a folder; {remedy}")
    names = []
    for parent, folders, files in os.walk(folder, onerror=_refuse_folder):
        folders[:] = [name for name in folders if name[0] != "."]
        names += [(Path(parent) / name).relative_to(folder).as_posix() for name in files]
    frames = frames_among(names, str(folder), remedy)
    for name in frames:
        if _UNDECODED.search(name):
            raise KgcpError(f"{folder}: the name {name!r} is not UTF-8; rename the file")
    return frames


def frames_among(names: Sequence[str], folder: str, remedy: str = CORRECT_FOLDER) -> list[str]:
    """Return the images among the files of a folder: their paths below it, sorted.

    Raises
    ------
    KgcpError
        If there are none. The message says what the folder holds instead.
    """
    visible = [name for name in names if not any(part[0] == "." for part in name.split("/"))]
    if FLIGHT_TOML in visible:
        visible = [name for name in visible if not name.startswith(f"{RESULTS_NAME}/")]
    visible = _without_other_flights(visible, folder)
    frames = [name for name in visible if PurePosixPath(name).suffix.lower() in FRAME_SUFFIXES]
    if frames:
        _warn_of_left_out(visible, frames, folder)
        return sorted(frames)
    counts = Counter(PurePosixPath(name).suffix.lower() for name in visible)
    counts.pop("", None)
    if not counts:
        raise KgcpError(f"{folder}: holds no images; put them there or {remedy}")
    suffix, count = counts.most_common(1)[0]
    kind, conversion = kind_of(suffix)
    if kind == "files":
        conversion += f", or {remedy}"
    raise KgcpError(
        f"{folder}: holds no images that kgcp reads, but {count} {suffix} {kind}; {conversion}"
    )


def _without_other_flights(names: Sequence[str], folder: str) -> list[str]:
    """Return the files that are not below another flight.toml, and warn of frames that are."""
    paths = [PurePosixPath(name) for name in names]
    others = {path.parent for path in paths if path.name == FLIGHT_TOML} - {PurePosixPath()}
    own, left_out = [], Counter[str]()
    for path in paths:
        flight = next((str(parent) for parent in path.parents if parent in others), None)
        if flight is None:
            own.append(str(path))
        elif path.suffix.lower() in FRAME_SUFFIXES:
            left_out[flight] += 1
    for flight, count in sorted(left_out.items()):
        warnings.warn(
            f"{folder}: leaves out {count} images in {flight}, which is another flight: it has a"
            f" {FLIGHT_TOML} of its own; delete that if they belong to this one",
            KgcpWarning,
            stacklevel=4,
        )
    return own


def _warn_of_left_out(names: Sequence[str], frames: Sequence[str], folder: str) -> None:
    """Warn of images of a phone or raw files that have no frame of the same name beside them."""
    read = {str(PurePosixPath(name).with_suffix("")) for name in frames}
    left_out = Counter(
        path.suffix.lower()
        for path in map(PurePosixPath, names)
        if path.suffix.lower() in _RAW_SUFFIXES | _PHONE_SUFFIXES
        and str(path.with_suffix("")) not in read
    )
    for suffix, count in sorted(left_out.items()):
        kind, conversion = kind_of(suffix)
        warnings.warn(
            f"{folder}: kgcp does not read {suffix} {kind} and leaves out {count}; {conversion}",
            KgcpWarning,
            stacklevel=3,
        )


def kind_of(suffix: str) -> tuple[str, str]:
    """Return the kind of files with a suffix that is no image's, and how to convert them."""
    if suffix in _RAW_SUFFIXES:
        return "raw files", (
            "develop them to JPEG, PNG or TIFF without lens correction, cropping or sharpening"
        )
    if suffix in _VIDEO_SUFFIXES:
        return "videos", (
            "extract the key frames with the time of each ('ffmpeg -skip_frame nokey -i FILE"
            " -fps_mode passthrough frames/%05d.png'), and give the times in frames.csv"
        )
    if suffix in _PHONE_SUFFIXES:
        return "files of a phone", "convert them to JPEG or PNG of the same size"
    return "files", "convert them to JPEG, PNG or TIFF"


def _refuse_folder(error: OSError) -> None:
    raise KgcpError(f"{error.filename}: {error.strerror}; make the folder readable") from error


def read_grey(path: Path, camera: Camera) -> GreyArray:
    """Decode a frame to grey values in its raw orientation.

    Parameters
    ----------
    path : Path
        An image of 8 or 16 bits, grey or colour (of which the luma is taken).

    Returns
    -------
    (height, width) array of uint8 or uint16

    Raises
    ------
    Rejection
        `decode_failed`: it is not an image, is damaged in whole or in part (even if the decoder
        would fill the gap), or has another depth. `wrong_size`: its size is not the camera's, which
        is checked before decoding.
    MemoryError
        If there is no memory for the pixels.
    """
    grey = _decode(_encoded(path, camera))
    if grey.dtype not in (np.uint8, np.uint16):
        raise Rejection(Reason.DECODE_FAILED, f"pixels are {grey.dtype}, not of 8 or 16 bits")
    height, width = grey.shape
    _require_size(width, height, camera)
    return grey


def _encoded(path: Path, camera: Camera) -> bytes:
    """Return the content of an image file if its header is that of a frame."""
    if os.path.lexists(path) and not is_file(path):  # opening a pipe would wait for ever
        raise Rejection(Reason.DECODE_FAILED, "is not a regular file")
    try:
        with path.open("rb") as stream:
            size_px, size = image_size(stream), os.fstat(stream.fileno()).st_size
            if size_px is None:
                raise Rejection(
                    Reason.DECODE_FAILED, f"{size} bytes that do not begin like an image"
                )
            _require_size(*size_px, camera)
            max_size = _MAX_BYTES_PER_PIXEL * camera.width * camera.height + _MAX_METADATA_BYTES
            if size > max_size:
                raise Rejection(Reason.DECODE_FAILED, f"{size} bytes are too many for its pixels")
            if pixels := misread_pixels(stream):
                raise Rejection(
                    Reason.DECODE_FAILED, f"a TIFF of {pixels}; save it as grey or RGB, or as PNG"
                )
            data = with_stored_pixels(stream)
    except OSError as error:  # no path: tables must not depend on the folder
        raise Rejection(Reason.DECODE_FAILED, error.strerror or str(error)) from error
    except ValueError as error:  # names that no file can have
        raise Rejection(Reason.DECODE_FAILED, str(error)) from error
    if is_cut_png(data):
        raise Rejection(Reason.DECODE_FAILED, f"a chunk ends beyond the {size} bytes of the file")
    return data


def _require_size(width: int, height: int, camera: Camera) -> None:
    if (width, height) != (camera.width, camera.height):
        raise Rejection(
            Reason.WRONG_SIZE,
            f"{width} x {height} px, the camera has {camera.width} x {camera.height}",
        )


def _decode(encoded: bytes) -> GreyArray:
    grey = _decode_jpeg(encoded) if encoded.startswith(JPEG_START) else None
    if grey is not None:
        return grey
    with _collected_stderr() as messages:
        try:
            grey = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), _RAW_GREY)
        except cv2.error as error:
            if error.code == cv2.Error.StsNoMem:  # for the pixels; the file may be sound
                raise MemoryError(error.err) from error
    if grey is None:
        raise Rejection(Reason.DECODE_FAILED, f"{len(encoded)} bytes that are not a complete image")
    for message in messages:
        if guess := _GUESSED_PIXELS.search(message):
            raise Rejection(Reason.DECODE_FAILED, guess[0])
    return grey


def _decode_jpeg(encoded: bytes) -> GreyArray | None:
    """Decode a JPEG to its luma; return None if it is unusual, but may be whole.

    Raises
    ------
    Rejection
        `DECODE_FAILED` if the decoder would have to guess pixels, or cannot go on.
    """
    try:
        # An end that alone is missing changes no pixels.
        return np.asarray(simplejpeg.decode_jpeg(encoded + JPEG_END, "GRAY")[..., 0])
    except ValueError as error:
        if str(error).startswith(_UNUSUAL_IN_JPEG):
            return None
        raise Rejection(Reason.DECODE_FAILED, str(error)) from error


@contextmanager
def _collected_stderr() -> Iterator[list[str]]:
    """Collect what libraries write to the process's stderr, as lines, until the block ends.

    The image decoders that OpenCV calls report damage in no other way. The whole process is
    affected, so the block must be short. Threads enter it one after the other; otherwise one would
    restore the other's file as stderr.
    """
    messages: list[str] = []
    with _STDERR_LOCK, scratch_file() as sink:
        if sys.stderr is not None:
            sys.stderr.flush()
        try:
            stderr = os.dup(2)
        except OSError:  # graphical programs have none on Windows
            yield messages
            return
        os.dup2(sink.fileno(), 2)
        log_level = _LOGGING.getLogLevel()  # may be set to silent by the environment
        _LOGGING.setLogLevel(_WARNINGS)
        try:
            yield messages
        finally:
            _LOGGING.setLogLevel(log_level)
            os.dup2(stderr, 2)
            os.close(stderr)
            sink.seek(0)
            messages += sink.read().decode(errors="replace").splitlines()
