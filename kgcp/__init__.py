"""kgcp: kinematic ground control points from coded circular targets in aerial frames.

The names below are the public interface; docs/api.md explains them with examples. Each is imported
when it is first used, so that `import kgcp` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kgcp.errors import KgcpError as KgcpError
    from kgcp.geometry.camera import Camera as Camera
    from kgcp.georef.selection import Selection as Selection
    from kgcp.io.flight.flight import Flight as Flight
    from kgcp.io.flight.flight import read_flight as read_flight
    from kgcp.io.tables.detections import read_detections as read_detections
    from kgcp.measurement.records import Measurement as Measurement
    from kgcp.measurement.records import Miss as Miss
    from kgcp.pipeline.bias_report import bias_study as bias_study
    from kgcp.pipeline.check import check_flight as check_flight
    from kgcp.pipeline.detect import RunOptions as RunOptions
    from kgcp.pipeline.detect import detect_flight as detect_flight
    from kgcp.pipeline.export import export_gcps as export_gcps
    from kgcp.pipeline.export import make_gcps as make_gcps
    from kgcp.pipeline.measure import measure_frame as measure_frame
    from kgcp.settings import DetectSettings as DetectSettings
    from kgcp.targets.layout import Ring as Ring
    from kgcp.targets.layout import Target as Target

__version__ = "0.1.0"

_MODULES = {
    "Camera": "kgcp.geometry.camera",
    "DetectSettings": "kgcp.settings",
    "Flight": "kgcp.io.flight.flight",
    "KgcpError": "kgcp.errors",
    "Measurement": "kgcp.measurement.records",
    "Miss": "kgcp.measurement.records",
    "Ring": "kgcp.targets.layout",
    "RunOptions": "kgcp.pipeline.detect",
    "Selection": "kgcp.georef.selection",
    "Target": "kgcp.targets.layout",
    "bias_study": "kgcp.pipeline.bias_report",
    "check_flight": "kgcp.pipeline.check",
    "detect_flight": "kgcp.pipeline.detect",
    "export_gcps": "kgcp.pipeline.export",
    "make_gcps": "kgcp.pipeline.export",
    "measure_frame": "kgcp.pipeline.measure",
    "read_detections": "kgcp.io.tables.detections",
    "read_flight": "kgcp.io.flight.flight",
}

__all__ = ["__version__", *_MODULES]  # noqa: PLE0604 - names of the table above


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module 'kgcp' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
