"""Slips of the pen, each as a change of a correct flight, and the cause that must be named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import rotation_from_opk
from kgcp.quality.checks.doubt import Cause
from tests.wrong_flights.flights import (
    CAMERA,
    TARGET,
    Flight,
    changed,
    drone_pictures,
    flight,
    scaled,
    with_receiver,
    without_reference,
)

_SIZE = ("fx", "fy", "cx", "cy")
_WEEK_S = 604_800.0


@dataclass(frozen=True)
class Slip:
    """A change of a correct flight.

    Attributes
    ----------
    causes : tuple of Cause
        Of which one must be named first.
    """

    make: Callable[[Flight], Flight]
    causes: tuple[Cause, ...]


def _slip(make: Callable[[Flight], Flight], *causes: Cause) -> Slip:
    return Slip(make, causes)


def _column(
    values: FloatArray, column: int, change: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    result = values.copy()
    result[:, column] = change(values[:, column])
    return result


def _vehicle(column: int, change: Callable[[FloatArray], FloatArray]) -> Callable[[Flight], Flight]:
    return lambda one: replace(one, vehicle=_column(one.vehicle, column, change))


def _without_satellites(one: Flight) -> Flight:
    """A receiver that repeats its position from the middle on, once a second."""
    vehicle = one.vehicle.copy()
    vehicle[220:, :3] = vehicle[220, :3]
    return replace(one, vehicle=vehicle[::10], vehicle_s=one.vehicle_s[::10])


def _reference(
    column: int, change: Callable[[FloatArray], FloatArray]
) -> Callable[[Flight], Flight]:
    def make(one: Flight) -> Flight:
        assert one.reference is not None
        return replace(one, reference=_column(one.reference, column, change))

    return make


def _swap_vehicle(one: Flight) -> Flight:
    return replace(one, vehicle=one.vehicle[:, [1, 0, 2, 3, 4, 5]])


def _swap_reference(one: Flight) -> Flight:
    assert one.reference is not None
    return replace(one, reference=one.reference[:, [1, 0, 2, 3, 4, 5]])


def _swap_both(one: Flight) -> Flight:
    swapped = _swap_vehicle(one)
    return swapped if one.reference is None else _swap_reference(swapped)


def _angles_in_radians(one: Flight) -> Flight:
    return replace(
        one, vehicle=np.column_stack((one.vehicle[:, :3], np.radians(one.vehicle[:, 3:])))
    )


def _opk(change: Callable[[FloatArray], FloatArray]) -> Callable[[Flight], Flight]:
    def make(one: Flight) -> Flight:
        assert one.reference is not None
        return replace(
            one, reference=np.column_stack((one.reference[:, :3], change(one.reference[:, 3:])))
        )

    return make


def _roll_pitch_yaw(opk_deg: FloatArray) -> FloatArray:
    """The same poses of cameras that look down; at 0, 0, 0 the top of the photo is north."""
    photo_from_body = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    rotation = photo_from_body @ rotation_from_opk(opk_deg) @ photo_from_body
    return Rotation.from_matrix(rotation).as_euler("ZYX", degrees=True)[:, ::-1]


def _late(seconds: float) -> Callable[[Flight], Flight]:
    return lambda one: replace(one, frame_s=one.frame_s + seconds)


def _late_vehicle(seconds: float) -> Callable[[Flight], Flight]:
    return lambda one: replace(one, vehicle_s=one.vehicle_s + seconds)


def _shift_times(one: Flight) -> Flight:
    return replace(one, frame_s=np.append(one.frame_s[1:], one.frame_s[-1] + 1.5))


def _shift_poses(one: Flight) -> Flight:
    assert one.reference is not None
    return replace(one, reference=np.roll(one.reference, 1, axis=0))


def _arm(*arm: float) -> Callable[[Flight], Flight]:
    return lambda one: replace(one, lever_arm_m=arm)


def _camera(camera: Mapping[str, float]) -> Callable[[Flight], Flight]:
    return lambda one: replace(one, camera=camera)


def _target(target: Mapping[str, float]) -> Callable[[Flight], Flight]:
    return lambda one: replace(one, target=target)


def _pictures(**changes: object) -> Callable[[Flight], Flight]:
    return lambda one: replace(one, pictures=drone_pictures(**changes))


def _mixed_pictures(tags: Mapping[str, object], every: int) -> Callable[[Flight], Flight]:
    def make(one: Flight) -> Flight:
        pictures = [
            {**picture, **(tags if index % every == 0 else {})}
            for index, picture in enumerate(drone_pictures())
        ]
        return replace(one, pictures=tuple(pictures))

    return make


def wgs84() -> Flight:
    """Return the sample flight in longitude and latitude."""
    return flight("EPSG:4326", (11.5491, 48.1509, 545.5))


def etrs89() -> Flight:
    """Return the sample flight in longitude and latitude of ETRS89."""
    return flight("EPSG:4258", (11.5491, 48.1509, 545.5))


ANYWAY: Mapping[str, Slip] = {
    "focal length in mm": _slip(_camera(changed(CAMERA, fx=8.8, fy=8.8)), Cause.FOCAL_LENGTH),
    "focal length in µm": _slip(_camera(changed(CAMERA, fx=8.8e4, fy=8.8e4)), Cause.FOCAL_LENGTH),
    "digits of fy exchanged": _slip(_camera(changed(CAMERA, fy=1091.0)), Cause.FOCAL_LENGTH),
    "principal point in mm": _slip(
        _camera(changed(CAMERA, cx=6.2, cy=-4.1)), Cause.PRINCIPAL_POINT
    ),
    "principal point from the centre": _slip(
        _camera(changed(CAMERA, cx=6.7, cy=-3.4)), Cause.PRINCIPAL_POINT
    ),
    "calibration of double size": _slip(
        _camera(scaled(CAMERA, 2.0, *_SIZE)), Cause.CALIBRATION_SIZE
    ),
    "calibration of half size": _slip(_camera(scaled(CAMERA, 0.5, *_SIZE)), Cause.CALIBRATION_SIZE),
    "width and height of double size": _slip(
        _camera(changed(CAMERA, width=2400, height=1800, cx=1200.0, cy=900.0)), Cause.FRAME_SIZE
    ),
    "width and height exchanged": _slip(
        _camera(changed(CAMERA, width=900, height=1200, cx=446.1, cy=606.2)), Cause.FRAME_SIZE
    ),
    "diameters in inches": _slip(_target(scaled(TARGET, 1.0 / 0.0254)), Cause.DIAMETERS),
    "diameters in decimetres": _slip(_target(scaled(TARGET, 10.0)), Cause.DIAMETERS),
    "headings by 180": _slip(_vehicle(5, lambda h: (h + 180.0) % 360.0), Cause.HEADING),
    "headings mathematical": _slip(_vehicle(5, lambda h: (90.0 - h) % 360.0), Cause.HEADING),
    "headings negative": _slip(_vehicle(5, lambda h: (-h) % 360.0), Cause.HEADING),
    "headings from east": _slip(_vehicle(5, lambda h: h - 90.0), Cause.HEADING),
    "headings zero": _slip(_vehicle(5, np.zeros_like), Cause.HEADING),
    "attitude in radians": _slip(_angles_in_radians, Cause.ANGLE_UNIT),
    "z axis up": _slip(_vehicle(3, lambda roll: roll + 180.0), Cause.ATTITUDE),
    "all x and y exchanged": _slip(_swap_both, Cause.AXES_SWAPPED),
    "another zone": _slip(lambda one: replace(one, crs="EPSG:2056"), Cause.CRS),
    "zone number in front": _slip(_vehicle(0, lambda x: x + 32e6), Cause.CRS),
    "frames in GPS time": _slip(_late(18.0), Cause.CLOCK),
    "frames in TAI": _slip(_late(37.0), Cause.CLOCK),
    "frames an hour late": _slip(_late(3600.0), Cause.CLOCK),
    "frames two hours early": _slip(_late(-7200.0), Cause.CLOCK),
    "frames a day late": _slip(_late(86_400.0), Cause.CLOCK),
    "trajectory a GPS week early": _slip(_late_vehicle(-_WEEK_S), Cause.CLOCK),
    "trajectory 1024 weeks early": _slip(_late_vehicle(-1024 * _WEEK_S), Cause.CLOCK),
    "trajectory in seconds of the GPS week": _slip(
        lambda one: replace(one, vehicle_s=one.vehicle_s % _WEEK_S), Cause.CLOCK
    ),
    "trajectory in seconds since 1980": _slip(_late_vehicle(-315_964_782.0), Cause.CLOCK),
    "trajectory in local time": _slip(_late_vehicle(7200.0), Cause.CLOCK),
    "trajectory of another drive": _slip(_late_vehicle(1000.0), Cause.NO_OVERLAP),
    "times of a fortnight later": _slip(_late(2 * _WEEK_S), Cause.CLOCK),
    "target below the vehicle": _slip(_arm(-0.8, 0.15, 1.95), Cause.LEVER_ARM),
    "lever arm of 20 m": _slip(_arm(-19.0, 0.15, -1.95), Cause.LEVER_ARM),
    "frames of two cameras": _slip(
        _mixed_pictures({"model": "L1D-20c", "focal_mm": 10.3}, 3), Cause.TWO_CAMERAS
    ),
    "frames of two zooms": _slip(_mixed_pictures({"focal_mm": 12.0}, 4), Cause.TWO_CAMERAS),
    "frames of two sizes": _slip(_mixed_pictures({"size": (1600, 1200)}, 2), Cause.FRAME_SIZE),
    "EXIF of half the focal length": _slip(_pictures(focal_35_mm=28.0), Cause.CALIBRATION_SIZE),
    "EXIF of another focal length": _slip(_pictures(focal_35_mm=85.0), Cause.FOCAL_LENGTH),
    "GPS of another place": _slip(_pictures(lonlat=(8.55, 47.37)), Cause.CAMERA_POSITION),
    "one epoch 50 m off": _slip(
        _vehicle(0, lambda x: x + 50.0 * (np.arange(len(x)) == 400)), Cause.TRAJECTORY_SPIKE
    ),
    "last position repeated": _slip(_without_satellites, Cause.TRAJECTORY_SPIKE),
}
"""With and without reference poses."""

WITH_REFERENCE: Mapping[str, Slip] = {
    "diameters are radii": _slip(_target(scaled(TARGET, 0.5)), Cause.DIAMETERS),
    "diameters are doubled": _slip(_target(scaled(TARGET, 2.0)), Cause.DIAMETERS),
    "diameters in feet": _slip(_target(scaled(TARGET, 1.0 / 0.3048)), Cause.DIAMETERS),
    "a target of another size": _slip(_target(scaled(TARGET, 0.95 / 0.9)), Cause.DISTANCE_SCALE),
    "a focal length of another zoom": _slip(
        _camera(scaled(CAMERA, 1.03, "fx", "fy")), Cause.DISTANCE_SCALE
    ),
    "a focal length 0.8 % too long": _slip(
        _camera(scaled(CAMERA, 1.008, "fx", "fy")), Cause.DISTANCE_SCALE
    ),
    "k1 and k2 of the opposite sign": _slip(
        _camera(changed(CAMERA, k1=0.081, k2=-0.064)), Cause.DISTORTION_SIGN
    ),
    "k1 of the opposite sign": _slip(_camera(changed(CAMERA, k1=0.081)), Cause.DISTORTION_SIGN),
    "cy counted upwards": _slip(
        _camera(changed(CAMERA, cx=630.0, cy=470.0)),
        Cause.PRINCIPAL_POINT,
        Cause.REFERENCE,
        Cause.CORRECTION,
    ),
    "lever arm reversed": _slip(_arm(0.8, -0.15, 1.95), Cause.LEVER_ARM),
    "lever arm forward, right exchanged": _slip(_arm(0.15, -0.8, -1.95), Cause.LEVER_ARM),
    "lever arm backwards": _slip(_arm(0.8, 0.15, -1.95), Cause.LEVER_ARM),
    "lever arm to the left": _slip(_arm(-0.8, -0.15, -1.95), Cause.LEVER_ARM, Cause.CORRECTION),
    "lever arm down": _slip(_arm(-0.8, 0.15, 1.95), Cause.LEVER_ARM),
    "lever arm half a metre short": _slip(
        _arm(-0.8, 0.15, -1.45), Cause.HEIGHTS, Cause.LEVER_ARM, Cause.CORRECTION
    ),
    "trajectory above the geoid": _slip(_vehicle(2, lambda z: z - 47.3), Cause.HEIGHTS),
    "reference above the geoid": _slip(_reference(2, lambda z: z - 47.3), Cause.HEIGHTS),
    "trajectory 18 s early": _slip(_late_vehicle(-18.0), Cause.CLOCK),
    "all 4.2 s late": _slip(_late(4.2), Cause.CLOCK),
    "all 0.6 s late": _slip(_late(0.6), Cause.CLOCK, Cause.CORRECTION),
    "all 50 ms late": _slip(_late(0.05), Cause.CORRECTION),
    "times of the next frame": _slip(_shift_times, Cause.FRAME_ORDER, Cause.CLOCK),
    "poses of the next frame": _slip(_shift_poses, Cause.FRAME_ORDER),
    "reference x and y exchanged": _slip(_swap_reference, Cause.AXES_SWAPPED),
    "trajectory x and y exchanged": _slip(_swap_vehicle, Cause.AXES_SWAPPED),
    "omega, phi, kappa in radians": _slip(_opk(np.radians), Cause.ANGLE_UNIT, Cause.REFERENCE),
    "omega, phi, kappa in gon": _slip(_opk(lambda opk: opk / 0.9), Cause.ANGLE_UNIT),
    "kappa turned by 90": _slip(_reference(5, lambda kappa: kappa + 90.0), Cause.REFERENCE),
    "kappa of the opposite sign": _slip(_reference(5, lambda kappa: -kappa), Cause.REFERENCE),
    "omega and phi exchanged": _slip(_opk(lambda opk: opk[:, [1, 0, 2]]), Cause.REFERENCE),
    "roll, pitch, yaw for omega, phi, kappa": _slip(_opk(_roll_pitch_yaw), Cause.REFERENCE),
    "poses of another place": _slip(_reference(0, lambda x: x + 20_000.0), Cause.REFERENCE),
    "another datum": _slip(
        lambda one: _reference(1, lambda y: y - 2.1)(_reference(0, lambda x: x + 1.3)(one)),
        Cause.CRS,
    ),
    "mount_deg": _slip(lambda one: replace(one, mount_deg=90.0), Cause.MOUNT),
    "mount_deg by 180": _slip(lambda one: replace(one, mount_deg=-180.0), Cause.MOUNT),
    "a few wrong frames": _slip(lambda one: replace(one, altered=(3, 11)), Cause.SINGLE_FRAMES),
}
"""What only reference poses can tell."""

WITHOUT_REFERENCE: Mapping[str, Slip] = {
    "radii, by the drone's height": _slip(
        lambda one: _target(scaled(TARGET, 0.5))(_pictures()(one)), Cause.DIAMETERS
    ),
    "doubled diameters, by the drone's height": _slip(
        lambda one: _target(scaled(TARGET, 2.0))(_pictures()(one)), Cause.DIAMETERS
    ),
    "latitude in x": _slip(lambda _: without_reference(_swap_both(etrs89())), Cause.AXES_SWAPPED),
    "latitude in x, by the drone's GPS": _slip(
        lambda _: without_reference(_pictures()(_swap_both(wgs84()))), Cause.AXES_SWAPPED
    ),
    "longitude in radians": _slip(
        lambda _: without_reference(
            replace(
                wgs84(),
                vehicle=np.column_stack(
                    (np.radians(wgs84().vehicle[:, :2]), wgs84().vehicle[:, 2:])
                ),
            )
        ),
        Cause.ANGLE_UNIT,
    ),
    "longitude for easting": _slip(
        lambda _: without_reference(replace(wgs84(), crs="EPSG:25832")), Cause.CRS
    ),
    "latitude in x, by the course": _slip(
        lambda _: without_reference(_swap_both(wgs84())), Cause.HEADING, Cause.AXES_SWAPPED
    ),
    "frames 5 s late, by the drone's GPS": _slip(
        lambda one: replace(
            one, pictures=with_receiver(flight()).pictures, frame_s=one.frame_s + 5
        ),
        Cause.CLOCK,
    ),
    "times in tenths of a second": _slip(
        lambda one: replace(one, frame_s=np.floor(10.0 * one.frame_s) / 10.0), Cause.COARSE_TIMES
    ),
    "times of the next frame, by EXIF": _slip(_shift_times, Cause.CLOCK, Cause.FRAME_ORDER),
}
"""What other things tell where there is no reference."""

PAIRS: tuple[tuple[str, str], ...] = (
    ("diameters are radii", "trajectory 18 s early"),
    ("diameters are radii", "lever arm down"),
    ("diameters are radii", "trajectory above the geoid"),
    ("diameters are radii", "headings by 180"),
    ("diameters are doubled", "lever arm reversed"),
    ("diameters in feet", "reference above the geoid"),
    ("diameters are radii", "frames an hour late"),
    ("diameters are radii", "kappa turned by 90"),
    ("k1 and k2 of the opposite sign", "trajectory above the geoid"),
    ("k1 and k2 of the opposite sign", "diameters are radii"),
    ("lever arm backwards", "trajectory above the geoid"),
    ("lever arm reversed", "omega, phi, kappa in radians"),
    ("lever arm to the left", "diameters are doubled"),
    ("kappa of the opposite sign", "reference above the geoid"),
    ("headings mathematical", "lever arm down"),
    ("all x and y exchanged", "headings by 180"),
    ("focal length in mm", "frames in TAI"),
    ("principal point in mm", "diameters in inches"),
    ("frames of two zooms", "GPS of another place"),
    ("attitude in radians", "trajectory above the geoid"),
    ("omega, phi, kappa in gon", "diameters are radii"),
)
"""Names of slips that are made at once."""
