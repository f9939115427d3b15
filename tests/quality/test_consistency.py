from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, ReferencePoses, opk_from_rotation
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.scene_rotation import CameraMotions, camera_motions
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.georef.trajectory import ENU_FROM_NED, Trajectory, body_to_ned
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.quality.advice import advice, corrections, is_explained
from kgcp.quality.checks.causes import causes_of
from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.quality.checks.encounters import Encounters
from kgcp.quality.consistency import Consistency, study_consistency
from kgcp.quality.corrections import UNKNOWNS
from kgcp.settings import VehicleSettings
from kgcp.targets.layout import Ring, Target

_CRS = "EPSG:25831"
_ORIGIN = np.array([430606.1, 4583523.0, 120.0])
_CAMERA = Camera(2048, 1536, 2900.0, 2900.0, 1020.0, 770.0)
_TARGET = Target(Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0)))
_LEVER = np.array([-0.8, 0.15, -1.95])
_TO_THE_RIGHT = np.array([0.0, 0.08, 0.0])
_STEP_S, _LEAD_S, _CORRELATION_S = 0.05, 5.0, 20.0
_SD_POSITION_M, _SD_REFERENCE_M, _SD_REFERENCE_DEG = 0.02, 0.01, 0.005
_SD_CENTRE_PX, _SD_DISTANCE = 0.05, 3e-4
_LOCAL_FRAME = LocalFrame.at(_CRS, _ORIGIN)
_SETTINGS = VehicleSettings(lever_arm_m=(-0.8, 0.15, -1.95), correlation_s=_CORRELATION_S)


