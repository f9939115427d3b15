"""Simulated photographs of a printed and lit field of targets from many directions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.simulation.disc_field import DiscCode, FieldScene, SimulatedDisc, field_irradiance
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.phone import Phone
from kgcp.targets.fields.layout import Field, FieldPolarity
from kgcp.targets.fields.points import AnyField, CodeRing, FieldPoint, PointField

_BORDER = 0.6  # from the outer discs' edges to that of the board, relative to the pitch
_PAPER, _INK = 0.8, 0.06  # radiance
_TILT_DEG = (15.0, 40.0)
_DISTANCE_RATIO = (1.03, 1.45)  # relative to the distance at which the board fills the frame
_TURN_SD_DEG = 6.0
_TURNED_PERIOD = 3  # every third photograph is turned by 90°
_ROUNDS = 60  # attempts to place the board in the frame
_MARGIN_PX = 4.0
_OPTICS, _SENSOR = Optics(0.7), Sensor()


@dataclass(frozen=True, slots=True)
class FieldSession:
    """Settings of the photographs."""

    camera: Camera  # the true camera, which a calibration has to recover
    field: AnyField  # as stated; printed discs deviate at random by `point_sds_m`
    photographs: int = 14
    optics: Optics = _OPTICS
    sensor: Sensor = _SENSOR
    gain: float = 1.0  # exposure relative to the one at which radiance 1 fills the well
    # largest decrease of the light over half the frame's width; its amount and direction are random
    fall: float = 0.15
    # whether the board has edges; without them, rendering is faster. Fields of points never have.
    has_edges: bool = True
    phone: Phone | None = None  # image processing; None: only the sensor's


@dataclass(frozen=True, slots=True, eq=False)
class FieldPhotograph:
    """One photograph with its truth."""

    grey: GreyArray  # (height, width), or (height, width, 3) of a phone
    pose: Pose  # field → camera


def printed_points(session: FieldSession, rng: np.random.Generator) -> FloatArray:
    """Return the true positions of the printed discs (m, 3), in the field's frame [m]."""
    stated = session.field.points_m()
    return np.asarray(stated + session.field.point_sds_m() * rng.standard_normal(stated.shape))


def field_photograph(
    session: FieldSession, points_m: FloatArray, number: int, rng: np.random.Generator
) -> FieldPhotograph:
    """Take one photograph of a field whose discs are at `points_m` (m, 3)."""
    discs = _discs(session.field, points_m)
    is_dark = session.field.polarity is FieldPolarity.DARK
    ground, ink = (_PAPER, _INK) if is_dark else (_INK, _PAPER)
    has_board = session.has_edges and isinstance(session.field, Field)
    board_m = _board_m(session.field)
    turn = rng.uniform(0.0, 2.0 * math.pi)
    fall_per_px = session.fall * rng.uniform() / (0.5 * session.camera.width)
    gradient = (fall_per_px * math.cos(turn), fall_per_px * math.sin(turn))
    scene = FieldScene(discs, ground, ink, gradient, board_m if has_board else None)
    pose = _pose(session.camera, _corners(session.field, board_m), number, rng)
    light = field_irradiance(session.camera, pose, scene, session.optics)
    if session.phone is not None:
        grey = session.phone.photograph(session.sensor, light, session.gain, rng)
    else:
        grey = session.sensor.expose(light, session.gain, rng)
    return FieldPhotograph(grey, pose)


def _discs(field: AnyField, points_m: FloatArray) -> tuple[SimulatedDisc, ...]:
    """Return the discs of a field at their true positions (m, 3)."""
    codes: list[DiscCode | None] = [None] * len(points_m)
    if isinstance(field, PointField) and field.code is not None:
        codes = [_code(point, field.code) for point in field.points]
    normals = field.normals()
    # normals must point into the board, because they define the sense of the codes
    normals = np.where(normals[:, 2:] < 0.0, -normals, normals)
    return tuple(
        SimulatedDisc((x, y, z), 2.0 * outer, 2.0 * hole, (u, v, w), code)
        for (x, y, z), (u, v, w), outer, hole, code in zip(
            points_m.tolist(),
            normals.tolist(),
            field.radii_m().tolist(),
            field.inner_radii_m().tolist(),
            codes,
            strict=True,
        )
    )


