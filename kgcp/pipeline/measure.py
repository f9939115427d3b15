"""Measurement of one frame in memory: the entry point for programs with their own images."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.measurement.frame import examine
from kgcp.measurement.records import Outcome
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.settings import DetectSettings, require_kind
from kgcp.targets.layout import Target
from kgcp.targets.validation import check_targets


@single_threaded()
def measure_frame(
    grey: GreyArray,
    camera: Camera,
    targets: Iterable[Target],
    settings: DetectSettings = DetectSettings(),  # noqa: B008 - frozen
) -> list[Outcome]:
    """Find and measure the targets in one frame.

    Parameters
    ----------
    grey : (height, width) array of uint8 or uint16
        The raw frame: not undistorted, not rotated, of the camera's size. Pixel (0, 0) is the
        centre of the top-left pixel.
    targets : iterable of Target
        All that may be seen.

    Returns
    -------
    list of Measurement or Miss
        In the order of the targets: for each its measured plates, best score first, or one `Miss`
        with the reason.

    Raises
    ------
    KgcpError
        If the array is not one grey frame of the camera's size, or the targets cannot be told
        apart.
    """
    require_kind("camera", camera, Camera)
    require_kind("settings", settings, DetectSettings)
    _check_frame(grey, camera)
    if isinstance(targets, Target):
        raise KgcpError("targets: is a single Target; give a list of them")
    wanted = tuple(targets)
    if not wanted:
        raise KgcpError("targets: is empty; name at least one target to look for")
    for target in wanted:
        if not isinstance(target, Target):
            raise KgcpError(f"targets: has a {type(target).__name__}; give kgcp.Target(ring)")
    check_targets(wanted)
    return list(examine(np.ascontiguousarray(grey), camera, wanted, settings).outcomes)


def _check_frame(grey: GreyArray, camera: Camera) -> None:
    if not isinstance(grey, np.ndarray):
        raise KgcpError(f"the frame is a {type(grey).__name__}; give a numpy array of grey values")
    if grey.ndim != 2:
        raise KgcpError(
            f"the frame has the shape {grey.shape}, not (height, width); convert it to grey values,"
            " for example by cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)"
        )
    if grey.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise KgcpError(
            f"the frame has the type {grey.dtype}; give the camera's own uint8 or uint16 values"
        )
    if grey.shape != (camera.height, camera.width):
        height, width = grey.shape
        raise KgcpError(
            f"the frame is {width} x {height} px, but the camera {camera.width} x {camera.height};"
            " give the whole raw frame, or the calibration for this size"
        )
