from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.gcp import SkippedSighting, SkipReason, build_gcps
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import NoPosition, TargetPosition, TargetPositions
from kgcp.georef.trajectory import Trajectory
from kgcp.settings import VehicleSettings
from kgcp.targets.layout import Ring, Target

_CAMERA = Camera(width=640, height=481, fx=900.0, fy=900.0, cx=320.0, cy=240.0)
_RING = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
_GROUND = Ring("G", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 90.0, 200.0))
_POSITION = (430620.0, 4583530.0, 120.0)


def _sighting(number: int, target: str, time_s: float | None, instance: int = 0) -> Sighting:
    return Sighting(
        frame=f"f_{number:04d}.png",
        number=number,
        target=target,
        instance=instance,
        time_s=time_s,
        centre_px=np.array([100.0, 480.0]),
        centre_cov_px2=None,
        distance_m=50.0,
        sd_distance_m=None,
        sd_common_distance_m=0.004,
    )


def _whereabouts(settings: VehicleSettings, static: str = "G") -> TargetPositions:
    time_s = np.arange(0.0, 10.01, 0.1)
    position = np.array([430606.1, 4583523.0, 120.0]) + np.outer(time_s, [10.0, 0.0, 0.0])
    sd = np.full((len(time_s), 3), 0.02)
    trajectory = Trajectory(time_s, position, np.zeros_like(position), sd, None)
    ring, sd_position_m = replace(_GROUND, name=static), (0.01, 0.02, 0.03)
    ground = Target(ring, position_m=_POSITION, sd_position_m=sd_position_m)
    return TargetPositions.of("EPSG:25831", [Target(_RING), ground], trajectory, settings)


def test_moving_points_are_named_by_frame_and_static_ones_by_target() -> None:
    sightings = [_sighting(3, "A", 1.0), _sighting(3, "G", 1.0), _sighting(7, "G", None)]
    gcps, skipped = build_gcps(sightings, _whereabouts(VehicleSettings()), _CAMERA)
    assert [point.id for point in gcps] == ["K0003", "G", "G"]
    assert skipped == ()
    np.testing.assert_allclose(gcps[0].position_map, [430616.1, 4583523.0, 120.0], atol=1e-4)
    for static in gcps[1:]:
        np.testing.assert_allclose(static.position_map, _POSITION, atol=1e-6)
        assert static.cov_m2 is not None
        np.testing.assert_allclose(np.sqrt(np.diag(static.cov_m2)), [0.01, 0.02, 0.03])


def test_a_static_target_named_like_a_moving_point_is_refused() -> None:
    """Packages would take both for one point."""
    whereabouts = _whereabouts(VehicleSettings(), static="K0003")
    with pytest.raises(KgcpError, match=r"^'K0003' is both a static target and a point of"):
        build_gcps([_sighting(3, "A", 1.0), _sighting(7, "K0003", None)], whereabouts, _CAMERA)
    gcps, _ = build_gcps([_sighting(4, "A", 1.0), _sighting(7, "K0003", 1.0)], whereabouts, _CAMERA)
    assert [point.id for point in gcps] == ["K0004", "K0003"]


def test_covariance_is_given_along_the_maps_axes() -> None:
    gcps, _ = build_gcps([_sighting(1, "A", 5.0)], _whereabouts(VehicleSettings()), _CAMERA)
    assert gcps[0].cov_m2 is not None
    np.testing.assert_allclose(gcps[0].cov_m2, 0.02**2 * np.eye(3), atol=1e-12)


def test_frames_outside_the_trajectory_are_skipped_and_counted() -> None:
    sightings = [_sighting(1, "A", -5.0), _sighting(2, "A", 5.0), _sighting(3, "A", None)]
    gcps, skipped = build_gcps(sightings, _whereabouts(VehicleSettings()), _CAMERA)
    assert [point.id for point in gcps] == ["K0002"]
    assert set(skipped) == {
        SkippedSighting("f_0001.png", "A", NoPosition.BEFORE_TRAJECTORY),
        SkippedSighting("f_0003.png", "A", NoPosition.NO_TIME),
    }


def test_a_frame_with_two_plates_of_one_code_makes_no_point() -> None:
    """The better score may be that of another vehicle's plate."""
    sightings = [
        _sighting(1, "A", 5.0),
        _sighting(2, "A", 6.0),
        _sighting(2, "A", 6.0, instance=1),
        _sighting(2, "B", 6.0),
    ]
    gcps, skipped = build_gcps(sightings, _whereabouts(VehicleSettings(), static="B"), _CAMERA)
    assert [(point.frame, point.target) for point in gcps] == [
        ("f_0001.png", "A"),
        ("f_0002.png", "B"),
    ]
    assert skipped == (SkippedSighting("f_0002.png", "A", SkipReason.SECOND_PLATE),) * 2


def test_no_sightings_make_no_points() -> None:
    assert build_gcps([], _whereabouts(VehicleSettings()), _CAMERA) == ((), ())


def test_a_rolling_shutter_reads_the_middle_row_at_mid_exposure() -> None:
    rolling = Camera(640, 481, 900.0, 900.0, 320.0, 240.0, readout_s=0.03)
    seen = _sighting(1, "A", 10.0)
    for row, time_s in ((0.0, 9.985), (240.0, 10.0), (480.0, 10.015)):
        in_row = replace(seen, centre_px=np.array([100.0, row]))
        assert in_row.row_time_s(rolling) == pytest.approx(time_s)
    assert _sighting(1, "A", None).row_time_s(rolling) is None


