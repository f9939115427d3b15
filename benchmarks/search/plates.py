"""Printed plates: the targets to search for, and decoys that must not be taken for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.simulation.plate import PrintedPlate
from kgcp.simulation.regions import DiscRegion, Region, rectangle, regular_polygon
from kgcp.targets.layout import Ring, Target
from kgcp.targets.validation import check_targets, codes_coincide

_CODE_A, _REPLICA_A = (0.0, 43.0, 78.0, 180.0), (10.0, 80.0, 150.0, 250.0, 290.0)
_MIN_GAP_DEG = 30.0  # between dots of random codes: more than the width of a dot
_MOST_DOTS = 7
_MOVED_DEG, _MOVED_LITTLE_DEG = 25.0, 10.0


def _target(name: str, code_deg: tuple[float, ...], replica_deg: tuple[float, ...] = ()) -> Target:
    ring = Ring(name, 0.9, 0.45, 0.9 / 1.4, 0.9 / 7.0, code_deg)
    return Target(ring, (ring.scaled(f"{name}-inner", 0.2, replica_deg),) if replica_deg else ())


TARGET_A = _target("A", _CODE_A, _REPLICA_A)
TARGET_B = _target("B", (0.0, 55.0, 130.0, 200.0, 285.0))
TARGET_C = Target(Ring("C", 0.6, 0.36, 0.48, 0.06, (0.0, 70.0, 160.0)))  # another design
TARGETS = (TARGET_A, TARGET_B, TARGET_C)
check_targets(TARGETS)


@dataclass(frozen=True, slots=True)
class PaintedPlate(PrintedPlate):
    """A plate that is not a coded target; its `target` only determines its size.

    Attributes
    ----------
    layers : tuple of (shape, ink)
        Shapes on the plate in the order of painting, and whether each is ink.
    """

    layers: tuple[tuple[Region, bool], ...] = ()

    def print_layers(self) -> Iterator[tuple[Region, float]]:
        """Yield shapes and radiances, in painting order."""
        for shape, ink in self.layers:
            yield shape, self.black if ink else self.white


def plate_of(target: Target, rng: np.random.Generator) -> PrintedPlate:
    """Return a target on a plate with random corners, margin, ink and paint."""
    radius_m = 0.5 * target.ring.outer_diameter_m
    outline = regular_polygon(int(rng.choice((4, 8, 24))), radius_m * rng.uniform(1.28, 1.42))
    white, black = rng.uniform(0.75, 0.9), rng.uniform(0.03, 0.09)
    return PrintedPlate(target, outline, float(white), float(black))


def _recoded(code_deg: tuple[float, ...], rng: np.random.Generator) -> PrintedPlate:
    return plate_of(_target("decoy", code_deg), rng)


def _random_code(count: int, rng: np.random.Generator) -> tuple[float, ...]:
    """Return directions of dots that are far enough apart and not those of a target."""
    while True:
        slack = 360.0 - count * _MIN_GAP_DEG
        shares = rng.dirichlet(np.ones(count)) * slack
        angles = np.cumsum(shares + _MIN_GAP_DEG) % 360.0
        decoy = _target("decoy", tuple(float(angle) for angle in angles))
        if not any(codes_coincide(decoy.ring, target.ring) for target in TARGETS):
            return decoy.ring.code_deg


def _other_code(rng: np.random.Generator) -> PrintedPlate:
    return _recoded(_random_code(int(rng.integers(1, _MOST_DOTS + 1)), rng), rng)


def _extra_dot(rng: np.random.Generator) -> PrintedPlate:
    free = [a for a in range(360) if _gap_deg(float(a), _CODE_A) >= _MIN_GAP_DEG]
    return _recoded((*_CODE_A, float(rng.choice(free))), rng)


def _gap_deg(angle: float, others: tuple[float, ...]) -> float:
    return float(np.abs((np.subtract(others, angle) + 180.0) % 360.0 - 180.0).min())


def _missing_dot(rng: np.random.Generator) -> PrintedPlate:
    gone = int(rng.integers(len(_CODE_A)))
    return _recoded(_CODE_A[:gone] + _CODE_A[gone + 1 :], rng)


def _mirrored(rng: np.random.Generator) -> PrintedPlate:
    return _recoded(tuple(-angle % 360.0 for angle in _CODE_A), rng)


def _moved_dot(rng: np.random.Generator) -> PrintedPlate:
    return _with_moved_dot(_MOVED_DEG, rng)


def _hardly_moved_dot(rng: np.random.Generator) -> PrintedPlate:
    return _with_moved_dot(_MOVED_LITTLE_DEG, rng)


def _with_moved_dot(step_deg: float, rng: np.random.Generator) -> PrintedPlate:
    while True:
        moved = int(rng.integers(len(_CODE_A)))
        others = _CODE_A[:moved] + _CODE_A[moved + 1 :]
        angle = (_CODE_A[moved] + rng.choice((-1.0, 1.0)) * step_deg) % 360.0
        if _gap_deg(float(angle), others) > 24.0:  # the dots do not touch
            return _recoded((*others, float(angle)), rng)


def _same_replica(rng: np.random.Generator) -> PrintedPlate:
    """Print another main ring around the replica that belongs to A."""
    return plate_of(_target("decoy", _random_code(4, rng), _REPLICA_A), rng)


def _plain_ring(rng: np.random.Generator) -> PrintedPlate:
    inner = rng.uniform(0.3, 0.7)
    return _painted(
        rng, (DiscRegion((0.0, 0.0), 0.45), True), (DiscRegion((0.0, 0.0), 0.45 * inner), False)
    )


def _painted(rng: np.random.Generator, *layers: tuple[Region, bool]) -> PrintedPlate:
    plate = plate_of(TARGET_A, rng)
    return PaintedPlate(plate.target, plate.outline, plate.white, plate.black, layers)


def _bull_s_eye(rng: np.random.Generator) -> PrintedPlate:
    radii = np.cumsum(rng.dirichlet(np.ones(5)) + 0.1)[::-1]
    radii *= 0.45 / radii[0]
    return _painted(
        rng, *((DiscRegion((0.0, 0.0), float(r)), index % 2 == 0) for index, r in enumerate(radii))
    )


def _negative(rng: np.random.Generator) -> PrintedPlate:
    """Print A in white on black, with a black rim outside."""
    ring = TARGET_A.ring
    dots = [
        (DiscRegion((float(x), float(y)), 0.5 * ring.dot_diameter_m), True)
        for x, y in ring.dot_centres_m()
    ]
    return _painted(
        rng,
        (DiscRegion((0.0, 0.0), 0.6), True),
        (DiscRegion((0.0, 0.0), 0.45), False),
        (DiscRegion((0.0, 0.0), 0.225), True),
        *dots,
    )


def _spokes(rng: np.random.Generator) -> PrintedPlate:
    """Print a ring that is crossed by bars: a wheel, or a circular bar code."""
    bars = [
        (rectangle((0.0, 0.0), 0.9, rng.uniform(0.03, 0.12), direction), False)
        for direction in rng.uniform(0.0, 180.0, int(rng.integers(1, 4)))
    ]
    return _painted(
        rng, (DiscRegion((0.0, 0.0), 0.45), True), *bars, (DiscRegion((0.0, 0.0), 0.225), False)
    )


def _other_proportions(rng: np.random.Generator) -> PrintedPlate:
    """Print A's code on a ring of other proportions."""
    inner = float(rng.choice((0.25, 0.68)))
    middle = 0.5 * (1.0 + inner)
    dot = min(
        0.5 * (1.0 - inner) * rng.uniform(0.6, 0.95), 0.29 * middle
    )  # inside the ring, without touching each other
    ring = Ring("decoy", 0.9, 0.9 * inner, 0.9 * middle, 0.9 * dot, _CODE_A)
    return plate_of(Target(ring), rng)


DECOYS: dict[str, Callable[[np.random.Generator], PrintedPlate]] = {
    "other code": _other_code,
    "extra dot": _extra_dot,
    "missing dot": _missing_dot,
    "mirrored": _mirrored,
    "dot moved by 25°": _moved_dot,
    "dot moved by 10°": _hardly_moved_dot,
    "A's replica in another ring": _same_replica,
    "plain ring": _plain_ring,
    "bull's eye": _bull_s_eye,
    "negative": _negative,
    "spokes": _spokes,
    "other proportions": _other_proportions,
}
