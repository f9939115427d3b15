"""Sets of frames for the search: where the plates are, and what makes them hard to find."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.search.plates import DECOYS, TARGET_A, TARGET_B, TARGET_C, plate_of
from benchmarks.search.scene import (
    ImagingChain,
    Obstacle,
    Shot,
    Veil,
    halved,
    pixel_inside,
    place,
    place_apart,
    random_camera,
    scene_around,
    stream,
)
from kgcp.geometry.camera import Camera
from kgcp.simulation.imaging import Optics
from kgcp.simulation.regions import ConvexPolygon, DiscRegion, polygon, regular_polygon
from kgcp.simulation.scene import PlatePose
from kgcp.targets.layout import Target

_UPRIGHT, _LEANING, _OBLIQUE = (0.0, 12.0), (0.0, 25.0), (30.0, 45.0)
_MIDDLE_PX = (12.0, 70.0)
_GOOD_GAIN = (0.7, 1.0)
_PSF_PX = (0.55, 0.85)
_REPLICA_MARGIN = 1.35  # radius around the centre that must be in the frame, in replica radii
_DECOYS_PER_FRAME = 4

Rng = np.random.Generator
Planner = Callable[[Rng], Shot]


@dataclass(frozen=True, slots=True)
class FrameSet:
    """Frames of one kind.

    Attributes
    ----------
    plan : callable
        Function of a random generator that plans one frame.
    goal : float or None
        Share of the plates that should be found.
    """

    name: str
    plan: Planner
    goal: float | None = None

    def shot(self, seed: int, index: int) -> Shot:
        """Plan one frame; the same seed and index always give the same frame."""
        return self.plan(stream(seed, self.name, index, "plan"))


def _log_uniform(limits: tuple[float, float], rng: Rng) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))


def _shot(
    camera: Camera,
    chain: ImagingChain,
    wanted: Sequence[PlatePose],
    rng: Rng,
    *,
    decoys: Sequence[tuple[str, PlatePose]] = (),
    obstacles: Sequence[Obstacle] = (),
    optics: Optics | None = None,
    gain: tuple[float, float] = _GOOD_GAIN,
    veil: Veil | None = None,
) -> Shot:
    plates = [*wanted, *(decoy for _, decoy in decoys)]
    return Shot(
        camera,
        chain,
        scene_around(plates[0], plates[1:], rng),
        tuple(wanted),
        tuple(decoys),
        tuple(obstacles),
        optics or Optics(float(rng.uniform(*_PSF_PX))),
        _log_uniform(gain, rng),
        veil or Veil(),
    )


def _one_plate(
    rng: Rng, ring_px: tuple[float, float], tilt: tuple[float, float]
) -> tuple[Camera, ImagingChain, PlatePose]:
    camera, chain = random_camera(rng)
    radius = _log_uniform(ring_px, rng)
    pixel = pixel_inside(camera, radius, rng)
    return camera, chain, place(camera, plate_of(TARGET_A, rng), pixel, radius, tilt, rng)


def _small(rng: Rng) -> Shot:
    camera, chain, seen = _one_plate(rng, (6.0, 9.0), _UPRIGHT)
    return _shot(camera, chain, [seen], rng)


def _middle(rng: Rng) -> Shot:
    camera, chain, seen = _one_plate(rng, (9.0, 150.0), _LEANING)
    return _shot(camera, chain, [seen], rng)


def _oblique(rng: Rng) -> Shot:
    camera, chain, seen = _one_plate(rng, _MIDDLE_PX, _OBLIQUE)
    return _shot(camera, chain, [seen], rng)


def _hidden(rng: Rng) -> Shot:
    camera, chain, seen = _one_plate(rng, _MIDDLE_PX, _LEANING)
    radiance = (0.3, 0.03, 0.85, None)[int(rng.integers(4))]
    obstacle = Obstacle(_quarter(rng), seen.pose, radiance)
    return _shot(camera, chain, [seen], rng, obstacles=[obstacle])


def _quarter(rng: Rng) -> ConvexPolygon | DiscRegion:
    """Return a shape that hides up to a quarter of the main ring's outer circle, on any side."""
    radius_m = 0.5 * TARGET_A.ring.outer_diameter_m
    half, way = math.radians(rng.uniform(36.0, 45.0)), rng.uniform(0.0, 2.0 * math.pi)
    kind = rng.integers(3)
    if kind == 0:  # a blob on the rim
        centre = radius_m * np.array([math.cos(way), math.sin(way)])
        return DiscRegion(
            (float(centre[0]), float(centre[1])), 2.0 * radius_m * math.sin(0.5 * half)
        )
    near = 0.45 if kind == 1 else math.cos(half)  # a wedge from inside the disc; a straight edge
    far, slope = rng.uniform(1.1, 2.5), math.tan(half)
    corners = [(near, -near * slope), (far, -far * slope), (far, far * slope), (near, near * slope)]
    turn = np.array([[math.cos(way), math.sin(way)], [-math.sin(way), math.cos(way)]])
    return polygon(list(radius_m * np.array(corners) @ turn))


