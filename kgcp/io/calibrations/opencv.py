"""OpenCV's FileStorage: YAML, XML or JSON with a camera matrix and distortion coefficients.

Pixels count from the centre of the top-left one, and the coefficients are those of `Camera`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy.typing as npt

from kgcp.geometry.camera import Camera
from kgcp.io.calibrations.entry import Entry, refuse_terms, unsupported
from kgcp.io.foreign import ForeignFile

# How OpenCV's own samples and users' scripts name the values, in small letters without "_".
_MATRIX_KEYS = ("cameramatrix", "intrinsicmatrix", "k", "m1", "mtx")
_DISTORTION_KEYS = (
    "distortioncoefficients",
    "distortioncoeffs",
    "distcoeffs",
    "distcoeff",
    "distortion",
    "dist",
    "d",
    "d1",
)
_WIDTH_KEYS = ("imagewidth", "width")
_HEIGHT_KEYS = ("imageheight", "height")

# Numbers of coefficients that OpenCV writes for its models; beyond 8 they must be zero.
_COUNTS = (0, 4, 5, 8, 12, 14)
_REST = ("thin-prism s1", "thin-prism s2", "thin-prism s3", "thin-prism s4", "tilt x", "tilt y")


def matches(file: ForeignFile) -> bool:
    """Whether the content is a FileStorage."""
    return file.text.lstrip().startswith(("%YAML", "<?xml", "<opencv_storage", "{"))


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the one camera of the file.

    Raises
    ------
    KgcpError
        If OpenCV cannot read it, or it has no camera matrix.
    """
    try:
        storage = cv2.FileStorage(file.text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        keys = storage.root().keys()
        nodes = {key.lower().replace("_", ""): key for key in keys}
        is_fisheye = "fisheyemodel" in nodes and storage.getNode(nodes["fisheyemodel"]).real()
        matrix = _matrix(storage, nodes, _MATRIX_KEYS)
        coefficients = _matrix(storage, nodes, _DISTORTION_KEYS)
        width = _number(storage, nodes, _WIDTH_KEYS)
        height = _number(storage, nodes, _HEIGHT_KEYS)
    except (cv2.error, SystemError) as error:  # SystemError: what the bindings make of bad syntax
        raise file.error("", "is no OpenCV FileStorage", "write it again with OpenCV") from error
    if is_fisheye:
        raise unsupported(file, "", "a fisheye model")
    if matrix is None:
        raise file.error("", "has no camera_matrix", "add it or write the values to [camera]")
    size = (int(width), int(height)) if width and height else None
    flat = [] if coefficients is None else coefficients.ravel().tolist()
    return (matrix_entry(file, "", size, matrix.tolist(), flat),)


def matrix_entry(
    file: ForeignFile,
    name: str,
    size: tuple[int, int] | None,
    matrix: Sequence[Sequence[float]],
    coefficients: Sequence[float],
) -> Entry:
    """Return the camera of OpenCV's camera matrix (3, 3) and coefficients k1 k2 p1 p2 k3 ….

    Raises
    ------
    KgcpError
        If it is no pinhole camera with Brown-Conrady distortion.
    """
    _check_model(file, matrix, coefficients)
    padding = [0.0] * (8 - len(coefficients))
    k1, k2, p1, p2, k3, k4, k5, k6 = [*coefficients[:8], *padding]
    (fx, _, cx), (_, fy, cy), _ = matrix

    def convert(width: int, height: int) -> Camera:
        """Return it for frames of this size [px]."""
        return Camera(width, height, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6)

    return Entry(name, size, convert)


def _matrix(
    storage: cv2.FileStorage, nodes: Mapping[str, str], names: Sequence[str]
) -> npt.NDArray[Any] | None:
    key = next((nodes[name] for name in names if name in nodes), None)
    return None if key is None else storage.getNode(key).mat()


def _number(
    storage: cv2.FileStorage, nodes: Mapping[str, str], names: Sequence[str]
) -> float | None:
    key = next((nodes[name] for name in names if name in nodes), None)
    return None if key is None else storage.getNode(key).real()


def _check_model(
    file: ForeignFile, matrix: Sequence[Sequence[float]], coefficients: Sequence[float]
) -> None:
    if [len(row) for row in matrix] != [3, 3, 3]:
        raise file.error("", "the camera matrix is not 3 x 3", "calibrate again")
    (_, skew, _), (zero, *_), last = matrix
    if [zero, *last] != [0.0, 0.0, 0.0, 1.0]:
        raise file.error("", "the camera matrix is none of a pinhole camera", "calibrate again")
    if skew:
        raise unsupported(file, "", f"a skew of {skew:g}")
    if len(coefficients) not in _COUNTS:
        raise unsupported(file, "", f"{len(coefficients)} distortion coefficients")
    rest = coefficients[8:]
    refuse_terms(file, "", _REST[: len(rest)], rest)
