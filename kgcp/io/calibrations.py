"""Camera calibrations as other programs write them: OpenCV FileStorage and ROS camera_info."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy.typing as npt
import yaml

from kgcp.errors import KgcpError, SettingError
from kgcp.geometry.camera import Camera

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
_OPENCV_COUNTS = (0, 4, 5, 8, 12, 14)
_ROS_MODELS = ("plumb_bob", "rational_polynomial")


# What a file says: width and height [px] (None: nothing), camera matrix, distortion coefficients.
Content = tuple[tuple[int, int] | None, list[list[float]], list[float]]


def read_calibration(path: Path, stated_size: tuple[int | None, int | None]) -> Camera:
    """Read a calibration file; its content says which format it has.

    Parameters
    ----------
    path : Path
        OpenCV FileStorage (YAML, XML or JSON) with `camera_matrix` and `distortion_coefficients`
        (or what else OpenCV's samples call them), or the camera_info YAML of ROS with
        `plumb_bob` or `rational_polynomial`. Both count pixels from the centre of the top-left
        one and have the same coefficients.
    stated_size : tuple of int or None
        Width and height [px] that flight.toml gives beside the file: needed where the file is
        silent, else they must agree.

    Raises
    ------
    KgcpError
        If the file is missing, is neither, lacks the size, or holds a model that `Camera` cannot
        represent exactly: fisheye, skew, thin-prism or tilt terms.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise KgcpError(f"{path}: {error.strerror}; correct [camera] file") from error
    except UnicodeDecodeError as error:
        raise _unknown_format(path) from error
    is_opencv = text.lstrip().startswith(("%YAML", "<?xml", "<opencv_storage", "{"))
    size, matrix, coefficients = (_read_opencv if is_opencv else _read_ros)(path, text)
    width, height = _agreed_size(path, size, stated_size)
    _check_model(path, matrix, coefficients)
    padding = [0.0] * (8 - len(coefficients))
    k1, k2, p1, p2, k3, k4, k5, k6 = [*coefficients[:8], *padding]
    (fx, _, cx), (_, fy, cy), _ = matrix
    try:
        return Camera(width, height, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6)
    except SettingError as error:
        raise KgcpError(f"{path}: {error}") from None


def _read_opencv(path: Path, text: str) -> Content:
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        keys = storage.root().keys()
        nodes = {key.lower().replace("_", ""): key for key in keys}
        if "fisheyemodel" in nodes and storage.getNode(nodes["fisheyemodel"]).real():
            raise _wrong_model(path, "a fisheye model")
        matrix = _opencv_matrix(storage, nodes, _MATRIX_KEYS)
        if matrix is None:
            raise KgcpError(f"{path}: has no camera_matrix; add it or write the values to [camera]")
        coefficients = _opencv_matrix(storage, nodes, _DISTORTION_KEYS)
        width = _opencv_number(storage, nodes, _WIDTH_KEYS)
        height = _opencv_number(storage, nodes, _HEIGHT_KEYS)
    except (cv2.error, SystemError) as error:  # SystemError: what the bindings make of bad syntax
        raise _unknown_format(path) from error
    size = (int(width), int(height)) if width and height else None
    return size, matrix.tolist(), [] if coefficients is None else coefficients.ravel().tolist()


def _opencv_matrix(
    storage: cv2.FileStorage, nodes: Mapping[str, str], names: Sequence[str]
) -> npt.NDArray[Any] | None:
    key = next((nodes[name] for name in names if name in nodes), None)
    return None if key is None else storage.getNode(key).mat()


def _opencv_number(
    storage: cv2.FileStorage, nodes: Mapping[str, str], names: Sequence[str]
) -> float | None:
    key = next((nodes[name] for name in names if name in nodes), None)
    return None if key is None else storage.getNode(key).real()


def _read_ros(path: Path, text: str) -> Content:
    try:
        info = yaml.safe_load(text)
        model = info.get("distortion_model", "plumb_bob")
        if model not in _ROS_MODELS:
            raise _wrong_model(path, f"the distortion model {model!r}")
        size = (int(info["image_width"]), int(info["image_height"]))
        flat = [float(value) for value in info["camera_matrix"]["data"]]
        coefficients = [float(value) for value in info["distortion_coefficients"]["data"]]
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise _unknown_format(path) from error
    return size, [flat[0:3], flat[3:6], flat[6:]], coefficients


def _agreed_size(
    path: Path, found: tuple[int, int] | None, stated: tuple[int | None, int | None]
) -> tuple[int, int]:
    width, height = stated
    if found is None:
        if width is None or height is None:
            raise KgcpError(f"{path}: has no image size; add width and height to [camera]")
        return width, height
    if (width or found[0], height or found[1]) != found:
        raise KgcpError(
            f"{path}: is for {found[0]} x {found[1]} px, but [camera] says"
            f" {width or found[0]} x {height or found[1]}; use the calibration of this frame size"
        )
    return found


def _check_model(
    path: Path, matrix: Sequence[Sequence[float]], coefficients: Sequence[float]
) -> None:
    """Refuse what is not Brown-Conrady, the model that both formats share with `Camera`."""
    if [len(row) for row in matrix] != [3, 3, 3]:
        raise KgcpError(f"{path}: the camera matrix is not 3 x 3; calibrate again")
    (_, skew, _), (zero, *_), last = matrix
    if [zero, *last] != [0.0, 0.0, 0.0, 1.0]:
        raise KgcpError(f"{path}: the camera matrix is none of a pinhole camera; calibrate again")
    if skew:
        raise _wrong_model(path, f"a skew of {skew:g}")
    if len(coefficients) not in _OPENCV_COUNTS:
        raise _wrong_model(path, f"{len(coefficients)} distortion coefficients")
    if any(coefficients[8:]):
        raise _wrong_model(path, "thin-prism or tilt terms")


def _unknown_format(path: Path) -> KgcpError:
    return KgcpError(
        f"{path}: is no calibration by OpenCV FileStorage or ROS camera_info;"
        " convert it or write the values to [camera]"
    )


def _wrong_model(path: Path, found: str) -> KgcpError:
    return KgcpError(
        f"{path}: has {found}, which kgcp has not;"
        " calibrate with OpenCV's k1 k2 p1 p2 k3 or rational model"
    )
