"""Point spreads with a third moment, against discs that are blurred by one."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.edge_terms import skew_rows

_SHIFT_PX, _SHARE = 1.0, 0.2  # a fifth of the light lands one pixel beside
_SD_PX = 1.2


def _disc(x: FloatArray, y: FloatArray, radius: float) -> FloatArray:
    """Blur a disc by a Gaussian, by sums over its pixels' tenths."""
    step = 0.1
    line = np.arange(-radius, radius, step) + 0.5 * step
    u, v = np.meshgrid(line, line)
    inside = u * u + v * v < radius * radius
    u, v = u[inside], v[inside]
    square = (x[:, None] - u) ** 2 + (y[:, None] - v) ** 2
    weights = np.exp(-0.5 * square / _SD_PX**2) / (2.0 * np.pi * _SD_PX**2)
    return np.asarray(weights.sum(axis=1) * step * step)


def test_third_moments_displace_edges_as_two_gaussians_do() -> None:
    """Two Gaussians beside each other have κ_xxx = p (1 − p)(1 − 2p) d³ about their centroid."""
    radius = 8.0
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    out = np.array([6.5, 7.5, 8.0, 8.5, 9.5])
    x, y = (np.outer(out, f(angles)).ravel() for f in (np.cos, np.sin))
    near, far = -_SHARE * _SHIFT_PX, (1.0 - _SHARE) * _SHIFT_PX
    truth = (1.0 - _SHARE) * _disc(x - near, y, radius) + _SHARE * _disc(x - far, y, radius)
    variance = _SHARE * (1.0 - _SHARE) * _SHIFT_PX**2
    cumulant = variance * (1.0 - 2.0 * _SHARE) * _SHIFT_PX
    rays = np.zeros((6, len(x)))
    rays[0], rays[1], rays[2], rays[5] = x, y, 1.0, 1.0
    pose = np.hstack((np.eye(3), [[0.0], [0.0], [1.0]]))  # a metre is a pixel
    members = np.arange(len(x))
    incidence = EdgeIncidence(
        np.array([[0.0, 0.0, radius, 1.0, 0.0]]),
        np.array([0, len(x)]),
        members,
        np.zeros(len(x)),
    )
    rows = skew_rows(pose, rays, (_SD_PX**2 + variance, _SD_PX**2, 0.0), incidence)
    # what is odd in x is the skew's; all else is the spread's variance
    opposite = np.array([np.argmin((x + a) ** 2 + (y - b) ** 2) for a, b in zip(x, y, strict=True)])
    odd = 0.5 * (truth - truth[opposite])
    modelled = cumulant * rows[0]
    assert np.abs(odd).max() > 0.003
    assert np.abs(modelled - odd).max() < 0.2 * np.abs(odd).max()
