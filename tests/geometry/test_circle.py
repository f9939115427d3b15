from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import (
    circle_distance,
    circle_planes,
    conic_of_circle,
    conic_on_plate,
    kim_centre,
    minimise_dispersion,
    pose_on_plane,
)
from kgcp.geometry.conic import chord, ellipse_from_conic, sampson_distance
from kgcp.geometry.pose import Pose, image_heading_deg

RADIUS_M = 0.45
GAMMAS = np.linspace(0.0, math.pi, 13, endpoint=False)


def pose_of(x: float, y: float, distance: float, tilt_deg: float, way: float, turn: float) -> Pose:
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([math.cos(way), math.sin(way), 0]))
    rotation = tilt.as_matrix() @ Rotation.from_euler("z", turn).as_matrix()
    return Pose(rotation, distance * np.array([x, y, 1.0]))


poses = st.builds(
    pose_of,
    x=st.floats(-0.35, 0.35),
    y=st.floats(-0.25, 0.25),
    distance=st.floats(4.0, 110.0),
    tilt_deg=st.floats(0.0, 50.0),
    way=st.floats(0.0, 6.28),
    turn=st.floats(0.0, 6.28),
)


def image_centre(pose: Pose) -> FloatArray:
    return np.asarray(pose.translation_m[:2] / pose.translation_m[2])


@given(poses)
def test_all_diameters_through_the_centre_give_the_distance(pose: Pose) -> None:
    conic = conic_of_circle(pose, RADIUS_M)
    distances = RADIUS_M * circle_distance(image_centre(pose), GAMMAS, conic)
    np.testing.assert_allclose(distances, pose.distance_m, rtol=1e-7)


def test_the_distance_equals_eq_5_as_printed() -> None:
    theta1, theta2 = 0.031, 0.027
    printed = (
        math.sqrt(2.0)
        * math.sin(theta1 + theta2)
        / math.sqrt(
            3.0
            - 2.0 * math.cos(2.0 * theta1)
            - 2.0 * math.cos(2.0 * theta2)
            + math.cos(2.0 * (theta1 + theta2))
        )
    )
    # A diameter in the xz plane seen under θ1 and θ2: OA sin θ1 = OB sin θ2, AB = 2.
    a, b = (
        np.array([-math.sin(theta1), math.cos(theta1)]) * math.sin(theta2),
        np.array([math.sin(theta2), math.cos(theta2)]) * math.sin(theta1),
    )
    assert printed == pytest.approx(float(np.linalg.norm(a + b) / np.linalg.norm(a - b)), rel=1e-9)


@given(poses)
def test_kim_centre_is_the_projected_centre(pose: Pose) -> None:
    outer, inner = conic_of_circle(pose, RADIUS_M), conic_of_circle(pose, 0.5 * RADIUS_M)
    np.testing.assert_allclose(kim_centre(outer, inner), image_centre(pose), atol=1e-9)


@given(poses)
def test_one_of_two_planes_is_the_plate_and_both_are_at_its_distance(pose: Pose) -> None:
    planes = circle_planes(conic_of_circle(pose, RADIUS_M))
    errors = [float(np.linalg.norm(RADIUS_M * p.centre - pose.translation_m)) for p in planes]
    truth = planes[int(np.argmin(errors))]
    # A nearly frontal circle's ellipse hardly has an axis: half the digits are left.
    np.testing.assert_allclose(RADIUS_M * truth.centre, pose.translation_m, rtol=1e-6, atol=1e-4)
    assert abs(float(truth.normal @ pose.normal)) > 1.0 - 1e-9
    for plane in planes:
        assert RADIUS_M * np.linalg.norm(plane.centre) == pytest.approx(pose.distance_m, rel=1e-7)


def dispersion(centre: FloatArray, conic: FloatArray) -> float:
    """D(C') of eq. 13, in units of the radius."""
    return float(np.std(circle_distance(centre, GAMMAS, conic)))


@pytest.mark.parametrize("tilt_deg", [8.0, 25.0, 45.0])
def test_the_closed_form_gives_both_minima_of_the_dispersion(tilt_deg: float) -> None:
    conic = conic_of_circle(pose_of(0.1, 0.2, 15.0, tilt_deg, 2.0, 0.0), RADIUS_M)
    radius = ellipse_from_conic(conic).mean_radius
    for plane in circle_planes(conic):
        beside = plane.image_centre + 0.01 * radius
        assert dispersion(plane.image_centre, conic) < 1e-8
        assert dispersion(beside, conic) > 1e-3


@pytest.mark.parametrize("which", [0, 1])
def test_the_minimisation_converges_to_the_nearer_minimum(which: int) -> None:
    conic = conic_of_circle(pose_of(-0.2, 0.1, 15.0, 35.0, 0.5, 0.0), RADIUS_M)
    wanted = circle_planes(conic)[which].image_centre
    radius = ellipse_from_conic(conic).mean_radius
    found = minimise_dispersion(conic, wanted + radius * np.array([2e-3, -1e-3]))
    np.testing.assert_allclose(found, wanted, atol=1e-9 * radius)


