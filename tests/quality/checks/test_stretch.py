"""The check for prints and images that are stretched in one direction."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import rotation_about
from kgcp.georef.camera_priors import body_from_plate
from kgcp.quality.checks import measured
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.encounters import Encounters
from kgcp.quality.checks.measured import _of_encounters
from kgcp.quality.checks.stretch import check_stretch
from kgcp.quality.consistency import Consistency
from tests.quality.checks.test_slips import of
from tests.wrong_flights.flights import CAMERA

_MOUNT_TILT = np.array([0.03, -0.02, 0.0])  # of the plate on the vehicle [rad]
_SHARE = 0.002
_SD_DEG = 0.02


@pytest.fixture(scope="module")
def encounters(tmp_path_factory: pytest.TempPathFactory) -> Encounters:
    """Those of the sample flight."""
    return of(tmp_path_factory.mktemp("right") / "flight", CAMERA)


def stretched(direction_deg: float) -> FloatArray:
    """Return a stretch (2, 2): one diameter is longer by `_SHARE` than the one across."""
    twice = np.radians(2.0 * direction_deg)
    cosine, sine = np.cos(twice), np.sin(twice)
    return np.eye(2) + 0.5 * _SHARE * np.array([[cosine, sine], [sine, -cosine]])


def seen_as(
    encounters: Encounters,
    *,
    plate: FloatArray,
    image: FloatArray,
    mount: FloatArray = _MOUNT_TILT,
) -> Encounters:
    """Return the encounters with the poses of round circles that look like stretched ones.

    They have random errors of `_SD_DEG` about each axis. The views are orthogonal projections along
    the ray. Such a view of plate axes x, y gives their third components, along the ray, but for the
    sign: those that are nearer to the truth are taken.
    """
    body = np.swapaxes(encounters.enu_from_camera, 1, 2) @ encounters.frame_from_body
    true = body @ rotation_about(mount) @ body_from_plate(0.0)
    rotations = []
    rng = np.random.default_rng(1)
    for rotation, centre in zip(true, encounters.in_camera_m, strict=True):
        ray = centre / np.linalg.norm(centre)
        x = np.array([1.0, 0.0, 0.0]) - ray[0] * ray
        x /= np.linalg.norm(x)
        axes = np.stack((x, np.cross(ray, x), ray))
        view = image @ (axes @ rotation)[:2, :2] @ plate
        view /= np.linalg.norm(view, 2)  # the longest diameter is that of the circle
        _, lengths, right = np.linalg.svd(view)
        along = np.sqrt(max(0.0, 1.0 - lengths[1] ** 2)) * right[1]
        if along @ (axes @ rotation)[2, :2] < 0.0:
            along = -along
        columns = axes.T @ np.vstack((view, along))
        error = rotation_about(np.radians(_SD_DEG) * rng.standard_normal(3))
        rotations.append(error @ np.column_stack((columns, np.cross(*columns.T))))
    return replace(encounters, camera_from_plate=np.array(rotations))


def test_a_round_print_on_a_tilted_plate_is_not_in_doubt(encounters: Encounters) -> None:
    assert not [*check_stretch(encounters)]
    assert not [*check_stretch(seen_as(encounters, plate=np.eye(2), image=np.eye(2)))]


@pytest.mark.parametrize("direction_deg", [20.0, 110.0])
def test_a_stretched_print_is_recognised(encounters: Encounters, direction_deg: float) -> None:
    """Every pose fits its frame, and the positions of vehicle and camera agree."""
    seen = seen_as(encounters, plate=stretched(direction_deg), image=np.eye(2))
    (doubt,) = _of_encounters(seen, None)
    assert doubt.code is Cause.STRETCH
    assert doubt.figures["stretch"] == pytest.approx(_SHARE, rel=0.03)
    (found,) = re.findall(r"the print was stretched by .* along (\d+)°", doubt.sentence)
    assert float(found) == pytest.approx(direction_deg, abs=3.0)
    assert "images" not in doubt.sentence
    assert "diameter in several directions" in doubt.remedy


def test_a_stretched_print_is_not_compensated_by_corrections(
    encounters: Encounters, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shorter lever arm, for example, would explain a part of the wrong distances."""
    monkeypatch.setattr(measured, "is_explained", lambda _: True)
    monkeypatch.setattr(measured, "_has_other_readout", lambda _: False)
    monkeypatch.setattr(measured, "corrections", lambda _: [("they differ", "add 0.04 m")])
    consistency = cast("Consistency", object())
    assert [doubt.code for doubt in _of_encounters(encounters, consistency)] == [Cause.CORRECTION]
    seen = seen_as(encounters, plate=stretched(20.0), image=np.eye(2))
    assert [doubt.code for doubt in _of_encounters(seen, consistency)] == [Cause.STRETCH]
    far = replace(seen, lever_arm_m=np.add(seen.lever_arm_m, [0.3, 0.0, 0.0]))
    both = [Cause.STRETCH, Cause.CORRECTION]
    assert [doubt.code for doubt in _of_encounters(far, consistency)] == both


