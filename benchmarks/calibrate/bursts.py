"""Bursts of photographs between which the camera moves a little.

    python -m benchmarks.calibrate.bursts

Discs are simulated without images. A smooth displacement over the frame stands for the errors of
the lens model. It acts on the estimated camera in every photograph. The correlation of its effects
in two photographs of a burst shows from which movement on they count as two places.
"""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.equations import computed, network_rows, view_rows
from kgcp.network.frame_camera import FrameCameraModel
from kgcp.network.records import CalibrationPrior, Estimate, Network, Observations, PointPrior

_CAMERA = Camera(1600, 1200, 1510.0, 1510.0, 811.0, 583.0, -0.11, 0.06)
_PITCH_M, _DISTANCE_M, _TILT = 0.03, 0.33, 0.55
_PLACES = 8
_WAVES = 12  # number of waves in a displacement
_SPREAD = (0.7, 1.3)  # range of their wavelengths, relative to the nominal one
_LENSES = 40
_APART = (0.0, 0.005, 0.015, 0.03, 0.04, 0.08)  # movements: relative to the distance, or [rad]
_WAVELENGTHS_PX = (800, 400, 200)
_KINDS = ("turn", "shift", "orbit")


def main() -> None:
    """Print a table of correlations."""
    print("wavelength px  camera " + " ".join(f"{apart:6}" for apart in _APART))
    for wavelength_px in _WAVELENGTHS_PX:
        for kind in _KINDS:
            row = [correlation(wavelength_px, kind, apart) for apart in _APART]
            print(f"{wavelength_px:13}  {kind:6} " + " ".join(f"{value:+6.2f}" for value in row))


def correlation(wavelength_px: float, kind: str, apart: float) -> float:
    """Return the correlation between the effects of displacements in two similar photographs.

    Parameters
    ----------
    wavelength_px : float
        Wavelength of the displacements.
    kind : str
        How the camera moves: `turn` about its projection centre, `shift`, or `orbit` about the
        middle of the field.
    apart : float
        Amount of the movement: relative to the distance, or [rad].
    """
    both, first, second = 0.0, 0.0, 0.0
    for seed in range(_LENSES):
        rng = np.random.default_rng([18, seed])
        still, moved = _two_sessions(kind, apart, rng)
        waves = _waves(wavelength_px, rng)
        one, other = (_scores(network, estimate, waves) for network, estimate in (still, moved))
        both += float(np.sum(one * other))
        first += float(np.sum(one**2))
        second += float(np.sum(other**2))
    return both / float(np.sqrt(first * second))


def _two_sessions(
    kind: str, apart: float, rng: np.random.Generator
) -> tuple[tuple[Network, Estimate], tuple[Network, Estimate]]:
    """Return photographs from all sides, and the same with the camera moved a little."""
    columns, rows = np.meshgrid(np.arange(7.0), np.arange(5.0))
    points = _PITCH_M * np.stack((columns.ravel(), rows.ravel(), np.zeros(35)), axis=1)
    points -= points.mean(axis=0)
    poses, moved = [], []
    for place in range(_PLACES):
        angle = 2.0 * np.pi * place / _PLACES
        tilt = rotation_about(_TILT * np.array([np.cos(angle), np.sin(angle), 0.0]))
        rotation = tilt @ rotation_about(np.array([0.0, 0.0, 0.5 * np.pi * (place % 4)]))
        middle = np.array([0.02 * np.cos(3.0 * angle), 0.02 * np.sin(2.0 * angle), _DISTANCE_M])
        direction = rng.standard_normal(3)
        direction *= apart / np.linalg.norm(direction)
        turn = rotation_about(direction)
        poses.append((rotation, middle))
        moved.append(
            (rotation, middle + _DISTANCE_M * direction)
            if kind == "shift"
            else (turn @ rotation, turn @ middle if kind == "turn" else middle)
        )
    return _session(points, poses), _session(points, moved)


def _session(
    points: FloatArray, poses: list[tuple[FloatArray, FloatArray]]
) -> tuple[Network, Estimate]:
    """Return photographs without errors; translations refer to the middle of the field."""
    model = FrameCameraModel(_CAMERA, ("k1", "k2"))
    values = model.values_of(_CAMERA)[None]
    view, point = np.divmod(np.arange(len(points) * len(poses)), len(points))
    rotations, translations = (np.array(each) for each in zip(*poses, strict=True))
    network = Network(
        model,
        np.zeros(len(poses), dtype=np.intp),
        Observations(view, point, np.zeros((len(view), 2)), np.tile(np.eye(2), (len(view), 1, 1))),
        PointPrior(points, None),
        CalibrationPrior(values, np.full_like(values, np.inf)),
    )
    return network, Estimate(values, rotations, translations, points)


def _waves(wavelength_px: float, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Return wave vectors (n, 2), phases (n,) and amplitudes (n, 2) of a displacement."""
    vectors = rng.standard_normal((_WAVES, 2))
    length = wavelength_px * rng.uniform(*_SPREAD, _WAVES)
    vectors *= (2.0 * np.pi / (length * np.linalg.norm(vectors, axis=1)))[:, None]
    return vectors, rng.uniform(0.0, 2.0 * np.pi, _WAVES), rng.standard_normal((_WAVES, 2))


def _scores(network: Network, estimate: Estimate, waves: tuple[FloatArray, ...]) -> FloatArray:
    """Return the gradients (v, p) of the camera's parameters by displacements, poses eliminated."""
    vectors, phases, amplitudes = waves
    places = computed(network, estimate)
    displaced = np.cos(places @ vectors.T + phases) @ amplitudes
    scores = []
    for view in view_rows(network, network_rows(network, estimate, np.ones(len(places)))):
        basis = np.linalg.qr(view.by_pose)[0]
        own = view.by_camera - basis @ (basis.T @ view.by_camera)
        scores.append(own.T @ displaced[view.rows].ravel() / np.linalg.norm(own, axis=0))
    return np.array(scores)


if __name__ == "__main__":
    main()
