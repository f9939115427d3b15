from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, ReferencePoses, opk_from_rotation
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.scene_rotation import CameraMotions, camera_motions
from kgcp.georef.sighting import Attempt, Exposure, Sighting
from kgcp.georef.target_positions import NoPosition, TargetPositions
from kgcp.georef.trajectory import Trajectory
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.quality.bias_study import edge_distances, study_bias
from kgcp.report.bias.numbers import bias_numbers
from kgcp.report.bias.verdict import assess
from kgcp.settings import Method, VehicleSettings
from kgcp.targets.layout import Ring, Target

_CAMERA = Camera(width=1600, height=1200, fx=2300.0, fy=2300.0, cx=800.0, cy=600.0, k1=-0.06)
_TARGET = Target(Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0)))
_NOTHING = Exposure(*[None] * 9)
_METHOD = Method.MODEL
_START = np.array([430606.1, 4583523.0, 120.0])

_TIME_S = np.arange(0.0, 10.01, 0.1)
_TRAJECTORY = Trajectory(
    _TIME_S,
    _START + np.outer(_TIME_S, [5.0, 5.0, 0.0]),
    np.zeros((len(_TIME_S), 3)),
    np.full((len(_TIME_S), 3), 0.03),
    None,
)
_TARGET_POSITIONS = TargetPositions.of("EPSG:25831", [_TARGET], _TRAJECTORY, VehicleSettings())


def _frame(index: int) -> str:
    return f"f_{index:04d}.png"


def _nadir_poses(
    above_m: FloatArray, aside_m: float = 0.0, sd_m: float | None = 0.04
) -> ReferencePoses:
    """Cameras straight above the vehicle at times 0, 1, …, looking down, x to the true east."""
    n = len(above_m)
    positions = _TARGET_POSITIONS.positions(["A"] * n, [float(i) for i in range(n)])
    enu = np.array(
        [position.position_m for position in positions if not isinstance(position, NoPosition)]
    )
    centre = enu + np.column_stack((np.full(n, aside_m), np.zeros(n), above_m))
    grids = np.array([_TARGET_POSITIONS.local_frame.grid_rotation(point) for point in centre])
    enu_from_photo = np.diag([1.0, -1.0, -1.0]) @ CAMERA_FROM_PHOTO
    return ReferencePoses(
        frames=tuple(_frame(index) for index in range(n)),
        position_map=_TARGET_POSITIONS.local_frame.map_from_enu(centre),
        opk_deg=opk_from_rotation(np.swapaxes(grids, 1, 2) @ enu_from_photo),
        sd_position_m=None if sd_m is None else np.full((n, 3), sd_m),
        sd_angle_deg=None,
    )


def _attempt(index: int, distance_m: float | None, centre: tuple[float, float]) -> Attempt:
    sighting = None
    if distance_m is not None:
        sighting = Sighting(
            frame=_frame(index),
            number=index + 1,
            target="A",
            instance=0,
            time_s=float(index),
            centre_px=np.array(centre),
            centre_cov_px2=None,
            distance_m=distance_m,
            sd_distance_m=None,
            sd_common_distance_m=None,
        )
    return Attempt(_frame(index), "A", float(index), sighting, _NOTHING)


_ABOVE = np.array([20.0, 40.0, 60.0, 80.0])
_MIDDLE = (800.0, 600.0)


def _attempts(scale: float = 1.0) -> list[Attempt]:
    return [_attempt(i, scale * above, _MIDDLE) for i, above in enumerate(_ABOVE)]


def test_residuals_are_measured_minus_reference() -> None:
    study = study_bias(
        _attempts(1.002), _nadir_poses(_ABOVE), _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD
    )
    assert study.attitudes_agree
    assert len(study.trusted) == 4
    for one, above in zip(study.measured, _ABOVE, strict=True):
        assert one.reference_distance_m == pytest.approx(above, abs=1e-5)
        assert one.residual_m == pytest.approx(0.002 * above, abs=1e-5)
        assert one.residual_percent == pytest.approx(0.2, abs=1e-4)
        np.testing.assert_allclose(one.expected_px, _MIDDLE, atol=0.01)
        assert one.expected_radius_px == pytest.approx(0.45 * 2300.0 / above)
        assert one.sds is not None
        assert one.sds.independent_m == pytest.approx(0.04, rel=1e-3)
        assert one.sds.trajectory_m == pytest.approx(0.03, rel=1e-3)
        assert one.sds.common_m == 0.0
        assert one.sds.total_m == pytest.approx(0.05, rel=1e-3)


