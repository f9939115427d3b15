"""Edge tracking against a plain version with numpy's linear algebra."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.measurement.search.edge_tracking import track_edges
from kgcp.measurement.search.pyramid import build_pyramid

RAYS = 40
ANGLES_RAD = 2.0 * np.pi / RAYS * np.arange(RAYS)
SAMPLES = np.arange(0.5, 1.71, 0.04)
HARMONICS = np.column_stack(
    [np.ones(RAYS)] + [f(k * ANGLES_RAD) for k in (1, 2) for f in (np.cos, np.sin)]
)


def robust_curve(
    edge: FloatArray, strength: FloatArray, harmonics: FloatArray, widths: tuple[float, ...]
) -> FloatArray:
    """Distances of the curve of few harmonics that fits edges best."""
    strong = np.clip(strength / (np.median(strength) + 1e-6), 0.0, 1.0)
    curve = np.full(len(edge), np.median(edge))
    for width in widths:
        weight = strong / (1.0 + ((edge - curve) / width) ** 2) ** 2
        normal = harmonics.T @ (weight[:, None] * harmonics) + 1e-3 * np.eye(5)
        curve = harmonics @ np.linalg.solve(normal, harmonics.T @ (weight * edge))
    return np.asarray(curve)


def track_plainly(
    image: GreyArray, x: float, y: float, radius: float
) -> tuple[FloatArray, BoolArray] | None:
    """Edges and which of them lie on the curve; None if half of the rays show no ring."""
    grey, middles = image.astype(float), SAMPLES[2:-2]
    height, width = image.shape
    column, row = (
        centre + radius * np.outer(f(ANGLES_RAD), SAMPLES)
        for centre, f in ((x, np.cos), (y, np.sin))
    )
    nearest = grey[
        np.clip((row + 0.5).astype(int), 0, height - 1),
        np.clip((column + 0.5).astype(int), 0, width - 1),
    ][::2]
    slopes = nearest[:, 4:] - nearest[:, :-4]
    edge, strength = middles[slopes.argmax(axis=1)], np.maximum(slopes.max(axis=1), 0.0)
    curve = robust_curve(edge, strength, HARMONICS[::2], (0.25, 0.12, 0.07))
    if np.sum(np.abs(edge - curve) < 0.14) <= 0.6 * len(edge):
        return None
    curve_of_all = HARMONICS @ np.linalg.lstsq(HARMONICS[::2], curve, rcond=None)[0]
    values = ndimage.map_coordinates(grey, [row, column], order=1, mode="nearest")
    slopes = values[:, 4:] - values[:, :-4]
    edge, strength = curve_of_all.copy(), np.zeros(RAYS)
    for k in range(RAYS):
        near = np.flatnonzero(np.abs(middles - curve_of_all[k]) <= 0.17)
        near = near[(near > 0) & (near < len(middles) - 1)]
        if len(near) == 0:
            continue
        best = near[slopes[k, near].argmax()]
        left, top, right = slopes[k, best - 1 : best + 2]
        beside = 0.5 * (left - right) / min(left - 2.0 * top + right, -1e-3)
        edge[k] = middles[best] + 0.04 * np.clip(beside, -0.5, 0.5)
        strength[k] = np.rint(max(top, 0.0))
    residuals = edge - robust_curve(edge, strength, HARMONICS, (0.07, 0.05))
    inlying = (np.abs(residuals) < 0.07) & (strength > 0.0)
    return edge, inlying & (inlying.sum() >= 0.55 * RAYS)


def frame_of_ellipses(seed: int) -> tuple[GreyArray, FloatArray, FloatArray]:
    """Dark elliptic rings on texture; rough centres and radii of them, and of nothing."""
    rng = np.random.default_rng(seed)
    texture = ndimage.gaussian_filter(rng.normal(size=(300, 400)), 2.0)
    frame = np.clip(130.0 + 200.0 * texture, 0, 255).astype(np.uint8)
    centres = rng.uniform((30.0, 30.0), (370.0, 270.0), (40, 2))
    radii = rng.uniform(8.0, 23.0, 40)  # of rings that are tracked in the frame itself
    for (x, y), radius in zip(centres[:25], radii[:25], strict=True):
        tilt, angle = rng.uniform(0.75, 1.0), rng.uniform(0.0, 180.0)
        for factor, level in ((1.4, 200), (1.0, 40), (0.5, 190)):
            axes = (round(factor * radius / tilt**0.5), round(factor * radius * tilt**0.5))
            cv2.ellipse(frame, (int(x), int(y)), axes, angle, 0.0, 360.0, level, -1)
    noise = rng.normal(0.0, 3.0, frame.shape)
    grey = np.clip(np.rint(cv2.GaussianBlur(frame, (0, 0), 0.8) + noise), 0, 255)
    return grey.astype(np.uint8), centres + rng.normal(0.0, 1.0, (40, 2)), radii


@pytest.mark.parametrize("seed", range(4))
def test_edges_equal_those_of_a_plain_implementation(seed: int) -> None:
    grey, centres, radii = frame_of_ellipses(seed)
    pyramid = build_pyramid(grey)
    edges, inlying = track_edges(pyramid.frame, pyramid.reduced, pyramid.levels, centres, radii)
    tracked = 0
    for i in range(40):
        plain = track_plainly(grey, float(centres[i, 0]), float(centres[i, 1]), float(radii[i]))
        if plain is None:
            assert not inlying[i].any()
            continue
        np.testing.assert_array_equal(inlying[i], plain[1])
        np.testing.assert_allclose(edges[i], plain[0], rtol=0.0, atol=1e-7)
        tracked += bool(inlying[i].any())
    assert tracked > 8
