"""A simulated field in simulated photographs, without images: where its discs are seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.equations import computed
from kgcp.network.frame_camera import FrameCameraModel
from kgcp.network.records import CalibrationPrior, Estimate, Network, Observations, PointPrior

SD_PX = 0.02
CAMERA = Camera(1600, 1200, 1510.0, 1510.0, 811.0, 583.0, -0.11, 0.06)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedNetwork:
    """A network with its truth."""

    network: Network
    truth: Estimate

    def start(self, rng: np.random.Generator) -> Estimate:
        """Return the truth, disturbed."""
        truth = self.truth
        turns = [rotation_about(0.01 * rng.standard_normal(3)) for _ in truth.rotations]
        return Estimate(
            truth.cameras * [[1.02, 1.02, 0.97, 0.0, 0.0]],
            np.array([turn @ r for turn, r in zip(turns, truth.rotations, strict=True)]),
            truth.translations + 0.003 * rng.standard_normal(truth.translations.shape),
            self.network.points.nominal,
        )

    def observed(self, rng: np.random.Generator) -> SimulatedNetwork:
        """Return it with other noise."""
        places = computed(self.network, self.truth)
        noise = SD_PX * rng.standard_normal(places.shape)
        observations = replace(self.network.observations, places=places + noise)
        return replace(self, network=replace(self.network, observations=observations))


def simulated(
    views: int = 8, *, points: PointPrior | None = None, displaced_m: FloatArray | None = None
) -> SimulatedNetwork:
    """Return a board of 7 x 5 discs in some tilted photographs, without noise."""
    columns, rows = np.meshgrid(np.arange(7.0), np.arange(5.0))
    nominal = 0.03 * np.stack((columns.ravel(), rows.ravel(), np.zeros(35)), axis=1)
    true_points = nominal if displaced_m is None else nominal + displaced_m
    rotations, translations = [], []
    for index in range(views):
        angle = 2.0 * np.pi * index / views
        tilt = rotation_about(0.55 * np.array([np.cos(angle), np.sin(angle), 0.0]))
        turn = rotation_about(np.array([0.0, 0.0, 0.5 * np.pi * (index % 4)]))
        rotation = tilt @ turn
        rotations.append(rotation)
        middle = np.array([0.02 * np.cos(3 * angle), 0.02 * np.sin(2 * angle), 0.33])
        translations.append(middle - rotation @ nominal.mean(axis=0))
    model = FrameCameraModel(CAMERA, ("k1", "k2"))
    values = model.values_of(CAMERA)[None]
    view, point = np.divmod(np.arange(35 * views), 35)
    observations = Observations(
        view,
        point,
        np.zeros((len(view), 2)),
        np.broadcast_to(SD_PX**2 * np.eye(2), (len(view), 2, 2)),
    )
    network = Network(
        model,
        np.zeros(views, dtype=np.intp),
        observations,
        points or PointPrior(nominal, None),
        CalibrationPrior(values, np.full_like(values, np.inf)),
    )
    truth = Estimate(values, np.array(rotations), np.array(translations), true_points)
    exact = SimulatedNetwork(network, truth)
    places = computed(network, truth)
    return replace(
        exact, network=replace(network, observations=replace(observations, places=places))
    )


def repeated(once: SimulatedNetwork, times: int) -> SimulatedNetwork:
    """Return a burst from each pose: all photographs, one after another, `times` times."""
    network, truth, seen = once.network, once.truth, once.network.observations
    views = len(network.view_camera)
    observations = Observations(
        np.concatenate([seen.view + views * number for number in range(times)]),
        np.tile(seen.point, times),
        np.tile(seen.places, (times, 1)),
        np.tile(seen.cov, (times, 1, 1)),
    )
    view_camera = np.tile(network.view_camera, times)
    return SimulatedNetwork(
        replace(network, view_camera=view_camera, observations=observations),
        replace(
            truth,
            rotations=np.tile(truth.rotations, (times, 1, 1)),
            translations=np.tile(truth.translations, (times, 1)),
        ),
    )


@pytest.fixture
def rng() -> np.random.Generator:
    """Return the same numbers for every test."""
    return np.random.default_rng(18)
