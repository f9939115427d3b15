"""What JPEG leaves of a frame."""

from __future__ import annotations

import cv2
import numpy as np

from kgcp.geometry.arrays import GreyArray


def compressed(grey: GreyArray, quality: int) -> GreyArray:
    """Return the grey values after compression."""
    _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
