"""Plain targets of frames without a pose: how many their neighbours predict, and how surely.

A drone flies a line over single discs. Some frames have no reference pose, and in the others the
targets count as measured. Places are interpolated between frames that show the target, or also
between frames whose poses say where it is beyond their borders. A prediction is right if it is sure
enough to look there, and off by less than four of its standard deviations.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.georef.plain_neighbours import PlainTracks
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.measurement.records import ExposureSettings, FrameResult
from kgcp.targets.plain import PlainPolarity, PlainTarget

_CAMERA = Camera(4000, 3000, 3600.0, 3600.0, 1999.5, 1499.5)
_HEIGHT_M, _SPEED_MPS, _DIAMETER_M = 50.0, 5.0, 0.3
_SPACING_M, _TARGETS, _FRAMES = 12.0, 20, 60
_SD_POSE_PX, _SD_MEASURED_PX = 3.0, 0.01
_FARTHEST_PX = 8000.0  # beyond, no pose says where a target is
_WANDER_S = 4.0  # over which the camera's attitude is like itself


@dataclass(frozen=True, slots=True, eq=False)
class _Flight:
    """Where targets are in all frames."""

    sights_m: FloatArray  # (frames, targets, 3): in the camera frame
    down: FloatArray  # (frames, 3): normal of the ground there, away from the camera
    places_px: FloatArray  # (frames, targets, 2)

    @property
    def is_visible(self) -> FloatArray:
        """Whether a target is in the frame (frames, targets)."""
        x, y = np.moveaxis(self.places_px, 2, 0)
        margin = 20.0
        within_x = (x > margin) & (x < _CAMERA.width - margin)
        return np.asarray(within_x & (y > margin) & (y < _CAMERA.height - margin))


def _fly(sd_deg: float, rng: np.random.Generator) -> _Flight:
    """Draw a flight whose attitude wanders by so much."""
    share = math.exp(-1.0 / _WANDER_S)
    angles = np.zeros((_FRAMES, 3))
    angles[0] = rng.standard_normal(3)
    for row in range(1, _FRAMES):
        angles[row] = share * angles[row - 1] + math.sqrt(1.0 - share**2) * rng.standard_normal(3)
    turns = [rotation_about(math.radians(sd_deg) * each) for each in angles]
    along_m = _SPACING_M * np.arange(_TARGETS)
    aside_m = rng.uniform(-15.0, 15.0, _TARGETS)
    on_ground = np.column_stack((aside_m, along_m, np.full(_TARGETS, _HEIGHT_M)))
    sights = []
    for row, turn in enumerate(turns):
        camera = np.array([0.0, _SPEED_MPS * row, 0.0]) + rng.normal(0.0, 0.1, 3)
        sights.append((on_ground - camera) @ turn)
    sights_m = np.array(sights)
    places = _CAMERA.project(sights_m.reshape(-1, 3)).reshape(_FRAMES, _TARGETS, 2)
    return _Flight(sights_m, np.array([turn[2] for turn in turns]), places)


def _placed(
    flight: _Flight, row: int, target: int, off_px: FloatArray, sd_px: float
) -> PlainPrediction:
    sight_m = flight.sights_m[row, target]
    radius_px = 0.5 * _DIAMETER_M * _CAMERA.fx / float(np.linalg.norm(sight_m))
    return PlainPrediction(
        flight.places_px[row, target] + off_px,
        sd_px**2 * np.eye(2),
        sight_m,
        0.002,
        NormalPrior(flight.down[row], 3.0),
        radius_px,
        "a benchmark",
    )


def count(sd_deg: float, missing: float, flights: int, *, has_poses: bool) -> tuple[int, int, int]:
    """Return how many targets are in frames without a pose, predicted, and predicted wrongly.

    Parameters
    ----------
    sd_deg : float
        How much the attitude wanders.
    missing : float
        Share of frames without a pose.
    has_poses : bool
        Whether poses of other frames tell where targets are that they do not show.
    """
    shown = right = wrong = 0
    for seed in range(flights):
        rng = np.random.default_rng([seed, round(10 * sd_deg), round(100 * missing)])
        flight = _fly(sd_deg, rng)
        lacks_pose = rng.random(_FRAMES) < missing
        names = [f"T{target}" for target in range(_TARGETS)]
        targets = [
            PlainTarget(name, (_DIAMETER_M,), PlainPolarity.BRIGHT, (0.0, 0.0, 0.0))
            for name in names
        ]
        tracks = PlainTracks(targets, np.arange(float(_FRAMES)))
        visible, nothing = flight.is_visible, FrameResult("", None, ExposureSettings(), ())
        for row in np.flatnonzero(~lacks_pose).tolist():
            off_px = rng.normal(0.0, _SD_POSE_PX, 2)
            places = {
                name: _placed(flight, row, target, off_px, _SD_POSE_PX)
                for target, name in enumerate(names)
                if has_poses and np.all(np.abs(flight.places_px[row, target]) < _FARTHEST_PX)
            }
            for target in np.flatnonzero(visible[row]).tolist():
                places[names[target]] = _placed(flight, row, target, np.zeros(2), _SD_MEASURED_PX)
            tracks.add(row, nothing, places)
        wanted = {
            row: [names[target] for target in np.flatnonzero(visible[row]).tolist()]
            for row in np.flatnonzero(lacks_pose).tolist()
        }
        made = tracks.predictions(_CAMERA, wanted)
        for row, row_names in wanted.items():
            for name in row_names:
                shown += 1
                prediction = made.get(row, {}).get(name)
                if prediction is None or not prediction.is_sure:
                    continue
                off = prediction.centre_px - flight.places_px[row, names.index(name)]
                is_right = float(np.linalg.norm(off)) < prediction.reach_px
                right, wrong = right + is_right, wrong + (not is_right)
    return shown, right, wrong


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line per wander of the attitude and share of missing poses."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=10, help="per line")
    chosen = parser.parse_args(arguments)
    print("attitude  missing  targets    by their own places      and by poses")
    for sd_deg in (0.1, 0.3, 1.0):
        for missing in (0.1, 0.3, 0.5):
            cells = []
            for has_poses in (False, True):
                shown, right, wrong = count(sd_deg, missing, chosen.flights, has_poses=has_poses)
                cells.append(f"{100.0 * right / shown:5.1f} %, {wrong:3d} wrong")
            print(f"{sd_deg:6.1f} °  {100.0 * missing:5.0f} %  {shown:7d}  ", "     ".join(cells))


if __name__ == "__main__":
    main()
