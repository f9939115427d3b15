"""The camera_info YAML of ROS: OpenCV's model and pixels under other keys."""

from __future__ import annotations

import re
import reprlib

import numpy as np

from kgcp.io.files.safe_yaml import load_yaml
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import Entry, unsupported
from kgcp.io.formats.calibrations.opencv import opencv_entry

_MODELS = ("plumb_bob", "rational_polynomial")


def matches(file: ForeignFile) -> bool:
    """Whether the content has the keys of a camera_info."""
    keys = ("camera_matrix", "distortion_coefficients")
    return all(re.search(rf"^{key}:", file.text, re.MULTILINE) for key in keys)


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the one camera of the file."""
    try:
        info = load_yaml(file.text)
        if not isinstance(info, dict):
            raise TypeError("not a mapping")
        model, name = info.get("distortion_model", "plumb_bob"), info.get("camera_name", "")
        size = (int(info["image_width"]), int(info["image_height"]))
        matrix = np.reshape([float(value) for value in info["camera_matrix"]["data"]], (3, 3))
        coefficients = [float(value) for value in info["distortion_coefficients"]["data"]]
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise file.error(f"is not a camera_info of ROS ({error})", "write it again") from error
    if model not in _MODELS:
        raise unsupported(file, f"the distortion model {reprlib.repr(model)}")
    return (opencv_entry(name if isinstance(name, str) else "", size, matrix, coefficients),)