@settings(deadline=None, max_examples=50)  # a minimisation takes as long as it takes
@given(poses, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_the_minimisation_never_ends_outside_the_valley(pose: Pose, dx: float, dy: float) -> None:
    conic = conic_of_circle(pose, RADIUS_M)
    radius = ellipse_from_conic(conic).mean_radius
    found = minimise_dispersion(conic, image_centre(pose) + radius * np.array([dx, dy]))
    first, second = (plane.image_centre for plane in circle_planes(conic))
    detour = np.linalg.norm(found - first) + np.linalg.norm(found - second)
    assert detour - np.linalg.norm(first - second) < 2e-3 * radius


def diameter_tilts_rad(centre: FloatArray, conic: FloatArray) -> tuple[float, float]:
    """φ and θ of eqs. 6-11: the tilts of the diameters whose images are parallel to y and to x.

    The law of sines gives OB (eqs. 6-9) as 2 OC sin θ1 / sin(θ1 + θ2), without the two solutions
    of an arc sine.
    """
    gammas = np.array([0.5 * math.pi, 0.0])
    ray_a, ray_b, ray_c = (
        rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        for rays in (
            np.pad(points, ((0, 0), (0, 1)), constant_values=1.0)
            for points in (*chord(conic, centre, gammas), centre[None])
        )
    )
    theta1, theta2 = (
        np.arcsin(np.linalg.norm(np.cross(ray, ray_c), axis=-1)) for ray in (ray_a, ray_b)
    )
    distance = circle_distance(centre, gammas, conic)
    length_b = 2.0 * distance * np.sin(theta1) / np.sin(theta1 + theta2)
    half = length_b[:, None] * ray_b - distance[:, None] * ray_c  # eq. 10
    return math.atan2(half[0, 2], half[0, 1]), math.atan2(half[1, 2], half[1, 0])


@given(poses)
def test_the_paper_s_angles_are_those_of_the_plate_s_diameters(pose: Pose) -> None:
    centre = image_centre(pose)
    phi, theta = diameter_tilts_rad(centre, conic_of_circle(pose, RADIUS_M))
    # The camera and the image line parallel to y span a plane: it cuts the plate in n × (1, 0, -x).
    along_y = np.cross(pose.normal, [1.0, 0.0, -centre[0]])
    along_x = np.cross([0.0, 1.0, -centre[1]], pose.normal)
    assert phi == pytest.approx(math.atan2(along_y[2], along_y[1]), abs=1e-6)
    assert theta == pytest.approx(math.atan2(along_x[2], along_x[0]), abs=1e-6)


def test_on_the_optical_axis_the_paper_s_angles_are_those_of_the_table() -> None:
    pose = pose_of(0.0, 0.0, 12.0, 20.0, 0.8, 1.0)
    phi, theta = diameter_tilts_rad(np.zeros(2), conic_of_circle(pose, RADIUS_M))
    assert math.degrees(phi) == pytest.approx(pose.roll_deg, abs=1e-6)
    assert math.degrees(theta) == pytest.approx(pose.pitch_deg, abs=1e-6)


@given(poses)
def test_pose_follows_from_plane_and_one_direction(pose: Pose) -> None:
    planes = circle_planes(conic_of_circle(pose, RADIUS_M))
    on_axis = pose.transform(np.array([0.3, 0.0]))
    rebuilt = [pose_on_plane(plane, RADIUS_M, on_axis[:2] / on_axis[2]) for plane in planes]
    best = min(rebuilt, key=lambda other: float(np.linalg.norm(other.rotation - pose.rotation)))
    np.testing.assert_allclose(best.rotation, pose.rotation, atol=1e-4)
    assert np.linalg.det(best.rotation) == pytest.approx(1.0)


def test_conics_map_to_the_plate_and_back() -> None:
    pose = pose_of(0.15, -0.2, 9.0, 28.0, 4.0, 2.0)
    back = ellipse_from_conic(conic_on_plate(pose, conic_of_circle(pose, 0.21)))
    np.testing.assert_allclose([back.x, back.y, back.a, back.b], [0.0, 0.0, 0.21, 0.21], atol=1e-9)
    ring = pose.transform(0.21 * np.column_stack((np.cos(GAMMAS), np.sin(GAMMAS))))
    conic = conic_of_circle(pose, 0.21)
    assert np.abs(sampson_distance(conic, ring[:, :2] / ring[:, 2:])).max() < 1e-12


def test_image_heading_is_the_direction_of_a_short_step_along_x() -> None:
    camera = Camera(1600, 1000, 1500.0, 1510.0, 790.0, 510.0, k1=-0.1, k2=0.05, p1=1e-3)
    pose = pose_of(0.3, -0.2, 20.0, 30.0, 1.1, 2.2)
    start, end = camera.project(pose.transform(np.array([[0.0, 0.0], [1e-6, 0.0]])))
    step = end - start
    wanted = math.degrees(math.atan2(step[1], step[0]))
    assert image_heading_deg(camera, pose) == pytest.approx(wanted, abs=1e-3)
    turned = pose.turned(10.0)
    np.testing.assert_allclose(turned.normal, pose.normal, atol=1e-12)
    assert math.degrees(math.acos(turned.rotation[:, 0] @ pose.rotation[:, 0])) == pytest.approx(10)
