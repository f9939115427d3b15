"""Close-ups of targets: a piece of the frame as JPEG, with the circles of the measured pose."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.georef.sighting import Sighting
from kgcp.measurement.image_model.window import contour_px
from kgcp.targets.layout import Target

WORST, SPREAD = 12, 24
"""How many close-ups a report has: of the largest deviations, and evenly over the distances."""

_REACH = 1.7  # of the outer radius, to each side
_SIDE_PX = 320
_SMALLEST_REACH_PX = 12.0
_JPEG_QUALITY = 82


@dataclass(frozen=True, slots=True, eq=False)
class Closeup:
    """One close-up.

    Attributes
    ----------
    row : int
        Of the measurement, by its place in time.
    width, height : int
        Of the picture [px].
    jpeg : str
        The picture, base64.
    circles : tuple of (n, 2) array
        Fitted circles in the picture [px], its left and top border at 0.
    """

    row: int
    width: int
    height: int
    jpeg: str
    circles: tuple[FloatArray, ...]


def evenly(distance_m: FloatArray, count: int) -> list[int]:
    """Return up to `count` of the rows (n,), evenly over the ranks of the distance, near to far."""
    ranked = np.argsort(distance_m, kind="stable")
    places = np.unique(np.linspace(0, len(ranked) - 1, min(count, len(ranked))).round())
    chosen: list[int] = ranked[places.astype(int)].tolist()
    return chosen


def largest(deviation: FloatArray) -> list[int]:
    """Return the rows (n,) of the largest deviations, the largest first."""
    chosen: list[int] = np.argsort(-np.abs(deviation), kind="stable")[:WORST].tolist()
    return chosen


def closeup(
    grey: GreyArray, camera: Camera, target: Target, seen: Sighting, row: int
) -> Closeup | None:
    """Cut out a target, stretched to its own levels; None where the measurement has no pose."""
    if seen.pose is None:
        return None
    ring = target.ring
    diameters = (ring.outer_diameter_m, ring.inner_diameter_m)
    circles = [contour_px(camera, seen.pose, 0.5 * diameter) for diameter in diameters]
    circles.append(camera.project(seen.pose.transform(np.zeros((1, 3)))))
    reach = max(_SMALLEST_REACH_PX, _REACH * float(np.ptp(circles[0], axis=0).max()) / 2.0)
    low = np.maximum(np.floor(seen.centre_px - reach), 0).astype(int)
    high = np.minimum(np.ceil(seen.centre_px + reach) + 1, grey.shape[::-1]).astype(int)
    if not np.all(high - low >= 2):
        return None
    cut = grey[low[1] : high[1], low[0] : high[0]]
    scale = _SIDE_PX / float(max(cut.shape))
    size = tuple(max(1, round(scale * side)) for side in cut.shape[::-1])
    way = cv2.INTER_NEAREST if scale > 1.0 else cv2.INTER_AREA
    stretched = cv2.normalize(cut, np.empty_like(cut), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    shown = cv2.resize(stretched, size, interpolation=way)
    content = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    factor = np.array(size) / cut.shape[::-1]
    return Closeup(
        row,
        size[0],
        size[1],
        base64.b64encode(content.tobytes()).decode("ascii"),
        tuple((circle - low + 0.5) * factor for circle in circles),
    )
