"""A disc in the penumbra of a shadow, against the blurred product of light and reflectance."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.edge_terms import spread_share_gradient

_RADIUS = 8.0
_XX, _YY, _XY = 0.9, 0.6, 0.15  # of the blur [px²]
_LIGHT_LEFT, _WIDTH, _OFFSET, _ANGLE = 0.45, 2.0, 6.5, 0.6  # of the shadow; σ and place [px]


def _light(x: FloatArray, y: FloatArray, variance: float) -> FloatArray:
    """Return the light, after a blur of that variance across the shadow's edge."""
    across = np.cos(_ANGLE) * x + np.sin(_ANGLE) * y - _OFFSET
    share = ndtr(across / np.sqrt(_WIDTH**2 + variance))
    return np.asarray(1.0 - (1.0 - _LIGHT_LEFT) * share)


def _blurred(x: FloatArray, y: FloatArray, *, is_lit: bool) -> FloatArray:
    """Blur a disc, or what it sends back of the light, by sums over tenths of pixels."""
    step = 0.1
    line = np.arange(-_RADIUS, _RADIUS, step) + 0.5 * step
    u, v = np.meshgrid(line, line)
    inside = u * u + v * v < _RADIUS * _RADIUS
    u, v = u[inside], v[inside]
    precision = np.linalg.inv([[_XX, _XY], [_XY, _YY]])
    dx, dy = x[:, None] - u, y[:, None] - v
    square = precision[0, 0] * dx * dx + 2.0 * precision[0, 1] * dx * dy + precision[1, 1] * dy * dy
    weights = np.exp(-0.5 * square) * np.sqrt(np.linalg.det(precision)) / (2.0 * np.pi)
    if is_lit:
        weights *= _light(u, v, 0.0)
    return np.asarray(weights.sum(axis=1) * step * step)


def test_light_across_an_edge_is_blurred_with_it() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    out = np.array([7.0, 7.5, 8.0, 8.5, 9.0])
    x, y = (np.outer(out, f(angles)).ravel() for f in (np.cos, np.sin))
    normal = np.array((np.cos(_ANGLE), np.sin(_ANGLE)))
    variance = float(normal @ [[_XX, _XY], [_XY, _YY]] @ normal)
    light, step = _light(x, y, variance), 1e-3
    slope = _light(x + step * normal[0], y + step * normal[1], variance)
    slope -= _light(x - step * normal[0], y - step * normal[1], variance)
    gradient = np.outer(normal, slope / (2.0 * step))
    rays = np.zeros((6, len(x)))
    rays[0], rays[1], rays[2], rays[5] = x, y, 1.0, 1.0
    pose = np.hstack((np.eye(3), [[0.0], [0.0], [1.0]]))  # a metre is a pixel
    incidence = EdgeIncidence(
        np.array([[0.0, 0.0, _RADIUS, 1.0, 0.0]]),
        np.array([0, len(x)]),
        np.arange(len(x)),
        np.zeros(len(x)),
    )
    spread = spread_share_gradient(pose, rays, (_XX, _YY, _XY), incidence)
    truth = _blurred(x, y, is_lit=True)
    without = light * _blurred(x, y, is_lit=False)
    missed = truth - (without + np.sum(gradient * spread, axis=0))
    assert 0.03 < np.abs(truth - without).max() < 0.06
    assert np.abs(missed).max() < 0.2 * np.abs(truth - without).max()
