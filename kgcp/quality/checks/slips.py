"""Slips in a flight's inputs that would explain why vehicle and camera disagree.

Each slip has a function that undoes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.errors import Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, rotation_from_opk
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import circle_planes
from kgcp.geometry.conic import fit_ellipse
from kgcp.georef.trajectory import ENU_FROM_NED, body_to_ned
from kgcp.quality.checks.clock import clock_shifts_s
from kgcp.quality.checks.course import READINGS
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.encounters import Encounters

_MIN_COMPONENT_M = 0.02  # of a lever arm; the sign of a shorter one does not matter
_CIRCLE_RATIO = 0.01  # radius of an auxiliary circle over its distance
_UNIT_CIRCLE = np.column_stack([f(2.0 * np.pi * np.arange(16) / 16) for f in (np.cos, np.sin)])
_OF_VEHICLE = frozenset({"clock", "attitude", "lever arm"})
_AXES = ("forward", "right", "down")


@dataclass(frozen=True, slots=True, eq=False)
class Slip:
    """One possible slip."""

    code: Cause
    group: str  # slips of one group exclude each other
    words: str  # what seems to be wrong
    remedy: str  # beginning with a verb
    # returns the encounters as they would be without the slip
    undone: Callable[[Encounters], Encounters]

    @property
    def is_of_vehicle(self) -> bool:
        """Whether it changes the target's position by the vehicle, and not that by the camera."""
        return self.group in _OF_VEHICLE


def slips(encounters: Encounters) -> Iterator[Slip]:
    """Yield the slips that are possible in a flight, the likelier first."""
    yield from _of_diameters()
    yield from _of_lever_arm(encounters)
    for words, remedy, convert in READINGS:
        code = Cause.ANGLE_UNIT if "radians" in words or "gon" in words else Cause.HEADING
        yield Slip(code, "attitude", f"headings seem to be {words}", remedy, _with_heading(convert))
    for shift_s, words in clock_shifts_s():
        if encounters.is_covered(encounters.time_s + shift_s):
            yield clock_slip(shift_s, words)
    yield from _of_camera(encounters.camera)
    yield from _of_frame_order()
    yield from _of_reference()


def _of_diameters() -> Iterator[Slip]:
    for factor, words, remedy in (
        (2.0, "diameters seem to be radii", "double the diameters in [[target]]"),
        (
            0.5,
            "diameters seem to be twice as large as they should be",
            "halve the diameters in [[target]]",
        ),
        (0.3048, "diameters seem to be in feet", "give the diameters in metres"),
        (0.0254, "diameters seem to be in inches", "give the diameters in metres"),
        (0.1, "diameters seem to be in decimetres", "give the diameters in metres"),
        (0.01, "diameters seem to be in centimetres", "give the diameters in metres"),
        (0.001, "diameters seem to be in millimetres", "give the diameters in metres"),
        (10.0, "diameters seem to be ten times too small", "give the diameters in metres"),
    ):
        yield Slip(Cause.DIAMETERS, "distance", words, remedy, _scaled(factor))


def _scaled(factor: float) -> Callable[[Encounters], Encounters]:
    return lambda encounters: replace(encounters, in_camera_m=factor * encounters.in_camera_m)


def _of_lever_arm(encounters: Encounters) -> Iterator[Slip]:
    arm = encounters.lever_arm_m
    turns = sorted(product((1.0, -1.0), repeat=3), key=lambda signs: (sum(signs) != 1.0, signs))
    for signs in turns:
        turned = [index for index, sign in enumerate(signs) if sign < 0.0]
        if not turned or any(abs(arm[index]) < _MIN_COMPONENT_M for index in turned):
            continue
        names = " and ".join(_AXES[index] for index in turned)
        words = f"the sign of lever_arm_m ({names}) seems to be wrong"
        if len(turned) == 3:
            words = "lever_arm_m seems to be from the target to the trajectory point, not to it"
        yield _arm_slip(words, np.array(signs) * arm)
    yield _arm_slip("forward and right of lever_arm_m seem to be exchanged", arm[[1, 0, 2]])
    yield _arm_slip("lever_arm_m seems to be in feet", 0.3048 * arm)
    yield _arm_slip("lever_arm_m seems to be in decimetres", 0.1 * arm)
    if abs(arm[0] + arm[1]) > _MIN_COMPONENT_M:
        swapped = np.array([arm[1], arm[0], -arm[2]])
        yield _arm_slip("lever_arm_m seems to be right, forward, up", swapped)


def _arm_slip(words: str, arm: FloatArray) -> Slip:
    values = ", ".join(f"{value:.4g}" for value in arm.tolist())
    return Slip(
        Cause.LEVER_ARM,
        "lever arm",
        words,
        f"give lever_arm_m = [{values}] (forward, right, down)",
        lambda encounters: replace(encounters, lever_arm_m=arm),
    )


