"""The compiled code of the measurement, loaded or compiled before the first frame.

Loading it takes half a second per process. Under Linux, the server of new processes loads it once,
while the program loads what else it needs, and all workers inherit it. Compiling takes a minute:
one worker compiles the search while another one compiles the adjustment, and all others load the
result from the disk (`kgcp.pipeline.execution.local_processes`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.fit_target import measure_by_model
from kgcp.measurement.frame import examine
from kgcp.measurement.records import InitialPose
from kgcp.measurement.search.candidates import find_code, find_dotted_rings, find_rings
from kgcp.measurement.search.initial_pose import initial_pose
from kgcp.measurement.search.template_match import match_templates_at
from kgcp.pipeline.execution.local_processes import Preparation
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target

_SIDE_PX, _RADIUS_PX = 100, 20.0
_OVERSAMPLING = 4  # points per pixel and axis
_BLACK, _WHITE, _NOISE = 40.0, 200.0, 1.5  # grey values
_TILT_RAD, _BLUR_PX = 0.1, 0.5  # start values of the adjustment
_CAMERA = Camera(_SIDE_PX, _SIDE_PX, 1000.0, 1000.0, 49.5, 49.5)
_RING = Ring("A", 1.0, 0.5, 0.75, 0.15, (0.0, 80.0, 130.0, 250.0))

_RESPONSES = (Response.LINEAR, Response.UNKNOWN)  # together they use most compiled functions

_loaded: set[Response] = set()


class _NotCompiled(Exception):  # noqa: N818 - a state and no error
    """A function has no compiled code."""


def load_compiled_code() -> bool:
    """Load the code that most frames need, without compiling; tell whether all of it exists."""
    if _loaded.issuperset(_RESPONSES):
        return True
    from numba.core import event

    class RefusedCandidate(event.Listener):
        """Listener that prevents the compilation of functions."""

        def on_start(self, event: object) -> None:  # noqa: ARG002 - the base class's signature
            """Refuse to compile a function."""
            raise _NotCompiled

        def on_end(self, event: object) -> None:
            """Do nothing after a compilation."""

    try:
        with event.install_listener("numba:compile", RefusedCandidate()):
            compile_code()
    except _NotCompiled:
        return False
    return True


@single_threaded()
def compile_search() -> None:
    """Compile missing code of the search, by searching for a drawn plate."""
    grey, target = _drawn_plate(), Target(_RING)
    candidates = find_dotted_rings(grey, find_rings(grey, DetectSettings()), [_RING])
    (match,), _ = find_code(candidates[_RING], _RING, DetectSettings())
    start = initial_pose(grey, _CAMERA, target, match)
    match_templates_at(grey, _CAMERA, start.pose, _RING)


@single_threaded()
def compile_adjustment() -> None:
    """Compile missing code of the adjustment, by measuring a drawn plate at its known place."""
    grey, distance_m = _drawn_plate(), _CAMERA.fx * 0.5 * _RING.outer_diameter_m / _RADIUS_PX
    pose = Pose(np.eye(3), np.array([0.0, 0.0, distance_m])).tilted(_TILT_RAD)
    start = InitialPose(_RING.name, 1.0, pose, _RADIUS_PX, edge_shift_px=0.0, blur_px=_BLUR_PX)
    for response in _RESPONSES:
        measure_by_model(grey, replace(_CAMERA, response=response), Target(_RING), start)


@single_threaded()
def compile_code() -> None:
    """Load the code that most frames need and compile what is missing, by measuring a plate."""
    grey = _drawn_plate()
    for response in _RESPONSES:
        if response not in _loaded:
            camera = replace(_CAMERA, response=response)
            examine(grey, camera, (Target(_RING),), DetectSettings())
            _loaded.add(response)


def compilation() -> Preparation:
    """Return the preparation of new processes for their first frame."""
    return Preparation(load_compiled_code, compile_code, (compile_adjustment, compile_search))


def _drawn_plate() -> GreyArray:
    """Draw a plate that is seen frontally."""
    places = (np.arange(_OVERSAMPLING * _SIDE_PX) + 0.5) / _OVERSAMPLING - 0.5
    x, y = np.meshgrid(places - _CAMERA.cx, places - _CAMERA.cy)
    px_per_m = _RADIUS_PX / (0.5 * _RING.outer_diameter_m)
    diameter = 2.0 * np.hypot(x, y) / px_per_m
    is_black = (diameter < _RING.outer_diameter_m) & (diameter > _RING.inner_diameter_m)
    for dot_x, dot_y in px_per_m * _RING.dot_centres_m():
        is_black &= 2.0 * np.hypot(x - dot_x, y - dot_y) / px_per_m > _RING.dot_diameter_m
    share = is_black.reshape(_SIDE_PX, _OVERSAMPLING, _SIDE_PX, _OVERSAMPLING).mean(axis=(1, 3))
    light = _WHITE + (_BLACK - _WHITE) * share
    light += np.random.default_rng(1).normal(0.0, _NOISE, light.shape)
    return np.asarray(light, dtype=np.uint8)