def test_unknown_deviations_stay_unknown() -> None:
    study = study_bias(
        _attempts(), _nadir_poses(_ABOVE, sd_m=None), _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD
    )
    assert study.measured[0].sds is None


def test_only_frames_that_must_show_the_whole_target_count() -> None:
    camera = Camera(1600, 1200, 2300.0, 2300.0, 800.0, 600.0)
    poses = _nadir_poses(_ABOVE, aside_m=-13.8)  # the target lies 13.8 m to the camera's east
    at_x = [800.0 + 2300.0 * 13.8 / above for above in _ABOVE]
    assert at_x[0] > 1600.0 > at_x[1] > 1600.0 - 0.45 * 2300.0 / 40.0  # outside; cut by the rim
    attempts = [
        *(_attempt(i, None, _MIDDLE) for i in range(3)),
        _attempt(3, 81.2, (at_x[3], 600.0)),
    ]
    study = study_bias(attempts, poses, _TARGET_POSITIONS, camera, [_TARGET], _METHOD)
    assert [one.attempt.frame for one in study.expected_visible] == [_frame(2), _frame(3)]
    assert [study.trusts(one) for one in study.expected_visible] == [False, True]


def test_measurements_away_from_the_expected_place_are_misplaced() -> None:
    attempts = [*_attempts()[:3], _attempt(3, 75.0, (400.0, 300.0))]
    study = study_bias(
        attempts, _nadir_poses(_ABOVE), _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD
    )
    assert [one.is_misplaced for one in study.measured] == [False, False, False, True]
    assert len(study.trusted) == 3


def test_wrong_attitudes_do_not_hide_the_distances() -> None:
    poses = _nadir_poses(_ABOVE)
    upside_down = replace(poses, opk_deg=poses.opk_deg + np.array([180.0, 0.0, 0.0]))
    study = study_bias(
        _attempts(1.001), upside_down, _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD
    )
    assert not study.attitudes_agree
    assert len(study.trusted) == len(study.expected_visible) == 4
    assert study.measured[0].residual_percent == pytest.approx(0.1, abs=1e-4)


def test_frames_without_pose_or_place_are_counted() -> None:
    attempts = [*_attempts()[:3], _attempt(77, 50.0, _MIDDLE)]
    late = replace(attempts[2], time_s=99.0, sighting=None)
    study = study_bias(
        [*attempts[:2], late, attempts[3]],
        _nadir_poses(_ABOVE),
        _TARGET_POSITIONS,
        _CAMERA,
        [_TARGET],
        _METHOD,
    )
    assert study.frames_without_pose == (_frame(77),)
    assert study.absences == (NoPosition.AFTER_TRAJECTORY,)
    assert len(study.measured) == 2


def test_a_reference_far_less_certain_than_the_others_is_not_compared() -> None:
    poses = _nadir_poses(_ABOVE)
    assert poses.sd_position_m is not None
    sds = poses.sd_position_m.copy()
    sds[1] = 0.8  # GNSS without ambiguities, and its error:
    moved = poses.position_map + np.outer([0.0, 1.0, 0.0, 0.0], [0.7, 0.0, 1.1])
    outage = replace(poses, position_map=moved, sd_position_m=sds)
    study = study_bias(_attempts(), outage, _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD)
    assert study.frames_with_vague_reference == (_frame(1),)
    assert len(study.measured) == len(study.trusted) == len(study.expected_visible) == 3
    alike = replace(poses, sd_position_m=20.0 * poses.sd_position_m)
    study = study_bias(_attempts(), alike, _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD)
    assert len(study.measured) == 4


def test_frames_with_two_plates_of_one_code_are_not_compared() -> None:
    """The better score may be that of another vehicle's plate."""
    attempts = _attempts()
    sighting = attempts[0].sighting
    assert sighting is not None
    second = replace(attempts[0], sighting=replace(sighting, instance=1, distance_m=99.0))
    poses = _nadir_poses(_ABOVE)
    study = study_bias([*attempts, second], poses, _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD)
    assert [pair.attempt.frame for pair in study.measured] == [_frame(1), _frame(2), _frame(3)]
    assert study.frames_with_several_plates == (_frame(0),)
    assert dict(bias_numbers(study).left_out)["second_plate"] == 1
    with pytest.raises(KgcpError, match="all 1 measurements are in frames with several plates"):
        study_bias([attempts[0], second], poses, _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD)