@dataclass(frozen=True)
class Flight:
    """What is true of a flight; `settings` and `camera` are what its flight.toml says."""

    seed: int = 0
    frames: int = 120
    time_offset_s: float = 0.0
    lever_m: FloatArray = field(default_factory=lambda: _LEVER)
    readout_s: float = 0.0
    boresight_rad: FloatArray = field(default_factory=lambda: np.zeros(3))
    stated_diameter: float = 1.0  # over the true one
    stated_focal_length: float = 1.0
    is_straight: bool = False
    wrong: tuple[int, ...] = ()
    has_sds: bool = True
    settings: VehicleSettings = _SETTINGS

    def vehicle(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions (n, 3) and body axes (n, 3, 3) in ENU: some 15 m/s, in bends or straight."""
        if self.is_straight:
            zero = np.zeros_like(time_s)
            position = np.column_stack((15.0 * time_s, zero, zero))
            heading_deg = np.full_like(time_s, 90.0)
        else:
            along = 15.0 * time_s + 20.0 * np.sin(0.2 * time_s)
            angle = along / 150.0
            position = np.column_stack((150.0 * np.cos(angle), 150.0 * np.sin(angle), 0.0 * angle))
            heading_deg = -np.degrees(angle)
        wave = np.sin(0.3 * time_s)
        attitude = ENU_FROM_NED @ body_to_ned(1.0 * wave, 0.7 * wave, heading_deg)
        level = _LOCAL_FRAME.level_rotations(position)
        return position, level @ attitude

    def target(self, time_s: FloatArray) -> FloatArray:
        position, axes = self.vehicle(time_s)
        return position + axes @ self.lever_m

    def drone(self, time_s: FloatArray) -> FloatArray:
        """Positions above the vehicle, to and fro by metres per second."""
        sway = np.column_stack((np.sin(0.5 * time_s), np.cos(0.37 * time_s), 0.0 * time_s))
        height = 60.0 + 15.0 * np.sin(0.05 * time_s)
        above = np.column_stack((0.0 * height, 0.0 * height, height))
        return self.vehicle(time_s)[0] + 9.0 * sway + above

    def spin(self, time_s: FloatArray) -> FloatArray:
        """Axes of the camera (n, 3, 3) in ENU, as columns: it looks down and sways."""
        yaw_deg, tilt_deg = 40.0 * np.sin(0.1 * time_s), 180.0 + 4.0 * np.sin(0.7 * time_s)
        turns = np.column_stack((yaw_deg, tilt_deg))
        return np.asarray(Rotation.from_euler("ZX", turns, degrees=True).as_matrix())

    def study(self) -> Consistency:
        found = self.study_if_enough()
        assert found is not None
        return found

    def study_if_enough(self) -> Consistency | None:
        return study_consistency(*self.inputs(), _CAMERA)

    def causes(self) -> tuple[Doubt, ...]:
        encounters = Encounters.of(*self.inputs(), _CAMERA)
        assert encounters is not None
        return causes_of(encounters)

    def motions(self) -> CameraMotions:
        """As the reference poses show them."""
        sightings, positions, poses = self.inputs()
        exterior = ExteriorOrientations.of(poses, positions.local_frame)
        return camera_motions(
            np.array([one.time_s for one in sightings]),
            exterior.centre_m,
            exterior.enu_from_camera,
            [None] * self.frames,
            SceneRotation.unknown(_CAMERA),
            60.0,
        )

    def inputs(self) -> tuple[list[Sighting], TargetPositions, ReferencePoses]:
        rng = np.random.default_rng(self.seed)
        time_s = _LEAD_S + 1.5 * np.arange(self.frames, dtype=np.float64)
        names = tuple(f"f{index:04d}.jpg" for index in range(self.frames))
        pixels, translations = self._seen(time_s, rng)
        translations *= self.stated_diameter * np.array([1.0, 1.0, self.stated_focal_length])
        translations[list(self.wrong)] += [0.6, -0.3, 0.8]
        sightings = [
            _sighting(index, names[index], t, pixels[index], translations[index])
            for index, t in enumerate(time_s)
        ]
        poses = _reference(
            names, self.drone(time_s), self.spin(time_s) @ _turns(self.boresight_rad), rng
        )
        trajectory = self._trajectory(rng)
        if not self.has_sds:
            trajectory = replace(trajectory, sd_position_m=None)
            poses = replace(poses, sd_position_m=None, sd_angle_deg=None)
        target_positions = TargetPositions.of(_CRS, [_TARGET], trajectory, self.settings)
        # the frames' clock is behind the trajectory's
        late = [
            replace(one, time_s=float(t) - self.time_offset_s)
            for one, t in zip(sightings, time_s, strict=True)
        ]
        return late, target_positions, poses

    def _seen(self, time_s: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) and measured translations (n, 3) of the target, row by row in time."""
        row_s = time_s
        for _ in range(5):
            sight = self.target(row_s) - self.drone(row_s)
            translation = np.einsum("nji,nj->ni", self.spin(row_s), sight)
            pixel = _CAMERA.project(translation)
            row_s = time_s + (pixel[:, 1] / (_CAMERA.height - 1) - 0.5) * self.readout_s
        distance = np.linalg.norm(translation, axis=1)
        noisy = pixel + _SD_CENTRE_PX * rng.standard_normal(pixel.shape)
        ray = np.column_stack((_CAMERA.undistort(noisy), np.ones(len(noisy))))
        length = distance * (1.0 + _SD_DISTANCE * rng.standard_normal(len(noisy)))
        return noisy, ray / np.linalg.norm(ray, axis=1, keepdims=True) * length[:, None]

    def _trajectory(self, rng: np.random.Generator) -> Trajectory:
        time_s = np.arange(0.0, 2.0 * _LEAD_S + 1.5 * self.frames, _STEP_S)
        position, axes = self.vehicle(time_s)
        keep = math.exp(-_STEP_S / _CORRELATION_S)
        drive = rng.standard_normal((len(time_s), 3))
        drive[1:] *= math.sqrt(1.0 - keep**2)
        error = _SD_POSITION_M * lfilter([1.0], [1.0, -keep], drive, axis=0)
        level = _LOCAL_FRAME.level_rotations(position) @ ENU_FROM_NED
        body = np.swapaxes(level, 1, 2) @ axes
        heading, pitch, roll = Rotation.from_matrix(body).as_euler("ZYX", degrees=True).T
        return Trajectory(
            time_s,
            _LOCAL_FRAME.map_from_enu(position) + error,
            np.column_stack((roll, pitch, heading)),
            np.full((len(time_s), 3), _SD_POSITION_M),
            None,
        )


def _turns(vector: FloatArray) -> FloatArray:
    return Rotation.from_rotvec(-vector).as_matrix()


def _sighting(
    index: int, name: str, time_s: float, pixel: FloatArray, translation: FloatArray
) -> Sighting:
    distance = float(np.linalg.norm(translation))
    ray = translation / distance
    lateral = (np.eye(3) - np.outer(ray, ray)) * (_SD_CENTRE_PX * distance / 2900.0) ** 2
    cov = np.zeros((6, 6))
    cov[:3, :3] = lateral + np.outer(ray, ray) * (_SD_DISTANCE * distance) ** 2
    return Sighting(
        frame=name,
        number=index + 1,
        target="A",
        instance=0,
        time_s=time_s,
        centre_px=pixel,
        centre_cov_px2=_SD_CENTRE_PX**2 * np.eye(2),
        distance_m=distance,
        sd_distance_m=_SD_DISTANCE * distance,
        sd_common_distance_m=None,
        pose=Pose(np.eye(3), translation),
        pose_cov=cov,
    )


def _reference(
    names: tuple[str, ...], centre: FloatArray, attitude: FloatArray, rng: np.random.Generator
) -> ReferencePoses:
    n = len(names)
    turn = Rotation.from_rotvec(_SD_REFERENCE_DEG * rng.standard_normal((n, 3)), degrees=True)
    photo = (
        np.swapaxes(_LOCAL_FRAME.grid_rotation(centre), 1, 2)
        @ turn.as_matrix()
        @ attitude
        @ CAMERA_FROM_PHOTO
    )
    return ReferencePoses(
        names,
        _LOCAL_FRAME.map_from_enu(centre) + _SD_REFERENCE_M * rng.standard_normal((n, 3)),
        opk_from_rotation(photo),
        np.full((n, 3), _SD_REFERENCE_M),
        np.full(n, _SD_REFERENCE_DEG),
    )


def _corrections(found: Consistency) -> FloatArray:
    """Values and deviations (10, 2); NaN: not estimated."""
    return np.array([[one.value, one.sd] for one in found.estimate.corrections], dtype=float)


_INJECTED = {
    "time_offset_s": (Flight(time_offset_s=0.025), 0.025),
    "lever_arm_right_m": (Flight(lever_m=_LEVER + _TO_THE_RIGHT), 0.08),
    "readout_s": (Flight(readout_s=0.03), 0.03),
    "boresight_y_deg": (Flight(boresight_rad=np.array([0.0, math.radians(0.2), 0.0])), 0.2),
    "diameter_percent": (Flight(stated_diameter=1.003), -0.3),
    "focal_length_percent": (Flight(stated_focal_length=1.003), -0.3),
}


@pytest.mark.parametrize("name", _INJECTED)
def test_only_injected_errors_are_found_within_their_deviations(name: str) -> None:
    flight, value = _INJECTED[name]
    truth = np.array([value if unknown.name == name else 0.0 for unknown in UNKNOWNS])
    found = [replace(flight, seed=seed).study() for seed in range(5)]
    tables = np.array([_corrections(one) for one in found])
    standardised = (tables[:, :, 0] - truth) / tables[:, :, 1]
    assert np.nanmax(np.abs(standardised)) < 4.0
    assert 0.8 < math.sqrt(np.nanmean(standardised**2)) < 1.25
    index = [unknown.name for unknown in UNKNOWNS].index(name)
    assert tables[:, index, 1].max() < 0.25 * abs(value)  # a small, meaningful sigma
    for one in found:
        significant = [c.name for c in one.estimate.corrections if c.is_significant]
        assert significant == [name]
        assert 0.75 < one.estimate.variance_factor < 1.25
        assert one.estimate.chi2_before - one.estimate.chi2_after > 60.0


def _poses_by_points(poses: ReferencePoses, sd_up_m: float) -> ReferencePoses:
    """State that poses err by their own turns about places 60 m below them, and in height."""
    turn = math.radians(_SD_REFERENCE_DEG)
    effects = np.zeros((6, 9))
    effects[:3, :3] = np.diag(
        [_SD_REFERENCE_M, _SD_REFERENCE_M, math.hypot(_SD_REFERENCE_M, sd_up_m)]
    )
    effects[:3, 3:6] = turn * np.array([[0.0, 60.0, 0.0], [-60.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    effects[3:, 3:6] = turn * np.eye(3)
    cov = np.broadcast_to(effects @ effects.T, (len(poses.frames), 6, 6))
    return replace(poses, cov=cov)


def test_errors_that_all_poses_share_are_no_corrections() -> None:
    """Poses by targets on the ground are all too high by the same amount."""
    sightings, positions, poses = Flight(frames=60, seed=2).inputs()
    high = replace(poses, position_map=poses.position_map + np.array([0.0, 0.0, 0.03]))
    found = study_consistency(sightings, positions, _poses_by_points(high, 0.03), _CAMERA)
    assert found is not None
    assert corrections(found) == ()
    by_name = {one.name: one for one in found.estimate.corrections}
    value, sd = by_name["lever_arm_down_m"].value, by_name["lever_arm_down_m"].sd
    assert value is not None
    assert sd is not None
    assert abs(value + 0.03) < 3.0 * sd < 0.06


def test_scatter_over_flights_is_the_reported_sigma() -> None:
    flight = Flight(time_offset_s=0.025, lever_m=_LEVER + _TO_THE_RIGHT, readout_s=0.03)
    truth = np.array([0.025, 0.0, 0.08, 0.0, 0.03, *[0.0] * 3])
    tables = np.array([_corrections(replace(flight, seed=100 + k).study())[:8] for k in range(24)])
    standardised = (tables[:, :, 0] - truth) / tables[:, :, 1]
    scatter = np.sqrt(np.mean(standardised**2, axis=0))
    assert np.all((scatter > 0.6) & (scatter < 1.45))  # of 24: ± 0.14 each
    assert 0.88 < math.sqrt(np.mean(scatter**2)) < 1.12
    assert np.abs(standardised.mean(axis=0)).max() < 0.8


def test_a_straight_drive_at_constant_speed_does_not_separate_time_and_lever_arm() -> None:
    found = Flight(is_straight=True, time_offset_s=0.025, seed=3).study()
    by_name = {one.name: one for one in found.estimate.corrections}
    time, forward = by_name["time_offset_s"], by_name["lever_arm_forward_m"]
    assert time.value is not None
    assert time.sd is not None
    assert abs(time.value - 0.025) < 4.0 * time.sd
    assert time.sd < 0.002
    assert forward.value is None
    assert "lever_arm_forward_m" in time.tangled_with
    assert "time_offset_s" in forward.tangled_with
    assert any("apart from lever_arm_forward_m" in line for line in advised(found))


def advised(found: Consistency) -> tuple[str, ...]:
    """The advice if no doubt names another cause than the corrections."""
    due = corrections(found) if is_explained(found) else ()
    return advice(found, [mild(Cause.CORRECTION, *each) for each in due])


def test_advice_names_key_and_amount_and_disappears_once_followed() -> None:
    flight = Flight(time_offset_s=0.025, seed=1)
    (line,) = advised(flight.study())
    match = re.fullmatch(
        r"add (0\.02\d+) ± (0\.000\d+) s to \[vehicle\] time_offset_s in flight\.toml", line
    )
    assert match
    heeded = replace(flight, settings=replace(flight.settings, time_offset_s=float(match[1])))
    assert advised(heeded.study()) == ()
    assert advised(Flight(seed=1).study()) == ()


def test_corrections_within_the_uncertainty_in_flight_toml_are_not_advised() -> None:
    """8 cm are found just as well, but are within an uncertainty of 10 cm in flight.toml."""
    flight = Flight(lever_m=_LEVER + _TO_THE_RIGHT, seed=1)
    for sd_m, lines in ((0.05, 1), (0.1, 0)):
        vague = replace(flight.settings, sd_lever_arm_m=(0.0, sd_m, 0.0))
        found = replace(flight, settings=vague).study()
        assert len(advised(found)) == lines
        assert [one.name for one in found.estimate.corrections if one.is_significant] == [
            "lever_arm_right_m"
        ]


def test_clocks_that_do_not_belong_together_are_named_instead_of_corrections() -> None:
    """Three seconds at 15 m/s are more than anybody's time_offset_s is wrong by."""
    flight = Flight(time_offset_s=-3.0, seed=1)
    (line,) = advised(flight.study())
    assert re.search(r"differ by \d+\.\d+ m along, .* no correction of lever arm", line)
    (doubt,) = flight.causes()
    assert doubt.code is Cause.CLOCK
    assert re.search(r"\(frames (3|3\.00\d*|2\.99\d*) s late\)", doubt.sentence)


def test_a_correct_flight_has_no_cause_to_look_for() -> None:
    for seed in range(3):
        assert Flight(seed=seed).causes() == ()
        assert Flight(seed=seed, has_sds=False).causes() == ()


def test_a_wrong_sign_of_a_lever_arm_is_distinguished_from_a_wrong_length() -> None:
    right = VehicleSettings(lever_arm_m=(*_LEVER[:2].tolist(), -float(_LEVER[2])))
    (doubt,) = Flight(seed=2, settings=right).causes()
    assert doubt.code is Cause.LEVER_ARM
    assert "the sign of lever_arm_m (down)" in doubt.sentence
    other = VehicleSettings(lever_arm_m=(*_LEVER[:2].tolist(), float(_LEVER[2]) - 30.0))
    (doubt,) = Flight(seed=2, settings=other).causes()
    assert doubt.code is Cause.LEVER_ARM
    assert "seems to be wrong by 30.0" in doubt.sentence


def test_a_known_readout_is_taken_into_account() -> None:
    """The camera moves and turns until the target's row: 7 cm and 0.07° in this flight."""
    flight, rolling = Flight(readout_s=0.03, seed=2), replace(_CAMERA, readout_s=0.03)
    inputs, motions = flight.inputs(), flight.motions()
    found = study_consistency(*inputs, rolling, motions)
    assert found is not None
    assert advised(found) == ()
    deviations = np.array(
        [one.offset_m / np.sqrt(np.diag(one.cov_m2)) for one in found.discrepancies]
    )
    assert 0.7 < np.sqrt(np.mean(deviations**2)) < 1.3
    # a camera that stands still until then was put 0.2 m from its vehicle
    still, moving = (Encounters.of(*inputs, rolling, known) for known in (None, motions))
    assert still is not None
    assert moving is not None
    assert causes_of(moving) == ()
    assert moving.misfit < 1.5
    assert still.misfit > 3.0


def test_offsets_are_along_and_across_the_track() -> None:
    found = Flight(time_offset_s=0.025, seed=4).study()
    offsets = np.array([one.offset_m for one in found.discrepancies])
    # the vehicle is put where it was 25 ms earlier, at some 15 m/s
    assert np.median(offsets[:, 0]) == pytest.approx(-0.375, abs=0.08)
    assert np.abs(np.median(offsets[:, 1:], axis=0)).max() < 0.02
    ahead = Flight(lever_m=_LEVER + _TO_THE_RIGHT, seed=4).study()
    across = np.array([one.offset_m for one in ahead.discrepancies])
    assert np.median(across[:, 1]) == pytest.approx(-0.08, abs=0.02)
    deviations = np.array(
        [one.residual_m / np.sqrt(np.diag(one.cov_m2)) for one in ahead.discrepancies]
    )
    assert 0.7 < np.sqrt(np.mean(deviations**2)) < 1.2


def test_wrong_points_are_named_as_outliers_and_left_out() -> None:
    found = Flight(seed=5, time_offset_s=0.025, wrong=(7, 30, 31, 90)).study()
    assert [i for i, one in enumerate(found.discrepancies) if one.is_outlier] == [7, 30, 31, 90]
    time = found.estimate.corrections[0]
    assert time.value is not None
    assert time.sd is not None
    assert abs(time.value - 0.025) < 4.0 * time.sd


def test_the_trajectorys_correlation_time_is_found_to_within_its_neighbours() -> None:
    times = [Flight(seed=seed).study().correlation_s for seed in range(3)]
    assert set(times) <= {10.0, 30.0}  # 20 s, of 0, 1, 3, 10, 30, 100, 300


def test_without_stated_deviations_the_residuals_determine_the_scale() -> None:
    flight = Flight(has_sds=False, time_offset_s=0.025)
    truth = np.array([0.025, *[0.0] * 7])
    tables = np.array([_corrections(replace(flight, seed=k).study())[:8] for k in range(6)])
    standardised = (tables[:, :, 0] - truth) / tables[:, :, 1]
    assert 0.7 < math.sqrt(np.mean(standardised**2)) < 2.5  # rough, as the documentation says


def test_a_few_frames_are_not_enough() -> None:
    assert Flight(frames=9).study_if_enough() is None