def _code(point: FieldPoint, ring: CodeRing) -> DiscCode | None:
    if point.code is None:
        return None
    bits = tuple(digit == "1" for digit in f"{point.code:0{ring.bits}b}")
    return DiscCode(ring.inner * point.diameter_m, ring.outer * point.diameter_m, bits)


def _corners(field: AnyField, board_m: tuple[float, float, float, float]) -> FloatArray:
    """Return the corners (n, 3) that a photograph must show, in the field's frame [m]."""
    left, top, right, bottom = board_m
    flat = [(left, top), (right, top), (right, bottom), (left, bottom)]
    depths = {0.0} if isinstance(field, Field) else {*field.points_m()[:, 2].tolist()}
    return np.array([(x, y, z) for z in sorted({min(depths), max(depths)}) for x, y in flat])


def _board_m(board: AnyField) -> tuple[float, float, float, float]:
    """Return the edges of the board: x and y of one corner and of the opposite one [m]."""
    points, radii = board.points_m()[:, :2], board.radii_m()[:, None]
    border_m = _BORDER * board.pitch_m
    left, top = (points - radii).min(axis=0) - border_m
    right, bottom = (points + radii).max(axis=0) + border_m
    return float(left), float(top), float(right), float(bottom)


def _pose(camera: Camera, corners: FloatArray, number: int, rng: np.random.Generator) -> Pose:
    """Return a tilted pose with all corners (n, 3) in the frame, at a random place."""
    middle = corners.mean(axis=0)
    quarter = 90.0 if number % _TURNED_PERIOD == _TURNED_PERIOD - 1 else 0.0
    turn = math.radians(quarter + _TURN_SD_DEG * rng.standard_normal())
    tilt, about = math.radians(rng.uniform(*_TILT_DEG)), rng.uniform(0.0, 2.0 * math.pi)
    axis = np.array((math.cos(about), math.sin(about), 0.0))
    rotation = rotation_about(tilt * axis) @ rotation_about(np.array((0.0, 0.0, turn)))
    around = (corners - middle) @ rotation.T
    distance_m = _fitting_distance_m(camera, around) * rng.uniform(*_DISTANCE_RATIO)
    aside = rng.uniform(-0.5, 0.5, 2) * np.array((camera.width, camera.height))
    centre_px = 0.5 * np.array((camera.width - 1, camera.height - 1))
    for step in range(_ROUNDS):
        place = camera.undistort(centre_px + aside * (1.0 - step / _ROUNDS))
        translation = distance_m * np.array((*place, 1.0))
        if _is_in_frame(camera, around + translation):
            break
    else:
        translation = np.array((0.0, 0.0, distance_m))
    return Pose(rotation, translation - rotation @ middle)


def _fitting_distance_m(camera: Camera, around: FloatArray) -> float:
    """Return the least distance at which the frame shows all corners, to a few per cent."""
    axis = np.array((*camera.undistort(0.5 * np.array((camera.width, camera.height))), 1.0))
    far_m = 100.0 * float(np.linalg.norm(around, axis=1).max())
    near_m = float(np.linalg.norm(around, axis=1).max())
    for _ in range(_ROUNDS // 3):
        between_m = math.sqrt(near_m * far_m)
        if _is_in_frame(camera, around + between_m * axis):
            far_m = between_m
        else:
            near_m = between_m
    return far_m


def _is_in_frame(camera: Camera, corners: FloatArray) -> bool:
    """Tell whether all corners and the midpoints between neighbours are in the frame."""
    outline = np.vstack((corners, 0.5 * (corners + np.roll(corners, 1, axis=0))))
    if outline[:, 2].min() <= 0.0:
        return False
    places = camera.project(outline)
    limits = np.array((camera.width, camera.height)) - 1.0 - _MARGIN_PX
    return bool(np.all((places >= _MARGIN_PX) & (places <= limits)))
