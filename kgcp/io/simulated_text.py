"""The texts of a simulated flight folder: flight.toml and README.md."""

from __future__ import annotations

import json
from collections.abc import Iterator

from kgcp.geometry.camera import Camera
from kgcp.io.target_text import target_lines
from kgcp.settings import VehicleSettings
from kgcp.synthetic.flight import CRS, TARGET_PLATE, FlightPlan

_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def flight_toml(plan: FlightPlan) -> str:
    """Return flight.toml by docs/conventions.md."""
    lines = [
        f"name = {json.dumps(plan.settings.name)}",
        f"crs = {json.dumps(CRS)}  # x, y: easting, northing [m]; z: ellipsoidal height [m]",
        "\n[frames]",
        'folder = "frames"',
        'times = "frames.csv"',
        *_camera_lines(plan.settings.camera),
        *target_lines(TARGET_PLATE.target),
        *_vehicle_lines(plan.vehicle),
        "\n[reference]",
        'poses = "reference.csv"',
    ]
    return "\n".join(lines) + "\n"


def _camera_lines(camera: Camera) -> Iterator[str]:
    yield "\n[camera]"
    yield f"width = {camera.width}"
    yield f"height = {camera.height}"
    for key in ("fx", "fy", "cx", "cy"):
        yield f"{key} = {getattr(camera, key)!r}"
    for key in _DISTORTION:
        if value := getattr(camera, key):
            yield f"{key} = {value!r}"
    yield f"response = {json.dumps(camera.response.value)}"


def _vehicle_lines(vehicle: VehicleSettings) -> Iterator[str]:
    yield "\n[vehicle]"
    yield 'trajectory = "vehicle.csv"'
    yield f"lever_arm_m = {list(vehicle.lever_arm_m)}"
    yield f"sd_lever_arm_m = {list(vehicle.sd_lever_arm_m)}"
    yield f"sd_time_s = {vehicle.sd_time_s!r}"


def readme(plan: FlightPlan) -> str:
    """Return a page that says what the folder is and how it was made."""
    settings = plan.settings
    present = sum(frame.present for frame in plan.frames)
    decoys = sum(bool(frame.decoys) for frame in plan.frames)
    survey = "" if settings.sd_position_m[0] else " --no-survey-errors"
    command = (
        f"kgcp simulate OUT --preset {settings.name} --frames {settings.frames}"
        f" --seed {plan.seed}{survey}"
    )
    return f"""# A simulated flight: {settings.name}

{settings.frames} frames, {present} with the target, {decoys} with a decoy of another code.
Nothing here was photographed: it was rendered by

    {command}

and the same version of kgcp writes the same bytes again. (In the sources of kgcp,
`make sample-flight` remakes `sample_flight/` in this way.)

| file | content |
|---|---|
| `flight.toml` | camera, target, vehicle: what the images cannot tell |
| `frames/` | the images, with exposure and time in their EXIF |
| `frames.csv` | time of each frame |
| `vehicle.csv` | trajectory of the vehicle that carries the target |
| `reference.csv` | poses of the camera as an aerial triangulation would give them |
| `truth.csv` | what kgcp should find |

Columns of `truth.csv`: `present` 1: the whole ring is in the frame, 0: nothing of the plate is;
`decoy` 1: a plate with another code is in the frame; `distance` [m] from the camera to the
target's centre; `x`, `y` its projection [px]; `r00` … `r22` rotation target → camera, row by row;
`cx`, `cy`, `cz` the centre in the camera frame [m]; `gain` exposure, 1 where white of radiance 1
fills the well; `psf` σ of the point spread [px]; `radius_px` fx · outer radius / distance [px];
`X`, `Y`, `Z` the centre in the flight's CRS [m]; `streak_x`, `streak_y` motion during the exposure
[px]; `black`, `white` levels of ink and plate, 0…1.
"""