def test_wrong_diameters_are_not_compensated_by_corrections(
    encounters: Encounters, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measured, "is_explained", lambda _: True)
    monkeypatch.setattr(measured, "_has_other_readout", lambda _: False)
    monkeypatch.setattr(measured, "corrections", lambda _: [("they differ", "add 0.04 m")])
    consistency = cast("Consistency", object())
    assert [*_of_encounters(encounters, consistency, 1e-5)], "not the cause"
    assert not [*_of_encounters(encounters, consistency, 0.003)]


@pytest.mark.parametrize("direction_deg", [0.0, 135.0])
def test_stretched_images_are_recognised(encounters: Encounters, direction_deg: float) -> None:
    seen = seen_as(encounters, plate=np.eye(2), image=stretched(direction_deg))
    (doubt,) = check_stretch(seen)
    assert doubt.figures["stretch"] == pytest.approx(_SHARE, rel=0.05)
    (found,) = re.findall(r"the images were stretched by .* along (\d+)°", doubt.sentence)
    assert abs((float(found) - direction_deg + 90.0) % 180.0 - 90.0) < 3.0
    assert "print" not in doubt.sentence
    assert "fx, fy and readout_s" in doubt.remedy


def test_a_plate_on_the_side_of_the_vehicle_may_be_stretched(encounters: Encounters) -> None:
    """Its normal has no component along the vehicle's vertical axis."""
    mount = np.array([0.5 * np.pi, 0.0, 0.0])
    body = encounters.frame_from_body
    turn = body @ rotation_about(mount) @ np.swapaxes(body, 1, 2)
    seen = replace(encounters, enu_from_camera=turn @ encounters.enu_from_camera)
    (doubt,) = check_stretch(seen_as(seen, plate=stretched(20.0), image=np.eye(2), mount=mount))
    assert doubt.figures["stretch"] == pytest.approx(_SHARE, rel=0.01)
    assert doubt.figures["sd_stretch"] < 0.02 * _SHARE


def of_a_camera_that_never_turns(encounters: Encounters) -> FloatArray:
    """Return attitudes (n, 3, 3) with which the plate always has the same heading in the image."""
    return encounters.frame_from_body @ body_from_plate(0.0)


def test_a_rolling_shutter_may_stretch_images_but_not_the_print(encounters: Encounters) -> None:
    camera = replace(encounters.camera, readout_s=0.02, motion_sd_deg_s=2.0)
    rolling = replace(encounters, camera=camera)
    assert not [*check_stretch(seen_as(rolling, plate=np.eye(2), image=stretched(0.0)))]
    # a motion of 5°/s that has the same direction on the plate in all frames stretches it as much
    faster = replace(encounters, camera=replace(camera, motion_sd_deg_s=5.0))
    assert not [*check_stretch(seen_as(faster, plate=stretched(0.0), image=np.eye(2)))]
    (doubt,) = check_stretch(seen_as(rolling, plate=stretched(0.0), image=np.eye(2)))
    assert "images" not in doubt.sentence
    same_heading = replace(rolling, enu_from_camera=of_a_camera_that_never_turns(rolling))
    assert not [*check_stretch(seen_as(same_heading, plate=np.eye(2), image=stretched(0.0)))]


def test_a_camera_that_never_turns_cannot_tell_print_from_images(encounters: Encounters) -> None:
    fixed = replace(encounters, enu_from_camera=of_a_camera_that_never_turns(encounters))
    (doubt,) = check_stretch(seen_as(fixed, plate=stretched(0.0), image=np.eye(2)))
    assert " or the " in doubt.sentence
    assert "diameter in several directions" in doubt.remedy
    assert "fx, fy and readout_s" in doubt.remedy


def test_few_frames_are_not_tested(encounters: Encounters) -> None:
    seen = seen_as(encounters, plate=stretched(0.0), image=np.eye(2))
    position = seen.position_m.copy()
    position[11:] = np.nan  # outside the trajectory
    assert not [*check_stretch(replace(seen, position_m=position))]


def test_equal_views_are_not_tested(encounters: Encounters) -> None:
    """A tilt of the plate and a stretch have the same effect then."""
    body = encounters.frame_from_body
    alike = replace(
        encounters,
        enu_from_camera=body @ body_from_plate(30.0),
        in_camera_m=np.broadcast_to([1.0, 2.0, 9.0], encounters.in_camera_m.shape),
    )
    assert not [*check_stretch(seen_as(alike, plate=stretched(0.0), image=np.eye(2)))]
