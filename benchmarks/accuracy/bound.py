"""Cramér-Rao bound of one simulated frame, by `kgcp.simulation.crlb`.

benchmarks/README.md lists what the bound treats as unknown and what it leaves out.
"""

from __future__ import annotations

from kgcp.simulation.crlb import Bound, Shot, bound_of
from kgcp.simulation.flight import TARGET_PLATE, FramePlan
from kgcp.simulation.presets import SimulationSettings


def frame_bound(settings: SimulationSettings, frame: FramePlan) -> Bound:
    """Return the bound of a frame that shows the target; a streak is unknown if there is one."""
    return bound_of(
        Shot(
            camera=settings.camera,
            plate=TARGET_PLATE,
            pose=frame.target,
            optics=frame.optics,
            sensor=settings.sensor,
            gain=frame.gain,
            has_unknown_streak=settings.streak_px[1] > 0.0,
        )
    )
