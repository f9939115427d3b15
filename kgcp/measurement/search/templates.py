"""Polar templates of coded rings, with several blurs and exposures."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, SingleArray
from kgcp.measurement.search.correlation import TemplateBank, build_bank
from kgcp.targets.layout import Ring

# Tuning of the templates. The benchmark is `benchmarks.search.hard_frames`; docs/method/search.md,
# "Constants of the search", has its results with fewer templates and shifts.
# Each template has a blur (σ of the edges, relative to the outer radius) and an exposure: the level
# between black, 0, and white, 1, at which it is clipped.
BLUR_CLIP_PAIRS = (
    (0.03, 1.0),
    (0.03, 0.55),
    (0.03, 0.3),
    (0.07, 1.0),
    (0.07, 0.55),
    (0.07, 0.3),
    (0.11, 1.0),
    (0.11, 0.55),
    (0.11, 0.35),
    (0.16, 1.0),
    (0.16, 0.6),
    (0.22, 1.0),
    (0.22, 0.75),
    (0.30, 1.0),
)
ANGLES = 120
# Frequencies along the angle that are compared. A dot is wider than a wave of the highest one;
# those left out change scores by up to 5e-3.
FREQUENCIES = 24
SHIFTS = 4  # rows by which the apparent edge may be off the true one, inwards or outwards
_ROWS = 20  # radii of a template
_LOG_STEP = 0.06  # between the logarithms of successive radii
_MAX_RADIUS = 1.15  # relative to the outer radius; the plate's margin is hardly wider
_PX = 64  # pixels of the drawing per outer radius
_REACH = 1.4  # half width of the drawing, in outer radii
_SUB_PIXEL_BITS = 6

ANGLES_RAD: FloatArray = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
CIRCLE: FloatArray = np.stack((np.cos(ANGLES_RAD), np.sin(ANGLES_RAD)), axis=-1)
# Radii at which a frame is sampled, from inside to outside, relative to the apparent outer radius.
# They are equidistant in the logarithm. So if the edge of a ring is taken as too large or too
# small, the ring is the template shifted by some rows.
SAMPLED_RADII: FloatArray = _MAX_RADIUS * np.exp(
    _LOG_STEP * np.arange(1 - _ROWS - SHIFTS, 1 + SHIFTS)
)
TEMPLATE_RADII = SAMPLED_RADII[SHIFTS : SHIFTS + _ROWS]


@lru_cache(maxsize=64)
def templates_of(ring: Ring) -> TemplateBank:
    """Return a ring's templates at heading 0, with black 0 and white 1; rows weigh by area."""
    drawing = _draw(ring)
    points = _PX * (_REACH + TEMPLATE_RADII[:, None, None] * CIRCLE).astype(np.float32)
    images = []
    for blur, clip in BLUR_CLIP_PAIRS:
        blurred = cv2.GaussianBlur(drawing, (0, 0), _PX * blur)
        polar = cv2.remap(blurred, points[..., 0], points[..., 1], cv2.INTER_LINEAR)
        images.append(np.minimum(polar, clip) / clip)
    return build_bank(np.array(images, dtype=np.float64), TEMPLATE_RADII**2, FREQUENCIES)


@lru_cache(maxsize=64)
def code_rows(ring: Ring) -> tuple[int, int]:
    """Return the first and the last row that dots reach."""
    radii = TEMPLATE_RADII * ring.outer_diameter_m
    rows = np.flatnonzero(np.abs(radii - ring.code_diameter_m) < ring.dot_diameter_m)
    return int(rows[0]), int(rows[-1])


@lru_cache(maxsize=64)
def edge_rows(ring: Ring) -> tuple[int, ...]:
    """Return four rows: plate and ink beside the outer edge, disc and ink beside the inner one."""
    code = ring.code_diameter_m / ring.outer_diameter_m
    dot = ring.dot_diameter_m / ring.outer_diameter_m
    outside, inside = 0.5 * (1.0 + code + dot), 0.5 * (ring.inner_ratio + code - dot)
    return tuple(
        int(np.abs(TEMPLATE_RADII - ratio).argmin())
        for ratio in (1.1, outside, 0.85 * ring.inner_ratio, inside)
    )


def _draw(ring: Ring) -> SingleArray:
    """Draw the ring on white; its outer radius is `_PX` pixels."""
    size = round(2.0 * _REACH * _PX) + 1
    drawing = np.ones((size, size), dtype=np.float32)
    unit = 2.0 / ring.outer_diameter_m
    _draw_disc(drawing, (0.0, 0.0), 1.0, 0.0)
    _draw_disc(drawing, (0.0, 0.0), ring.inner_ratio, 1.0)
    for x, y in unit * ring.dot_centres_m():
        _draw_disc(drawing, (float(x), float(y)), 0.5 * unit * ring.dot_diameter_m, 1.0)
    return drawing


def _draw_disc(
    drawing: SingleArray, centre: tuple[float, float], radius: float, value: float
) -> None:
    scale = _PX * 2**_SUB_PIXEL_BITS
    x, y = (round((_REACH + c) * scale) for c in centre)
    cv2.circle(drawing, (x, y), round(radius * scale), value, -1, cv2.LINE_8, _SUB_PIXEL_BITS)
