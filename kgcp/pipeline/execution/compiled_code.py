"""The compiled code of the measurement, loaded or compiled before the first frame.

A process takes half a second to load it. Under Linux, the server of new processes does so once,
while the program loads what else it needs, and its children have it from the start. What is not
compiled yet takes a minute: one worker compiles, and the others wait for what it leaves on the disk
(`kgcp.pipeline.execution.local_processes`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.measurement.frame import examine
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target

_SIDE_PX, _RADIUS_PX = 100, 20.0
_FINE = 4  # points per pixel and axis
_BLACK, _WHITE, _NOISE = 40.0, 200.0, 1.5  # grey values
_CAMERA = Camera(_SIDE_PX, _SIDE_PX, 1000.0, 1000.0, 49.5, 49.5)
_RING = Ring("A", 1.0, 0.5, 0.75, 0.15, (0.0, 80.0, 130.0, 250.0))

_RESPONSES = (Response.LINEAR, Response.UNKNOWN)  # between them, they use most compiled functions

_loaded: set[Response] = set()


class _NotCompiled(Exception):  # noqa: N818 - a state and no error
    """A function has no compiled code."""


def load_compiled_code() -> bool:
    """Load what most frames need, and tell whether all of it is there; nothing is compiled."""
    if _loaded.issuperset(_RESPONSES):
        return True
    from numba.core import event

    class Refusal(event.Listener):
        """Hears of functions that would be compiled."""

        def on_start(self, event: object) -> None:  # noqa: ARG002 - the base class's signature
            """Refuse to compile one."""
            raise _NotCompiled

        def on_end(self, event: object) -> None:
            """Hear that it is compiled."""

    try:
        with event.install_listener("numba:compile", Refusal()):
            compile_code()
    except _NotCompiled:
        return False
    return True


@single_threaded()
def compile_code() -> bool:
    """Load what most frames need, and compile what is missing: by measuring a drawn plate."""
    grey = _drawn_plate()
    for response in _RESPONSES:
        if response not in _loaded:
            camera = replace(_CAMERA, response=response)
            examine(grey, camera, (Target(_RING),), DetectSettings())
            _loaded.add(response)
    return True


def _drawn_plate() -> GreyArray:
    """Draw a plate seen from the front."""
    places = (np.arange(_FINE * _SIDE_PX) + 0.5) / _FINE - 0.5
    x, y = np.meshgrid(places - _CAMERA.cx, places - _CAMERA.cy)
    px_per_m = _RADIUS_PX / (0.5 * _RING.outer_diameter_m)
    diameter = 2.0 * np.hypot(x, y) / px_per_m
    is_black = (diameter < _RING.outer_diameter_m) & (diameter > _RING.inner_diameter_m)
    for dot_x, dot_y in px_per_m * _RING.dot_centres_m():
        is_black &= 2.0 * np.hypot(x - dot_x, y - dot_y) / px_per_m > _RING.dot_diameter_m
    share = is_black.reshape(_SIDE_PX, _FINE, _SIDE_PX, _FINE).mean(axis=(1, 3))
    light = _WHITE + (_BLACK - _WHITE) * share
    light += np.random.default_rng(1).normal(0.0, _NOISE, light.shape)
    return np.asarray(light, dtype=np.uint8)
