"""The camera_info YAML of ROS: OpenCV's model and pixels under other keys."""

from __future__ import annotations

import re

import yaml

from kgcp.io.calibrations.entry import Entry, unsupported
from kgcp.io.calibrations.opencv import matrix_entry
from kgcp.io.foreign import ForeignFile

_MOST_CHARACTERS = 1 << 20
_MODELS = ("plumb_bob", "rational_polynomial")


class _Loader(yaml.SafeLoader):
    """Loads plain values, and no aliases: a few lines of them are millions of values."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)


def matches(file: ForeignFile) -> bool:
    """Whether the content has the keys of a camera_info."""
    keys = ("camera_matrix", "distortion_coefficients")
    return len(file.text) <= _MOST_CHARACTERS and all(
        re.search(rf"^{key}:", file.text, re.MULTILINE) for key in keys
    )


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the one camera of the file.

    Raises
    ------
    KgcpError
        If it is no camera_info, or of a model that `Camera` has not.
    """
    try:
        info = yaml.load(file.text, _Loader)  # noqa: S506 - it is a SafeLoader
        model = info.get("distortion_model", "plumb_bob")
        if model not in _MODELS:
            raise unsupported(file, "", f"the distortion model {model!r}")
        size = (int(info["image_width"]), int(info["image_height"]))
        flat = [float(value) for value in info["camera_matrix"]["data"]]
        coefficients = [float(value) for value in info["distortion_coefficients"]["data"]]
    except (
        *(yaml.YAMLError, AttributeError, LookupError, TypeError),
        *(ValueError, OverflowError, RecursionError),
    ) as error:
        what = " ".join(str(error).split())
        raise file.error("", f"is no camera_info of ROS ({what})", "write it again") from error
    return (
        matrix_entry(
            file,
            str(info.get("camera_name", "")),
            size,
            [flat[0:3], flat[3:6], flat[6:]],
            coefficients,
        ),
    )
