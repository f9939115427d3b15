"""Tables of flight.toml that many tests share."""

from __future__ import annotations

from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera

RING_A = """\
[[target]]
name = "A"
outer_diameter_m = 0.9
inner_diameter_m = 0.45
code_diameter_m = 0.642857143
dot_diameter_m = 0.128571429
code_deg = [0, 43, 78, 180]
"""
"""The ring of `kgcp.simulation.flight.TARGET_PLATE`."""

REPLICA_OF_A = """\
[[target]]
name = "A-inner"
replica_of = "A"
scale = 0.2
code_deg = [10, 80, 150, 250, 290]
"""
"""The small ring within it."""

ON_A_VEHICLE = f"""\
crs = "EPSG:25831"

[camera]
width = 1600
height = 1200
fx = 2300.0
fy = 2300.0
cx = 800.0
cy = 600.0

{RING_A}
[vehicle]
trajectory = "vehicle.csv"
lever_arm_m = [0.0, 0.0, -2.0]

[reference]
poses = "reference.csv"
"""
"""A flight whose target is on a vehicle, with reference poses."""


def camera_table(camera: Camera) -> str:
    """Return the table of a camera without its response."""
    values = {name: getattr(camera, name) for name in ("width", "height", *CALIBRATION_PARAMETERS)}
    lines = [f"{name} = {value}" for name, value in values.items() if value]
    return "\n".join(["[camera]", *lines, ""])