def test_targets_that_gave_the_poses_are_not_compared_with_them() -> None:
    """Their errors have gone into the poses, and would seem smaller than they are."""
    attempts, poses = _attempts(), _nadir_poses(_ABOVE)
    static = replace(attempts[1], target="static")
    measured = [attempts[0], static, *attempts[2:]]
    places, targets = (_TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD), ("static",)
    study = study_bias(measured, poses, *places, orienting=targets)
    assert [pair.attempt.frame for pair in study.measured] == [_frame(0), _frame(2), _frame(3)]
    assert dict(bias_numbers(study).left_out)["static_targets_that_gave_the_poses"] == 1
    with pytest.raises(KgcpError, match="computed from all measured targets, by 'kgcp orient'"):
        study_bias([static], poses, *places, orienting=targets)


def test_nothing_to_compare_is_an_error_with_a_remedy() -> None:
    poses = _nadir_poses(_ABOVE)
    with pytest.raises(KgcpError, match="no target was measured"):
        study_bias(
            [_attempt(0, None, _MIDDLE)], poses, _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD
        )
    renamed = replace(poses, frames=("a.jpg", "b.jpg", "c.jpg", "d.jpg"))
    with pytest.raises(KgcpError, match=r"'f_0000\.png'.*'a\.jpg'.*relative to the frames folder"):
        study_bias(_attempts(), renamed, _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD)


def test_errors_common_to_all_frames_are_stated_separately() -> None:
    settings = VehicleSettings(sd_lever_arm_m=(0.0, 0.0, 0.02), sd_time_s=0.001)
    target_positions = TargetPositions.of("EPSG:25831", [_TARGET], _TRAJECTORY, settings)
    study = study_bias(
        _attempts(), _nadir_poses(_ABOVE), target_positions, _CAMERA, [_TARGET], _METHOD
    )
    sds = study.measured[0].sds
    assert sds is not None
    assert sds.common_m == pytest.approx(0.02, rel=1e-3)  # horizontal errors do not count
    assert sds.trajectory_m == pytest.approx(0.03, rel=1e-3)


def test_the_position_error_of_a_static_target_is_common_to_all_frames() -> None:
    position = tuple(_TARGET_POSITIONS.local_frame.map_from_enu(np.zeros((1, 3)))[0].tolist())
    static = replace(_TARGET, position_m=position, sd_position_m=(0.01, 0.01, 0.05))
    target_positions = TargetPositions.of("EPSG:25831", [static], _TRAJECTORY, VehicleSettings())
    study = study_bias(
        _attempts(), _nadir_poses(_ABOVE), target_positions, _CAMERA, [static], _METHOD
    )
    sds = study.measured[0].sds
    assert sds is not None
    assert sds.trajectory_m == 0.0
    assert sds.common_m == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("method", [Method.MODEL, Method.PAPER])
def test_distances_from_one_edge_are_displaced_and_from_two_are_not(method: Method) -> None:
    delta, radius, true_m = 0.4, 20.0, _ABOVE[0]
    displaced_m = true_m * radius / (radius - delta)  # a smaller ring seems farther away
    seen_px, seen_m = (radius, true_m) if method is Method.MODEL else (radius - delta, displaced_m)
    exposure = replace(_NOTHING, edge_shift_px=delta, radius_px=seen_px)
    attempt = replace(_attempt(0, seen_m, _MIDDLE), exposure=exposure)
    study = study_bias(
        [attempt], _nadir_poses(_ABOVE), _TARGET_POSITIONS, _CAMERA, [_TARGET], method
    )
    found = edge_distances(study.measured[0], method)
    assert found is not None
    assert found.by_outer_edge_m == pytest.approx(displaced_m, rel=1e-12)
    assert found.by_both_edges_m == pytest.approx(true_m, rel=1e-12)


@pytest.mark.parametrize(
    ("readout_s", "sd_deg_s", "says"),
    [
        (0.03, 5.0, "motion while its frames are read out is unknown and may be the cause"),
        (0.03, 1.0, "Biased: measured distances are too short"),  # known but for vibration
        (0.0, None, "Biased: measured distances are too short"),
    ],
)
def test_an_unknown_motion_is_that_of_all_frames(
    readout_s: float, sd_deg_s: float | None, says: str
) -> None:
    """By many frames, its effect seemed to be certain, and right distances biased."""
    above = np.linspace(20.0, 60.0, 10)
    motions = None
    if sd_deg_s is not None:
        still, sds = np.zeros((10, 3)), np.full(10, np.radians(sd_deg_s))
        motions = CameraMotions(still, 0.1 * sds, still, sds, np.ones(10, dtype=np.bool_))
    attempts = []
    for index, above_m in enumerate(above.tolist()):
        attempt = _attempt(index, (0.9967 + 1e-4 * (-1) ** index) * above_m, _MIDDLE)
        assert attempt.sighting is not None
        sighting = replace(attempt.sighting, sd_distance_m=0.004 * above_m)
        attempts.append(replace(attempt, sighting=sighting))
    study = study_bias(
        attempts,
        _nadir_poses(above, sd_m=0.005),
        _TARGET_POSITIONS,
        replace(_CAMERA, readout_s=readout_s),
        [_TARGET],
        _METHOD,
        motions,
    )
    numbers = bias_numbers(study)
    assert numbers.total.sd_motion_percent == pytest.approx(
        0.4 if sd_deg_s == 5.0 else 0.0, abs=1e-3
    )
    assert any(says in sentence for sentence in assess(numbers).sentences)


