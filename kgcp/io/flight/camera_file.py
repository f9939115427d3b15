"""camera.toml: a camera with the full covariance of its calibration."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, CalibrationCovariance
from kgcp.geometry.camera import Camera


def camera_toml(camera: Camera, covariance: CalibrationCovariance | None) -> str:
    """Return the text of a camera.toml, whose numbers are read back to the last bit.

    Without a covariance it says nothing about how well the camera is known.
    """
    lines = [
        "# Written by kgcp. In flight.toml:",
        "#",
        "#     [camera]",
        '#     file = "camera.toml"',
        '#     format = "kgcp"',
        "",
        "[camera]",
        f"width = {camera.width}",
        f"height = {camera.height}",
    ]
    for name in CALIBRATION_PARAMETERS:
        value = float(getattr(camera, name))
        if name in CALIBRATION_PARAMETERS[:4] or value != 0.0:
            lines.append(f"{name} = {value!r}")
    lines.append(f'response = "{camera.response.value}"')
    if covariance is None:
        return "\n".join(lines) + "\n"
    estimated = np.flatnonzero(covariance.cov.any(axis=1)).tolist()
    names = ", ".join(f'"{CALIBRATION_PARAMETERS[index]}"' for index in estimated)
    lines += [f"cov_of = [{names}]", "cov = ["]
    for row in covariance.cov[np.ix_(estimated, estimated)].tolist():
        lines.append(f"    {', '.join(map(repr, row))},")
    lines.append("]")
    return "\n".join(lines) + "\n"