def test_the_target_is_where_it_was_when_its_row_was_read() -> None:
    rolling = Camera(640, 481, 900.0, 900.0, 320.0, 240.0, readout_s=0.03)
    target_positions = _whereabouts(VehicleSettings())
    (late,), _ = build_gcps([_sighting(1, "A", 5.0)], target_positions, rolling)
    (plain,), _ = build_gcps([_sighting(1, "A", 5.0)], target_positions, _CAMERA)
    np.testing.assert_allclose(
        late.position_map - plain.position_map, [0.15, 0.0, 0.0], atol=1e-4
    )  # 10 m/s for half of 30 ms
    assert late.time_s == pytest.approx(5.015)


def test_time_is_that_of_the_trajectorys_clock() -> None:
    target_positions = _whereabouts(VehicleSettings(time_offset_s=-18.0))
    (point,), _ = build_gcps([_sighting(1, "A", 23.0)], target_positions, _CAMERA)
    assert point.time_s == pytest.approx(5.0)


def _bend(settings: VehicleSettings) -> TargetPositions:
    """15 m/s on a circle of 100 m, level, heading along the track."""
    time_s = np.arange(0.0, 30.01, 0.05)
    local_frame = LocalFrame.at("EPSG:25831", np.array([430606.1, 4583523.0, 120.0]))
    angle = 0.15 * time_s
    enu = 100.0 * np.column_stack((np.cos(angle), np.sin(angle), 0.0 * angle))
    attitude = np.column_stack((0.0 * angle, 0.0 * angle, -np.degrees(angle)))
    sd = np.full((len(time_s), 3), 0.02)
    trajectory = Trajectory(time_s, local_frame.map_from_enu(enu), attitude, sd, None)
    return TargetPositions.of("EPSG:25831", [Target(_RING)], trajectory, settings)


def test_common_effects_are_the_covariance_between_points() -> None:
    rng = np.random.default_rng(3)
    settings = VehicleSettings(
        lever_arm_m=(-0.8, 0.15, -1.95), sd_lever_arm_m=(0.03, 0.01, 0.02), sd_time_s=0.002
    )
    sightings = [_sighting(1, "A", 5.0), _sighting(2, "A", 14.0)]
    right = _bend(settings)
    reported, _ = build_gcps(sightings, right, _CAMERA)

    def error() -> FloatArray:
        arm = settings.lever_arm_m + settings.sd_lever_arm_m * rng.standard_normal(3)
        wrong = replace(
            settings,
            lever_arm_m=(arm[0], arm[1], arm[2]),
            time_offset_s=settings.sd_time_s * rng.standard_normal(),
        )
        assert right.vehicle is not None
        moved = replace(right, vehicle=replace(right.vehicle, settings=wrong))
        placed, _ = build_gcps(sightings, moved, _CAMERA)
        return np.concatenate(
            [a.position_map - b.position_map for a, b in zip(placed, reported, strict=True)]
        )

    scatter = np.cov(np.array([error() for _ in range(300)]).T)
    factors = np.vstack([point.common_m for point in reported if point.common_m is not None])
    assert factors.shape == (6, 4)
    sd = np.sqrt(np.diag(factors @ factors.T))
    difference = (scatter - factors @ factors.T) / np.outer(sd, sd)
    assert np.abs(difference).max() < 4.0 * np.sqrt(2.0 / 300.0)
    for point in reported:
        assert point.cov_m2 is not None
        assert point.cov_common_m2 is not None
        own = point.cov_m2 - point.cov_common_m2
        np.testing.assert_allclose(own, 0.02**2 * np.eye(3), atol=1e-9)  # the trajectory's


def test_a_static_targets_covariance_is_one_error_in_all_frames() -> None:
    (point,), _ = build_gcps([_sighting(1, "G", None)], _whereabouts(VehicleSettings()), _CAMERA)
    assert point.common_m is None
    assert point.cov_common_m2 is point.cov_m2


def test_rows_of_a_rolling_shutter_are_up_to_22_cm_apart_at_15_m_s() -> None:
    rolling = replace(_CAMERA, readout_s=0.03)
    truth = _bend(VehicleSettings())
    for row in (0.0, 120.0, 480.0):
        seen = replace(_sighting(1, "A", 10.0), centre_px=np.array([320.0, row]))
        when = 10.0 + (row / 480.0 - 0.5) * 0.03
        (there,) = truth.positions(["A"], [when])
        assert isinstance(there, TargetPosition)
        (point,), _ = build_gcps([seen], truth, rolling)
        expected = truth.local_frame.map_from_enu(there.position_m[None])[0]
        np.testing.assert_allclose(point.position_map, expected, atol=1e-6)
        (still,), _ = build_gcps([seen], truth, _CAMERA)
        apart = np.linalg.norm(point.position_map - still.position_map)
        assert apart == pytest.approx(15.0 * 0.03 * abs(row / 480.0 - 0.5), rel=2e-3)
    assert apart == pytest.approx(0.225, abs=1e-3)