def _cut(rng: Rng) -> Shot:
    """Let one or two borders of the frame cut the main ring, with the replica inside the frame."""
    camera, chain = random_camera(rng)
    radius = _log_uniform((40.0, 170.0), rng)
    size = np.array([camera.width, camera.height], dtype=np.float64)
    pixel = pixel_inside(camera, min(radius, 0.3 * float(size.min())), rng)
    first = int(rng.integers(2))
    for axis in (first, 1 - first) if rng.random() < 0.3 else (first,):
        beyond = radius * rng.uniform(0.2 * _REPLICA_MARGIN, 0.8) + 1.0
        pixel[axis] = beyond if rng.random() < 0.5 else size[axis] - 1.0 - beyond
    seen = place(camera, plate_of(TARGET_A, rng), pixel, radius, _UPRIGHT, rng)
    return _shot(camera, chain, [seen], rng)


def _large(rng: Rng) -> Shot:
    camera, chain = random_camera(rng)
    camera = halved(camera)
    size = min(camera.width, camera.height)
    radius = float(rng.uniform(0.34, 0.46)) * size
    pixel = pixel_inside(camera, radius, rng)
    seen = place(camera, plate_of(TARGET_A, rng), pixel, radius, _UPRIGHT, rng)
    return _shot(camera, chain, [seen], rng)


def _larger_than_frame(rng: Rng) -> Shot:
    camera, chain = random_camera(rng)
    camera = halved(camera)
    sides = np.array([camera.width, camera.height])
    radius = _log_uniform((0.6 * sides.min(), 1.1 * float(np.hypot(*sides))), rng)
    pixel = pixel_inside(camera, 0.2 * _REPLICA_MARGIN * radius, rng)
    seen = place(camera, plate_of(TARGET_A, rng), pixel, radius, _UPRIGHT, rng)
    return _shot(camera, chain, [seen], rng)


def _several(first: Target, second: Target) -> Planner:
    def plan(rng: Rng) -> Shot:
        camera, chain = random_camera(rng)
        plates = [plate_of(target, rng) for target in (first, second)]
        placed = place_apart(camera, plates, (10.0, 60.0), _LEANING, rng)
        return _shot(camera, chain, [plate for plate in placed if plate is not None], rng)

    return plan


def _decoys(rng: Rng) -> Shot:
    camera, chain = random_camera(rng)
    kinds = [str(kind) for kind in rng.choice(list(DECOYS), _DECOYS_PER_FRAME, replace=False)]
    plates = [DECOYS[kind](rng) for kind in kinds]
    placed = place_apart(camera, plates, (7.0, 70.0), _LEANING, rng)
    decoys = [(kind, seen) for kind, seen in zip(kinds, placed, strict=True) if seen is not None]
    return _shot(camera, chain, [], rng, decoys=decoys, gain=(0.5, 1.3))


def _shadow(rng: Rng) -> Shot:
    camera, chain, seen = _one_plate(rng, _MIDDLE_PX, _LEANING)
    side = regular_polygon(4, rng.uniform(0.7, 2.0))
    shadow = Obstacle(side, seen.pose, 0.0, opacity=float(rng.uniform(0.8, 0.94)))
    return _shot(camera, chain, [seen], rng, obstacles=[shadow])


def _burnt(rng: Rng) -> Shot:
    camera, chain, seen = _one_plate(rng, _MIDDLE_PX, _LEANING)
    return _shot(camera, chain, [seen], rng, gain=(1.5, 4.0))


def _hazy(rng: Rng) -> Shot:
    """Reduce the contrast to a tenth, at levels below those at which film curves flatten."""
    camera, chain, seen = _one_plate(rng, _MIDDLE_PX, _LEANING)
    veil = Veil(0.1 / (seen.plate.white - seen.plate.black), float(rng.uniform(0.1, 0.5)))
    return _shot(camera, chain, [seen], rng, veil=veil, gain=(1.0, 1.0))


def _blurred(rng: Rng) -> Shot:
    camera, chain, seen = _one_plate(rng, (12.0, 40.0), _LEANING)
    radius = 0.45 * camera.mean_focal_px / seen.pose.distance_m
    spread, length = radius * rng.uniform(0.06, 0.15), radius * rng.uniform(0.0, 0.25)
    way = rng.uniform(0.0, math.pi)
    optics = Optics(float(spread), (length * math.cos(way), length * math.sin(way)))
    return _shot(camera, chain, [seen], rng, optics=optics)


SETS = (
    FrameSet("small", _small, 0.95),
    FrameSet("middle", _middle),
    FrameSet("oblique", _oblique, 0.98),
    FrameSet("hidden", _hidden, 0.95),
    FrameSet("cut", _cut, 0.95),
    FrameSet("large", _large),
    FrameSet("larger", _larger_than_frame),
    FrameSet("two_targets", _several(TARGET_A, TARGET_B), 1.0),
    FrameSet("other_design", _several(TARGET_C, TARGET_A)),
    FrameSet("two_instances", _several(TARGET_A, TARGET_A)),
    FrameSet("shadow", _shadow),
    FrameSet("burnt", _burnt),
    FrameSet("haze", _hazy),
    FrameSet("blur", _blurred),
    FrameSet("decoys", _decoys),
)
SETS_BY_NAME = {frame_set.name: frame_set for frame_set in SETS}