def _with_heading(
    convert: Callable[[FloatArray], FloatArray],
) -> Callable[[Encounters], Encounters]:
    def undone(encounters: Encounters) -> Encounters:
        attitude = encounters.attitude_deg.copy()
        attitude[:, 2] = convert(attitude[:, 2])
        return replace(encounters, attitude_deg=attitude)

    return undone


def clock_slip(shift_s: float, words: str) -> Slip:
    """Return the slip of clocks that differ by `shift_s`, which is to be added to frame times."""
    return Slip(
        Cause.CLOCK,
        "clock",
        f"{words} (frames {abs(shift_s):.6g} s {'early' if shift_s > 0.0 else 'late'})",
        f"correct the times file or [vehicle] time_system, or add {shift_s:.6g} s to [vehicle]"
        " time_offset_s",
        lambda encounters: encounters.at(encounters.time_s + shift_s),
    )


def _of_camera(camera: Camera) -> Iterator[Slip]:
    """Yield slips of a calibration: of frame size, focal length, signs and axes."""
    for factor, word in ((0.5, "double"), (2.0, "half")):
        resized = replace(
            camera,
            fx=factor * camera.fx,
            fy=factor * camera.fy,
            cx=min(max(factor * camera.cx, 0.0), camera.width),
            cy=min(max(factor * camera.cy, 0.0), camera.height),
        )
        yield Slip(
            Cause.CALIBRATION_SIZE,
            "camera",
            f"the calibration seems to be of frames of {word} size",
            f"give the calibration of frames of {camera.width} x {camera.height} px",
            _with_camera(resized),
        )
        zoomed = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        yield Slip(
            Cause.FOCAL_LENGTH,
            "camera",
            f"fx and fy seem to be {'twice' if factor < 1.0 else 'half'} the camera's",
            f"look fx and fy up in the calibration: {zoomed.fx:g} and {zoomed.fy:g} would fit",
            _with_camera(zoomed),
        )
    if any((camera.k1, camera.k2, camera.k3)):
        turned = replace(camera, k1=-camera.k1, k2=-camera.k2, k3=-camera.k3)
        yield Slip(
            Cause.DISTORTION_SIGN,
            "camera",
            "k1, k2 … seem to have the opposite sign, as in models that undo distortion instead of"
            " describing it",
            "give OpenCV's k1, k2 …, or name the calibration's own file in [camera] file",
            _with_camera(turned),
        )
        first = replace(camera, k1=-camera.k1)
        yield Slip(
            Cause.DISTORTION_SIGN,
            "camera",
            "k1 seems to have the opposite sign",
            "give OpenCV's k1, or name the calibration's own file in [camera] file",
            _with_camera(first),
        )
    rectified = without_distortion(camera)
    if camera != rectified:
        yield Slip(
            Cause.DISTORTION,
            "camera",
            "the frames seem to be rectified, but the camera has distortion",
            "if they are, give the raw frames, or name the camera of the rectified ones; if not,"
            " look k1, k2 … up in the calibration",
            _with_camera(rectified),
        )
    mirrored = {
        "x and y": {"cx": camera.width - 1 - camera.cx, "cy": camera.height - 1 - camera.cy},
        "y": {"cx": camera.cx, "cy": camera.height - 1 - camera.cy},
        "x": {"cx": camera.width - 1 - camera.cx, "cy": camera.cy},
    }
    for axis, point in mirrored.items():
        yield Slip(
            Cause.PRINCIPAL_POINT,
            "camera",
            f"the principal point seems to be counted in the opposite direction of {axis}",
            f"try cx = {point['cx']:.6g}, cy = {point['cy']:.6g}",
            _with_camera(replace(camera, cx=point["cx"], cy=point["cy"])),
        )


def without_distortion(camera: Camera) -> Camera:
    """Return the camera of frames that are rectified for this one."""
    return replace(camera, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)


def _with_camera(camera: Camera) -> Callable[[Encounters], Encounters]:
    return lambda encounters: remeasured(encounters, camera)


def remeasured(encounters: Encounters, camera: Camera) -> Encounters:
    """Return what would have been measured with another camera in the same images.

    A small circle at the plate is projected into the image by the one camera, and its ellipse is
    projected back into space by the other. NaN if the other camera has no rays for these pixels.
    """
    positions = encounters.in_camera_m.copy()
    for index, (position, rotation) in enumerate(
        zip(encounters.in_camera_m, encounters.camera_from_plate, strict=True)
    ):
        radius_m = _CIRCLE_RATIO * float(np.linalg.norm(position))
        circle = radius_m * _UNIT_CIRCLE @ rotation[:, :2].T + position
        points = camera.undistort(encounters.camera.project(circle))
        positions[index] = np.nan
        if np.isfinite(points).all():
            positions[index] = _circle_centre(points, radius_m, rotation[:, 2])
    return replace(encounters, in_camera_m=positions, camera=camera)


def _circle_centre(points: FloatArray, radius_m: float, normal: FloatArray) -> FloatArray:
    """Return the centre of a circle from its normalised image points (n, 2).

    Of the two solutions, the one whose normal is closer to `normal` is taken.
    """
    try:
        planes = circle_planes(fit_ellipse(points))
    except Rejection:
        return np.full(3, np.nan)
    plane = max(planes, key=lambda plane: float(plane.normal @ normal))
    return radius_m * plane.centre


