"""A lens whose distortion is felt within a target, off the middle of the frame."""

from __future__ import annotations

from kgcp.geometry.camera import Camera, Response

LENS = Camera(
    width=480,
    height=340,
    fx=1310.0,
    fy=1306.0,
    cx=121.2,
    cy=91.7,
    k1=-0.09,
    k2=0.06,
    p1=8e-4,
    p2=-6e-4,
    k3=-0.01,
    response=Response.LINEAR,
)
