"""Moments of circles' images against plain integration, and derivatives against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import conic_of_circle
from kgcp.geometry.circle_image import (
    CircleDerivatives,
    Circles3D,
    circle_derivatives,
    circle_images,
    eccentricity,
    moments_jacobian_by_calibration,
)
from kgcp.geometry.conic import ellipse_from_conic
from kgcp.geometry.pose import Pose, rotation_about

CAMERA = Camera(640, 480, 610.0, 605.0, 322.3, 236.1, -0.2, 0.07, 0.001, -0.0007, 0.01)
RADII = np.array([0.02, 0.05, 0.01])
CENTRES = np.array([[0.1, -0.05, 0.5], [-0.2, 0.12, 0.6], [0.0, 0.0, 0.4]])
TURNS = np.array([[0.5, -0.3, 0.1], [-0.4, 0.6, 0.0], [0.2, 0.1, -0.8]])


def circles() -> Circles3D:
    axes = np.stack([rotation_about(turn)[:, :2] for turn in TURNS])
    return Circles3D(CENTRES, axes, RADII)


def pixels(plane: FloatArray, i: int) -> FloatArray:
    points = plane @ circles().axes[i].T + CENTRES[i]
    return CAMERA.project(points.reshape(-1, 3)).reshape(plane.shape)


def test_moments_equal_numerical_integration() -> None:
    """Rings of quadrature nodes over the circle, mapped to pixels by the Jacobian determinant."""
    images = circle_images(CAMERA, circles())
    nodes, weights = np.polynomial.legendre.leggauss(24)
    radius, of_radius = 0.5 * (nodes + 1.0), 0.5 * weights
    turn = 2.0 * np.pi * np.arange(64) / 64
    unit = np.stack((np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn))), axis=-1)
    for i, radius_m in enumerate(RADII):
        step = 1e-6 * radius_m
        along_x = pixels(radius_m * unit + [step, 0.0], i) - pixels(
            radius_m * unit - [step, 0.0], i
        )
        along_y = pixels(radius_m * unit + [0.0, step], i) - pixels(
            radius_m * unit - [0.0, step], i
        )
        scale = np.abs(along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0])
        mass = scale * (radius * of_radius)[:, None]
        mass /= mass.sum()
        places = pixels(radius_m * unit, i)
        mean = np.einsum("rt,rtj->j", mass, places)
        off = places - mean
        spread = np.einsum("rt,rti,rtj->ij", mass, off, off)
        assert images.moments[i, :2] == pytest.approx(mean, abs=1e-7)
        assert images.moments[i, 2:] == pytest.approx(spread[[0, 0, 1], [0, 1, 1]], rel=1e-7)


def test_without_distortion_the_image_is_the_conic() -> None:
    ideal = replace(CAMERA, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, fx=610.0, fy=610.0)
    images, split = circle_images(ideal, circles()), eccentricity(ideal, circles())
    for i, turn in enumerate(TURNS):
        conic = conic_of_circle(Pose(rotation_about(turn), CENTRES[i]), RADII[i])
        ellipse = ellipse_from_conic(conic)
        centre = ideal.distort(ellipse.centre[None])[0]
        spread = 0.25 * 610.0**2 * ellipse.stretch @ ellipse.stretch
        assert images.moments[i, :2] == pytest.approx(centre, abs=1e-9)
        assert images.moments[i, 2:] == pytest.approx(spread[[0, 0, 1], [0, 1, 1]], rel=1e-9)
    assert split.in_marker_px == pytest.approx(np.zeros((3, 2)), abs=1e-9)


def test_eccentricity_equals_the_known_formula() -> None:
    """(R²/f) ½ sin 2θ for a small circle on the axis, R its radius in the image."""
    camera = Camera(640, 480, 1000.0, 1000.0, 320.0, 240.0)
    tilt = np.radians(40.0)
    normal = np.array([[np.sin(tilt), 0.0, np.cos(tilt)]])
    plane = Circles3D.with_normals(np.array([[0.0, 0.0, 1.0]]), normal, np.array([0.02]))
    split = eccentricity(camera, plane)
    expected = 20.0**2 / 1000.0 * 0.5 * np.sin(2.0 * tilt)
    assert np.hypot(*split.perspective_px[0]) == pytest.approx(expected, rel=1e-3)


def test_eccentricity_parts_add_up_to_the_total() -> None:
    images, split = circle_images(CAMERA, circles()), eccentricity(CAMERA, circles())
    assert split.centres_px + split.total_px == pytest.approx(images.moments[:, :2], abs=1e-9)
    assert np.abs(split.in_marker_px).max() > 1e-3
    assert CAMERA.project(CENTRES) == pytest.approx(split.centres_px, abs=1e-9)


def moved(slopes: CircleDerivatives) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Derivatives, and the same by central differences."""
    start, step, pairs = circles(), 1e-6, {}

    def difference(plus: FloatArray, minus: FloatArray) -> FloatArray:
        return np.asarray((plus - minus) / (2.0 * step))

    def at(camera: Camera = CAMERA, **changes: FloatArray) -> FloatArray:
        return circle_images(camera, replace(start, **changes)).moments

    def turned(axis: FloatArray, angle: float) -> FloatArray:
        return np.asarray(rotation_about(angle * axis) @ start.axes)

    for k, axis in enumerate(np.eye(3)):
        shift = step * axis
        numeric = difference(at(centres_m=CENTRES + shift), at(centres_m=CENTRES - shift))
        pairs[f"centre {k}"] = slopes.by_centre[..., k], numeric
        numeric = difference(at(axes=turned(axis, step)), at(axes=turned(axis, -step)))
        pairs[f"rotation {k}"] = slopes.by_rotation[..., k], numeric
    numeric = difference(at(radii_m=RADII + step), at(radii_m=RADII - step))
    pairs["radius"] = slopes.by_radius, numeric
    by_calibration = moments_jacobian_by_calibration(CAMERA, start)
    for k, name in enumerate(CALIBRATION_PARAMETERS):
        value = getattr(CAMERA, name)
        more, less = (
            replace(CAMERA, **{name: value + step}),
            replace(CAMERA, **{name: value - step}),
        )
        pairs[name] = by_calibration[..., k], difference(at(more), at(less))
    return pairs


def test_moment_derivatives_equal_finite_differences() -> None:
    slopes = circle_derivatives(CAMERA, circles())
    assert np.array_equal(slopes.moments, circle_images(CAMERA, circles()).moments)
    for name, (analytic, numeric) in moved(slopes).items():
        scale = np.abs(numeric).max(axis=0)
        assert analytic == pytest.approx(numeric, abs=1e-5 * float(scale.max())), name


def test_circles_behind_the_camera_have_no_image() -> None:
    behind = replace(circles(), centres_m=CENTRES * [1.0, 1.0, -1.0])
    assert np.isnan(circle_images(CAMERA, behind).moments).all()


def test_a_circle_extremely_far_away_has_no_image() -> None:
    """Its moments would be those of rounding."""
    far = Circles3D(np.array([[0.0, 0.0, 1e20]]), circles().axes[:1], RADII[:1])
    assert np.isnan(circle_images(CAMERA, far).moments).all()
    assert np.isnan(circle_derivatives(CAMERA, far).by_centre).any()