def _of_frame_order() -> Iterator[Slip]:
    for step, word in ((1, "next"), (-1, "previous")):
        yield Slip(
            Cause.FRAME_ORDER,
            "clock",
            f"frames seem to have the time of the {word} frame",
            "check that every line of the times file has the time of the frame it names",
            _with_times_of_neighbours(-step),
        )
        yield Slip(
            Cause.FRAME_ORDER,
            "reference",
            f"frames seem to have the reference pose of the {word} frame",
            "check that every pose has the name of its frame",
            _with_poses_of_neighbours(-step),
        )


def _with_times_of_neighbours(step: int) -> Callable[[Encounters], Encounters]:
    def undone(encounters: Encounters) -> Encounters:
        moved = np.roll(encounters.time_s, -step)
        moved[-1 if step > 0 else 0] = np.nan
        return encounters.at(moved)

    return undone


def _with_poses_of_neighbours(step: int) -> Callable[[Encounters], Encounters]:
    def undone(encounters: Encounters) -> Encounters:
        """Return the encounters, each with the pose of the frame `step` later."""
        centre = np.roll(encounters.centre_m, -step, axis=0)
        centre[-1 if step > 0 else 0] = np.nan
        return replace(
            encounters,
            centre_m=centre,
            enu_from_camera=np.roll(encounters.enu_from_camera, -step, axis=0),
        )

    return undone


def _of_reference() -> Iterator[Slip]:
    for turn_deg in (180.0, 90.0, -90.0):
        yield Slip(
            Cause.REFERENCE,
            "reference",
            f"kappa of the reference poses seems to be rotated by {turn_deg:g}°",
            "check which image axis kappa refers to, and whether frames were rotated",
            _with_turn(turn_deg),
        )
    for factor, unit in ((np.degrees(1.0), "radians"), (0.9, "gon")):
        yield Slip(
            Cause.ANGLE_UNIT,
            "reference",
            f"omega, phi, kappa of the reference poses seem to be in {unit}",
            "give them in degrees",
            _with_angles(_opk_times(factor * np.eye(3))),
        )
    for signs, word in (
        ((1.0, 1.0, -1.0), "the sign of kappa"),
        ((-1.0, -1.0, 1.0), "the signs of omega and phi"),
        ((-1.0, -1.0, -1.0), "all signs of omega, phi and kappa"),
    ):
        yield Slip(
            Cause.REFERENCE,
            "reference",
            f"{word} of the reference poses seem{'s' if word.startswith('the sign ') else ''}"
            " to be reversed",
            "give omega, phi, kappa of R = Rx(omega) Ry(phi) Rz(kappa), camera to map",
            _with_angles(_opk_times(np.diag(signs))),
        )
    yield Slip(
        Cause.REFERENCE,
        "reference",
        "omega and phi of the reference poses seem to be exchanged",
        "exchange the two columns",
        _with_angles(_opk_times(np.eye(3)[[1, 0, 2]])),
    )
    yield Slip(
        Cause.REFERENCE,
        "reference",
        "omega, phi, kappa of the reference poses seem to be roll, pitch and yaw",
        "convert them, or name the adjustment's own file in [reference] poses",
        _with_angles(_as_of_vehicle),
    )


def _with_turn(turn_deg: float) -> Callable[[Encounters], Encounters]:
    turn = Rotation.from_euler("Z", turn_deg, degrees=True).as_matrix()
    return lambda encounters: replace(encounters, enu_from_camera=encounters.enu_from_camera @ turn)


def _with_angles(
    map_from_photo: Callable[[FloatArray], FloatArray],
) -> Callable[[Encounters], Encounters]:
    """Return the slip's reverse, by rotations (n, 3, 3) from the angles of the poses (n, 3)."""

    def undone(encounters: Encounters) -> Encounters:
        # the rotation from the map's axes to ENU does not depend on how the angles are read
        own = rotation_from_opk(encounters.opk_deg) @ CAMERA_FROM_PHOTO
        enu_from_map = encounters.enu_from_camera @ np.swapaxes(own, 1, 2)
        other = map_from_photo(encounters.opk_deg) @ CAMERA_FROM_PHOTO
        return replace(encounters, enu_from_camera=enu_from_map @ other)

    return undone


def _opk_times(factors: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return the rotations by omega, phi, kappa times a matrix (3, 3)."""
    return lambda opk_deg: rotation_from_opk(opk_deg @ factors)


def _as_of_vehicle(rpy_deg: FloatArray) -> FloatArray:
    """Return rotations (n, 3, 3) of photos from roll, pitch, yaw; at 0, the top is in the north."""
    # photos that look down have x right, y forward, z up, like ENU; vehicles have axes like NED
    return np.asarray(ENU_FROM_NED @ body_to_ned(*rpy_deg.T) @ ENU_FROM_NED.T)