def test_without_edge_shift_there_are_no_edge_distances() -> None:
    study = study_bias(
        _attempts(), _nadir_poses(_ABOVE), _TARGET_POSITIONS, _CAMERA, [_TARGET], _METHOD
    )
    assert edge_distances(study.measured[0], _METHOD) is None


def test_reference_distances_are_those_when_a_rolling_shutter_exposes_the_target() -> None:
    """The camera is ahead of the vehicle and behind it in turn; both go north at 5 m/s.

    North is up in the image. Targets behind the camera are lower in the image and exposed later,
    when the camera is farther away; those ahead are exposed earlier. With the camera's place at the
    middle row, all reference distances would be too short.
    """
    camera = replace(_CAMERA, readout_s=0.03)
    count, above_m = 40, 60.0
    time_s = 5.0 + 0.1 * np.arange(float(count))
    driven_m = np.outer(_TIME_S, (0.0, 5.0, 0.0))
    northward = replace(_TRAJECTORY, time_s=_TIME_S, position_map=_START + driven_m)
    target_positions = TargetPositions.of("EPSG:25831", [_TARGET], northward, VehicleSettings())

    def sight_at(at_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the camera's positions, and the vectors from it to the target, in ENU."""
        places = target_positions.positions(["A"] * len(at_s), at_s.tolist())
        target = np.array([each.position_m for each in places if not isinstance(each, NoPosition)])
        ahead_m = 12.0 * np.sin(2.0 * np.pi * at_s / 8.0)
        centre = target + np.column_stack((0.0 * at_s, ahead_m, np.full_like(at_s, above_m)))
        return centre, target - centre

    delay_s = np.zeros(count)
    for _ in range(10):
        _, sight = sight_at(time_s + delay_s)
        pixels = camera.project(sight * [1.0, -1.0, -1.0])
        delay_s = camera.readout_s * camera.rows_since_middle(pixels)
    attempts = []
    for index, at_s in enumerate(time_s.tolist()):
        attempt = _attempt(index, float(np.linalg.norm(sight[index])), tuple(pixels[index]))
        assert attempt.sighting is not None
        sighting = replace(attempt.sighting, time_s=at_s)
        attempts.append(replace(attempt, time_s=at_s, sighting=sighting))
    centre, _ = sight_at(time_s)
    local_frame = target_positions.local_frame
    grids = local_frame.grid_rotation(centre)
    enu_from_photo = np.diag([1.0, -1.0, -1.0]) @ CAMERA_FROM_PHOTO
    poses = ReferencePoses(
        tuple(_frame(index) for index in range(count)),
        local_frame.map_from_enu(centre),
        opk_from_rotation(np.swapaxes(grids, 1, 2) @ enu_from_photo),
        np.full((count, 3), 0.01),
        None,
    )
    orientations = ExteriorOrientations.of(poses, local_frame)
    motions = camera_motions(
        time_s,
        orientations.centre_m,
        orientations.enu_from_camera,
        [None] * count,
        SceneRotation.unknown(camera),
        above_m,
    )
    still, moving = (
        study_bias(attempts, poses, target_positions, camera, [_TARGET], _METHOD, known)
        for known in (None, motions)
    )
    before = np.array([pair.residual_m for pair in still.measured])
    after = np.array([pair.residual_m for pair in moving.measured])
    assert np.abs(before).max() > 0.01
    assert np.abs(after[1:-1]).max() < 0.001  # the first and the last have no frame beside them
    sds = np.array([pair.sds.independent_m for pair in moving.measured if pair.sds is not None])
    assert np.all(np.abs(after) < 3.0 * sds)
    assert np.median(sds) < 0.011  # hardly more than the poses' own
