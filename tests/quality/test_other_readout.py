"""A wrong readout, by a camera that hovers: it also shears the images of the target's ring."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.georef.camera_priors import BODY_FROM_LEVEL_PLATE
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.scene_rotation import CameraMotions, camera_motions
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.georef.trajectory import ENU_FROM_NED, body_to_ned
from kgcp.measurement.image_model.plate import circles_of
from kgcp.measurement.image_model.rotation_displacement import (
    mean_square_displacement,
    pose_displacements,
)
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.quality.advice import corrections, is_explained
from kgcp.quality.consistency import Consistency, study_consistency
from kgcp.quality.corrections import READOUT
from tests.quality import test_consistency as flights

_CAMERA = flights._CAMERA
_CIRCLES = circles_of((flights._TARGET.ring,))
_DELAY = _CAMERA.fy / (_CAMERA.height - 1)  # per unit of y, in readouts
_HEIGHT_M = 50.0
_SD_RAD_S = np.radians(1.0)  # of the scene's rotation, as the frames around show it


@dataclass(frozen=True)
class Hovering(flights.Flight):
    """A vehicle at 5 m/s on a circle of 10 m radius, below a camera that hardly moves."""

    frames: int = 24
    stated_s: float = 0.0

    def vehicle(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        angle, wave = 0.5 * time_s, np.sin(0.3 * time_s)
        position = 10.0 * np.column_stack((np.cos(angle), np.sin(angle), 0.0 * angle))
        attitude = ENU_FROM_NED @ body_to_ned(wave, 0.7 * wave, -np.degrees(angle))
        return position, flights._LOCAL_FRAME.level_rotations(position) @ attitude

    def drone(self, time_s: FloatArray) -> FloatArray:
        sway = 0.3 * np.column_stack((np.sin(0.5 * time_s), np.cos(0.37 * time_s), 0.0 * time_s))
        return np.asarray(sway + np.array([0.0, 0.0, _HEIGHT_M]))

    def spin(self, time_s: FloatArray) -> FloatArray:
        turns = np.column_stack((5.0 * np.sin(0.1 * time_s), 180.0 + 0.5 * np.sin(0.7 * time_s)))
        return np.asarray(Rotation.from_euler("ZX", turns, degrees=True).as_matrix())

    def inputs(self) -> tuple[list[Sighting], TargetPositions, ReferencePoses]:
        """With poses as measured in images that are corrected for the stated readout."""
        sightings, positions, poses = super().inputs()
        return [self._sheared(each) for each in sightings], positions, poses

    def _sheared(self, sighting: Sighting) -> Sighting:
        assert sighting.pose is not None
        assert sighting.pose_cov is not None
        assert sighting.time_s is not None
        row_s = sighting.time_s + sighting.rows_since_middle(_CAMERA) * self.readout_s
        (before, after), axes = self._sights(row_s + np.array([-0.01, 0.01])), self._axes(row_s)
        turn = np.cross(before, after) / (0.02 * np.linalg.norm(before) * np.linalg.norm(after))
        true = Pose(axes, sighting.pose.translation_m)
        excess_s = self.readout_s - self.stated_s
        (off,) = pose_displacements(true, _CIRCLES, _DELAY, -excess_s * turn[None])
        cov = sighting.pose_cov + 4e-8 * np.diag([0, 0, 0, 1, 1, 1])
        if self.stated_s:
            cov = cov + mean_square_displacement(true, _CIRCLES, self.stated_s * _DELAY, _SD_RAD_S)
        pose = Pose(rotation_about(off[3:]) @ axes, true.translation_m + off[:3])
        return replace(sighting, pose=pose, pose_cov=cov, distance_m=pose.distance_m)

    def _sights(self, time_s: FloatArray) -> FloatArray:
        sight_m = self.target(time_s) - self.drone(time_s)
        return np.asarray(np.einsum("nji,nj->ni", self.spin(time_s), sight_m))

    def _axes(self, time_s: float) -> FloatArray:
        at_s = np.array([time_s])
        body = self.spin(at_s)[0].T @ self.vehicle(at_s)[1][0]
        return np.asarray(body @ BODY_FROM_LEVEL_PLATE)

    def motions(self) -> CameraMotions:
        sightings, positions, poses = self.inputs()
        exterior = ExteriorOrientations.of(poses, positions.local_frame)
        return camera_motions(
            np.array([each.time_s for each in sightings]),
            exterior.centre_m,
            exterior.enu_from_camera,
            [None] * self.frames,
            SceneRotation.unknown(replace(_CAMERA, readout_s=self.stated_s)),
            _HEIGHT_M,
        )

    def study(self) -> Consistency:
        motions = self.motions() if self.stated_s else None
        camera = replace(_CAMERA, readout_s=self.stated_s)
        found = study_consistency(*self.inputs(), camera, motions)
        assert found is not None
        return found


@pytest.mark.parametrize(
    ("true_s", "stated_s"),
    [(0.03, 0.015), (0.03, 0.06), (0.03, 0.0), (0.0, 0.03), (-0.03, 0.03)],
)
def test_a_wrong_readout_is_named_with_its_deviation(true_s: float, stated_s: float) -> None:
    """Sizes and rows agree on it; by the rows alone, sizes would contradict every correction."""
    found = Hovering(readout_s=true_s, stated_s=stated_s, seed=1).study()
    assert is_explained(found)
    (line,) = [remedy for _, remedy in corrections(found) if "readout_s" in remedy]
    assert "then run 'kgcp detect' again" in line
    readout = found.estimate.corrections[READOUT]
    assert readout.value is not None
    assert readout.sd is not None
    assert abs(readout.value - (true_s - stated_s)) < 3.0 * readout.sd < 0.01
    assert found.estimate.chi2_after < 0.5 * found.estimate.chi2_before


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_a_right_readout_is_left_alone(readout_s: float) -> None:
    """Also where another error makes vehicle and camera disagree."""
    for lever_m in (flights._LEVER, flights._LEVER + flights._TO_THE_RIGHT):
        flight = Hovering(readout_s=readout_s, stated_s=readout_s, lever_m=lever_m, seed=2)
        found = flight.study()
        significant = [c.name for c in found.estimate.corrections if c.is_significant]
        assert significant == ["lever_arm_right_m"] * (lever_m is not flights._LEVER)
