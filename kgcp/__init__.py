"""kgcp: kinematic ground control points from coded circular targets in aerial frames."""

__version__ = "0.1.0"
